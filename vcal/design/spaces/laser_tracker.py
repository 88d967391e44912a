"""The space of a laser tracker: its points, and the position of its station."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ...bounds import Coordinate
from ...instruments.laser_tracker import LaserTracker
from ...machine.chain import Chain
from ...model.forward import tool_points
from ...numerics.arrays import Array
from ..plan_space import Subject, register
from .points import Placed, PointsDesign, PointSpace, check_bounds

_ANGLES = 13
"""Angles of a rotary axis at which the work space is evaluated."""


class TrackerDesign(PointsDesign):
    """Keys of ``[design]`` for ``kind = "laser_tracker"``."""

    station: bool = False
    """Whether the station may move within the bounds below."""
    station_low_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Lowest coordinates of the station in the workpiece frame."""
    station_high_mm: tuple[Coordinate, Coordinate, Coordinate] | None = None
    """Highest coordinates of the station in the workpiece frame."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.station:
            check_bounds("station", "station", self.station_low_mm, self.station_high_mm)
        return self


@register
@dataclass(frozen=True)
class TrackerSpace(PointSpace):
    """Points within the travel, including rotary axes, and the position of the station.

    The station rotates with a rotary table. Its distance from a point is at least the smallest
    range in its data, a millimetre. Its orientation is fixed, as no uncertainty depends on it.
    Several stations stay where they are declared, and every row keeps its station and its tool.
    """

    kind = "laser_tracker"
    Settings = TrackerDesign
    rotary = True

    @classmethod
    def follows(cls, chain: Chain) -> tuple[str, ...]:
        return ("range", "azimuth", "elevation")

    def following_from(self, placed: Placed) -> Mapping[str, Float[Array, " n"]]:
        position, device = jnp.asarray(placed.position), self.device
        first = 6 * len(self.chain.joints)
        ports = jnp.zeros((len(position), first + 6))
        if device.tools:
            offset = np.asarray(device.offsets)[self.index["tool"]]
            ports = ports.at[:, first : first + 3].set(offset)
        point = tool_points(self.chain, position, ports)
        if device.names:
            at = self.index["station"]
            turn, place = np.asarray(device.orientations)[at], np.asarray(device.places)[at]
            v = jnp.einsum("nji,nj->ni", turn, point - place)
        else:
            v = (point - placed.station) @ device.orientation
        r = jnp.sqrt((v**2).sum(1))
        if device.reads == "range":
            return {"range": r}
        return {
            "range": r,
            "azimuth": jnp.arctan2(v[:, 1], v[:, 0]),
            "elevation": jnp.arcsin(v[:, 2] / r),
        }

    def standing(self, station: Float[Array, " s"]) -> LaserTracker:
        if self.device.names:
            return self.device
        return eqx.tree_at(lambda i: i.station, self.device, station)

    @classmethod
    def stands(cls, subject: Subject, settings: TrackerDesign) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(subject.instrument, LaserTracker)
        place = np.asarray(subject.instrument.station)
        low, high = settings.station_low_mm, settings.station_high_mm
        if not settings.station or low is None or high is None:
            return place, np.zeros((0, 2))
        if subject.instrument.names:
            raise subject.refusal(
                "station",
                f"true with {len(subject.instrument.names)} stations",
                "one station, as only its place can be optimised",
                "set it to false, or design the stations one by one",
            )
        room = np.column_stack([low, high]) * 1e-3
        low, high = work_space(subject.chain)
        if ((room[:, 0] < high) & (room[:, 1] > low)).all():
            raise subject.refusal(
                "station_low_mm",
                "bounds of the station that reach into the work space",
                "bounds outside it, where the tool does not get",
                "move one of the bounds",
            )
        return place, room

    def station(self, placed: Placed) -> Float[np.ndarray, "3"] | None:
        if self.device.names:
            return None
        return np.asarray(placed.station) - np.asarray(self.chain.tool_offset)

    def changed(self, placed: Placed) -> Mapping[str, Any]:
        return self.device.declaration(np.asarray(placed.station) if len(self.room) else None)


def work_space(chain: Chain) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest coordinates of the nominal tool point in the workpiece frame, m.

    They are evaluated at the ends of the travel of linear axes and at some angles of the others.
    """
    ends = [
        np.linspace(*np.asarray(joint.travel).tolist(), num=_ANGLES if joint.turns else 2)
        for joint in chain.joints
    ]
    every = np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(-1, len(ends))
    reached = chain.tool_point(every)
    return reached.min(0), reached.max(0)
