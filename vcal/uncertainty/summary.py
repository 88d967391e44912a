"""The running summary of a Monte Carlo campaign, in memory that does not grow with the draws.

Blocks are added in order, so that the numbers do not depend on the grouping of the draws, on the
devices, or on interruptions of the campaign.

Another process can summarise blocks (`digest`), once the first draws have shown where the bins of
the counts lie (`Layout`). Merging its digests gives the same numbers as adding the draws, bit for
bit: the sums of a block are the same, and they are added in the same order.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt16

from ..numerics.arrays import Array
from .adaptive import StepResults, Steps, step_results
from .intervals import Kind
from .moments import (
    BlockMoments,
    BlockSpread,
    Moments,
    Spread,
    block_moments,
    block_spread,
    restored_moments,
    restored_spread,
)
from .outputs import Field, Output, check_names, field_rows, labels_of, scalar_rows
from .quantile_counts import Bins, Packed, Sketch, packed, quantile_ranks, sketch_of

_PILOT = 10_000
"""Draws that define the bins of the scalar outputs."""
_FIELD_PILOT = 256
"""The same for fields, whose values are not kept."""


@dataclass(frozen=True)
class Declared:
    """The results of a campaign per draw, and the settings of their summary."""

    outputs: tuple[Output, ...]
    fields: tuple[Field, ...]
    step: int
    """Draws of a sub-block (JCGM 101, 7.9)."""
    coverage: float
    kind: Kind
    keep: int
    """Largest number of kept values of scalar outputs."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all scalar outputs, in order."""
        return labels_of(self.outputs)


class Layout(NamedTuple):
    """What the first draws have shown, and blocks of further ones are summarised with."""

    origin: Float[np.ndarray, " k"]
    """Origin of the moments (`Moments.origin`)."""
    bins: Bins | None
    """Bins of the scalar outputs; None while their values are kept."""
    fields: tuple[Bins | None, ...]
    """Bins of every field; None without quantiles, and where too few draws were finite so far."""


class FieldBlock(NamedTuple):
    """The summary of a field in one block."""

    failed: int
    spread: BlockSpread | None
    """None where no draw is finite."""
    values: Float[np.ndarray, "n size"] | None = None
    """Finite draws, where the bins of their quantiles are not known yet."""
    numbers: Packed | None = None
    """Bins of the finite draws."""


class Digest(NamedTuple):
    """The summary of consecutive whole blocks."""

    draws: int
    moments: tuple[BlockMoments, ...]
    """One per block."""
    fields: tuple[tuple[FieldBlock, ...], ...]
    """One per block and field."""
    values: Float[np.ndarray, "n k"] | None = None
    """Scalar outputs of a single block, where these are kept, or are no whole sub-block."""
    numbers: UInt16[np.ndarray, "n k"] | Packed | None = None
    """Bins of the scalar outputs of a whole sub-block, packed where all of them are finite."""
    finite: Bool[np.ndarray, "n k"] | None = None
    """Whether these are finite; None where all of them are."""
    step: StepResults | None = None
    """Results of that sub-block."""


