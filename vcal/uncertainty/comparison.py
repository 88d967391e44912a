"""Whether the GUM's interval may stand: JCGM 101, clause 8, and coverage on simulated truth."""

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
"""Of a value: what sums of inputs that cancel leave, and is no uncertainty."""


@dataclass(frozen=True)
class Comparison:
    """The GUM against a Monte Carlo of the same m outputs (JCGM 101, 8.1)."""

    labels: tuple[str, ...]
    coverage: float
    kind: Kind
    """Kind of the Monte Carlo's interval."""
    digits: int
    """Significant decimal digits of u that are regarded as meaningful."""
    value: Float[np.ndarray, "m 2"] = field(repr=False)
    """y: GUM, Monte Carlo. So are the columns of `u`, `low` and `high`."""
    u: Float[np.ndarray, "m 2"] = field(repr=False)
    low: Float[np.ndarray, "m 2"] = field(repr=False)
    high: Float[np.ndarray, "m 2"] = field(repr=False)
    delta: Float[np.ndarray, " m"]
    """Numerical tolerance delta = 10^l / 2 of u = c 10^l (7.9.2); of an output that does not vary,
    what rounding makes of its value.
    """
    precision: Precision
    """Standard deviations of the Monte Carlo's y, u, low and high."""

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
        """Whether both differences are no larger than delta; false where one is not a number."""
        return (self.d_low <= self.delta) & (self.d_high <= self.delta)

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """`passed` where 2 s of the interval's ends cannot turn it; otherwise undecided."""
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

    d_low = |y - U_p - y_low| and d_high = |y + U_p - y_high| against delta, for every output of
    the budget and its coverage probability. delta belongs to the Monte Carlo's u: what is judged
    cannot set its own tolerance, and a first-order u of zero would have none.

    The two ends of a shortest interval of a skewed distribution may both lie far from y +/- U_p
    although the symmetric ones do not; the standard leaves the `kind` to the user.

    Raises `ValueError` if the Monte Carlo has no output of a name that the budget has, if it has
    too few draws for the interval, or for other than 1 or 2 digits.
    """
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
    )


@dataclass(frozen=True)
class Attained:
    """How often intervals held the truth, per output."""

    share: Float[np.ndarray, "..."]
    """NaN where no case counts."""
    cases: Int[np.ndarray, "..."]
    """Cases that count."""
    left_out: Int[np.ndarray, "..."]
    """Cases in which an end of the interval, or the truth, is not a number."""

    @property
    def u(self) -> Float[np.ndarray, "..."]:
        """Binomial standard error sqrt(c (1 - c) / n); zero where all or none are held."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.share * (1.0 - self.share) / self.cases)

    def bounds(self, p: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Interval for the coverage probability itself, exact where the standard error is not.

        Clopper and Pearson (1934), at probability `p`; wide near 0 and 1 as it has to be. Raises
        `ValueError` for a probability outside of (0, 1).
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

    An interval with an end that is not a number is counted in `Attained.left_out`, not as one that
    missed. Raises `ValueError` for shapes that differ, or an interval whose ends are exchanged.
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
