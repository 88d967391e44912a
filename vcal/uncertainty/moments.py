"""Mean, covariance and range of any number of draws, updated block by block.

Blocks are merged by the update of Chan, Golub and LeVeque (1983). It keeps sums of deviations from
the mean, so that no digits are lost where the spread is small against the mean. The sums of a block
(`block_moments`, `block_spread`) may come from another process: the result depends on the order in
which blocks are merged alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .quantile_counts import slices


class BlockMoments(NamedTuple):
    """Joint moments of k scalar outputs in one block of draws."""

    rows: int
    count: Int[np.ndarray, "k k"] | None
    """Draws in which outputs i and j are both finite; None where all of them are."""
    offset: Float[np.ndarray, "k k"] | Float[np.ndarray, " k"]
    """Mean of output i over those draws, minus its origin; one per output where all are finite."""
    comoment: Float[np.ndarray, "k k"]
    minimum: Float[np.ndarray, " k"]
    maximum: Float[np.ndarray, " k"]


class BlockSpread(NamedTuple):
    """Mean, sum of squared deviations and range of every element of a field in one block."""

    count: int
    mean: Float[np.ndarray, " size"]
    squares: Float[np.ndarray, " size"]
    minimum: Float[np.ndarray, " size"]
    maximum: Float[np.ndarray, " size"]


class Moments:
    """Joint moments of k scalar outputs, without failed values.

    Variances use the draws in which the output is finite, covariances the draws in which both
    outputs are. Where no draw fails, or draws fail as a whole, the result is the usual covariance
    matrix. Where outputs fail in different draws, it need not be positive semi-definite.
    """

    def __init__(self, size: int):
        self.count = np.zeros((size, size), np.int64)
        """Draws in which outputs i and j are both finite."""
        self.origin = np.full(size, np.nan)
        """Mean of the first block, the origin of all values, which preserves digits where the
        spread is small against the value.
        """
        self.offset = np.zeros((size, size))
        """[i, j]: mean of output i over those draws, minus its origin."""
        self.comoment = np.zeros((size, size))
        """Sum over those draws of the product of both deviations."""
        self.minimum = np.full(size, np.inf)
        self.maximum = np.full(size, -np.inf)

    def add(self, values: Float[np.ndarray, "n k"]) -> None:
        """Merge a block of draws."""
        finite = np.isfinite(values)
        if np.isnan(self.origin).any():
            first = np.where(finite, values, 0.0).sum(0) / np.maximum(finite.sum(0), 1)
            self.origin = np.where(np.isnan(self.origin) & finite.any(0), first, self.origin)
        self.merge(block_moments(values, self.origin))

    def merge(self, block: BlockMoments) -> None:
        """Merge the moments of a block, relative to `origin`."""
        count, offset = block.count, block.offset
        if count is None:
            count = np.full(self.count.shape, block.rows)
            offset = np.repeat(offset[:, None], len(offset), axis=1)
        total = self.count + count
        share = count / np.maximum(total, 1)
        apart = offset - self.offset
        self.comoment = self.comoment + block.comoment + apart * apart.T * self.count * share
        self.offset = self.offset + apart * share
        self.count = total
        self.minimum = np.minimum(self.minimum, block.minimum)
        self.maximum = np.maximum(self.maximum, block.maximum)

    @property
    def mean(self) -> Float[np.ndarray, " k"]:
        """Mean of every output; NaN where every draw failed."""
        return self.origin + np.diag(self.offset)

    @property
    def covariance(self) -> Float[np.ndarray, "k k"]:
        """Covariance with n - 1 (JCGM 102, 7.6); NaN for fewer than two draws."""
        dof = np.where(self.count > 1, self.count - 1.0, np.nan)
        return self.comoment / dof

    @property
    def deviation(self) -> Float[np.ndarray, " k"]:
        """Standard deviation of every output (JCGM 101, 7.6)."""
        return np.sqrt(np.diag(self.covariance))

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays, for `restored_moments`."""
        names = ("count", "origin", "offset", "comoment", "minimum", "maximum")
        return {name: getattr(self, name) for name in names}


def restored_moments(arrays: dict[str, np.ndarray]) -> Moments:
    """The moments with the state in `arrays`."""
    found = Moments(len(arrays["minimum"]))
    for name, value in arrays.items():
        setattr(found, name, value)
    return found


class Spread:
    """Mean, variance and range of every element of a field, element by element.

    Only draws in which the whole field is finite may be added.
    """

    def __init__(self, size: int):
        self.count = 0
        self.mean = np.zeros(size)
        self.squares = np.zeros(size)
        """Sum of squared deviations from the mean."""
        self.minimum = np.full(size, np.inf)
        self.maximum = np.full(size, -np.inf)

    def add(self, values: Float[np.ndarray, "n size"]) -> None:
        """Merge a block of draws."""
        if len(values):
            self.merge(block_spread(values))

    def merge(self, block: BlockSpread) -> None:
        """Merge the spread of a block."""
        total = self.count + block.count
        share = block.count / total
        apart = block.mean - self.mean
        self.squares += block.squares + apart**2 * (self.count * share)
        self.mean += apart * share
        self.minimum = np.minimum(self.minimum, block.minimum)
        self.maximum = np.maximum(self.maximum, block.maximum)
        self.count = total

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays, for `restored_spread`."""
        names = ("mean", "squares", "minimum", "maximum")
        return {"count": np.array(self.count)} | {name: getattr(self, name) for name in names}


def restored_spread(arrays: dict[str, np.ndarray]) -> Spread:
    """The spread with the state in `arrays`."""
    found = Spread(len(arrays["mean"]))
    found.count = int(arrays["count"])
    found.mean, found.squares = arrays["mean"], arrays["squares"]
    found.minimum, found.maximum = arrays["minimum"], arrays["maximum"]
    return found


def block_moments(
    values: Float[np.ndarray, "n k"], origin: Float[np.ndarray, " k"]
) -> BlockMoments:
    """Joint moments of a block of draws, relative to an origin."""
    finite, moved = np.isfinite(values), values - origin
    if finite.all():
        mean = moved.mean(0)
        apart = moved - mean
        comoment = apart.T @ apart
        return BlockMoments(len(values), None, mean, comoment, values.min(0), values.max(0))
    low, high = (np.where(finite, values, end) for end in (np.inf, -np.inf))
    return BlockMoments(len(values), *_pairs(moved, finite), low.min(0), high.max(0))


def block_spread(values: Float[np.ndarray, "n size"]) -> BlockSpread:
    """Mean, sum of squared deviations and range of every element; n is at least one."""
    mean, squares, low, high = np.empty((4, values.shape[1]))
    for part in slices(values.shape[1], len(values)):
        x = values[:, part]
        mean[part] = x.mean(0)
        squares[part] = ((x - mean[part]) ** 2).sum(0)
        low[part], high[part] = x.min(0), x.max(0)
    return BlockSpread(len(values), mean, squares, low, high)


def _pairs(
    values: Float[np.ndarray, "n k"], finite: Bool[np.ndarray, "n k"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count, mean and co-moment of every pair of outputs where both are finite."""
    weight = finite.astype(float)
    count = (weight.T @ weight).astype(np.int64)
    own = np.where(finite, values, 0.0).sum(0) / np.maximum(np.diag(count), 1)
    apart = np.where(finite, values - own, 0.0)
    moved = (
        apart.T @ weight / np.maximum(count, 1)
    )  # from the mean of the output to that of the pair
    comoment = apart.T @ apart - moved * moved.T * count
    return count, np.where(count > 0, own[:, None] + moved, 0.0), comoment