class Summary:
    """The summary of the draws so far.

    Values of scalar outputs are kept as long as their total number is at most `keep`. When the next
    block would exceed it, all kept values are counted in a sketch, and so is every further block.
    The mode therefore depends on the number of draws alone. The values of the first draws stay.
    """

    def __init__(self, declared: Declared):
        self.declared = declared
        size = len(declared.labels)
        self.draws = 0
        self.moments = Moments(size)
        self.steps = Steps(size, declared.step, declared.coverage, declared.kind)
        self.kept: list[np.ndarray] = []
        """Values of the first draws, block after block."""
        self.sketch: Sketch | None = None
        self.fields = {field.name: FieldSummary(field) for field in declared.fields}

    def add(self, values: Mapping[str, Array], count: int, rows: int) -> None:
        """Add the first `rows` of the `count` draws of a block.

        Raises `ValueError` where the values are not as declared.
        """
        declared = self.declared
        check_names(values, declared.outputs, declared.fields)
        scalars = scalar_rows(values, declared.outputs, count)[:rows]
        fields = {f.name: field_rows(values, f, count)[:rows] for f in declared.fields}
        self._keep(scalars)
        self.moments.add(scalars)
        for name, field in fields.items():
            self.fields[name].add(field)
        self.draws += rows
        self.steps.add(scalars)

    def merge(self, found: Digest) -> None:
        """Add blocks that were summarised elsewhere with the layout of this summary."""
        if self.sketch is not None and found.numbers is not None:
            self.sketch.count(found.numbers, found.finite)
        for moments, fields in zip(found.moments, found.fields, strict=True):
            self.moments.merge(moments)
            for own, field in zip(self.fields.values(), fields, strict=True):
                own.merge(field)
        if found.step is not None:
            self.steps.merge(found.step)
        if found.values is not None:
            self._keep(found.values)
            self.steps.add(found.values)
        self.draws += found.draws

    @property
    def layout(self) -> Layout | None:
        """What blocks can be summarised with elsewhere; None until every output was finite."""
        if not self.draws or np.isnan(self.moments.origin).any():
            return None
        bins = None if self.sketch is None else self.sketch.layout
        return Layout(self.moments.origin, bins, tuple(f.bins for f in self.fields.values()))

    def together(self, number: int, block: int, total: int) -> int:
        """How many of the `total` draws' blocks, from `number` on, one digest may summarise.

        A whole sub-block; a single block while values of scalar outputs are kept, and where no
        sub-block begins or it is cut off.
        """
        size, step = len(self.declared.labels), self.declared.step
        kept = (number + 1) * block * size <= self.declared.keep
        whole = number * block % step == 0 and number * block + step <= total
        return step // block if whole and not kept else 1

    def count(self) -> None:
        """Count all further values of scalar outputs: no more are kept."""
        self._count_from(self.values[:_PILOT])

    @property
    def values(self) -> Float[np.ndarray, "m k"]:
        """Values of the kept draws, all or the first ones."""
        return np.concatenate([np.empty((0, len(self.declared.labels))), *self.kept])

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays without the kept values, for `restore`."""
        found = {"draws": np.array(self.draws)}
        found |= _prefixed("moments", self.moments.arrays())
        found |= _prefixed("steps", self.steps.arrays())
        if self.sketch is not None:
            found |= _prefixed("sketch", _sketch_arrays(self.sketch))
        for number, field in enumerate(self.fields.values()):
            found |= _prefixed(f"field{number}", field.arrays())
        return found

    def restore(self, arrays: Mapping[str, np.ndarray], kept: Sequence[np.ndarray]) -> None:
        """Restore the state from `arrays` and the kept values.

        Raises `ValueError` for arrays that are not those of this state.
        """
        for name, own in self.arrays().items():
            found = arrays.get(name)
            # The number of rows of these is that of the first, or of the latest draws.
            first = 1 if name.endswith((".pilot", ".waiting")) else 0
            if found is None or (found.dtype, found.ndim, found.shape[first:]) != (
                own.dtype, own.ndim, own.shape[first:]
            ):  # fmt: skip
                raise ValueError(f"no {name} of shape {own.shape}")
        if not 0 <= int(arrays["draws"]) <= 2**32:
            raise ValueError(f"{int(arrays['draws'])} draws")
        self.draws = int(arrays["draws"])
        self.kept = list(kept)
        self.moments = restored_moments(_part(arrays, "moments"))
        self.steps.restore(_part(arrays, "steps"))
        sketch = _part(arrays, "sketch")
        self.sketch = Sketch(**sketch) if sketch else None
        for number, field in enumerate(self.fields.values()):
            field.restore(_part(arrays, f"field{number}"))

    def _keep(self, scalars: Float[np.ndarray, "n k"]) -> None:
        if self.sketch is None:
            if (self.draws + len(scalars)) * scalars.shape[1] <= self.declared.keep:
                self.kept.append(scalars)
                return
            self._count_from(self.values[:_PILOT] if self.kept else scalars)
        assert self.sketch is not None
        self.sketch.add(scalars)

    def _count_from(self, pilot: Float[np.ndarray, "n k"]) -> None:
        sketch = sketch_of(pilot)
        for block in self.kept:
            sketch.add(block)
        self.sketch = sketch


class FieldSummary:
    """The summary of a field; a draw with an element that is not finite is left out."""

    def __init__(self, field: Field):
        self.field = field
        self.failed = 0
        self.spread = Spread(field.size)
        self.pilot: list[np.ndarray] = []
        """Values of the first draws, until there are enough to define the bins."""
        self.sketch: Sketch | None = None

    def add(self, values: Float[np.ndarray, "n size"]) -> None:
        """Add a block of draws."""
        self.merge(_field_block(self.field, values, None))

    def merge(self, block: FieldBlock) -> None:
        """Add a block that was summarised elsewhere."""
        self.failed += block.failed
        if block.spread is not None:
            self.spread.merge(block.spread)
        good = block.values
        if self.sketch is not None and block.numbers is not None:
            self.sketch.count(block.numbers)
        if good is None or not self.field.quantiles:
            return
        if self.sketch is not None:
            self.sketch.add(good)
            return
        self.pilot.append(good)
        if self.spread.count >= _FIELD_PILOT:
            first = np.concatenate([block[:_FIELD_PILOT] for block in self.pilot])
            sketch = sketch_of(first[:_FIELD_PILOT])
            for part in self.pilot:
                sketch.add(part)
            self.sketch, self.pilot = sketch, []

    @property
    def bins(self) -> Bins | None:
        """Where the bins lie; None where there are none, or not yet."""
        return None if self.sketch is None else self.sketch.layout

    def quantiles(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For every requested probability: quantiles (size,) and bounds of their errors (size,)."""
        count, size = self.spread.count, self.field.size
        if not count or not self.field.quantiles:
            return [(np.full(size, np.nan), np.full(size, np.nan)) for _ in self.field.quantiles]
        if self.sketch is None:
            ordered, found = np.sort(np.concatenate(self.pilot), axis=0), []
            for probability in self.field.quantiles:
                ranks, weights = quantile_ranks(count, probability)
                found.append((weights @ ordered[ranks - 1], np.zeros(size)))
            return found
        low, high = self.spread.minimum, self.spread.maximum
        return [self.sketch.quantiles(low, high, count, q) for q in self.field.quantiles]

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays, for `restore`."""
        pilot = np.concatenate([np.empty((0, self.field.size)), *self.pilot])
        found = {"failed": np.array(self.failed), "pilot": pilot}
        found |= _prefixed("spread", self.spread.arrays())
        if self.sketch is not None:
            found |= _prefixed("sketch", _sketch_arrays(self.sketch))
        return found

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the state from `arrays`."""
        self.failed, self.pilot = int(arrays["failed"]), [arrays["pilot"]]
        self.spread = restored_spread(_part(arrays, "spread"))
        sketch = _part(arrays, "sketch")
        self.sketch = Sketch(**sketch) if sketch else None


