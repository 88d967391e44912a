"""Errors a fit makes on readings it has not seen, and on independent check points."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..fit import Fit
from ..measurement import CheckPoints
from ..model import Terms, concatenate, effect_terms, tool_points_with_jacobian
from ..spatial import align_rigid, rigid_columns


@dataclass(frozen=True)
class Rms:
    """A root mean square with its standard uncertainty, um."""

    value: float
    u: float


def heldout_residuals(fit: Fit) -> np.ndarray:
    """Residuals (n, m), SI, of every row predicted without its fold; nan where never held out.

    Folds that rotate are left out by the exact downdate of the linearised problem,
    d = -(H - J_g'J_g)^-1 J_g'r_g; parameters with a flat prior that only this fold can see (the
    pose of an artefact) are then re-estimated from the fold with all others fixed. Folds that were
    never fitted are predicted as they are.
    """
    instrument, plan = fit.model.instrument, fit.measurement.plan
    folds, apart = instrument.folds(plan)
    n, m = fit.residual.shape
    found = np.full((n, m), np.nan)
    apart = np.broadcast_to(apart, n) & (folds >= 0)
    found[apart] = fit.residual[apart]
    jacobian = fit.jacobian.reshape(n, m, -1)
    whitened = fit.whitened.reshape(n, m)
    total = fit.jacobian.T @ fit.jacobian
    for fold in np.unique(folds[(folds >= 0) & ~apart]):
        rows = np.flatnonzero((folds == fold) & fit.used)
        if not len(rows):
            continue
        j = jacobian[rows].reshape(-1, jacobian.shape[2])
        r = whitened[rows].reshape(-1)
        inside = j.T @ j
        # What the other folds say about a parameter is nothing: it belongs to this fold alone.
        own = (fit.precision == 0) & (np.diag(total - inside) <= 1e-9 * np.diag(total))
        common = ~own
        h = (total - inside)[np.ix_(common, common)] + np.diag(fit.precision[common])
        # Stationarity of the whole fit: the gradient of the rest is minus that of the fold. The
        # fold's own parameters leave the rest untouched.
        delta = -cho_solve(cho_factor(h), j[:, common].T @ r)
        predicted = r - j[:, common] @ delta
        if own.any():
            q, _ = np.linalg.qr(j[:, own])
            predicted = predicted - q @ (q.T @ predicted)
        unwhiten = np.linalg.inv(fit.whitener[rows])
        found[rows] = np.einsum("nij,nj->ni", unwhiten, predicted.reshape(len(rows), m))
    return found


def squared_errors(fit: Fit, residuals: np.ndarray) -> np.ndarray:
    """Mean squared length of the points of every row, m^2; nan rows are left out."""
    instrument, plan = fit.model.instrument, fit.measurement.plan
    squares = (residuals * instrument.lengths(plan, fit.measurement.readings)) ** 2
    told = np.isfinite(squares).all(1)
    readings = instrument.present(plan)[told].sum(1)
    return squares[told].sum(1) * instrument.dimensions(plan)[told] / readings


def rms(squares: np.ndarray) -> Rms:
    """Root of the mean of squared errors (m^2) with the uncertainty from their scatter, um."""
    if not len(squares):
        return Rms(math.nan, math.nan)
    value = math.sqrt(squares.mean())
    u = squares.std() / math.sqrt(len(squares)) / (2.0 * value) if value > 0 else 0.0
    return Rms(value * 1e6, u * 1e6)


def fit_rms(fit: Fit, rows: np.ndarray | bool = True) -> Rms:
    """3-D rms of the residuals of the rows that were fitted, um; of `rows` (n,) only."""
    return rms(squared_errors(fit, np.where((fit.used & rows)[:, None], fit.residual, np.nan)))


def heldout_rms(fit: Fit, rows: np.ndarray | bool = True) -> Rms:
    """3-D rms of the held-out residuals, um; of `rows` (n,) only."""
    kept = np.broadcast_to(rows, fit.used.shape)[:, None]
    return rms(squared_errors(fit, np.where(kept, heldout_residuals(fit), np.nan)))


def machine_terms(fit: Fit, plan) -> tuple[Terms, np.ndarray]:
    """Terms, at another plan, of the effects that move the tool point, and which entries of theta
    they use; effects that lack a covariate there are left out.
    """
    model = fit.model
    blocks, start, used = [], 0, np.zeros(len(fit.theta), bool)
    for i, effect in enumerate(model.effects):
        count = len(effect.amplitudes)
        if effect.where == "machine" and plan.has(*effect.needs):
            blocks.append(effect_terms(effect, model.layout, plan, fit.shapes.get(i, {}), start))
            used[start : start + count] = True
        start += count
    return concatenate(blocks, plan.rows, len(model.layout)), used


def compensated_points(fit: Fit, plan) -> tuple[np.ndarray, np.ndarray]:
    """Tool points of the identified machine (n, 3), m, and their derivative (n, 3, k) with respect
    to the amplitudes in solver units.
    """
    terms, _ = machine_terms(fit, plan)
    size = len(fit.model.layout)
    ports = terms.offset + (terms.values * fit.theta[terms.parameter]) @ np.eye(size)[terms.port]
    points, by_port = (
        np.asarray(v)
        for v in tool_points_with_jacobian(fit.model.chain, np.asarray(plan.position), ports)
    )
    by_term = by_port[:, :, terms.port] * terms.values[:, None, :]
    gather = np.zeros((len(terms.parameter), len(fit.theta)))
    gather[np.arange(len(terms.parameter)), terms.parameter] = 1.0
    return points, by_term @ gather


def check_rms(fit: Fit, check: CheckPoints) -> tuple[Rms, Rms]:
    """rms volumetric error at the check points: after the best rigid alignment, and raw, um.

    The uncertainty joins the scatter over the points and what the posterior of the parameters
    passes on.
    """
    points, jacobian = compensated_points(fit, check.plan)
    raw = check.tool_point - points
    aligned = align_rigid(check.tool_point, raw)
    covariance = fit.covariance
    results = []
    for error in (aligned, raw):
        found = rms((error**2).sum(1))
        if found.value > 0:
            gradient = np.einsum("ni,nik->k", error, jacobian) / (len(error) * found.value * 1e-6)
            passed = math.sqrt(gradient @ covariance @ gradient) * 1e6
            found = Rms(found.value, math.hypot(found.u, passed))
        results.append(found)
    return results[0], results[1]


def rigid_free(points: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns (n, 3, k) less their best rigid motion of `points` (n, 3)."""
    rigid = rigid_columns(points - points.mean(0)).reshape(-1, 6)
    q, _ = np.linalg.qr(rigid / np.linalg.norm(rigid, axis=0))
    flat = columns.reshape(len(rigid), -1)
    return (flat - q @ (q.T @ flat)).reshape(columns.shape)


def improvement(before: Fit, after: Fit) -> tuple[float, float, float]:
    """Fall of the held-out squared whitened error per row with its standard error, and the fall of
    the held-out rms as a share, of several data sets that where it fell most.

    Paired row by row with the same whitening, in clusters (folds, or rows where folds are blocks).
    """
    plan = before.measurement.plan
    whitener = before.whitener
    folds, apart = before.model.instrument.folds(plan)
    apart = np.broadcast_to(apart, plan.rows)
    for inside in plan.parts.values():
        if apart[inside].any():
            # Rows that were never fitted have no weight of their own: use that of the fitted ones.
            typical = np.median(whitener[before.used & inside], axis=0)
            unused = (inside & ~before.used)[:, None, None]
            whitener = np.where(unused, typical, whitener)
    a, b = heldout_residuals(before), heldout_residuals(after)
    rows = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    squares = [
        (np.einsum("nij,nj->ni", whitener[rows], residual[rows]) ** 2).sum(1) for residual in (a, b)
    ]
    fall = squares[0] - squares[1]
    groups = folds[rows]
    for inside in plan.parts.values():
        mine = inside[rows]
        if len(np.unique(groups[mine])) < 12:
            groups = np.where(mine, plan.rows + np.arange(len(groups)), groups)
    sums = np.array([fall[groups == g].sum() for g in np.unique(groups)])
    error = math.sqrt(len(sums)) * sums.std(ddof=1) if len(sums) > 1 else math.inf
    shares = []
    for inside in plan.parts.values():
        left, right = (np.where(inside[:, None], residual, np.nan) for residual in (a, b))
        if np.isfinite(left).any():
            was, now = rms(squared_errors(before, left)), rms(squared_errors(after, right))
            shares.append(1.0 - now.value / was.value)
    return float(fall.sum()), float(error), max(shares)
