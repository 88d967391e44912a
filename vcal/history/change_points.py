"""Tests of a series of results for a step and for a drift, with the covariance of every result.

Results y_i (d parts) of reports i = 1 ... n with covariances C_i are independent of one another and
normal. A constant mu is tested against

    mu + h_i s    a step after report k:  h_i = 0 for i <= k, 1 for i > k
    mu + t_i s    a drift, linear in the date t_i

by generalised least squares. With the size s and its covariance S, chi^2 = s' S^-1 s has the
chi-square distribution of d degrees of freedom where nothing has changed; it is the decrease of the
weighted sum of squares. There is one such test for every place of a step, and one for the drift.
The p-value of the largest chi-square c among m tests is

    p = P(chi^2_1 >= c or ... or chi^2_m >= c) = m_e P(chi^2_d >= c)

with the effective number of tests m_e, between 1 and m, because the tests share their data:
m_e = sum over k of E[1 / N | chi^2_k >= c], N being the number of tests that exceed c. This is the
importance sampling of a union (D. Q. Naiman and C. E. Priebe 2001, J. Comput. Graph. Stat. 10,
296-328; A. B. Owen, Y. Maximov and M. Chertkov 2019, Electron. J. Stat. 13, 231-254): its relative
error does not grow where p is small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import gammainccinv
from scipy.stats import chi2

DRAWS = 4000
"""Draws behind an effective number of tests: its relative standard uncertainty is 1 to 2 %."""
_LENGTHS = 200
"""Quantiles of the chi-square beyond the threshold from which the draws take theirs."""
SAME = 3.841
"""Difference of two chi-squares up to which two places of a step are not told apart: the 95 %
quantile of one degree of freedom."""


@dataclass(frozen=True)
class Sample:
    """The results of one series that can be tested, in the order of their dates."""

    times: Float[np.ndarray, " n"]
    """Days."""
    values: Float[np.ndarray, "n d"]
    covariances: Float[np.ndarray, "n d d"]

    @property
    def size(self) -> int:
        """Number of results."""
        return len(self.times)

    def part(self, first: int, last: int) -> "Sample":
        """The results from `first` to before `last`."""
        rows = slice(first, last)
        return Sample(self.times[rows], self.values[rows], self.covariances[rows])

    def less(self, slope: Float[np.ndarray, " d"]) -> "Sample":
        """Without a slope per day that is zero at the first result."""
        drift = np.outer(self.times - self.times[0], slope)
        return Sample(self.times, self.values - drift, self.covariances)

    @property
    def mean(self) -> "Size":
        """The weighted mean with its covariance."""
        weights = np.linalg.inv(self.covariances)
        covariance = np.linalg.inv(weights.sum(0))
        return Size(covariance @ np.einsum("nij,nj->i", weights, self.values), covariance)


@dataclass(frozen=True)
class Size:
    """An estimate of d parts with its covariance."""

    value: Float[np.ndarray, " d"]
    covariance: Float[np.ndarray, "d d"]

    @property
    def u(self) -> Float[np.ndarray, " d"]:
        """Standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def chi2(self) -> float:
        """s' S^-1 s."""
        return float(self.value @ np.linalg.solve(self.covariance, self.value))

    @property
    def p_value(self) -> float:
        """Probability of such a size where there is none."""
        return float(chi2.sf(self.chi2, len(self.value)))

    def minus(self, other: "Size") -> "Size":
        """The difference from another, independent one."""
        return Size(self.value - other.value, self.covariance + other.covariance)


@dataclass(frozen=True)
class Alternative:
    """One way in which a series may have changed, with the size of the change."""

    kind: Literal["step", "drift"]
    after: int
    """Number of results before the step; 0 for a drift."""
    size: Size
    """Of a step, the change; of a drift, the change per day."""


@dataclass(frozen=True)
class Tested:
    """A constant against all alternatives of a series."""

    alternatives: tuple[Alternative, ...]
    effective: float
    """Effective number of tests, at the largest chi-square."""
    p_value: float
    """Of the largest chi-square, corrected for the number of tests in this series."""

    @property
    def best(self) -> Alternative:
        """The alternative with the largest chi-square."""
        return max(self.alternatives, key=lambda one: one.size.chi2)

    @property
    def alike(self) -> list[int]:
        """Places of a step whose chi-square is within `SAME` of the largest of them."""
        steps = {a.after: a.size.chi2 for a in self.alternatives if a.kind == "step"}
        return [k for k, value in steps.items() if value >= max(steps.values()) - SAME]


