"""Weights of candidate measurements that minimise the largest uncertainty.

    min over w of max_i d_i' C(w) d_i,      C(w)^-1 = L + sum_n w_n F_n,   w >= 0,  sum w = total

with F_n the information of one measurement at candidate n. The problem is convex: its value is a
lower bound for every whole number of measurements at these candidates, and its weights give their
distribution. It is solved by multiplicative updates of the weights, by the derivative of the
present mixture of the criteria, and of the mixture, towards the largest criteria (Silvey,
Titterington and Torsney 1978 for a single criterion).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .point_exchange import covariance_of

_POWER = 4.0


class Weights(NamedTuple):
    """The best weights found."""

    weights: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " q"]
    """sqrt(d' C d) of every functional."""

    @property
    def largest(self) -> float:
        """The largest value, which was minimised."""
        return float(self.values.max())


def weigh(
    information: Float[np.ndarray, "n k k"],
    precision: Float[np.ndarray, "k k"],
    functionals: Float[np.ndarray, "q k"],
    total: float,
    *,
    steps: int = 300,
) -> Weights:
    """Distribute `total` measurements among candidates.

    Raises `ValueError` where all candidates and the prior together leave a parameter undetermined.
    """
    w = np.full(len(information), total / len(information))
    mixture = np.full(len(functionals), 1.0 / len(functionals))
    best: Weights | None = None
    for _ in range(steps):
        H = precision + np.tensordot(w, information, 1)
        C = covariance_of(H, check=best is None)
        reached = functionals @ C
        values = np.sqrt(np.maximum((reached * functionals).sum(1), 0.0))
        if best is None or values.max() < best.largest:
            best = Weights(w, values)
        mixture = mixture * (values / values.max()) ** _POWER
        mixture /= mixture.sum()
        # The derivative of the sum of mixture times values; the square root damps the update.
        slope = reached.T @ (reached * (mixture / np.maximum(values, 1e-300))[:, None])
        w = w * np.sqrt(np.maximum(np.einsum("nkl,kl->n", information, slope), 0.0))
        w *= total / w.sum()
    assert best is not None
    return best


def apportion(shares: Float[np.ndarray, " n"], total: int, least: int = 0) -> np.ndarray:
    """Whole numbers near `shares` that add up to `total`, none below `least`, by largest remainder.

    Raises `ValueError` where `least` of each exceed `total`, for shares that are negative or not
    finite, and where all are zero.
    """
    if least * len(shares) > total:
        raise ValueError(
            f"found {total} for {len(shares)} shares, expected at least {least * len(shares)}, "
            f"{least} for each; raise the total, or lower the least number"
        )
    shares = np.asarray(shares, float)
    if not (np.isfinite(shares).all() and (shares >= 0.0).all() and shares.sum() > 0.0):
        raise ValueError(
            f"found the shares {shares.tolist()}, expected finite ones, none below zero and one "
            "above"
        )
    exact = np.maximum(shares * total / shares.sum(), least)
    counts = np.floor(exact).astype(int)
    while counts.sum() > total:
        above = np.where(counts > least, counts - exact, -np.inf)
        counts[int(np.argmax(above))] -= 1
    for place in np.argsort(counts - exact, kind="stable")[: total - counts.sum()]:
        counts[place] += 1
    return counts
