"""How likely something as large is by chance: tails without underflow, and what searching costs."""

import numpy as np
from scipy.special import betainc, betaln, gammaincc, gammaln

LEAST_NOISE = 0.01
"""Of what is declared: the loop goes by no noise that is smaller. Readings of a simulation without
any would else be judged by how numbers are rounded.
"""
SILENT = 0.1
"""Variance, in that of the noise that a fit goes by, that residuals count for at least: by noise
that was found theirs is one, but by the least noise it may be anything.
"""
TOLD = 10.0
"""Least degrees of freedom by which noise is estimated."""
_RAREST, _ENOUGH = 0.1, 25
"""Share of the null draws, and their least number, that tell of how many trials the rarest is."""


def minus_log_chi2_tail(x: np.ndarray, dof: np.ndarray | float) -> np.ndarray:
    """-ln of the probability that chi-square with `dof` exceeds `x`, without underflow."""
    x, half = np.broadcast_arrays(np.asarray(x, float), 0.5 * np.asarray(dof, float))
    tail = gammaincc(half, 0.5 * x)
    y = np.maximum(0.5 * x, 1e-300)
    # Leading terms of the asymptotic series where the tail underflows.
    far = y - (half - 1.0) * np.log(y) + gammaln(half) - (half - 1.0) / y
    return np.where(tail > 1e-290, -np.log(np.maximum(tail, 1e-300)), far)


def minus_log_beta_tail(
    share: np.ndarray | float, dof: float, rank: np.ndarray | float
) -> np.ndarray:
    """-ln of the probability that a share of the squares of `dof` normal numbers, that which lies
    in a space of `rank` dimensions, exceeds `share`; without underflow. Zero where there are no
    more numbers than dimensions.
    """
    share, b = np.broadcast_arrays(np.clip(share, 0.0, 1.0 - 1e-12), 0.5 * np.asarray(rank, float))
    a = np.maximum(0.5 * dof - b, 1e-6)
    tail = betainc(a, b, 1.0 - share)
    # Leading term of the series where the tail underflows.
    far = np.log(a) + betaln(a, b) - a * np.log1p(-share) - (b - 1.0) * np.log(share + 1e-300)
    found = np.where(tail > 1e-290, -np.log(np.maximum(tail, 1e-300)), far)
    return np.where(0.5 * dof > b, found, 0.0)


def effective_trials(null: np.ndarray) -> float:
    """Effective number of independent trials whose largest -ln p is distributed as the rarest of
    `null` (draws): maximum likelihood, where all others are known to be no rarer than these.

    Neighbouring steps of a scan are alike, and the less so the rarer what they show (Gross,
    Vitells, Eur. Phys. J. C 70, 2010, 525): by all draws, most of which show nothing rare, there
    are fewer trials than where something seems significant.
    """
    common = np.log1p(-np.clip(np.exp(-null), 1e-15, 1.0 - 1e-15))
    count = min(max(int(_RAREST * len(null)), _ENOUGH), len(null))
    least = np.partition(common, -count)[-count]
    return float(-count / np.maximum(common, least).sum())


def corrected(minus_log_p: np.ndarray | float, trials: float) -> np.ndarray:
    """Probability that the best of `trials` is as good: 1 - (1 - p)^trials."""
    p = np.exp(-np.asarray(minus_log_p, float))
    return -np.expm1(trials * np.log1p(-np.minimum(p, 1.0 - 1e-15)))
