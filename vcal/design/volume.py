"""What errors of a machine amount to in its work space: quadratic forms of its parameters.

    mean square |d| over the points = theta' G theta

with d the displacement of the tool point. The rigid motion that fits all points best is taken out
(*aligned*), as an artefact or a station of unknown pose cannot see it, or left in (*raw*).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..arrays import Array
from ..model import Model, effect_terms, tool_points_with_jacobian
from ..plan import Plan
from ..spatial import rigid_columns


class Gram(NamedTuple):
    """Mean square of the displacement over some points, m^2 per solver unit squared."""

    aligned: Float[np.ndarray, "k k"]
    raw: Float[np.ndarray, "k k"]


def volumetric_gram(model: Model, points: Plan) -> Gram:
    """G of the machine's own effects, by the amplitudes in solver units (`Model.entries`); those of
    the instrument do not move the tool. Linear in the amplitudes, at the nominal machine.
    """
    still = jnp.zeros((points.rows, len(model.layout)))
    nominal, by_port = tool_points_with_jacobian(model.chain, jnp.asarray(points.position), still)
    slopes = np.asarray(by_port)
    moved = np.zeros((points.rows, 3, len(model.entries)))
    start, moves = 0, np.zeros(len(model.entries), bool)
    for effect in model.effects:
        if effect.where == "machine":
            shape = {p.name: p.mean * p.si for p in effect.shapes}
            terms = effect_terms(effect, model.layout, points, shape, start)
            columns = np.asarray(terms.values)
            for port, parameter, column in zip(terms.port, terms.parameter, columns.T, strict=True):
                moved[:, :, parameter] += slopes[:, :, port] * column[:, None]
            moves[start : start + len(effect.amplitudes)] = True
        start += len(effect.amplitudes)
    flat = moved[:, :, moves].reshape(3 * points.rows, -1)
    at = np.asarray(nominal)
    rigid, _ = np.linalg.qr(rigid_columns(at - at.mean(0)).reshape(-1, 6))
    seen = rigid.T @ flat
    raw = np.zeros((len(moves), len(moves)))
    aligned = np.zeros_like(raw)
    own = np.ix_(moves, moves)
    raw[own] = flat.T @ flat / points.rows
    aligned[own] = raw[own] - seen.T @ seen / points.rows
    return Gram(aligned, raw)


def gram_for(model: Model, gram: Gram, of: Model) -> Gram:
    """G of the amplitudes of `model` out of the `gram` of another one, which has all those of its
    effects that move the tool.

    Raises `ValueError` for an effect of the machine that `of` does not have.
    """
    known = {(e.key, e.parameter.name): i for i, e in enumerate(of.entries)}
    places = np.array([known.get((e.key, e.parameter.name), -1) for e in model.entries])
    for entry, place in zip(model.entries, places, strict=True):
        if place < 0 and model.effects[entry.effect].where == "machine":
            raise ValueError(
                f"{entry.key}: found an effect of the machine that the Gram matrix was not "
                "computed for, expected one of its own; compute it for all effects"
            )
    # The last row and column, which -1 reads, are zero.
    return Gram(*(np.pad(g, (0, 1))[np.ix_(places, places)] for g in gram))


def expected_rms(gram: Float[Array, "k k"], covariance: Float[Array, "k k"]) -> Float[Array, ""]:
    """Root of the expected mean square of the displacement, m: sqrt(tr(G C))."""
    return jnp.sqrt(jnp.einsum("kl,kl->", gram, covariance))
