"""Validation of the GUM's intervals: JCGM 101, clause 8, and attained coverage of a known truth."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import betaincinv

from .adaptive import Precision, numerical_tolerance
from .budget import Budget
from .ensemble import Ensemble
from .intervals import Kind, check_coverage

Verdict = Literal["passed", "failed", "undecided"]

_ROUNDING = 1e-13
"""Share of a value below which a spread is the rounding error of terms that cancel."""


@dataclass(frozen=True)
class Comparison:
    """Validation of the GUM's intervals of m outputs by Monte Carlo (JCGM 101, 8.1)."""

    labels: tuple[str, ...]
    coverage: float
    kind: Kind
    """Kind of the interval of the Monte Carlo."""
    digits: int
    """Significant decimal digits of u that are regarded as meaningful."""
    value: Float[np.ndarray, "m 2"] = field(repr=False)
    """Estimate y; columns GUM and Monte Carlo, as for `u`, `low` and `high`."""
    u: Float[np.ndarray, "m 2"] = field(repr=False)
    low: Float[np.ndarray, "m 2"] = field(repr=False)
    high: Float[np.ndarray, "m 2"] = field(repr=False)
    delta: Float[np.ndarray, " m"]
    """Numerical tolerance delta = 10^l / 2 of u = c 10^l (7.9.2); for an output that does not vary,
    the rounding error of its value.
    """
    precision: Precision
    """Standard deviations of y, u, low and high of the Monte Carlo."""
    failed: Float[np.ndarray, " m"]
    """Share of the draws that are not finite, which the Monte Carlo leaves out."""
    notes: tuple[str, ...] = ()
    """Remarks of both methods on these numbers."""

    @property
    def d_low(self) -> Float[np.ndarray, " m"]:
        """|y - U_p - y_low|."""
        return np.abs(self.low[:, 0] - self.low[:, 1])

    @property
    def d_high(self) -> Float[np.ndarray, " m"]:
        """|y + U_p - y_high|."""
        return np.abs(self.high[:, 0] - self.high[:, 1])

    @property
    def passed(self) -> Bool[np.ndarray, " m"]:
        """Whether both differences are at most delta; false where one is not a number."""
        return (self.d_low <= self.delta) & (self.d_high <= self.delta)

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """The verdict of `passed` where 2 s of the ends cannot reverse it; undecided otherwise."""
        return tuple(self._verdict(i) for i in range(len(self.labels)))

    def _verdict(self, i: int) -> Verdict:
        apart = np.array([self.d_low[i], self.d_high[i]])
        doubt = 2.0 * np.array([self.precision.low[i], self.precision.high[i]])
        if np.all(apart + doubt <= self.delta[i]):
            return "passed"
        return "failed" if np.any(apart - doubt > self.delta[i]) else "undecided"


