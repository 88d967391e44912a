"""Robust identification: single outliers have a bounded influence."""

from collections.abc import Callable

import numpy as np
from scipy.special import gammainccinv

from ..model.declared_noise import declared_whitener
from ..model.forward import Model, Shapes
from ..model.measurement import Measurement
from .fit import Fit
from .identify import ROUGHLY, identify

_SETTLED = 1e-3
"""Change of the weights below which they have converged."""
_LINEAR = 30
"""Largest number of iterations on the linearised problem."""


def identify_robust(
    model: Model,
    measurement: Measurement,
    *,
    tuning: float = 1.5,
    rounds: int = 10,
    theta: np.ndarray | None = None,
    shapes: Shapes | None = None,
    whitener: np.ndarray | None = None,
    keep: np.ndarray | None = None,
    room: int = 0,
) -> tuple[Fit, np.ndarray]:
    """Fit with Huber's loss on whole rows, by iteratively reweighted least squares.

    A row whose whitened residual has the norm d has the weight min(1, c s / d). The robust scale s
    is the median of d over its expectation, for all rows of the data set. The limit c is `tuning`
    times the expected norm of that number of readings. `rounds` limits the number of fits. The
    other arguments are those of `vcal.identification.identify.identify`.

    Returns the fit and the weights (n,). A row with a weight far below one is a suspected outlier.
    Raises as `identify` does.
    """
    if whitener is None:
        whitener = declared_whitener(model, measurement)
    fit = identify(
        model, measurement, theta=theta, shapes=shapes, whitener=whitener, keep=keep, room=room
    )
    count = np.maximum(model.instrument.present(measurement.plan).sum(1), 1)
    median = np.sqrt(2.0 * gammainccinv(0.5 * count, 0.5))
    used = np.ones(measurement.rows, bool) if keep is None else np.asarray(keep, bool)
    parts = [rows & used for rows in measurement.plan.parts.values() if (rows & used).any()]

    def weights_at(distance: np.ndarray) -> np.ndarray:
        limit = np.full(measurement.rows, np.inf)
        for rows in parts:
            scale = np.median(distance[rows] / median[rows])
            limit[rows] = tuning * np.sqrt(count[rows]) * scale
        return np.minimum(1.0, limit / np.maximum(distance, 1e-30))

    weights = np.ones(measurement.rows)
    for _ in range(rounds):
        distance = np.linalg.norm(np.einsum("nij,nj->ni", whitener, fit.residual), axis=1)
        if np.abs(weights_at(distance) - weights).max() < _SETTLED:
            break
        theta, weights = _linearly(fit, weights, weights_at)
        fit = identify(
            model,
            measurement,
            theta=theta,
            shapes=fit.shapes,
            whitener=whitener * np.sqrt(weights)[:, None, None],
            keep=keep,
            room=room,
            tolerance=ROUGHLY,
        )
    return fit, weights


def _linearly(
    fit: Fit, weights: np.ndarray, weights_at: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (k,) and weights (n,) at which the reweighted problem, linearised about a fit with
    the present weights, has converged: most of the iteration, for little of the work.
    """
    n, k = len(weights), len(fit.theta)
    root = np.sqrt(weights)[:, None]
    jacobian = (fit.jacobian.reshape(n, -1) / root).reshape(-1, k)
    whitened = (fit.whitened.reshape(n, -1) / root).reshape(-1)
    # A shape moves by no more than the width of its scan, whatever the linear problem gives.
    held, step = np.diag(fit.within_scans), np.zeros(k)
    for _ in range(_LINEAR):
        left = (whitened - jacobian @ step).reshape(n, -1)
        new = weights_at(np.linalg.norm(left, axis=1))
        if np.abs(new - weights).max() < _SETTLED:
            break
        weights = new
        by_weight = jacobian * np.repeat(weights, len(jacobian) // n)[:, None]
        slope = by_weight.T @ whitened - fit.precision * fit.theta
        step = np.linalg.solve(by_weight.T @ jacobian + held, slope)
    return fit.theta + step, weights
