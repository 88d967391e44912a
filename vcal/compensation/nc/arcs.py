"""Circular arcs and helices in a plane of two axes (RS-274/NGC, clause 3.5.3)."""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

AXES = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}
"""First, second and normal axis of G17, G18 and G19, right-handed: G3 turns from the first to the
second."""
_FULL = 1e-6
"""Angle, rad, below which an arc is a whole turn."""
_RADIUS_MM, _RADIUS_SHARE = 0.01, 0.001
"""Difference of the radii at both ends, from rounded words, that is still an arc."""


class Arc(NamedTuple):
    """p(f) = centre + r(f) (cos a(f), sin a(f)) in the plane, mm and rad.

    The radius r, the angle a and the height are linear in the share f of the way.
    """

    plane: int
    centre: tuple[float, float]
    radius: tuple[float, float]
    angle: float
    turn: float
    """Angle from start to end, positive from the first axis to the second."""
    height: tuple[float, float]

    def point(self, share: float) -> list[float]:
        """Position (3,), mm."""
        u, v, w = AXES[self.plane]
        a = self.angle + share * self.turn
        r = self.radius[0] + share * (self.radius[1] - self.radius[0])
        found = [0.0, 0.0, 0.0]
        found[u], found[v] = self.centre[0] + r * math.cos(a), self.centre[1] + r * math.sin(a)
        found[w] = self.height[0] + share * (self.height[1] - self.height[0])
        return found

    def length(self) -> float:
        """Of the helix, mm."""
        r = 0.5 * (self.radius[0] + self.radius[1])
        return math.hypot(r * self.turn, self.height[1] - self.height[0])

    def part(self, low: float, high: float) -> "Arc":
        """The arc from one share of the way to another."""
        r0, r1 = self.radius
        w0, w1 = self.height
        return Arc(
            self.plane,
            self.centre,
            (r0 + low * (r1 - r0), r0 + high * (r1 - r0)),
            self.angle + low * self.turn,
            (high - low) * self.turn,
            (w0 + low * (w1 - w0), w0 + high * (w1 - w0)),
        )

    def reversals(self, least: float) -> list[float]:
        """Shares at which an axis of the plane turns round: multiples of a right angle.

        Those nearer to an end than a move of `least` mm of that axis are not counted.
        """
        r = min(self.radius)
        near = math.acos(1.0 - min(least / r, 1.0)) if r > 0 else math.inf
        low, high = sorted((self.angle, self.angle + self.turn))
        if high - low <= 2 * near:
            return []
        first, last = (low + near) / (math.pi / 2), (high - near) / (math.pi / 2)
        angles = [k * math.pi / 2 for k in range(math.ceil(first), math.floor(last) + 1)]
        return sorted((a - self.angle) / self.turn for a in angles)

    def directions(self) -> list[float]:
        """Signs (3,) of the moves of the axes, at the middle of the arc."""
        u, v, w = AXES[self.plane]
        a = self.angle + 0.5 * self.turn
        way = math.copysign(1.0, self.turn)
        found = [0.0, 0.0, 0.0]
        found[u], found[v] = -way * math.sin(a), way * math.cos(a)
        found[w] = self.height[1] - self.height[0]
        return found


def centre_arc(
    plane: int,
    counter_clockwise: bool,
    start: list[float],
    end: list[float],
    centre: tuple[float, float],
    turns: int = 1,
) -> Arc | None:
    """The arc about a centre, mm. None where both ends are not on one circle."""
    u, v, w = AXES[plane]
    a, b = start[u] - centre[0], start[v] - centre[1]
    c, d = end[u] - centre[0], end[v] - centre[1]
    r0, r1 = math.hypot(a, b), math.hypot(c, d)
    if min(r0, r1) <= 0.0 or abs(r1 - r0) > max(_RADIUS_MM, _RADIUS_SHARE * min(r0, r1)):
        return None
    angle, last = math.atan2(b, a), math.atan2(d, c)
    turn = (last - angle if counter_clockwise else angle - last) % (2 * math.pi)
    if turn < _FULL:
        turn += 2 * math.pi
    turn += 2 * math.pi * (turns - 1)
    return Arc(
        plane,
        centre,
        (r0, r1),
        angle,
        turn if counter_clockwise else -turn,
        (start[w], end[w]),
    )


def radius_arc(
    plane: int, counter_clockwise: bool, start: list[float], end: list[float], radius: float
) -> Arc | None:
    """The arc of a radius, mm: the longer of two where it is negative. None where there is none.

    A chord that is longer than the diameter by rounding of the words is a half circle.
    """
    u, v, _ = AXES[plane]
    x, y = end[u] - start[u], end[v] - start[v]
    half = 0.5 * math.hypot(x, y)
    if half <= 0.0 or abs(radius) < half - max(_RADIUS_MM, _RADIUS_SHARE * half):
        return None
    height = math.sqrt(max(radius * radius - half * half, 0.0)) / (2 * half)
    if (radius < 0) == counter_clockwise:
        height = -height
    centre = (0.5 * (start[u] + end[u]) - height * y, 0.5 * (start[v] + end[v]) + height * x)
    return centre_arc(plane, counter_clockwise, start, end, centre)


_C = TypeVar("_C", float, np.ndarray)
"""A coordinate, mm: of one point, or (n,) of many."""


def centre_through(a: Sequence[_C], b: Sequence[_C], c: Sequence[_C]) -> tuple[_C, _C]:
    """Centre, relative to `a`, of the circle through three points of two coordinates each.

    With p = b - a and q = c - a, it is (|p|^2 q - |q|^2 p) rotated by -90 degrees, divided by
    2 p x q. Points on a line give no finite circle.
    """
    px, py, qx, qy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    cross = 2.0 * (px * qy - py * qx)
    pp, qq = px * px + py * py, qx * qx + qy * qy
    return (qy * pp - py * qq) / cross, (px * qq - qx * pp) / cross
