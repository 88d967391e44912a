"""Conformity of a quantity with its tolerance, from draws of its distribution: JCGM 106:2012.

With the values Y of the quantity over the draws, their mean y, and an upper tolerance limit T::

    p_c = P(Y <= T)                       conformance probability (7.2), for any distribution
    guarded acceptance (8.3.2):  the item conforms          where p_c >= 1 - r
    guarded rejection (8.3.3):   the item does not conform  where p_c <= r
    otherwise it cannot be decided
    simple acceptance (8.2):     the item conforms where y <= T, else it does not

r is the largest probability of a wrong decision. The same rule as limits of the estimate y, where
Y - y has the distribution of the draws::

    acceptance limit  A = T - w,  w = Q(1 - r) - y     guard band
    rejection limit   R = T + y - Q(r)

with the quantile Q. For a normal distribution, w is the 1.64 u of JCGM 106, table 1, at r = 5 %.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Rule = Literal["guarded", "simple"]
Verdict = Literal["conforms", "does_not_conform", "undecided"]


@dataclass(frozen=True)
class Requirement:
    """An upper tolerance limit with its decision rule."""

    tolerance: float
    """Largest permissible value T."""
    risk: float = 0.05
    """Largest probability of a wrong decision r, from 0 to 0.5."""
    rule: Rule = "guarded"


@dataclass(frozen=True)
class Conformity:
    """The decision on one quantity, in its unit."""

    estimate: float
    """Mean y over the draws."""
    u: float
    """Standard deviation over the draws."""
    probability: float
    """Conformance probability p_c."""
    u_probability: float
    """Standard deviation of p_c by the number of draws, sqrt(p_c (1 - p_c) / n)."""
    guard_band: float
    """w; zero for simple acceptance."""
    acceptance_limit: float
    """Estimate up to which the item conforms."""
    rejection_limit: float
    """Estimate beyond which the item does not conform."""
    verdict: Verdict
    draws: int
    """Number of values n."""


def decide(values: Float[np.ndarray, " draws"], asked: Requirement) -> Conformity:
    """The decision by JCGM 106:2012 on a quantity with these drawn `values`.

    Raises `ValueError` for fewer than two values.
    """
    if len(values) < 2:
        raise ValueError(f"found {len(values)} values, expected two draws at least")
    estimate, limit, r = float(values.mean()), asked.tolerance, asked.risk
    p = float((values <= limit).mean())
    guard, beyond = 0.0, 0.0
    if asked.rule == "guarded":
        # The outermost values inside of which a share 1 - r lies: p_c >= 1 - r just where y <= A,
        # and p_c <= r just where y > R.
        high, low = (
            way * float(np.quantile(way * values, 1.0 - r, method="inverted_cdf"))
            for way in (1, -1)
        )
        guard, beyond = high - estimate, estimate - low
        verdict: Verdict = (
            "conforms" if p >= 1.0 - r else "does_not_conform" if p <= r else "undecided"
        )
    else:
        verdict = "conforms" if estimate <= limit else "does_not_conform"
    return Conformity(
        estimate=estimate,
        u=float(values.std(ddof=1)),
        probability=p,
        u_probability=math.sqrt(p * (1.0 - p) / len(values)),
        guard_band=guard,
        acceptance_limit=limit - guard,
        rejection_limit=limit + beyond,
        verdict=verdict,
        draws=len(values),
    )
