"""Laser tracker: range, azimuth and elevation of a reflector on the tool, or its coordinates, or
the range alone (multilateration), from one station or several.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation as Turn

from ..effects.base import Effect, Response
from ..effects.station import STATION, at_station
from ..errors import KeyedError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from .base import (
    Column,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import linear_plan, linear_plan_table
from .follow import Variant, check_follows
from .frame import Station, displaced
from .marks import Mark
from .stations import Lateration, Pose, fitted_pose, laterated
from .tracker_poses import composed, declared_pose, elsewhere, in_other_frame, read_otherwise_of
from .tracker_settings import (
    CARTESIAN,
    COLUMNS,
    POLAR,
    TOOL,
    LaserTrackerSettings,
    Readings,
    StationSettings,
    indices,
    station_names,
    station_settings,
    tool_offsets,
)

_READ = ("range", "azimuth", "elevation")
_CLOSE, _CLOSE_M = 0.02, 5e-3
"""Share of the size of the measured region, and distance, within which the declared pose is an
accurate start."""
_LINE_M = 1e-3
"""Width, m, below which points are on one line."""
_FEWEST = 4
"""Least number of points that determine a pose with something left to check it."""


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
        tool = np.asarray(plan.groups[TOOL])
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
    read_otherwise = (*POLAR, *CARTESIAN)

    station: np.ndarray
    """Place of the station (3,), m; the mean of several."""
    orientation: np.ndarray
    range_sigma: float
    range_sigma_per_m: float
    angle_sigma: float
    reads: Readings = eqx.field(static=True, default="polar")
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
    declared: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4, 3)))
    """Rotation and, in the last row, place (m) of every station as declared (stations, 4, 3); NaN
    where none is. It serves the picture of the machine only."""
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
        if settings.readings is None and CARTESIAN[0] in header:
            return settings.model_copy(update={"readings": "cartesian"})
        return settings

    @classmethod
    def label_columns(
        cls, settings: LaserTrackerSettings, header: Sequence[str]
    ) -> tuple[str, ...]:
        wanted = {
            STATION: settings.stations is not None,
            TOOL: settings.tools is not None or settings.tools_file is not None,
        }
        return tuple(name for name, needed in wanted.items() if needed or name in header)

    @classmethod
    def columns(
        cls, settings: LaserTrackerSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        if not readings:
            return []
        if settings.columns_of == "cartesian":
            return [Column(name=name, low=-200e3, high=200e3) for name in CARTESIAN]
        if settings.columns_of == "range":
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
        if settings.angle_sigma_urad is None and settings.columns_of != "range":
            raise KeyedError(
                "instrument.angle_sigma_urad",
                "nothing",
                "the noise of azimuth and elevation, unless ranges alone are read "
                '(readings = "range")',
                "add it",
            )
        names = station_names(settings, table)
        rows = station_settings(settings, names)
        tools = tool_offsets(settings, table, load)
        kind = settings.columns_of
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
        declared = [declared_pose(row) for row in rows]
        self = dataclasses.replace(self, declared=_stacked(declared))
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
                other = in_other_frame(row, pose, fit, own)
                others.append(other)
                fit = composed(fit, other)
            size = float(np.linalg.norm(nominal[here] - nominal[here].mean(0), axis=1).max())
            if pose is not None and not others:
                off = seen[here] @ pose.orientation.T + pose.place - nominal[here]
                if np.median(np.linalg.norm(off, axis=1)) <= max(_CLOSE * size, _CLOSE_M):
                    found.append(pose)
                    continue
            found.append(fit)
            new = True
            said += elsewhere(row, own, pose, fit, nominal[here])
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
            here, pose = at == i, declared_pose(row)
            if here.sum() <= _FEWEST:
                self._need_place(pose, own)
                assert pose is not None
                poses.append(pose)
                continue
            found = self._lateration(row, ranges[here], nominal[here])
            poses.append(Pose(np.eye(3), found.place))
            dead[i] = found.dead_path
            if pose is not None:
                said += elsewhere(row, own, pose, poses[-1], nominal[here], turned=False)
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
            for words, columns in read_otherwise_of(self.reads, table)
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
        return COLUMNS[self.reads]

    def _has_readings(self, table: Mapping[str, np.ndarray]) -> bool:
        return all(name in table for name in self._own_columns)

    def _station_of(self, table: Mapping[str, np.ndarray]) -> Int[np.ndarray, " n"]:
        """Index of the station of every row."""
        return indices(table, STATION, self.names)

    def _points(
        self, chain: Chain, position: np.ndarray, table: Mapping[str, np.ndarray]
    ) -> Float[np.ndarray, "n 3"]:
        """Nominal places of the reflector in the workpiece frame, m."""
        turn, point = chain.tool_frame(position)
        if not self.tools:
            return point
        return point + np.einsum("nij,nj->ni", turn, self.offsets[indices(table, TOOL, self.tools)])

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
            groups[TOOL] = indices(table, TOOL, self.tools)
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
            r, azimuth, elevation = (np.asarray(table[name], float) for name in POLAR)
            return np.column_stack([1e-3 * r, azimuth, elevation])
        if len(self.other_places):
            at = self._station_of(table)
            turn, place = np.asarray(self.other_turns)[at], np.asarray(self.other_places)[at]
            seen = np.einsum("nji,nj->ni", turn, seen - place)
        return _polar(seen)

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        named = {STATION: self.names, TOOL: self.tools}
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
        return {**table, **{name: 1e3 * v[:, i] for i, name in enumerate(CARTESIAN)}}

    def rows(self, plan: Plan) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        if self.names:
            found["turn"], found["station"] = self._stands(plan)
        if self.dead.any():
            found["dead"] = self._dead_of(plan)
        if self.tools and TOOL in plan.groups:
            found["offset"] = np.asarray(self.offsets)[np.asarray(plan.groups[TOOL], int)]
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

    def as_declared(self) -> Self:
        turns = self.orientations if self.names else np.asarray(self.orientation)[None]
        places = self.places if self.names else np.asarray(self.station)[None]
        poses = [Pose(np.asarray(t), np.asarray(p)) for t, p in zip(turns, places, strict=True)]
        for i, own in enumerate(self.declared):
            if np.isfinite(own).all():
                poses[i] = Pose(own[:3], own[3])
        return self._at(poses, ())

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        """The stations as declared, and where the readings place those that are not."""
        names = self.names or ("station",)
        places = self.places if self.names else np.reshape(self.station, (1, 3))
        turns = self.orientations if self.names else np.asarray(self.orientation)[None]
        found = []
        for i, name in enumerate(names):
            turn, place, free = turns[i], places[i], True
            if i < len(self.declared) and np.isfinite(self.declared[i]).all():
                turn, place, free = self.declared[i, :3], self.declared[i, 3], False
            polar = self.reads != "range"
            frame = np.asarray(turn) if polar else None
            found.append(
                Mark(name, np.reshape(place, (1, 3)), frame=frame, azimuth=polar, free=free)
            )
        return tuple(found)

    def seen_points(self, readings: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k 3"] | None:
        # Points in several frames, or ranges alone, are not points in one frame.
        if self.names or self.reads == "range":
            return None
        r, azimuth, elevation = np.asarray(readings).T
        level = r * np.cos(elevation)
        xyz = level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)
        return np.stack(xyz, axis=-1)[:, None]

    def difference(self, measured: Array, predicted: Array) -> Array:
        d = measured - predicted
        if self.reads == "range":
            return d
        return d - jnp.array([0.0, 2 * jnp.pi, 0.0]) * jnp.round(d / (2 * jnp.pi))

    # --- what it declares -------------------------------------------------------------------------
    def noise(self, plan: Plan, readings: Any) -> Any:
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


def _stacked(poses: Sequence[Pose | None]) -> Float[np.ndarray, "k 4 3"]:
    """Poses as arrays, NaN for none."""
    none = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
    return np.array([np.vstack(pose or none) for pose in poses])
