"""The space of a double ball bar: where the ball stands, planes, bars, arcs and senses."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from pydantic import model_validator

from ...bounds import Angle, Coordinate, Seconds, Within
from ...effects.base import Effect
from ...instruments.bar_motion import FEED, MM_MIN, motion
from ...instruments.double_ball_bar import (
    BarCentre,
    BarLength,
    DoubleBallBar,
    SetupLength,
    pairs_of,
    seen_in,
)
from ...machine.plan import Plan
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import DesignSettings, Subject, Varied, path_m, register
from .points import check_bounds
from .setups import LOOSE_M, Block, Own, SetupSpace

Plane = Literal["XY", "YZ", "ZX"]
_PLANES: tuple[Plane, ...] = ("XY", "YZ", "ZX")
_AXES = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
"""First and second axis of every plane, and the one across it."""
_LARGEST: Mapping[Plane, tuple[float, float]] = {
    "XY": (0.0, 360.0),
    "YZ": (-20.0, 200.0),
    "ZX": (-110.0, 110.0),
}
"""Ends of the largest arcs, deg from the first axis towards the second: above a table."""
_KINDS = ("dir", "since", "v", "a")
_PLANE_M = 2e-4
"""Largest distance of a tool point from the plane or the circle of its run."""
_AT = 5e-3
"""Share of the step from row to row within which a row counts as being at a reversal."""
_SAME_MM = 1e-3
_EXCESS_M = 1e-3
"""Excess over the travel that doubles the criterion."""

_Length = Annotated[
    float, Within(1.0, 5000.0, "no ball bar is shorter than 1 mm or longer than 5 m")
]
_Arc = tuple[Angle, Angle]


class DoubleBallBarDesign(DesignSettings):
    """Keys of ``[design]`` for ``kind = "double_ball_bar"``."""

    centres: bool = True
    """Whether the ball on the table may be anywhere from where the travel leaves room for the
    circles."""
    centre_low_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Lowest coordinates of the ball in the workpiece frame, such as the height of the table."""
    centre_high_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Highest coordinates of the ball in the workpiece frame."""
    planes: tuple[Plane, ...] = ()
    """Planes of which every run has one; by default it keeps its own."""
    lengths_mm: tuple[_Length, ...] = ()
    """Lengths of bars of which every set-up has one; by default it keeps its own."""
    arcs: bool = False
    """Whether every run may begin and end elsewhere within the largest arc of its plane."""
    arcs_deg: dict[Plane, _Arc] = {}
    """Ends of the largest arc in every plane, from its first axis towards the second: XY 0 to 360,
    YZ -20 to 200, ZX -110 to 110 by default, which is above a table."""
    shortest_arc_deg: Annotated[
        float, Within(30.0, 360.0, "a shorter arc has no centre, and a longer one is a circle")
    ] = 180.0
    """Least length of an arc."""
    senses: bool = False
    """Whether every run may have either sense."""
    seconds_per_setup: Seconds = 600.0
    """Time to set up the ball on the table, or another bar."""
    seconds_per_run: Seconds = 60.0
    """Time of a run."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if (self.centre_low_mm is None) != (self.centre_high_mm is None):
            check_bounds("centres", "centre", self.centre_low_mm, self.centre_high_mm)
        if self.centre_low_mm is not None:
            check_bounds("centres", "centre", self.centre_low_mm, self.centre_high_mm)
        for plane in _PLANES:
            low, high = self.largest(plane)
            if not self.shortest_arc_deg <= high - low <= 360.0:
                raise ValueError(
                    f"found the largest arc {low:g} to {high:g} deg in {plane}, expected at least "
                    f"shortest_arc_deg = {self.shortest_arc_deg:g} and at most 360; correct "
                    "arcs_deg or shortest_arc_deg"
                )
        return self

    def largest(self, plane: Plane) -> _Arc:
        """Ends of the largest arc in a plane, deg."""
        return self.arcs_deg.get(plane, _LARGEST[plane])


class Runs(NamedTuple):
    """The runs of a plan; angles in rad, from the first axis of the plane towards the second."""

    setup: Int[Array, " r"]
    """Index of the set-up."""
    plane: Int[Array, " r"]
    bar: Int[Array, " r"]
    """Index of the length."""
    sense: Float[Array, " r"]
    """1 from the first axis towards the second, else -1."""
    first: Float[Array, " r"]
    """Lower end of the arc."""
    width: Float[Array, " r"]
    latitude: Float[Array, " r"]
    """Angle of the bar to the plane of a cone; zero for circles about the ball."""


