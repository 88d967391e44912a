"""Circles that two axes interpolate: the actual motion, from the encoder readings of the axes.

    x_i(t) = c_i + A_i cos(omega t) + B_i sin(omega t)

The amplitudes of a control loop differ from the commanded ones (0.8 to 1.1 times as large is usual
at 5 m/s^2), and so do the accelerations. The structure of the machine responds to the actual
acceleration.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from ..numerics.arrays import Array

_STEPS = 20
"""Largest number of Gauss-Newton steps for the angular velocity."""
_AT = 5e-3
"""Share of the step from row to row within which a row counts as being at a reversal."""
_STILL = 0.02
"""Amplitude, relative to that of the circle, below which an axis counts as at rest: the motion of
the others deflects a held axis by some micrometres."""


@dataclass(frozen=True)
class Circle:
    """The fundamental oscillation of several axes in one run."""

    omega: float
    """Angular velocity, rad/s."""
    centre: Float[np.ndarray, " axes"]
    """c of every axis, m."""
    cosine: Float[np.ndarray, " axes"]
    """A of every axis, m."""
    sine: Float[np.ndarray, " axes"]
    """B of every axis, m."""

    @property
    def amplitude(self) -> Float[np.ndarray, " axes"]:
        """sqrt(A^2 + B^2) of every axis, m."""
        return np.hypot(self.cosine, self.sine)

    @property
    def moving(self) -> np.ndarray:
        """Which axes move (axes,)."""
        return self.amplitude > _STILL * self.amplitude.max()

    def position(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Position of every axis, m; that of the centre for an axis at rest."""
        return self.centre + self._wave(t, self.moving * self.cosine, self.moving * self.sine)

    def velocity(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Velocity of every axis, m/s; zero for an axis at rest."""
        k = self.omega * self.moving
        return self._wave(t, k * self.sine, -k * self.cosine)

    def acceleration(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Acceleration of every axis, m/s^2; zero for an axis at rest."""
        k = -(self.omega**2) * self.moving
        return self._wave(t, k * self.cosine, k * self.sine)

    def direction(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Direction of motion of every axis, +1 or -1; zero for an axis at rest.

        A row at a reversal has the direction of its approach, as for a bidirectional position
        (ISO 230-2, 3.7), and not the direction that the rounding of its phase would give.
        """
        # A little earlier: a row at a reversal moves neither way but for rounding.
        t = np.asarray(t)
        return np.sign(self.velocity(t - _AT * self._step(t)))

    def since_reversal(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Distance travelled since the last reversal of every axis, m, on a circle without start.

        An axis at rest has the radius of the circle, half the distance between two reversals. With
        a large distance, the values of all moving axes would be nearly equal in comparison, and a
        product with the distance would only distinguish moving axes from axes at rest.
        """
        travelled = self.amplitude * (1.0 - np.cos(self._phase(t)))
        return np.where(self.moving, travelled, self.amplitude.max())

    def _phase(self, t: np.ndarray) -> np.ndarray:
        """Phase angle since the last reversal of every axis, 0 to pi; pi or slightly more in a row
        at the next reversal.
        """
        t = np.asarray(t)
        start = np.arctan2(-self.sine, self.cosine)
        angle = np.mod(self.omega * t[:, None] + start, np.pi)
        step = self.omega * self._step(t)
        return np.where(angle < _AT * abs(step), angle + np.pi, angle)

    def _step(self, t: np.ndarray) -> float:
        """Median time from row to row."""
        return float(np.median(np.diff(t))) if len(t) > 1 else 0.0

    def _wave(self, t: np.ndarray, cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
        angle = self.omega * np.asarray(t)[:, None]
        return np.cos(angle) * cosine + np.sin(angle) * sine


def fit_circle(t: Float[np.ndarray, " n"], position: Float[np.ndarray, "n axes"]) -> Circle:
    """The fundamental oscillation by least squares, including the angular velocity.

    `t` is in s, `position` in m. The start is the mean angular velocity of the two axes that move
    most; Gauss-Newton steps refine it. Raises `ValueError` for fewer than five rows, and where
    fewer than two axes move.
    """
    t, x = np.asarray(t, float), np.asarray(position, float)
    if len(t) < 5:
        raise ValueError(f"found {len(t)} rows, expected at least five for a circle")
    first, second = np.argsort(-np.ptp(x, axis=0))[:2]
    if np.ptp(x[:, second]) <= _STILL * np.ptp(x[:, first]) or np.ptp(x[:, first]) == 0.0:
        raise ValueError("found one axis that moves at most, expected two for a circle")
    middle = 0.5 * (x.max(0) + x.min(0))
    angle = np.unwrap(np.arctan2(x[:, second] - middle[second], x[:, first] - middle[first]))
    omega = abs(np.polyfit(t, angle, 1)[0])
    for _ in range(_STEPS):
        columns = np.column_stack([np.ones_like(t), np.cos(omega * t), np.sin(omega * t)])
        c, a, b = np.linalg.lstsq(columns, x, rcond=None)[0]
        left = x - columns @ np.array([c, a, b])
        slope = t[:, None] * (np.outer(columns[:, 1], b) - np.outer(columns[:, 2], a))
        # The linear amplitudes are eliminated: only the part orthogonal to them remains.
        slope = slope - columns @ np.linalg.lstsq(columns, slope, rcond=None)[0]
        step = float((slope * left).sum() / (slope * slope).sum())
        omega += step
        if abs(step) <= 1e-13 * omega:
            break
    columns = np.column_stack([np.ones_like(t), np.cos(omega * t), np.sin(omega * t)])
    c, a, b = np.linalg.lstsq(columns, x, rcond=None)[0]
    return Circle(float(omega), c, a, b)


def squared_pace(
    run: Int[np.ndarray, " n"],
    velocity: Float[Array, "n axes"],
    acceleration: Float[Array, "n axes"],
) -> Float[Array, " n"]:
    """omega^2 of the circle of every row (n,), (rad/s)^2: the mean square of the acceleration in
    its run, divided by that of the velocity.
    """
    runs, index = np.unique(np.asarray(run), return_inverse=True)

    def sums(squares: Array) -> Array:
        if isinstance(squares, jax.Array):
            return jax.ops.segment_sum(squares, index, len(runs))
        return np.bincount(index, squares, len(runs))

    a2, v2 = (sums((x * x).sum(1)) for x in (acceleration, velocity))
    return (a2 / v2)[index]


_ROUND = 1e-3
"""Largest distance of positions from their circle, as a share of its radius."""
_STEP = 2.0
"""Largest angle from row to row, rad, at which the sense of a circle is certain."""


def circle_through(
    position: Float[np.ndarray, "n axes"],
) -> tuple[Circle, Float[np.ndarray, " n"]] | None:
    """The circle or arc that successive positions (n, axes), m, travel in one sense, with the angle
    travelled at each of them (n,), rad, ascending; None where they travel none.

    The plane is that of the two largest singular values of the positions about their mean, the
    centre the linear least-squares solution of 2 e.c + const = |e|^2 in that plane. The circle has
    an angular velocity of 1 rad/s: its `velocity` and `acceleration` at an angle are per
    angular velocity and per its square.
    """
    x = np.asarray(position, float)
    if len(x) < 4:
        return None
    middle = x.mean(0)
    _, size, axes = np.linalg.svd(x - middle, full_matrices=False)
    if len(size) < 2 or size[1] <= 1e-6 * size[0] or size[0] == 0.0:
        return None
    first, second = axes[:2]
    flat = (x - middle) @ axes[:2].T
    matrix = np.column_stack([2.0 * flat, np.ones(len(flat))])
    a, b, rest = np.linalg.lstsq(matrix, (flat**2).sum(1), rcond=None)[0]
    radius = float(np.sqrt(max(rest + a * a + b * b, 0.0)))
    if radius == 0.0:
        return None
    centre = middle + a * first + b * second
    angle = np.unwrap(np.arctan2(flat[:, 1] - b, flat[:, 0] - a))
    step = np.diff(angle)
    sense = 1.0 if np.median(step) >= 0.0 else -1.0
    if (sense * step <= 0.0).any() or np.abs(step).max() > _STEP:
        return None
    circle = Circle(1.0, centre, radius * first, sense * radius * second)
    angle = sense * angle
    exact = centre + np.outer(np.cos(angle), circle.cosine) + np.outer(np.sin(angle), circle.sine)
    off = np.linalg.norm(x - exact, axis=1)
    return (circle, angle) if off.max() <= _ROUND * radius else None
