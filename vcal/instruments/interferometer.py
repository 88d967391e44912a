"""Laser interferometer: error motions of one linear axis at a time, along lines.

ISO 230-1:2012, 3.4 (error motions of a linear axis), ISO 230-2:2014 (positioning), ISO 230-1:2012,
clauses 8 and 10 (straightness, squareness and angles by interferometers).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import equinox as eqx
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..bounds import Expansion, Index, Noise, Uncertainty, Within
from ..effects.base import Effect
from ..effects.thermal import REFERENCE_DEGC
from ..errors import KeyedError
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import known, namespace
from ..numerics.rigid import ORIGIN, Rotation, Scalar, Vector
from .base import (
    Column,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import file_column, linear_plan, linear_plan_table
from .line_setup import (
    AIR,
    ANGLES,
    LINE,
    MATERIAL,
    POSITION,
    READ,
    STRAIGHT,
    BeamAlignment,
    BeamSlope,
    DeadPath,
    FreeBeamSlope,
    LaserScale,
    Lines,
    LineZero,
    MaterialCompensation,
    OpticalSquare,
)
from .line_table import approach_directions, check_deviations, moving_axes
from .marks import Mark

_FOLDS = 5
"""Number of parts of a line that are held out in turn."""
_LARGEST_UM, _LARGEST_URAD = 2e8, 2e4
"""Largest readings: the travel of any machine, and any error of an angle."""
_Coordinate = Annotated[
    float, Within(-20e3, 20e3, "optics are not mounted more than 20 m from the tool point")
]
Reading = Literal[
    "position", "straight_x", "straight_y", "straight_z", "angle_a", "angle_b", "angle_c"
]


class LineSettings(BaseModel):
    """``[[instrument.line]]``: one set-up, where it differs from the others."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    line: Index
    """Its number in the column `line`."""
    offset_mm: tuple[_Coordinate, _Coordinate, _Coordinate] = (0.0, 0.0, 0.0)
    """Place of the reflector relative to the tool point, in the frame of the tool: the Abbe lever.
    """
    dead_path_mm: Annotated[
        float, Within(0.0, 50e3, "a beam is not led 50 m past what it measures")
    ] = 0.0
    """Length of air between interferometer and reflector in its first row."""
    alignment: str | None = Field(default=None, pattern=r"^[A-Za-z0-9_]+$")
    """Name of the alignment of its straightness optics. Lines with one name share it, by an optical
    square; their slopes then show the squareness. By default every line has one of its own."""
    reads: tuple[Reading, ...] | None = None
    """Its readings, as `reads` of the instrument."""


class InterferometerSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "interferometer"``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    reads: tuple[Reading, ...] | None = None
    """Readings of every line; by default those that its rows contain. A plan must name them."""
    position_sigma_um: Noise = 0.2
    """Noise of the positioning, one standard deviation: the part that does not depend on the
    distance."""
    position_sigma_um_per_m: Uncertainty = 0.0
    """The part that grows with the length of air, added to the other one."""
    straightness_sigma_um: Noise = 0.5
    """Noise of a straightness, one standard deviation, likewise."""
    straightness_sigma_um_per_m: Uncertainty = 0.0
    """The part that grows with the length of air."""
    angle_sigma_urad: Noise = 0.5
    """Noise of roll, pitch and yaw, one standard deviation."""
    zero: Literal["line", "run"] = "line"
    """Whether the readings are set to zero once in a line, or at the start of every `run` of it."""
    slope_sigma_um_per_m: Uncertainty | Literal["free"] = 0.5
    """Prior standard deviation of the slope of the positioning in every line: misalignment of the
    beam with the axis (1 mm in 1 m is a cosine error of 0.5 um/m), refractive index. 0 where there
    is none, "free" where it is unknown: the scale of the axis is then not determined."""
    laser_u_um_per_m: Uncertainty = 0.0
    """Standard uncertainty of the scale of the laser, common to all lines."""
    square_u_urad: Uncertainty = 0.0
    """Standard uncertainty of the optical square between lines that share an alignment."""
    expansion_um_per_m_K: Expansion | None = None  # noqa: N815
    """Expansion coefficient with which the instrument compensated the positioning to 20 degC, by
    the temperature in the column `T_material_degC`; without it, the readings are not compensated.
    """
    expansion_u_um_per_m_K: Annotated[  # noqa: N815
        float, Within(0.0, 50.0, "it would exceed every coefficient of expansion")
    ] = 0.0
    """Its standard uncertainty."""
    material_u_K: Annotated[  # noqa: N815
        float, Within(0.0, 20.0, "a thermometer that is wrong by more says nothing")
    ] = 0.0
    """Standard uncertainty of the measured temperature of the material."""
    dead_path_u_um_per_m_K: Annotated[  # noqa: N815
        float, Within(0.0, 50.0, "air and mounts change by less")
    ] = 0.0
    """Prior standard deviation of the change of the positioning per metre of `dead_path_mm` and
    kelvin of the air: 0.9 for a laser without dead-path compensation."""
    environment_um: Uncertainty = 0.0
    """Range of the reading in a drift test of the duration of a run, axis at rest (ISO 230-3):
    environmental variation in the uncertainties of the ISO 230-2 evaluation."""
    line: tuple[LineSettings, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        numbers = [one.line for one in self.line]
        if twice := sorted({n for n in numbers if numbers.count(n) > 1}):
            raise ValueError(
                f"found two rows [[instrument.line]] of line {twice[0]}, expected one; join them"
            )
        if self.expansion_um_per_m_K is None:
            for key in ("expansion_u_um_per_m_K", "material_u_K"):
                if getattr(self, key):
                    raise ValueError(
                        f"found {key} without expansion_um_per_m_K, expected the coefficient of "
                        "the compensation; add it, or remove the uncertainty"
                    )
        return self


@register
class Interferometer(TableInstrument):
    """Deviations of a reflector from its commanded path along a line of one linear axis.

    With the tool point t and the rotation R of the tool in the frame of the workpiece, o the place
    of the reflector relative to the tool point and a zero the nominal machine, the readings are, in
    the directions of the bed::

        d = t + R o - (t + R o)_0
        position   = d . e - alpha (T_material - 20 degC) s      (e: direction of the moving axis)
        straight_c = d . c,   c = x, y or z across the line
        angle_a, angle_b, angle_c: rotation of R R_0' about x, y and z

    (roll is the angle about the axis itself; of an axis X, pitch is b and yaw is c). To these add
    the zero of every reading in every line (or run), a slope of the positioning in every line, and
    the alignment of the straightness optics: `vcal.instruments.line_setup`. alpha is zero unless
    the readings were compensated. Rotary axes stand still in a line.
    """

    kind = "interferometer"
    rotary = True
    parallel = True
    remembers = True
    read_by = LINE
    shows_unseen = True
    steady = tuple(f"{name}_um" for name in STRAIGHT) + tuple(f"{name}_urad" for name in ANGLES)
    Settings = InterferometerSettings

    chain: Chain
    lines: Lines
    names: tuple[str, ...] = eqx.field(static=True)
    """Kinds of reading of any line."""
    turned: bool = eqx.field(static=True)
    """Whether rotary axes of the machine may turn the frame of the workpiece or of the tool."""
    settings: InterferometerSettings = eqx.field(static=True)

    @property
    def ports(self) -> tuple[str, ...]:
        return group("read", READ)

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        """The lines of the beam, between their outermost positions."""
        point, line = chain.tool_point(np.asarray(plan.position)), np.asarray(plan.groups["line"])
        found = []
        for own in np.unique(line):
            mine = point[line == own]
            ends = mine[[np.argmin(far := np.ptp(mine, axis=0) @ mine.T), np.argmax(far)]]
            found.append(Mark("beam", ends, joined=True, free=True))
        return tuple(found)

    @property
    def readings(self) -> tuple[str, ...]:
        return self.names

    # --- files ----------------------------------------------------------------------------------
    @classmethod
    def columns(
        cls, settings: InterferometerSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        found = [Column(name=LINE, low=0, integer=True)]
        if settings.zero == "run":
            found.append(Column(name="run", low=0, integer=True))
        if settings.expansion_um_per_m_K is not None:
            found.append(Column(name=f"{MATERIAL}_degC", low=-50.0, high=150.0))
        if settings.dead_path_u_um_per_m_K:
            found.append(Column(name=f"{AIR}_degC", low=-50.0, high=150.0))
        if readings:
            for name in READ:
                # Positions instead of deviations are reported with their cause.
                most = _LARGEST_URAD if name in ANGLES else _LARGEST_UM
                found.append(Column(name=column_of(name), low=-most, high=most))
        return found

    @classmethod
    def build(
        cls,
        settings: InterferometerSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        position = np.asarray(linear_plan(chain, _places(chain, table)).position)
        line = np.asarray(table[LINE], int)
        numbers = np.unique(line)
        own = {one.line: one for one in settings.line}
        if unknown := sorted({*own} - {*numbers.tolist()}):
            raise KeyedError(
                "instrument.line",
                f"line {unknown[0]}, of which there is no row",
                f"lines of the column {LINE}: {', '.join(map(str, numbers[:10]))}",
                "correct the number, or remove the row",
            )
        axes = moving_axes(chain, line, position)
        rows = [line == number for number in numbers]
        at = [position[mine, chain.axes.index(axis)] for mine, axis in zip(rows, axes, strict=True)]
        default = LineSettings(line=0)
        each = [own.get(int(number), default) for number in numbers]
        reads = tuple(
            _reads(settings, one, int(number), axis, chain, table, mine)
            for one, number, axis, mine in zip(each, numbers, axes, rows, strict=True)
        )
        lines = Lines(
            numbers=tuple(int(number) for number in numbers),
            axes=axes,
            along=np.stack([np.asarray(chain.joint(axis).direction) for axis in axes]),
            reads=reads,
            labels=tuple(
                str(number) if one.alignment is None else f"{one.alignment}"
                for one, number in zip(each, numbers, strict=True)
            ),
            centres=np.array([0.5 * (x.min() + x.max()) for x in at]),
            starts=np.array([x[0] for x in at]),
            offsets=np.array([one.offset_mm for one in each]) * 1e-3,
            dead_paths=np.array([one.dead_path_mm for one in each]) * 1e-3,
        )
        names = tuple(name for name in READ if any(name in of for of in reads))
        found = cls(
            chain=chain, lines=lines, names=names, turned=not chain.linear, settings=settings
        )
        check_deviations(table, line, lines, position, chain)
        return found

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        known = {column_of(name) for name in READ}
        plan = linear_plan(chain, table, known, groups=(LINE,))
        missing = {f"dir_{axis}" for axis in {*self.lines.axes}} - {*plan.covariates}
        if not missing:
            return plan
        derived = approach_directions(plan, self.lines)
        found = {**plan.covariates, **{name: derived[name] for name in sorted(missing)}}
        return dataclasses.replace(plan, covariates=found)

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        values = [np.asarray(table[column_of(name)], float) * 1e-6 for name in self.names]
        line = np.searchsorted(self.lines.numbers, np.asarray(table[LINE], int))
        has = np.array([[name in reads for name in self.names] for reads in self.lines.reads])
        return np.where(has[line], np.column_stack(values), 0.0)

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        seen = np.where(self.present(plan), np.asarray(readings) * 1e6, np.nan)
        return {
            **linear_plan_table(plan),
            **{column_of(name): seen[:, i] for i, name in enumerate(self.names)},
        }

    # --- one observation ------------------------------------------------------------------------
    def rows(self, plan: Plan) -> Any:
        lines, index = self.lines, self.lines.index(plan)
        offset = lines.offsets[index]
        shrunk: Any = np.zeros(plan.rows)
        if self.settings.expansion_um_per_m_K is not None:
            warm = plan.covariate(MATERIAL) - REFERENCE_DEGC
            shrunk = 1e-6 * self.settings.expansion_um_per_m_K * warm * lines.distance(plan)
        found = [lines.along[index], offset, shrunk, self.present(plan) * 1.0]
        if not known(plan.position):
            # A design varies the positions. Derivatives do not depend on the nominal place.
            return (*found, np.zeros((plan.rows, 3)))
        position = np.asarray(plan.position)
        rotation, tool = self.chain.tool_frame(position)
        found.append(tool + np.einsum("nij,nj->ni", rotation, offset))
        if self.turned:
            found += [np.swapaxes(self.chain.turn(position), 1, 2), rotation]
        return tuple(found)

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        along, offset, shrunk, here, place, *turns = row
        d = tool + rotation @ Vector.of(offset) - Vector.of(place)
        if turns:
            bed, nominal = (Rotation.of(turn) for turn in turns)
            d = bed @ d
            angle = ORIGIN
            for old, new in zip(nominal.T.rows, rotation.T.rows, strict=True):
                angle = angle + (bed @ old).cross(bed @ new)
            angle = angle * 0.5
        else:
            x, y, z = rotation.rows
            angle = Vector(z.y - y.z, x.z - z.x, y.x - x.y) * 0.5
        ideal: dict[str, Scalar] = {
            POSITION: Vector.of(along).dot(d) - shrunk,
            **dict(zip(STRAIGHT, d.parts, strict=True)),
            **dict(zip(ANGLES, angle.parts, strict=True)),
        }
        read: dict[str, Scalar] = dict(zip(READ, ports["read"], strict=True))
        # Readings that a line does not have are zero.
        return [(ideal[name] + read[name]) * here[i] for i, name in enumerate(self.names)]

    # --- what it declares -----------------------------------------------------------------------
    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        s, lines = self.settings, self.lines
        index, x = lines.index(plan), lines.moving(plan)
        xp = namespace(x)
        air = lines.dead_paths[index] + xp.abs(x - lines.starts[index])
        straight = 1e-6 * (s.straightness_sigma_um + s.straightness_sigma_um_per_m * air)
        found = {
            POSITION: 1e-6 * (s.position_sigma_um + s.position_sigma_um_per_m * air),
            **dict.fromkeys(STRAIGHT, straight),
            **dict.fromkeys(ANGLES, 1e-6 * s.angle_sigma_urad + 0.0 * air),
        }
        return xp.stack([found[name] for name in self.names], axis=1)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        # An angle counts with the lever arm at which its noise is that of the positioning.
        lever = self.settings.position_sigma_um / self.settings.angle_sigma_urad
        per = [lever if name in ANGLES else 1.0 for name in self.names]
        return np.tile(per, (plan.rows, 1))

    def dimensions(self, plan: Plan) -> np.ndarray:
        moved = [i for i, name in enumerate(self.names) if name not in ANGLES]
        return np.maximum(self.present(plan)[:, moved].sum(1), 1)

    def present(self, plan: Plan) -> np.ndarray:
        return self.lines.present(plan, self.names)

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        s, lines = self.settings, self.lines
        runs: tuple[tuple[int, ...], ...] = ()
        if s.zero == "run":
            line, run = np.asarray(plan.groups[LINE]), np.asarray(plan.groups["run"])
            runs = tuple(
                tuple(int(k) for k in np.unique(run[line == number])) for number in lines.numbers
            )
        found: list[Effect] = [LineZero(lines=lines, runs=runs)]
        if lines.with_position():
            if s.slope_sigma_um_per_m == "free":
                found.append(FreeBeamSlope(lines=lines))
            elif s.slope_sigma_um_per_m:
                found.append(BeamSlope(lines=lines, sigma=1e-6 * s.slope_sigma_um_per_m))
            if s.laser_u_um_per_m:
                found.append(LaserScale(lines=lines, sigma=1e-6 * s.laser_u_um_per_m))
            if s.expansion_u_um_per_m_K or s.material_u_K:
                compensation = MaterialCompensation(
                    lines=lines,
                    expansion=1e-6 * (s.expansion_um_per_m_K or 0.0),
                    expansion_sigma=1e-6 * s.expansion_u_um_per_m_K,
                    temperature_sigma=s.material_u_K,
                )
                found.append(compensation)
            if s.dead_path_u_um_per_m_K and lines.dead_paths.any():
                found.append(DeadPath(lines=lines, sigma=1e-6 * s.dead_path_u_um_per_m_K))
        alignment = BeamAlignment(lines=lines)
        if alignment.parameters:
            found.append(alignment)
            square = OpticalSquare(lines=lines, sigma=1e-6 * s.square_u_urad)
            if s.square_u_urad and square.parameters:
                found.append(square)
        return tuple(found)

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Fifths of every set-up, contiguous in time, as neighbours share a drift; the others
        # determine its zero and alignment. With a zero in every run, fifths of every run.
        set_up = np.asarray(plan.groups[LINE])
        if self.settings.zero == "run":
            pairs = np.column_stack([set_up, np.asarray(plan.groups["run"])])
            set_up = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
        fold = np.zeros(plan.rows, int)
        for k in np.unique(set_up):
            mine = plan.in_time(np.flatnonzero(set_up == k))
            fold[mine] = np.arange(len(mine)) * _FOLDS // len(mine)
        return fold, False


def column_of(reading: str) -> str:
    """The column of a reading: ``"meas_straight_y_um"``."""
    return f"{reading}_{'urad' if reading in ANGLES else 'um'}"


def _places(chain: Chain, table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of the positions alone."""
    names = [file_column(axis, chain.axes)[0] for axis in chain.axes]
    return {name: table[name] for name in names}


def _reads(
    settings: InterferometerSettings,
    own: LineSettings,
    number: int,
    axis: str,
    chain: Chain,
    table: Mapping[str, np.ndarray],
    rows: np.ndarray,
) -> tuple[str, ...]:
    """The kinds of reading of one line: those declared, or those that its rows contain.

    Raises `KeyedError` for declared ones that the data lack, for none at all, and for a
    straightness along the line.
    """
    there = {
        name
        for name in READ
        if column_of(name) in table and np.isfinite(np.asarray(table[column_of(name)])[rows]).all()
    }
    measured = any(column_of(name) in table for name in READ)
    key = "instrument.reads" if own.reads is None else "instrument.line"
    declared = settings.reads if own.reads is None else own.reads
    c = "xyz"[int(np.argmax(np.abs(np.asarray(chain.joint(axis).direction))))]
    along = f"meas_straight_{c}"
    if declared is None:
        if not measured:
            raise KeyedError(
                "instrument.reads",
                "a plan that does not say what is read",
                'the readings of its lines, such as ["position", "angle_b"]',
                "add the key, or the columns of readings",
            )
        if not there or along in there:
            raise KeyedError(
                f"data, line {number}",
                f"{column_of(along)} along the axis {axis}, which moves" if there else "no reading",
                "positioning, straightness across the line, or angles",
                "correct the columns, or the column line",
            )
        return tuple(name for name in READ if name in there)
    wanted = tuple(name for name in READ if name.removeprefix("meas_") in declared)
    # The straightness along the line is left out of a list that is meant for all lines.
    wanted = tuple(name for name in wanted if name != along or own.reads is not None)
    if along in wanted or not wanted:
        raise KeyedError(
            key,
            f"{along.removeprefix('meas_')} in line {number} along {axis}" if wanted else "none",
            "positioning, straightness across the line, or angles",
            "correct the list",
        )
    lacking = [name for name in wanted if measured and name not in there]
    if lacking:
        raise KeyedError(
            key,
            f"{lacking[0].removeprefix('meas_')}, which the rows of line {number} lack",
            f"readings in the column {column_of(lacking[0])}",
            "correct the list, or fill in the column",
        )
    return wanted
