"""Volumetric errors of a machine as quadratic forms of its parameters.

    mean of |d|^2 over the points = theta' G theta

with d the displacement of the tool point. The rigid motion that fits all points best is either
subtracted (*aligned*), because a measurement with an artefact or a station of unknown pose contains
no information about it, or included (*raw*).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..machine.plan import Plan
from ..model.forward import Model, effect_terms, tool_points_with_jacobian
from ..numerics.arrays import Array
from ..numerics.spatial import rigid_basis


class Gram(NamedTuple):
    """Mean square of the displacement over some points, m^2 per solver unit squared."""

    aligned: Float[np.ndarray, "k k"]
    raw: Float[np.ndarray, "k k"]


class Displacements(NamedTuple):
    """Displacement of the tool point at some points, m per solver unit."""

    raw: Float[np.ndarray, "n 3 c"]
    rigid: Float[np.ndarray, "n 3 r"]
    """Orthonormal rigid motions of all points."""
    places: Int[np.ndarray, " c"]
    """Positions of the amplitudes of the model that move the tool."""

    @property
    def aligned(self) -> Float[np.ndarray, "n 3 c"]:
        """Displacement after the best rigid alignment of all points."""
        return self.raw - np.einsum("nar,rc->nac", self.rigid, self.seen)

    @property
    def seen(self) -> Float[np.ndarray, "r c"]:
        """Components of the displacement along the rigid motions."""
        return np.einsum("nar,nac->rc", self.rigid, self.raw, optimize=True)


def displacements(model: Model, points: Plan) -> Displacements:
    """Displacement of the tool point by the effects of the machine, per amplitude in solver units
    (`Model.entries`), linearised at the nominal machine.

    Effects of the instrument do not move the tool point.
    """
    still = jnp.zeros((points.rows, len(model.layout)))
    nominal, by_port = tool_points_with_jacobian(model.chain, jnp.asarray(points.position), still)
    slopes = np.asarray(by_port)
    moved = np.zeros((points.rows, 3, len(model.entries)))
    moves = np.zeros(len(model.entries), bool)
    for effect, place in zip(model.effects, model.places, strict=True):
        if effect.where == "machine":
            shape = {p.name: p.mean * p.si for p in effect.shapes}
            terms = effect_terms(effect, model.layout, points, shape, place.start)
            columns = np.asarray(terms.values)
            for port, parameter, column in zip(terms.port, terms.parameter, columns.T, strict=True):
                moved[:, :, parameter] += slopes[:, :, port] * column[:, None]
            moves[place] = True
    rigid = rigid_basis(np.asarray(nominal))
    return Displacements(
        moved[:, :, moves], rigid.reshape(points.rows, 3, -1), np.flatnonzero(moves)
    )


def volumetric_gram(model: Model, points: Plan) -> Gram:
    """G (k, k) of all amplitudes of a model over some points (`displacements`)."""
    moved = displacements(model, points)
    size, own = len(model.entries), np.ix_(moved.places, moved.places)
    flat = moved.raw.reshape(3 * points.rows, -1)
    raw = np.zeros((size, size))
    raw[own] = flat.T @ flat / points.rows
    aligned = raw.copy()
    aligned[own] -= moved.seen.T @ moved.seen / points.rows
    return Gram(aligned, raw)


def gram_for(model: Model, gram: Gram, of: Model) -> Gram:
    """G of the amplitudes of `model`, taken from the `gram` of the model `of`, which contains all
    effects of `model` that move the tool.

    Raises `ValueError` for an effect of the machine that `of` does not contain.
    """
    known = {(e.key, e.parameter.name): i for i, e in enumerate(of.entries)}
    places = np.array([known.get((e.key, e.parameter.name), -1) for e in model.entries])
    for entry, place in zip(model.entries, places, strict=True):
        if place < 0 and model.effects[entry.effect].where == "machine":
            raise ValueError(
                f"{entry.key}: found an effect of the machine that is not in the Gram matrix, "
                "expected all of them; compute the matrix for a model with all effects"
            )
    # The last row and column, which -1 reads, are zero.
    return Gram(*(np.pad(g, (0, 1))[np.ix_(places, places)] for g in gram))


def expected_rms(gram: Float[Array, "k k"], covariance: Float[Array, "k k"]) -> Float[Array, ""]:
    """Root of the expected mean square of the displacement, m: sqrt(tr(G C))."""
    return jnp.sqrt(jnp.einsum("kl,kl->", gram, covariance))
