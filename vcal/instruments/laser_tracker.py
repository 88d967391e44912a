"""Laser tracker: range, azimuth and elevation of a reflector on the tool, from one or more stations;
also Cartesian coordinates, and ranges alone (multilateration).
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.spatial.transform import Rotation as Turn

from ..effects.base import Effect, Response
from ..effects.station import STATION, at_station
from ..errors import KeyedError, RowError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from .base import (
    LARGEST_NOISE,
    SMALLEST_NOISE,
    Column,
    FileName,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import linear_plan, linear_plan_table
from .follow import Variant, check_follows
from .frame import Station, displaced
from .stations import Lateration, Pose, fitted_pose, laterated

_Coordinate = Annotated[float, Field(ge=-200e3, le=200e3)]
_Angle = Annotated[float, Field(ge=-360, le=360)]
_Point = tuple[_Coordinate, _Coordinate, _Coordinate]
_Readings = Literal["polar", "cartesian", "range"]
_READ = ("range", "azimuth", "elevation")
_POLAR = ("range_mm", "azimuth_rad", "elevation_rad")
_CARTESIAN = ("meas_x_mm", "meas_y_mm", "meas_z_mm")
_COLUMNS = {"polar": _POLAR, "cartesian": _CARTESIAN, "range": _POLAR[:1]}
_TOOL = "tool"
_MOST_TOOLS = 100

_CLOSE, _CLOSE_M = 0.02, 5e-3
"""Share of the size of the measured region, and distance, within which the declared pose is an
accurate start."""
_OTHER_PLACE, _OTHER_PLACE_M = 0.2, 0.3
"""Share of the distance from the measured region, and distance, from which the declared place of a
station is reported as another one."""
_OTHER_DEG = 5.0
"""The same for its declared rotation."""
_LINE_M = 1e-3
"""Width, m, below which points are on one line."""
_FEWEST = 4
"""Least number of points that determine a pose with something left to check it."""


class StationSettings(BaseModel):
    """One station of several: a row of ``[instrument.stations]``, named as in column ``station``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    station_mm: _Point | None = None
    """Approximate place of the tracker in the workpiece frame; it is identified."""
    euler_xyz_deg: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)
    """Approximate rotation of the tracker, R = Rx Ry Rz; it is identified."""
    station_in_frame_mm: _Point | None = None
    """Place of the tracker in the frame of the coordinates, for ``coordinates = "other"``."""
    dead_path_mm: float = Field(default=0.0, ge=-200e3, le=200e3)
    """Approximate dead path of ranges alone; it is identified."""


class LaserTrackerSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "laser_tracker"``."""

    readings: _Readings | None = None
    """Columns of the readings: "polar" (range_mm, azimuth_rad, elevation_rad), "cartesian"
    (meas_x_mm, meas_y_mm, meas_z_mm) or "range" (range_mm alone); by default "cartesian" where the
    table has meas_x_mm, else "polar"."""
    range_sigma_um: float = Field(ge=SMALLEST_NOISE, le=LARGEST_NOISE)
    """Noise of the range, one standard deviation: the part that does not depend on the range."""
    range_sigma_um_per_m: float = Field(default=0.0, ge=0, le=LARGEST_NOISE)
    """The part that grows with the range."""
    range_sigma_sum: Literal["linear", "quadrature"] | None = None
    """How the two parts add up; by default "quadrature" for ranges alone, else "linear"."""
    angle_sigma_urad: float | None = Field(default=None, ge=SMALLEST_NOISE, le=LARGEST_NOISE)
    """Noise of azimuth and elevation, one standard deviation; required unless ranges alone are
    read."""
    station_mm: _Point | None = None
    """Approximate place of the tracker in the workpiece frame; it is identified. Required for a
    plan without readings."""
    euler_xyz_deg: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)
    """Approximate rotation of the tracker, R = Rx Ry Rz; it is identified."""
    coordinates: Literal["tracker", "other"] = "tracker"
    """Frame of Cartesian readings: the tracker's own, or another one that was fitted elsewhere."""
    station_in_frame_mm: _Point | None = None
    """Place of the tracker in that other frame, from where range and angles are counted; by default
    it follows from `station_mm`."""
    dead_path_mm: float = Field(default=0.0, ge=-200e3, le=200e3)
    """Approximate distance at which the range is zero, for ranges alone; it is identified."""
    dead_path_sigma_um: float | None = Field(default=None, ge=0, le=1e9)
    """Prior standard deviation of the dead path of every station; 0 where it is known, as that of
    an absolute distance meter. By default it is free for ranges alone, and known otherwise."""
    stations: dict[str, StationSettings] | None = None
    """Approximate poses of several stations, by their names in the column `station`."""
    tools: dict[str, _Point] | None = None
    """Tool offsets by their names in the column `tool`: from the frame of the last axis to the
    reflector, as machine.tool_offset_mm."""
    tools_file: FileName | None = None
    """Table of the tool offsets in place of `tools`: columns tool, x_mm, y_mm, z_mm."""
    tools_sigma_um: float = Field(default=0.0, ge=0, le=1e6)
    """Standard uncertainty of every coordinate of the tool offsets relative to each other."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.tools is not None and self.tools_file is not None:
            raise ValueError("found both tools and tools_file, expected one of them; remove one")
        if self.tools is not None and not 0 < len(self.tools) <= _MOST_TOOLS:
            raise ValueError(
                f"found {len(self.tools)} tools, expected 1 to {_MOST_TOOLS}; correct tools"
            )
        single = {"station_mm", "euler_xyz_deg", "station_in_frame_mm", "dead_path_mm"}
        if self.stations is not None and (given := single & self.model_fields_set):
            raise ValueError(
                f"found both stations and {sorted(given)[0]}, expected the latter in the rows of "
                "stations; move it there"
            )
        if self.stations is not None and not self.stations:
            raise ValueError("found no stations, expected at least one row; add it")
        return self

    @property
    def _kind(self) -> _Readings:
        return self.readings or "polar"


class DeadPath(Effect):
    """Distance d at which the range reads zero, from its initial value: r = norm(v) - d."""

    name = "dead_path"
    summary = "dead path of the range"
    kind = "nuisance"
    where = "instrument"
    number: int = eqx.field(static=True, default=-1)
    """Index of the station in the group ``"station"``; -1 where there is only one."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("length", "um", scale=1000.0),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {("read.range", "length"): -at_station(plan, self.number)}

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return at_station(plan, self.number) > 0.0


