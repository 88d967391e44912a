"""Conformity of a quantity with its tolerance, from its distribution: JCGM 106:2012.

With the quantity Y, its estimate y, and tolerance limits T_L < T_U, of which one may be infinite::

    p_c = P(T_L <= Y <= T_U)               conformance probability (7.1), for any distribution
    guarded acceptance (8.3.2):  the item conforms          where p_c >= 1 - r
    guarded rejection (8.3.3):   the item does not conform  where p_c <= r
    otherwise it cannot be decided
    simple acceptance (8.2):     the item conforms where T_L <= y <= T_U, else it does not

r is the largest probability of a wrong decision. The same rule as limits of the estimate, where
Y - y keeps its distribution while y moves: the item conforms where y lies in the acceptance
interval [A_L, A_U], and does not conform where y lies outside of the rejection limits [R_L, R_U].
The guard band is w = T_U - A_U. For one limit and a normal distribution, w is the 1.64 u of
JCGM 106, table 1, at r = 5 %.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar, root_scalar

Rule = Literal["guarded", "simple"]
Verdict = Literal["conforms", "does_not_conform", "undecided"]
Interval = tuple[float, float]

_TINY = 1e-15
"""Probability of a tail beyond which the quantile of an unbounded quantity is not evaluated."""
_NONE: Interval = (math.nan, math.nan)


@dataclass(frozen=True)
class Tolerance:
    """Permissible values of a quantity, from `lower` to `upper`, in its unit (JCGM 106, 3.3.5).

    Raises `ValueError` for a limit that is no number, for exchanged limits, and for none at all.
    """

    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        if math.isnan(self.lower) or math.isnan(self.upper) or not self.lower < self.upper:
            raise ValueError(
                f"tolerance: found lower = {self.lower:g} and upper = {self.upper:g}, expected "
                "lower < upper; exchange or correct them"
            )
        if math.isinf(self.lower) and math.isinf(self.upper):
            raise ValueError(
                "tolerance: found no limit, expected lower, upper or both; write "
                "Tolerance(upper=...)"
            )

    def __contains__(self, value: float) -> bool:
        return self.lower <= value <= self.upper


@dataclass(frozen=True)
class Requirement:
    """Tolerance limits with their decision rule.

    `guard_band` replaces the risk: the item conforms where the estimate is inside of the limits by
    this length at least, and does not conform where it is outside by more. U is a usual choice
    (JCGM 106, 8.3.2). Raises `ValueError` for a risk outside (0, 0.5], an unknown rule, and a
    guard band below zero or together with simple acceptance.
    """

    tolerance: Tolerance
    risk: float = 0.05
    """Largest probability of a wrong decision r, above 0 and up to 0.5."""
    rule: Rule = "guarded"
    guard_band: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.risk <= 0.5:
            raise ValueError(
                f"risk: found {self.risk}, expected a probability above 0 and up to 0.5"
            )
        if self.rule not in ("guarded", "simple"):
            raise ValueError(f"rule: found {self.rule!r}, expected 'guarded' or 'simple'")
        if self.guard_band is not None and (self.rule == "simple" or not self.guard_band >= 0.0):
            raise ValueError(
                f"guard band: found {self.guard_band} with rule {self.rule!r}, expected a length "
                "of at least 0 with rule 'guarded'"
            )


class Law(Protocol):
    """The distribution of a quantity, as far as a decision needs it."""

    @property
    def estimate(self) -> float: ...
    @property
    def u(self) -> float: ...
    @property
    def size(self) -> int | None:
        """Number of draws; None for a distribution that is known."""
        ...

    def probability(self, tolerance: Tolerance) -> float:
        """P(T_L <= Y <= T_U)."""
        ...

    def shifts(self, tolerance: Tolerance, share: float, above: bool = False) -> Interval:
        """Least and largest shift s with P(T_L <= Y + s <= T_U) >= `share`, or > `share` where
        `above`; NaN where there is none.
        """
        ...


@dataclass(frozen=True)
class Draws:
    """A quantity of which values were drawn. Raises `ValueError` for fewer than two."""

    values: Float[np.ndarray, " n"] = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.values) < 2:
            raise ValueError(f"found {len(self.values)} values, expected two draws at least")

    @property
    def estimate(self) -> float:
        """Mean of the draws."""
        return float(self.values.mean())

    @property
    def u(self) -> float:
        """Standard deviation of the draws."""
        return float(self.values.std(ddof=1))

    @property
    def size(self) -> int:
        """Number of draws."""
        return len(self.values)

    def probability(self, tolerance: Tolerance) -> float:
        """Share of the draws within the limits."""
        inside = (self.values >= tolerance.lower) & (self.values <= tolerance.upper)
        return float(inside.mean())

    def shifts(self, tolerance: Tolerance, share: float, above: bool = False) -> Interval:
        """The shifts that leave a sufficient number of draws within the limits, exactly."""
        n = len(self.values)
        need = share * n * (1.0 - 1e-12)  # a rounding error must not require one more
        count = min(math.floor(share * n * (1.0 + 1e-12)) + 1 if above else math.ceil(need), n)
        ordered = np.sort(self.values)
        # Values i ... i + count - 1 are within the limits for shifts from T_L - v_i to
        # T_U - v_(i+count-1).
        first, last = ordered[: n - count + 1], ordered[count - 1 :]
        fits = np.flatnonzero(last - first <= tolerance.upper - tolerance.lower)
        if not len(fits):
            return _NONE
        return tolerance.lower - float(first[fits[-1]]), tolerance.upper - float(last[fits[0]])


@dataclass(frozen=True)
class Continuous:
    """A quantity with a known, unimodal distribution."""

    estimate: float
    u: float
    cdf: Callable[[float], float]
    quantile: Callable[[float], float]
    size: int | None = None
    """Number of draws from which the distribution was counted."""

    def probability(self, tolerance: Tolerance) -> float:
        """P(T_L <= Y <= T_U)."""
        low = 0.0 if math.isinf(tolerance.lower) else self.cdf(tolerance.lower)
        high = 1.0 if math.isinf(tolerance.upper) else self.cdf(tolerance.upper)
        return float(high - low)

    def shifts(self, tolerance: Tolerance, share: float, above: bool = False) -> Interval:
        """The shifts, by the quantiles at a and a + `share` that are no farther apart than the
        limits.
        """
        if math.isinf(tolerance.lower):
            return -math.inf, tolerance.upper - self.quantile(share)
        if math.isinf(tolerance.upper):
            return tolerance.lower - self.quantile(1.0 - share), math.inf
        limit, spare = tolerance.upper - tolerance.lower, 1.0 - share

        def excess(a: float) -> float:
            return self.quantile(min(a + share, 1.0 - _TINY)) - self.quantile(a) - limit

        ends = (_TINY, max(spare - _TINY, _TINY))
        best = 0.5 * spare
        if excess(best) > 0.0:
            found: Any = minimize_scalar(excess, bounds=ends, method="bounded")
            best = float(found.x)
            if excess(best) > 0.0:
                return _NONE
        low, high = (
            end
            if excess(end) <= 0.0
            else float(root_scalar(excess, bracket=(best, end), xtol=1e-16).root)
            for end in ends
        )
        return tolerance.lower - self.quantile(high), tolerance.upper - self.quantile(low + share)


@dataclass(frozen=True)
class Conformity:
    """The decision on one quantity, in its unit."""

    tolerance: Tolerance
    estimate: float
    """y: the mean, of the distribution or of the draws."""
    u: float
    """Standard uncertainty."""
    probability: float
    """Conformance probability p_c."""
    u_probability: float
    """Standard deviation of p_c by the number of draws, sqrt(p_c (1 - p_c) / n); zero for a known
    distribution."""
    acceptance: Interval
    """[A_L, A_U]: the item conforms where the estimate is inside. NaN where no estimate can show
    conformity, as the uncertainty is too large for the tolerance."""
    rejection: Interval
    """[R_L, R_U]: the item does not conform where the estimate is outside."""
    verdict: Verdict
    draws: int | None
    """Number of draws; None for a known distribution."""

    @property
    def guard_band(self) -> Interval:
        """A_L - T_L and T_U - A_U; zero for simple acceptance and for an absent limit."""
        low, high = (
            0.0 if math.isinf(limit) else way * (end - limit)
            for way, end, limit in zip(
                (1, -1), self.acceptance, (self.tolerance.lower, self.tolerance.upper), strict=True
            )
        )
        return low, high

    @property
    def consumer_risk(self) -> float:
        """Specific consumer's risk 1 - p_c: the probability that the item does not conform, if it
        is accepted (JCGM 106, 9.3.2).
        """
        return 1.0 - self.probability

    @property
    def producer_risk(self) -> float:
        """Specific producer's risk p_c: the probability that the item conforms, if it is rejected
        (JCGM 106, 9.3.2).
        """
        return self.probability


def decide(law: Law, asked: Requirement) -> Conformity:
    """The decision by JCGM 106:2012 on a quantity with this distribution."""
    limits, r, y = asked.tolerance, asked.risk, law.estimate
    p = law.probability(limits)
    inside = rejected = (limits.lower, limits.upper)
    verdict: Verdict
    if asked.rule == "simple":
        verdict = "conforms" if y in limits else "does_not_conform"
    elif asked.guard_band is not None:
        w = asked.guard_band
        inside, rejected = (
            (limits.lower + w, limits.upper - w),
            (limits.lower - w, limits.upper + w),
        )
        if inside[0] > inside[1]:
            inside = _NONE
        verdict = _by_limits(y, inside, rejected)
    else:
        inside, rejected = (
            (y + low, y + high)
            for low, high in (law.shifts(limits, 1.0 - r), law.shifts(limits, r, above=True))
        )
        verdict = "conforms" if p >= 1.0 - r else "does_not_conform" if p <= r else "undecided"
    return Conformity(
        tolerance=limits,
        estimate=y,
        u=law.u,
        probability=p,
        u_probability=0.0 if law.size is None else math.sqrt(p * (1.0 - p) / law.size),
        acceptance=inside,
        rejection=rejected,
        verdict=verdict,
        draws=law.size,
    )


def _by_limits(y: float, inside: Interval, rejected: Interval) -> Verdict:
    if inside[0] <= y <= inside[1]:
        return "conforms"
    return "undecided" if rejected[0] <= y <= rejected[1] else "does_not_conform"
