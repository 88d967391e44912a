"""Reflectors: coordinates of several points on the tool (and on the base) in a tracker's frame."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator
from scipy.spatial.transform import Rotation as Turn

from ..bounds import Angle, Coordinate, Noise, PlaceSigma, Within
from ..effects.base import Effect, Response
from ..errors import KeyedError, RowError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS, group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from ..numerics.spatial import best_rigid
from .arm_follow import check_arm_follows
from .arm_table import arm_columns, arm_plan, arm_table
from .base import (
    Column,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .base_drift import BaseDrift
from .frame import Station, displaced
from .marks import Mark

_MOTIONS = ("t1", "t2", "t3", "r1", "r2", "r3")
"""Motions along and about the principal axes of the reflectors on the base."""
_NOTHING = 1e-9
"""m or rad: below the resolution of any tracker."""
_MOST = 100
"""Most reflectors on the tool or the base: each one adds three columns and three unknowns."""

_COORDINATE = re.compile(r"(smr|base)\d+_[xyz]_mm")
"""Columns of the reflectors."""
_OTHER_UNIT, _LARGE_M = 5.0, 0.05
"""Ratio of sizes that indicates another unit, and the least size at which it is checked."""


class ReflectorsSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "reflectors"``."""

    tool_reflectors: Annotated[int, Within(1, _MOST, "no tool carries more reflectors")]
    """Number of reflectors on the tool."""
    base_reflectors: Annotated[int, Within(0, _MOST, "no base carries more reflectors")] = 0
    """Number of reflectors on the base."""
    sigma_um: Noise
    """Noise of each coordinate of a reflector, one standard deviation."""
    joints: Literal["commanded", "read"] = "commanded"
    """Which joint positions move the model: those commanded or those read back."""
    station_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Place of the tracker in the frame of the arm's base, where it is known; without it, the pose
    of the tracker is identified freely."""
    euler_xyz_deg: tuple[Angle, Angle, Angle] | None = None
    """Rotation of the tracker in that frame, R = Rx Ry Rz."""
    station_sigma_um: PlaceSigma = 0.0
    """Prior standard deviation of each coordinate of `station_mm`; 0 where it is known."""
    station_sigma_urad: PlaceSigma = 0.0
    """Prior standard deviation of each rotation of the tracker; 0 where it is known."""
    reflectors_mm: tuple[tuple[Coordinate, Coordinate, Coordinate], ...] | None = None
    """Coordinates of every reflector on the tool, from the tool point in the frame of the flange,
    where they are known; without them, they are identified freely."""
    reflectors_sigma_um: PlaceSigma = 0.0
    """Prior standard deviation of each of these coordinates; 0 where they are known."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.station_mm is None) != (self.euler_xyz_deg is None):
            missing = "station_mm" if self.station_mm is None else "euler_xyz_deg"
            raise ValueError(
                f"found a pose of the tracker without {missing}, expected both station_mm and "
                "euler_xyz_deg, or neither; add or remove one"
            )
        uses = {
            "station_sigma_um": "station_mm",
            "station_sigma_urad": "station_mm",
            "reflectors_sigma_um": "reflectors_mm",
        }
        for key, needed in uses.items():
            if key in self.model_fields_set and getattr(self, needed) is None:
                raise ValueError(
                    f"found {key} without {needed}, expected the value that it is the uncertainty "
                    f"of; add {needed}, or remove it"
                )
        if self.reflectors_mm is not None and len(self.reflectors_mm) != self.tool_reflectors:
            raise ValueError(
                f"found reflectors_mm of {len(self.reflectors_mm)} reflectors, expected "
                f"{self.tool_reflectors} (tool_reflectors); add or remove some"
            )
        return self


class ToolPoints(Effect):
    """Positions of the reflectors on the tool from their initial values: three parameters each,
    with flat priors.
    """

    name = "tool_points"
    summary = "positions of the reflectors on the tool"
    kind = "nuisance"
    where = "instrument"
    count: int = 1

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{k}.{c}", "um", scale=1000.0)
            for k in range(1, self.count + 1)
            for c in "XYZ"
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = jnp.ones(plan.rows)
        return {(f"point{k}.{c}", f"{k}.{c}"): one for k in range(1, self.count + 1) for c in "XYZ"}


