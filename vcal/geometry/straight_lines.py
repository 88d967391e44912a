"""Straight motions of the tool point, one linear axis at a time, and lines through their errors.

What a test of the geometry measures (ISO 230-1:2012, 3.4 and 3.6): an axis moves over its travel
while the others stand in the middle of theirs and rotary axes at zero. Deviations of the paths are
linear in their errors, so that they are given as weights of these.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ..machine.chain import Chain

_ABOUT = {("X", "Y"): ("C", 1.0), ("X", "Z"): ("B", -1.0), ("Y", "Z"): ("A", 1.0)}
"""About which axis the later one of two is turned, and the sign of first x second along that."""
_SQUARE = 1e-6
"""Cosine of an angle that is meant to be a right one, at most."""


@dataclass(frozen=True)
class StraightLines:
    """The nominal paths of the tool point; weights of deviations have their shape (a, n, 3)."""

    axes: tuple[str, ...]
    """Linear axes that have a travel."""
    position: Float[np.ndarray, "m axes"]
    """Of all axes of the chain, path by path, m or rad; m = a n."""
    nominal: Float[np.ndarray, "a n 3"]
    """In the frame of the workpiece, m."""
    travelled: Float[np.ndarray, "a n"]
    """Position of the axis that moves, m."""

    @classmethod
    def of(cls, chain: Chain, ends: Float[np.ndarray, "axes 2"], nodes: int) -> "StraightLines":
        """So many positions between the `ends` of every axis of the chain, m or rad."""
        ends = np.asarray(ends, float)
        axes = tuple(
            joint.name
            for joint, (low, high) in zip(chain.joints, ends, strict=True)
            if not joint.turns and high > low
        )
        places = [chain.axes.index(axis) for axis in axes]
        at_zero = (
            np.array([j.turns for j in chain.joints]) & (ends[:, 0] <= 0.0) & (ends[:, 1] >= 0.0)
        )
        position = np.tile(np.where(at_zero, 0.0, ends.mean(1)), (len(axes), nodes, 1))
        for k, place in enumerate(places):
            position[k, :, place] = np.linspace(ends[place, 0], ends[place, 1], nodes)
        travelled = np.array([position[k, :, place] for k, place in enumerate(places)])
        flat = position.reshape(-1, len(ends))
        nominal = chain.tool_point(flat).reshape(len(axes), nodes, 3)
        return cls(axes, flat, nominal, travelled.reshape(len(axes), nodes))

    @cached_property
    def along(self) -> dict[str, Float[np.ndarray, "3"]]:
        """Nominal direction of every axis, of unit length, as seen from the workpiece."""
        ways = self.nominal[:, -1] - self.nominal[:, 0]
        return dict(zip(self.axes, ways / np.linalg.norm(ways, axis=1, keepdims=True), strict=True))

    def slope(self, axis: str) -> Float[np.ndarray, " n"]:
        """Weights of the slope of the least-squares line through what is so much per node."""
        x = self.travelled[self.axes.index(axis)]
        x = x - x.mean()
        return x / (x @ x)

    def on(
        self, axis: str, per_node: Float[np.ndarray, " n"], direction: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "a n 3"]:
        """Weights of what is so much per node of one path, in one direction."""
        weights = np.zeros(self.nominal.shape)
        weights[self.axes.index(axis)] = per_node[:, None] * direction
        return weights

    def deviation(self, axis: str) -> Float[np.ndarray, "n n"]:
        """Takes errors along a path to what they deviate from their least-squares line."""
        x = self.travelled[self.axes.index(axis)]
        return np.eye(len(x)) - 1.0 / len(x) - np.outer(x - x.mean(), self.slope(axis))

    @property
    def squareness(self) -> list[tuple[str, str, str, Float[np.ndarray, "a n 3"]]]:
        """Of axes that are meant to be square: the name as in ISO 230-1 (``"EC(0X)Y"``), the axis
        that is referred to, the other one, and the weights: rad, positive where the other one is
        turned in the positive sense from it, as EC0Y is.
        """
        found = []
        for first, second in itertools.combinations(sorted(self.axes), 2):
            about, sign = _ABOUT[first, second]
            a, b = self.along[first], self.along[second]
            if abs(a @ b) > _SQUARE:
                continue
            turn = sign * np.cross(a, b)
            weights = self.on(second, self.slope(second), np.cross(turn, b))
            weights = weights - self.on(first, self.slope(first), np.cross(turn, a))
            found.append((f"E{about}(0{first}){second}", first, second, weights))
        return found
