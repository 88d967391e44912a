"""Whether held-out readings can be predicted from those that are fitted.

The prediction of a held-out row with the derivative J has the covariance 1 + J H^-1 J' in units of
the noise, with H = J_f'J_f + L of the fitted rows f and of the prior. The second term is that of
the parameters. Where the fitted rows leave a direction of the parameters open on which the held-out
rows depend (poses that are all upright do not separate the height of the station from that of the
reflector), it is far above one: the held-out error then says nothing about the model.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import solve_triangular

from ..machine.plan import Plan
from ..model.declared_noise import declared_whitener
from ..model.forward import Model
from ..model.measurement import Measurement
from ..numerics.eigen import eigh
from .fit import Fit
from .linearised import linearised_terms
from .posterior import open_shapes
from .rank import nominal_jacobian

FAR = 10.0
"""Uncertainty of a prediction by the parameters, in units of the noise, from which a row cannot be
predicted."""
_FEW = 0.02
"""Share of the held-out rows that may be beyond that: single poses at the edge of the work space
are extrapolated under any choice."""
_SMALLEST = 1e-14
"""Least eigenvalue of the scaled information that is taken to differ from zero."""
_PART = 0.25
"""Component, relative to the largest, from which a parameter belongs to an open direction."""
_MANY = 50
"""Number of parameters from which their elimination takes less time than it saves."""
_MOST = 4
"""Largest number of parameters that are named."""


@dataclass(frozen=True)
class Unpredictable:
    """Held-out rows that the fitted rows do not predict."""

    rows: Int[np.ndarray, " r"]
    """Their positions in the plan, the worst first."""
    held: int
    """Number of all held-out rows."""
    ratio: float
    """Root mean square uncertainty of the prediction of `rows` by the parameters, in units of the
    noise; infinite where the fitted rows leave a parameter entirely open."""
    parameters: tuple[str, ...]
    """Names of the parameters in the direction on which most of it depends."""

    def words(self, plan: Plan) -> str:
        """Which rows, how far, and on which parameters it depends."""
        which = _spans(sorted(int(row) for row in self.rows), plan)
        size = "unbounded" if not self.ratio < 1e6 else f"{self.ratio:.2g} times the noise"
        names = " and ".join(self.parameters)
        return (
            f"{len(self.rows)} of the {self.held} held-out rows ({which}) cannot be predicted from "
            f"those that are fitted, as these do not determine {names} separately (uncertainty of "
            f"the prediction: {size})"
        )


def unpredictable(
    jacobian: Float[np.ndarray, "n m k"],
    precision: Float[np.ndarray, " k"],
    names: Sequence[str],
    folds: Int[np.ndarray, " n"],
    apart: Bool[np.ndarray, " n"],
    kept: Bool[np.ndarray, " n"],
) -> Unpredictable | None:
    """The held-out rows that the fitted rows do not predict; None where they predict (nearly) all.

    `jacobian` is whitened by the noise, also in the rows that are never fitted (`apart`); `folds`
    are those of the other held-out rows, -1 for none. `kept` are the rows without outliers, and
    `precision` is the diagonal of that of the prior.
    """
    found: list[np.ndarray] = []
    held: list[np.ndarray] = []
    blame = np.zeros(len(precision))
    fitted = kept & ~apart
    seen = jacobian[fitted].reshape(-1, len(precision))
    total = seen.T @ seen
    for fold in (-1, *np.unique(folds[fitted & (folds >= 0)])):
        rows = np.flatnonzero(apart & kept if fold < 0 else fitted & (folds == fold))
        rest = fitted & ~(folds == fold) if fold >= 0 else fitted
        if not len(rows):
            continue
        size, part = _uncertainty(jacobian[rows], jacobian[rest], precision, fold >= 0, total)
        held.append(rows)
        found.append(size)
        if (far := size > FAR).any():
            blame = np.maximum(blame, part(far))
    if not held:
        return None
    rows, size = np.concatenate(held), np.concatenate(found)
    far = np.flatnonzero(size > FAR)
    if len(far) <= _FEW * len(rows):
        return None
    far = far[np.argsort(-size[far], kind="stable")]
    order = np.argsort(-blame, kind="stable")[:_MOST]
    order = order[blame[order] > _PART * blame.max()]
    return Unpredictable(
        rows=rows[far],
        held=len(rows),
        ratio=math.sqrt(float((size[far] ** 2).mean())),
        parameters=tuple(str(names[int(i)]) for i in np.sort(order)),
    )


def own_parameters(
    inside: Float[np.ndarray, "r k"],
    total: Float[np.ndarray, "k k"],
    precision: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, "k k"], Bool[np.ndarray, " k"]]:
    """Basis (k, k) of the parameters, and which of its vectors only one fold determines (k,).

    Parameters with a flat prior are combined so that those that only the fold with the Jacobian
    `inside` (r, k) determines are separate; `total` (k, k) is the information of all readings.
    """
    flat = precision == 0
    basis, own = np.eye(len(total)), np.zeros(len(total), bool)
    if flat.any():
        block = np.ix_(flat, flat)
        diagonal = np.diag(total)[flat]
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        rest = total[block] - inside[:, flat].T @ inside[:, flat]
        values, vectors = eigh(rest * scale[:, None] * scale)
        basis[block] = scale[:, None] * vectors
        own[flat] = values <= 1e-9
    return basis, own


def independent_of(
    inside: Float[np.ndarray, "r k"],
    total: Float[np.ndarray, "k k"],
    precision: Float[np.ndarray, " k"],
) -> tuple[Bool[np.ndarray, " k"], np.ndarray | float]:
    """Elimination of the parameters with a flat prior on which some rows do not depend, such as the
    other poses of an artefact: the parameters that remain (k,), and what the elimination takes from
    the information about them, H_ru H_uu^-1 H_ur.

    `inside` (r, k) is the Jacobian of the rows and `total` (k, k) the information of all readings.
    Few parameters remain where they are.
    """
    away = (precision == 0) & ~inside.any(axis=0)
    every = np.ones(len(precision), bool), 0.0
    diagonal = np.diag(total)[away]
    if len(diagonal) < _MANY or not (diagonal > 0.0).all():
        return every
    scale = 1.0 / np.sqrt(diagonal)
    try:
        lower = np.linalg.cholesky(total[np.ix_(away, away)] * scale[:, None] * scale)
    except np.linalg.LinAlgError:
        return every
    half = solve_triangular(lower, scale[:, None] * total[np.ix_(away, ~away)], lower=True)
    return ~away, half.T @ half


def _uncertainty(
    inside: np.ndarray, rest: np.ndarray, precision: np.ndarray, fresh: bool, total: np.ndarray
):
    """Uncertainty (r,) of the predictions of rows (r, m, k) from the `rest` by the parameters, rms
    over their readings, and a function that gives the share (k,) of every parameter in the
    direction that makes up most of it for some of these rows.

    With `fresh`, parameters with a flat prior that only the rows themselves determine, such as the
    pose of an artefact, are re-estimated from them; `total` (k, k) is then the information of the
    rows and the `rest`.
    """
    r, m, size = inside.shape
    rows, rest, remain, taken = inside.reshape(-1, size), rest.reshape(-1, size), ..., 0.0
    if fresh:
        remain, taken = independent_of(rows, total, precision)
    rows, rest, precision = rows[:, remain], rest[:, remain], precision[remain]
    information, k = rest.T @ rest - taken, rows.shape[1]
    basis, own = np.eye(k), np.zeros(k, bool)
    if fresh:
        basis, own = own_parameters(rows, information + rows.T @ rows, precision)
    rows = rows @ basis
    information = basis.T @ (information + np.diag(precision)) @ basis
    common = np.flatnonzero(~own)
    diagonal = np.diag(information)[common]
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = eigh(information[np.ix_(common, common)] * scale[:, None] * scale)
    directions = scale[:, None] * vectors
    moved = rows[:, common] @ directions
    if own.any():
        q, _ = np.linalg.qr(rows[:, own])
        moved = moved - q @ (q.T @ moved)
    by_direction = (moved**2 / np.maximum(values, _SMALLEST)).reshape(r, m, -1).mean(1)

    def part(far: np.ndarray) -> np.ndarray:
        worst = int(by_direction[far].sum(0).argmax())
        # In units of what each parameter moves in the held-out rows.
        along = np.zeros(size)
        along[remain] = np.abs(basis[:, common] @ directions[:, worst])
        return along * np.sqrt((inside[far].reshape(-1, size) ** 2).sum(0))

    return np.sqrt(by_direction.sum(1)), part


def unpredictable_by(
    model: Model, measurement: Measurement, folds: np.ndarray, apart: np.ndarray
) -> Unpredictable | None:
    """`unpredictable` before any fit: at the nominal machine, with the declared noise and priors.

    Effects whose shape parameters are not declared are left out.
    """
    kept = [i for i, effect in enumerate(model.effects) if not open_shapes(effect)]
    less = Model(model.chain, model.instrument, (*(model.effects[i] for i in kept), *model.random))
    jacobian = np.einsum(
        "nij,njk->nik",
        declared_whitener(less, measurement),
        nominal_jacobian(less, measurement.plan),
    )
    return unpredictable(
        jacobian,
        np.array([float(e.parameter.informed) for e in less.entries]),
        [f"{e.key} {e.parameter.name}" for e in less.entries],
        np.where(apart, -1, folds),
        apart,
        np.ones(measurement.rows, bool),
    )


def unpredictable_of(fit: Fit, folds: np.ndarray, apart: np.ndarray) -> Unpredictable | None:
    """`unpredictable` of a fit, without its outliers, and with the effects that were found."""
    n, m = fit.residual.shape
    jacobian = fit.jacobian.reshape(n, m, -1).copy()
    if apart.any():
        plan = fit.measurement.plan
        terms = linearised_terms(fit.model, plan, fit.shapes, fit.theta)
        gather = np.zeros((len(terms.parameter), jacobian.shape[2]))
        gather[np.arange(len(terms.parameter)), terms.parameter] = 1.0
        values = np.asarray(terms.values)[apart]
        by_port = fit.port_jacobian[apart][:, :, np.asarray(terms.port)]
        for name, inside in plan.parts.items():
            del name
            mine = apart & inside
            if mine.any() and (used := fit.used & inside).any():
                typical = np.median(fit.whitener[used], axis=0)
                here = mine[apart]
                jacobian[mine] = typical @ ((by_port[here] * values[here][:, None, :]) @ gather)
    shapes = [f"{fit.model.effects[i].key} shape" for i in fit.shapes]
    names = [f"{key} {p.name}" for key, p in fit.entries]
    names += shapes * (jacobian.shape[2] - len(names))
    return unpredictable(
        jacobian,
        fit.within_scans,
        names[: jacobian.shape[2]],
        folds,
        apart,
        fit.used | apart,
    )


def _spans(rows: Sequence[int], plan: Plan, most: int = 3) -> str:
    """Rows by their numbers in the tables, consecutive ones as a span."""
    spans: list[list[int]] = []
    for row in rows:
        if spans and row == spans[-1][1] + 1:
            spans[-1][1] = row
        else:
            spans.append([row, row])
    spans.sort(key=lambda s: s[0] - s[1])
    said = [
        plan.row_name(a) if a == b else f"{plan.row_name(a)} to {plan.row_name(b)}"
        for a, b in spans[:most]
    ]
    return ", ".join(said) + (", ..." if len(spans) > most else "")
