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

from ...identification.fit import Fit

_SQUARED = 4.0 ** -np.arange(11.0)
"""Squares of the factors, down to a thousandth."""

_TOLD = 1e-9
"""Least information, in units of that of the prior, from which an amplitude has a size."""
_SURPRISE = math.log(20.0)
"""Most that a size beyond its prior may count against a rival, as log odds."""


def surprise(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """What it costs the log evidence that amplitudes are larger than expected, of a linear model as
    in `log_gain` (..., c), as (...): what the prior adds to half the chi-square at its minimum,
    beyond what an amplitude of one standard deviation costs.

    A prior that outweighs the readings makes an amplitude look small and the fit poor; that counts
    as well: with b = l x, half of l x^2 / (1 + l) is half of x^2 where the readings tell x.
    """
    cost = 0.5 * (_sizes(information, scores) ** 2 * information / (1.0 + information) - 1.0)
    return np.maximum(cost, 0.0).sum(-1)


def size_told(information: np.ndarray, scores: np.ndarray) -> float:
    """How large the readings alone say that amplitudes (c,) are together, in prior standard
    deviations.
    """
    return float(np.linalg.norm(_sizes(information, scores)))


def _sizes(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    seen = information > _TOLD
    return np.where(seen, scores / np.where(seen, information, 1.0), 0.0)


def leniency(surprise: np.ndarray) -> np.ndarray:
    """What that costs beyond `_SURPRISE`: how large an effect may be is known roughly, enough to
    prefer one rival, not to exclude another.
    """
    return np.maximum(surprise - _SURPRISE, 0.0)


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


def over_scales(fit: Fit, entries: slice | np.ndarray, noise_scale: float = 1.0) -> float:
    """What the mixture adds to the log evidence of a fit (`Fit.log_evidence`) for the effect whose
    amplitudes are these entries of theta.
    """
    values, scores = _seen(fit, entries, noise_scale, len(fit.theta))
    once = log_gain(values, scores, np.ones(1))[0]
    return float(log_mixture(values, scores) - once)


def at_its_shape(
    fit: Fit, entries: slice | np.ndarray, noise_scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores (as of `log_gain`) of the amplitudes that are these entries of theta,
    beside all other amplitudes, at the shapes of the fit: where the readings do not tell a time
    constant, how large the amplitude would be at another one says nothing of this.
    """
    return _seen(fit, entries, noise_scale, len(fit.model.entries))


def _seen(
    fit: Fit, entries: slice | np.ndarray, noise_scale: float, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores of some entries of theta, the others of the first k eliminated."""
    jacobian = fit.jacobian[:, :k]
    h = jacobian.T @ jacobian / noise_scale**2 + np.diag(fit.within_scans[:k])
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
    theta = fit.theta[mine] + fit.step_at(noise_scale)[mine]
    scores = vectors.T @ (precision @ theta)
    return values, scores
