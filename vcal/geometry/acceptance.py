"""The geometry as acceptance tests state it: straight motions of the tool point, squareness."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..identification.fit import Fit
from ..identification.model_averaging import Alternatives, between_model_variance
from .compensated import compensated_in_blocks
from .error_motions import NODES, Spread, functions_on, line_of
from .straight_lines import StraightLines

_SAME = 1e-12
"""m or rad: less than this is no deviation."""


@dataclass(frozen=True)
class GeometricTest:
    """One deviation with its standard uncertainty."""

    name: str
    """As in ISO 230-1, such as ``"EYX"`` or ``"EC(0X)Y"``."""
    what: str
    """``"straightness"``, say."""
    axis: str
    value: float
    u: float
    unit: str
    information: float
    """1 - variance after / variance before the measurement."""


@dataclass(frozen=True)
class _Asked:
    """A linear functional of what was sampled: weights (size,), 1e-6 of SI."""

    name: str
    what: str
    axis: str
    unit: str
    weights: np.ndarray


def geometric_tests(
    fit: Fit, *, alternatives: Sequence[Alternatives] = (), size: int = 0
) -> list[GeometricTest]:
    """What a test of the geometry would find on the identified machine (ISO 230-1:2012, 3.4, 3.6).

    One linear axis after the other moves over its travel (or the range used, where none is
    declared) while the others stand in the middle of theirs and rotary axes at zero. Of the tool
    point's path in the frame of the workpiece: the positioning error as the range of EXX and the
    slope of its least-squares line; straightness as the range of what deviates from the
    least-squares line; squareness as the angle between two of these lines less its nominal value,
    positive where the later axis is turned in the positive sense from the earlier one, as EC0Y is.
    Angular errors as ranges of the error motions. Of a rotary axis the position and direction of
    its axis average line: the location error and the mean of the error motion that goes with it,
    where that has one.

    Neither a rigid motion of the frame changes them, nor how slopes are shared out between
    parameters. What depends on direction, temperature or time is not in them. The uncertainty is
    that of the difference between the two positions that make a range; `alternatives` count as in
    `error_motion_tables`. `size` is a number of rows that is compiled already. Empty for an
    arm; without what the model says nothing of.
    """
    chain = fit.model.chain
    if chain.arm:
        return []
    nodes = [line_of(fit, axis, NODES) for axis in chain.axes]
    lines = StraightLines.of(chain, np.array([(x.min(), x.max()) for x in nodes]), NODES)
    motions = {name: len(mean) for name, (_, mean) in functions_on(fit, nodes).items()}

    def sampled(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        return _sampled(fit, lines, nodes, motions, size)

    values, jacobian = sampled(fit)
    turning = [joint.name for joint in chain.joints if joint.turns]
    asked = _deviations(lines, turning, motions, values)
    if not asked:
        return []
    weights = 1e6 * np.array([one.weights for one in asked])
    u, _, information = Spread.of_fit(fit).of(weights @ jacobian)
    found = weights @ values
    # What the model says nothing of is no deviation of zero.
    told = (u > 0.0) | (np.abs(found) > 1e6 * _SAME)
    if not told.any():
        return []
    between = between_model_variance(
        alternatives, lambda other: weights @ sampled(other)[0], np.zeros(len(asked))
    )
    return [
        GeometricTest(
            name=one.name,
            what=one.what,
            axis=one.axis,
            value=float(found[k]),
            u=math.hypot(u[k], math.sqrt(between[k])),
            unit=one.unit,
            information=float(information[k]),
        )
        for k, one in enumerate(asked)
        if told[k]
    ]


def _sampled(
    fit: Fit,
    lines: StraightLines,
    nodes: Sequence[np.ndarray],
    motions: Mapping[str, int],
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the tool point, then every error motion of so many nodes: values (size,), m or rad,
    and their derivative (size, k).
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
) -> list[_Asked]:
    """All that is asked of what was `_sampled`: of linear axes, between them, of rotary ones."""
    starts = dict(
        zip(motions, lines.nominal.size + np.cumsum([0, *motions.values()]), strict=False)
    )
    moving = [*_paths(lines, values), *_angular(lines, motions, starts, values)]
    return [
        *sorted(moving, key=lambda one: lines.axes.index(one.axis)),
        *(
            _Asked(name, f"squareness of {b} to {a}", b, "urad", _filled(weights, len(values)))
            for name, a, b, weights in lines.squareness
        ),
        *_average_lines(turning, motions, starts, values),
    ]


def _paths(lines: StraightLines, values: np.ndarray) -> list[_Asked]:
    """Positioning and straightness, of errors that come first in `values`."""
    errors, found = values[: lines.nominal.size].reshape(lines.nominal.shape), []
    for k, axis in enumerate(lines.axes):
        for component, direction in lines.along.items():
            error, name = errors[k] @ direction, f"E{component}{axis}"
            if component == axis:
                told = [
                    ("positioning, range", "um", _ends(error)),
                    ("positioning, slope", "um/m", lines.slope(axis)),
                ]
            else:
                deviates = lines.deviation(axis)
                told = [("straightness", "um", deviates.T @ _ends(deviates @ error))]
            for what, unit, per_node in told:
                weights = _filled(lines.on(axis, per_node, direction), len(values))
                found.append(_Asked(name, what, axis, unit, weights))
    return found


def _angular(
    lines: StraightLines, motions: Mapping[str, int], starts: Mapping[str, int], values: np.ndarray
) -> list[_Asked]:
    """Ranges of the error rotations of linear axes, so many nodes each from their place on."""
    found = []
    for name in sorted(motions):
        if name[1] in "ABC" and name[2:] in lines.axes and motions[name] > 1:
            at = starts[name]
            ends = _filled(_ends(values[at : at + motions[name]]), len(values), at)
            found.append(_Asked(name, "angular error, range", name[2:], "urad", ends))
    return found


def _average_lines(
    axes: Sequence[str], motions: Mapping[str, int], starts: Mapping[str, int], values: np.ndarray
) -> list[_Asked]:
    """Where axes of rotation are and how they point, of those whose error motions have a mean."""
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
            found.append(_Asked(location, what, axis, unit, weights))
    return found


def _ends(error: np.ndarray) -> np.ndarray:
    """Weights (n,) of the largest less the smallest of some values."""
    weights = np.zeros(len(error))
    weights[error.argmax()] += 1.0
    weights[error.argmin()] -= 1.0
    return weights


def _filled(part: np.ndarray, size: int, start: int = 0) -> np.ndarray:
    """Weights (size,) of which a part, from `start` on, is not zero."""
    weights = np.zeros(size)
    weights[start : start + part.size] = part.ravel()
    return weights
