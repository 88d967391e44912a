"""In-talk and cross-talk of every circle by the evaluation of the publication.

Nguyen, Weikert, Wegener (2012), section 2.3. Perpendicular to the plane of a circle, the external
reading is fitted by the plane y = c + EYZ z'' + EYX x'' (eq. 9), which gives two elements of
cross-talk. In the plane, the cross-talk of the other circles is subtracted first. The result is
fitted by an ellipse along the axes, whose half axes are those of the internal reading minus EZZ a
and EXX a (eqs. 7 and 8), which gives two elements of in-talk. Both are least-squares fits. The
acceleration is the set one, in the direction of the internal reading (eqs. 5 and 6), or the actual
one.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..instruments.r_test import RTest
from ..machine.circles import fit_circle
from ..model.measurement import Measurement

_AXES = "XYZ"
Acceleration = Literal["nominal", "actual"]


@dataclass(frozen=True)
class Evaluated:
    """Elements of the matrix by the evaluation of the publication, um s^2/m."""

    runs: Float[np.ndarray, "r 3 3"]
    """Elements by run; NaN where a circle does not determine the element."""
    acceleration: Float[np.ndarray, " r"]
    """Set acceleration of every run, m/s^2."""

    @property
    def mean(self) -> Float[np.ndarray, "3 3"]:
        """Mean over the runs that determine an element."""
        return np.nanmean(self.runs, axis=0)

    def at(self, acceleration: float) -> Float[np.ndarray, "3 3"]:
        """Mean over the runs of one set acceleration that determine an element."""
        return np.nanmean(self.runs[np.isclose(self.acceleration, acceleration)], axis=0)

    def dispersion(self, about: Float[np.ndarray, "3 3"] | None = None) -> dict[float, float]:
        """Root mean square about the mean of all runs, or about a matrix, by set acceleration."""
        deviation = self.runs - (self.mean if about is None else about)
        found = {}
        for a in np.unique(np.round(self.acceleration, 9)):
            mine = deviation[np.isclose(self.acceleration, a)]
            found[float(a)] = float(np.sqrt(np.nanmean(mine**2)))
        return found


def evaluate(
    measurement: Measurement, instrument: RTest, acceleration: Acceleration = "actual"
) -> Evaluated:
    """Both fits for every run of an R-test with readings of coordinates.

    Raises `ValueError` for readings of single probes, and unless there are circles in all three
    planes: every plane gives two of the six elements of cross-talk, and the in-talk needs all six.
    """
    instrument.check_coordinates()
    plan = measurement.plan
    run, t = np.asarray(plan.groups["run"]), np.asarray(plan.covariate("t_run"))
    position, external = np.asarray(plan.position), np.asarray(measurement.readings)
    numbers = np.unique(run)
    found = np.full((len(numbers), 3, 3), np.nan)
    circles = [fit_circle(t[run == k], position[run == k]) for k in numbers]
    planes = {"".join(np.array(list(_AXES))[c.moving]) for c in circles}
    if planes != {"XY", "YZ", "XZ"}:
        raise ValueError(
            f"found circles in {', '.join(sorted(planes))}, expected some in XY, YZ and XZ: every "
            "plane gives two elements of the cross-talk; measure the planes that are missing"
        )
    settings = np.array([plan.covariate("a_set_m_s2")[run == k][0] for k in numbers])
    accelerations = []
    for number, circle, a_set in zip(numbers, circles, settings, strict=True):
        place = position[run == number] - circle.centre
        if acceleration == "nominal":
            far = np.linalg.norm(place, axis=1, keepdims=True)
            accelerations.append(-a_set * place / far)
        else:
            accelerations.append(circle.acceleration(t[run == number]))
    for i, (number, circle) in enumerate(zip(numbers, circles, strict=True)):
        (across,), inside = np.flatnonzero(~circle.moving), np.flatnonzero(circle.moving)
        a, read = accelerations[i][:, inside], external[run == number, across]
        columns = np.column_stack([np.ones(len(a)), a])
        found[i, across, inside] = 1e6 * np.linalg.lstsq(columns, read, rcond=None)[0][1:]
    crosstalk = np.nansum(found, axis=0) / np.maximum(np.isfinite(found).sum(axis=0), 1)
    for i, (number, circle) in enumerate(zip(numbers, circles, strict=True)):
        mine, inside = run == number, np.flatnonzero(circle.moving)
        first, second = inside
        a = accelerations[i]
        untilted = external[mine][:, inside].copy()
        untilted[:, 0] -= 1e-6 * crosstalk[first, second] * a[:, second]
        untilted[:, 1] -= 1e-6 * crosstalk[second, first] * a[:, first]
        if acceleration == "nominal":
            half = np.full(2, _radius(circle.amplitude))
            peak = np.full(2, settings[i])
        else:
            half = circle.amplitude[inside]
            peak = circle.omega**2 * half
        reached = even_ellipse(untilted)
        found[i, inside, inside] = 1e6 * (half - reached) / peak
    return Evaluated(found, settings)


def _radius(amplitude: Float[np.ndarray, " axes"]) -> float:
    """Radius of the circle in the internal reading, m."""
    return float(np.sort(amplitude)[-2:].mean())


def even_ellipse(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Half axes of the least-squares ellipse along the coordinates, A x^2 + B y^2 + C x + D y = 1.

    Raises `ValueError` where the points are not those of an ellipse.
    """
    middle, size = points.mean(0), np.ptp(points, axis=0) / 2.0
    x, y = ((points - middle) / size).T
    columns = np.column_stack([x * x, y * y, x, y])
    A, B, C, D = np.linalg.lstsq(columns, np.ones(len(x)), rcond=None)[0]
    level = 1.0 + C**2 / (4.0 * A) + D**2 / (4.0 * B)
    if A <= 0.0 or B <= 0.0 or level <= 0.0:
        raise ValueError("found points that lie on no ellipse, expected points of a circle")
    return size * np.sqrt(level / np.array([A, B]))
