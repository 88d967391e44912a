"""Rank of a plan: which amplitudes the readings determine without any prior."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..machine.plan import Plan
from ..model.forward import Model, compared_with_jacobian
from .posterior import check_shapes, open_shapes, slopes

FREE = 1e-8
"""Singular value, for columns of unit length, below which a combination is not observable."""
_PART = 1e-3
"""Component in an unobservable combination from which a parameter counts as part of it."""


class Rank(NamedTuple):
    """Rank of the derivative of all readings by the amplitudes."""

    columns: int
    """Number of amplitudes."""
    rank: int
    mixed: tuple[int, ...]
    """Positions of the amplitudes (`Model.entries`) in unobservable combinations."""


def rank_of(model: Model, plan: Plan) -> Rank:
    """Rank for all amplitudes at the nominal machine.

    Raises as `vcal.identification.posterior.jacobian` does.
    """
    return _rank(model, plan, range(len(model.entries)))


def flat_rank(model: Model, plan: Plan, rows: Bool[np.ndarray, " n"] | None = None) -> Rank:
    """Rank for the amplitudes with a flat prior, at the nominal machine, from the readings of
    `rows`, by default of all.

    Amplitudes with a proper prior count as known. Effects with shape parameters that are not
    declared are left out, because their response depends on these.
    """
    flat = [
        i
        for i, entry in enumerate(model.entries)
        if not entry.parameter.informed and not open_shapes(model.effects[entry.effect])
    ]
    kept = sorted({model.entries[i].effect for i in flat})
    less = Model(model.chain, model.instrument, [model.effects[i] for i in kept])
    # Positions in the whole model of the remaining amplitudes.
    own = [i for i, entry in enumerate(model.entries) if entry.effect in kept]
    found = _rank(less, plan, [own.index(i) for i in flat], rows)
    return found._replace(mixed=tuple(own[i] for i in found.mixed))


def _rank(
    model: Model, plan: Plan, columns: Sequence[int], rows: Bool[np.ndarray, " n"] | None = None
) -> Rank:
    """Rank for some of the amplitudes, by their positions."""
    if not columns:
        return Rank(0, 0, ())
    J = nominal_jacobian(model, plan)
    J = J if rows is None else J[rows]
    J = J.reshape(-1, J.shape[-1])[:, np.asarray(columns)]
    norms = np.linalg.norm(J, axis=0)
    J = J / np.where(norms > 0.0, norms, 1.0)
    _, sizes, vt = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    rank = int((sizes > FREE).sum())
    parts = np.abs(vt[rank:]).max(0, initial=0.0)
    mixed = tuple(columns[i] for i in np.flatnonzero(parts > _PART).tolist())
    return Rank(J.shape[1], rank, mixed)


def nominal_jacobian(model: Model, plan: Plan) -> Float[np.ndarray, "n m k"]:
    """Derivative (n, m, k) of the readings by the amplitudes at the nominal machine, up to its
    sign, by the function that a later fit of this plan compiles too. Raises as
    `vcal.identification.posterior.jacobian` does.
    """
    check_shapes(model)
    instrument, rows = model.instrument, plan.rows
    # The same compiled function as in a later fit of this plan.
    _, by_port = compared_with_jacobian(
        model.chain,
        instrument,
        plan,
        instrument.rows(plan),
        np.zeros((rows, len(instrument.readings))),  # type: ignore[arg-type]
        np.zeros((rows, len(model.layout))),  # type: ignore[arg-type]
    )
    return np.asarray(slopes(model.effects, model, plan, np.asarray(by_port)))  # type: ignore[arg-type]
