"""Larger movements: the positioning of the publication, and whether E holds for any other."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from ...dynamics.closed_loop import ClosedLoop, Response, run
from ...dynamics.setpoints import Limits, Profile, positioning
from .setting import move

_SETTLE_S = 0.15
_RUN = jax.jit(run)


@dataclass(frozen=True)
class Positioning:
    """A move along Z and what came of it."""

    t: Float[np.ndarray, " n"]
    asked: Float[np.ndarray, "n 3"]
    """Set position (m), velocity, acceleration of Z."""
    position: Float[np.ndarray, " n"]
    """Actual, m."""
    acceleration: Float[np.ndarray, " n"]
    """Actual, m/s^2."""
    across: Float[np.ndarray, " n"]
    """Displacement of the tool point along X, m."""

    @property
    def set_peak(self) -> float:
        """m/s^2, of the profile itself."""
        return move().peak_acceleration

    @property
    def peak(self) -> float:
        """Largest actual acceleration, m/s^2."""
        return float(self.acceleration.max())

    @property
    def at_peak_um(self) -> float:
        """Displacement when it is reached."""
        return 1e6 * float(self.across[int(self.acceleration.argmax())])

    @property
    def ratio(self) -> float:
        """Of the two, um s^2/m."""
        return self.at_peak_um / self.peak

    @property
    def fitted(self) -> float:
        """Displacement per acceleration by least squares over the whole move, um s^2/m."""
        a = self.acceleration
        return 1e6 * float(a @ self.across / (a @ a))


def travel(loop: ClosedLoop, profile: Profile, direction: Float[np.ndarray, " axes"]) -> Response:
    """A profile along a direction (per axis), from rest until it has settled."""
    T = loop.sample_time
    # A few lengths only, so that moves of similar duration share a program.
    rows = int(np.ceil((profile.duration + _SETTLE_S) / T / 500.0)) * 500
    s, v, _ = profile(T * np.arange(rows)).T
    return _RUN(loop, np.outer(s, direction), np.outer(v, direction))


def positioned(loop: ClosedLoop) -> Positioning:
    """The move of section 3.4 along Z."""
    along = np.array([axis == "Z" for axis in loop.axes], float)
    found = travel(loop, move(), along)
    z = loop.axes.index("Z")
    t = np.asarray(found.t)
    return Positioning(
        t,
        move()(t),
        np.asarray(found.scale[:, z]),
        np.asarray(found.acceleration[:, z]),
        np.asarray(found.error[:, 0]),
    )


MOVES: dict[str, tuple[float, Limits, tuple[float, float, float]]] = {
    "Z, 20 mm, 250 m/s³": (0.02, Limits(0.5, 10.0, 250.0), (0, 0, 1)),
    "X, 200 mm, 100 m/s³": (0.2, Limits(0.5, 5.0, 100.0), (1, 0, 0)),
    "Y, 80 mm, 200 m/s³": (0.08, Limits(0.5, 6.0, 200.0), (0, 1, 0)),
    "X, Y and Z, 60 mm, 200 m/s³": (0.06, Limits(0.4, 6.0, 200.0), (0.6, -0.64, 0.48)),
    "Z, 20 mm, 1000 m/s³": (0.02, Limits(0.5, 10.0, 1000.0), (0, 0, 1)),
    "Z, 5 mm, 5000 m/s³": (0.005, Limits(0.5, 10.0, 5000.0), (0, 0, 1)),
}
"""Length (m), limits, and direction by axis X, Y, Z of movements that no circle resembles."""


@dataclass(frozen=True)
class Compensated:
    """One movement before and after the matrix has been taken off, at the tool point."""

    largest_um: float
    before_um: float
    """Root mean square over the time in which the axes are accelerated."""
    after_um: float
    after_largest_um: float

    @property
    def left(self) -> float:
        """Share that is left."""
        return self.after_um / self.before_um


def compensated(loop: ClosedLoop, matrix: Float[np.ndarray, "3 3"]) -> dict[str, Compensated]:
    """Every movement of `MOVES`, less E times its actual acceleration; E in um s^2/m."""
    found = {}
    place = ["XYZ".index(axis) for axis in loop.axes]
    for name, (length, limits, way) in MOVES.items():
        profile = positioning(length, limits)
        response = travel(loop, profile, np.asarray(way, float)[place])
        mine = np.asarray(response.t) <= profile.duration
        error = 1e6 * np.asarray(response.error)[mine]
        left = error - np.asarray(response.acceleration)[mine] @ matrix[:, place].T
        sizes = [np.linalg.norm(e, axis=1) for e in (error, left)]
        before, after = (float(np.sqrt((s**2).mean())) for s in sizes)
        found[name] = Compensated(float(sizes[0].max()), before, after, float(sizes[1].max()))
    return found
