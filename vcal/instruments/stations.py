"""Poses of instruments from their readings and nominal points, in closed form.

They are starting values of a fit from anywhere, and decide before any fit whether readings follow
the machine (`vcal.instruments.follow`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..numerics.spatial import best_rigid

_OUTLIER = 5.0
"""Distances from a pose, in units of their median, of readings that the pose leaves out."""
_ROUNDS = 3
_FLAT = 1e-3
"""Least thickness of a set of points, as a share of its length, at which it is no plane."""
_STEPS = 20


class Pose(NamedTuple):
    """A frame in that of the workpiece."""

    orientation: Float[np.ndarray, "3 3"]
    place: Float[np.ndarray, "3"]


class Lateration(NamedTuple):
    """Place of an instrument that reads distances only."""

    place: Float[np.ndarray, "3"]
    dead_path: float
    """Distance at which it reads zero, m."""


def fitted_pose(seen: Float[np.ndarray, "n 3"], nominal: Float[np.ndarray, "n 3"]) -> Pose:
    """Pose (R, s) with R seen + s = nominal in the least-squares sense, m, without outliers.

    Kabsch's closed form, repeated without the points that are farther off than five times the
    median distance.
    """
    used = np.ones(len(seen), bool)
    for _ in range(_ROUNDS):
        turn, place = best_rigid(seen[used], nominal[used])
        used = _near(np.linalg.norm(seen @ turn.T + place - nominal, axis=1))
    return Pose(turn, place)


def _near(off: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    return off <= max(_OUTLIER * float(np.median(off)), 1e-12)


def laterated(
    points: Float[np.ndarray, "n 3"],
    ranges: Float[np.ndarray, " n"],
    near: Float[np.ndarray, "3"] | None = None,
    dead_path: float | None = None,
) -> Lateration:
    """Place s and dead path d with ranges = norm(points - s) - d, m, without outliers.

    The square of the equation is linear in s, d and d^2 - s^2, which is solved first::

        p^2 - r^2 = 2 p's + 2 r d + (d^2 - s^2)

    Gauss-Newton steps on the distances follow. Where the points lie in a plane, the place may be on
    either side: it is the one nearer to `near`, or the upper one. With `dead_path`, d is known.
    """
    used = np.ones(len(points), bool)
    found = Lateration(points.mean(0), 0.0)
    for _ in range(_ROUNDS):
        found = _laterated(points[used], ranges[used], near, dead_path)
        left = np.linalg.norm(points - found.place, axis=1) - found.dead_path - ranges
        used = _near(np.abs(left))
    return found


def _laterated(
    points: Float[np.ndarray, "n 3"],
    ranges: Float[np.ndarray, " n"],
    near: Float[np.ndarray, "3"] | None,
    dead_path: float | None,
) -> Lateration:
    middle = points.mean(0)
    _, sizes, axes = np.linalg.svd(points - middle, full_matrices=False)
    p = (points - middle) @ axes.T
    flat = sizes[2] < _FLAT * sizes[0]
    columns = p[:, :2] if flat else p
    known = 0.0 if dead_path is None else dead_path
    r = ranges + known
    unknown = [2.0 * columns, np.ones((len(p), 1))]
    if dead_path is None:
        unknown.insert(1, 2.0 * r[:, None])
    solved = np.linalg.lstsq(np.hstack(unknown), (p**2).sum(1) - r**2, rcond=None)[0]
    s = np.zeros(3)
    s[: columns.shape[1]] = solved[: columns.shape[1]]
    d = float(solved[-2]) if dead_path is None else 0.0
    if flat:
        height = np.sqrt(max(d**2 - float(solved[-1]) - float(s @ s), 0.0))
        toward = axes[2] @ (np.array([0.0, 0.0, 1.0]) if near is None else near - middle)
        s[2] = height if toward >= 0.0 else -height
    for _ in range(_STEPS):
        v = p - s
        length = np.maximum(np.linalg.norm(v, axis=1), 1e-9)
        J = -v / length[:, None]
        if dead_path is None:
            J = np.hstack([J, -np.ones((len(p), 1))])
        step = np.linalg.lstsq(J, r - (length - d), rcond=1e-9)[0]
        s, d = s + step[:3], d + (float(step[3]) if dead_path is None else 0.0)
        if np.abs(step).max() < 1e-12:
            break
    return Lateration(s @ axes + middle, d + known)
