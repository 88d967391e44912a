"""The geometry as acceptance tests state it: straight motions of the tool point, squareness."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..fit import Fit
from ..loop.doubt import Doubt, of_doubts
from ..loop.heldout import compensated_in_blocks
from .compensation import NODES, Spread, functions_on, line_of

_SQUARENESS = {("X", "Y"): ("C", 1.0), ("X", "Z"): ("B", -1.0), ("Y", "Z"): ("A", 1.0)}
"""Between which axes, about which, and the sign of first x second along that."""
_SQUARE = 1e-6
"""Cosine of an angle that is meant to be a right one, at most."""
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
    """A linear functional of what was sampled: weights (size,), in units of `si`."""

    name: str
    what: str
    axis: str
    unit: str
    weights: np.ndarray
    si: float = 1e-6


def geometric_tests(
    fit: Fit, *, doubts: Sequence[Doubt] = (), size: int = 0
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
    that of the difference between the two positions that make a range; of the effects in `doubts`
    as in `error_motion_tables`. `size` is a number of rows that is compiled already. Empty for an
    arm; without what the model says nothing of.
    """
    chain = fit.model.chain
    if chain.arm:
        return []
    lines = {axis: line_of(fit, axis, NODES) for axis in chain.axes}
    straight = [j.name for j in chain.joints if not j.turns and np.ptp(lines[j.name]) > 0.0]
    stands = [_stands(lines[j.name], j.turns) for j in chain.joints]
    position = np.tile(stands, (len(straight), NODES, 1))
    for k, axis in enumerate(straight):
        position[k, :, chain.axes.index(axis)] = lines[axis]
    position = position.reshape(-1, len(stands))
    nominal = chain.tool_point(position)
    motions = {name: len(mean) for name, (_, mean) in functions_on(fit, [*lines.values()]).items()}

    def sampled(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the tool point, then every error motion: values (size,), m or rad, and their
        derivative (size, k).
        """
        points, jacobian = compensated_in_blocks(fit, position, size or len(position))
        values, rows = [(points - nominal).ravel()], [jacobian.reshape(-1, jacobian.shape[2])]
        functions = functions_on(fit, [*lines.values()])
        for name, count in motions.items():
            block, mean = functions.get(name, (np.zeros((count, len(fit.theta))), np.zeros(count)))
            values.append(mean + block @ fit.theta)
            rows.append(block)
        return np.concatenate(values), np.concatenate(rows)

    values, jacobian = sampled(fit)
    moving = [
        *_paths(straight, lines, nominal.reshape(len(straight), NODES, 3), values),
        *_angular(straight, motions, nominal.size, values),
    ]
    asked = [
        *sorted(moving, key=lambda one: straight.index(one.axis)),
        *_squareness(straight, lines, nominal.reshape(len(straight), NODES, 3), values),
        *_average_lines([j.name for j in chain.joints if j.turns], motions, nominal.size, values),
    ]
    if not asked:
        return []
    weights = np.array([one.weights for one in asked])
    u, _, information = Spread.of_fit(fit).of(weights @ jacobian)
    found = weights @ values
    # What the model says nothing of is no deviation of zero.
    told = (u > 0.0) | (np.abs(found) > _SAME)
    if not told.any():
        return []
    doubted = of_doubts(doubts, lambda other: weights @ sampled(other)[0], np.zeros(len(asked)))
    return [
        GeometricTest(
            name=one.name,
            what=one.what,
            axis=one.axis,
            value=float(found[k] / one.si),
            u=math.hypot(u[k], math.sqrt(doubted[k])) / one.si,
            unit=one.unit,
            information=float(information[k]),
        )
        for k, one in enumerate(asked)
        if told[k]
    ]


def _stands(line: np.ndarray, turns: bool) -> float:
    low, high = line.min(), line.max()
    return 0.0 if turns and low <= 0.0 <= high else 0.5 * (low + high)


def _paths(
    axes: Sequence[str],
    lines: dict[str, np.ndarray],
    nominal: Float[np.ndarray, "a n 3"],
    values: np.ndarray,
) -> list[_Asked]:
    """Positioning and straightness, of errors that come first in `values`."""
    errors, found = values[: nominal.size].reshape(nominal.shape), []
    along = _along(axes, nominal)

    def asked(k: int, component: str, what: str, per_node: np.ndarray, unit: str = "um") -> _Asked:
        weights = np.zeros(nominal.shape)
        weights[k] = per_node[:, None] * along[component]
        name, weights = f"E{component}{axes[k]}", _filled(weights.ravel(), len(values))
        return _Asked(name, what, axes[k], unit, weights)

    for k, axis in enumerate(axes):
        slope = _slope(lines[axis])
        for component, direction in along.items():
            error = errors[k] @ direction
            if component == axis:
                found.append(asked(k, component, "positioning, range", _ends(error)))
                found.append(asked(k, component, "positioning, slope", slope, "um/m"))
                continue
            x = lines[axis] - lines[axis].mean()
            deviates = np.eye(len(x)) - 1.0 / len(x) - np.outer(x, slope)
            ends = deviates.T @ _ends(deviates @ error)
            found.append(asked(k, component, "straightness", ends))
    return found


def _squareness(
    axes: Sequence[str],
    lines: dict[str, np.ndarray],
    nominal: Float[np.ndarray, "a n 3"],
    values: np.ndarray,
) -> list[_Asked]:
    """Between axes that are meant to be square, of errors that come first in `values`."""
    found, along = [], _along(axes, nominal)
    for first, second in itertools.combinations(sorted(axes), 2):
        about, sign = _SQUARENESS[first, second]
        if abs(along[first] @ along[second]) > _SQUARE:
            continue
        turn = sign * np.cross(along[first], along[second])
        weights = np.zeros(nominal.shape)
        for axis, way in ((second, 1.0), (first, -1.0)):
            across = way * np.cross(turn, along[axis])
            weights[axes.index(axis)] = _slope(lines[axis])[:, None] * across
        name, weights = f"E{about}(0{first}){second}", _filled(weights.ravel(), len(values))
        found.append(_Asked(name, f"squareness of {second} to {first}", second, "urad", weights))
    return found


def _along(axes: Sequence[str], nominal: Float[np.ndarray, "a n 3"]) -> dict[str, np.ndarray]:
    """Nominal directions of axes, of unit length, as seen from the workpiece."""
    ways = nominal[:, -1] - nominal[:, 0]
    return dict(zip(axes, ways / np.linalg.norm(ways, axis=1, keepdims=True), strict=True))


def _slope(line: np.ndarray) -> np.ndarray:
    """Weights (n,) of the slope of a least-squares line."""
    x = line - line.mean()
    return x / (x @ x)


def _angular(
    axes: Sequence[str], motions: dict[str, int], start: int, values: np.ndarray
) -> list[_Asked]:
    """Ranges of the error rotations of linear axes; error motions come from `start` in `values`."""
    found, at = [], start
    for name, count in motions.items():
        if name[1] in "ABC" and name[2:] in axes and count > 1:
            ends = _filled(_ends(values[at : at + count]), len(values), at)
            found.append(_Asked(name, "angular error, range", name[2:], "urad", ends))
        at += count
    return sorted(found, key=lambda one: one.name)


def _average_lines(
    axes: Sequence[str], motions: dict[str, int], start: int, values: np.ndarray
) -> list[_Asked]:
    """Where axes of rotation are and how they point, of those whose error motions have a mean."""
    starts = dict(zip(motions, start + np.cumsum([0, *motions.values()]), strict=False))
    found = []
    for axis in axes:
        for component in "XYZABC":
            motion, location = f"E{component}{axis}", f"E{component}0{axis}"
            if motion not in motions or location not in motions:
                continue
            count = motions[motion]
            weights = _filled(np.full(count, 1.0 / count), len(values), starts[motion])
            weights[starts[location]] = 1.0
            translation = component in "XYZ"
            what = f"{'position' if translation else 'direction'} of the axis average line"
            unit = "um" if translation else "urad"
            found.append(_Asked(location, what, axis, unit, weights))
    return found


def _ends(error: np.ndarray) -> np.ndarray:
    """Weights (n,) of the largest less the smallest of some values."""
    weights = np.zeros(len(error))
    weights[error.argmax()] += 1.0
    weights[error.argmin()] -= 1.0
    return weights


def _filled(part: np.ndarray, size: int, start: int = 0) -> np.ndarray:
    weights = np.zeros(size)
    weights[start : start + len(part)] = part
    return weights
