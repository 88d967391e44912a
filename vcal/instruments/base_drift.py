"""How an instrument's frame moves, as reflectors tell that stand still on the base.

Every pose gives the rigid motion that brings the base's reflectors back onto their places: six
numbers y, with the noise e of so many readings. Of what the frame does, a is slow and told by the
poses before and after as well; b is another one at every pose, as where the beam is bent,

    y_i = a_i + b_i + e_i,    a_i = a_(i-1) + w_i,    var w = r (var b + var e) (o_i - o_(i-1)),

o the order of the poses. var e follows from how the base's reflectors are off their shape, which no
motion of the frame changes; var b + var e and r are those of maximum likelihood, and a comes from
Kalman's filter and the smoother of Rauch, Tung and Striebel (Durbin, Koopman, Time Series Analysis
by State Space Methods, 2012, ch. 2). The motion is then a + k (y - a), k = var b / (var b + var e):
noise of the base does not become noise of the tool, and what both have is taken off both.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ..spatial import best_rigid

_RATIOS = np.r_[0.0, np.geomspace(1e-6, 1e6, 49)]
_KNOCKED = 5.0
"""Times the median by which the base's reflectors must be off their shape for a pose to tell
nothing of the drift."""
_LINE = 1e-3
"""Breadth over length of what is a line."""
_DIFFUSE = 1e10
"""Variance of a level before anything is known of it, in parts of that of y about it."""
_ROUNDING = 1e-12
"""m or rad: what is no noise."""


@dataclass(frozen=True)
class BaseDrift:
    """The motion of the frame at every pose, against the base's reflectors."""

    centre: Float[np.ndarray, "3"]
    """Middle of the base's reflectors, m."""
    axes: Float[np.ndarray, "3 3"]
    """Their principal axes, one per row: along and about them the six are independent."""
    motion: Float[np.ndarray, "n 6"]
    """What brings the readings of a pose back: along the axes (m) and about them (rad)."""
    u: Float[np.ndarray, "6"]
    """Standard uncertainty of that, on average over the poses."""

    @classmethod
    def of(cls, base: Float[np.ndarray, "n k 3"], order: Float[np.ndarray, " n"]) -> "BaseDrift":
        """From the readings of at least three reflectors of the base. Raises `ValueError` where
        they are on one line, about which nothing tells how the frame turns.
        """
        shape, count = base[0], base.shape[1]
        spans = np.linalg.svd(shape - shape.mean(0), compute_uv=False)
        if spans[1] < _LINE * spans[0]:
            raise ValueError("on one line")
        for _ in range(2):  # the second time against the shape of all poses, in their middle
            turns, moves = _back(base, shape)
            aligned = np.einsum("nij,nkj->nki", turns, base) + moves[:, None]
            off = ((aligned - shape) ** 2).sum((1, 2))
            sound = off <= max(_KNOCKED**2 * float(np.median(off)), 1e-24)
            shape = aligned[sound].mean(0)
            r, t = best_rigid(shape, base[sound].mean(0))
            shape = shape @ r.T + t
        centre = shape.mean(0)
        axes = np.linalg.svd(shape - centre)[2]
        axes[2] = np.cross(axes[0], axes[1])
        moves = turns @ centre + moves - centre
        seen = np.hstack([moves @ axes.T, Rotation.from_matrix(turns).as_rotvec() @ axes.T])
        squares = ((aligned[sound] - aligned[sound].mean(0)) ** 2).sum()
        variance = squares / ((3 * count - 6) * max(int(sound.sum()) - 1, 1))
        arms = (((shape - centre) @ axes.T) ** 2).sum(0)
        noise = variance / np.r_[np.full(3, count), arms.sum() - arms]
        noise = np.maximum(noise, _ROUNDING**2)
        slow, unsure, white = _smoothed(seen, np.asarray(order, float), sound, noise)
        share = 1.0 - noise / white
        motion = slow + np.where(sound[:, None], share * (seen - slow), 0.0)
        left = share * noise + (1.0 - share) ** 2 * unsure.mean(0)
        return cls(centre, axes, motion, np.sqrt(left))

    def undone(self, points: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n k 3"]:
        """Points as seen at every pose, as they would be seen without the drift."""
        moves, turns = self.motion[:, :3] @ self.axes, self.motion[:, 3:] @ self.axes
        turned = np.einsum(
            "nij,nkj->nki", Rotation.from_rotvec(turns).as_matrix(), points - self.centre
        )
        return turned + (self.centre + moves)[:, None]


def _back(
    base: Float[np.ndarray, "n k 3"], shape: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Rotation and translation that bring every pose's reflectors best onto a shape (Kabsch)."""
    middle, centre = base.mean(1), shape.mean(0)
    u, _, vt = np.linalg.svd(np.einsum("nki,kj->nij", base - middle[:, None], shape - centre))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turns = np.einsum("nij,njk->nki", u, vt)
    return turns, centre - np.einsum("nij,nj->ni", turns, middle)


def _smoothed(
    y: Float[np.ndarray, "n 6"],
    order: Float[np.ndarray, " n"],
    sound: Bool[np.ndarray, " n"],
    noise: Float[np.ndarray, "6"],
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6"], Float[np.ndarray, "6"]]:
    """The random walks that these tell, their variances, and that of what is another one at every
    pose, which is not below that of the `noise`.
    """
    by_time = np.argsort(order, kind="stable")
    y, sound, steps = y[by_time], sound[by_time], np.r_[0.0, np.diff(order[by_time])]
    *_, squares, logs = _filtered(y, steps, sound, _RATIOS[:, None])
    told = max(int(sound.sum()) - 1, 1)
    scales = np.maximum(squares / told, noise)
    best = np.argmin(told * np.log(scales) + squares / scales + logs, axis=0)
    ratio, scale = _RATIOS[best], scales[best, np.arange(y.shape[1])]
    level, spread, ahead, *_ = _filtered(y, steps, sound, ratio)
    for i in range(len(y) - 2, -1, -1):
        gain = spread[i] / ahead[i + 1]
        level[i] += gain * (level[i + 1] - level[i])
        spread[i] += gain**2 * (spread[i + 1] - ahead[i + 1])
    back = np.argsort(by_time)
    return level[back], scale * spread[back], scale


def _filtered(y: np.ndarray, steps: np.ndarray, sound: np.ndarray, ratio: np.ndarray) -> tuple:
    """Kalman's filter of local levels, variances in parts of that of y about them: level, variance
    and variance foretold at every pose (n, ..., 6), and sums of the squares of what is not
    foretold, over their variances, and of the logarithms of these (..., 6).
    """
    shape = np.broadcast_shapes(ratio.shape, y[0].shape)
    level, spread, ahead = (np.empty((len(y), *shape)) for _ in range(3))
    squares, logs = np.zeros(shape), np.zeros(shape)
    at, p, first = np.zeros(shape), np.full(shape, _DIFFUSE), True
    for i, step in enumerate(steps):
        p = p + ratio * step
        ahead[i] = p
        if sound[i]:
            if not first:
                squares += (y[i] - at) ** 2 / (p + 1.0)
                logs += np.log(p + 1.0)
            first = False
            gain = p / (p + 1.0)
            at, p = at + gain * (y[i] - at), gain
        level[i], spread[i] = at, p
    return level, spread, ahead, squares, logs
