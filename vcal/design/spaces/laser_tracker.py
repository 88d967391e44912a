"""Laser tracker: where its points are, and where it stands."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from ...instruments.laser_tracker import LaserTracker
from ...machine.chain import Chain
from ...model.forward import tool_points
from ...numerics.arrays import Array
from ..plan_space import Subject, register
from .points import Placed, PointsDesign, PointSpace, check_bounds

_ANGLES = 13
"""Of a rotary axis, at which the work space is looked at."""


class TrackerDesign(PointsDesign):
    """Keys of ``[design]`` for ``kind = "laser_tracker"``."""

    station: bool = False
    """Whether the tracker may stand elsewhere, within the bounds below."""
    station_low_mm: tuple[float, float, float] | None = None
    """Lowest place of the station in the workpiece frame."""
    station_high_mm: tuple[float, float, float] | None = None
    """Highest place of the station."""

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.station:
            check_bounds("station", "station", self.station_low_mm, self.station_high_mm)
        return self


@register
@dataclass(frozen=True)
class TrackerSpace(PointSpace):
    """A laser tracker: points within the travel, also of rotary axes, and the place of the station,
    which turns with the table where that turns.

    A tracker does not come nearer to a point than its data may say, a millimetre; how it is turned
    stays, as no uncertainty depends on it.
    """

    kind = "laser_tracker"
    Settings = TrackerDesign
    rotary = True

    @classmethod
    def follows(cls, chain: Chain) -> tuple[str, ...]:
        return ("range", "azimuth", "elevation")

    def following_from(self, placed: Placed) -> Mapping[str, Float[Array, " n"]]:
        position = jnp.asarray(placed.position)
        still = jnp.zeros((len(position), 6 * len(self.chain.joints) + 6))
        point = tool_points(self.chain, position, still)
        v = (point - placed.station) @ self.device.orientation
        r = jnp.sqrt((v**2).sum(1))
        return {
            "range": r,
            "azimuth": jnp.arctan2(v[:, 1], v[:, 0]),
            "elevation": jnp.arcsin(v[:, 2] / r),
        }

    def standing(self, station: Float[Array, " s"]) -> LaserTracker:
        return eqx.tree_at(lambda i: i.station, self.device, station)

    @classmethod
    def stands(cls, subject: Subject, settings: TrackerDesign) -> tuple[np.ndarray, np.ndarray]:
        assert isinstance(subject.instrument, LaserTracker)
        place = np.asarray(subject.instrument.station)
        low, high = settings.station_low_mm, settings.station_high_mm
        if not settings.station or low is None or high is None:
            return place, np.zeros((0, 2))
        room = np.column_stack([low, high]) * 1e-3
        low, high = work_space(subject.chain)
        if ((room[:, 0] < high) & (room[:, 1] > low)).all():
            raise subject.refusal(
                "station_low_mm",
                "a room for the station that reaches into the work space",
                "one beside it, where no point of the tool gets",
                "move one of its bounds",
            )
        return place, room

    def station(self, placed: Placed) -> Float[np.ndarray, "3"]:
        return np.asarray(placed.station) - np.asarray(self.chain.tool_offset)

    def changed(self, placed: Placed) -> Mapping[str, Any]:
        if not len(self.room):
            return {}
        return {"station_mm": [round(1e3 * float(v), 6) for v in np.asarray(placed.station)]}


def work_space(chain: Chain) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest coordinates of the nominal tool point in the frame of the workpiece, m, at
    the ends of the travel of linear axes and at some angles of the others.
    """
    ends = [
        np.linspace(*np.asarray(joint.travel).tolist(), num=_ANGLES if joint.turns else 2)
        for joint in chain.joints
    ]
    every = np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(-1, len(ends))
    reached = chain.tool_point(every)
    return reached.min(0), reached.max(0)
