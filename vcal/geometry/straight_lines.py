"""Straight motions of the tool point, one linear axis at a time, and lines through their errors.

A geometric test (ISO 230-1:2012, 3.4 and 3.6) moves one axis over its travel, with the other linear
axes in the middle of their travel and the rotary axes at zero. The deviations of the paths are
linear in the errors of the tool point, and are therefore given as weights of these errors.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ..machine.chain import Chain

_ABOUT = {("X", "Y"): ("C", 1.0), ("X", "Z"): ("B", -1.0), ("Y", "Z"): ("A", 1.0)}
"""The axis about which the later one of two axes is rotated, and the sign of first x second along
it."""
_MAIN = {"U": "X", "V": "Y", "W": "Z"}
"""Axes to which secondary axes are parallel."""
_SQUARE = 1e-6
"""Largest cosine of an angle that is nominally a right angle."""


@dataclass(frozen=True)
class StraightLines:
    """The nominal paths of the tool point; weights of deviations have their shape (a, n, 3)."""

    axes: tuple[str, ...]
    """Names of the linear axes that have a travel."""
    position: Float[np.ndarray, "m axes"]
    """Positions of all axes of the chain, path by path, m or rad; m = a n."""
    nominal: Float[np.ndarray, "a n 3"]
    """Nominal tool points in the frame of the workpiece, m."""
    travelled: Float[np.ndarray, "a n"]
    """Position of the axis that moves, m."""

    @classmethod
    def of(cls, chain: Chain, ends: Float[np.ndarray, "axes 2"], nodes: int) -> "StraightLines":
        """Paths of `nodes` positions between the `ends` of every linear axis, m or rad."""
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
        """Nominal direction of every axis, a unit vector in the frame of the workpiece."""
        chords = self.nominal[:, -1] - self.nominal[:, 0]
        units = chords / np.linalg.norm(chords, axis=1, keepdims=True)
        return dict(zip(self.axes, units, strict=True))

    def slope(self, axis: str) -> Float[np.ndarray, " n"]:
        """Weights (n,) of the slope of the least-squares line through values at the nodes, 1/m."""
        x = self.travelled[self.axes.index(axis)]
        x = x - x.mean()
        return x / (x @ x)

    def on(
        self, axis: str, per_node: Float[np.ndarray, " n"], direction: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "a n 3"]:
        """Weights (a, n, 3) of the errors in one direction on the path of one axis, from weights
        per node.
        """
        weights = np.zeros(self.nominal.shape)
        weights[self.axes.index(axis)] = per_node[:, None] * direction
        return weights

    def deviation(self, axis: str) -> Float[np.ndarray, "n n"]:
        """Matrix (n, n) from values at nodes to their deviations from the least-squares line."""
        x = self.travelled[self.axes.index(axis)]
        return np.eye(len(x)) - 1.0 / len(x) - np.outer(x - x.mean(), self.slope(axis))

    @property
    def squareness(self) -> list[tuple[str, str, str, Float[np.ndarray, "a n 3"]]]:
        """Squareness of every pair of axes that are nominally square to each other.

        Each entry has the name as in ISO 230-1 (``"EC(0X)Y"``), the reference axis, the other axis,
        and the weights (a, n, 3) of the angle in rad. It is positive where the other axis is
        rotated in the positive sense from the reference axis, as for EC0Y.
        """
        found = []
        in_order = sorted(self.axes, key=lambda axis: (axis in _MAIN, axis))
        for first, second in itertools.combinations(in_order, 2):
            a, b = self.along[first], self.along[second]
            if abs(a @ b) > _SQUARE:
                continue
            main = _MAIN.get(first, first), _MAIN.get(second, second)
            about, sign = _ABOUT[min(main), max(main)]
            sign = sign if main[0] < main[1] else -sign
            turn = sign * np.cross(a, b)
            weights = self.on(second, self.slope(second), np.cross(turn, b))
            weights = weights - self.on(first, self.slope(first), np.cross(turn, a))
            found.append((f"E{about}(0{first}){second}", first, second, weights))
        return found
