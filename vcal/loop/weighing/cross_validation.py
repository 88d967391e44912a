"""Cross-validation: errors of a fit on held-out readings, and at independent check points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from ...geometry.compensated import compensated_points
from ...identification.fit import Fit
from ...identification.model_averaging import Alternatives
from ...identification.predictable import independent_of, own_parameters
from ...identification.shape_steps import SETTLED
from ...model.forward import Model
from ...model.measurement import CheckPoints, Measurement
from ...numerics.eigen import eigh
from ...numerics.spatial import after_alignment, align_rigid

_BLOCK, _BLOCKS = 8, 25
"""Least number of rows in a block that is predicted together, and about the largest number of
blocks in a fold."""
_OWN, _SHARED = 1e-9, 1e-4
"""Share of a direction of the readings of a fold that the other folds leave: below the first, only
the fold determines it; above the second, others do."""
_FEW = 12
"""Least number of folds whose scatter gives the standard error of a sum over them."""
_ALL = 0.99
"""Share of the information on an effect from which one fold counts as its only support."""


@dataclass(frozen=True)
class Rms:
    """A root mean square with its standard uncertainty, um."""

    value: float
    u: float


def held_apart(model: Model, measurement: Measurement) -> tuple[np.ndarray, np.ndarray]:
    """Fold of every row (n,), -1 where it is never held out or never fitted, and the rows (n,) that
    are never fitted: the hold-out of the measurement, or that of the instrument.
    """
    chosen = measurement.holdout
    if chosen is None:
        folds, apart = model.instrument.folds(measurement.plan)
    else:
        folds, apart = chosen.folds, chosen.apart
    apart = np.broadcast_to(apart, folds.shape) & (folds >= 0)
    return np.where(apart, -1, folds), apart


def folds_of(model: Model, measurement: Measurement) -> tuple[np.ndarray, np.ndarray]:
    """`held_apart`, without the rows that are set aside as outliers and those that the fitted rows
    do not predict.
    """
    folds, apart = held_apart(model, measurement)
    chosen = measurement.holdout
    if chosen is not None and chosen.unpredicted is not None:
        apart = apart & ~chosen.unpredicted
    return folds, apart if measurement.aside is None else apart & ~measurement.aside


def heldout_residuals(fit: Fit) -> np.ndarray:
    """Held-out residuals (n, m), SI: every row predicted without its fold; nan where never held
    out, not predicted by the other rows (`HoldOut.unpredicted`), or where the other folds do not
    determine the prediction.

    Rotating folds are left out by the exact downdate of the linearised problem, d = -(H -
    J_g'J_g)^-1 J_g'r_g. Of a fold with fewer readings than there are parameters, the same follows
    from its leverage G = J_g H^-1 J_g', without a factor of its own: (1 - G)^-1 r_g. Parameters
    with a flat prior that only this fold determines (the pose of an artefact) are then re-estimated
    from the fold with all others fixed. Folds that are never fitted are predicted directly.
    """
    folds, apart = folds_of(fit.model, fit.measurement)
    n, m = fit.residual.shape
    found = np.full((n, m), np.nan)
    found[apart] = fit.residual[apart]
    jacobian = fit.jacobian.reshape(n, m, -1)
    total = fit.normal
    # A shape parameter that only this fold determines stays within its grid.
    precision = fit.within_scans
    whitened = (fit.whitened - fit.jacobian @ _left(fit, total, precision)).reshape(n, m)
    roots = _leverage_roots(fit.jacobian, total, precision).reshape(n, m, -1)
    for fold in np.unique(folds[folds >= 0]):
        rows = np.flatnonzero((folds == fold) & fit.used)
        if not len(rows):
            continue
        j = jacobian[rows].reshape(-1, jacobian.shape[2])
        r = whitened[rows].reshape(-1)
        predicted = _by_leverage(roots[rows].reshape(len(r), -1), r)
        if predicted is None:
            predicted = _by_downdate(j, r, total, precision)
        if predicted is None:
            continue  # the other folds do not determine what this one is predicted from
        unwhiten = np.linalg.inv(fit.whitener[rows])
        found[rows] = np.einsum("nij,nj->ni", unwhiten, predicted.reshape(len(rows), m))
    chosen = fit.measurement.holdout
    if chosen is not None and chosen.unpredicted is not None:
        found[chosen.unpredicted] = np.nan
    return found


def _leverage_roots(jacobian: np.ndarray, total: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Z (readings, k) with Z Z' = J H^-1 J'; no columns where H has no factor."""
    h = total + np.diag(precision)
    diagonal = np.diag(h)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    try:
        lower = np.linalg.cholesky(h * scale[:, None] * scale)
    except np.linalg.LinAlgError:
        return np.zeros((len(jacobian), 0))
    return solve_triangular(lower, (jacobian * scale).T, lower=True).T


def _by_leverage(roots: np.ndarray, r: np.ndarray) -> np.ndarray | None:
    """Whitened residuals of a fold that is predicted by the others; None where the fold is larger
    than the parameters, or where it is not plain what only the fold determines.

    An eigenvalue of 1 - G is the share of a direction of the readings that the other folds leave:
    zero for the parameters that only this fold determines, which are projected out.
    """
    if len(r) >= roots.shape[1]:
        return None
    seen = roots.any(axis=1)  # a reading that does not exist stays exactly zero
    z, predicted = roots[seen], r.copy()
    left, directions = eigh(np.eye(len(z)) - z @ z.T)
    if np.any((left > _OWN) & (left < _SHARED)):
        return None
    kept = left >= _SHARED
    predicted[seen] = directions[:, kept] @ ((directions[:, kept].T @ r[seen]) / left[kept])
    return predicted


def _by_downdate(
    j: np.ndarray, r: np.ndarray, total: np.ndarray, precision: np.ndarray
) -> np.ndarray | None:
    """The same from the information of the other folds; None where they do not determine it."""
    basis, own = own_parameters(j, total, precision)
    j, common = j @ basis, ~own
    rest = basis.T @ total @ basis - j.T @ j
    h = rest[np.ix_(common, common)] + np.diag(precision[common])
    # Stationarity of the whole fit: the gradient of the other folds is minus that of this fold.
    # The fold's own parameters do not affect the other folds.
    try:
        factor = cho_factor(h)
    except np.linalg.LinAlgError:
        return None
    delta = -cho_solve(factor, j[:, common].T @ r)
    predicted = r - j[:, common] @ delta
    if own.any():
        q, _ = np.linalg.qr(j[:, own])
        predicted = predicted - q @ (q.T @ predicted)
    return predicted


def _left(fit: Fit, total: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """The remaining step to the minimum where a fit has converged to its tolerance, else zero: at
    the end of a grid, or at a corner, there is no step to take.

    A parameter that only one fold determines is free without that fold: a small remaining gradient,
    which does not come from the other folds, would move it anywhere.
    """
    uphill = fit.jacobian.T @ fit.whitened - fit.precision * fit.theta
    step = np.linalg.solve(total + np.diag(precision), uphill)
    return step if uphill @ step < SETTLED else np.zeros(len(step))


def squared_errors(fit: Fit, residuals: np.ndarray) -> np.ndarray:
    """Mean squared length of the deviations of every row, m^2; rows with nan are left out."""
    instrument, plan = fit.model.instrument, fit.measurement.plan
    squares = (residuals * instrument.lengths(plan, fit.measurement.readings)) ** 2
    known = np.isfinite(squares).all(1)
    readings = instrument.present(plan)[known].sum(1)
    return squares[known].sum(1) * instrument.dimensions(plan)[known] / readings


def rms(squares: np.ndarray, shared: np.ndarray | None = None) -> Rms:
    """Root of the mean of squared errors (m^2), with the uncertainty from their scatter, um.

    Errors with the same number in `shared` (n,) are correlated. With enough such groups, the
    scatter is that of the sums of the groups, as for a sample of clusters.
    """
    if not len(squares):
        return Rms(math.nan, math.nan)
    value = math.sqrt(squares.mean())
    scatter = squares.std() / math.sqrt(len(squares))
    if shared is not None:
        found, place = np.unique(shared, return_inverse=True)
        if (groups := len(found)) >= _FEW:
            sums = np.bincount(place, squares - squares.mean())
            scatter = math.sqrt(groups / (groups - 1) * (sums @ sums)) / len(squares)
    u = scatter / (2.0 * value) if value > 0 else 0.0
    return Rms(value * 1e6, u * 1e6)


def heldout_fall(before: Fit, after: Fit, alternatives: Sequence[Alternatives] = ()) -> Rms | None:
    """Fall of the mean squared held-out error from one fit to another of the same rows, relative to
    that of the first, with its standard uncertainty, which is that of the differences of the rows;
    None where no row is held out, or there is no error. `alternatives` are those of the second fit.
    """
    old, new = heldout_residuals(before), averaged_residuals(after, alternatives)
    both = np.asarray(np.isfinite(old).all(axis=1) & np.isfinite(new).all(axis=1))
    if not both.any():
        return None
    a, b = (squared_errors(fit, np.where(both[:, None], r, np.nan))
            for fit, r in ((before, old), (after, new)))  # fmt: skip
    if not a.mean() > 0.0:
        return None
    shared = _shared(after)[both]
    groups = np.unique(shared, return_inverse=True)[1]
    count = groups.max() + 1
    if count < _FEW:
        groups, count = np.arange(len(a)), len(a)
    sums = np.bincount(groups, a - b - (a - b).mean())
    error = math.sqrt(count / max(count - 1, 1) * float(sums @ sums)) / len(a)
    return Rms(float((a - b).mean() / a.mean()), error / float(a.mean()))


def _shared(fit: Fit) -> np.ndarray:
    """Cluster (n,) of every row: rows of one fold, pose or run share errors."""
    plan = fit.measurement.plan
    common = [folds_of(fit.model, fit.measurement)[0]]
    common += [np.asarray(plan.groups[name]) for name in ("pose", "run") if name in plan.groups]
    return np.unique(np.column_stack(common), axis=0, return_inverse=True)[1].ravel()


def averaged_residuals(fit: Fit, alternatives: Sequence[Alternatives] = ()) -> np.ndarray:
    """`heldout_residuals` of the average of models where that is predicted."""
    return heldout_residuals(fit) + _averaged(alternatives, heldout_residuals)


def _averaged(
    alternatives: Sequence[Alternatives], of: Callable[[Fit], np.ndarray]
) -> np.ndarray | float:
    """Change of the quantity `of(fit)` by the models that are averaged."""
    moved: np.ndarray | float = 0.0
    for one in alternatives:
        if one.averaged and one.others:
            named = of(one.found)
            for probability, other in one.others:
                change = probability * (of(other) - named)
                # A model that cannot predict a row changes nothing there.
                moved = moved + np.where(np.isfinite(change), change, 0.0)
    return moved


def fit_rms(fit: Fit, rows: np.ndarray | bool = True) -> Rms:
    """3-D rms of the residuals of the fitted rows, um; of `rows` (n,) only."""
    return rms(squared_errors(fit, np.where((fit.used & rows)[:, None], fit.residual, np.nan)))


def heldout_rms(
    fit: Fit, rows: np.ndarray | bool = True, alternatives: Sequence[Alternatives] = ()
) -> Rms:
    """3-D rms of the held-out residuals, um; of `rows` (n,) only. Where the average of models is
    predicted (`Alternatives.averaged`), they are those of the average.

    Rows of one fold, pose or run share errors and count as clusters (`rms`).
    """
    kept = np.broadcast_to(rows, fit.used.shape)[:, None]
    residual = np.where(kept, averaged_residuals(fit, alternatives), np.nan)
    return rms(squared_errors(fit, residual), _shared(fit)[np.isfinite(residual).all(1)])


def check_rms(
    fit: Fit, check: CheckPoints, alternatives: Sequence[Alternatives] = ()
) -> tuple[Rms, Rms]:
    """Rms volumetric error at the check points, um: after the best rigid alignment (exact, so that
    the check points may be in any frame), and raw.

    The uncertainty combines the scatter over the points, the posterior covariance of the parameters
    and the between-model variance of the effects in `alternatives`; where their average is
    predicted, the error is that of the average.
    """
    points, jacobian = compensated_points(fit, check.plan)
    points = points + _averaged(alternatives, lambda f: compensated_points(f, check.plan)[0])

    def errors(points: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        raw = check.tool_point - points, np.eye(3)
        return after_alignment(points, check.tool_point), raw

    found = [rms((error**2).sum(1)) for error, _ in errors(points)]
    between_models = np.zeros(2)
    for doubt in alternatives:
        named = compensated_points(doubt.found, check.plan)[0]
        # `points` holds the average already; without the change of this effect the named one.
        own = _averaged([doubt], lambda f: compensated_points(f, check.plan)[0])
        weights = [p for p, _ in doubt.others]
        models = [(p, compensated_points(other, check.plan)[0]) for p, other in doubt.others]
        if doubt.averaged:
            models.append((max(1.0 - sum(weights), 0.0), named))
        for probability, of_other in models:
            moved = points - own + of_other - named
            left = (rms((error**2).sum(1)) for error, _ in errors(moved))
            change = [a.value - b.value for a, b in zip(left, found, strict=True)]
            between_models += probability * np.square(change)
    covariance = fit.covariance
    results = []
    for (error, turn), here, more in zip(
        errors(points), found, np.sqrt(between_models), strict=True
    ):
        passed = 0.0
        if here.value > 0:
            # The alignment is a minimum: its own change does not enter to first order.
            gradient = np.einsum("ni,nik->k", error @ turn, jacobian)
            gradient /= len(error) * here.value * 1e-6
            passed = math.sqrt(gradient @ covariance @ gradient) * 1e6
        results.append(Rms(here.value, math.hypot(here.u, passed, more)))
    return results[0], results[1]


def predicted_rms(fit: Fit, check: CheckPoints) -> float:
    """Expected rms volumetric error at the check points after alignment, um, from the posterior
    covariance of the declared and identified errors.
    """
    points, jacobian = compensated_points(fit, check.plan)
    moved = align_rigid(points, jacobian).reshape(-1, len(fit.theta))
    return math.sqrt(float(((moved @ fit.covariance) * moved).sum()) / len(points)) * 1e6


@dataclass(frozen=True)
class PredictiveDensity:
    """Predictive density of every block of readings, from a fit without its fold."""

    deviance: np.ndarray
    """-2 ln of the density of the readings, up to a constant of the readings alone (blocks)."""
    squares: np.ndarray
    """The part of the deviance that is the squared distance from the prediction, d'C^-1 d (blocks).
    """
    folds: np.ndarray
    """The fold of every block; negative for rows that are never fitted, one block each."""


def log_predictive_density(fit: Fit, noise: float = 1.0) -> PredictiveDensity:
    """Log predictive density of every block of readings without its fold.

    The blocks of a fold are predicted in sequence, each from the other folds and the blocks before
    it: d'C^-1 d + ln det C with the whitened residual d = r - J_b x, x = -H_s^-1 J_f'r_f, and its
    covariance C = 1 + J_b H_s^-1 J_b'. H_s is the information available by then, and J_f'r_f the
    gradient of the rest of the fold. Unlike in a plain sum of squares, a poor prediction due to a
    lack of information counts little. Parameters with a flat prior that only this fold determines
    are projected out of it, for the whole fold.

    Rows that are never fitted are predicted directly. They may be few (some poses at the end), so
    the fitted rows of their data set count as consecutive folds too. `noise` multiplies the noise
    of the fit.
    """
    plan = fit.measurement.plan
    folds, apart = folds_of(fit.model, fit.measurement)
    folds = _beside(folds, apart, fit)
    n, m = fit.residual.shape
    jacobian = fit.jacobian.reshape(n, m, -1) / noise
    whitened = fit.whitened.reshape(n, m) / noise
    total = np.einsum("nmk,nml->kl", jacobian, jacobian, optimize=True)
    precision = fit.within_scans
    # The fit is the minimum at its own noise, not at `noise` times that.
    step = fit.step_at(noise) + _left(fit, fit.normal, precision)
    whitened = whitened - jacobian @ step
    squares: list[float] = []
    volumes: list[float] = []
    where: list[int] = []
    for fold in np.unique(folds[folds >= 0]):
        rows = np.flatnonzero((folds == fold) & fit.used)
        if not len(rows):
            continue
        flat = jacobian[rows].reshape(-1, jacobian.shape[2])
        remain, taken = independent_of(flat, total, precision)
        prior, others = precision[remain], total[np.ix_(remain, remain)] - taken
        basis, own = own_parameters(flat[:, remain], others, prior)
        turned, common = jacobian[rows][:, :, remain] @ basis, ~own
        inside = turned.reshape(-1, len(prior))
        rest = basis.T @ others @ basis - inside.T @ inside
        known = rest[np.ix_(common, common)] + np.diag(prior[common])
        size = len(rows) if own.any() else max(_BLOCK, -(-len(rows) // _BLOCKS))
        ahead = inside[:, common].T @ whitened[rows].reshape(-1)
        for start in range(0, len(rows), size):
            part = rows[start : start + size]
            j = turned[start : start + size].reshape(-1, len(prior))
            r = whitened[part].reshape(-1)
            lower = np.linalg.cholesky(known)
            left = solve_triangular(lower, j[:, common].T, lower=True)
            d = r + left.T @ solve_triangular(lower, ahead, lower=True)
            if own.any():
                q, _ = np.linalg.qr(j[:, own])
                d, left = d - q @ (q.T @ d), left - (left @ q) @ q.T
            # C = 1 + left' left has as many eigenvalues other than one as there are parameters.
            c = np.linalg.cholesky(np.eye(len(left)) + left @ left.T)
            z = solve_triangular(c, left @ d, lower=True)
            squares.append(float(d @ d - z @ z))
            volumes.append(2.0 * float(np.log(np.diag(c)).sum()))
            where.append(int(fold))
            known = known + j[:, common].T @ j[:, common]
            ahead = ahead - j[:, common].T @ r
    for inside in plan.parts.values():
        rows = np.flatnonzero(apart & inside)
        if len(rows):
            # They have no whitener of their own: the median of the fitted rows is used.
            typical = np.median(fit.whitener[fit.used & inside], axis=0) / noise
            squares += list(((fit.residual[rows] @ typical.T) ** 2).sum(1))
            volumes += [0.0] * len(rows)
            where += [-1 - int(row) for row in rows]
    return PredictiveDensity(np.add(squares, volumes), np.array(squares), np.array(where))


def _beside(folds: np.ndarray, apart: np.ndarray, fit: Fit) -> np.ndarray:
    """The folds (n,), with further folds for the fitted rows of data sets that have rows which are
    never fitted.

    The further folds are consecutive in time and about as long as the part that is never fitted.
    """
    found, plan = np.array(folds), fit.measurement.plan
    taken = next((plan.values(name) for name in ("t", "pose") if plan.has(name)), found * 0)
    in_time = np.argsort(taken, kind="stable")
    for inside in plan.parts.values():
        rows = in_time[(fit.used & inside & (folds < 0))[in_time]]
        if (held := int((apart & inside).sum())) and len(rows):
            count = max(round(len(rows) / held), 2)
            found[rows] = found.max() + 1 + np.arange(len(rows)) * count // len(rows)
    return found


def improvement(before: Fit, after: Fit, noise: float = 1.0) -> tuple[float, float]:
    """Fall of the predictive deviance from one fit to another of the same readings with the same
    weights, with its standard error from the scatter over folds, or over blocks where there are few
    folds.
    """
    a, b = (log_predictive_density(fit, noise) for fit in (before, after))
    fall = a.deviance - b.deviance
    groups = a.folds
    if len(np.unique(groups)) < _FEW:
        groups = np.arange(len(fall))
    sums = np.array([fall[groups == g].sum() for g in np.unique(groups)])
    error = math.sqrt(len(sums)) * sums.std(ddof=1) if len(sums) > 1 else math.inf
    return float(fall.sum()), float(error)


def predicted_squares_fall(before: Fit, after: Fit, noise: float = 1.0) -> float:
    """Relative fall of the root mean square distance of the readings from their prediction, over
    the rows of `log_predictive_density`.
    """
    a, b = (log_predictive_density(fit, noise).squares.sum() for fit in (before, after))
    return 1.0 - math.sqrt(b / a)


def supported_by_one_fold(fit: Fit, effect: int) -> bool:
    """Whether a single fold supports the effect at that place of the model.

    An example is a jump within a run where every run has an offset of its own: the flat parameters
    absorb it in all other folds.
    """
    folds, _ = folds_of(fit.model, fit.measurement)
    n, m = fit.residual.shape
    flat, mine = fit.precision == 0, fit.places_of(effect)[0]
    q, r = np.linalg.qr(fit.jacobian[:, flat])
    q = q[:, np.abs(np.diag(r)) > 1e-9 * np.abs(np.diag(r)).max(initial=0.0)]
    own = fit.jacobian[:, mine]
    squares = ((own - q @ (q.T @ own)) ** 2).sum(1).reshape(n, m).sum(1)
    by_fold = [squares[folds == fold].sum() for fold in np.unique(folds)]
    return len(by_fold) > 1 and max(by_fold) > _ALL * sum(by_fold)


def weighted_squares(fit: Fit, residuals: np.ndarray) -> np.ndarray:
    """Sum of squares of every row in units of the noise of the fit; rows with nan are left out."""
    known = np.isfinite(residuals).all(1)
    whitener = np.array(fit.whitener)
    for inside in fit.measurement.plan.parts.values():
        if (fitted := fit.used & inside).any():
            # Rows that are never fitted have no whitener of their own.
            whitener[~fit.used & inside] = np.median(whitener[fitted], axis=0)
    whitened = np.einsum("nij,nj->ni", whitener[known], residuals[known])
    return (whitened**2).sum(1)


def rms_fall(
    before: Fit,
    after: Fit,
    rows: np.ndarray | bool = True,
    squares: Callable[[Fit, np.ndarray], np.ndarray] = squared_errors,
) -> float:
    """Relative fall of the held-out rms.

    Of several data sets that have any of `rows` (n,), it is the largest fall. `squares` are the
    squared errors that are averaged; by default squared lengths.
    """
    a, b = heldout_residuals(before), heldout_residuals(after)
    shares = [-math.inf]
    for inside in before.measurement.plan.parts.values():
        left, right = (np.where(inside[:, None], residual, np.nan) for residual in (a, b))
        if (inside & rows).any() and np.isfinite(left).any():
            was, now = rms(squares(before, left)), rms(squares(after, right))
            shares.append(1.0 - now.value / was.value)
    return max(shares)
