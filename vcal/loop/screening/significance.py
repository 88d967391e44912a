"""Tail probabilities without underflow, and the correction for the number of trials."""

import numpy as np
from scipy.special import betainc, betaln, gammaincc, gammaln

LEAST_NOISE = 0.01
"""Least noise that is used, in units of the declared noise. Otherwise simulated readings without
noise would be judged by rounding errors."""
SILENT = 0.1
"""Least variance, in units of the noise used, that residuals count for. It is one where the noise
was estimated from them; with the least noise it could be arbitrarily small."""
LEAST_DOF = 10.0
"""Least degrees of freedom for an estimate of the noise."""
_RAREST, _ENOUGH = 0.1, 25
"""Share of the null draws, and their least number, from which the number of trials is estimated."""


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
    """-ln of the probability that a random subspace explains a share of squares above `share`.

    The squares are those of `dof` independent normal numbers, the subspace has `rank` dimensions,
    and their ratio has the distribution Beta(rank/2, (dof - rank)/2). No underflow; zero where
    `dof` does not exceed `rank`.
    """
    share, b = np.broadcast_arrays(np.clip(share, 0.0, 1.0 - 1e-12), 0.5 * np.asarray(rank, float))
    a = np.maximum(0.5 * dof - b, 1e-6)
    tail = betainc(a, b, 1.0 - share)
    # Leading term of the series where the tail underflows.
    far = np.log(a) + betaln(a, b) - a * np.log1p(-share) - (b - 1.0) * np.log(share + 1e-300)
    found = np.where(tail > 1e-290, -np.log(np.maximum(tail, 1e-300)), far)
    return np.where(0.5 * dof > b, found, 0.0)


def effective_trials(null: np.ndarray) -> float:
    """Effective number of independent trials whose largest -ln p is distributed as `null` (draws).

    Maximum likelihood from the least probable draws; all others are censored, as known to be no
    rarer.

    Neighbouring steps of a grid are correlated, and the less so the rarer the excursion (Gross,
    Vitells, Eur. Phys. J. C 70, 2010, 525). An estimate from all draws, most of which show nothing
    rare, would give fewer trials than apply where something seems significant.
    """
    common = np.log1p(-np.clip(np.exp(-null), 1e-15, 1.0 - 1e-15))
    count = min(max(int(_RAREST * len(null)), _ENOUGH), len(null))
    least = np.partition(common, -count)[-count]
    return float(-count / np.maximum(common, least).sum())


def corrected(minus_log_p: np.ndarray | float, trials: float) -> np.ndarray:
    """Probability that the best of `trials` independent trials is as good: 1 - (1 - p)^trials."""
    p = np.exp(-np.asarray(minus_log_p, float))
    return -np.expm1(trials * np.log1p(-np.minimum(p, 1.0 - 1e-15)))
