"""R-test: three probes in a nest follow a precision sphere while the axes travel small circles.

The difference between the position of the sphere by the axes' own scales (internal) and by the
probes (external) is the error of the structure in between. Weikert, Knapp (2004), CIRP Annals
53(1), 429-432; its use on circles of known acceleration: Nguyen, Weikert, Wegener (2012).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..bounds import Uncertainty, Within
from ..effects.base import Effect
from ..effects.probes import ProbeMatrix, middle_of_runs
from ..errors import RowError
from ..machine.chain import Chain
from ..machine.circles import Circle, fit_circle
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.rigid import Rotation, Scalar, Vector
from .base import Column, Loader, Ports, Summary, TableInstrument, register
from .circle_averages import automatic, averages, samples_of, words_of
from .conditions import linear_plan, linear_plan_table
from .follow import check_moves
from .marks import Mark
from .nest import COORDINATES, PROBES, Nest, NestSettings, PlaceOfRuns, reading_columns

_XYZ = "XYZ"
PLANES = ("XY", "YZ", "ZX")
"""Planes of circles, in the order of their numbers in a plan."""
_SLACK = 0.02
"""Share of a turn that may be missing between the last row and the first."""
_WITHIN = 3.0
"""Largest plausible ratio of the travelled circle to the commanded one."""
_PER_TURN = 3.0
"""Least number of rows per turn, which excludes aliases of another frequency: an f that appears as
abs(f_s - f), within a factor of 3 in the square, has 2.8 rows per turn at most.
"""
_BESIDE = 0.1
"""Largest rms distance of positions from the circle, as a share of the radius."""
_DERIVED = tuple(f"{kind}_{axis}" for kind in ("a", "v", "dir", "since") for axis in _XYZ)
_OWN = ("run", "plane", "sense", "a_set_m_s2", "t_s")


class RTestSettings(NestSettings):
    """Keys of ``[instrument]`` for ``kind = "r_test"``."""

    radius_mm: Annotated[
        float, Within(0.1, 1e4, "no circle of a machine is smaller than 0.1 mm or larger than 10 m")
    ]
    """Commanded radius of the circles."""
    internal_sigma_um: Uncertainty = 0.0
    """Noise of the axes' scales."""
    averages_per_turn: (
        Annotated[
            int, Within(0, 100_000, "0 uses all samples; no more than 100,000 averages are of use")
        ]
        | None
    ) = None
    """Number of averages per turn in place of the samples of all turns of a run; 0: all samples.
    Without the key, runs of more than 50,000 samples together are averaged to some 20,000 rows.
    """
    acceleration: Literal["actual", "nominal"] = "actual"
    """Acceleration used by effects: that of the travelled circle, or the commanded one, r omega^2
    towards the centre of the circle (eqs. (5) and (6) of the publication).
    """


class RunOffsets(PlaceOfRuns):
    """Position of the sphere between the probes in every run: three parameters per run with flat
    priors.
    """

    name = "run_offset"
    summary = "place of the sphere in each run"
    group = "sphere"


