"""A star stylus: straight and to the side in turn, within every pose.

With one tool the rotations of the last axis move all touches of a pose alike, which its unknown
place takes up. Two tips within one pose do not. At equal touches and in the same poses: all
straight, all alternating, and with tips and poses found by gradient.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...design import ArrayPoses, ArraySpace, expected_rms, search, spread
from ...numerics.arrays import Array
from .expected import Task, bayes_um, posterior
from .setting import TOOL, TRAVEL, Known

SIDE_M = 0.15
"""Length of a stylus to the side."""
_ARMS = (
    ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)),
    ((-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (0.0, 1.0)),
)
"""Sides in the order in which they are tried, for one side touch and for the next."""


@dataclass(frozen=True)
class Star:
    """Expected rms, aligned, um, with equal touches."""

    straight: float
    alternating: float
    found: float
    """With tips and poses searched by gradient from the alternating ones."""
    poses: ArrayPoses
    """Alternating, in the nominal poses."""
    best: ArrayPoses

    @property
    def gain(self) -> float:
        """Share by which alternating lowers the expected error."""
        return 1.0 - self.alternating / self.straight


def with_star(poses: ArrayPoses, side_m: float = SIDE_M) -> ArrayPoses:
    """The same touches, every second one, from the first, with a stylus to the side.

    To +X and to -X in turn, to Y where the axes have no room for that. Raises `ValueError` where no
    side has room.
    """
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    centres = np.asarray(poses.centres)
    tool = np.broadcast_to(np.array(TOOL), centres.shape).copy()
    for k, pose in enumerate(centres):
        for number, i in enumerate(range(0, len(pose), 2)):
            for x, y in _ARMS[number % 2]:
                tip = np.array(TOOL) + side_m * np.array([x, y, 0.0])
                at = pose[i] - tip
                if (at >= low - 1e-9).all() and (at <= high + 1e-9).all():
                    tool[k, i] = tip
                    break
            else:
                raise ValueError(
                    f"pose {k + 1}, ball {i + 1}: found no room for a stylus {1e3 * side_m:g} mm "
                    "to any side, expected one; shorten it or move the pose"
                )
    return replace(poses, tool=jnp.asarray(tool))


def star(task: Task, nominal: ArrayPoses, known: Known, *, steps: int = 200, seed: int = 0) -> Star:
    """Straight, alternating, and tips and poses found by search."""
    alternating = with_star(nominal)
    assert alternating.tool is not None
    tips, which = np.unique(
        np.asarray(alternating.tool).reshape(-1, 3), axis=0, return_inverse=True
    )
    m, n = alternating.tool.shape[:2]
    space = ArraySpace(
        alternating,
        TRAVEL,
        tool=TOOL,
        styli=tuple(map(tuple, which.reshape(m, n).tolist())),
        reach=SIDE_M,
    )
    gram = jnp.asarray(task.gram.aligned)

    def criterion(z: Float[Array, " d"]) -> Float[Array, ""]:
        made = space.candidate(z)
        rms = expected_rms(gram, posterior(task.model, made.poses, known))
        return 1e6 * rms * made.penalty

    begin = spread(space, jax.random.key(seed), 2)
    best = space.candidate(search(criterion, begin, space.low, space.high, steps=steps)[0].z).poses
    straight, other, found = (bayes_um(task, p, known)[0] for p in (nominal, alternating, best))
    return Star(straight, other, found, alternating, best)
