"""Deviations as acceptance tests define them: straight motions of the tool point, squareness."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..identification.fit import Fit
from ..identification.model_averaging import Alternatives, model_average
from ..machine.chain import Chain
from .compensated import compensated_in_blocks
from .error_motions import NODES, Spread, functions_on, line_of
from .straight_lines import StraightLines

_SAME = 1e-12
"""Deviation, m or rad, below which it counts as zero."""


@dataclass(frozen=True)
class GeometricTest:
    """One deviation with its standard uncertainty."""

    name: str
    """Name as in ISO 230-1, such as ``"EYX"`` or ``"EC(0X)Y"``."""
    what: str
    """Kind of deviation, such as ``"straightness"``."""
    axis: str
    value: float
    """Deviation, in `unit`."""
    u: float
    """Standard uncertainty, in `unit`."""
    unit: str
    information: float
    """Share of information from the data: 1 - variance after / variance before the measurement."""


@dataclass(frozen=True)
class _Functional:
    """A deviation as a linear functional of the sampled errors: weights (size,)."""

    name: str
    what: str
    axis: str
    unit: str
    weights: np.ndarray


def geometric_tests(
    fit: Fit, *, alternatives: Sequence[Alternatives] = (), size: int = 0
) -> list[GeometricTest]:
    """Deviations that a geometric test would find on the identified machine (ISO 230-1:2012, 3.4,
    3.6).

    One linear axis at a time moves over its travel (or the measured range, where no travel is
    declared), with the other linear axes in the middle of their travel and the rotary axes at zero.
    The deviations refer to the path of the tool point in the frame of the workpiece:

    - positioning: the range of EXX, and the slope of its least-squares line;
    - straightness: the range of the deviations from the least-squares line;
    - squareness: the angle between two of these lines minus its nominal value, positive where the
      later axis is rotated in the positive sense from the earlier one, as for EC0Y;
    - angular errors: the ranges of the error motions;
    - a rotary axis: position and direction of its axis average line, that is the location error
      plus the mean of the corresponding error motion.

    A rigid motion of the frame does not change these deviations, nor does the allocation of slopes
    to parameters. Effects of direction, temperature and time are not included. The uncertainty of a
    range is that of the difference between its two extreme positions. `alternatives` contribute as
    in `vcal.geometry.error_motions.error_motion_tables`. `size` is a number of rows that is
    compiled already (`compensated_in_blocks`). The list is empty for an arm, and does not contain
    deviations about which the model says nothing.
    """
    chain = fit.model.chain
    if chain.arm:
        return []
    nodes = [line_of(fit, axis, NODES) for axis in chain.axes]
    lines = StraightLines.of(chain, np.array([(x.min(), x.max()) for x in nodes]), NODES)
    motions = {name: len(mean) for name, (_, mean) in functions_on(fit, nodes).items()}

    def sampled(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        return _sampled(fit, lines, nodes, motions, size)

    def average(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return model_average(
            alternatives, lambda other: weights @ sampled(other)[0], np.zeros(len(weights))
        )

    return tests_of(lines, chain, motions, *sampled(fit), Spread.of_fit(fit), average)


def tests_of(
    lines: StraightLines,
    chain: Chain,
    motions: Mapping[str, int],
    values: np.ndarray,
    jacobian: np.ndarray,
    spread: Spread,
    average: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> list[GeometricTest]:
    """The deviations of `geometric_tests` from sampled errors: `values` (size,), m or rad, those of
    the tool point on the `lines`, then the error `motions` with their number of nodes, and their
    derivative (size, k).

    `average` gives the change by averaging over models, and the between-model variance, of
    functionals with these weights (q, size).
    """
    turning = [joint.name for joint in chain.joints if joint.turns]
    deviations = _deviations(lines, turning, motions, values)
    if not deviations:
        return []
    weights = 1e6 * np.array([one.weights for one in deviations])
    u, _, information = spread.of(weights @ jacobian)
    found = weights @ values
    # A deviation that does not depend on the model is unknown, not zero.
    modelled = (u > 0.0) | (np.abs(found) > 1e6 * _SAME)
    if not modelled.any():
        return []
    moved, between = average(weights)
    return [
        GeometricTest(
            name=one.name,
            what=one.what,
            axis=one.axis,
            value=float(found[k] + moved[k]),
            u=math.hypot(u[k], math.sqrt(between[k])),
            unit=one.unit,
            information=float(information[k]),
        )
        for k, one in enumerate(deviations)
        if modelled[k]
    ]


def _sampled(
    fit: Fit,
    lines: StraightLines,
    nodes: Sequence[np.ndarray],
    motions: Mapping[str, int],
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The sampled errors: those of the tool point on the lines, then the error motions with their
    number of nodes. Values (size,), m or rad, and their derivative (size, k).
    """
    at = lines.position
    points, jacobian = compensated_in_blocks(fit, at, size or len(at))
    values = [(points - lines.nominal.reshape(-1, 3)).ravel()]
    rows = [jacobian.reshape(-1, jacobian.shape[2])]
    functions = functions_on(fit, nodes)
    for name, count in motions.items():
        block, mean = functions.get(name, (np.zeros((count, len(fit.theta))), np.zeros(count)))
        values.append(mean + block @ fit.theta)
        rows.append(block)
    return np.concatenate(values), np.concatenate(rows)


