"""Evidence of an effect whose size is known to orders of magnitude only.

The prior of an amplitude tells how large an effect may be on some machine. On a precise one it may
be a hundred times smaller, and an effect of three amplitudes would then pay three times for a width
that says nothing. Therefore the prior is a mixture: sigma times 1, 1/2, 1/4, ... with equal odds,
one factor for all amplitudes of an effect.
"""

import math

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import logsumexp

from ..fit import Fit

_SQUARED = 4.0 ** -np.arange(11.0)
"""Squares of the factors, down to a thousandth."""

_SURPRISE = math.log(20.0)
"""Most that a size beyond its prior may count against a rival, as log odds."""


def surprise(sizes: np.ndarray) -> np.ndarray:
    """What it costs the log evidence that amplitudes (..., c), in prior standard deviations, are
    larger than expected.
    """
    return 0.5 * np.maximum(np.square(sizes) - 1.0, 0.0).sum(-1)


def leniency(surprise: float) -> float:
    """What that costs beyond `_SURPRISE`: how large an effect may be is known roughly, enough to
    prefer one rival, not to exclude another.
    """
    return max(0.0, surprise - _SURPRISE)


def too_large(information: np.ndarray, scores: np.ndarray) -> float:
    """What it costs the log evidence of amplitudes (as of `log_gain`) that their prior is narrow:
    by how much a wider one would be better.
    """
    wider = log_gain(information, scores, 4.0 ** np.arange(16.0))
    return float(wider.max() - wider[0])


def log_gain(information: np.ndarray, scores: np.ndarray, squared: np.ndarray) -> np.ndarray:
    """Log Bayes factors of amplitudes with a normal prior of sigma s over none, by s^2 (k).

    For a linear model with the eigenvalues l of C'C (what the model beside leaves of it) and the
    scores b = v'C'r, both (..., c), in units of the noise: sum of s^2 b^2/(1 + s^2 l)/2 -
    ln(1 + s^2 l)/2, as (..., k).
    """
    s2 = squared[:, None]
    grown = 1.0 + s2 * information[..., None, :]
    return 0.5 * (s2 * scores[..., None, :] ** 2 / grown - np.log(grown)).sum(-1)


def log_mixture(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """The same of the mixture, (...)."""
    each = log_gain(information, scores, _SQUARED)
    return logsumexp(each, axis=-1) - np.log(len(_SQUARED))


def over_scales(fit: Fit, entries: slice, noise_scale: float = 1.0) -> float:
    """What the mixture adds to the log evidence of a fit (`Fit.log_evidence`) for the effect whose
    amplitudes are these entries of theta.
    """
    values, scores = _alone(fit, entries, noise_scale)
    once = log_gain(values, scores, np.ones(1))[0]
    return float(log_mixture(values, scores) - once)


def narrowed(fit: Fit, entries: slice, wider: float, noise_scale: float = 1.0) -> float:
    """What the log evidence of a fit with so many times the prior standard deviations of these
    entries of theta would lose with one times.
    """
    values, scores = _alone(fit, entries, noise_scale)
    wide, narrow = log_gain(values, scores, np.array([1.0, wider**-2.0]))
    return float(max(wide - narrow, 0.0))


def _alone(fit: Fit, entries: slice, noise_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores, as of `log_gain`, of these entries of theta beside all others."""
    h = fit.jacobian.T @ fit.jacobian / noise_scale**2 + np.diag(fit.precision)
    k = len(fit.theta)
    mine = np.arange(k)[entries]
    others = np.setdiff1d(np.arange(k), mine)
    across = h[np.ix_(others, mine)]
    precision = h[np.ix_(mine, mine)]
    if len(others):
        scale = 1.0 / np.sqrt(np.diag(h)[others])
        scaled = h[np.ix_(others, others)] * scale[:, None] * scale
        left = across * scale[:, None]
        precision = precision - left.T @ cho_solve((np.linalg.cholesky(scaled), True), left)
    values, vectors = np.linalg.eigh(precision - np.diag(fit.precision[mine]))
    values = np.maximum(values, 0.0)
    scores = vectors.T @ (precision @ fit.theta[mine])
    return values, scores
