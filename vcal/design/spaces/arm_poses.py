"""The common space of instruments on an arm: the poses of the arm."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...instruments.arm_table import moves
from ...instruments.base import TableInstrument
from ...machine.chain import Chain
from ...numerics.arrays import Array
from .points import Placed, PointSpace


@dataclass(frozen=True)
class ArmPoseSpace(PointSpace):
    """Positions of the joints of an arm within their bounds, as commanded or as read back.

    Directions and sizes of the moves into a pose follow from the order of the poses.
    """

    group = "pose"

    @classmethod
    def follows(cls, chain: Chain) -> tuple[str, ...]:
        own = ("commanded", "read", "dir", "move")
        return ("order", *(f"{name}_{axis}" for name in own for axis in chain.axes))

    def following_from(self, placed: Placed) -> Mapping[str, Float[Array, " n"]]:
        angle = jnp.asarray(placed.position)
        pose = np.asarray(self.index["pose"])
        move, direction = moves(angle, pose)
        found: dict[str, Array] = {"order": jnp.asarray(pose, float)}
        for i, axis in enumerate(self.chain.axes):
            found[f"commanded_{axis}"] = found[f"read_{axis}"] = angle[:, i]
            found[f"dir_{axis}"], found[f"move_{axis}"] = direction[:, i], move[:, i]
        return found

    def standing(self, station: Float[Array, " s"]) -> TableInstrument:
        del station
        return self.device
