"""Quantiles of any number of draws from counts in fixed bins.

    z = (x - centre) / scale,    t = z / (1 + |z|),    bins of equal width in t over (-1, 1)

The map covers the whole line, so that no value falls outside, and bins are narrowest about the
centre: with a scale of two standard deviations and 2^16 bins, a bin is 6e-5 standard deviations
wide there and four times that at two standard deviations. Counts are independent of the order of
the draws.
"""

import zlib
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16, UInt32

from .intervals import Kind, interval_ranks

Numbers = float | np.ndarray

_CELLS = 2**25
"""Total number of counts, 4 bytes each."""
_FINEST, _COARSEST = 2**16, 2**6
_ELEMENTS = 2**18
"""Values processed at a time, which bounds the memory of intermediate results and fits the cache.
"""


class Bins(NamedTuple):
    """Where the bins of k quantities lie."""

    centre: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, " k"]
    number: int
    """Bins per quantity, at most 2^16."""

    def of(self, values: Float[np.ndarray, "n k"]) -> UInt16[np.ndarray, "n k"]:
        """The bin of every value; zero for those that are not finite."""
        found = np.empty(values.shape, np.uint16)
        for part in slices(values.shape[1], len(values)):
            found[:, part] = _bins_of(values[:, part], self.centre[part], self.scale[part],
                                      self.number)  # fmt: skip
        return found


class Packed(NamedTuple):
    """Numbers of bins without the order of the draws, which counts do not need, in few bytes.

    The numbers of every quantity are sorted, and their differences, low bytes first and then high
    bytes, have a Huffman code: about five bits per value where 10 000 draws fill 2^16 bins.
    """

    shape: tuple[int, int]
    content: bytes

    @property
    def numbers(self) -> UInt16[np.ndarray, "n k"]:
        """The numbers, in ascending order."""
        n, k = self.shape
        low, high = np.frombuffer(zlib.decompress(self.content), np.uint8).reshape(2, k, n)
        steps = low.astype(np.uint16) | (high.astype(np.uint16) << 8)
        return np.cumsum(steps, axis=1, dtype=np.uint16).T


def packed(numbers: UInt16[np.ndarray, "n k"]) -> Packed:
    """Numbers of bins as few bytes."""
    steps = np.diff(np.sort(numbers.T, axis=1), axis=1, prepend=np.uint16(0))
    planes = np.stack([steps.astype(np.uint8), (steps >> 8).astype(np.uint8)])
    code = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_HUFFMAN_ONLY)
    return Packed(numbers.shape, code.compress(planes.tobytes()) + code.flush())


