"""Selection of measurements from candidates by greedy choice and exchange.

    min over whole n_i of tr(G C),     C^-1 = L + sum_i n_i F_i,
    0 <= n_i <= most,     sum_i n_i c_i <= total

with F_i the information of candidate i (a pose of an artefact, a point, a line), c_i its cost, L
the prior precision and G the quadratic form of the criterion. A greedy choice is followed by
exchanges of one measurement for another until none lowers the criterion (Fedorov 1972, in the
cheaper order of Cook and Nachtsheim 1980); the same is done from random choices. The result is a
local minimum; `weigh_average` gives a lower bound for every choice. Unknowns that all candidates
share and that do not count themselves, such as the errors of an artefact, belong into the matrices,
with zeros in G.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from ..numerics.eigen import eigh

_SURE = 1e12
"""Condition number above which a parameter counts as undetermined."""


def covariance_of(
    precision: Float[np.ndarray, "k k"], *, check: bool = True
) -> Float[np.ndarray, "k k"]:
    """Inverse of a precision matrix, computed with its diagonal scaled to one.

    With `check`, raises `ValueError` where the condition number of the scaled matrix shows that a
    combination of parameters is not determined.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
    units = np.outer(scale, scale)
    scaled = precision * units
    if check and np.linalg.cond(scaled) > _SURE:
        raise ValueError(
            "found measurements that leave a parameter undetermined, expected every parameter to "
            "be measured by some of them or to have a prior; choose more, or add candidates"
        )
    return np.linalg.inv(scaled) * units


_FACTOR = 1e-13
"""Eigenvalue of an information, relative to its largest, that counts as zero."""
_RIDGE = 1e-10
"""Precision for parameters without a prior, in units of the information of all candidates."""


class Choice(NamedTuple):
    """A choice of measurements."""

    counts: Int[np.ndarray, " n"]
    """Number of measurements of each candidate."""
    value: float
    """sqrt(tr(G C)) of the choice."""

    @property
    def chosen(self) -> Int[np.ndarray, " c"]:
        """Indices of the candidates, each as often as it is measured, in ascending order."""
        return np.repeat(np.arange(len(self.counts)), self.counts)


# Many small matrices: more threads of BLAS only wait for each other.
@threadpool_limits.wrap(limits=1, user_api="blas")
def exchange(
    information: Float[np.ndarray, "n k k"],
    precision: Float[np.ndarray, "k k"],
    gram: Float[np.ndarray, "k k"],
    total: float,
    *,
    costs: Float[np.ndarray, " n"] | None = None,
    most: int = 1,
    starts: int = 4,
    seed: int = 0,
    tolerance: float = 1e-9,
) -> Choice:
    """Choose `total` measurements or, with `costs`, measurements with a total cost of at most that.

    A candidate is measured at most `most` times. Exchanges start from the greedy choice and from
    `starts` - 1 random ones; the best result is returned. An exchange has to lower the criterion by
    more than the relative `tolerance`. Raises `ValueError` for fewer candidates than required, for
    costs that are not above zero or all above `total`, and where the choice leaves a parameter
    undetermined.
    """
    F, G = np.asarray(information, float), np.asarray(gram, float)
    price = _checked(len(F), total, costs, most)
    prior = np.asarray(precision, float)
    L, scale = _in_units(F, prior)
    parts = _factors(F * np.outer(scale, scale))
    inner = G * np.outer(scale, scale)
    task = _Task(parts, inner, L, price, total * (1.0 + 1e-9), most, tolerance)
    rng = np.random.default_rng(seed)
    orders = [None, *(rng.permutation(len(F)) for _ in range(starts - 1))]
    begun = [task.filled(np.zeros(len(F), int), order) for order in orders]
    counts = min(map(task.exchanged, begun), key=task.value)
    return Choice(counts, _value(F, prior, G, counts))


