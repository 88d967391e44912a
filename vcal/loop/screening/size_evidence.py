"""Evidence of an effect whose size is known to orders of magnitude only.

The prior of an amplitude says how large an effect may be on some machine. On a precise machine it
may be a hundred times smaller, and an effect of three amplitudes would then be penalised three
times for a width that carries no information. After a collision it may be a thousand times larger,
and a normal prior would exclude what the readings show beyond doubt. The prior is therefore a
mixture of normal distributions with sigma times s, one factor for all amplitudes of an effect:

    s = 1, 1/2, 1/4, ... with equal odds,        s = 2, 4, 8, ... with odds 0.1 / s.

Far above sigma the density of an amplitude x falls as 1/x^2, as that of a Cauchy distribution does:
a size x costs about ln 10 x in log evidence instead of x^2 / 2. Sizes of a few sigma cost what they
do with a normal prior (a contaminated prior: Berger, Statistical Decision Theory and Bayesian
Analysis, 1985, 4.7).
"""

import math

import numpy as np
from scipy.linalg import cho_solve

from ...identification.fit import Fit
from ...numerics.eigen import eigh

_OCTAVES = np.arange(-10.0, 17.0)
"""Base-two logarithms of the factors: from a thousandth to 65,000."""
_SQUARED = 4.0**_OCTAVES
_LARGER = 0.1
"""Odds of a machine whose effects are larger than the prior says."""
_SURPLUS = np.where(_OCTAVES > 0.0, _OCTAVES * math.log(2.0) - math.log(_LARGER), 0.0)
"""Log of the odds of a factor of one over those of each factor."""
_LOG_ODDS = -_SURPLUS - math.log(np.exp(-_SURPLUS).sum())

_LEAST_INFORMATION = 1e-9
"""Least information, in units of that of the prior, for an amplitude to have an estimated size."""
_ROUNDING = 1e-22
"""Least share of its information that the other parameters must leave of a direction."""
_MOST_COST = math.log(20.0)
"""Most log odds that a size beyond its prior may cost a rival."""


