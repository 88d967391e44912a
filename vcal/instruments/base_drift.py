"""Motion of an instrument's frame, estimated from stationary reflectors on the base.

Every pose gives the rigid motion that brings the base's reflectors back onto their positions: six
numbers y, with the noise e of so many readings. The size of e follows from the deviations of the
base's reflectors from their common shape, which no motion of the frame changes. Each of the six
follows the model::

    y_i = a_i + b_i + e_i,    a_i = a_(i-1) + w_i,    var w = r (var b + var e) (o_i - o_(i-1))

with o the order of the poses: a varies slowly, b is independent at every pose, as where the beam is
bent. The likelihood of r is that of a Kalman filter (Durbin, Koopman, Time Series Analysis by State
Space Methods, 2012, ch. 2). Where the best r is not significantly better than r = 0, the frame is
stationary: a is the mean of all poses, and the deviations from it are multiplied by the share of b,
var b / (var b + var e), so that noise of the base does not become noise of the tool. Where the
frame drifts, y is used as it is: a smoother would leave less noise, but the remaining error would
be correlated over many poses and resemble an effect.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ..numerics.spatial import best_rigid

_RATIOS = np.r_[0.0, np.geomspace(1e-6, 1e6, 49)]
_KNOCKED = 5.0
"""Multiple of the median deviation from the common shape above which a pose is an outlier and not
used for the drift."""
_LINE = 1e-3
"""Ratio of breadth to length below which reflectors lie on one line."""
_DRIFTS = 6.0
"""Twice the log likelihood ratio above which a frame drifts; 1 in 140 stationary ones has it."""
_ROUNDING = 1e-12
"""Least noise, m or rad."""


@dataclass(frozen=True)
class BaseDrift:
    """The motion of the frame relative to the base's reflectors at every pose."""

    centre: Float[np.ndarray, "3"]
    """Middle of the base's reflectors, m."""
    axes: Float[np.ndarray, "3 3"]
    """Their principal axes, one per row: along and about them the six are independent."""
    motion: Float[np.ndarray, "n 6"]
    """Motion that corrects the readings of a pose: along the axes (m) and about them (rad)."""
    u: Float[np.ndarray, "6"]
    """Standard uncertainty of the motion at every pose, without the part common to all poses."""

    @classmethod
    def of(cls, base: Float[np.ndarray, "n k 3"], order: Float[np.ndarray, " n"]) -> "BaseDrift":
        """From the readings of at least three reflectors on the base. Raises `ValueError` where
        they lie on one line: the rotation of the frame about it is then not observable.
        """
        shape, count = base[0], base.shape[1]
        spans = np.linalg.svd(shape - shape.mean(0), compute_uv=False)
        if spans[1] < _LINE * spans[0]:
            raise ValueError("on one line")
        for _ in range(2):  # the second time against the mean shape of all poses
            turns, moves = _back(base, shape)
            aligned = np.einsum("nij,nkj->nki", turns, base) + moves[:, None]
            off = ((aligned - shape) ** 2).sum((1, 2))
            sound = off <= max(_KNOCKED**2 * float(np.median(off)), 1e-24)
            shape = aligned[sound].mean(0)
            r, t = best_rigid(shape, base[sound].mean(0))
            shape = shape @ r.T + t
        # Imported here, as the import takes long and only arms need it.
        from scipy.spatial.transform import Rotation

        centre = shape.mean(0)
        axes = np.linalg.svd(shape - centre)[2]
        axes[2] = np.cross(axes[0], axes[1])
        moves = turns @ centre + moves - centre
        seen = np.hstack([moves @ axes.T, Rotation.from_matrix(turns).as_rotvec() @ axes.T])
        squares = ((aligned[sound] - aligned[sound].mean(0)) ** 2).sum()
        variance = squares / ((3 * count - 6) * max(int(sound.sum()) - 1, 1))
        arms = (((shape - centre) @ axes.T) ** 2).sum(0)
        noise = variance / np.r_[np.full(3, count), arms.sum() - arms]
        motion, u = _motion(seen, np.asarray(order, float), sound, np.maximum(noise, _ROUNDING**2))
        return cls(centre, axes, motion, u)

    def undone(self, points: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n k 3"]:
        """Points read at every pose (m), corrected for the drift."""
        from scipy.spatial.transform import Rotation

        moves, turns = self.motion[:, :3] @ self.axes, self.motion[:, 3:] @ self.axes
        turned = np.einsum(
            "nij,nkj->nki", Rotation.from_rotvec(turns).as_matrix(), points - self.centre
        )
        return turned + (self.centre + moves)[:, None]


def _back(
    base: Float[np.ndarray, "n k 3"], shape: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Least-squares rotation and translation of every pose's reflectors onto a shape (Kabsch)."""
    middle, centre = base.mean(1), shape.mean(0)
    u, _, vt = np.linalg.svd(np.einsum("nki,kj->nij", base - middle[:, None], shape - centre))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turns = np.einsum("nij,njk->nki", u, vt)
    return turns, centre - np.einsum("nij,nj->ni", turns, middle)


def _motion(
    y: Float[np.ndarray, "n 6"],
    order: Float[np.ndarray, " n"],
    sound: Bool[np.ndarray, " n"],
    noise: Float[np.ndarray, "6"],
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "6"]]:
    """The motion at every pose, and its standard uncertainty. `noise` is the variance of the noise,
    `sound` the poses that are no outliers; the motion at the others is interpolated.
    """
    times = order[sound]
    by_time = np.argsort(times, kind="stable")
    seen, times = y[sound][by_time], times[by_time]
    costs, variances = _costs(seen, np.diff(times), noise)
    drifts = costs[0] - costs.min(0) > _DRIFTS
    middle, share = seen.mean(0), 1.0 - noise / variances[0]
    kept = np.where(drifts, seen, middle + share * (seen - middle))
    motion = np.column_stack([np.interp(order, times, one) for one in kept.T])
    return motion, np.sqrt(np.where(drifts, 1.0, share) * noise)


def _costs(
    y: Float[np.ndarray, "n 6"], steps: Float[np.ndarray, " n-1"], noise: Float[np.ndarray, "6"]
) -> tuple[Float[np.ndarray, "g 6"], Float[np.ndarray, "g 6"]]:
    """Twice the negative log likelihood of random walks of every ratio r, up to a constant, and the
    variance about them that minimises it, which is at least that of the noise.

    The first level has a flat prior, so that n poses give n - 1 innovations (Kalman filter, with
    variances relative to that about the walk).
    """
    at, p = np.broadcast_to(y[0], (len(_RATIOS), y.shape[1])), np.ones((len(_RATIOS), 1))
    squares, logs = np.zeros(at.shape), np.zeros(p.shape)
    for one, step in zip(y[1:], steps, strict=True):
        p = p + _RATIOS[:, None] * step
        squares += (one - at) ** 2 / (p + 1.0)
        logs += np.log(p + 1.0)
        p = p / (p + 1.0)
        at = at + p * (one - at)
    innovations = max(len(steps), 1)
    variances = np.maximum(squares / innovations, noise)
    return innovations * np.log(variances) + squares / variances + logs, variances