class BaseReflectors(Effect):
    """Uncertainty of the motion of the frame as estimated from the reflectors on the base: along
    and about each of their principal axes, independent at every pose
    (`vcal.instruments.base_drift`).
    """

    name = "base_reflectors"
    summary = "uncertainty of the frame's motion as estimated from reflectors on the base"
    kind = "random"
    where = "instrument"
    twists: np.ndarray
    """Motion of the frame (6, 6), `frame.X` to `frame.C`, per unit along and about each axis."""
    u: np.ndarray
    """Standard uncertainty along (m) and about the axes (rad)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(name, "um" if name[0] == "t" else "urad", sigma=u * 1e6)
            for name, u in zip(_MOTIONS, self.u.tolist(), strict=True)
            if u > _NOTHING
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = np.ones(plan.rows)
        return {
            (f"frame.{c}", name): value * one
            for name, u, twist in zip(_MOTIONS, self.u, self.twists, strict=True)
            if u > _NOTHING
            for c, value in zip(COMPONENTS, twist, strict=True)
        }


@register
class Reflectors(TableInstrument):
    """Coordinates v_k = R'(p + R_tool r_k - s) of the tool's reflectors, in the frame of the base.

    Where at least three reflectors on the base were measured at every pose, each row is corrected
    first for the motion of the tracker estimated from them (`vcal.instruments.base_drift`); the
    uncertainty of that motion is noise common to the whole pose. The pose of the base and the
    positions of the reflectors on the tool are nuisances.
    """

    kind = "reflectors"
    arms = True
    remembers = True
    Settings = ReflectorsSettings

    count: int
    base_count: int
    sigma: float
    joints: str
    station: np.ndarray
    orientation: np.ndarray
    points: np.ndarray
    """Initial positions of the reflectors on the tool (count, 3), m."""
    base_centre: np.ndarray
    """Middle of the reflectors on the base in the tracker's frame, m."""
    base_axes: np.ndarray
    """Their principal axes, one per row."""
    base_u: np.ndarray
    """Standard uncertainty along (m) and about these axes (rad); zero without reflectors."""
    uncoupled: np.ndarray | None = None
    """Matrix from positions of the joints to their columns (SI), where the control couples them."""
    station_u: tuple[float, float] | None = eqx.field(static=True, default=None)
    """Prior standard deviation of the declared place (m) and rotation (rad) of the tracker; None
    where they are free."""
    points_u: float | None = eqx.field(static=True, default=None)
    """Prior standard deviation of the declared positions of the reflectors, m; None: free."""

    @property
    def ports(self) -> tuple[str, ...]:
        points = [group(f"point{k}", ("X", "Y", "Z")) for k in range(1, self.count + 1)]
        return group("frame") + tuple(name for names in points for name in names)

    @property
    def frame_pose(self) -> tuple[np.ndarray, np.ndarray]:
        return self.orientation, self.station

    @property
    def tool_places(self) -> Mapping[str, np.ndarray]:
        return {f"point{k + 1}": place for k, place in enumerate(np.asarray(self.points))}

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        place, frame = np.reshape(self.station, (1, 3)), np.asarray(self.orientation)
        station = Mark("tracker", place, frame=frame, free=self.station_u is None)
        reflectors = np.asarray(self.points)
        return station, Mark("reflector", reflectors, "tool", free=self.points_u is None)

    def seen_points(self, readings: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k 3"]:
        return np.asarray(readings, float).reshape(-1, self.count, 3)

    @property
    def readings(self) -> tuple[str, ...]:
        return tuple(f"{k}.{c}" for k in range(1, self.count + 1) for c in "XYZ")

    @classmethod
    def columns(
        cls, settings: ReflectorsSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        found = arm_columns(axes, settings.joints)
        if readings:
            found += [
                Column(name=f"{kind}{k}_{c}_mm", low=-1e5, high=1e5)
                for kind, count in (
                    ("smr", settings.tool_reflectors),
                    ("base", settings.base_reflectors),
                )
                for k in range(1, count + 1)
                for c in "xyz"
            ]
        return found

    @classmethod
    def build(
        cls,
        settings: ReflectorsSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        drift = _drift(table, settings.base_reflectors)
        return cls(
            count=settings.tool_reflectors,
            base_count=settings.base_reflectors,
            sigma=settings.sigma_um * 1e-6,
            joints=settings.joints,
            station=1e-3 * np.array(settings.station_mm or (0.0, 0.0, 0.0)),
            orientation=Turn.from_euler(
                "XYZ", settings.euler_xyz_deg or (0.0, 0.0, 0.0), degrees=True
            ).as_matrix(),
            points=_on_a_circle(settings.tool_reflectors)
            if settings.reflectors_mm is None
            else 1e-3 * np.array(settings.reflectors_mm),
            station_u=None
            if settings.station_mm is None
            else (settings.station_sigma_um * 1e-6, settings.station_sigma_urad * 1e-6),
            points_u=None
            if settings.reflectors_mm is None
            else settings.reflectors_sigma_um * 1e-6,
            base_centre=np.zeros(3) if drift is None else drift.centre,
            base_axes=np.eye(3) if drift is None else drift.axes,
            base_u=np.zeros(6) if drift is None else drift.u,
            uncoupled=None if chain.coupling is None else np.linalg.inv(chain.coupling),
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        own = {name for name in table if _COORDINATE.fullmatch(name)}
        return arm_plan(chain, table, self.joints, own)

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        tool = _points(table, "smr", self.count)
        drift = _drift(table, self.base_count)
        return (tool if drift is None else drift.undone(tool)).reshape(len(tool), -1)

    def _commands(self, position: np.ndarray) -> np.ndarray:
        """Commands (n, joints) that lead to positions of the joints."""
        return position if self.uncoupled is None else position @ self.uncoupled.T

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        table = arm_table(plan, self._commands)
        for k in range(self.count):
            for i, c in enumerate("xyz"):
                table[f"smr{k + 1}_{c}_mm"] = readings[:, 3 * k + i] * 1e3
        # A simulated tracker does not drift: its base reflectors are stationary.
        for k in range(self.base_count):
            for i, c in enumerate("xyz"):
                table[f"base{k + 1}_{c}_mm"] = np.full(plan.rows, 500.0 * (i == k % 3))
        return table

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        turn, station = displaced(self.orientation, self.station, ports["frame"])
        coordinates: list[Scalar] = []
        for k in range(self.count):
            place = Vector.of(self.points[k]) + Vector.of(ports[f"point{k + 1}"])
            coordinates += (turn.T @ (tool + rotation @ place - station)).parts
        return coordinates

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.full((plan.rows, 3 * self.count), self.sigma)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 3 * self.count))

    @property
    def on_tool(self) -> tuple[str, ...]:
        return (ToolPoints.name,)

    def start(self, chain: Chain, plan: Plan, readings: np.ndarray) -> Self:
        seen = np.asarray(readings)
        _check_size(chain, plan, seen[:, :3])
        check_arm_follows(
            chain,
            np.asarray(plan.position),
            seen.reshape(plan.rows, self.count, 3),
            "columns smr1_x_mm, smr1_y_mm, smr1_z_mm" + (", ..." if self.count > 1 else ""),
            f"{self.joints}_",
        )
        return self._placed(chain, plan, readings, self.points_u is not None)

    def with_tool_of(
        self, other: Self, chain: Chain, plan: Plan, readings: np.ndarray | None
    ) -> Self:
        if self.count != other.count:
            raise ValueError(f"{self.count} reflectors in place of {other.count}")
        declared = self.points_u is not None
        if self.points_u != other.points_u or declared and (self.points != other.points).any():
            raise ValueError("other reflectors_mm or another reflectors_sigma_um")
        same = dataclasses.replace(self, points=other.points)
        return same if readings is None else same._placed(chain, plan, readings, True)

    def _placed(self, chain: Chain, plan: Plan, readings: np.ndarray, known: bool) -> Self:
        """Initial pose of the base, and initial positions of the reflectors unless `known`."""
        rotations, origins = chain.tool_frame(np.asarray(plan.position))
        measured = readings.reshape(plan.rows, self.count, 3)
        points = self.points if known else np.zeros((self.count, 3))
        orientation, station = self.orientation, self.station
        # The base's pose and the points on the tool appear as a product; alternate between the
        # two closed-form solutions, which halves the error in every round.
        for _ in range(200):
            if self.station_u is None:
                model = origins[:, None] + np.einsum("nij,kj->nki", rotations, points)
                orientation, station = best_rigid(measured.reshape(-1, 3), model.reshape(-1, 3))
            if known:
                break
            seen = measured @ orientation.T + station
            new = np.einsum("nji,nkj->ki", rotations, seen - origins[:, None]) / plan.rows
            if np.abs(new - points).max() < 1e-7:
                break
            points = new
        return dataclasses.replace(self, station=station, orientation=orientation, points=points)

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        found: list[Effect] = []
        if self.station_u is None:
            found.append(Station())
        elif any(self.station_u):
            found.append(Station(given=_given("XYZ", self.station_u[0], "ABC", self.station_u[1])))
        if self.points_u is None:
            found.append(ToolPoints(count=self.count))
        elif self.points_u > 0.0:
            points = ToolPoints(count=self.count)
            names = [p.name for p in points.parameters]
            found.append(ToolPoints(count=self.count, given=_given(names, self.points_u)))
        if self.base_u.max() <= _NOTHING:
            return tuple(found)
        # A point at v moves by e along an axis e, and by e x (v - c) about it, c the middle.
        levers = np.cross(self.base_axes, self.base_centre) @ self.orientation.T
        along, about = self.base_axes @ self.orientation.T, -self.base_axes
        twists = np.block([[along, np.zeros((3, 3))], [levers, about]])
        return (*found, BaseReflectors(twists=twists, u=self.base_u))

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # The last fifth in time is never fitted: an arm is used after its calibration.
        in_time = np.argsort(np.asarray(plan.groups["pose"]), kind="stable")
        held = np.argsort(in_time) >= plan.rows - plan.rows // 5
        return np.where(held, 0, -1), True

    def clusters(self, plan: Plan) -> np.ndarray:
        return np.zeros(plan.rows, int)


def _given(*sizes: Any) -> tuple[tuple[str, float, float], ...]:
    """Declared values of zero of parameters, with their standard deviations (m or rad): names,
    size, names, size, ...
    """
    pairs = zip(sizes[::2], sizes[1::2], strict=True)
    return tuple((name, 0.0, size * 1e6) for names, size in pairs for name in names)


def _check_size(chain: Chain, plan: Plan, seen: np.ndarray) -> None:
    """Raise `RowError` where positions (n, 3), m, of a reflector extend over far less than the tool
    of the nominal arm, or over far more while the angles are small enough to be radians: with free
    links, a fit could absorb a wrong unit.
    """
    position = np.asarray(plan.position)
    nominal = chain.tool_point(position)
    size, expected = (np.sqrt(((p - p.mean(0)) ** 2).sum(1).mean()) for p in (seen, nominal))
    small = expected > _LARGE_M and size < expected / _OTHER_UNIT
    turning = [joint.turns for joint in chain.joints]
    angles = np.abs(position[:, turning])
    radians = angles.size > 0 and angles.max() <= math.radians(2.0 * math.pi)
    if not small and not (radians and size > _LARGE_M and size > _OTHER_UNIT * expected):
        return
    raise RowError(
        int(np.argmax(((nominal - nominal.mean(0)) ** 2).sum(1))),
        "columns smr1_x_mm, smr1_y_mm, smr1_z_mm" if small else "columns of the joint angles",
        f"positions of a reflector within {1e3 * size:.4g} mm (rms about their mean), while the "
        f"arm moves its tool by {1e3 * expected:.4g} mm",
        "about the same, in millimetres and degrees",
        "correct the unit of the reflectors' columns"
        if small
        else "convert the angles to degrees, if they are radians",
    )


def _on_a_circle(count: int) -> np.ndarray:
    """Assumed positions on the tool (count, 3), m, without readings: 60 mm from its axis."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.column_stack([0.06 * np.cos(angle), 0.06 * np.sin(angle), np.full(count, 0.03)])


def _drift(table: Mapping[str, np.ndarray], count: int) -> BaseDrift | None:
    """The motion estimated from the reflectors on the base; None where there are too few."""
    if count < 3 or "base1_x_mm" not in table:
        return None
    base = _points(table, "base", count)
    try:
        return BaseDrift.of(base, np.asarray(table["pose"], float))
    except ValueError as error:
        raise KeyedError(
            "instrument.base_reflectors",
            f"{count} reflectors {error}",
            "reflectors that span a plane, as the rotation about a line is not observable",
            "set it to 0, if the tracker does not drift, or measure others",
        ) from error


def _points(table: Mapping[str, np.ndarray], kind: str, count: int) -> np.ndarray:
    return (
        np.stack(
            [
                np.column_stack([table[f"{kind}{k}_{c}_mm"] for c in "xyz"])
                for k in range(1, count + 1)
            ],
            axis=1,
        )
        * 1e-3
    )