def _deviations(
    lines: StraightLines, turning: Sequence[str], motions: Mapping[str, int], values: np.ndarray
) -> list[_Functional]:
    """The deviations as functionals of the `_sampled` errors: of linear axes, between them, and of
    rotary axes.
    """
    starts = dict(
        zip(motions, lines.nominal.size + np.cumsum([0, *motions.values()]), strict=False)
    )
    moving = [*_paths(lines, values), *_angular(lines, motions, starts, values)]
    return [
        *sorted(moving, key=lambda one: lines.axes.index(one.axis)),
        *(
            _Functional(name, f"squareness of {b} to {a}", b, "urad", _filled(weights, len(values)))
            for name, a, b, weights in lines.squareness
        ),
        *_average_lines(turning, motions, starts, values),
    ]


def _paths(lines: StraightLines, values: np.ndarray) -> list[_Functional]:
    """Positioning and straightness, from the errors on the lines, the first ones in `values`."""
    errors, found = values[: lines.nominal.size].reshape(lines.nominal.shape), []
    for k, axis in enumerate(lines.axes):
        for component, direction in lines.along.items():
            error, name = errors[k] @ direction, f"E{component}{axis}"
            if component == axis:
                parts = [
                    ("positioning, range", "um", _ends(error)),
                    ("positioning, slope", "um/m", lines.slope(axis)),
                ]
            else:
                deviates = lines.deviation(axis)
                parts = [("straightness", "um", deviates.T @ _ends(deviates @ error))]
            for what, unit, per_node in parts:
                weights = _filled(lines.on(axis, per_node, direction), len(values))
                found.append(_Functional(name, what, axis, unit, weights))
    return found


def _angular(
    lines: StraightLines, motions: Mapping[str, int], starts: Mapping[str, int], values: np.ndarray
) -> list[_Functional]:
    """Ranges of the error rotations of linear axes; `motions` are their numbers of nodes, `starts`
    their positions in `values`.
    """
    found = []
    for name in sorted(motions):
        if name[1] in "ABC" and name[2:] in lines.axes and motions[name] > 1:
            at = starts[name]
            ends = _filled(_ends(values[at : at + motions[name]]), len(values), at)
            found.append(_Functional(name, "angular error, range", name[2:], "urad", ends))
    return found


def _average_lines(
    axes: Sequence[str], motions: Mapping[str, int], starts: Mapping[str, int], values: np.ndarray
) -> list[_Functional]:
    """Positions and directions of the axis average lines of rotary axes with error motions."""
    found = []
    for axis in axes:
        for component in "XYZABC":
            motion, location = f"E{component}{axis}", f"E{component}0{axis}"
            if motion not in motions or location not in motions:
                continue
            count = motions[motion]
            weights = _filled(np.full(count, 1.0 / count), len(values), starts[motion])
            weights[starts[location]] = 1.0
            what, unit = ("position", "um") if component in "XYZ" else ("direction", "urad")
            what = f"{what} of the axis average line"
            found.append(_Functional(location, what, axis, unit, weights))
    return found


def _ends(error: np.ndarray) -> np.ndarray:
    """Weights (n,) of the difference between the largest and the smallest of some values."""
    weights = np.zeros(len(error))
    weights[error.argmax()] += 1.0
    weights[error.argmin()] -= 1.0
    return weights


def _filled(part: np.ndarray, size: int, start: int = 0) -> np.ndarray:
    """Weights (size,) that are zero except for a `part` from `start` on."""
    weights = np.zeros(size)
    weights[start : start + part.size] = part.ravel()
    return weights