@dataclass(frozen=True)
class Sketch:
    """Counts of the values of k quantities in bins; immutable except for the counts."""

    centre: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, " k"]
    counts: UInt32[np.ndarray, "k bins"]

    @property
    def bins(self) -> int:
        """Number of bins per quantity."""
        return self.counts.shape[1]

    @property
    def layout(self) -> Bins:
        """Where the bins lie."""
        return Bins(self.centre, self.scale, self.bins)

    def add(self, values: Float[np.ndarray, "n k"]) -> None:
        """Count values; those that are not finite are left out."""
        for part in slices(values.shape[1], len(values)):
            x = values[:, part]
            self._count(part, _bins_of(x, self.centre[part], self.scale[part], self.bins),
                        np.isfinite(x))  # fmt: skip

    def count(
        self,
        numbers: UInt16[np.ndarray, "n k"] | Packed,
        finite: Bool[np.ndarray, "n k"] | None = None,
    ) -> None:
        """Count values by the numbers of their bins (`Bins.of`), as `add` does."""
        if isinstance(numbers, Packed):
            numbers = numbers.numbers
        for part in slices(numbers.shape[1], len(numbers)):
            counted = ... if finite is None else finite[:, part]
            self._count(part, numbers[:, part].astype(np.int64), counted)

    def _count(self, part: slice, numbers: np.ndarray, counted: Any) -> None:
        cells = numbers + np.arange(numbers.shape[1]) * self.bins
        np.add.at(self.counts[part].reshape(-1), cells[counted].reshape(-1), np.uint32(1))

    def column(self, low: float, high: float, at: int) -> "Column":
        """Quantity `at`, whose smallest and largest values are `low` and `high`."""
        number = np.arange(self.bins + 1)
        edges = _edges(number, self.bins, self.centre[at], self.scale[at], low, high)
        total = np.concatenate([[0], np.cumsum(self.counts[at], dtype=np.int64)])
        return Column(edges, total)

    def quantiles(
        self,
        low: Float[np.ndarray, " k"],
        high: Float[np.ndarray, " k"],
        draws: int,
        probability: float,
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """A quantile of every quantity with the bound of its error, as in `Column.quantile`.

        `low` and `high` are the smallest and largest values of each quantity, `draws` their number.
        """
        found = np.zeros((2, len(low)))
        for rank, weight in zip(*quantile_ranks(draws, probability), strict=True):
            for part in slices(len(low), self.bins):
                counts = self.counts[part].astype(np.int64)
                at = (np.cumsum(counts, axis=1) < rank - 0.5).sum(1)
                inside = np.take_along_axis(counts, at[:, None], 1)[:, 0]
                below = (counts * (np.arange(self.bins) < at[:, None])).sum(1)
                span = self.centre[part], self.scale[part], low[part], high[part]
                left, right = (_edges(number, self.bins, *span) for number in (at, at + 1))
                share = (rank - 0.5 - below) / inside
                known = low[part] if rank == 1 else high[part] if rank == draws else None
                value, bound = _within(left, right, share)
                found[0, part] += weight * (value if known is None else known)
                found[1, part] += weight * (bound if known is None else 0.0)
        return found[0], found[1]


@dataclass(frozen=True)
class Column:
    """One quantity of a sketch: values by rank, distributed evenly over their bin."""

    edges: Float[np.ndarray, " bins+1"]
    total: Int[np.ndarray, " bins+1"]
    """Values below each edge."""

    @property
    def draws(self) -> int:
        """Number of counted values."""
        return int(self.total[-1])

    def ranked(self, ranks: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Values of these ranks; the first and the last are exact."""
        inside = _within(*self._bins(ranks))[0]
        last = ranks == self.draws
        return np.where(ranks == 1, self.edges[0], np.where(last, self.edges[-1], inside))

    def bound(self, ranks: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Bound of the error of `ranked`: the distance to the farther edge of the bin."""
        known = (ranks == 1) | (ranks == self.draws)
        return np.where(known, 0.0, _within(*self._bins(ranks))[1])

    def quantile(self, probability: float) -> tuple[float, float]:
        """Quantile and the bound of its error, ranks as in `quantile_ranks`; NaN without values."""
        if not self.draws:
            return np.nan, np.nan
        ranks, weights = quantile_ranks(self.draws, probability)
        return float(weights @ self.ranked(ranks)), float(weights @ self.bound(ranks))

    def interval(self, p: float, kind: Kind) -> tuple[tuple[float, float], float]:
        """Coverage interval (JCGM 101, 7.7.2), and the larger error bound of its ends.

        For a shortest interval, the bound holds for the ends at the chosen ranks.
        """
        filled = np.flatnonzero(np.diff(self.total))
        knots = np.concatenate([self.total[filled] + 1, self.total[filled + 1]])
        ranks = np.array(interval_ranks(self.ranked, self.draws, p, kind, knots))
        low, high = self.ranked(ranks)
        return (float(low), float(high)), float(self.bound(ranks).max())

    def _bins(self, ranks: Int[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper edge of the bin of each rank, and the position between them."""
        # Rank r has the cumulative probability (r - 1/2)/M (JCGM 101, 7.5.1).
        middle = ranks - 0.5
        at = np.searchsorted(self.total, middle) - 1
        share = (middle - self.total[at]) / (self.total[at + 1] - self.total[at])
        return self.edges[at], self.edges[at + 1], share


def sketch_of(pilot: Float[np.ndarray, "n k"]) -> Sketch:
    """An empty sketch with bins for values like those of a pilot sample.

    The centre is the median, the scale half the width of the central 95 %. Both are order
    statistics, so that a few extreme values do not widen the bins. The number of bins is a power of
    two from 2^6 to 2^16; it is larger for fewer quantities.
    """
    size = pilot.shape[1]
    centre, scale = np.empty(size), np.empty(size)
    for part in slices(size, len(pilot)):
        centre[part], scale[part] = _layout(pilot[:, part])
    bins = _FINEST
    while bins > _COARSEST and bins * size > _CELLS:
        bins //= 2
    return Sketch(centre, scale, np.zeros((size, bins), np.uint32))


def quantile_ranks(
    draws: int, probability: float
) -> tuple[Int[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Two neighbouring ranks and their weights in a quantile.

    Rank r has the cumulative probability (r - 1/2)/M, linear in between (JCGM 101, 7.5.1).
    """
    place = probability * draws + 0.5
    low = min(max(int(place), 1), max(draws - 1, 1))
    weight = min(max(place - low, 0.0), 1.0)
    return np.array([low, min(low + 1, draws)]), np.array([1.0 - weight, weight])


def slices(size: int, rows: int) -> list[slice]:
    """Ranges of columns to process together, for arrays with `rows` rows."""
    step = max(1, _ELEMENTS // max(rows, 1))
    return [slice(start, min(start + step, size)) for start in range(0, size, step)]


def _bins_of(
    x: Float[np.ndarray, "n k"],
    centre: Float[np.ndarray, " k"],
    scale: Float[np.ndarray, " k"],
    bins: int,
) -> Int[np.ndarray, "n k"]:
    z = np.clip((x - centre) / scale, -1e18, 1e18)
    t = np.where(np.isfinite(x), z / (1.0 + np.abs(z)), -1.0)
    # Rounding may map an extreme value to t = 1.
    return np.minimum(((t + 1.0) * (0.5 * bins)).astype(np.int64), bins - 1)


def _layout(pilot: Float[np.ndarray, "n k"]) -> tuple[np.ndarray, np.ndarray]:
    ordered = np.sort(np.where(np.isfinite(pilot), pilot, np.nan), axis=0)  # NaN goes last
    count = np.isfinite(ordered).sum(0)

    def at(probability: float) -> np.ndarray:
        place = np.maximum((probability * (count - 1)).astype(int), 0)
        return np.take_along_axis(ordered, place[None], 0)[0]

    low, centre, high = at(0.025), at(0.5), at(0.975)
    scale = 0.5 * (high - low)
    # Values that are mostly equal have no such width; their size then sets the scale.
    for other in (0.5 * (at(1.0) - at(0.0)), np.abs(centre), np.ones_like(scale)):
        scale = np.where(scale > 0.0, scale, other)
    return np.where(count > 0, centre, 0.0), scale


def _edges(
    number: Int[np.ndarray, " n"],
    bins: int,
    centre: Numbers,
    scale: Numbers,
    low: Numbers,
    high: Numbers,
) -> Float[np.ndarray, " n"]:
    """Lower edges of bins, limited to the known range of the values.

    The edge with the index after the last bin is the upper end of that bin.
    """
    t = 2.0 * number / bins - 1.0
    inner = np.abs(t) < 1.0
    z = np.where(inner, t / np.where(inner, 1.0 - np.abs(t), 1.0), np.copysign(np.inf, t))
    return np.clip(centre + scale * z, low, high)


def _within(
    low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], share: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """A value inside a bin, and the bound of its error, the distance to the farther edge."""
    return low + (high - low) * share, (high - low) * np.maximum(share, 1.0 - share)
