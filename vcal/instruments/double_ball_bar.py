"""Double ball bar: the distance between a ball on the table and one in the spindle, on circles.

ISO 230-4 tests two linear axes on circles with it; ISO 10791-6 tests rotary axes on cylinders and
cones. `vcal.geometry.circular_deviations` has the deviations that ISO 230-4 defines.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..bounds import Noise, Range, Uncertainty, Within
from ..effects.base import Effect, Response
from ..errors import RowError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import Array, known
from ..numerics.rigid import Rotation, Scalar, Vector
from ..words import counted
from .bar_motion import directed_at_rest, motion
from .base import (
    Column,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import file_column, linear_plan, linear_plan_table
from .follow import cause
from .marks import Mark

_XYZ = ("X", "Y", "Z")
_READING = "deviation_um"
_BALL = ("ball_x_mm", "ball_y_mm", "ball_z_mm")
_LENGTH = "length_mm"
_OWN = (*_BALL, _LENGTH)
_INDEPENDENT = 1e-3
"""Least part of a column of the design matrix that the columns before it do not contain, as a share
of a full column: below it, the readings do not show the coordinate."""
_FEWEST = 4
"""Least number of rows of a set-up."""
_FOLDS = 5
"""Number of parts of a run that are held out in turn."""
_SAME_MM = 1e-3
"""Largest scatter of what is one position or one length in a table."""


class DoubleBallBarSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "double_ball_bar"``."""

    length_mm: Annotated[
        float, Within(1.0, 5000.0, "no ball bar is shorter than 1 mm or longer than 5 m")
    ]
    """Distance of the centres of the balls at which the bar reads zero. A column ``length_mm`` of
    the table replaces it row by row, for bars of several lengths."""
    length_u_um: Uncertainty | None = None
    """Standard uncertainty of that distance from its calibration, the same error in all rows of
    one length. Without it, the length is unknown in every set-up."""
    sigma_um: Noise
    """Noise of a reading, one standard deviation."""
    range_mm: Range = 1.0
    """Range of the bar's sensor: readings beyond it, and positions that need more, are errors."""


class BarCentre(Effect):
    """Position of the ball on the table in every set-up, relative to its nominal one in the frame
    of the workpiece: flat priors. Coordinates that the readings of a set-up do not show, such as
    the one across the plane of its only circle, keep their nominal values.
    """

    name = "bar_centre"
    summary = "position of the ball on the table in each set-up"
    kind = "nuisance"
    where = "instrument"
    uses = ("setup",)
    seen: tuple[tuple[int, str], ...] = eqx.field(static=True, default=())
    """Set-up and coordinate of every parameter."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"{k}.{c}", "um", scale=100.0) for k, c in self.seen)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index = plan.groups["setup"]
        return {(f"centre.{c}", f"{k}.{c}"): (index == k) * 1.0 for k, c in self.seen}


class SetupLength(Effect):
    """Length of an uncalibrated bar in every set-up: flat priors. A longer bar reads less."""

    name = "setup_length"
    summary = "length of the bar in each set-up"
    kind = "nuisance"
    where = "instrument"
    uses = ("setup", "bar")
    seen: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())
    """Set-up and index of the length of every parameter."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(self._label(k, b), "um", scale=100.0) for k, b in self.seen)

    def _label(self, setup: int, bar: int) -> str:
        several = sum(k == setup for k, _ in self.seen) > 1
        return f"{setup}.length{bar}" if several else f"{setup}.length"

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        setup, bar = plan.groups["setup"], plan.groups["bar"]
        return {
            ("read.length", self._label(k, b)): -1.0 * ((setup == k) & (bar == b))
            for k, b in self.seen
        }


