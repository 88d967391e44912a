"""Deviations of circular paths as ISO 230-4 defines them, from radial readings; plain numpy.

The actual path of a run is p_i = (R + f_i) (cos phi_i, sin phi_i), with the nominal radius R, the
commanded angle phi_i and the reading f_i along the radius, positive outwards. The least-squares
circle of a path has the centre c and the radius r of

    min sum_i (|p_i - c| - r)^2,

and the minimum zone circles the centre of

    min_c (max_i |p_i - c| - min_i |p_i - c|).

- *Circular deviation* G: radial separation of two concentric circles that envelop the path in one
  sense. By definition it is that of the minimum zone circles; it may be evaluated as the radial
  range about the centre of the least-squares circle, which is never smaller.
- *Bidirectional circular deviation* G(b): the same of both paths, clockwise and counter-clockwise,
  together.
- *Radial deviation* F: |p_i - c| - R, with its extremes F_max and F_min; c is the centre at which
  the instrument was set up or, on full circles only, that of the least-squares circle.
- *Mean bidirectional radial deviation* D: mean radius of both paths minus R, on full circles only.
- *Circular hysteresis* H: largest radial difference |f_ccw - f_cw| of both paths at one angle, in
  the edition of 1996; G(b) has taken its place since 2005.

Small errors of a machine give, with t = phi and the sense s = 1 (counter-clockwise) or -1:

    squareness e (Y turned towards X by e)   f = -e R sin(2 t)/2            G = e R, D = H = 0
    scales e_x, e_y                          f = R (e_x cos^2 t + e_y sin^2 t)
                                             G = R |e_x - e_y|, D = R (e_x + e_y)/2, H = 0
    backlash b of X, a lead b/2 sgn(v_x)     f = -s b/2 sgn(sin t) cos t    G = G(b) = H = b, D = 0
    lag T of X, at the feed v                f = s v T sin(2 t)/2           G = G(b) = H = vT, D = 0

Public abstracts of both editions name these quantities: UNI ISO 230-4:2010
(https://store.uni.com/uni-iso-230-4-2010), DIN ISO 230-4 of 1996
(https://www.aenor.com/normas-y-libros/buscador-de-normas/din?c=39812701).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog

_STEPS = 20
_FULL = 2.0 * np.pi * 0.9
"""Least angle from the first to the last reading of a full circle, rad."""
_SAME_RAD = 1e-9
"""Difference below which two angles are one."""


@dataclass(frozen=True)
class Zone:
    """The ring between two concentric circles that envelop a path."""

    centre: Float[np.ndarray, "2"]
    """Their centre relative to the nominal one, m."""
    radius: float
    """Mean radius of the path about it, m: that of the least-squares circle, or the mean of both
    circles of a minimum zone."""
    inner: float
    """Radius of the inscribed circle, m."""
    outer: float
    """Radius of the circumscribed circle, m."""

    @property
    def width(self) -> float:
        """Their radial separation, m."""
        return self.outer - self.inner


def actual_path(
    angle: Float[np.ndarray, " n"], deviation: Float[np.ndarray, " n"], radius: float
) -> Float[np.ndarray, "n 2"]:
    """Points of the actual path in its plane, m, relative to the nominal centre."""
    return (radius + deviation)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def least_squares_circle(path: Float[np.ndarray, "n 2"]) -> Zone:
    """The least-squares circle of a path, by Gauss-Newton steps from its linear approximation.

    Raises `ValueError` for fewer than three points.
    """
    path = np.asarray(path, float)
    if len(path) < 3:
        raise ValueError(f"found {len(path)} points, expected at least three for a circle")
    linear = np.column_stack([2.0 * path, np.ones(len(path))])
    centre = np.linalg.lstsq(linear, (path**2).sum(1), rcond=None)[0][:2]
    for _ in range(_STEPS):
        arm = path - centre
        far = np.linalg.norm(arm, axis=1)
        slopes = np.column_stack([-arm / far[:, None], -np.ones(len(far))])
        step = np.linalg.lstsq(slopes, -(far - far.mean()), rcond=None)[0][:2]
        centre = centre + step
        if np.abs(step).max() <= 1e-15 * far.mean():
            break
    far = np.linalg.norm(path - centre, axis=1)
    return Zone(centre, float(far.mean()), float(far.min()), float(far.max()))


def minimum_zone_circles(path: Float[np.ndarray, "n 2"]) -> Zone:
    """The minimum zone circles of a path: linear programmes about the centre of the step before,
    from that of the least-squares circle.

    With the unit vectors u_i from the centre to the points, a step s minimises h - l under
    l <= |p_i - c| - u_i.s <= h; the error of this linearisation is |s|^2 / (2 R).
    """
    return _minimum_zone(np.asarray(path, float))[0]


def _minimum_zone(path: Float[np.ndarray, "n 2"]) -> tuple[Zone, Float[np.ndarray, " n"]]:
    """The minimum zone circles, and the derivative of their separation by the radius of every
    point: the multipliers of the linear programme, which are zero but for the points touched.
    """
    found, weights = least_squares_circle(path), np.zeros(len(path))
    for _ in range(_STEPS):
        arm = path - found.centre
        far = np.linalg.norm(arm, axis=1)
        size = max(float(np.ptp(far)), 1e-12)
        unit, off = arm / far[:, None], (far - far.mean()) / size
        one = np.ones((len(far), 1))
        # In units of the width of the zone, so that the tolerances of the solver are relative.
        above = np.hstack([-unit, -one, 0.0 * one])
        below = np.hstack([unit, 0.0 * one, one])
        solved = linprog(
            [0.0, 0.0, 1.0, -1.0],
            A_ub=np.vstack([above, below]),
            b_ub=np.concatenate([-off, off]),
            bounds=[(None, None)] * 4,
            method="highs",
        )
        if not solved.success:
            break
        multipliers = solved.ineqlin.marginals
        weights = multipliers[len(far) :] - multipliers[: len(far)]
        centre = found.centre + size * solved.x[:2]
        far = np.linalg.norm(path - centre, axis=1)
        better = Zone(
            centre, 0.5 * float(far.max() + far.min()), float(far.min()), float(far.max())
        )
        gained = found.width - better.width
        found = better if gained > 0.0 else found
        if gained <= 1e-9 * size:
            break
    return found, weights


@dataclass(frozen=True)
class CircularDeviations:
    """The deviations of one path, or of both paths together, m."""

    circular: float
    """G, or G(b): width of the minimum zone circles."""
    circular_least_squares: float
    """The same as the radial range about the centre of the least-squares circle."""
    radial_max: float
    """F_max about the centre at which the instrument was set up."""
    radial_min: float
    """F_min about the same centre."""
    radial_max_centred: float
    """F_max about the centre of the least-squares circle; nan for an arc."""
    radial_min_centred: float
    """F_min about the same centre; nan for an arc."""
    mean_radial: float
    """Mean radius about the least-squares centre minus R: D, where the paths are both of a pair;
    nan for an arc."""
    hysteresis: float = float("nan")
    """H of a pair (`circular_hysteresis`); nan for a single path."""

    @property
    def values(self) -> tuple[float, ...]:
        """All of them, in this order."""
        return tuple(getattr(self, name) for name in self.__dataclass_fields__)


def is_full_circle(angle: Float[np.ndarray, " n"]) -> bool:
    """Whether successive angles of a run, rad, go once round."""
    travelled = np.unwrap(angle)
    return bool(np.ptp(travelled) >= _FULL)


def circular_deviations(
    path: Float[np.ndarray, "n 2"], radius: float, *, full: bool = True
) -> CircularDeviations:
    """The deviations of a path (n, 2), m, of the nominal radius, m; of one sense, or of both paths
    one after the other. `full` says that it is a whole circle and no arc.

    Raises `ValueError` for fewer than three points.
    """
    path = np.asarray(path, float)
    fitted, least = least_squares_circle(path), minimum_zone_circles(path)
    far = np.linalg.norm(path, axis=1) - radius
    nan = float("nan")
    return CircularDeviations(
        circular=least.width,
        circular_least_squares=fitted.width,
        radial_max=float(far.max()),
        radial_min=float(far.min()),
        radial_max_centred=fitted.outer - radius if full else nan,
        radial_min_centred=fitted.inner - radius if full else nan,
        mean_radial=fitted.radius - radius if full else nan,
    )


def sensitivities(path: Float[np.ndarray, "n 2"], *, full: bool = True) -> Float[np.ndarray, "7 n"]:
    """Derivatives of the deviations of a path, in the order of `CircularDeviations.values` without
    the hysteresis, by the radial reading of every point.

    The centre of the least-squares circle moves by the regression of the changes on (cos phi,
    sin phi, 1); a range depends on its two extreme points, a minimum zone on the points that it
    touches.
    """
    path = np.asarray(path, float)
    fitted, (_, touched) = least_squares_circle(path), _minimum_zone(path)
    arm = path - fitted.centre
    far = np.linalg.norm(arm, axis=1)
    unit, one = arm / far[:, None], np.eye(len(far))
    moved = np.linalg.pinv(np.column_stack([unit, np.ones(len(far))]))[:2]
    about = one - unit @ moved
    reading = np.linalg.norm(path, axis=1)
    high, low = about[np.argmax(far)], about[np.argmin(far)]
    rows = [touched, high - low, one[np.argmax(reading)], one[np.argmin(reading)]]
    rows += [high, low, about.mean(0)] if full else [np.full(len(far), np.nan)] * 3
    return np.stack(rows)


def circular_hysteresis(
    angles: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]],
    deviations: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]],
    *,
    full: bool = True,
) -> tuple[float, Float[np.ndarray, " n+m"]]:
    """The circular hysteresis H of a pair, m, and its derivative by all radial readings.

    `angles` are those of both paths along one circle, rad, `deviations` their radial readings, m.
    The second path is interpolated linearly between its angles, at those of the first one that lie
    in its arc; on a `full` circle across its ends too. Raises `ValueError` for paths without any
    angle in common.
    """
    first, second = (np.asarray(angle, float) for angle in angles)
    order = np.argsort(np.mod(second - first[0], 2.0 * np.pi))
    at, place = np.mod(second - first[0], 2.0 * np.pi)[order], np.mod(first - first[0], 2.0 * np.pi)
    if full:
        at = np.concatenate([at[-1:] - 2.0 * np.pi, at, at[:1] + 2.0 * np.pi])
        order = np.concatenate([order[-1:], order, order[:1]])
    else:
        # Cut where the arc has its gap.
        gap = int(np.argmax(np.diff(np.append(at, at[0] + 2.0 * np.pi))))
        start = at[(gap + 1) % len(at)]
        at, order = np.roll(at, -gap - 1), np.roll(order, -gap - 1)
        at, place = np.mod(at - start, 2.0 * np.pi), np.mod(place - start, 2.0 * np.pi)
        place = np.where(place > 2.0 * np.pi - _SAME_RAD, 0.0, place)
    inside = np.flatnonzero((place >= at[0]) & (place <= at[-1] + _SAME_RAD))
    if not len(inside):
        raise ValueError("found two paths without an angle in common, expected those of one circle")
    right = np.clip(np.searchsorted(at, place[inside]), 1, len(at) - 1)
    share = (place[inside] - at[right - 1]) / (at[right] - at[right - 1])
    n, rows = len(first), np.arange(len(inside))
    weights = np.zeros((len(inside), n + len(second)))
    weights[rows, inside] = 1.0
    np.add.at(weights, (rows, n + order[right - 1]), -(1.0 - share))
    np.add.at(weights, (rows, n + order[right]), -share)
    apart = weights @ np.concatenate([np.asarray(f, float) for f in deviations])
    largest = int(np.argmax(np.abs(apart)))
    sign = 1.0 if apart[largest] >= 0.0 else -1.0
    return float(abs(apart[largest])), sign * weights[largest]