@register
class RTest(TableInstrument):
    """Centre of the sphere in the frame of the probes: p = tool point - middle of the run's circle
    + offset of the run, along x, y, z of the machine; the middle is that of the nominal tool point.

    The axis positions are readings of the machine's scales, so the tool point differs from them by
    the errors of the structure. `vcal.instruments.nest` gives the readings of the probes from p.

    Every run is one circle or more. Positions, accelerations, directions and the distance since the
    last reversal are those of its fundamental (`vcal.machine.circles`); the rest of the scales'
    readings, with their noise, is subtracted from both the internal and the external reading.
    Otherwise, a residual would correlate with a position merely because both contain the same
    noise.

    A long recording is averaged by the angle of the circle (`vcal.instruments.circle_averages`). A
    column ``samples`` says of how many samples a row is the mean: its noise is smaller by the root
    of that number.
    """

    kind = "r_test"
    remembers = True
    machine: ClassVar[str | None] = "w b X Y Z t"
    labels: ClassVar[tuple[str, ...]] = ("plane",)
    read_otherwise = (*COORDINATES, *PROBES)
    positioned: ClassVar[bool] = True
    derived: ClassVar[tuple[str, ...]] = ("t_run", "circle_angle")
    Settings = RTestSettings

    radius: float
    sigma: float
    """Noise of a difference between external and internal reading, m."""
    internal_sigma: float
    """Noise of the internal reading alone, m."""
    matrix_sigma: float
    """Standard deviation of the elements of `ProbeMatrix`."""
    nominal: bool = eqx.field(static=True)
    nest: Nest
    offset: np.ndarray
    """From the axes' position to the nominal tool point, m."""
    averages: int | None = eqx.field(static=True, default=None)
    """`RTestSettings.averages_per_turn`."""
    said: str = eqx.field(static=True, default="")

    @property
    def ports(self) -> tuple[str, ...]:
        return group("sphere", tuple(_XYZ))

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        first = np.unique(np.asarray(plan.groups["run"]), return_index=True)[1]
        return (Mark("nest", self.rows(plan)[first], free=True),)

    @property
    def readings(self) -> tuple[str, ...]:
        return self.nest.readings

    @property
    def averaged(self) -> str:
        return self.said

    @classmethod
    def columns(cls, settings: RTestSettings, axes: Sequence[str], readings: bool) -> list[Column]:
        found = [
            Column(name="run", low=0, integer=True),
            Column(name="sense", low=-1, high=1, integer=True),
            Column(name="a_set_m_s2", low=1e-9, high=1e3),
            Column(name="t_s"),
            *(Column(name=f"{axis.lower()}_int_mm", low=-1e6, high=1e6) for axis in axes),
        ]
        return found + reading_columns(settings) * readings

    @classmethod
    def build(
        cls, settings: RTestSettings, chain: Chain, table: Mapping[str, np.ndarray], load: Loader
    ) -> Self:
        return cls(
            radius=settings.radius_mm * 1e-3,
            sigma=math.hypot(settings.external_sigma_um, settings.internal_sigma_um) * 1e-6,
            internal_sigma=settings.internal_sigma_um * 1e-6,
            matrix_sigma=settings.matrix_sigma,
            nominal=settings.acceleration == "nominal",
            nest=Nest.of(settings),
            offset=np.asarray(chain.tool_offset, float),
            averages=settings.averages_per_turn,
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        own = {name: values for name, values in table.items() if name not in ("plane", "t_s")}
        for axis in chain.axes:
            own[f"{axis.lower()}_mm"] = own.pop(f"{axis.lower()}_int_mm")
        plan = linear_plan(chain, own, (*COORDINATES, *PROBES))
        if (few := samples_of(plan) < 1.0).any():
            row = int(np.argmax(few))
            found = f"{samples_of(plan)[row]:g}"
            raise RowError(
                row, "column samples", found, "the number of samples of a mean, at least 1",
                "correct it, or give the column another name",
            )  # fmt: skip
        t, run = np.asarray(table["t_s"], float), np.asarray(plan.groups["run"])
        _refuse_copies(run, table)
        covariates = dict(plan.covariates) | {"t_run": t}
        if (np.diff(t) > 0.0).all():  # otherwise it starts from zero in every run
            covariates["t"] = t
        plane = _plane_numbers(table["plane"])
        derived = {name: np.zeros(plan.rows) for name in _DERIVED}
        read, position = np.asarray(plan.position), np.zeros((plan.rows, len(chain.axes)))
        around = np.zeros(plan.rows)
        turning: dict[int, tuple[Circle, str, float]] = {}
        for number in np.unique(run):
            mine = np.flatnonzero(run == number)
            a_set, sense = (np.asarray(covariates[n])[mine] for n in ("a_set_m_s2", "sense"))
            for column, values in (("a_set_m_s2", a_set), ("sense", sense)):
                _refuse_two(number, mine, column, values)
            circle = self._circle(number, mine, t[mine], read[mine], plane[mine], a_set, chain.axes)
            turning[number] = circle, str(table["plane"][mine[0]]).upper(), sense[0]
            found, around[mine] = self._motion(
                circle, t[mine], int(plane[mine[0]]), a_set, chain.axes
            )
            position[mine] = circle.position(t[mine])
            for name, values in found.items():
                derived[name][mine] = values
        _refuse_senses(run, turning, chain.axes)
        covariates |= derived | {"circle_angle": around}
        return Plan(plan.axes, position, covariates, dict(plan.groups) | {"plane": plane})

    def _motion(
        self, circle: Circle, t: np.ndarray, plane: int, a_set: np.ndarray, axes: Sequence[str]
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Acceleration, velocity, direction and distance since the last reversal of every axis on a
        circle at the times `t` (n,), by the names of their covariates; the angle of the circle.
        """
        place = circle.position(t) - circle.centre
        first, second = (axes.index(axis) for axis in PLANES[plane])
        around = np.mod(np.arctan2(place[:, second], place[:, first]), 2.0 * np.pi)
        values = circle.acceleration(t)
        if self.nominal:
            values = -a_set[:, None] * place / np.linalg.norm(place, axis=1, keepdims=True)
        kinds = {
            "a": values,
            "v": circle.velocity(t),
            "dir": circle.direction(t),
            "since": circle.since_reversal(t),
        }
        found = {
            f"{kind}_{axis}": columns[:, i]
            for kind, columns in kinds.items()
            for i, axis in enumerate(axes)
        }
        return found, around

    def summarised(self, plan: Plan, readings: np.ndarray) -> Summary[Self] | None:
        run = np.asarray(plan.groups["run"])
        angles = self.averages
        if angles is None:
            angles = automatic(plan.rows, len(np.unique(run)))
        if not angles:
            return None
        circles, t = self.circles(plan), np.asarray(plan.covariate("t_run"))
        means = averages(t, run, circles, angles, samples_of(plan))
        at = np.asarray(plan.position)
        new = np.concatenate([circles[k].position(means.time[means.run == k]) for k in circles])
        # Only the deviation from the circle is averaged: the mean of an arc lies inside it.
        beside = means.of(readings - self.nest.along(at)) + self.nest.along(new)
        covariates = {name: means.of(np.asarray(v)) for name, v in plan.covariates.items()}
        covariates |= {name: means.time for name in ("t", "t_run") if name in covariates}
        covariates["samples"] = means.samples
        groups = {name: np.asarray(v)[means.rows] for name, v in plan.groups.items()}
        for k, circle in circles.items():
            mine = means.run == k
            found, around = self._motion(
                circle, means.time[mine], int(groups["plane"][mine][0]),
                covariates["a_set_m_s2"][mine], plan.axes,
            )  # fmt: skip
            for name, values in {**found, "circle_angle": around}.items():
                covariates[name][mine] = values
        numbers = np.arange(1, plan.rows + 1) if plan.numbers is None else np.asarray(plan.numbers)
        averaged = Plan(plan.axes, new, covariates, groups, plan.sets, numbers[means.rows])
        words = words_of(plan.rows, means, angles, self.radius)
        return Summary(replace(self, said=words), averaged, beside, means.rows)

    def check_coordinates(self) -> None:
        """Raise `ValueError` where the readings are those of the single probes."""
        if not self.nest.coordinates:
            raise ValueError(
                "[instrument]: found readings of probes, expected coordinates of the sphere; "
                "identify acceleration_crosstalk, which takes both, or turn the readings into "
                "coordinates"
            )

    def circles(self, plan: Plan) -> dict[int, Circle]:
        """The circle that the axes travelled in every run."""
        t, run = np.asarray(plan.covariate("t_run")), np.asarray(plan.groups["run"])
        position = np.asarray(plan.position)
        return {int(k): fit_circle(t[run == k], position[run == k]) for k in np.unique(run)}

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        readings = self.nest.measured(table)
        t, run = np.asarray(table["t_s"], float), np.asarray(table["run"], int)
        internal = np.column_stack([table[f"{c}_int_mm"] for c in "xyz"]) * 1e-3
        check_moves(readings, self.nest.along(internal), run, self.nest.columns)
        for number in np.unique(run):
            mine = np.flatnonzero(run == number)
            beside = internal[mine] - fit_circle(t[mine], internal[mine]).position(t[mine])
            # About 0.1 um from the circle: the linear response of the probes is sufficient.
            readings[mine] -= self.nest.along(beside)
        return readings

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        shown = linear_plan_table(plan, (*_DERIVED, *self.derived, "t", "sense", "a_set_m_s2"))
        for axis in plan.axes:
            shown[f"{axis.lower()}_int_mm"] = shown.pop(f"{axis.lower()}_mm")
        own = {
            "run": shown.pop("run"),
            "plane": np.array(PLANES)[shown.pop("plane")],
            "sense": np.asarray(plan.covariate("sense")),
            "a_set_m_s2": np.asarray(plan.covariate("a_set_m_s2")),
            "t_s": np.asarray(plan.covariate("t_run")),
        }
        return {**own, **shown, **self.nest.to_table(readings)}

    def rows(self, plan: Plan) -> Any:
        return middle_of_runs(plan) + self.offset

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        return self.nest.read(tool - Vector.of(row) + Vector.of(ports["sphere"]))

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.repeat(self.sigma / np.sqrt(samples_of(plan))[:, None], 3, axis=1)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 3))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        runs = tuple(int(run) for run in np.unique(np.asarray(plan.groups["run"])))
        found: tuple[Effect, ...] = (RunOffsets(runs=runs),)
        if self.matrix_sigma > 0.0:
            found += (ProbeMatrix(sigma=self.matrix_sigma),)
        return found

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        runs, fold = np.unique(np.asarray(plan.groups["run"]), return_inverse=True)
        # Successive runs differ in acceleration only: every fold gets some of each.
        if len(runs) > 1:
            return fold % min(len(runs), 5), False
        return np.arange(plan.rows) * 5 // plan.rows, False

    def _circle(
        self,
        run: int,
        rows: Int[np.ndarray, " n"],
        t: Float[np.ndarray, " n"],
        position: Float[np.ndarray, "n axes"],
        plane: np.ndarray,
        a_set: Float[np.ndarray, " n"],
        axes: Sequence[str],
    ) -> Circle:

        def refuse(column: str, found: str, expected: str, do: str, at: int = 0) -> RowError:
            place = f"run {run}" + (f", column {column}" if column else "")
            return RowError(int(rows[at]), place, found, expected, do)

        if (np.diff(t) <= 0.0).any():
            row = int(np.argmax(np.diff(t) <= 0.0))
            raise refuse(
                "t_s",
                f"{t[row + 1]:.15g} after {t[row]:.15g}",
                "rising times",
                "sort the rows of the run, or give the repeated circle another run",
                row + 1,
            )
        try:
            circle = fit_circle(t, position)
        except ValueError as error:
            found, _, expected = str(error).removeprefix("found ").partition(", expected ")
            raise refuse("", found, expected, "correct the rows, or leave the run out") from error
        step = float(np.median(np.diff(t)))
        turns = circle.omega * (t[-1] - t[0] + step) / (2.0 * np.pi)
        if turns < 1.0 - _SLACK:
            raise refuse(
                "",
                f"{turns:.2f} of a turn",
                "a whole one at least, to separate offset and amplitude",
                "measure longer, or leave the run out",
            )
        if (per_turn := 2.0 * np.pi / (circle.omega * step)) < _PER_TURN:
            raise refuse(
                "",
                f"{per_turn:.2f} rows per turn",
                f"{_PER_TURN:g} at least, as a circle of another speed would look the same",
                "sample faster, or leave the run out",
            )
        beside = np.linalg.norm(position - circle.position(t), axis=1)
        radius = float(circle.amplitude.max())
        if (rms := math.sqrt(np.square(beside).mean())) > _BESIDE * radius:
            raise refuse(
                "",
                f"positions {1e3 * rms:.3g} mm (rms) from the best-fitting circle of one speed",
                f"one circle at constant speed: within {100 * _BESIDE:g} % of its radius",
                "give every speed its own run, and leave out rows in which the axes accelerate",
                int(np.argmax(beside)),
            )
        moving = {axis for axis, moves in zip(axes, circle.moving, strict=True) if moves}
        if len(set(plane)) > 1 or moving != set(PLANES[plane[0]]):
            found = " and ".join(dict.fromkeys(PLANES[k] for k in plane))
            raise refuse(
                "plane",
                f"{found}, while {', '.join(sorted(moving))} move",
                "the plane of the two axes that do",
                "correct the column",
            )
        ratio = float(circle.amplitude.max()) / self.radius
        if not 1.0 / _WITHIN < ratio < _WITHIN:
            raise refuse(
                "",
                f"a circle of {1e3 * ratio * self.radius:.3g} mm",
                f"about radius_mm = {1e3 * self.radius:g}",
                "correct the key, or the unit of the columns",
            )
        a = circle.omega**2 * float(circle.amplitude.max())
        wrong = ~((a_set > a / _WITHIN) & (a_set < a * _WITHIN))
        if wrong.any():
            raise refuse(
                "a_set_m_s2",
                f"{a_set[wrong][0]:g}, while the axes travel {1e3 * circle.amplitude.max():.3g} mm "
                f"at {circle.omega / 2.0 / np.pi:.3g} turns per second, {a:.3g} m/s^2",
                "about the same",
                "correct the column, or the unit of t_s",
                int(np.argmax(wrong)),
            )
        return circle


def _refuse_two(run: int, rows: np.ndarray, column: str, values: np.ndarray) -> None:
    """Raise `RowError` where a run has two settings, or its sense is zero."""
    place = f"run {run}, column {column}"
    if len(np.unique(values)) > 1:
        at = int(np.argmax(values != values[0]))
        found = f"{values[at]:g} after {values[0]:g}"
        raise RowError(
            int(rows[at]), place, found, "one setting in a run", "give every circle its own run"
        )
    if column == "sense" and values[0] == 0.0:
        raise RowError(int(rows[0]), place, "0", "1 or -1", "enter the sense of the circle")


def _refuse_senses(
    run: np.ndarray, turning: Mapping[int, tuple[Circle, str, float]], axes: Sequence[str]
) -> None:
    """Raise `RowError` where the senses of circles in one plane contradict their positions. Either
    direction may be called 1, if it is the same in all runs.
    """
    ways: dict[str, dict[float, list[int]]] = {}
    for number, (circle, plane, sense) in turning.items():
        first, second = (axes.index(axis) for axis in plane)
        a, b = circle.cosine, circle.sine
        way = np.sign(a[first] * b[second] - a[second] * b[first])
        ways.setdefault(plane, {}).setdefault(float(way * sense), []).append(number)
    for plane, found in ways.items():
        if len(found) > 1:
            few = min(found.values(), key=len)[0]
            raise RowError(
                int(np.argmax(run == few)),
                f"run {few}, column sense",
                f"{turning[few][2]:g}, the other way round than in other runs of {plane}",
                "one sign for one sense of rotation",
                "correct the column",
            )


def _refuse_copies(run: np.ndarray, table: Mapping[str, np.ndarray]) -> None:
    """Raise `RowError` where a run has the same readings as another."""
    names = [name for name in (*COORDINATES, *PROBES) if name in table]
    if not names:
        return
    readings = np.column_stack([np.asarray(table[name], float) for name in names])
    known: dict[bytes, int] = {}
    for number in np.unique(run):
        mine = np.flatnonzero(run == number)
        other = known.setdefault(readings[mine].tobytes(), int(number))
        if other != number:
            raise RowError(
                int(mine[0]),
                f"run {number}",
                f"all readings of run {other} again",
                "every reading once",
                "leave one of the runs out",
            )


def _plane_numbers(names: np.ndarray) -> np.ndarray:
    known = {name: i for i, plane in enumerate(PLANES) for name in (plane, plane[::-1])}
    for row, name in enumerate(names):
        if str(name).upper() not in known:
            raise RowError(
                row, "column plane", repr(str(name)), f"one of {', '.join(PLANES)}", "correct it"
            )
    return np.array([known[str(name).upper()] for name in names])