class BarLength(Effect):
    """Error of every calibrated length, with the standard uncertainty of the calibration. It is
    the same in all set-ups; a longer bar reads less.
    """

    name = "bar_length"
    summary = "error of the calibrated length of the bar"
    where = "instrument"
    uses = ("bar",)
    lengths_mm: tuple[float, ...] = eqx.field(static=True, default=())
    sigma: float = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        size = self.sigma / 1e-6
        return tuple(Parameter(name, "um", sigma=size) for name in self._names)

    @property
    def _names(self) -> tuple[str, ...]:
        if len(self.lengths_mm) == 1:
            return ("error",)
        return tuple(f"error_{length:g}mm".replace(".", "p") for length in self.lengths_mm)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        bar = plan.groups["bar"]
        return {("read.length", name): -1.0 * (bar == b) for b, name in enumerate(self._names)}


@register
class DoubleBallBar(TableInstrument):
    """Reading |p - c| - L: tool point p and ball on the table c in the frame of the workpiece,
    nominal length L.

    A *run* is one pass along a circle or an arc, in one sense. Runs with the same number in the
    column ``setup`` have the ball at the same position; without this column, every run is a set-up
    of its own. The nominal c is the centre of the sphere of radius L through the nominal tool
    points of a set-up. A circle smaller than L (a cone), or a tool point at rest in the frame of
    the workpiece while rotary axes turn (a cylinder), needs c in the columns ``ball_x_mm``,
    ``ball_y_mm``, ``ball_z_mm``.

    From the positions within a run follow the direction of travel of every axis; on circles of
    linear axes also the distance since the last reversal and, with the column ``feed_mm_min``, the
    velocities. Accelerations follow where runs differ in them, since at a single acceleration their
    effects have the shape of scale and squareness errors. Columns of the table have precedence.

    A common lag of all axes displaces the tool along the circle and is not seen. The mismatch of
    two servo loops is `servo_lag` of one axis, play across a guideway is `lateral_reversal`.
    """

    kind = "double_ball_bar"
    dimension = 1
    rotary = True
    Settings = DoubleBallBarSettings

    sigma: float
    """Noise of a reading, m."""
    length_sigma: float | None
    """Standard uncertainty of a length, m; None where the length is unknown in every set-up."""
    lengths_mm: tuple[float, ...] = eqx.field(static=True)
    """The nominal lengths, ascending."""
    setups: tuple[int, ...] = eqx.field(static=True)
    centres: np.ndarray
    """Nominal c in the order of `setups` (setups, 3), m."""
    seen: tuple[tuple[int, str], ...] = eqx.field(static=True)
    """Set-up and coordinate of c that the readings show."""
    bars: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """Set-up and index of the length, each pair once."""
    given: bool = eqx.field(static=True, default=False)
    """Whether the table has the positions of the ball."""
    grouped: bool = eqx.field(static=True, default=False)
    """Whether the table numbers the set-ups."""

    @property
    def ports(self) -> tuple[str, ...]:
        return group("centre", _XYZ) + group("read", ("length",))

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        return (Mark("ball", np.asarray(self.centres), free=True),)

    @property
    def readings(self) -> tuple[str, ...]:
        return ("length",)

    @classmethod
    def columns(
        cls, settings: DoubleBallBarSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        limit = 1e3 * settings.range_mm
        plain = [Column(name="run", low=0, integer=True)]
        return plain + [Column(name=_READING, low=-limit, high=limit)] * readings

    @classmethod
    def build(
        cls,
        settings: DoubleBallBarSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        run = np.asarray(table["run"], int)
        setup, bar, lengths_mm = _setups(table), *_lengths(table, settings.length_mm)
        position = np.asarray(linear_plan(chain, table).position)
        points = chain.tool_point(position)
        setups, length = np.unique(setup), 1e-3 * np.array(lengths_mm)[bar]
        _check_setups(run, setup)
        _check_rows(setup, np.full(len(setups), _FEWEST), setups, table)
        given = all(name in table for name in _BALL)
        if given:
            centres = _given_centres(table, setup, setups)
        else:
            centres = np.stack(
                [_sphere_centre(points[setup == k], length[setup == k]) for k in setups]
            )
        at = centres[np.searchsorted(setups, setup)]
        _check_distance(chain, settings, table, position, (run, setup), (at, length), given)
        flat = settings.length_u_um is None
        bars = pairs_of(setup, bar)
        seen = seen_in(setup, (points - at) / length[:, None], bar, flat)
        unknown = [
            sum(s == k for s, _ in seen) + flat * sum(s == k for s, _ in bars) for k in setups
        ]
        _check_rows(setup, np.array(unknown) + 1, setups, table)
        return cls(
            sigma=settings.sigma_um * 1e-6,
            length_sigma=None if settings.length_u_um is None else settings.length_u_um * 1e-6,
            lengths_mm=lengths_mm,
            setups=tuple(int(k) for k in setups),
            centres=centres,
            seen=seen,
            bars=bars,
            given=given,
            grouped="setup" in table,
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        own = {name: values for name, values in table.items() if name not in _OWN}
        plan = linear_plan(chain, own, (_READING,), groups=("setup",))
        groups = {**plan.groups, "setup": _setups(table)}
        groups["bar"] = self._bar(table)
        covariates = {**motion(chain, plan), **plan.covariates}
        return Plan(plan.axes, plan.position, covariates, groups)

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.asarray(table[_READING], float)[:, None] * 1e-6

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        # What follows from the positions is not written: it follows from those of a new plan.
        motion = [f"{kind}_{axis}" for kind in ("since", "v", "a") for axis in plan.axes]
        motion += [f"dir_{axis}" for axis in plan.axes if not directed_at_rest(plan, axis)]
        shown = linear_plan_table(plan, motion)
        bar, setup = shown.pop("bar"), shown.pop("setup")
        if self.grouped:
            shown["setup"] = setup
        if len(self.lengths_mm) > 1:
            shown[_LENGTH] = np.array(self.lengths_mm)[bar]
        if self.given:
            at = 1e3 * np.asarray(self.rows(plan)[0])
            shown |= {name: at[:, i] for i, name in enumerate(_BALL)}
        return {**shown, _READING: readings[:, 0] * 1e6}

    def rows(self, plan: Plan) -> Any:
        place = np.searchsorted(self.setups, np.asarray(plan.groups["setup"]))
        bar = plan.groups["bar"]  # traced where a design chooses the bar
        length = self._length[np.asarray(bar)] if known(bar) else jnp.asarray(self._length)[bar]
        return self.centres[np.clip(place, 0, len(self.setups) - 1)], length

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        centre, length = row
        bar = tool - Vector.of(centre) - Vector.of(ports["centre"])
        return [jnp.sqrt(bar.dot(bar)) - length + ports["read"][0]]

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.full((plan.rows, 1), self.sigma)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 1))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        found: tuple[Effect, ...] = (BarCentre(seen=self.seen),) if self.seen else ()
        if self.length_sigma is None:
            return (*found, SetupLength(seen=self.bars))
        if self.length_sigma > 0.0:
            found += (BarLength(lengths_mm=self.lengths_mm, sigma=self.length_sigma),)
        return found

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Fifths of every run: the other fifths determine the position of the ball.
        run, fold = np.asarray(plan.groups["run"]), np.zeros(plan.rows, int)
        for k in np.unique(run):
            mine = np.flatnonzero(run == k)
            fold[mine] = np.arange(len(mine)) * _FOLDS // len(mine)
        return fold, False

    @property
    def _length(self) -> np.ndarray:
        return 1e-3 * np.array(self.lengths_mm)

    def _bar(self, table: Mapping[str, np.ndarray]) -> Int[np.ndarray, " n"]:
        if _LENGTH not in table:
            return np.zeros(len(table["run"]), int)
        return _nearest(np.asarray(table[_LENGTH], float), self.lengths_mm)


# --- table ---------------------------------------------------------------------------------------


def _setups(table: Mapping[str, np.ndarray]) -> Int[np.ndarray, " n"]:
    """Number of the set-up of every row; that of the run where the table has no such column."""
    values = np.asarray(table.get("setup", table["run"]), float)
    wrong = (values < 0.0) | (values != np.round(values))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise RowError(
            row, "column setup", f"{values[row]:g}", "whole numbers from 0 on", "number the set-ups"
        )
    return values.astype(int)


def _lengths(
    table: Mapping[str, np.ndarray], length_mm: float
) -> tuple[Int[np.ndarray, " n"], tuple[float, ...]]:
    """Index of the nominal length of every row, and the lengths in mm, ascending."""
    if _LENGTH not in table:
        return np.zeros(len(table["run"]), int), (length_mm,)
    values = np.asarray(table[_LENGTH], float)
    wrong = ~((values > 0.0) & (values <= 5000.0))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise RowError(
            row,
            f"column {_LENGTH}",
            f"{values[row]:g}",
            "the distance of the balls at which the bar reads zero, above 0 to 5000 mm",
            "correct the column or its unit",
        )
    lengths: list[float] = []
    for value in np.unique(values):
        if not lengths or value - lengths[-1] > _SAME_MM:
            lengths.append(float(value))
    return _nearest(values, lengths), tuple(lengths)


def _nearest(values: np.ndarray, lengths: Sequence[float]) -> Int[np.ndarray, " n"]:
    return np.argmin(np.abs(values[:, None] - np.array(lengths)), axis=1)


def _check_setups(run: np.ndarray, setup: np.ndarray) -> None:
    for k in np.unique(run):
        mine = np.flatnonzero(run == k)
        if len(others := np.unique(setup[mine])) > 1:
            row = int(mine[np.argmax(setup[mine] != setup[mine[0]])])
            raise RowError(
                row,
                "column setup",
                f"set-ups {', '.join(str(s) for s in others)} in run {k}",
                "one set-up for a run",
                "correct the column run or setup",
            )


def _check_rows(
    setup: np.ndarray, fewest: np.ndarray, setups: np.ndarray, table: Mapping[str, np.ndarray]
) -> None:
    for k, least in zip(setups, fewest, strict=True):
        mine = np.flatnonzero(setup == k)
        if len(mine) < least:
            raise RowError(
                int(mine[0]),
                "column setup" if "setup" in table else "column run",
                f"{counted(len(mine), 'row')} of set-up {k}",
                f"at least {least}, as every set-up has unknowns of its own",
                "measure more, leave them out, or give runs about one ball the same setup",
            )


def _given_centres(
    table: Mapping[str, np.ndarray], setup: np.ndarray, setups: np.ndarray
) -> Float[np.ndarray, "s 3"]:
    places = np.column_stack([table[name] for name in _BALL])
    for k in setups:
        mine = np.flatnonzero(setup == k)
        apart = np.abs(places[mine] - places[mine[0]]).max(1)
        if apart.max() > _SAME_MM:
            raise RowError(
                int(mine[np.argmax(apart)]),
                f"columns {', '.join(_BALL)}",
                f"the ball {apart.max():.4g} mm from where set-up {k} begins",
                "one position in a set-up",
                "give every position of the ball a number in the column setup",
            )
    return 1e-3 * np.stack([places[setup == k].mean(0) for k in setups])


def _check_distance(
    chain: Chain,
    settings: DoubleBallBarSettings,
    table: Mapping[str, np.ndarray],
    position: np.ndarray,
    index: tuple[np.ndarray, np.ndarray],
    nominal: tuple[np.ndarray, np.ndarray],
    given: bool,
) -> None:
    """Raise `RowError` where a nominal tool point is not at the length of the bar from the ball."""
    (run, setup), (at, length), reach = index, nominal, 1e-3 * settings.range_mm

    def off(points: np.ndarray) -> np.ndarray:
        centres = at
        if not given:  # positions with another sign lie about another ball
            centres = np.empty_like(at)
            for k in np.unique(setup):
                mine = setup == k
                centres[mine] = _sphere_centre(points[mine], length[mine])
        return np.abs(np.linalg.norm(points - centres, axis=1) - length)

    points = chain.tool_point(position)
    found = off(points)
    row = int(np.argmax(found))
    if found[row] <= reach:
        return
    key = f"column {_LENGTH}" if _LENGTH in table else "instrument.length_mm"
    radius = np.linalg.norm(points[row] - at[row])
    named = "columns " + ", ".join(file_column(axis, chain.axes)[0] for axis in chain.axes)
    expected = f"{1e3 * length[row]:g} mm ({key}), within {settings.range_mm:g} mm (range_mm)"
    hint = cause(chain, chain.axes, position, off, reach)
    if not given and radius < length[row]:
        hint = hint or (
            f"correct positions, {'setup' if 'setup' in table else 'run'} or length; for a cone, "
            f"or a tool at rest on a turning table, add the ball's position ({', '.join(_BALL)})"
        )
    raise RowError(
        row,
        named,
        f"a tool point {1e3 * radius:.4g} mm from the ball of set-up {setup[row]} (run {run[row]})",
        expected,
        hint or "correct the positions, the position of the ball or the length",
    )


def _sphere_centre(
    points: Float[np.ndarray, "n 3"], length: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3"]:
    """Centre c with |p - c| = length by linear least squares: of a sphere or, for points in one
    plane, of the circle in that plane.

    2 (p - m).(c - m) - |c - m|^2 = |p - m|^2 - length^2 with m the mean of the points; the square
    is an unknown of its own, and the shortest solution stays in the plane.
    """
    middle = points.mean(0)
    arm = points - middle
    size = float(np.sqrt((arm**2).sum(1).mean()))
    if size < _SAME_MM * 1e-3:
        return middle  # a point at rest determines no centre
    matrix = np.column_stack([2.0 * arm / size, -np.ones(len(arm))])
    right = ((arm**2).sum(1) - length**2) / size
    return middle + np.linalg.lstsq(matrix, right, rcond=1e-6)[0][:3]


def pairs_of(
    setup: Int[np.ndarray, " n"], bar: Int[np.ndarray, " n"]
) -> tuple[tuple[int, int], ...]:
    """Set-up and index of the length, each pair once."""
    return tuple((int(k), int(b)) for k, b in np.unique(np.column_stack([setup, bar]), axis=0))


def seen_in(
    setup: Int[np.ndarray, " n"],
    unit: Float[np.ndarray, "n 3"],
    bar: Int[np.ndarray, " n"],
    flat: bool,
) -> tuple[tuple[int, str], ...]:
    """Set-up and coordinate of the ball that the readings along unit vectors (n, 3) show; `flat`:
    beside unknown lengths of the bar by index (n,).
    """
    found: list[tuple[int, str]] = []
    for k in np.unique(setup):
        mine = np.flatnonzero(setup == k)
        found += [(int(k), c) for c in _seen(unit[mine], bar[mine] * flat, flat)]
    return tuple(found)


def _seen(
    unit: Float[np.ndarray, "n 3"], bar: Int[np.ndarray, " n"], flat: bool
) -> tuple[str, ...]:
    """Coordinates of the ball that readings along unit vectors (n, 3) show, beside unknown lengths
    (`flat`) by index (n,): the first ones whose columns are independent.
    """
    before = [(bar == b) * 1.0 for b in np.unique(bar)] if flat else []
    found = []
    for c, column in zip(_XYZ, unit.T, strict=True):
        rest = column
        if before:
            basis = np.column_stack(before)
            rest = column - basis @ np.linalg.lstsq(basis, column, rcond=1e-9)[0]
        if np.sqrt((rest**2).mean()) > _INDEPENDENT:
            before.append(column)
            found.append(c)
    return tuple(found)
