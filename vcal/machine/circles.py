"""Circles that an axis pair interpolates: what was really travelled, from the axes' own readings.

    x_i(t) = c_i + A_i cos(omega t) + B_i sin(omega t)

The amplitudes of a closed loop differ from those that were commanded (0.8 to 1.1 of them are usual
at 5 m/s^2), and so do accelerations; what a machine's structure answers to is the actual one.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from ..numerics.arrays import Array

_STEPS = 20
_AT = 5e-3
"""Share of a step from row to row within which a row is at a reversal."""
_STILL = 0.02
"""Amplitude over that of the circle below which an axis is at rest: a held axis gives way to what
the others do to it, by some micrometres."""


@dataclass(frozen=True)
class Circle:
    """The fundamental of one run of several axes."""

    omega: float
    """Angular velocity, rad/s."""
    centre: Float[np.ndarray, " axes"]
    """m."""
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
        """Which axes take part."""
        return self.amplitude > _STILL * self.amplitude.max()

    def position(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """m; that of the centre for an axis that takes no part."""
        return self.centre + self._wave(t, self.moving * self.cosine, self.moving * self.sine)

    def velocity(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """m/s; zero for an axis that takes no part."""
        k = self.omega * self.moving
        return self._wave(t, k * self.sine, -k * self.cosine)

    def acceleration(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """m/s^2; zero for an axis that takes no part."""
        k = -(self.omega**2) * self.moving
        return self._wave(t, k * self.cosine, k * self.sine)

    def direction(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """+1, -1; zero for an axis that takes no part. A row at a reversal is on the side from
        which it came, as a position that was approached (ISO 230-2, 3.7), not on that which the
        rounding of its phase happens to give.
        """
        at = self._phase(t) >= np.pi
        return np.where(at, -1.0, 1.0) * np.sign(self.velocity(t))

    def since_reversal(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n axes"]:
        """Distance travelled since the last reversal of every axis, m, as if the circle had been
        travelled for ever; the radius for an axis that takes no part, half of the way to the next
        one: were it far, all axes that move would seem alike beside it, and a product with the
        distance that an axis has travelled would be a product with whether it moves.
        """
        way = self.amplitude * (1.0 - np.cos(self._phase(t)))
        return np.where(self.moving, way, self.amplitude.max())

    def _phase(self, t: np.ndarray) -> np.ndarray:
        """Angle since the last reversal of every axis, 0 to pi; pi and a little more in a row that
        is at the next one.
        """
        t = np.asarray(t)
        start = np.arctan2(-self.sine, self.cosine)
        angle = np.mod(self.omega * t[:, None] + start, np.pi)
        step = self.omega * float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        return np.where(angle < _AT * abs(step), angle + np.pi, angle)

    def _wave(self, t: np.ndarray, cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
        angle = self.omega * np.asarray(t)[:, None]
        return np.cos(angle) * cosine + np.sin(angle) * sine


def fit_circle(t: Float[np.ndarray, " n"], position: Float[np.ndarray, "n axes"]) -> Circle:
    """The fundamental by least squares, the angular velocity included.

    It starts at the mean turn of the two axes that move most, and is refined by Gauss-Newton steps.
    Raises `ValueError` for fewer than five rows, and where fewer than two axes move.
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
        # What the linear amplitudes can take up of a change of omega is theirs.
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
    """omega^2 of the circle of every row, (rad/s)^2: the mean square of the acceleration in its run
    over that of the velocity.
    """
    runs, index = np.unique(np.asarray(run), return_inverse=True)

    def sums(squares: Array) -> Array:
        if isinstance(squares, jax.Array):
            return jax.ops.segment_sum(squares, index, len(runs))
        return np.bincount(index, squares, len(runs))

    a2, v2 = (sums((x * x).sum(1)) for x in (acceleration, velocity))
    return (a2 / v2)[index]
