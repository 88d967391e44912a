"""Laser frame: a position-sensitive diode (PSD) at the tool follows a beam along the axes.

A laser and pentaprisms on a frame of low expansion send one beam along edges of the work space,
segment after segment. On every segment, a PSD at the spindle reads the position of the beam in the
two directions across it. The readings are changes from a reference run, so neither the beams nor
the machine need to be straight. Brecher, Spierling, Fey, Neus (2021), CIRP Annals 70(1), 333-336.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict

from ..bounds import Index, Noise, Position, Temperature, Within
from ..effects.base import Effect
from ..effects.thermal import REFERENCE_DEGC
from ..errors import KeyedError, RowError, StudyError
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.rigid import Rotation, Scalar, Vector
from .base import (
    Column,
    FileName,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import linear_plan, linear_plan_table
from .frame import Station, displaced
from .marks import Mark
from .psd_map import PsdMap

_XYZ = "XYZ"
_READ = ("u", "v")
_COLUMNS = ("u_um", "v_um")
_PSD = ("psd_u_mm", "psd_v_mm")
_SHOWN_M = 1e-15
_STEPS = 100

Psd = Literal["vertical", "horizontal"]
Direction = Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"]


class Segment(NamedTuple):
    """One straight part of the beam."""

    number: int
    start: tuple[float, float, float]
    """Positions of the axes X, Y, Z at its start, m."""
    end: tuple[float, float, float]
    points: int
    """Measuring points, both ends included."""
    psd: Psd
    """The diode that reads it: the upright one, which faces the beam, or the flat one."""
    psd_range: tuple[float, float] = (0.0, 0.0)
    """Position of the beam on the diode at the end of the segment, in both readings, m; at its
    start, the position is the opposite one.
    """

    @property
    def axis(self) -> str:
        """The axis along which the beam runs."""
        return _XYZ[int(np.argmax(np.abs(self._step)))]

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Unit vector along the beam."""
        return self._step / self.length

    @property
    def across(self) -> tuple[int, int]:
        """The two coordinates that are read: 0, 1, 2 for x, y, z."""
        u, v = (i for i in range(3) if _XYZ[i] != self.axis)
        return u, v

    @property
    def length(self) -> float:
        """Length, m."""
        return float(np.abs(self._step).max())

    @property
    def positions(self) -> Float[np.ndarray, "points 3"]:
        """Positions of the axes at the measuring points, evenly spaced."""
        share = np.linspace(0.0, 1.0, self.points)[:, None]
        return np.asarray(self.start) + share * self._step

    @property
    def _step(self) -> np.ndarray:
        return np.asarray(self.end) - np.asarray(self.start)


_CORNERS: dict[str, tuple[tuple[int, str, str], ...]] = {
    "3d": (
        (1, "---", "-+-"),
        (2, "-+-", "++-"),
        (5, "++-", "+++"),
        (3, "+++", "+-+"),
        (4, "+-+", "--+"),
    ),
    "planar": (
        (1, "---", "-+-"),
        (2, "-+-", "++-"),
        (3, "++-", "+--"),
        (4, "+--", "---"),
        (5, "---", "--+"),
    ),
}


def beam_path(
    name: str,
    travel: Mapping[str, Sequence[float]],
    psd_range: Mapping[int, tuple[float, float]] | None = None,
) -> tuple[Segment, ...]:
    """A beam path by name over a travel (m) in X, Y and Z, in the order of the beam.

    ``"3d"``: low along Y at x-, low along X at y+, up at (x+, y+), high along Y at x+, high along X
    at y-; this observes as many errors as five segments can. ``"planar"``: round the lower plane,
    then up at (x-, y-). There are seven points on the first segment, eleven on the others.
    `psd_range` gives the `Segment.psd_range` of some segments, m. Raises `KeyError` for another
    name.
    """
    found = []
    for number, first, last in _CORNERS[name]:
        start, end = (
            tuple(float(travel[axis][s == "+"]) for axis, s in zip(_XYZ, corner, strict=True))
            for corner in (first, last)
        )
        upright: Psd = "horizontal" if number == 5 else "vertical"
        own = (psd_range or {}).get(number, (0.0, 0.0))
        points = 7 if number == 1 else 11
        found.append(Segment(number, start, end, points, upright, own))  # type: ignore[arg-type]
    return tuple(found)


