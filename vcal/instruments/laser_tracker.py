"""Laser tracker: range, azimuth and elevation of a reflector at the tool point."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field

from ..effects.base import Effect
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from ..numerics.spatial import best_rigid, euler_xyz
from .base import (
    LARGEST_NOISE,
    SMALLEST_NOISE,
    Column,
    InstrumentSettings,
    Loader,
    Ports,
    TableInstrument,
    register,
)
from .conditions import linear_plan, linear_plan_table
from .follow import check_follows
from .frame import Station, displaced
from .marks import Mark

_Coordinate = Annotated[float, Field(ge=-200e3, le=200e3)]
_Angle = Annotated[float, Field(ge=-360, le=360)]
_READ = ("range", "azimuth", "elevation")
_COLUMNS = ("range_mm", "azimuth_rad", "elevation_rad")
_RANGE = np.array([1.0, 0.0, 0.0])


class LaserTrackerSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "laser_tracker"``."""

    range_sigma_um: float = Field(ge=SMALLEST_NOISE, le=LARGEST_NOISE)
    """Noise of the range, one standard deviation: the part that does not depend on the range."""
    range_sigma_um_per_m: float = Field(default=0.0, ge=0, le=LARGEST_NOISE)
    """The part that grows with the range; it is added to the other one."""
    angle_sigma_urad: float = Field(ge=SMALLEST_NOISE, le=LARGEST_NOISE)
    """Noise of azimuth and elevation, one standard deviation."""
    station_mm: tuple[_Coordinate, _Coordinate, _Coordinate]
    """Approximate place of the tracker in the workpiece frame; it is identified."""
    euler_xyz_deg: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)
    """Approximate rotation of the tracker, R = Rx Ry Rz; it is identified."""


@register
class LaserTracker(TableInstrument):
    """Range r = norm(v), azimuth atan2(v_y, v_x), elevation asin(v_z / r) with v = R'(p - station).

    Noise: range sigma a + b r (added linearly), one sigma for both angles. The station's pose (R =
    Rx Ry Rz of the nominal Euler angles) is a nuisance with six parameters. The station is on the
    table, with the workpiece, and moves and rotates with it.

    The tracker's errors depend on its readings, not on the estimated station: range and angles of a
    plan are the readings, or those from the nominal station where there are none.
    """

    kind = "laser_tracker"
    Settings = LaserTrackerSettings
    derived = _READ
    rotary = True
    parallel = True

    station: np.ndarray
    orientation: np.ndarray
    range_sigma: float
    range_sigma_per_m: float
    angle_sigma: float

    @property
    def ports(self) -> tuple[str, ...]:
        return group("frame") + group("read", _READ)

    @property
    def readings(self) -> tuple[str, ...]:
        return _READ

    @classmethod
    def columns(
        cls, settings: LaserTrackerSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        if not readings:
            return []
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
        angles = np.deg2rad(np.asarray(settings.euler_xyz_deg, float))
        if all(name in table for name in _COLUMNS):
            _check_follows(chain, table)
        return cls(
            station=np.asarray(settings.station_mm, float) * 1e-3,
            orientation=np.asarray(euler_xyz(jnp.asarray(angles))),
            range_sigma=settings.range_sigma_um * 1e-6,
            range_sigma_per_m=settings.range_sigma_um_per_m * 1e-6,
            angle_sigma=settings.angle_sigma_urad * 1e-6,
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        plan = linear_plan(chain, table, _COLUMNS)
        if all(name in table for name in _COLUMNS):
            return _with_read(plan, self.measured(table))
        nominal = chain.tool_point(np.asarray(plan.position))
        v = (nominal - self.station) @ self.orientation
        r = np.linalg.norm(v, axis=1)
        seen = r, np.arctan2(v[:, 1], v[:, 0]), np.arcsin(v[:, 2] / r)
        return _with_read(plan, np.column_stack(seen))

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """Readings with noise, and the plan with range and angles without noise: those in the
        given plan may belong to a station at another position.
        """
        plan = _with_read(plan, ideal(plan))
        return plan, ideal(plan) + noise

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        r, azimuth, elevation = (np.asarray(table[name], float) for name in _COLUMNS)
        return np.column_stack([1e-3 * r, azimuth, elevation])

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        return {
            **linear_plan_table(plan, _READ),
            "range_mm": readings[:, 0] * 1e3,
            "azimuth_rad": readings[:, 1],
            "elevation_rad": readings[:, 2],
        }

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        turn, station = displaced(self.orientation, self.station, ports["frame"])
        v = turn.T @ (tool - station)
        length = jnp.sqrt(v.dot(v))
        ideal = length, jnp.arctan2(v.y, v.x), jnp.arcsin(v.z / length)
        return [value + port for value, port in zip(ideal, ports["read"], strict=True)]

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        place = np.reshape(self.station, (1, 3))
        return (Mark("station", place, frame=np.asarray(self.orientation), azimuth=True),)

    def seen_points(self, readings: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k 3"]:
        r, azimuth, elevation = np.asarray(readings).T
        level = r * np.cos(elevation)
        xyz = level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)
        return np.stack(xyz, axis=-1)[:, None]

    def difference(self, measured: Array, predicted: Array) -> Array:
        d = measured - predicted
        return d - jnp.array([0.0, 2 * jnp.pi, 0.0]) * jnp.round(d / (2 * jnp.pi))

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        r = readings[:, 0]
        # Whole arrays, so that the readings may be traced while a design optimises positions.
        return (
            self.range_sigma * _RANGE
            + self.range_sigma_per_m * r[:, None] * _RANGE
            + (self.angle_sigma * (1.0 - _RANGE))
        )

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        r, elevation = readings[:, 0], readings[:, 2]
        return np.column_stack([np.ones_like(r), r * np.cos(elevation), r])

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        return (Station(),)

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Five contiguous blocks in time: neighbours in time share a drift.
        t = plan.values("t") if plan.has("t") else np.zeros(plan.rows)
        place = np.argsort(np.argsort(t, kind="stable"), kind="stable")
        return place * 5 // plan.rows, False


def _check_follows(chain: Chain, table: Mapping[str, np.ndarray]) -> None:
    """Raise `RowError` where the readings do not follow the axes."""
    r, azimuth, elevation = (np.asarray(table[name], float) for name in _COLUMNS)
    level = np.cos(elevation)
    seen = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
    ) * (1e-3 * r[:, None])
    if not np.ptp(seen, axis=0).any():
        return  # another check reports columns with the same number in every row

    def off(nominal: np.ndarray) -> np.ndarray:
        turn, place = best_rigid(seen, nominal)
        return np.linalg.norm(seen @ turn.T + place - nominal, axis=1)

    check_follows(chain, linear_plan(chain, table, _COLUMNS), off, f"columns {', '.join(_COLUMNS)}")


def _with_read(plan: Plan, readings: Float[np.ndarray, "n 3"]) -> Plan:
    """The plan with range (m), azimuth (-pi to pi) and elevation as covariates."""
    r, azimuth, elevation = readings.T
    turn = 2.0 * np.pi
    read = {"range": r, "azimuth": azimuth - turn * np.round(azimuth / turn)}
    covariates = {**plan.covariates, **read, "elevation": elevation}
    return dataclasses.replace(plan, covariates=covariates)