def digest(
    blocks: Iterable[Mapping[str, Array]], count: int, declared: Declared, layout: Layout
) -> Digest:
    """The summary of consecutive blocks of `count` draws each, for `Summary.merge`.

    As many as `Summary.together` gives. Raises `ValueError` where the values are not as declared.
    """
    scalars, moments, fields = [], [], []
    for values in blocks:
        check_names(values, declared.outputs, declared.fields)
        rows = scalar_rows(values, declared.outputs, count)
        scalars.append(rows)
        moments.append(block_moments(rows, layout.origin))
        each = zip(declared.fields, layout.fields, strict=True)
        fields.append(
            tuple(_field_block(f, field_rows(values, f, count), bins) for f, bins in each)
        )
    found = np.concatenate(scalars)
    summed = Digest(len(found), tuple(moments), tuple(fields))
    if len(scalars) == 1:
        return summed._replace(values=found)
    assert layout.bins is not None and len(found) == declared.step
    finite, numbers = np.isfinite(found), layout.bins.of(found)
    whole = bool(finite.all())
    return summed._replace(
        numbers=packed(numbers) if whole else numbers,
        finite=None if whole else finite,
        step=step_results(found, declared.coverage, declared.kind),
    )


def _field_block(
    field: Field, values: Float[np.ndarray, "n size"], bins: Bins | None
) -> FieldBlock:
    finite = np.isfinite(values).all(1)
    good = values if finite.all() else values[finite]
    found = FieldBlock(len(values) - len(good), block_spread(good) if len(good) else None)
    if not field.quantiles:
        return found
    if bins is None:
        return found._replace(values=good)
    return found._replace(numbers=packed(bins.of(good)))


def _sketch_arrays(sketch: Sketch) -> dict[str, np.ndarray]:
    return {"centre": sketch.centre, "scale": sketch.scale, "counts": sketch.counts}


def _prefixed(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{prefix}.{name}": value for name, value in arrays.items()}


def _part(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    start = f"{prefix}."
    return {n.removeprefix(start): v for n, v in arrays.items() if n.startswith(start)}
