"""A machine as a measurement has identified it, without the measurement.

    displacement = p(q + E(q, s)) - p(q)

with the commanded positions q, the conditions s (direction of approach, temperatures, load, time)
and the identified errors E; error = actual - nominal, in the frame of the workpiece.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, along
from ..effects.geometric import GeometricErrors
from ..errors import StudyError
from ..geometry.error_motions import ErrorMotionTable, line_of
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import PortLayout
from ..model.forward import tool_points, tool_points_with_jacobian
from ..units import si_factor
from .parts import GEOMETRY, Kind, Part, in_order, part_names, part_of

if TYPE_CHECKING:
    from ..identification.fit import Fit
    from ..identification.model_averaging import Alternatives

_BLOCK = 256
"""Default number of rows that are evaluated together: one program is compiled for a chain, whatever
the points."""
_MANY = 2048
"""Rows above which a function without derivatives is compiled, for as many rows at a time."""
_NODES = 41
_STEPS = 2
"""Iterations of a correction; each leaves the 1e-4 th part of what the one before has left."""
_STILL = ("v_", "a_", "j_", "jerk_", "snap_")
"""Beginnings of the names of covariates that are zero at rest."""
_TIMES = ("t", "t_run", "order")
"""Covariates that count time from the start of the measurement."""
_SINCE = "since_"
_DIR = "dir_"


class _Column(NamedTuple):
    """Response of one port to one amplitude."""

    part: str
    kind: Kind
    port: int
    parameter: int
    declared: Parameter
    values: Float[np.ndarray, " n"]
    """Per SI unit of the amplitude."""
    needs: tuple[str, ...]


@dataclass(frozen=True)
class Range:
    """Values of a covariate in the measurement, SI (temperatures: degC)."""

    low: float
    mean: float
    high: float


@dataclass(frozen=True)
class Rival:
    """Models that compete with one effect: each with its probability, as the difference of its
    errors from those of the identified machine (`Alternatives`).
    """

    found: "IdentifiedMachine"
    others: tuple[tuple[float, "IdentifiedMachine"], ...]
    averaged: bool = False
    """Whether the average of the models is predicted instead of the chosen one."""

    def changes(self, plan: Plan) -> list[tuple[float, np.ndarray]]:
        """Probability, and change of the tool points (n, 3), m, of every other model."""
        named = self.found.whole.tool_points(plan)
        return [(p, other.whole.tool_points(plan) - named) for p, other in self.others]


@dataclass(frozen=True)
class IdentifiedMachine:
    """A chain with identified effects: values, covariance and what the readings know.

    Arrays over parameters (k,) hold the amplitudes of all `effects`, then the shape parameters that
    were fitted, in solver units (prior standard deviation or scale; `Fit.theta`).
    """

    chain: Chain
    effects: tuple[Effect, ...]
    """Systematic effects of the machine; those of instruments are not among them."""
    theta: Float[np.ndarray, " k"] = field(repr=False)
    shapes: tuple[Mapping[str, float], ...]
    """Shape parameters (SI) of every effect."""
    shape_steps: tuple[float, ...]
    """Solver unit of every fitted shape parameter, SI."""
    covariance: Float[np.ndarray, "k k"] = field(repr=False)
    """Stated posterior covariance (`Fit.covariance`)."""
    planned: Float[np.ndarray, "k k"] = field(repr=False)
    """`Fit.planned_covariance`, from which shares of information follow."""
    prior: Float[np.ndarray, " k"] = field(repr=False)
    """Prior variances; infinite for a flat prior."""
    ranges: Mapping[str, Range] = field(default_factory=dict)
    """Conditions in the measurement, of every covariate that an effect needs."""
    volume: Float[np.ndarray, "axes 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """Working volume, m or rad: the travels, or the measured range where none is declared."""
    random: tuple[Effect, ...] = ()
    """Effects with an independent draw at every approach (`repeatability`): never compensated."""
    rivals: tuple[Rival, ...] = field(default=(), repr=False)
    check: Plan | None = field(default=None, repr=False)
    """Positions and conditions of the check points, if there are any."""
    temperature_offset_K: float = 0.0  # noqa: N815
    """What is subtracted from the temperature of a sensor, `Instrument.temperature_offset_K`."""
    instrument_ports: tuple[str, ...] = field(default=(), repr=False)
    name: str = ""
    date: str = ""
    """When the report was made."""
    no_gain: str = ""
    """A sentence where compensation does not reduce the error; else empty."""
    about: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, repr=False)
    """What the study states of the machine, its tolerance, the measurement and the certificate:
    keys by table of the study file (``machine``, ``acceptance``, ``measurement``, ``certificate``).
    """
    block: int = field(default=_BLOCK, repr=False, compare=False)
    """Rows that are evaluated together; a number that is compiled already costs nothing."""
    only: frozenset[str] | None = None
    """Names of the parts that make up the displacement; None: all that are identified."""

    # --- from a fit -------------------------------------------------------------------------------
    @classmethod
    def of_fit(
        cls,
        fit: "Fit",
        *,
        alternatives: "Sequence[Alternatives]" = (),
        check: Plan | None = None,
        name: str = "",
        date: str = "",
        no_gain: str = "",
        about: Mapping[str, Mapping[str, Any]] | None = None,
        block: int = _BLOCK,
    ) -> "IdentifiedMachine":
        """The machine of a fit: effects of the instrument are marginalised.

        `alternatives` are the models that compete with its effects.
        """

        def bare_of(one: "Fit") -> "IdentifiedMachine":
            return replace(_bare(one), block=block)

        rivals = tuple(
            Rival(
                bare_of(one.found),
                tuple((p, bare_of(other)) for p, other in one.others),
                one.averaged,
            )
            for one in alternatives
            if one.others
        )
        bare = bare_of(fit)
        places = _places(fit)
        own = np.ix_(places, places)
        precision = np.asarray(fit.within_scans, float)[places]
        flat = precision <= 0.0
        ranges = dict(bare.ranges)
        for rival in rivals:
            for _, other in rival.others:
                ranges = {**other.ranges, **ranges}
        return replace(
            bare,
            ranges=ranges,
            covariance=fit.covariance[own],
            planned=fit.planned_covariance[own],
            prior=np.where(flat, math.inf, 1.0 / np.where(flat, 1.0, precision)),
            rivals=rivals,
            check=check,
            name=name,
            date=date,
            no_gain=no_gain,
            about=about or {},
        )

    # --- conditions -------------------------------------------------------------------------------
    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes, in the order of the columns of positions."""
        return self.chain.axes

    def at_rest(self, name: str) -> float:
        """The value of a covariate that a table without it is made for: speeds and accelerations
        are zero, the last reversal is far away, everything else has its mean in the measurement.
        """
        if name.startswith((_DIR, *_STILL)):
            return 0.0
        return self.ranges[name].high if name.startswith(_SINCE) else self.ranges[name].mean

    @cached_property
    def varying(self) -> tuple[str, ...]:
        """Covariates that a control may know and on which the displacement depends: directions
        (``"dir_X"``), temperatures, load; neither time, nor speeds, nor ways since a reversal.
        """
        kept = [p for p in self.parts if p.name in self.shown]
        needs = dict.fromkeys(n for p in kept for n in p.needs)
        still = (*_STILL, _SINCE)
        return tuple(
            n for n in needs if n not in self.axes and n not in _TIMES and not n.startswith(still)
        )

    def plan(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"] | None = None,
        covariates: Mapping[str, Float[np.ndarray, " n"] | float] | None = None,
    ) -> Plan:
        """Positions (n, axes), m or rad, with all conditions that an effect needs.

        `directions` (n, axes) are +1 or -1; by default 0, the mean of both. Covariates that are not
        given have their value `at_rest`.
        """
        position = np.asarray(position, float)
        rows = len(position)
        found = {name: np.full(rows, self.at_rest(name)) for name in self.ranges}
        for i, axis in enumerate(self.axes):
            found[f"{_DIR}{axis}"] = (
                np.zeros(rows) if directions is None else np.asarray(directions, float)[:, i]
            )
            for near in ("commanded_", "read_"):
                if f"{near}{axis}" in self.ranges:
                    found[f"{near}{axis}"] = position[:, i]
        for name, values in (covariates or {}).items():
            found[name] = np.broadcast_to(np.asarray(values, float), (rows,))
        return Plan(self.axes, position, found)

    # --- parts ------------------------------------------------------------------------------------
    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Everything that the model of the machine contains, with its share of information."""
        lines = self.lines(_NODES)
        blocks: dict[str, np.ndarray] = {}
        about: dict[str, tuple[Kind, str, tuple[str, ...]]] = {}
        declared = set()
        # In one direction: an effect of the direction is nothing at the mean of both.
        plan = self.plan(lines, np.ones_like(lines), self._extreme)
        for one in self._columns(plan, everything=True):
            rows = blocks.setdefault(one.part, np.zeros((_NODES, len(self.theta))))
            rows[:, one.parameter] += one.values * one.declared.step
            unit = one.declared.unit
            if one.kind != "effect":
                unit = "um" if one.part[1] in "XYZ" else "urad"
            about[one.part] = (one.kind, unit, one.needs)
            if one.declared.mean and np.any(one.values):
                declared.add(one.part)
        for own, effect, shape in self._named:
            needs = effect.needs_at(shape)
            if not plan.has(*needs):
                about[own] = ("effect", effect.amplitudes[0].unit, tuple(needs))
        found = []
        for name in in_order(about, self.axes):
            share = self.information(blocks[name]).max() if name in blocks else 0.0
            found.append(Part(name, *about[name], float(share), name in declared))
        return tuple(found)

    def lines(self, nodes: int) -> Float[np.ndarray, "nodes axes"]:
        """Positions of every axis over its travel."""
        return np.linspace(self.volume[:, 0], self.volume[:, 1], nodes)

    @property
    def _extreme(self) -> dict[str, float]:
        """Conditions in which every effect shows: the ends of the measured ranges."""
        return {name: one.high for name, one in self.ranges.items()}

    @cached_property
    def shown(self) -> frozenset[str]:
        """Names of the parts that make up the displacement."""
        if self.only is not None:
            return self.only
        return frozenset(p.name for p in self.parts if p.identified)

    def restricted(self, names: Collection[str]) -> "IdentifiedMachine":
        """The machine with these parts only."""
        found = replace(self, only=frozenset(names), rivals=())
        found.__dict__["parts"] = self.parts  # they do not depend on what is shown
        return found

    @property
    def whole(self) -> "IdentifiedMachine":
        """The machine with all parts, also those that are not identified."""
        return replace(self, only=frozenset(p.name for p in self.parts))

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Names of the parts of which the readings know nothing."""
        return tuple(p.name for p in self.parts if not p.identified)

    def information(self, block: np.ndarray) -> np.ndarray:
        """Share of information of F theta for the rows of F (q, k); one for a flat prior, and for a
        known value that is not zero.
        """
        used = np.abs(block).max(0, initial=0.0) > 0.0
        planned = ((block @ self.planned) * block).sum(1)
        flat = used & ~np.isfinite(self.prior)
        prior = block**2 @ np.where(np.isfinite(self.prior), self.prior, 0.0)
        found = 1.0 - planned / np.where(prior > 0.0, prior, np.inf)
        found = np.where(prior > 0.0, np.clip(found, 0.0, 1.0), 0.0)
        return np.ones(len(block)) if flat.any() else found

    # --- displacement -----------------------------------------------------------------------------
    @cached_property
    def layout(self) -> PortLayout:
        """Ports of the chain and the tool, and those of the instrument, which move nothing."""
        return PortLayout.of(self.axes, self.instrument_ports)

    @cached_property
    def _named(self) -> list[tuple[str, Effect, Mapping[str, Any]]]:
        """Name as a part, effect, and shape parameters of every effect."""
        names = part_names(self.effects)
        return list(zip(names, self.effects, self.shapes, strict=True))

    @cached_property
    def _sized(self) -> list[tuple[Effect, dict[str, float]]]:
        """Every effect with its amplitudes, SI, by their names."""
        found, theta = [], iter(self.theta.tolist())
        for effect in self.effects:
            sizes = {p.name: p.mean * p.si + next(theta) * p.step for p in effect.amplitudes}
            found.append((effect, sizes))
        return found

    def _columns(
        self, plan: Plan, everything: bool = False, geometry: bool = True
    ) -> Iterator[_Column]:
        """Responses of the effects that can be evaluated, of the parts that are shown or of all;
        without `geometry`, those of `GeometricErrors` are left out.
        """
        start = 0
        for own, effect, shape in self._named:
            amplitudes = {p.name: (start + i, p) for i, p in enumerate(effect.amplitudes)}
            start += len(amplitudes)
            needs = effect.needs_at(shape)
            if not plan.has(*needs):
                continue
            if not (everything or isinstance(effect, GEOMETRY) or own in self.shown):
                continue
            if not geometry and isinstance(effect, GeometricErrors):
                continue
            for (port, name), values in effect.response(plan, shape).items():
                part, kind = part_of(effect, own, port, name)
                if everything or part in self.shown:
                    column = np.broadcast_to(np.asarray(values, float), (plan.rows,))
                    asked = tuple(needs) if kind == "effect" else ()
                    place = self.layout.index(port)
                    yield _Column(part, kind, place, *amplitudes[name], column, asked)

    def _ports(self, plan: Plan) -> tuple[np.ndarray, list[tuple[int, int, np.ndarray]]]:
        """Values of the ports (n, p), and their derivatives: port, parameter, values (n,)."""
        ports = np.zeros((plan.rows, len(self.layout)))
        slopes = []
        for one in self._columns(plan):
            p, k = one.declared, one.parameter
            ports[:, one.port] += one.values * (p.mean * p.si + self.theta[k] * p.step)
            slopes.append((one.port, k, one.values * p.step))
        return ports, [*slopes, *self._shape_slopes(plan)]

    def _shape_slopes(self, plan: Plan) -> Iterator[tuple[int, int, np.ndarray]]:
        """Derivatives of the ports by the fitted shape parameters, by central differences over the
        1e-4 th part of a step of their scan.
        """
        k = first = sum(len(effect.amplitudes) for effect in self.effects)
        for (own, effect, shape), (_, sizes) in zip(self._named, self._sized, strict=True):
            for p in (p for p in effect.shapes if p.moves):
                step = self.shape_steps[k - first]
                if plan.has(*effect.needs_at(shape)) and own in self.shown:
                    short = 1e-4 * step
                    above, below = (
                        effect.response(plan, {**shape, p.name: shape[p.name] + change})
                        for change in (short, -short)
                    )
                    for (port, name), value in above.items():
                        slope = (np.asarray(value) - np.asarray(below[port, name])) / (2.0 * short)
                        slope = np.broadcast_to(slope * sizes[name] * step, (plan.rows,))
                        yield self.layout.index(port), k, slope
                k += 1

    def tool_points(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        """Actual tool points in the frame of the workpiece, m; of `rivals` that are averaged, the
        average.
        """
        return self._points(plan) + self._averages(plan)

    def _averages(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        found = np.zeros((plan.rows, 3))
        for rival in self.rivals:
            if rival.averaged:
                found = found + sum(p * change for p, change in rival.changes(plan))
        return found

    def nominal(self, position: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n 3"]:
        """Nominal tool points at commanded positions, m."""
        position = np.asarray(position, float)
        if len(position) <= _MANY or not self.chain.linear:
            return self.chain.tool_point(position)
        # No axis turns: the tool point is a linear function of the positions.
        origin, *ends = self.chain.tool_point(np.eye(1 + len(self.axes), len(self.axes), -1))
        return origin + position @ (np.array(ends) - origin)

    def displacement(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        """Displacement of the tool point, actual - nominal, in the frame of the workpiece, m."""
        return self.tool_points(plan) - self.nominal(np.asarray(plan.position))

    def derivative(self, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
        """Actual tool points (n, 3), m, and their derivative (n, 3, k) per solver unit."""
        ports, slopes = self._ports(plan)
        points, by_port = self._evaluated(plan, ports)
        found = np.zeros((plan.rows, 3, len(self.theta)))
        for port, k, values in slopes:
            found[:, :, k] += by_port[:, :, port] * values[:, None]
        return points + self._averages(plan), found

    def uncertainty(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        """Standard uncertainty of the displacement, m, with the between-model variance of `rivals`
        (law of total variance).
        """
        _, slopes = self.derivative(plan)
        variance = np.einsum("nik,kl,nil->ni", slopes, self.covariance, slopes, optimize=True)
        for rival in self.rivals:
            changes = rival.changes(plan)
            between = sum(p * change**2 for p, change in changes)
            mean = sum(p * change for p, change in changes) if rival.averaged else 0.0
            variance = variance + between - np.square(mean)
        return np.sqrt(np.maximum(variance, 0.0))

    def scatter(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        """Standard deviation of the tool point by the `random` effects, m."""
        variance = np.zeros((plan.rows, 3))
        known = [e for e in self.random if plan.has(*e.needs_at({}))]
        if known:
            _, by_port = self._evaluated(plan, self._ports(plan)[0])
            for effect in known:
                # Its standard deviation is declared as its value, or is that of its prior.
                sigma = {p.name: (p.mean or p.sigma) * p.si for p in effect.amplitudes}
                for (port, name), values in effect.response(plan, {}).items():
                    column = np.broadcast_to(np.asarray(values, float), (plan.rows,)) * sigma[name]
                    moved = by_port[:, :, self.layout.index(port)] * column[:, None]
                    variance += moved**2
        return np.sqrt(variance)

    def _points(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        """Tool points without averages: of a program with its many rows by a function without
        derivatives, of few rows by the one that everything else compiles.
        """
        if plan.rows <= _MANY:
            return self._evaluated(plan, self._ports(plan)[0])[0]
        ports = np.zeros((len(self.layout), plan.rows))
        for one in self._columns(plan, geometry=False):
            p = one.declared
            ports[one.port] += one.values * (p.mean * p.si + self.theta[one.parameter] * p.step)
        for effect, sizes in self._sized:
            if isinstance(effect, GeometricErrors):
                for port, values in effect.errors(plan, sizes, self.shown).items():
                    ports[self.layout.index(port)] += values
        position = np.asarray(plan.position)
        points = []
        for first in range(0, plan.rows, _MANY):
            rows = np.minimum(np.arange(first, first + _MANY), plan.rows - 1)
            points.append(np.asarray(tool_points(self.chain, position[rows], ports[:, rows].T)))
        return np.concatenate(points)[: plan.rows]

    def _evaluated(self, plan: Plan, ports: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tool points and their derivatives by the ports, in blocks of one size."""
        position = np.asarray(plan.position)
        points, slopes = [], []
        for first in range(0, plan.rows, self.block):
            rows = np.minimum(np.arange(first, first + self.block), plan.rows - 1)
            found, by_port = tool_points_with_jacobian(self.chain, position[rows], ports[rows])
            points.append(np.asarray(found))
            slopes.append(np.asarray(by_port))
        return np.concatenate(points)[: plan.rows], np.concatenate(slopes)[: plan.rows]

    # --- what tables are made from ----------------------------------------------------------------
    def correction(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"] | None = None,
        covariates: Mapping[str, Float[np.ndarray, " n"] | float] | None = None,
    ) -> Float[np.ndarray, "n axes"]:
        """What is added to the commands (n, axes), m, so that the actual tool point is the nominal
        one: p(q + c + E(q + c)) = p(q). Rotary axes are not moved.

        Raises `StudyError` for an arm, and for a machine without linear axes X, Y or Z.
        """
        linear = self.linear
        position = np.asarray(position, float)
        wanted = self.nominal(position)
        moved = np.stack([self.nominal(position + _unit(self, i)) - wanted for i in linear], 2)
        inverse = np.linalg.pinv(moved)
        found = np.zeros_like(position)
        for _ in range(_STEPS):
            plan = self.plan(position + found, directions, covariates)
            error = self.tool_points(plan) - wanted
            found[:, linear] -= np.einsum("nij,nj->ni", inverse, error)
        return found

    @property
    def linear(self) -> list[int]:
        """Columns of the linear axes X, Y and Z. Raises `StudyError` as `correction` does."""
        found = [i for i, axis in enumerate(self.axes) if axis in ("X", "Y", "Z")]
        if self.chain.arm or not found:
            what = "an arm" if self.chain.arm else "no linear axis"
            raise StudyError(
                f"machine {self.chain.text!r}: found {what}, expected a machine tool with linear "
                "axes X, Y or Z; for an arm, use the corrected rows in kinematics.csv of the report"
            )
        return found

    def positioning(
        self,
        axis: str,
        position: Float[np.ndarray, " n"],
        direction: float,
        covariates: Mapping[str, float] | None = None,
    ) -> Float[np.ndarray, " n"]:
        """Positioning error of one axis along (or about) itself, m or rad: EXX of X with backlash,
        screw and scale errors, at positions of this axis approached in one direction (+1, -1, or 0
        for the mean of both). Actual - nominal, in the direction of the command.
        """
        i = self.axes.index(axis)
        q = np.repeat(self.volume.mean(1)[None], len(position), 0)
        q[:, i] = position
        directions = np.zeros_like(q)
        directions[:, i] = direction
        port, _ = along(self.chain, axis)
        values = self._ports(self.plan(q, directions, covariates))[0][:, self.layout.index(port)]
        return self.chain.joint(axis).sign * values

    def line_correction(
        self,
        axis: str,
        position: Float[np.ndarray, " n"],
        direction: float,
        covariates: Mapping[str, float] | None = None,
        others: int = 5,
    ) -> Float[np.ndarray, " n"]:
        """The best correction (n,), m, that depends on the position of one axis only: the mean of
        `correction` over `others` positions of each other axis in the working volume. With it, the
        mean square displacement over the volume is least.
        """
        i = self.axes.index(axis)
        travels = (self.volume[j] for j in range(len(self.axes)) if j != i)
        lines = [_middles(low, high, others) for low, high in travels]
        rest = np.stack([v.ravel() for v in np.meshgrid(*lines, indexing="ij")], 1)
        q = np.repeat(np.insert(rest, i, 0.0, axis=1)[None], len(position), 0)
        q[:, :, i] = np.asarray(position)[:, None]
        directions = np.zeros((q.shape[0] * q.shape[1], len(self.axes)))
        directions[:, i] = direction
        found = self.correction(q.reshape(-1, len(self.axes)), directions, covariates)
        return found[:, i].reshape(q.shape[:2]).mean(1)

    def error_motions(self, nodes: int = _NODES) -> list[ErrorMotionTable]:
        """Error motions and location errors on `nodes` positions over the travels, as in a report;
        those that are not identified are zero, with the uncertainty of their prior.
        """
        lines = self.lines(nodes)
        functions = self.error_functions(lines)
        named = {p.name: p for p in self.parts}
        return [
            self._table(named[name], *functions[name], lines)
            for name in in_order(functions, self.axes)
        ]

    def error_functions(
        self, lines: Float[np.ndarray, "nodes axes"]
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """F (nodes, k) of every error motion E = mean + F theta on these positions of every axis,
        or (1, k) of a location error, and the mean, SI; also of those that are not identified.
        """
        blocks: dict[str, np.ndarray] = {}
        means: dict[str, np.ndarray] = {}
        for one in self._columns(self.plan(lines), everything=True):
            if one.kind == "effect":
                continue
            located, p = one.kind == "location error", one.declared
            column = np.ones(1) if located else one.values
            block = blocks.setdefault(one.part, np.zeros((len(column), len(self.theta))))
            block[:, one.parameter] = column * p.step  # a location error has several ports
            mean = means.setdefault(one.part, np.zeros(len(column)))
            if not located or not mean.any():
                means[one.part] = mean + column * p.mean * p.si
        return {name: (block, means[name]) for name, block in blocks.items()}

    def _table(
        self, part: Part, block: np.ndarray, mean: np.ndarray, lines: np.ndarray
    ) -> ErrorMotionTable:
        located = part.kind == "location error"
        axis = part.name[3:] if located else part.name[2:]
        unit = "deg" if self.chain.joint(axis).turns else "mm"
        si = si_factor(part.unit)
        variance = ((block @ self.covariance) * block).sum(1)
        prior = block**2 @ np.where(np.isfinite(self.prior), self.prior, 0.0)
        i = self.axes.index(axis)
        value = mean + block @ self.theta
        return ErrorMotionTable(
            name=part.name,
            axis=axis,
            unit=part.unit,
            position=np.zeros(0) if located else lines[:, i] / si_factor(unit),
            position_unit=unit,
            value=value / si if part.name in self.shown else np.zeros_like(value),
            u=np.sqrt(np.maximum(variance, 0.0)) / si,
            prior=np.sqrt(prior) / si,
            information=self.information(block),
        )


def _middles(low: float, high: float, count: int) -> np.ndarray:
    """Middles of `count` equal parts of an interval."""
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _unit(machine: IdentifiedMachine, axis: int) -> np.ndarray:
    return np.eye(len(machine.axes))[axis]


def _on_machine(fit: "Fit") -> list[int]:
    return [i for i, effect in enumerate(fit.model.effects) if not effect.on_instrument]


def _places(fit: "Fit") -> np.ndarray:
    """Positions in `Fit.theta` of the amplitudes of the machine, then of its shape parameters."""
    pairs = [fit.places_of(i) for i in _on_machine(fit)]
    empty = np.zeros(0, int)
    return np.concatenate([empty, *(a for a, _ in pairs), *(s for _, s in pairs)])


def _bare(fit: "Fit") -> IdentifiedMachine:
    """The machine of a fit, without covariance."""
    # Imported here: it takes long, and a machine that is read back needs nothing of it.
    from ..identification.fit import shape_step

    model, plan = fit.model, fit.measurement.plan
    mine = _on_machine(fit)
    effects = tuple(model.effects[i] for i in mine)
    shapes = tuple(
        {name: float(value) for name, value in fit.shapes.get(i, {}).items()} for i in mine
    )
    steps = []
    for effect, shape in zip(effects, shapes, strict=True):
        moving = [p for p in effect.shapes if p.moves]
        grids = effect.scan(plan) if moving else {}
        steps += [shape_step(p, shape[p.name], grids) for p in moving]
    random = tuple(e for e in model.random if not e.on_instrument)
    needs = {n for e, s in zip(effects, shapes, strict=True) for n in e.needs_at(s)}
    needs |= {n for e in random for n in e.needs}
    ranges = {}
    for name in sorted(needs & set(plan.covariates)):
        values = np.asarray(plan.covariates[name], float)
        values = values[np.isfinite(values)]
        if len(values) and not name.startswith(_DIR):
            ranges[name] = Range(float(values.min()), float(values.mean()), float(values.max()))
    theta = np.asarray(fit.theta, float)[_places(fit)]
    k = len(theta)
    volume = np.array([line_of(fit, axis, 2) for axis in model.chain.axes])
    return IdentifiedMachine(
        chain=model.chain,
        effects=effects,
        theta=theta,
        shapes=shapes,
        shape_steps=tuple(steps),
        covariance=np.zeros((k, k)),
        planned=np.zeros((k, k)),
        prior=np.full(k, math.inf),
        ranges=ranges,
        volume=volume,
        random=random,
        temperature_offset_K=float(model.instrument.temperature_offset_K),
        instrument_ports=tuple(model.instrument.ports),
    )