def size_surplus(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Cost in log evidence of amplitudes that are larger than expected: the size surplus.

    It is the mean over the posterior of the factor s of the mixture of the log of the odds of s = 1
    over those of s, for a linear model as in `log_gain`, as (...). Amplitudes of one standard
    deviation cost almost nothing, a hundred of them ln 1000. Amplitudes that the readings hardly
    determine cost nothing either.
    """
    each = log_gain(information, scores, _SQUARED) + _LOG_ODDS
    odds = np.exp(each - each.max(-1, keepdims=True))
    return (odds @ _SURPLUS) / odds.sum(-1)


def prior_pull(information: np.ndarray, scores: np.ndarray) -> float:
    """Half of what a normal prior of one standard deviation adds to chi-square at its minimum,
    beyond its expectation: sum over c of max(0, (l x^2 / (1 + l) - 1) / 2), x = b / l.

    A prior that outweighs the readings shrinks the amplitudes and worsens the fit, which is
    included.
    """
    pull = 0.5 * (_sizes(information, scores) ** 2 * information / (1.0 + information) - 1.0)
    return float(np.maximum(pull, 0.0).sum(-1))


def observed_size(information: np.ndarray, scores: np.ndarray) -> float:
    """Least-squares size of the amplitudes (c,) together, without their prior, in prior standard
    deviations.
    """
    return float(np.linalg.norm(_sizes(information, scores)))


def _sizes(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    seen = information > _LEAST_INFORMATION
    return np.where(seen, scores / np.where(seen, information, 1.0), 0.0)


def size_allowance(surplus: np.ndarray) -> np.ndarray:
    """Part of a size surplus beyond ln 20, which is credited to the log odds of a rival.

    How large an effect may be is known roughly. That is enough to prefer one rival, and not enough
    to exclude another.
    """
    return np.maximum(surplus - _MOST_COST, 0.0)


def log_gain(information: np.ndarray, scores: np.ndarray, squared: np.ndarray) -> np.ndarray:
    """Log Bayes factors of amplitudes with a normal prior of sigma s over none, by s^2 (k), as
    (..., k).

    For a linear model with the eigenvalues l of C'C (with the other parameters eliminated) and the
    scores b = v'C'r, both (..., c), in units of the noise: sum over c of s^2 b^2 / (1 + s^2 l) / 2
    - ln(1 + s^2 l) / 2.
    """
    s2 = squared[:, None]
    grown = 1.0 + s2 * information[..., None, :]
    return 0.5 * (s2 * scores[..., None, :] ** 2 / grown - np.log(grown)).sum(-1)


def log_mixture(information: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Log Bayes factor of the mixture over none, as (...)."""
    each = log_gain(information, scores, _SQUARED) + _LOG_ODDS
    most = each.max(-1)
    return most + np.log(np.exp(each - most[..., None]).sum(-1))


def mixture_terms(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `log_mixture` needs of the information (..., c), for many scores b: factors (..., c, k)
    and constants (..., k) with which it is the log of the sum over k of exp(b^2 factors +
    constants).
    """
    grown = 1.0 + _SQUARED * information[..., None]
    return 0.5 * _SQUARED / grown, _LOG_ODDS - 0.5 * np.log(grown).sum(-2)


def over_scales(fit: Fit, entries: slice | np.ndarray, noise_scale: float = 1.0) -> float:
    """What the mixture adds to the log evidence of a fit (`Fit.log_evidence`), for the effect whose
    amplitudes are these entries of theta.
    """
    values, scores = _seen(fit, entries, noise_scale, len(fit.theta))
    once = log_gain(values, scores, np.ones(1))[0]
    return float(log_mixture(values, scores) - once)


def at_its_shape(
    fit: Fit, entries: slice | np.ndarray, noise_scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores (as in `log_gain`) of the amplitudes that are these entries of theta.

    All other amplitudes are eliminated; shapes are held at those of the fit. Where the readings do
    not determine a time constant, the size that the amplitude would have at another one is
    irrelevant.
    """
    return _seen(fit, entries, noise_scale, len(fit.model.entries))


def _seen(
    fit: Fit, entries: slice | np.ndarray, noise_scale: float, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """Information and scores of some entries of theta, the others of the first k eliminated."""
    mine = np.arange(k)[entries]
    others = np.setdiff1d(np.arange(k), mine)
    prior = fit.within_scans[:k]
    own = fit.jacobian[:, mine] / noise_scale
    left = _eliminated(fit, others, prior[others], own, noise_scale) if len(others) else own
    within = np.diag(prior[mine])
    precision = left.T @ left + within
    values, vectors = eigh(precision - np.diag(fit.precision[mine]))
    # What the other parameters leave of a direction may be rounding, which a wide prior would
    # multiply.
    whole = ((own @ vectors) ** 2).sum(0)
    seen = values > _ROUNDING * whole
    theta = fit.theta[mine] + fit.step_at(noise_scale)[mine]
    scores = vectors.T @ (precision @ theta)
    return np.where(seen, values, 0.0), np.where(seen, scores, 0.0)


def _eliminated(
    fit: Fit, others: np.ndarray, prior: np.ndarray, own: np.ndarray, noise_scale: float
) -> np.ndarray:
    """What the parameters `others` with these prior precisions leave of the columns `own`, with the
    rows of their prior beneath: the residual of least squares.

    The normal equations lose half of the digits. A second step from the residual restores them
    (corrected seminormal equations: Bjorck, Numerical Methods for Least Squares Problems, 1996,
    6.6.5).
    """
    normal = fit.normal[np.ix_(others, others)] / noise_scale**2 + np.diag(prior)
    scale = 1.0 / np.sqrt(np.diag(normal))
    factor = np.linalg.cholesky(scale[:, None] * normal * scale), True
    root = np.sqrt(prior) * scale
    left, beneath = own, np.zeros((len(prior), own.shape[1]))
    # The Jacobian is taken whole: its columns without `own` would be a copy of it.
    every = np.zeros((fit.jacobian.shape[1], own.shape[1]))
    for _ in range(2):
        onto = (fit.jacobian.T @ left)[others] * (scale / noise_scale)[:, None]
        step = cho_solve(factor, onto + root[:, None] * beneath)
        every[others] = (scale / noise_scale)[:, None] * step
        left, beneath = left - fit.jacobian @ every, beneath - root[:, None] * step
    return np.concatenate([left, beneath])
