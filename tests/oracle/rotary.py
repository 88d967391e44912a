"""A machine with rotary axes, as homogeneous matrices in plain numpy.

SI throughout, vectorised over n observations. The tool point in the workpiece frame is
inv(T_workpiece_side) T_tool_side tool_offset. Between bed and tool a linear axis is
[x d + E, R(e)], with the error translation E and the error rotation e in the moved frame; a rotary
one, about a line through `at`, is [at] [E, R(e)] turn [-at]: its errors act in what carries it,
about its reference point. On the workpiece side commands count the other way, errors do not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from .kinematics import Array

LINEAR, ROTARY = "XYZ", "ABC"
Twists = Callable[[Array], Array]
"""Errors (n, axes, 6) at axis positions (n, axes)."""


def moved(v: ArrayLike) -> Array:
    """Return the translations by v (n, 3)."""
    v = np.asarray(v, float)
    t = np.tile(np.eye(4), (len(v), 1, 1))
    t[:, :3, 3] = v
    return t


def turned(v: ArrayLike) -> Array:
    """Return the rotations by the vectors v (n, 3)."""
    v = np.asarray(v, float)
    t = np.tile(np.eye(4), (len(v), 1, 1))
    t[:, :3, :3] = Rotation.from_rotvec(v).as_matrix()
    return t


@dataclass(frozen=True)
class FiveAxis:
    """A chain such as "w C A b Y X Z t", with a point on every rotary axis, m."""

    chain: str
    at: Mapping[str, ArrayLike]
    tool: ArrayLike

    @property
    def axes(self) -> str:
        """Linear axes, then rotary ones: the order of positions."""
        return "".join(a for a in LINEAR + ROTARY if a in self.chain)

    def frame(self, q: Array, twists: Array) -> Array:
        """Return the pose of the tool's frame in that of the workpiece (n, 4, 4)."""
        table, spindle = self.chain.strip("wt ").split("b")
        work = self._side(table.split()[::-1], -1.0, q, twists)
        return np.linalg.inv(work) @ self._side(spindle.split(), 1.0, q, twists)

    def _side(self, names: list[str], sign: float, q: Array, twists: Array) -> Array:
        t = np.tile(np.eye(4), (len(q), 1, 1))
        for name in names:
            i = self.axes.index(name)
            error = moved(twists[:, i, :3]) @ turned(twists[:, i, 3:])
            step = sign * q[:, i, None] * np.eye(3)[(LINEAR + ROTARY).index(name) % 3]
            if name in LINEAR:
                t = t @ moved(step) @ error
                continue
            at = np.tile(np.asarray(self.at[name], float), (len(q), 1))
            t = t @ moved(at) @ error @ turned(step) @ moved(-at)
        return t

    def point(self, q: Array, twists: Array) -> Array:
        """Return the tool point in the workpiece frame (n, 3)."""
        t = self.frame(q, twists)
        return t[:, :3, 3] + t[:, :3, :3] @ np.asarray(self.tool, float)

    def follow(self, target: Array, q: Array, twists: Twists) -> Array:
        """Return the positions q (n, axes) with X, Y and Z such that the tool point is at `target`
        (n, 3) of the workpiece.
        """
        q = np.array(q, float)
        for _ in range(8):
            off = self.point(q, twists(q)) - target
            steps = [q + 1e-3 * np.eye(len(self.axes))[i] for i in range(3)]
            slopes = [(self.point(s, twists(s)) - target - off) / 1e-3 for s in steps]
            q[:, :3] -= np.linalg.solve(np.stack(slopes, axis=2), off[:, :, None])[:, :, 0]
        return q

    def still(self, q: Array) -> Array:
        """Return no errors."""
        return np.zeros((len(q), len(self.axes), 6))


@dataclass(frozen=True)
class Drawn:
    """Errors of a machine drawn from a smooth family: Matern-5/2 over every travel, over the chord
    of an axis that turns round; squareness; and where the rotary axes are.
    """

    machine: FiveAxis
    travel: Mapping[str, tuple[float, float]]
    """m or rad."""
    translation: float
    rotation: float
    squareness: float
    location: float
    rng: np.random.Generator
    smoothness: float = 0.5
    nodes: int = 81
    weights: dict[str, Array] = field(default_factory=dict, init=False)
    located: dict[str, Array] = field(default_factory=dict, init=False)
    tilts: Array = field(default_factory=lambda: np.zeros(3), init=False)

    def __post_init__(self) -> None:
        sizes = np.repeat([self.translation, self.rotation], 3)[:, None]
        for axis in self.machine.axes:
            x = self._nodes(axis)
            root = np.linalg.cholesky(self._kernel(axis, x, x) + 1e-9 * np.eye(len(x)))
            drawn = self.rng.standard_normal((6, len(x))) @ root.T
            self.weights[axis] = sizes * np.linalg.solve(root.T, np.linalg.solve(root, drawn.T)).T
            if axis in ROTARY:
                own = ROTARY.index(axis)
                place = self.rng.standard_normal(6) * np.repeat([self.location, self.squareness], 3)
                place[[own, 3 + own]] = 0.0
                self.located[axis] = place
        self.tilts[:] = self.squareness * self.rng.standard_normal(3)

    def _around(self, axis: str) -> bool:
        low, high = self.travel[axis]
        return axis in ROTARY and high - low > 2.0 * np.pi - 1e-9

    def _nodes(self, axis: str) -> Array:
        return np.linspace(*self.travel[axis], self.nodes, endpoint=not self._around(axis))

    def _kernel(self, axis: str, a: Array, b: Array) -> Array:
        apart, (low, high) = a[:, None] - b, self.travel[axis]
        if self._around(axis):
            apart, size = 2.0 * np.sin(0.5 * apart), 2.0
        else:
            size = high - low
        r = np.sqrt(5.0) * np.abs(apart) / (self.smoothness * size)
        return (1.0 + r + r**2 / 3.0) * np.exp(-r)

    def __call__(self, q: Array) -> Array:
        """Return the errors (n, axes, 6) at positions q (n, axes)."""
        axes, found = self.machine.axes, np.zeros((len(q), len(self.machine.axes), 6))
        for i, axis in enumerate(axes):
            kernel = self._kernel(axis, q[:, i], self._nodes(axis))
            found[:, i] = kernel @ self.weights[axis].T
            if axis in ROTARY:
                found[:, i] += self.located[axis]
        y, z = axes.index("Y"), axes.index("Z")
        # Y leans towards X, Z towards X and Y: translations in proportion to the command.
        found[:, y, 0] += self.tilts[0] * q[:, y]
        found[:, z, 0] += self.tilts[1] * q[:, z]
        found[:, z, 1] += self.tilts[2] * q[:, z]
        return found
