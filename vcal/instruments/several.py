"""Several data sets of one machine, each with its own instrument, as one instrument."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..effects.base import Effect
from ..effects.clock import CLOCKS
from ..effects.data_set import OfDataSet, SharedByDataSets
from ..machine.chain import Chain
from ..machine.plan import Plan, joined, of_set
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from .base import Instrument, Ports, TableInstrument


class DataSet(NamedTuple):
    """One of several data sets, as `several` joins them."""

    instrument: TableInstrument
    plan: Plan
    tool: Sequence[float] = (0.0, 0.0, 0.0)
    """Tool point of this instrument relative to that of the chain, in the last axis's frame, m."""
    shared: str = ""
    """Name of the tool that it shares with other data sets; empty for a tool of its own."""


class Several(Instrument):
    """The rows of all data sets one after the other, each with the readings of its own instrument.

    A row has the readings of its instrument first; the rest, up to the largest number of readings,
    is zero for all parameters and has no weight (`present`). Ports are those of the members with
    the names of their data sets in front (`vcal.machine.plan.of_set`), and so are their effects
    (`vcal.effects.data_set`).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    instruments: tuple[TableInstrument, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)
    """Rows of every data set."""
    tools: np.ndarray
    """Tool point of every data set relative to that of the chain, in the last axis's frame (sets,
    3), m.
    """
    shared: tuple[str, ...] = eqx.field(static=True, default=())
    """Name of the tool that every data set shares with others; empty for a tool of its own."""

    def as_declared(self) -> Self:
        own = tuple(member.as_declared() for member in self.instruments)
        return dataclasses.replace(self, instruments=own)

    @property
    def members(self) -> Mapping[str, Instrument]:
        return dict(zip(self.names, self.instruments, strict=True))

    @property
    def ports(self) -> tuple[str, ...]:
        return tuple(of_set(k, port) for k, m in self.members.items() for port in m.ports)

    @property
    def readings(self) -> tuple[str, ...]:
        return tuple(f"reading {i + 1}" for i in range(self._width))

    @property
    def _width(self) -> int:
        return max(len(member.readings) for member in self.instruments)

    @property
    def _slices(self) -> list[slice]:
        ends = [0, *accumulate(self.sizes)]
        return [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]

    def _each(self, plan: Plan):
        """(member, its plan, its rows, its readings) one after the other.

        Rows are selected by their number, so that the plan may be traced.
        """
        for name, member, rows in zip(self.names, self.instruments, self._slices, strict=True):
            yield member, plan.of(name).take(rows), rows, slice(0, len(member.readings))

    def _table(self, plan: Plan, values: Callable[[Instrument, Plan, Any], Any], readings=None):
        """A table of every member's readings (n_k, m_k), one below the other, zero elsewhere."""
        found = np.zeros((plan.rows, self._width))
        for member, part, rows, columns in self._each(plan):
            own = None if readings is None else np.asarray(readings)[rows, columns]
            found[rows, columns] = values(member, part, own)
        return found

    def padded(self, tables: Sequence[np.ndarray]) -> np.ndarray:
        """Readings (n, m) from those of every data set (n_k, m_k)."""
        found = np.zeros((sum(self.sizes), self._width))
        for values, rows in zip(tables, self._slices, strict=True):
            found[rows, : values.shape[1]] = values
        return found

    def rows(self, plan: Plan) -> Any:
        total = sum(self.sizes)

        def spread(values: Any, rows: slice) -> Any:
            # Rows of other data sets get the first row, so that all numbers are defined.
            values = jnp.asarray(values)
            place = np.clip(np.arange(total) - (rows.start or 0), 0, len(values) - 1)
            return values[place]

        own = tuple(
            jax.tree.map(lambda v, rows=rows: spread(v, rows), member.rows(part))
            for member, part, rows, _ in self._each(plan)
        )
        place = np.repeat(np.arange(len(self.names)), self.sizes)
        return place, self.tools[place], own

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        place, offset, own = row
        tool = tool + rotation @ Vector.of(offset)
        found: list[Scalar] = [0.0] * self._width
        for k, (name, member) in enumerate(self.members.items()):
            prefix = of_set(name, "")
            mine = {g.removeprefix(prefix): v for g, v in ports.items() if g.startswith(prefix)}
            read = member.observe(own[k], rotation, tool, mine)
            for i, value in enumerate(read):
                found[i] = jnp.where(place == k, value, found[i])
        return found

    def reduce(self, values: Array, plan: Plan) -> Array:
        blocks = []
        for member, part, rows, columns in self._each(plan):
            block = member.reduce(values[rows, columns], part)
            missing = self._width - block.shape[1]
            blocks.append(jnp.pad(block, [(0, 0), (0, missing), *[(0, 0)] * (block.ndim - 2)]))
        return jnp.concatenate(blocks)

    def difference(self, measured: Array, predicted: Array) -> Array:
        blocks = []
        for member, rows in zip(self.instruments, self._slices, strict=True):
            m = len(member.readings)
            block = member.difference(measured[rows, :m], predicted[rows, :m])
            blocks.append(jnp.pad(block, ((0, 0), (0, self._width - m))))
        return jnp.concatenate(blocks)

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        recorded, readings = plan, np.zeros((plan.rows, self._width))
        each = zip(self.names, self._each(plan), strict=True)
        for name, (member, part, rows, columns) in each:

            def mine(at: Plan, name=name, rows=rows, columns=columns) -> np.ndarray:
                return np.asarray(ideal(_replaced(plan, name, rows, at)))[rows, columns]

            found, read = member.record(part, mine, np.asarray(noise)[rows, columns])
            recorded, readings[rows, columns] = _replaced(recorded, name, rows, found), read
        return recorded, readings

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return self._table(plan, lambda m, part, own: m.noise(part, own), readings)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return self._table(plan, lambda m, part, own: m.lengths(part, own), readings)

    def present(self, plan: Plan) -> np.ndarray:
        return self._table(plan, lambda m, part, own: m.present(part)) > 0

    def dimensions(self, plan: Plan) -> np.ndarray:
        return np.concatenate([m.dimensions(part) for m, part, *_ in self._each(plan)])

    @property
    def temperature_offset_K(self) -> float:
        # Common columns are written with an offset only where it is the same for all data sets.
        all_of_them = {member.temperature_offset_K for member in self.instruments}
        return all_of_them.pop() if len(all_of_them) == 1 else 0.0

    def clusters(self, plan: Plan) -> np.ndarray:
        return _numbered([m.clusters(part) for m, part, *_ in self._each(plan)])

    def folds(self, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
        found = [member.folds(part) for member, part, *_ in self._each(plan)]
        apart = [np.broadcast_to(a, len(index)) for index, a in found]
        return _numbered([index for index, _ in found]), np.concatenate(apart)

    def start(self, chain: Chain, plan: Plan, readings: np.ndarray) -> Self:
        begun = []
        for (member, part, rows, columns), tool in zip(self._each(plan), self.tools, strict=True):
            own = with_tool(chain, tool)
            begun.append(member.start(own, part, np.asarray(readings)[rows, columns]))
        return eqx.tree_at(lambda s: s.instruments, self, tuple(begun))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        found: list[Effect] = []
        together: dict[tuple[str, str], dict[str, Effect]] = {}
        tools = self.shared or ("",) * len(self.names)
        for name, tool, (member, part, *_) in zip(self.names, tools, self._each(plan), strict=True):
            for effect in member.effects(part):
                if tool and effect.name in member.on_tool:
                    together.setdefault((tool, effect.name), {})[name] = effect
                else:
                    found.append(OfDataSet.of(effect, name))
        return (*found, *(SharedByDataSets.of(e, tool) for (tool, _), e in together.items()))


def _replaced(plan: Plan, name: str, rows: slice, part: Plan) -> Plan:
    """A plan with positions and covariates of the rows of one data set from a plan of these."""
    position = np.array(plan.position)
    position[rows] = part.position
    covariates = dict(plan.covariates)
    for key, values in part.covariates.items():
        own = key if key in plan.covariates else of_set(name, key)
        column = np.array(covariates.get(own, np.full(plan.rows, np.nan)))
        column[rows] = values
        covariates[own] = column
    return Plan(plan.axes, position, covariates, plan.groups, plan.sets, plan.numbers)


def with_tool(chain: Chain, offset: Sequence[float] | np.ndarray) -> Chain:
    """The chain with its tool point moved by `offset` (m) in the last axis's frame."""
    moved = np.asarray(chain.tool_offset) + np.asarray(offset, float)
    return eqx.tree_at(lambda c: c.tool_offset, chain, moved)


def several(sets: Mapping[str, DataSet]) -> tuple[Several, Plan]:
    """Data sets by name, each with its instrument and the plan from it, joined into one.

    A time that starts from zero in every data set is not common to the machine: it is shared only
    where the data sets follow each other on it (`CLOCKS`). `Several.padded` joins the readings.
    Raises `ValueError` where there are no data sets, or the plans have different axes.
    """
    plans = {name: one.plan for name, one in sets.items()}
    unshared = [clock for clock in CLOCKS if not one_clock(plans, clock)]
    own = {name: (*one.instrument.derived, *unshared) for name, one in sets.items()}
    plan = joined(plans, own)
    instrument = Several(
        names=tuple(sets),
        instruments=tuple(one.instrument for one in sets.values()),
        sizes=tuple(one.plan.rows for one in sets.values()),
        tools=np.array([one.tool for one in sets.values()], float),
        shared=tuple(one.shared for one in sets.values()),
    )
    return instrument, plan


def one_clock(plans: Mapping[str, Plan], clock: str = "t") -> bool:
    """Whether the data sets follow each other in time, so that they can share one clock.

    A machine is at one position at a time: where the times of two data sets overlap, each has a
    clock of its own.
    """
    spans = [
        (float(np.min(values)), float(np.max(values)))
        for values in (plan.covariates.get(clock) for plan in plans.values())
        if values is not None
    ]
    spans.sort()
    return all(a[1] < b[0] for a, b in zip(spans, spans[1:], strict=False))


def _numbered(indices: Sequence[np.ndarray]) -> np.ndarray:
    """Indices of all data sets, numbered consecutively; -1 remains."""
    found, start = [], 0
    for index in indices:
        found.append(np.where(index >= 0, index + start, -1))
        start += int(index.max(initial=-1)) + 1
    return np.concatenate(found)