class ToolOffsets(Effect):
    """Errors of the declared tool offsets, three parameters each."""

    name = "tool_offsets"
    summary = "errors of the offsets of the tools"
    kind = "nuisance"
    where = "instrument"
    tools: tuple[str, ...] = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"{k}.{c}", "um", sigma=1.0) for k in self.tools for c in "XYZ")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        tool = np.asarray(plan.groups[_TOOL])
        return {
            (f"offset.{c}", f"{k}.{c}"): (tool == i).astype(float)
            for i, k in enumerate(self.tools)
            for c in "XYZ"
        }


@register
class LaserTracker(TableInstrument):
    """Range r = norm(v) - d, azimuth atan2(v_y, v_x), elevation asin(v_z / r) with v = R'(p - s).

    p is the reflector on the tool, s and R the place and rotation of the station in the frame of
    the workpiece, with which it moves and rotates; they are nuisances with six parameters. Noise:
    range sigma a + b r, added linearly or in quadrature, one sigma for both angles. An azimuth zero
    is part of the rotation R. d is the dead path, zero unless it is declared.

    - Cartesian coordinates c are converted: v = c in the tracker's frame, or v = Q'(c - t) in
      another one, in which the tracker is at t with the rotation Q. That frame need not be that of
      the workpiece: its pose is identified.
    - Ranges alone (a tracking interferometer; multilateration, ISO 230-1:2012, 7) identify the
      place of the station, three parameters, and the dead path.
    - The column ``station`` names the station of every row, each with its own pose and dead path,
      and the column ``tool`` the tool offset.

    Starting values of poses and dead paths are closed-form solutions from the readings and the
    nominal machine, wherever the declared ones are not close.

    The tracker's errors depend on its readings, not on the estimated station: range and angles of a
    plan are the readings, or those from the nominal station where there are none.
    """

    kind = "laser_tracker"
    Settings = LaserTrackerSettings
    derived = _READ
    rotary = True
    parallel = True
    read_otherwise = (*_POLAR, *_CARTESIAN)

    station: np.ndarray
    """Place of the station (3,), m; the mean of several."""
    orientation: np.ndarray
    range_sigma: float
    range_sigma_per_m: float
    angle_sigma: float
    reads: _Readings = eqx.field(static=True, default="polar")
    quadrature: bool = eqx.field(static=True, default=False)
    names: tuple[str, ...] = eqx.field(static=True, default=())
    """Names of several stations; empty where there is one."""
    places: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Places of several stations (stations, 3), m."""
    orientations: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3, 3)))
    dead: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(1))
    """Dead path of every station (stations,), m."""
    dead_sigma: float | None = eqx.field(static=True, default=0.0)
    """Prior standard deviation of the dead paths, m; None: free."""
    tools: tuple[str, ...] = eqx.field(static=True, default=())
    """Names of the tools; empty where all rows have that of the machine."""
    offsets: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Offsets of the tools from that of the machine (tools, 3), m."""
    tools_sigma: float = eqx.field(static=True, default=0.0)
    other_places: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """Place t of every station in the other frame of the coordinates (stations, 3), m; empty where
    coordinates are in the tracker's own frame."""
    other_turns: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3, 3)))
    """Rotation Q of every station in that frame (stations, 3, 3)."""
    found: bool = eqx.field(static=True, default=False)
    """Whether a pose follows from readings."""
    said: tuple[str, ...] = eqx.field(static=True, default=())

    # --- what it reads ----------------------------------------------------------------------------
    @property
    def ports(self) -> tuple[str, ...]:
        frame = group("frame", tuple("XYZ")) if self.reads == "range" else group("frame")
        shifted = group("offset", tuple("XYZ")) if self.tools_sigma else ()
        return frame + group("read", self.readings) + shifted

    @property
    def readings(self) -> tuple[str, ...]:
        return _READ[:1] if self.reads == "range" else _READ

    @property
    def stations(self) -> tuple[str, ...]:
        return self.names

    @property
    def remarks(self) -> tuple[str, ...]:
        return self.said

    @classmethod
    def recognised(
        cls, settings: LaserTrackerSettings, header: Sequence[str]
    ) -> LaserTrackerSettings:
        if settings.readings is None and _CARTESIAN[0] in header:
            return settings.model_copy(update={"readings": "cartesian"})
        return settings

    @classmethod
    def label_columns(
        cls, settings: LaserTrackerSettings, header: Sequence[str]
    ) -> tuple[str, ...]:
        wanted = {
            STATION: settings.stations is not None,
            _TOOL: settings.tools is not None or settings.tools_file is not None,
        }
        return tuple(name for name, needed in wanted.items() if needed or name in header)

    @classmethod
    def columns(
        cls, settings: LaserTrackerSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        if not readings:
            return []
        if settings._kind == "cartesian":
            return [Column(name=name, low=-200e3, high=200e3) for name in _CARTESIAN]
        if settings._kind == "range":
            return [Column(name="range_mm", low=-200e3, high=200e3)]
        return [
            Column(name="range_mm", low=1.0, high=200e3),
            Column(name="azimuth_rad", low=-2 * np.pi, high=2 * np.pi),
            Column(name="elevation_rad", low=-np.pi / 2, high=np.pi / 2),
        ]

    @classmethod
    def build(
        cls,
        settings: LaserTrackerSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        if settings.angle_sigma_urad is None and settings._kind != "range":
            raise KeyedError(
                "instrument.angle_sigma_urad",
                "nothing",
                "the noise of azimuth and elevation, unless ranges alone are read "
                '(readings = "range")',
                "add it",
            )
        names = _station_names(settings, table)
        rows = _station_settings(settings, names)
        tools = _tools(settings, table, load)
        kind = settings._kind
        sigma = settings.dead_path_sigma_um
        if sigma is None:
            sigma = None if kind == "range" else 0.0
        sum_of_both = settings.range_sigma_sum or ("quadrature" if kind == "range" else "linear")
        tool_offset = np.asarray(chain.tool_offset)
        made = cls(
            station=np.zeros(3),
            orientation=np.eye(3),
            range_sigma=settings.range_sigma_um * 1e-6,
            range_sigma_per_m=settings.range_sigma_um_per_m * 1e-6,
            angle_sigma=(settings.angle_sigma_urad or 0.0) * 1e-6,
            reads=kind,
            quadrature=sum_of_both == "quadrature",
            names=names,
            dead=1e-3 * np.array([row.dead_path_mm for row in rows]),
            dead_sigma=None if sigma is None else sigma * 1e-6,
            tools=tuple(tools),
            offsets=np.array([1e-3 * np.array(v) - tool_offset for v in tools.values()]).reshape(
                -1, 3
            ),
            tools_sigma=settings.tools_sigma_um * 1e-6 if tools else 0.0,
        )
        return made._placed(settings, rows, chain, table)

    # --- poses of the stations --------------------------------------------------------------------
    def _placed(
        self,
        settings: LaserTrackerSettings,
        rows: Sequence[StationSettings],
        chain: Chain,
        table: Mapping[str, np.ndarray],
    ) -> Self:
        """The instrument with its starting poses and dead paths, and what they contradict."""
        key = "instrument.stations.{}" if self.names else "instrument"
        keys = [key.format(name) for name in self.names or ("",)]
        declared = [_declared(row) for row in rows]
        at = self._station_of(table)
        if not self._has_readings(table):
            for row, own in zip(rows, keys, strict=True):
                if row.station_mm is None:
                    raise KeyedError(
                        f"{own}.station_mm",
                        "nothing for a plan without readings",
                        "the approximate place of the tracker",
                        "add it",
                    )
            other = settings.coordinates == "other" and self.reads == "cartesian"
            poses = [pose for pose in declared if pose is not None]
            # Without readings, the other frame is that of the workpiece.
            return self._at(poses, poses if other else ())
        plan = linear_plan(chain, table, self._own_columns)
        nominal = self._points(chain, np.asarray(plan.position), table)
        seen = self._seen(table)
        self._check_follows(chain, plan, table, seen, declared)
        if self.reads == "range":
            return self._laterated(settings, rows, keys, seen[:, 0], nominal, at)
        found, others, said, new = [], [], [], False
        for i, (row, pose, own) in enumerate(zip(rows, declared, keys, strict=True)):
            here = at == i
            if not (_spread(seen[here]) and _spread(nominal[here])):
                self._need_place(pose, own)
                assert pose is not None
                found.append(pose)
                others.append(pose)
                continue
            fit = fitted_pose(seen[here], nominal[here])
            if settings.coordinates == "other" and self.reads == "cartesian":
                other = _in_other_frame(row, pose, fit, own)
                others.append(other)
                fit = _composed(fit, other)
            size = float(np.linalg.norm(nominal[here] - nominal[here].mean(0), axis=1).max())
            if pose is not None and not others:
                off = seen[here] @ pose.orientation.T + pose.place - nominal[here]
                if np.median(np.linalg.norm(off, axis=1)) <= max(_CLOSE * size, _CLOSE_M):
                    found.append(pose)
                    continue
            found.append(fit)
            new = True
            said += _elsewhere(row, own, pose, fit, nominal[here])
        return dataclasses.replace(self._at(found, others), found=new, said=tuple(said))

    def _laterated(
        self,
        settings: LaserTrackerSettings,
        rows: Sequence[StationSettings],
        keys: Sequence[str],
        ranges: Float[np.ndarray, " n"],
        nominal: Float[np.ndarray, "n 3"],
        at: Int[np.ndarray, " n"],
    ) -> Self:
        """The instrument with stations from ranges alone."""
        poses, dead, said = [], self.dead.copy(), []
        for i, (row, own) in enumerate(zip(rows, keys, strict=True)):
            here, pose = at == i, _declared(row)
            if here.sum() <= _FEWEST:
                self._need_place(pose, own)
                assert pose is not None
                poses.append(pose)
                continue
            found = self._lateration(row, ranges[here], nominal[here])
            poses.append(Pose(np.eye(3), found.place))
            dead[i] = found.dead_path
            if pose is not None:
                said += _elsewhere(row, own, pose, poses[-1], nominal[here], turned=False)
        return dataclasses.replace(self._at(poses, ()), dead=dead, found=True, said=tuple(said))

    def _lateration(
        self, row: StationSettings, ranges: np.ndarray, nominal: np.ndarray
    ) -> Lateration:
        near = None if row.station_mm is None else 1e-3 * np.array(row.station_mm)
        known = 1e-3 * row.dead_path_mm if self.dead_sigma == 0.0 else None
        return laterated(nominal, ranges, near, known)

    def _need_place(self, pose: Pose | None, key: str) -> None:
        if pose is None:
            raise KeyedError(
                f"{key}.station_mm",
                "nothing, with too few points from there to find the place",
                "the approximate place of the tracker",
                "add it, or measure more points from there",
            )

    def _at(self, poses: Sequence[Pose], others: Sequence[Pose]) -> Self:
        """The instrument with its stations at these poses."""
        made = dataclasses.replace(
            self,
            station=np.mean([pose.place for pose in poses], axis=0),
            orientation=poses[0].orientation,
        )
        if self.names:
            made = dataclasses.replace(
                made,
                places=np.array([pose.place for pose in poses]),
                orientations=np.array([pose.orientation for pose in poses]),
            )
        if others:
            made = dataclasses.replace(
                made,
                other_places=np.array([pose.place for pose in others]),
                other_turns=np.array([pose.orientation for pose in others]),
            )
        return made

    def _check_follows(
        self,
        chain: Chain,
        plan: Plan,
        table: Mapping[str, np.ndarray],
        seen: Float[np.ndarray, "n k"],
        declared: Sequence[Pose | None],
    ) -> None:
        """Raise `RowError` where the readings do not follow the axes."""
        if not np.ptp(seen, axis=0).any():
            return  # another check reports columns with the same number in every row
        at = self._station_of(table)

        def off(seen: Float[np.ndarray, "n k"]) -> Callable[[np.ndarray], np.ndarray]:
            def away(nominal: np.ndarray) -> np.ndarray:
                far = np.zeros(len(nominal))
                for i, pose in enumerate(declared):
                    here = at == i
                    if here.sum() < _FEWEST:
                        continue
                    if self.reads == "range":
                        near = None if pose is None else pose.place
                        known = float(self.dead[i]) if self.dead_sigma == 0.0 else None
                        found = laterated(nominal[here], seen[here, 0], near, known)
                        read = np.linalg.norm(nominal[here] - found.place, axis=1)
                        far[here] = np.abs(read - found.dead_path - seen[here, 0])
                        continue
                    turn, place = fitted_pose(seen[here], nominal[here])
                    far[here] = np.linalg.norm(seen[here] @ turn.T + place - nominal[here], axis=1)
                return far

            return away

        changed = [
            Variant(words, off(self._seen({**table, **columns})))
            for words, columns in _read_otherwise(self.reads, table)
        ]
        check_follows(
            chain,
            plan,
            off(seen),
            f"columns {', '.join(self._own_columns)}",
            points=lambda chain, position: self._points(chain, position, table),
            readings=changed,
            mirrors=self.reads != "range",
        )

    def declaration(self, station: Float[np.ndarray, "3"] | None = None) -> dict[str, Any]:
        """Keys of ``[instrument]`` that a plan without readings needs, where the table of this one
        determined them: the columns of readings and the poses. `station` is another place of the
        only station, m.
        """
        keys: dict[str, Any] = {}
        if self.reads == "cartesian":
            keys["readings"] = self.reads
        if station is not None:
            keys["station_mm"] = [round(1e3 * float(v), 6) for v in station]
        if not self.found:
            return keys
        turns = self.orientations if self.names else np.asarray(self.orientation)[None]
        places = self.places if self.names else np.asarray(self.station)[None]
        rows = [
            {
                "station_mm": [round(1e3 * float(v), 6) for v in place],
                "euler_xyz_deg": np.round(
                    Turn.from_matrix(np.asarray(turn)).as_euler("XYZ", degrees=True), 9
                ).tolist(),
                "dead_path_mm": round(1e3 * float(dead), 6),
            }
            for turn, place, dead in zip(turns, places, self.dead, strict=True)
        ]
        return keys | ({"stations": dict(zip(self.names, rows, strict=True))} if self.names
                       else {**rows[0], **keys})  # fmt: skip

    # --- plan and readings ------------------------------------------------------------------------
    @property
    def _own_columns(self) -> tuple[str, ...]:
        return _COLUMNS[self.reads]

    def _has_readings(self, table: Mapping[str, np.ndarray]) -> bool:
        return all(name in table for name in self._own_columns)

    def _station_of(self, table: Mapping[str, np.ndarray]) -> Int[np.ndarray, " n"]:
        """Index of the station of every row."""
        return _index(table, STATION, self.names)

    def _points(
        self, chain: Chain, position: np.ndarray, table: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "n 3"]:
        """Nominal places of the reflector in the workpiece frame, m."""
        turn, point = chain.tool_frame(position)
        if not self.tools:
            return point
        return point + np.einsum("nij,nj->ni", turn, self.offsets[_index(table, _TOOL, self.tools)])

    def _seen(self, table: Mapping[str, np.ndarray]) -> Float[np.ndarray, "n k"]:
        """Coordinates (n, 3) in the frame of the readings, or ranges alone (n, 1), m."""
        columns = [np.asarray(table[name], float) for name in self._own_columns]
        if self.reads == "cartesian":
            return 1e-3 * np.column_stack(columns)
        if self.reads == "range":
            return 1e-3 * columns[0][:, None]
        r, azimuth, elevation = columns
        level = np.cos(elevation)
        seen = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        return np.stack(seen, axis=1) * (1e-3 * r[:, None])

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        plan = linear_plan(chain, table, self._own_columns)
        groups = dict(plan.groups)
        if self.names:
            groups[STATION] = self._station_of(table)
        if self.tools:
            groups[_TOOL] = _index(table, _TOOL, self.tools)
        plan = dataclasses.replace(plan, groups=groups)
        if self._has_readings(table):
            return self._with_read(plan, self.measured(table))
        nominal = self._points(chain, np.asarray(plan.position), table)
        orientation, station = self._stands(plan)
        v = np.einsum("nji,nj->ni", orientation, nominal - station)
        r = np.linalg.norm(v, axis=1)
        if self.reads == "range":
            return self._with_read(plan, (r - self._dead_of(plan))[:, None])
        return self._with_read(plan, _polar(v))

    def _with_read(self, plan: Plan, readings: Float[np.ndarray, "n k"]) -> Plan:
        """The plan with distance (m), azimuth (-pi to pi) and elevation as covariates."""
        read = {"range": readings[:, 0] + self._dead_of(plan)}
        if self.reads != "range":
            azimuth, turn = readings[:, 1], 2.0 * np.pi
            read["azimuth"] = azimuth - turn * np.round(azimuth / turn)
            read["elevation"] = readings[:, 2]
        return dataclasses.replace(plan, covariates={**plan.covariates, **read})

    def _at_station(self, plan: Plan) -> Int[np.ndarray, " n"]:
        if not self.names or STATION not in plan.groups:
            return np.zeros(plan.rows, int)
        return np.asarray(plan.groups[STATION], int)

    def _stands(self, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
        """Orientation (n, 3, 3) and place (n, 3), m, of the station of every row."""
        if self.names:
            at = self._at_station(plan)
            return np.asarray(self.orientations)[at], np.asarray(self.places)[at]
        shape = (plan.rows, 3)
        return (
            np.broadcast_to(np.asarray(self.orientation), (*shape, 3)),
            np.broadcast_to(np.asarray(self.station), shape),
        )

    def _dead_of(self, plan: Plan) -> Float[np.ndarray, " n"]:
        """Dead path of every row, m."""
        return np.asarray(self.dead)[self._at_station(plan)]

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """Readings with noise, and the plan with range and angles without noise: those in the
        given plan may belong to a station at another position.
        """
        plan = self._with_read(plan, ideal(plan))
        return plan, ideal(plan) + noise

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        seen = self._seen(table)
        if self.reads == "range":
            return seen
        if self.reads == "polar":
            r, azimuth, elevation = (np.asarray(table[name], float) for name in _POLAR)
            return np.column_stack([1e-3 * r, azimuth, elevation])
        if len(self.other_places):
            at = self._station_of(table)
            turn, place = np.asarray(self.other_turns)[at], np.asarray(self.other_places)[at]
            seen = np.einsum("nji,nj->ni", turn, seen - place)
        return _polar(seen)

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        named = {STATION: self.names, _TOOL: self.tools}
        plain = {k: v for k, v in plan.groups.items() if not named.get(k)}
        table = linear_plan_table(dataclasses.replace(plan, groups=plain), _READ)
        for column, names in named.items():
            if names and column in plan.groups:
                table[column] = np.array(names)[np.asarray(plan.groups[column], int)]
        r = readings[:, 0]
        if self.reads == "range":
            return {**table, "range_mm": r * 1e3}
        azimuth, elevation = readings[:, 1], readings[:, 2]
        if self.reads == "polar":
            read = {"range_mm": r * 1e3, "azimuth_rad": azimuth, "elevation_rad": elevation}
            return {**table, **read}
        level = r * np.cos(elevation)
        v = np.column_stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)]
        )
        if len(self.other_places):
            at = self._at_station(plan)
            v = np.einsum("nij,nj->ni", np.asarray(self.other_turns)[at], v)
            v = v + np.asarray(self.other_places)[at]
        return {**table, **{name: 1e3 * v[:, i] for i, name in enumerate(_CARTESIAN)}}

    def rows(self, plan: Plan) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        if self.names:
            found["turn"], found["station"] = self._stands(plan)
        if self.dead.any():
            found["dead"] = self._dead_of(plan)
        if self.tools and _TOOL in plan.groups:
            found["offset"] = np.asarray(self.offsets)[np.asarray(plan.groups[_TOOL], int)]
        return found

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        row = row or {}
        if "offset" in row:
            tool = tool + rotation @ Vector.of(row["offset"])
        if "offset" in ports:
            tool = tool + rotation @ Vector.of(ports["offset"])
        orientation = row.get("turn", self.orientation)
        place = row.get("station", self.station)
        dead, read = row.get("dead", 0.0), ports["read"]
        if self.reads == "range":
            v = tool - Vector.of(place) - Vector.of(ports["frame"])
            return [jnp.sqrt(v.dot(v)) - dead + read[0]]
        turn, station = displaced(orientation, place, ports["frame"])
        v = turn.T @ (tool - station)
        length = jnp.sqrt(v.dot(v))
        ideal = length - dead, jnp.arctan2(v.y, v.x), jnp.arcsin(v.z / length)
        return [value + port for value, port in zip(ideal, read, strict=True)]

    def difference(self, measured: Array, predicted: Array) -> Array:
        d = measured - predicted
        if self.reads == "range":
            return d
        return d - jnp.array([0.0, 2 * jnp.pi, 0.0]) * jnp.round(d / (2 * jnp.pi))

    # --- what it declares -------------------------------------------------------------------------
    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        # Whole arrays, so that the readings may be traced while a design optimises positions.
        r = readings[:, :1] + self._dead_of(plan)[:, None]
        constant, growing = self.range_sigma, self.range_sigma_per_m * r
        if self.quadrature:
            xp = np if isinstance(r, np.ndarray) else jnp
            noise = xp.sqrt(constant**2 + growing**2)
        else:
            noise = constant + growing
        if self.reads == "range":
            return noise
        first = np.array([1.0, 0.0, 0.0])
        return noise * first + self.angle_sigma * (1.0 - first)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        if self.reads == "range":
            return np.ones((plan.rows, 1))
        r, elevation = readings[:, 0] + self._dead_of(plan), readings[:, 2]
        return np.column_stack([np.ones_like(r), r * np.cos(elevation), r])

    def dimensions(self, plan: Plan) -> np.ndarray:
        return np.full(plan.rows, 1 if self.reads == "range" else 3)

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        components = "XYZ" if self.reads == "range" else "XYZABC"
        numbers = range(len(self.names)) if self.names else (-1,)
        place = dict(enumerate(self.names))
        found: list[Effect] = [
            Station(components=components, number=i, placement=place.get(i, "")) for i in numbers
        ]
        if self.dead_sigma != 0.0:
            given = () if self.dead_sigma is None else (("length", 0.0, self.dead_sigma * 1e6),)
            found += [DeadPath(number=i, placement=place.get(i, ""), given=given) for i in numbers]
        if self.tools_sigma > 0.0:
            shifts = ToolOffsets(tools=self.tools)
            size = self.tools_sigma * 1e6
            own = tuple((p.name, 0.0, size) for p in shifts.parameters)
            found.append(ToolOffsets(tools=self.tools, given=own))
        return tuple(found)

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Five contiguous blocks in time of every station: neighbours in time share a drift, and no
        # other station contains the pose of one.
        t = plan.values("t") if plan.has("t") else np.zeros(plan.rows)
        fold, at = np.zeros(plan.rows, int), self._at_station(plan)
        for i in np.unique(at):
            here = np.flatnonzero(at == i)
            order = np.argsort(np.argsort(t[here], kind="stable"), kind="stable")
            fold[here] = order * 5 // len(here)
        return fold, False


