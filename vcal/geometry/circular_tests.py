"""Circular tests of ISO 230-4 in the readings of a double ball bar, and as the identified machine
travels the same circles.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..identification.fit import Fit
from ..instruments.double_ball_bar import BarCentre, BarLength, DoubleBallBar, SetupLength
from ..machine.circles import circle_through
from ..machine.plan import Plan
from ..numerics.eigen import eigh
from .circular_deviations import (
    CircularDeviations,
    circular_deviations,
    circular_hysteresis,
    is_full_circle,
    sensitivities,
)

_SAME_M = 1e-6
"""Distance below which two nominal circles are one."""
_OF_BAR = (BarCentre.name, BarLength.name, SetupLength.name)
_NORMALS = ("YZ", "ZX", "XY")
"""Planes by the axis across them."""


@dataclass(frozen=True)
class CircularTest:
    """One path, or the pair of both senses, with the deviations of ISO 230-4."""

    plane: str
    """``"XY"``, ``"YZ"``, ``"ZX"``, or ``"tilted"``."""
    runs: tuple[int, ...]
    """The run, or those of the pair."""
    sense: str
    """``"counter-clockwise"`` or ``"clockwise"``, seen against the axis across the plane;
    ``"both"`` of a pair."""
    radius: float
    """Nominal radius, m."""
    arc: float
    """Angle travelled, rad; the smaller one of a pair."""
    measured: CircularDeviations
    """From the readings, about the commanded centre, with the nominal length."""
    machine: CircularDeviations
    """Of the identified machine: without noise, with the estimated position of the ball and length
    of the bar taken off."""
    u: CircularDeviations
    """Standard uncertainties of those of the machine."""


@dataclass(frozen=True)
class _Path:
    run: int
    rows: np.ndarray
    centre: np.ndarray
    normal: np.ndarray
    radius: float
    arm: np.ndarray
    """Unit vectors from the centre to the positions (n, 3)."""
    full: bool
    arc: float
    alike: tuple[object, ...]
    """Conditions that both paths of a pair have in common."""


def circular_tests(
    fit: Fit, instrument: DoubleBallBar, plan: Plan, rows: np.ndarray
) -> list[CircularTest]:
    """The circular tests in one data set of a ball bar: `plan` is its plan, `rows` are its rows in
    the measurement of the fit.

    A test is a run along a circle or an arc of linear axes whose radius is the length of the bar;
    two runs along the same circle with the same set-up and feed, in opposite senses, are a pair.
    The deviations of the identified machine follow from the readings minus their residuals and
    minus the linear contributions of the bar; their standard uncertainties are those of the points
    on which they depend (`sensitivities`).
    The list is empty where rotary axes may turn.
    """
    if not fit.model.chain.linear:
        return []
    paths = list(_paths(fit, instrument, plan))
    if not paths:
        return []
    read = np.asarray(fit.measurement.readings)[rows, 0]
    machine, root = _of_machine(fit, rows)
    found = []
    for members in (*((p,) for p in paths), *_pairs(paths)):
        first, own = members[0], np.concatenate([p.rows for p in members])
        travelled = _travelled(members, machine)
        spread = np.linalg.norm(sensitivities(travelled, full=first.full) @ root[own], axis=1)
        measured = circular_deviations(_travelled(members, read), first.radius, full=first.full)
        of_machine = circular_deviations(travelled, first.radius, full=first.full)
        u = CircularDeviations(*(float(v) for v in spread))
        if len(members) == 2:
            width, slope = _hysteresis(members, machine)
            measured = replace(measured, hysteresis=_hysteresis(members, read)[0])
            of_machine = replace(of_machine, hysteresis=width)
            u = replace(u, hysteresis=float(np.linalg.norm(slope @ root[own])))
        found.append(
            CircularTest(
                plane=_plane(first),
                runs=tuple(p.run for p in members),
                sense=_sense(first) if len(members) == 1 else "both",
                radius=first.radius,
                arc=min(p.arc for p in members),
                measured=measured,
                machine=of_machine,
                u=u,
            )
        )
    return found


def _paths(fit: Fit, instrument: DoubleBallBar, plan: Plan) -> Iterator[_Path]:
    run = np.asarray(plan.groups["run"])
    points = fit.model.chain.tool_point(np.asarray(plan.position))
    centres, length = (np.asarray(v) for v in instrument.rows(plan))
    feed = plan.values("feed_mm_min") if plan.has("feed_mm_min") else np.zeros(plan.rows)
    for k in np.unique(run):
        rows = np.flatnonzero(run == k)
        found = circle_through(points[rows])
        if found is None or len(rows) < 8:
            continue
        circle, angle = found
        radius = float(np.linalg.norm(circle.cosine))
        if (
            np.linalg.norm(circle.centre - centres[rows[0]]) > 0.01 * radius
            or abs(radius - length[rows[0]]) > 0.01 * radius
        ):
            continue  # a cone reads along its side, not along the radius
        normal = np.cross(circle.cosine, circle.sine) / radius**2
        arm = (points[rows] - circle.centre) / np.linalg.norm(
            points[rows] - circle.centre, axis=1, keepdims=True
        )
        setup = int(np.asarray(plan.groups["setup"])[rows[0]]) if instrument.grouped else None
        yield _Path(
            run=int(k),
            rows=rows,
            centre=circle.centre,
            normal=normal,
            radius=float(length[rows[0]]),
            arm=arm,
            full=is_full_circle(angle),
            arc=float(np.ptp(angle)),
            alike=(setup, float(feed[rows[0]])),
        )


def _pairs(paths: Sequence[_Path]) -> Iterator[tuple[_Path, _Path]]:
    """Runs along one circle in opposite senses, each in one pair at most, in the order of runs."""
    left = list(paths)
    while left:
        one = left.pop(0)
        for other in left:
            if (
                one.alike == other.alike
                and one.full == other.full
                and np.linalg.norm(one.centre - other.centre) < _SAME_M
                and abs(one.radius - other.radius) < _SAME_M
                and one.normal @ other.normal < -0.999
            ):
                left.remove(other)
                yield one, other
                break


def _travelled(
    members: Sequence[_Path], values: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "k 2"]:
    """The actual path of one run, or both, in its plane, from the radial deviations of all rows
    (n,), m.
    """
    radius, basis = members[0].radius, _basis(members[0])
    return np.concatenate([(radius + values[p.rows])[:, None] * (p.arm @ basis) for p in members])


def _hysteresis(
    members: Sequence[_Path], values: Float[np.ndarray, " n"]
) -> tuple[float, Float[np.ndarray, " k"]]:
    """The circular hysteresis of a pair, m, and its derivative by the radial deviations of both
    paths one after the other, from those of all rows (n,), m.
    """
    basis = _basis(members[0])
    angles = [np.arctan2(*(p.arm @ basis).T[::-1]) for p in members]
    deviations = [values[p.rows] for p in members]
    return circular_hysteresis(
        (angles[0], angles[1]), (deviations[0], deviations[1]), full=members[0].full
    )


def _basis(path: _Path) -> Float[np.ndarray, "3 2"]:
    """Two directions in the plane of a path: to its first position, and along the path there."""
    return np.column_stack([path.arm[0], np.cross(path.normal, path.arm[0])])


def _of_machine(
    fit: Fit, rows: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n d"]]:
    """Radial deviations of the machine in these rows (n,), and a root (n, d) of the covariance."""
    bar = np.array([key.partition(" ")[0] in _OF_BAR for key, _ in fit.entries])
    whitener = np.asarray(fit.whitener)[rows, 0, 0]
    jacobian = np.asarray(fit.jacobian).reshape(*fit.residual.shape, -1)[rows, 0]
    weight = np.where(whitener > 0.0, whitener, 1.0)
    jacobian = jacobian / weight[:, None]
    bar = np.concatenate([bar, np.zeros(jacobian.shape[1] - len(bar), bool)])
    predicted = (np.asarray(fit.measurement.readings) - fit.residual)[rows, 0]
    mean = predicted - jacobian[:, bar] @ fit.theta[bar]
    covariance = fit.covariance[np.ix_(~bar, ~bar)]
    values, vectors = eigh(0.5 * (covariance + covariance.T))
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    return mean, jacobian[:, ~bar] @ root


def _plane(path: _Path) -> str:
    largest = int(np.argmax(np.abs(path.normal)))
    return _NORMALS[largest] if abs(path.normal[largest]) > 1.0 - 1e-6 else "tilted"


def _sense(path: _Path) -> str:
    largest = int(np.argmax(np.abs(path.normal)))
    return "counter-clockwise" if path.normal[largest] > 0.0 else "clockwise"