_OnDiode = Annotated[float, Within(-1e3, 1e3, "no diode is two metres wide")]


class SegmentSettings(BaseModel):
    """A row of ``[[instrument.segment]]``: the user's own path, in the order of the beam."""

    model_config = ConfigDict(extra="forbid")
    number: Index
    """Number of the segment, as in the column `segment` of the data."""
    start_mm: tuple[Position, Position, Position]
    """Positions of X, Y, Z at its start."""
    direction: Direction
    """The way the beam runs."""
    length_mm: Annotated[
        float, Within(0.1, 2e5, "no travel is shorter than 0.1 mm or longer than 200 m")
    ]
    """Length of the segment."""
    points: Annotated[
        int, Within(2, 100_000, "a line has two ends, and no run has as many points")
    ] = 11
    """Measuring points, both ends included."""
    psd: Psd = "vertical"
    """The diode that looks at it: the upright one, which faces the beam, or the flat one."""
    psd_range_mm: tuple[_OnDiode, _OnDiode] = (0.0, 0.0)
    """Position of the beam on the diode at the end of the segment."""


class LaserFrameSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "laser_frame"``."""

    sigma_um: Noise
    """Noise of a change from the reference run."""
    beam_path: Literal["3d", "planar", "own"] = "3d"
    """A name, over the travel of the machine; or ``"own"``, with [[instrument.segment]] rows."""
    segment: tuple[SegmentSettings, ...] = ()
    reference_degC: Temperature = REFERENCE_DEGC  # noqa: N815
    """Temperature of the reference run: thermal effects are zero there."""
    psd_lever_mm: Annotated[float, Within(0.0, 1e4, "no tool is longer than 10 m")] = 0.0
    """Distance from the spindle's axis to the upright diode, towards the beam."""
    psd_size_mm: Annotated[
        float, Within(0.1, 1e3, "no diode is narrower than 0.1 mm or a metre wide")
    ] = 10.0
    """Width of the diode."""
    psd_map: FileName | None = None
    """Table of the diode's calibrated error: u_mm, v_mm, error_u_um, error_v_um on a full grid."""
    filter_mm: Annotated[float, Within(0.0, 100.0, "no filter is 100 mm thick")] = 0.0
    """Thickness of the filter in front of the diode."""
    filter_index: Annotated[
        float,
        Within(1.0, 5.0, "light is fastest in vacuum, and no glass refracts more", open_low=True),
    ] = 1.5
    """Its refractive index."""


