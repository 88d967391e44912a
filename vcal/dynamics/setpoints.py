"""Set points: circles of given acceleration, positioning with limited velocity and jerk."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..instruments.r_test import PLANES


@dataclass(frozen=True)
class Limits:
    """Limits of the set motion of an axis."""

    velocity: float = math.inf
    """m/s."""
    acceleration: float = math.inf
    """m/s^2."""
    jerk: float = math.inf
    """m/s^3."""


@dataclass(frozen=True)
class SetCircle:
    """One circle of the R-test: x_1 = r cos(omega t), x_2 = sense r sin(omega t) in its plane.

    In the plane ``"ZX"`` the first axis is Z, as in eqs. (3) and (4) of Nguyen et al. (2012).
    Raises `ValueError` for a sense other than 1 and -1, and for a radius or an acceleration that is
    not above zero.
    """

    plane: str
    sense: int
    radius: float
    """m."""
    acceleration: float
    """r omega^2, m/s^2."""

    def __post_init__(self):
        if self.sense not in (1, -1):
            raise ValueError(f"circle in {self.plane}: found the sense {self.sense}, expected 1 or "
                             "-1; correct it")  # fmt: skip
        if not (self.radius > 0.0 and self.acceleration > 0.0):
            raise ValueError(
                f"circle in {self.plane}: found a radius of {1e3 * self.radius:g} mm and "
                f"{self.acceleration:g} m/s^2, expected both above zero; correct them"
            )

    @property
    def omega(self) -> float:
        """sqrt(a / r), rad/s."""
        return math.sqrt(self.acceleration / self.radius)

    @property
    def feed(self) -> float:
        """r omega, m/s."""
        return self.radius * self.omega

    def phasor(self, axes: tuple[str, ...]) -> Float[np.ndarray, " axes"]:
        """Complex R of every axis, x(t) = Re(R exp(i omega t)).

        Raises `ValueError` for an unknown plane, and for a plane of axes that the machine lacks.
        """
        if self.plane not in PLANES or not set(self.plane) <= set(axes):
            raise ValueError(
                f"plane: found {self.plane!r}, expected one of {', '.join(PLANES)} with axes out "
                f"of {', '.join(axes)}; correct it"
            )
        found = np.zeros(len(axes), complex)
        found[axes.index(self.plane[0])] = self.radius
        found[axes.index(self.plane[1])] = -1j * self.sense * self.radius
        return found

    def check(self, limits: Limits) -> None:
        """Raise `ValueError` where the circle exceeds a limit of an axis."""
        reached = {
            "a feed": (self.feed, limits.velocity, "m/s"),
            "an acceleration": (self.acceleration, limits.acceleration, "m/s^2"),
            "a jerk": (self.acceleration * self.omega, limits.jerk, "m/s^3"),
        }
        for what, (value, most, unit) in reached.items():
            if value > most:
                raise ValueError(
                    f"circle in {self.plane} of {1e3 * self.radius:g} mm at "
                    f"{self.acceleration:g} m/s^2: found {what} of {value:.4g} {unit}, expected "
                    f"at most {most:g}, which the axes reach; lower the acceleration, or choose "
                    "another radius"
                )


def circle_set(
    radius: float,
    accelerations: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 4.5),
    planes: tuple[str, ...] = PLANES,
) -> list[SetCircle]:
    """Circles of all planes and accelerations, in both senses."""
    return [
        SetCircle(plane, sense, radius, a)
        for plane in planes
        for sense in (1, -1)
        for a in accelerations
    ]


@dataclass(frozen=True)
class Profile:
    """A move along one axis with constant jerk between knots."""

    times: Float[np.ndarray, " k"]
    """Knots, s; the first is 0, the last the end of the move."""
    jerks: Float[np.ndarray, " k-1"]
    """Jerks between the knots, m/s^3."""

    @property
    def duration(self) -> float:
        """s."""
        return float(self.times[-1])

    @property
    def peak_acceleration(self) -> float:
        """m/s^2."""
        return float(np.abs(self._states[:, 2]).max())

    @property
    def peak_velocity(self) -> float:
        """m/s."""
        return float(np.abs(self._states[:, 1]).max())

    def __call__(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Position (m), velocity and acceleration; at rest before and after."""
        t = np.asarray(t, float)
        place = np.clip(np.searchsorted(self.times, t, "right") - 1, 0, len(self.jerks) - 1)
        h = np.clip(t, 0.0, self.duration) - self.times[place]
        s, v, a = self._states[place].T
        j = self.jerks[place]
        inside = (t >= 0.0) & (t <= self.duration)
        return np.column_stack(
            [
                s + v * h + a * h**2 / 2.0 + j * h**3 / 6.0,
                np.where(inside, v + a * h + j * h**2 / 2.0, 0.0),
                np.where(inside, a + j * h, 0.0),
            ]
        )

    @property
    def _states(self) -> np.ndarray:
        """Position, velocity, acceleration at the knots."""
        found = np.zeros((len(self.times), 3))
        for k, (h, j) in enumerate(zip(np.diff(self.times), self.jerks, strict=True)):
            s, v, a = found[k]
            found[k + 1] = (
                s + v * h + a * h**2 / 2.0 + j * h**3 / 6.0,
                v + a * h + j * h**2 / 2.0,
                a + j * h,
            )
        return found


def positioning(length: float, limits: Limits) -> Profile:
    """The fastest move over `length` (m, either sign) from rest to rest within all limits.

    The move has seven parts of constant jerk, some of zero duration: jerk J for t_j, acceleration
    J t_j for t_a, and so on. Where neither the velocity nor the acceleration limit is reached, the
    peak acceleration is (S J^2 / 2)^(1/3). Raises `ValueError` for limits that are not above zero
    or not finite, and for a length that is zero or not finite.
    """
    v, a, J = limits.velocity, limits.acceleration, limits.jerk
    if not all(0.0 < x < math.inf for x in (v, a, J, abs(length))):
        raise ValueError(
            f"found length = {length:g} m, velocity = {v:g} m/s, acceleration = {a:g} m/s^2 and "
            f"jerk = {J:g} m/s^3, expected a length that is not zero and "
            "limits above zero, all of them finite; correct them"
        )
    S = abs(length)
    # The velocity that length and limits allow, first assuming that the acceleration is reached.
    reached = -(a**2) / (2.0 * J) + math.sqrt((a**2 / (2.0 * J)) ** 2 + a * S)
    if min(v, reached) < a**2 / J:
        reached = (S * math.sqrt(J) / 2.0) ** (2.0 / 3.0)
    peak = min(v, reached)
    a = min(a, math.sqrt(peak * J))
    t_j = a / J
    t_a = max(peak / a - t_j, 0.0)
    t_v = max(S / peak - (2.0 * t_j + t_a), 0.0)
    steps = np.array([t_j, t_a, t_j, t_v, t_j, t_a, t_j])
    signs = np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    return Profile(np.r_[0.0, np.cumsum(steps)], math.copysign(J, length) * signs)
