"""Identification that single stray readings cannot pull away."""

import numpy as np
from scipy.special import gammainccinv

from .declared_noise import declared_whitener
from .fit import Fit
from .identify import ROUGHLY, identify
from .measurement import Measurement
from .model import Model, Shapes


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

    A row whose whitened residual has the norm d is weighted by min(1, c s / d): s is the robust
    scale of all rows of its data set (median of d over its expectation), c is `tuning` times the
    expected norm of as many readings.
    `whitener` (n, m, m) is that of the declared noise unless given, `keep` (n,) leaves rows out.
    Returns the fit and the weights (n,); rows with weights far below one are suspect.
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
    weights = np.ones(measurement.rows)
    for _ in range(rounds):
        distance = np.linalg.norm(np.einsum("nij,nj->ni", whitener, fit.residual), axis=1)
        limit = np.full(measurement.rows, np.inf)
        for rows in parts:
            scale = np.median(distance[rows] / median[rows])
            limit[rows] = tuning * np.sqrt(count[rows]) * scale
        new = np.minimum(1.0, limit / np.maximum(distance, 1e-30))
        if np.abs(new - weights).max() < 1e-3:
            break
        weights = new
        fit = identify(
            model,
            measurement,
            theta=fit.theta,
            shapes=fit.shapes,
            whitener=whitener * np.sqrt(weights)[:, None, None],
            keep=keep,
            room=room,
            tolerance=ROUGHLY,
        )
    return fit, weights