@register
class LaserFrame(TableInstrument):
    """Change of the tool point in the two directions of x, y, z across the beam.

    (u, v) = e . (R_f' (p - s) - p0), where p is the sensitive point of the diode in the workpiece
    frame, p0 its nominal position, R_f and s the rotation and the displacement of the frame since
    the reference run, about the middle of its beams: a nuisance with six parameters. A diode off
    the spindle's axis has a lever arm, which the spindle orients towards the beam. A filter of
    thickness d shifts the beam by -d (tan a - tan b), sin a = n sin b (Snell), where the angle a
    changes with the rotation of the tool; `filter_shift`.
    """

    kind = "laser_frame"
    dimension = 2
    Settings = LaserFrameSettings
    derived = ("path_mm", *_PSD)
    steady = _PSD

    segments: tuple[Segment, ...] = eqx.field(static=True)
    centre: np.ndarray
    """Middle of the beams, about which the frame rotates, m."""
    offset: np.ndarray
    """From the axes' position to the nominal tool point, m."""
    sigma: float
    lever: float
    size: float
    psd_map: PsdMap | None
    thickness: float
    index: float
    reference: float = REFERENCE_DEGC
    """Temperature of the reference run, degC."""

    @classmethod
    def of(
        cls,
        segments: Sequence[Segment],
        chain: Chain,
        *,
        sigma: float,
        lever: float = 0.0,
        size: float = 0.01,
        psd_map: PsdMap | None = None,
        thickness: float = 0.0,
        index: float = 1.5,
        reference: float = REFERENCE_DEGC,
    ) -> Self:
        """A laser frame on a machine with the linear axes X, Y, Z; lengths in m, the temperature
        of the reference run in degC.
        """
        ends = np.array([end for one in segments for end in (one.start, one.end)])
        offset = np.asarray(chain.tool_offset, float)
        return cls(
            segments=tuple(segments),
            centre=0.5 * (ends.min(0) + ends.max(0)) + offset,
            offset=offset,
            sigma=sigma,
            lever=lever,
            size=size,
            psd_map=psd_map,
            thickness=thickness,
            index=index,
            reference=reference,
        )

    @property
    def temperature_offset_K(self) -> float:
        return self.reference - REFERENCE_DEGC

    @property
    def ports(self) -> tuple[str, ...]:
        return group("frame") + group("head", tuple(_XYZ)) + group("read", _READ)

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        ends = ((np.array([one.start, one.end]) + self.offset) for one in self.segments)
        return tuple(Mark("beam", places, joined=True) for places in ends)

    @property
    def readings(self) -> tuple[str, ...]:
        return _READ

    @classmethod
    def columns(
        cls, settings: LaserFrameSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        found = [Column(name="segment", low=0, integer=True)]
        if not readings:
            return found
        size = settings.psd_size_mm
        found += [Column(name=c, low=-1e3 * size, high=1e3 * size) for c in _COLUMNS]
        if settings.psd_map is not None:
            found += [Column(name=c, low=-0.5 * size, high=0.5 * size) for c in _PSD]
        return found

    @classmethod
    def build(
        cls,
        settings: LaserFrameSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        segments = _segments(settings, chain)
        _check_numbers(segments, table["segment"])
        psd_map = None if settings.psd_map is None else PsdMap.read(settings.psd_map, load)
        return cls.of(
            segments,
            chain,
            sigma=settings.sigma_um * 1e-6,
            lever=settings.psd_lever_mm * 1e-3,
            size=settings.psd_size_mm * 1e-3,
            psd_map=psd_map,
            thickness=settings.filter_mm * 1e-3,
            index=settings.filter_index,
            reference=settings.reference_degC,
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        plan = linear_plan(chain, table, _COLUMNS, temperature_offset_K=self.temperature_offset_K)
        covariates = dict(plan.covariates)
        s = self.along(plan)
        self._check_places(plan, s)
        order = {one.number: one for one in self.segments}
        if "path_mm" not in covariates:
            starts, total = {}, 0.0
            for one in self.segments:
                starts[one.number], total = total, total + one.length
            rows = np.asarray(plan.groups["segment"])
            covariates["path_mm"] = np.array(
                [1e3 * (starts[k] + a * order[k].length) for k, a in zip(rows, s, strict=True)]
            )
        ranges = np.array([order[k].psd_range for k in np.asarray(plan.groups["segment"])])
        if ranges.any():
            for i, name in enumerate(_PSD):
                covariates.setdefault(name, 1e3 * ranges[:, i] * (2.0 * s - 1.0))
        return Plan(plan.axes, plan.position, covariates, plan.groups)

    def along(self, plan: Plan) -> Float[np.ndarray, " n"]:
        """Position of every row on its segment: 0 at the start, 1 at the end."""
        position, number = self._xyz(plan), np.asarray(plan.groups["segment"])
        found = np.zeros(plan.rows)
        for one in self.segments:
            mine = number == one.number
            found[mine] = (position[mine] - one.start) @ one.direction / one.length
        return found

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        readings = np.column_stack([table[c] for c in _COLUMNS]) * 1e-6
        if self.psd_map is None:
            return readings
        place = np.column_stack([table[c] for c in _PSD]) * 1e-3
        return readings - (self.psd_map(place + readings) - self.psd_map(place))

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        shown = linear_plan_table(plan, temperature_offset_K=self.temperature_offset_K)
        if self.psd_map is not None:
            # By default, the beam meets the middle of the diode.
            middle = np.zeros(plan.rows)
            place = {c: np.asarray(plan.covariates.get(c, middle)) for c in _PSD}
            shown |= place
            readings = _displayed(readings, np.column_stack([*place.values()]) * 1e-3, self.psd_map)
        return {**shown, **{c: readings[:, i] * 1e6 for i, c in enumerate(_COLUMNS)}}

    def rows(self, plan: Plan) -> Any:
        number = np.asarray(plan.groups["segment"])
        shapes = (2, 3), (3,), (3,), (2,)
        across, along, towards, beam = (np.zeros((plan.rows, *shape)) for shape in shapes)
        for one in self.segments:
            mine = number == one.number
            across[mine] = np.eye(3)[list(one.across)]
            along[mine] = one.direction
            if one.psd == "vertical":
                towards[mine] = -one.direction
            beam[mine] = 2.0 * np.asarray(one.psd_range) / one.length
        lever = self.lever * towards
        # JAX traces positions and lever where a design optimises them.
        xyz = jnp.stack([jnp.asarray(plan.x(axis)) for axis in _XYZ], -1)
        nominal = xyz + self.offset + lever
        return nominal, across, along, lever, beam

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        nominal, across, along, lever, beam = row
        turn, middle = displaced(np.eye(3), self.centre, ports["frame"])
        point = tool + rotation @ (Vector.of(lever) + Vector.of(ports["head"]))
        moved = turn.T @ (point - middle) - (Vector.of(nominal) - Vector.of(self.centre))
        u, v = (Vector.of(across[i]) for i in range(2))
        read = [u.dot(moved), v.dot(moved)]
        if self.thickness:
            # The direction of the beam in the frame of the head, before and after both rotate.
            ray = Vector.of(along) + u * beam[0] + v * beam[1]
            seen = rotation.T @ (turn @ ray)
            slopes = [w.dot(seen) / Vector.of(along).dot(seen) for w in (u, v)]
            after = filter_shift(slopes[0], slopes[1], self.thickness, self.index)
            before = filter_shift(beam[0], beam[1], self.thickness, self.index)
            read = [r - (a - b) for r, a, b in zip(read, after, before, strict=True)]
        return [value + port for value, port in zip(read, ports["read"], strict=True)]

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.full((plan.rows, 2), self.sigma)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 2))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        return (Station(),)

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Runs where there are several; else every fifth point, as no segment predicts another.
        if "run" in plan.groups:
            runs, fold = np.unique(np.asarray(plan.groups["run"]), return_inverse=True)
            if len(runs) > 1:
                return fold, False
        return np.arange(plan.rows) % 5, False

    def _xyz(self, plan: Plan) -> Float[np.ndarray, "n 3"]:
        return np.column_stack([np.asarray(plan.x(axis)) for axis in _XYZ])

    def _check_places(self, plan: Plan, s: np.ndarray) -> None:
        position, number = self._xyz(plan), np.asarray(plan.groups["segment"])
        for one in self.segments:
            mine = np.flatnonzero(number == one.number)
            off = position[mine] - one.start - np.outer(s[mine], one.length * one.direction)
            far = np.abs(off).max(1) > 0.5 * self.size
            outside = (s[mine] < -0.05) | (s[mine] > 1.05)
            if len(bad := np.flatnonzero(far | outside)):
                row = mine[bad[0]]
                place = ", ".join(f"{1e3 * v:g}" for v in position[row])
                ends = " to ".join(
                    f"({', '.join(f'{1e3 * v:g}' for v in end)})" for end in (one.start, one.end)
                )
                raise RowError(
                    int(row),
                    "",
                    f"the position ({place}) mm on segment {one.number}",
                    f"one on the beam from {ends} mm, where it meets the {1e3 * self.size:g} mm "
                    "of the diode",
                    "correct the row, or the beam path in [instrument]",
                )


def _displayed(
    readings: Float[np.ndarray, "n 2"], place: Float[np.ndarray, "n 2"], psd_map: PsdMap
) -> Float[np.ndarray, "n 2"]:
    """Uncorrected readings of the diode (m) from readings corrected by its map: the fixed point of
    r <- readings + map(place + r) - map(place).

    Raises `StudyError` where the map is so steep that the iteration does not converge.
    """
    shown, start = np.asarray(readings, float), psd_map(place)
    for _ in range(_STEPS):
        before, shown = shown, readings + psd_map(place + shown) - start
        if (step := float(np.abs(shown - before).max())) < _SHOWN_M:
            return shown
    raise StudyError(
        f"{psd_map.name}: found readings that still change by {step:.3g} m after {_STEPS} steps, "
        f"expected less than {_SHOWN_M:g} m, as an error that changes by less than the place does; "
        "correct error_u_um and error_v_um"
    )


def filter_shift(
    slope_u: Scalar, slope_v: Scalar, thickness: float, index: float
) -> tuple[Scalar, Scalar]:
    """Shift of a beam by a plane filter, d (tan a - tan b) with sin a = n sin b.

    The shift is given in both directions; the slopes are those of the beam from the normal of the
    filter, tan a = sqrt(u^2 + v^2).
    """
    squared = slope_u * slope_u + slope_v * slope_v
    kept = thickness * (1.0 - 1.0 / jnp.sqrt(index**2 + (index**2 - 1.0) * squared))
    return slope_u * kept, slope_v * kept


def safe_filter_shift(slope: Scalar, turned: Scalar, thickness: float) -> Scalar:
    """Upper bound of the change of the shift when the angle a = atan(slope) grows by `turned`:
    d (tan(a + turned) - tan a), without the refraction in the glass (eq. (10) of the publication).
    """
    return thickness * (jnp.tan(jnp.arctan(slope) + turned) - slope)


def _segments(settings: LaserFrameSettings, chain: Chain) -> tuple[Segment, ...]:
    if set(chain.axes) != set(_XYZ):
        raise KeyedError(
            "machine.chain",
            f"the axes {', '.join(chain.axes)}",
            "X, Y and Z, along which the beams of a laser frame run",
            "correct the chain",
        )
    if settings.beam_path != "own":
        if settings.segment:
            raise KeyedError(
                "instrument.beam_path",
                f"{settings.beam_path!r} and [[instrument.segment]] rows",
                "one of the two",
                "set beam_path = 'own', or remove the [[instrument.segment]] rows",
            )
        travel = {axis: chain.joint(axis).travel.tolist() for axis in _XYZ}
        if not np.isfinite(list(travel.values())).all():
            raise KeyedError(
                "machine.travel_mm",
                "no travel of every axis",
                f"it, as the beam path {settings.beam_path!r} runs along its edges",
                "add it, or give segments",
            )
        return beam_path(settings.beam_path, travel)
    if not settings.segment:
        raise KeyedError(
            "instrument.beam_path",
            "'own' without [[instrument.segment]] rows",
            "one for every segment, with number, start_mm, direction and length_mm",
            "add them",
        )
    numbers = [row.number for row in settings.segment]
    if len(set(numbers)) < len(numbers):
        raise KeyedError(
            "instrument.segment",
            f"the numbers {', '.join(map(str, numbers))}",
            "every number once",
            "correct them",
        )
    found = []
    for i, row in enumerate(settings.segment):
        start = np.asarray(row.start_mm) * 1e-3
        step = np.zeros(3)
        step["XYZ".index(row.direction[1])] = float(f"{row.direction[0]}1") * row.length_mm * 1e-3
        reach = tuple(1e-3 * v for v in row.psd_range_mm)
        if max(map(abs, reach)) > 0.5e-3 * settings.psd_size_mm:
            raise KeyedError(
                f"instrument.segment.{i}.psd_range_mm",
                f"{list(row.psd_range_mm)}",
                f"at most half of psd_size_mm = {settings.psd_size_mm:g}, as the beam misses the "
                "diode otherwise",
                "correct them",
            )
        ends = tuple(start.tolist()), tuple((start + step).tolist())
        found.append(Segment(row.number, *ends, row.points, row.psd, reach))  # type: ignore[arg-type]
    return tuple(found)


def _check_numbers(segments: Sequence[Segment], found: np.ndarray) -> None:
    known = [one.number for one in segments]
    bad = np.flatnonzero(~np.isin(found, known))
    if len(bad):
        raise RowError(
            int(bad[0]),
            "column segment",
            f"{found[bad[0]]:g}",
            f"one of {', '.join(map(str, sorted(known)))}, the segments of the beam path",
            "correct it",
        )