class _Task(NamedTuple):
    """The candidates, the prior and the criterion in common units."""

    parts: Float[np.ndarray, "n k r"]
    gram: Float[np.ndarray, "k k"]
    prior: Float[np.ndarray, "k k"]
    price: Float[np.ndarray, " n"]
    total: float
    most: int
    tolerance: float

    def inverse(self, counts: np.ndarray) -> np.ndarray:
        """C of a choice."""
        used = np.flatnonzero(counts)
        rows = self.parts[used] * np.sqrt(counts[used])[:, None, None]
        rows = rows.swapaxes(0, 1).reshape(len(self.prior), -1)
        return np.linalg.inv(self.prior + rows @ rows.T)

    def value(self, counts: np.ndarray) -> float:
        """tr(G C)."""
        return float(np.einsum("kl,kl->", self.gram, self.inverse(counts)))

    def fits(self, counts: np.ndarray) -> np.ndarray:
        """Whether one more measurement of each candidate is allowed."""
        return (counts < self.most) & (self.price @ counts + self.price <= self.total)

    def filled(self, counts: np.ndarray, order: np.ndarray | None = None) -> np.ndarray:
        """Add measurements until none fits: by the largest gain per cost, or in a given order."""
        while (fits := self.fits(counts)).any():
            if order is None:
                gained = _gains(self.inverse(counts), self.gram, self.parts) / self.price
            else:
                gained = -order.astype(float)
            counts = _moved(counts, int(np.argmax(np.where(fits, gained, -np.inf))), 1)
        return counts

    def exchanged(self, counts: np.ndarray) -> np.ndarray:
        """Exchange single measurements until no exchange lowers the criterion."""
        value, moved = self.value(counts), True
        while moved:
            moved = False
            for out in np.flatnonzero(counts).tolist():
                fewer = _moved(counts, out, -1)
                C = self.inverse(fewer)
                gained = _gains(C, self.gram, self.parts)
                best = int(np.argmax(np.where(self.fits(fewer), gained, -np.inf)))
                reached = float(np.einsum("kl,kl->", self.gram, C)) - gained[best]
                if best != out and reached < value * (1.0 - self.tolerance):
                    counts = _moved(fewer, best, 1)
                    value, moved = reached, True
            # A cheaper measurement may leave a budget for one more.
            fuller = self.filled(counts)
            if fuller.sum() > counts.sum():
                counts, value, moved = fuller, self.value(fuller), True
        return counts


def _moved(counts: np.ndarray, place: int, by: int) -> np.ndarray:
    counts = counts.copy()
    counts[place] += by
    return counts


def _checked(count: int, total: float, costs: np.ndarray | None, most: int) -> np.ndarray:
    """The cost of every candidate; raises `ValueError` for invalid arguments."""
    if costs is None:
        if not 1 <= total <= most * count or total != int(total):
            raise ValueError(
                f"total: found {total:g} measurements, expected a whole number from 1 to "
                f"{most * count}, as {count} candidates are measured {most} times at most"
            )
        return np.ones(count)
    price = np.asarray(costs, float)
    if price.shape != (count,) or not (price > 0.0).all():
        raise ValueError(f"costs: expected {count} numbers above zero, one for every candidate")
    if price.min() > total:
        raise ValueError(
            f"total: found {total:g}, expected at least {price.min():g}, the cheapest candidate"
        )
    return price


def _in_units(F: np.ndarray, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The prior in units in which the information of all candidates is one, and these units."""
    whole = precision + F.sum(0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), np.finfo(float).tiny))
    L = precision * np.outer(scale, scale)
    if np.linalg.eigvalsh(L)[0] < _RIDGE:
        # The first measurements of a greedy choice do not determine all parameters.
        L = L + _RIDGE * np.eye(len(L))
    return L, scale


def _factors(F: np.ndarray) -> np.ndarray:
    """V (n, k, r) with V V' = F, r the largest rank."""
    sizes, ways = eigh(F)
    kept = sizes > _FACTOR * sizes[:, -1:]
    rank = max(int(kept.sum(1).max()), 1)
    root = np.sqrt(np.where(kept, sizes, 0.0))[:, -rank:]
    return ways[:, :, -rank:] * root[:, None, :]


def _gains(C: np.ndarray, G: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Decrease of tr(G C) with one more measurement of every candidate:
    tr((1 + V'C V)^-1 V'C G C V) (Woodbury).
    """
    n, k, r = parts.shape
    side = parts.swapaxes(1, 2)
    flat = side.reshape(n * r, k)
    seen = (flat @ C).reshape(n, r, k)
    counted = (flat @ (C @ G @ C)).reshape(n, r, k)
    inner = np.eye(r) + seen @ parts
    return np.trace(np.linalg.solve(inner, counted @ parts), axis1=1, axis2=2)


def _value(F: np.ndarray, precision: np.ndarray, G: np.ndarray, counts: np.ndarray) -> float:
    """sqrt(tr(G C)) with the given prior."""
    H = precision + np.tensordot(counts.astype(float), F, 1)
    return float(np.sqrt(np.einsum("kl,kl->", G, covariance_of(H))))