def against_constant(sample: Sample, seed: int = 0) -> Tested | None:
    """A constant against a step at every place and against a drift; None where all dates are the
    same, so that there is nothing to compare.

    A step between results of one date is no alternative; a drift is one from three dates on,
    because that of two dates is the step between them.
    """
    after = [k for k in range(1, sample.size) if sample.times[k] > sample.times[k - 1]]
    if not after:
        return None
    regressors = [(np.arange(sample.size) >= k).astype(float) for k in after]
    if len(after) > 1:
        regressors.append(sample.times - sample.times.mean())
    found, whitened = [], []
    for k, regressor in zip([*after, 0], regressors, strict=False):
        size, contrast = _regression(sample, regressor)
        found.append(Alternative("step" if k else "drift", k, size))
        whitened.append(_whitened(sample, size, contrast))
    largest = max(one.size.chi2 for one in found)
    effective = effective_number(np.array(whitened), largest, seed)
    alone = float(chi2.sf(largest, sample.values.shape[1]))
    return Tested(tuple(found), effective, min(1.0, effective * alone))


def remaining(sample: Sample, places: Sequence[int], drift: bool = False) -> float:
    """p-value of what steps after `places`, or a drift, leave of the scatter about a constant;
    1 where nothing is left to test.
    """
    parts = sample.values.shape[1]
    rows = np.arange(sample.size)
    columns = [np.ones(sample.size), *((rows >= k).astype(float) for k in places)]
    if drift:
        columns.append(sample.times - sample.times.mean())
    free = (sample.size - len(columns)) * parts
    if free <= 0:
        return 1.0
    roots = _inverse_roots(sample.covariances)
    design = np.stack(columns, 1)
    whole = np.einsum("nij,nk->nikj", roots, design).reshape(sample.size * parts, -1)
    target = np.einsum("nij,nj->ni", roots, sample.values).ravel()
    solution = np.linalg.lstsq(whole, target, rcond=None)[0]
    return float(chi2.sf(np.sum((target - whole @ solution) ** 2), free))


def effective_number(
    contrasts: Float[np.ndarray, "m d k"], threshold: float, seed: int, draws: int = DRAWS
) -> float:
    """The effective number of m tests, whose statistics are |A_j e|^2 for normal e and contrasts
    A_j with orthonormal rows, at a threshold: P(any exceeds it) / P(one exceeds it).
    """
    m, d, k = contrasts.shape
    if m == 1:
        return 1.0
    random = np.random.default_rng(seed)
    normal = random.standard_normal((draws, k))
    which = np.arange(draws) % m
    own = contrasts[which]
    tails = (np.arange(_LENGTHS) + 0.5) / _LENGTHS * chi2.sf(threshold, d)
    lengths = np.sqrt(2.0 * gammainccinv(0.5 * d, tails))  # chi-squares of these tails
    length = lengths[random.integers(_LENGTHS, size=draws)]
    direction = random.standard_normal((draws, d))
    direction *= (length / np.linalg.norm(direction, axis=1))[:, None]
    inside = np.einsum("sdk,sk->sd", own, normal)
    normal += np.einsum("sdk,sd->sk", own, direction - inside)
    statistics = ((normal @ contrasts.reshape(m * d, k).T) ** 2).reshape(draws, m, d).sum(2)
    exceeds = statistics >= threshold
    exceeds[np.arange(draws), which] = True  # by construction, whatever the rounding
    shares = 1.0 / exceeds.sum(1)
    return float(sum(shares[which == j].mean() for j in range(m)))


def _regression(sample: Sample, regressor: np.ndarray) -> tuple[Size, np.ndarray]:
    """Size of a regressor beside a constant, and the contrast (d, n, d) that gives it."""
    n, d = sample.values.shape
    weights = np.linalg.inv(sample.covariances)
    design = np.stack([np.ones(n), regressor], 1)
    normal = np.einsum("na,nb,nij->aibj", design, design, weights).reshape(2 * d, 2 * d)
    covariance = np.linalg.inv(normal)
    right = np.einsum("na,nij->ainj", design, weights).reshape(2 * d, n * d)
    contrast = (covariance @ right)[d:].reshape(d, n, d)
    value = np.einsum("inj,nj->i", contrast, sample.values)
    return Size(value, covariance[d:, d:]), contrast


def _whitened(sample: Sample, size: Size, contrast: np.ndarray) -> np.ndarray:
    """The contrast of results of unit covariance, with orthonormal rows (d, n d)."""
    roots = np.linalg.cholesky(sample.covariances)
    spread = np.einsum("inj,njk->ink", contrast, roots).reshape(len(size.value), -1)
    return np.linalg.solve(np.linalg.cholesky(size.covariance), spread)


def _inverse_roots(covariances: np.ndarray) -> np.ndarray:
    """R with R' R = C^-1."""
    return np.linalg.inv(np.linalg.cholesky(covariances))