def compare(
    budget: Budget, ensemble: Ensemble, digits: Literal[1, 2] = 2, kind: Kind = "symmetric"
) -> Comparison:
    """Validate the GUM's coverage intervals by a Monte Carlo (JCGM 101, clause 8).

    d_low = |y - U_p - y_low| and d_high = |y + U_p - y_high| are compared with delta, for every
    output and the coverage probability of the budget. delta is that of the Monte Carlo's u, as the
    method under validation cannot set its own tolerance, and a first-order u of zero has none.

    For a skewed distribution, the ends of the shortest interval may lie far from y +/- U_p although
    those of the symmetric one do not. The standard leaves the `kind` to the user.

    Raises `ValueError` for an output of the budget that the Monte Carlo lacks, for too few draws
    for the interval, for a number of digits other than 1 or 2, and for a stated k, which has no
    coverage probability.
    """
    if budget.stated_k is not None:
        raise ValueError(
            f"the budget states k = {budget.stated_k:g}, which has no coverage probability; "
            "compare the budget without it"
        )
    if digits not in (1, 2):
        raise ValueError(f"digits: found {digits!r}, expected 1 or 2 (JCGM 101, 7.9.2)")
    missing = [label for label in budget.labels if label not in ensemble.labels]
    if missing:
        raise ValueError(
            f"the Monte Carlo has no scalar output {missing[0]!r}, only "
            f"{', '.join(ensemble.labels)}; compare results of the same measurement function"
        )
    at = [ensemble.labels.index(label) for label in budget.labels]
    ends = np.array([ensemble.interval(label, budget.coverage, kind) for label in budget.labels])
    u = ensemble.u[at]
    return Comparison(
        labels=budget.labels,
        coverage=budget.coverage,
        kind=kind,
        digits=digits,
        value=np.column_stack([budget.value, ensemble.mean[at]]),
        u=np.column_stack([budget.u, u]),
        low=np.column_stack([budget.value - budget.U, ends[:, 0]]),
        high=np.column_stack([budget.value + budget.U, ends[:, 1]]),
        delta=np.maximum(
            [numerical_tolerance(float(one), digits) for one in u],
            _ROUNDING * np.abs(ensemble.mean[at]),
        ),
        precision=Precision(*(s[at] for s in ensemble.precision(budget.coverage, kind))),
        failed=np.array(
            [ensemble.failed.get(label, 0) / ensemble.draws for label in budget.labels]
        ),
        notes=tuple(dict.fromkeys((*budget.notes, *ensemble.notes))),
    )


@dataclass(frozen=True)
class Attained:
    """Attained coverage: the share of intervals that contain the truth, per output."""

    share: Float[np.ndarray, "..."]
    """Share of the counted cases; NaN without any."""
    cases: Int[np.ndarray, "..."]
    """Number of counted cases."""
    left_out: Int[np.ndarray, "..."]
    """Number of cases in which an end of the interval, or the truth, is not a number."""

    @property
    def u(self) -> Float[np.ndarray, "..."]:
        """Binomial standard error sqrt(c (1 - c) / n); zero for a share c of 0 or 1."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.share * (1.0 - self.share) / self.cases)

    def bounds(self, p: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Exact confidence interval of the coverage probability at probability `p`.

        Clopper and Pearson (1934); unlike the standard error, it is valid near 0 and 1. Raises
        `ValueError` for a probability outside (0, 1).
        """
        check_coverage(p)
        n = self.cases.astype(float)
        held = np.where(n > 0.0, np.round(self.share * n), 0.0)
        tail = 0.5 * (1.0 - p)
        none, every = held == 0.0, held == n
        low = betaincinv(np.where(none, 1.0, held), n - held + 1.0, tail)
        high = betaincinv(held + 1.0, np.where(every, 1.0, n - held), 1.0 - tail)
        return np.where(none, 0.0, low), np.where(every, 1.0, high)


def attained_coverage(
    low: Float[np.ndarray, "n ..."],
    high: Float[np.ndarray, "n ..."],
    truth: Float[np.ndarray, "n ..."] | float,
) -> Attained:
    """Share of n cases in which low <= truth <= high, for every output along the other axes.

    An interval with an end that is not a number counts in `Attained.left_out`, not as a miss.
    Raises `ValueError` for shapes that differ, and for an interval with exchanged ends.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    if low.ndim == 0 or low.shape != high.shape:
        raise ValueError(
            f"found lower ends of shape {low.shape} and upper ends of shape {high.shape}, expected "
            "the same, with one interval per case along the first axis"
        )
    try:
        truth = np.broadcast_to(np.asarray(truth, float), low.shape)
    except ValueError:
        raise ValueError(
            f"found a truth of shape {np.shape(truth)}, expected {low.shape} as the intervals"
        ) from None
    if np.any(low > high):
        raise ValueError("found an interval whose lower end is above its upper; exchange the two")
    known = np.isfinite(truth) & ~np.isnan(low) & ~np.isnan(high)
    cases = known.sum(0)
    held = (known & (low <= truth) & (truth <= high)).sum(0)
    share = np.where(cases > 0, held / np.maximum(cases, 1), np.nan)
    return Attained(share, cases, np.asarray(len(low) - cases))
