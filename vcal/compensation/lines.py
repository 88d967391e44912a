"""Corrections that are sums of functions of one position each, as controls with tables per pair of
axes have them, and products of two such functions.

    c_i(q, d) = sum_j f_ij(q_j, d_j)  [+ sum_(j < k) a_ijk(q_j) b_ijk(q_k)]

f is the mean of the correction over the positions of the other axes; no other sum of functions of
one position leaves a smaller mean square over the working volume. a and b are the first pair of
singular vectors of what remains of the mean over the third axis: an angle of one axis times the
lever of another is such a product.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .machine import IdentifiedMachine

_OTHERS = 5
"""Positions of every other axis over which a mean is taken."""


@dataclass(frozen=True)
class Line:
    """f: a correction that depends on the position and the direction of one axis."""

    corrected: str
    by: str
    nodes: Float[np.ndarray, " nodes"]
    """Positions of `by`, ascending, m."""
    up: Float[np.ndarray, " nodes"]
    """Correction where `by` moves in the positive direction, m."""
    down: Float[np.ndarray, " nodes"]

    def at(
        self, position: Float[np.ndarray, " n"], direction: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Linear between the nodes, constant beyond them; the last direction of an axis that stands
        still (0) counts as positive.
        """
        up = np.interp(position, self.nodes, self.up)
        return np.where(direction < 0.0, np.interp(position, self.nodes, self.down), up)

    @property
    def directed(self) -> bool:
        """Whether the direction matters."""
        return bool(np.any(self.up != self.down))

    @property
    def used(self) -> bool:
        """Whether any value differs from zero."""
        return bool(np.any(self.up) or np.any(self.down))

    def rounded(self, step_m: float) -> "Line":
        """With values in whole multiples of `step_m`."""
        up, down = (np.round(v / step_m) * step_m for v in (self.up, self.down))
        return replace(self, up=up, down=down)


@dataclass(frozen=True)
class Product:
    """a(q_first) b(q_second), m: `a` in m, `b` a number of size one."""

    corrected: str
    first: str
    second: str
    nodes: tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]
    a: Float[np.ndarray, " nodes"]
    b: Float[np.ndarray, " nodes"]

    def at(
        self, first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Both factors linear between the nodes, constant beyond them."""
        return np.interp(first, self.nodes[0], self.a) * np.interp(second, self.nodes[1], self.b)


def lines_of(
    machine: IdentifiedMachine,
    nodes: Mapping[str, Float[np.ndarray, " nodes"]],
    at: Mapping[str, float],
) -> list[Line]:
    """f of every pair of linear axes, the corrected axis in the outer loop; `nodes` by axis, m.

    The mean of c_i over the volume is part of f_ii. `at` are conditions (`Options.at`).
    """
    axes = [machine.axes[i] for i in machine.linear]
    means = {axis: _means(machine, axis, nodes[axis], at) for axis in axes}
    found = []
    for i, corrected in zip(machine.linear, axes, strict=True):
        for by in axes:
            up, down = (values[:, i] for values in means[by])
            level = 0.0 if by == corrected else _mean((up + down) / 2.0, nodes[by])
            found.append(Line(corrected, by, nodes[by], up - level, down - level))
    return found


def products_of(
    machine: IdentifiedMachine,
    nodes: Mapping[str, Float[np.ndarray, " nodes"]],
    at: Mapping[str, float],
    least_m: float,
) -> list[Product]:
    """a b of every pair of linear axes, at the mean of both directions, where it reaches `least_m`
    at some node.
    """
    axes = [machine.axes[i] for i in machine.linear]
    found = []
    for n, first in enumerate(axes):
        for second in axes[n + 1 :]:
            mean = _plane(machine, first, second, nodes, at)
            for i, corrected in zip(machine.linear, axes, strict=True):
                rest = _interaction(mean[:, :, i], nodes[first], nodes[second])
                left, size, right = np.linalg.svd(rest, full_matrices=False)
                b = right[0] / np.abs(right[0]).max()
                a = left[:, 0] * size[0] * np.abs(right[0]).max()
                if np.abs(a).max() >= least_m:
                    pair = nodes[first], nodes[second]
                    found.append(Product(corrected, first, second, pair, a, b))
    return found


def _means(
    machine: IdentifiedMachine,
    axis: str,
    nodes: Float[np.ndarray, " nodes"],
    at: Mapping[str, float],
) -> tuple[Float[np.ndarray, "nodes axes"], Float[np.ndarray, "nodes axes"]]:
    """Mean correction of all axes at the nodes of one axis, in its two directions."""
    i = machine.axes.index(axis)
    position = _around(machine, {axis: nodes})
    directions = np.zeros_like(position)
    found = []
    for direction in (1.0, -1.0):
        directions[:, i] = direction
        values = machine.correction(position, directions, at)
        found.append(values.reshape(len(nodes), -1, len(machine.axes)).mean(1))
    return found[0], found[1]


def _plane(
    machine: IdentifiedMachine,
    first: str,
    second: str,
    nodes: Mapping[str, Float[np.ndarray, " nodes"]],
    at: Mapping[str, float],
) -> Float[np.ndarray, "first second axes"]:
    """Mean correction over the third axis."""
    lines = {axis: nodes[axis] for axis in (first, second)}
    values = machine.correction(_around(machine, lines), None, at)
    shape = len(nodes[first]), len(nodes[second]), -1, len(machine.axes)
    return values.reshape(shape).mean(2)


def _around(
    machine: IdentifiedMachine, lines: Mapping[str, Float[np.ndarray, " nodes"]]
) -> Float[np.ndarray, "n axes"]:
    """Positions with the axes of `lines` at their nodes (slowest), the others in the middles of
    equal parts of their travels.
    """
    others = [axis for axis in machine.axes if axis not in lines]
    rest = [_middles(*machine.volume[machine.axes.index(axis)]) for axis in others]
    grid = np.meshgrid(*lines.values(), *rest, indexing="ij")
    flat = dict(zip([*lines, *others], (v.ravel() for v in grid), strict=True))
    return np.stack([flat[axis] for axis in machine.axes], 1)


def _interaction(
    values: Float[np.ndarray, "first second"], first: np.ndarray, second: np.ndarray
) -> Float[np.ndarray, "first second"]:
    """What no sum of a function of the first and one of the second position holds."""
    by_first = np.array([_mean(row, second) for row in values])
    by_second = np.array([_mean(column, first) for column in values.T])
    return values - by_first[:, None] - by_second[None, :] + _mean(by_first, first)


def _mean(values: Sequence[float] | np.ndarray, nodes: np.ndarray) -> float:
    """Mean over a line of what is linear between its nodes."""
    span = float(nodes[-1] - nodes[0])
    return float(np.trapezoid(values, nodes)) / span if span > 0.0 else float(np.mean(values))


def _middles(low: float, high: float) -> np.ndarray:
    """Middles of equal parts of an interval."""
    return low + (high - low) * (np.arange(_OTHERS) + 0.5) / _OTHERS
