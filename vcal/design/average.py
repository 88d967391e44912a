"""Weights of candidate measurements that minimise an average criterion, with a lower bound.

    f(w) = tr(G C(w)),    C(w)^-1 = L + sum_n w_n F_n,    0 <= w <= most,    sum w c = total

with F_n the information of one measurement at candidate n and c_n its cost. f is convex, so that
every w gives a lower bound for all choices v, including whole numbers:

    f(v) >= f(w) + f'(w) (v - w) >= f(w) + sum_n s_n w_n - max over v of sum_n s_n v_n,

s_n = -df/dw_n = tr(F_n C G C). The bound therefore holds before the weights have converged. The
weights follow multiplicative updates by the square root of s (Silvey, Titterington and Torsney
1978), limited to their upper bound.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from .point_exchange import covariance_of


class Average(NamedTuple):
    """The best weights found."""

    weights: Float[np.ndarray, " n"]
    value: float
    """sqrt(tr(G C)) of these weights."""
    bound: float
    """Lower bound of sqrt(tr(G C)) for every choice; equal to `value` at convergence."""


# With many small matrices, further BLAS threads only wait for each other.
@threadpool_limits.wrap(limits=1, user_api="blas")
def weigh_average(
    information: Float[np.ndarray, "n k k"],
    precision: Float[np.ndarray, "k k"],
    gram: Float[np.ndarray, "k k"],
    total: float,
    *,
    costs: Float[np.ndarray, " n"] | None = None,
    most: float = np.inf,
    steps: int = 1000,
    gap: float = 1e-3,
) -> Average:
    """Distribute `total` measurements among candidates, each at most `most` times.

    With `costs`, `total` is their total cost. `information` (n, k, k) holds the information of one
    measurement at each candidate. Ends after `steps` iterations, or where value and bound differ by
    less than the share `gap`. Raises `ValueError` where `most` of every candidate is less than
    `total`, and where all candidates and the prior together leave a parameter undetermined.
    """
    price = np.ones(len(information)) if costs is None else np.asarray(costs, float)
    limit = most * price
    if limit.sum() < total * (1.0 - 1e-12):
        raise ValueError(
            f"total: found {total:g}, expected at most {limit.sum():g}, which is {most:g} of every "
            "candidate; add candidates, or lower the total"
        )
    F = np.asarray(information, float) / price[:, None, None]
    flat = F.reshape(len(F), -1)
    # Shares of the total, in units of cost.
    share = _held(np.full(len(F), 1.0), limit, total)
    best: Average | None = None
    bound = 0.0
    for _ in range(steps):
        H = precision + (share @ flat).reshape(precision.shape)
        C = covariance_of(H, check=best is None)
        value = float(np.einsum("kl,kl->", gram, C))
        slope = np.maximum(flat @ (C @ gram @ C).ravel(), 0.0)
        steepest = _held(slope, limit, total, first=True)
        bound = max(bound, value + float(slope @ (share - steepest)))
        if best is None or value**0.5 < best.value:
            best = Average(share / price, value**0.5, 0.0)
        if best.value - bound**0.5 < gap * best.value:
            break
        share = _held(share * np.sqrt(slope), limit, total)
    assert best is not None
    return best._replace(bound=bound**0.5)


def _held(
    wish: np.ndarray, limit: np.ndarray, total: float, *, first: bool = False
) -> Float[np.ndarray, " n"]:
    """Shares of `total` in proportion to `wish`, none above its limit.

    With `first`, the candidates with the largest wishes get their limits in turn.
    """
    if first:
        order = np.argsort(-wish, kind="stable")
        room = np.minimum(np.cumsum(np.minimum(limit[order], total)), total)
        given = np.empty_like(wish)
        given[order] = np.diff(room, prepend=0.0)
        return given
    given = np.minimum(wish * (total / wish.sum()), limit)
    for _ in range(len(wish)):
        free = given < limit
        left = total - given[~free].sum()
        spare = wish[free].sum()
        if not free.any() or spare <= 0.0:
            break
        grown = np.minimum(wish[free] * (left / spare), limit[free])
        settled = (grown < limit[free]).all()
        given[free] = grown
        if settled:
            break
    return given