def _spread(points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether points determine a pose: at least three that are not on one line."""
    if len(points) < _FEWEST - 1:
        return False
    return int(np.linalg.matrix_rank(points - points.mean(0), tol=_LINE_M)) > 1


def _polar(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Range, azimuth and elevation of coordinates in the tracker's frame."""
    r = np.linalg.norm(v, axis=1)
    return np.column_stack([r, np.arctan2(v[:, 1], v[:, 0]), np.arcsin(v[:, 2] / r)])


def _index(
    table: Mapping[str, np.ndarray], column: str, names: Sequence[str]
) -> Int[np.ndarray, " n"]:
    """Index of the name in a column in every row; zero where there are no names."""
    rows = len(next(iter(table.values())))
    if not names:
        return np.zeros(rows, int)
    place = {name: i for i, name in enumerate(names)}
    return np.array([place[str(name)] for name in table[column]], int)


def _names(column: np.ndarray) -> tuple[str, ...]:
    """The names in a column of text, in the order of their first rows."""
    return tuple(dict.fromkeys(str(name) for name in column))


def _check_named(column: str, values: np.ndarray, names: Sequence[str], key: str) -> None:
    """Raise `RowError` for a row with another name, or none."""
    for row, name in enumerate(values):
        if str(name) not in names:
            raise RowError(
                row,
                f"column {column}",
                repr(str(name)) if str(name) else "an empty cell",
                f"one of {', '.join(names)} ({key})",
                f"correct the name, or add it to {key}",
            )


def _station_names(
    settings: LaserTrackerSettings, table: Mapping[str, np.ndarray]
) -> tuple[str, ...]:
    """Names of several stations; empty where there is one."""
    if STATION not in table:
        return ()
    found = _names(table[STATION])
    if "" in found:
        _check_named(STATION, table[STATION], [n for n in found if n], "a name in every row")
    if settings.stations is None:
        return found if len(found) > 1 else ()
    _check_named(STATION, table[STATION], [*settings.stations], "instrument.stations")
    return tuple(name for name in settings.stations if name in found)


def _station_settings(
    settings: LaserTrackerSettings, names: Sequence[str]
) -> list[StationSettings]:
    if settings.stations is not None:
        return [settings.stations[name] for name in names]
    own = {name: getattr(settings, name) for name in StationSettings.model_fields}
    given = {name: own[name] for name in own if name in settings.model_fields_set}
    if not names:
        return [StationSettings(**given)]
    if any(name in given for name in ("station_mm", "station_in_frame_mm")):
        raise KeyedError(
            "instrument.station_mm" if "station_mm" in given else "instrument.station_in_frame_mm",
            f"one place for the {len(names)} stations {', '.join(names[:5])} of column station",
            "one for each in [instrument.stations], or none where the readings determine it",
            "write [instrument.stations] with a row per station, or remove the key",
        )
    return [StationSettings(**given) for _ in names]


def _tools(
    settings: LaserTrackerSettings, table: Mapping[str, np.ndarray], load: Loader
) -> dict[str, Any]:
    """Offsets of the tools by their names, mm; empty where all rows have that of the machine."""
    tools: Mapping[str, Any] | None = settings.tools
    key = "instrument.tools"
    if settings.tools_file is not None:
        key = settings.tools_file
        file = load(
            settings.tools_file,
            [Column(name=f"{c}_mm", low=-200e3, high=200e3) for c in "xyz"],
            labels=(_TOOL,),
        )
        tools = {
            str(name): (x, y, z)
            for name, x, y, z in zip(*(file[c] for c in (_TOOL, "x_mm", "y_mm", "z_mm")))
        }
        if len(tools) < len(file[_TOOL]):
            raise KeyedError(
                "instrument.tools_file",
                f"a tool twice in {settings.tools_file}",
                "every tool once",
                "remove one of them",
            )
    if _TOOL not in table:
        return {}
    found = _names(table[_TOOL])
    if tools is None:
        if len(found) == 1:
            return {}
        raise KeyedError(
            "instrument.tools",
            f"no offsets for the {len(found)} tools {', '.join(found[:5])} of column tool",
            "the offset of each, from the frame of the last axis to the reflector",
            f"add tools = {{ {found[0]} = [x, y, z], ... }}, or tools_file",
        )
    _check_named(_TOOL, table[_TOOL], [*tools], key)
    return {name: offset for name, offset in tools.items() if name in found}


def _declared(row: StationSettings) -> Pose | None:
    """The declared pose of a station; None without a place."""
    if row.station_mm is None:
        return None
    turn = Turn.from_euler("XYZ", row.euler_xyz_deg, degrees=True).as_matrix()
    return Pose(turn, 1e-3 * np.array(row.station_mm))


def _composed(frame: Pose, inner: Pose) -> Pose:
    """A pose in a frame, in the frame of that frame."""
    return Pose(
        frame.orientation @ inner.orientation, frame.orientation @ inner.place + frame.place
    )


def _in_other_frame(row: StationSettings, declared: Pose | None, frame: Pose, key: str) -> Pose:
    """Pose of a station in the frame of its coordinates, which is at `frame` in the workpiece's."""
    if declared is None and row.station_in_frame_mm is None:
        raise KeyedError(
            f"{key}.station_in_frame_mm",
            "nothing for coordinates in another frame than that of the tracker",
            "the place of the tracker in that frame, from where its noise is counted; or "
            "station_mm, its approximate place in the workpiece frame",
            "add one of them",
        )
    if declared is None:
        turn = np.eye(3)
    else:
        turn = frame.orientation.T @ declared.orientation
    if row.station_in_frame_mm is not None:
        return Pose(turn, 1e-3 * np.array(row.station_in_frame_mm))
    assert declared is not None
    return Pose(turn, frame.orientation.T @ (declared.place - frame.place))


def _elsewhere(
    row: StationSettings,
    key: str,
    declared: Pose | None,
    found: Pose,
    nominal: Float[np.ndarray, "n 3"],
    turned: bool = True,
) -> list[str]:
    """What is wrong with a declared pose, in words."""
    if declared is None:
        return []
    said, middle = [], nominal.mean(0)
    apart = float(np.linalg.norm(found.place - declared.place))
    if apart > max(_OTHER_PLACE * np.linalg.norm(found.place - middle), _OTHER_PLACE_M):
        place = ", ".join(f"{1e3 * v:.0f}" for v in found.place)
        said.append(
            f"the readings place the station at [{place}] mm, {apart:.3g} m from {key}.station_mm "
            f"= [{', '.join(f'{v:g}' for v in row.station_mm or ())}]; the place from the readings "
            "is used: compare station_mm with where the tracker stood"
        )
    if turned and "euler_xyz_deg" in row.model_fields_set:
        angle = Turn.from_matrix(declared.orientation.T @ found.orientation).magnitude()
        if np.rad2deg(angle) > _OTHER_DEG:
            said.append(
                f"the readings turn the station by {np.rad2deg(angle):.3g} deg from "
                f"{key}.euler_xyz_deg; the rotation from the readings is used: compare the azimuth "
                "zero with euler_xyz_deg"
            )
    return said


def _read_otherwise(
    reads: _Readings, table: Mapping[str, np.ndarray]
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Single changes of the columns of readings: what is changed, and the columns after it."""
    columns = {name: np.asarray(table[name], float) for name in _COLUMNS[reads]}
    lengths = [name for name in columns if name.endswith("_mm")]
    found: list[tuple[str, dict[str, np.ndarray]]] = []
    units = (("inches", 25.4), ("metres", 1e3), ("micrometres", 1e-3))
    for unit, factor in units:
        for names in ([name] for name in lengths):
            changed = {name: factor * columns[name] for name in names}
            found.append((f"{unit} turned into millimetres in {', '.join(names)}", changed))
        if len(lengths) > 1:
            changed = {name: factor * columns[name] for name in lengths}
            found.append((f"{unit} turned into millimetres in {', '.join(lengths)}", changed))
    if reads == "polar":
        angles = _POLAR[1:]
        for unit, factor in (("degrees", np.pi / 180.0), ("gon", np.pi / 200.0)):
            for names in (angles, angles[:1], angles[1:]):
                changed = {name: factor * columns[name] for name in names}
                found.append((f"{unit} turned into radians in {', '.join(names)}", changed))
        zenith = {angles[1]: 0.5 * np.pi - columns[angles[1]]}
        found.append((f"elevations instead of zenith angles in {angles[1]}", zenith))
        swapped = {angles[0]: columns[angles[1]], angles[1]: columns[angles[0]]}
        found.append((f"{' and '.join(angles)} exchanged", swapped))
        for name in angles:
            found.append((f"the other sign in {name}", {name: -columns[name]}))
    if reads == "cartesian":
        for a, b in itertools.combinations(_CARTESIAN, 2):
            found.append((f"{a} and {b} exchanged", {a: columns[b], b: columns[a]}))
        for name in _CARTESIAN:
            found.append((f"the other sign in {name}", {name: -columns[name]}))
    return found