class Placed(NamedTuple):
    """Rows with conditions, the position of every ball, the bar of every row, and the fit."""

    position: Float[Array, "n axes"]
    covariates: Mapping[str, Float[Array, " n"]]
    place: Float[Array, "s 3"]
    """Nominal position of the ball in the frame of the workpiece, m."""
    bar: Int[Array, " n"]
    excess: Float[Array, ""]
    """Length by which a circle exceeds the travel, or a ball its bounds, m."""


@register
@dataclass(frozen=True)
class DoubleBallBarSpace(SetupSpace):
    """Positions of the ball, and for every run its plane, bar, arc and sense.

    The number of runs in every set-up, their rows and feeds are those of the plan, and so is the
    latitude of a cone. Positions are shares of the room that the travel leaves for the circles of a
    set-up. Planes, bars and senses are choices; all other numbers are continuous.
    """

    kind = "double_ball_bar"
    Settings = DoubleBallBarDesign
    planned = ("length_mm", FEED, "ball_x_mm", "ball_y_mm", "ball_z_mm")
    lacking = (
        "room for the circles; allow shorter bars (design.lengths_mm), or move the bounds "
        "(design.centre_low_mm, design.centre_high_mm)"
    )

    run: Int[np.ndarray, " n"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    """Index of the run of every row."""
    run_numbers: tuple[int, ...] = ()
    share: Float[np.ndarray, " n"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    """Share of the arc at which a row is, in the order of travel."""
    runs: Runs = Runs(*[np.zeros(0, int)] * 3, *[np.zeros(0)] * 4)
    place: Float[np.ndarray, "s 3"] = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Present positions of the ball in the frame of the workpiece, m."""
    lengths: Float[np.ndarray, " b"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    """All lengths of bars, m, ascending."""
    choice: Int[np.ndarray, " c"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    """Planes to choose from."""
    feed: Float[np.ndarray, " n"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    """Feed along the path, m/s; zero where it is unknown."""
    resting: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Recorded directions of axes at rest (n,), which do not follow from the positions."""
    present: Plan | None = None
    """The present plan, whose recorded directions count as they are."""

    # --- construction ---------------------------------------------------------------------------
    @classmethod
    def of(cls, subject: Subject, model: Model, settings: DoubleBallBarDesign) -> Self:
        chain, device, plan = subject.chain, subject.instrument, subject.plan
        assert isinstance(device, DoubleBallBar)
        if not np.isfinite(chain.travel).all():
            raise subject.refusal(
                "centres", "a machine without travel_mm", "the travel of X, Y and Z", "declare it"
            )
        lengths = _lengths(subject, device, settings)
        run_numbers, run = np.unique(np.asarray(plan.groups["run"]), return_inverse=True)
        setup = np.searchsorted(device.setups, np.asarray(plan.groups["setup"]))
        present = 1e-3 * np.array(device.lengths_mm)[np.asarray(plan.groups["bar"])]
        bar = np.argmin(np.abs(present[:, None] - lengths), axis=1)
        runs, share = _runs(subject, device, run.ravel(), setup, bar)
        choice = _choice(subject, settings, runs, run_numbers)
        if settings.lengths_mm:
            _check_one_bar(subject, device, runs)
        follows = {f"{kind}_{axis}" for kind in _KINDS for axis in chain.axes}
        derived = motion(chain, plan)
        resting = {
            name: np.where(derived.get(name, 0.0) == 0.0, np.asarray(values), 0.0)
            for name, values in plan.covariates.items()
            if name in follows and name.startswith("dir_")
        }
        return cls(
            chain=chain,
            device=device,
            settings=settings,
            position=np.asarray(plan.position),
            known={n: np.asarray(v) for n, v in plan.covariates.items() if n not in follows},
            setup=setup,
            numbers=device.setups,
            run=run.ravel(),
            run_numbers=tuple(run_numbers.tolist()),
            share=share,
            runs=runs,
            place=np.asarray(device.centres),
            lengths=lengths,
            choice=choice,
            feed=np.asarray(plan.covariates.get(FEED, np.zeros(plan.rows))) * MM_MIN,
            resting=resting,
            present=plan,
        )

    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        # Every further set-up has the runs of the last one.
        last = len(self.numbers) - 1
        rows, mine = np.flatnonzero(self.setup == last), np.flatnonzero(self.runs.setup == last)
        every, first = np.tile(rows, count), max(self.run_numbers) + 1
        n, r = len(rows), len(mine)
        known = {name: np.full(n * count, values[-1]) for name, values in self.known.items()}
        if FEED in known:
            known[FEED] = self.known[FEED][every]
        runs = Runs(*(np.tile(values[mine], count) for values in self.runs))
        follows = {f"{kind}_{axis}" for kind in _KINDS for axis in self.chain.axes}
        return dataclasses.replace(
            self,
            settings=self.settings.model_copy(update={"centres": True}),
            position=self.position[every],
            known=known,
            setup=np.repeat(np.arange(count), n),
            numbers=tuple((max(self.numbers) + 1 + np.arange(count)).tolist()),
            run=np.searchsorted(mine, self.run[rows])[np.tile(np.arange(n), count)]
            + r * np.repeat(np.arange(count), n),
            run_numbers=tuple((first + np.arange(r * count)).tolist()),
            share=self.share[every],
            runs=runs._replace(setup=np.repeat(np.arange(count), r)),
            place=np.repeat(self.place[-1:], count, axis=0),
            feed=self.feed[every],
            resting={name: values[every] for name, values in self.resting.items()},
            present=None,
            varied=tuple(v for v in varied if v.name not in follows),
            anywhere=True,
        )

    # --- numbers within bounds ------------------------------------------------------------------
    @property
    def blocks(self) -> Mapping[str, Block]:
        s, runs, found = self.settings, self.runs, dict[str, Block]()
        if s.centres:
            with jax.ensure_compile_time_eval():  # a search calls this inside of its program
                low, room = (np.asarray(part) for part in self._room(runs))
            inside = np.where(room > 0.0, room, 1.0)
            share = np.where(room > 0.0, (self.place - low) / inside, 0.5)
            found["centres"] = Block(share)
        if s.arcs:
            found["arcs"] = Block(self._arc_shares())
        if s.planes:
            found["planes"] = Block(
                np.searchsorted(self.choice, runs.plane), 0, len(self.choice) - 1, len(self.choice)
            )
        if s.lengths_mm:
            bars = [runs.bar[runs.setup == k][0] for k in range(len(self.numbers))]
            last = len(self.lengths) - 1
            found["lengths"] = Block(np.array(bars), 0, last, last + 1)
        if s.senses:
            found["senses"] = Block(np.asarray(runs.sense) > 0.0, 0, 1, 2)
        return found

    def _arc_shares(self) -> Float[np.ndarray, "r 2"]:
        """Width and first end of every arc, as shares of what the largest arc of its plane leaves.

        A run that changes its plane keeps them.
        """
        low, most, least = (values[self.runs.plane] for values in self._ends)
        middle = low + 0.5 * most
        turns = np.round((middle - self.runs.first - 0.5 * self.runs.width) / (2.0 * np.pi))
        width = np.clip(self.runs.width, least, most)
        first = self.runs.first + 2.0 * np.pi * turns
        share = np.column_stack(
            [
                (width - least) / np.where(most > least, most - least, 1.0),
                (first - low) / np.where(most > width, most - width, 1.0),
            ]
        )
        return np.clip(share, 0.0, 1.0)

    @property
    def _ends(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Low end, width and least width of the arcs in every plane (3,), rad."""
        low, high = np.deg2rad([self.settings.largest(plane) for plane in _PLANES]).T
        return low, high - low, np.full(3, np.deg2rad(self.settings.shortest_arc_deg))

    # --- the placed measurement -----------------------------------------------------------------
    @property
    def nominal(self) -> Placed:
        covariates = dict(self._placed(self.runs, self.place, {}).covariates)
        if self.present is not None:
            covariates |= dict(self.present.covariates)
        bar = self.runs.bar[self.run]
        return Placed(self.position, covariates, self.place, bar, np.zeros(()))  # type: ignore[arg-type]

    def at(self, values: Mapping[str, Array], conditions: Mapping[str, Array]) -> Placed:
        runs: Any = self.runs
        if "planes" in values:
            runs = runs._replace(plane=jnp.asarray(self.choice)[values["planes"]])
        if "lengths" in values:
            runs = runs._replace(bar=values["lengths"][self.runs.setup])
        if "senses" in values:
            runs = runs._replace(sense=2.0 * values["senses"] - 1.0)
        if self.settings.arcs or self.settings.planes:
            share = jnp.asarray(values.get("arcs", self._arc_shares()))
            low, most, least = (jnp.asarray(v)[runs.plane] for v in self._ends)
            width = least + share[:, 0] * (most - least)
            runs = runs._replace(width=width, first=low + share[:, 1] * (most - width))
        if "centres" not in values:
            return self._placed(runs, jnp.asarray(self.place), conditions)
        low, room = self._room(runs)
        place = jnp.where(room > 0.0, low + values["centres"] * room, low + 0.5 * room)
        return self._placed(runs, place, conditions)

    def _placed(self, runs: Any, place: Array, conditions: Mapping[str, Array]) -> Placed:
        xyz = [self.chain.axes.index(axis) for axis in "XYZ"]
        row = Runs(*(jnp.asarray(values)[self.run] for values in runs))
        turned = jnp.where(row.sense > 0.0, self.share, 1.0 - self.share)
        angle = row.first + turned * row.width
        far = jnp.asarray(self.lengths)[row.bar]
        radius = (far * jnp.cos(row.latitude))[:, None]
        wave, way = self._wave(row.plane, angle)
        across = self._across(row.plane) * (far * jnp.sin(row.latitude))[:, None]
        point = place[self.setup] + radius * wave + across
        position = jnp.asarray(self.position).at[:, np.array(xyz)].set(point - self._offset)
        # A little earlier: a row at a reversal has the direction of its approach.
        step = row.width / np.maximum(np.bincount(self.run) - 1, 1)[self.run]
        before = self._wave(row.plane, angle - row.sense * _AT * step)[1]
        direction = row.sense[:, None] * jnp.sign(before)
        speed = self.feed[:, None]
        parts = {
            "dir": direction,
            "since": radius * (1.0 + direction * wave),
            "v": row.sense[:, None] * speed * way,
            "a": -(speed**2) / radius * wave,
        }
        found = {f"{k}_{c}": v[:, i] for k, v in parts.items() for i, c in enumerate("XYZ")}
        for name, values in self.resting.items():
            found[name] = jnp.where(found[name] == 0.0, values, found[name])
        covariates = {**self.known, **found, **conditions}
        return Placed(position, covariates, place, row.bar, self._excess(runs, place))

    def _wave(self, plane: Array, angle: Array) -> tuple[Array, Array]:
        """Unit vectors (n, 3) from the centre, and along the circle for rising angles."""
        first, second = (jnp.eye(3)[jnp.asarray(_AXES)[plane, i]] for i in (0, 1))
        cosine, sine = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
        return cosine * first + sine * second, cosine * second - sine * first

    def _across(self, plane: Array) -> Array:
        return jnp.eye(3)[jnp.asarray(_AXES)[plane, 2]]

    @property
    def _offset(self) -> np.ndarray:
        """Tool point minus axis positions: constant on a machine of linear axes."""
        return self.chain.tool_point(np.zeros((1, len(self.chain.axes))))[0]

    # --- room in the travel ---------------------------------------------------------------------
    def _extent(self, runs: Any) -> tuple[Array, Array]:
        """Lowest and highest tool point of every set-up (s, 3) relative to its ball.

        An arc reaches half of a step beyond its first and its last row.
        """
        far = jnp.asarray(self.lengths)[runs.bar]
        radius = far * jnp.cos(jnp.asarray(runs.latitude))
        half = 0.5 * runs.width / np.maximum(np.bincount(self.run) - 1, 1)
        ends = runs.first - half, runs.first + runs.width + half
        first, second, across = (jnp.eye(3)[jnp.asarray(_AXES)[runs.plane, i]] for i in (0, 1, 2))
        height = across * (far * jnp.sin(jnp.asarray(runs.latitude)))[:, None]
        reach = [_reach(*ends, at)[:, None] for at in np.pi * np.array([1.0, 1.5, 0.0, 0.5])]
        low = height - radius[:, None] * (first * reach[0] + second * reach[1])
        high = height + radius[:, None] * (first * reach[2] + second * reach[3])
        own = [np.flatnonzero(self.runs.setup == k) for k in range(len(self.numbers))]
        return (
            jnp.stack([low[mine].min(0) for mine in own]),
            jnp.stack([high[mine].max(0) for mine in own]),
        )

    def _room(self, runs: Any) -> tuple[Array, Array]:
        """Lowest position of every ball (s, 3) with all circles inside the travel, and the range
        of its movement, negative where there is no room.
        """
        below, above = self._extent(runs)
        low, high = (self._travel[:, i] - end for i, end in ((0, below), (1, above)))
        s = self.settings
        if s.centre_low_mm is not None and s.centre_high_mm is not None:
            low = jnp.maximum(low, 1e-3 * np.array(s.centre_low_mm))
            high = jnp.minimum(high, 1e-3 * np.array(s.centre_high_mm))
        return low, high - low

    def _excess(self, runs: Any, place: Array) -> Array:
        low, room = self._room(runs)
        beyond = jnp.maximum(low - place, place - low - room)
        return jnp.maximum(beyond, 0.0).max()

    @property
    def _travel(self) -> Float[np.ndarray, "3 2"]:
        """Range of the tool point along X, Y and Z, m."""
        travel = np.stack([self.chain.joint(axis).travel for axis in "XYZ"])
        return travel + self._offset[:, None]

    def excess(self, placed: Placed) -> Float[Array, ""]:
        # Rounding: a circle may touch the end of the travel.
        return jnp.where(placed.excess < 1e-12, 0.0, placed.excess)

    def penalty(self, placed: Placed) -> Float[Array, ""]:
        return 1.0 + (placed.excess / _EXCESS_M) ** 2

    # --- unknowns -------------------------------------------------------------------------------
    @property
    def own(self) -> Own:
        count, flat = len(self.numbers), self.device.length_sigma is None
        seen = tuple((k, c) for k in self.numbers for c in "XYZ")
        effects: tuple[Effect, ...] = (BarCentre(seen=seen),)
        columns = np.arange(3 * count).reshape(count, 3)
        if flat:
            effects += (SetupLength(seen=tuple((k, 0) for k in self.numbers)),)
            columns = np.column_stack([columns, 3 * count + np.arange(count)])
        scale = np.array([float(p.step) for e in effects for p in e.amplitudes])[columns[0]]
        shared: tuple[Effect, ...] = ()
        if self.device.length_sigma:
            mm = tuple((1e3 * self.lengths).tolist())
            shared = (BarLength(lengths_mm=mm, sigma=self.device.length_sigma),)
        return Own(shared, effects, columns, np.diag((scale / LOOSE_M) ** 2))

    def seen_by(self, placed: Placed) -> tuple[DoubleBallBar, Plan]:
        flat = self.device.length_sigma is None
        device = dataclasses.replace(self._bare, centres=placed.place)
        groups = {**self._index, "bar": np.zeros_like(self.run) if flat else placed.bar}
        return device, Plan(self.chain.axes, placed.position, placed.covariates, groups)

    @property
    def _bare(self) -> DoubleBallBar:
        mm = tuple((1e3 * self.lengths).tolist())
        return dataclasses.replace(self.device, lengths_mm=mm, setups=self.numbers)

    @property
    def _index(self) -> dict[str, np.ndarray]:
        """Numbers of the run and of the set-up of every row."""
        return {
            "run": np.array(self.run_numbers)[self.run],
            "setup": np.array(self.numbers)[self.setup],
        }

    # --- output ---------------------------------------------------------------------------------
    def instrument(self, placed: Placed) -> DoubleBallBar:
        place, bar = np.asarray(placed.place), np.asarray(placed.bar)
        setup, flat = self._index["setup"], self.device.length_sigma is None
        unit = self.chain.tool_point(np.asarray(placed.position)) - place[self.setup]
        unit = unit / self.lengths[bar][:, None]
        return dataclasses.replace(
            self._bare,
            centres=place,
            seen=seen_in(setup, unit, bar, flat),
            bars=pairs_of(setup, bar),
        )

    def plan(self, placed: Placed) -> Plan:
        if self.present is not None and placed.position is self.position:
            groups = {**self.present.groups, "bar": np.asarray(placed.bar)}
            return Plan(self.chain.axes, self.position, self.present.covariates, groups)
        covariates = {n: np.asarray(v) for n, v in placed.covariates.items()}
        own = {n: v for n, v in covariates.items() if n.split("_")[0] not in _KINDS}
        groups = {**self._index, "bar": np.asarray(placed.bar)}
        plan = Plan(self.chain.axes, np.asarray(placed.position), own, groups)
        found = motion(self.chain, plan)
        found |= {name: covariates[name] for name in self.resting}
        return dataclasses.replace(plan, covariates={**found, **own})

    def seconds(self, placed: Placed) -> float:
        s = self.settings
        fixed = len(self.numbers) * s.seconds_per_setup + len(self.run_numbers) * s.seconds_per_run
        return float(fixed + path_m(np.asarray(placed.position)) * s.seconds_per_metre)


# --- the present plan ----------------------------------------------------------------------------


def _lengths(
    subject: Subject, device: DoubleBallBar, settings: DoubleBallBarDesign
) -> Float[np.ndarray, " b"]:
    """All lengths of bars, m, ascending."""
    present, named = np.array(device.lengths_mm), np.unique(settings.lengths_mm)
    if not len(named):
        return 1e-3 * present
    for length in present:
        if np.abs(named - length).min() > _SAME_MM:
            raise subject.refusal(
                "lengths_mm",
                f"bars of {', '.join(f'{v:g}' for v in named)} mm, and a set-up with {length:g} mm",
                "the lengths of the present plan among them",
                "add it, or write a plan with these bars",
            )
    return 1e-3 * named


def _runs(
    subject: Subject, device: DoubleBallBar, run: np.ndarray, setup: np.ndarray, bar: np.ndarray
) -> tuple[Runs, Float[np.ndarray, " n"]]:
    """The runs of the present plan, and the share of its arc at which every row is."""
    points = subject.chain.tool_point(np.asarray(subject.plan.position))
    arm = points - np.asarray(device.centres)[setup]
    found, share = [], np.zeros(len(run))
    for k in range(run.max() + 1):
        mine = np.flatnonzero(run == k)
        across = int(np.argmin(np.ptp(arm[mine], axis=0)))
        plane = int(np.flatnonzero(_AXES[:, 2] == across)[0])
        first, second = arm[mine][:, _AXES[plane, 0]], arm[mine][:, _AXES[plane, 1]]
        radius, height = np.hypot(first, second), arm[mine][:, across]
        flat = max(np.ptp(height), np.ptp(radius)) <= _PLANE_M and len(np.unique(bar[mine])) == 1
        angle = np.unwrap(np.arctan2(second, first))
        steps = np.diff(angle)
        sense = float(np.sign(steps.sum()))
        if not flat or len(mine) < 2 or not (sense * steps > 0.0).all():
            number = int(np.asarray(subject.plan.groups["run"])[mine[0]])
            raise subject.refusal(
                "centres",
                f"run {number}, which is no arc of one bar in one sense and in one of the planes "
                "XY, YZ and ZX",
                "such arcs, as a design moves whole arcs",
                "judge plans of your own with `vcal uncertainty`",
            )
        width = float(np.ptp(angle))
        share[mine] = sense * (angle - angle[0]) / width
        latitude = float(np.arctan2(height.mean(), radius.mean()))
        found.append((setup[mine[0]], plane, bar[mine[0]], sense, angle.min(), width, latitude))
    columns = [np.array(column) for column in zip(*found, strict=True)]
    return Runs(*columns), share


def _choice(
    subject: Subject, settings: DoubleBallBarDesign, runs: Runs, numbers: np.ndarray
) -> Int[np.ndarray, " c"]:
    """Planes to choose from, by their place in `_PLANES`."""
    choice = np.array([i for i, plane in enumerate(_PLANES) if plane in settings.planes], int)
    for number, plane in zip(numbers, runs.plane, strict=True):
        if len(choice) and plane not in choice:
            raise subject.refusal(
                "planes",
                f"{', '.join(settings.planes)}, and run {number} in {_PLANES[plane]}",
                "the planes of the present plan among them",
                "add it, or write a plan in these planes",
            )
    return choice


def _check_one_bar(subject: Subject, device: DoubleBallBar, runs: Runs) -> None:
    for k, number in enumerate(device.setups):
        if len(np.unique(runs.bar[runs.setup == k])) > 1:
            raise subject.refusal(
                "lengths_mm",
                f"set-up {number} with bars of several lengths",
                "one bar in a set-up",
                "give every bar a set-up of its own (column setup), or remove lengths_mm",
            )


def _reach(first: Array, last: Array, at: float) -> Array:
    """Largest cosine of the angle to `at` on arcs from `first` to `last`, rad; continuous."""
    inside = jnp.mod(at - first, 2.0 * np.pi) <= last - first
    return jnp.where(inside, 1.0, jnp.maximum(jnp.cos(first - at), jnp.cos(last - at)))
