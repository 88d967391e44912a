"""Thirteen errors from ten straightnesses, beam by beam, and their Table 4.

The publication refers to an earlier one for its measurement model. What is here follows from the
beams that run along a plane: with u_k the reading of beam k in direction u,

    straightness  the reading less its line, on the first beam along the axis
    EXX, EYY      (mean X(3) - mean X(1)) / 2, (mean Y(2) - mean Y(4)) / 2: half the change of the
                  travel, that is, the error of either end about the middle
    EAX, EBY      (Z(2) - Z(4)) / dy, (Z(3) - Z(1)) / dx, less their mean
    squareness    sum of the slopes of the two beams that span the plane

All of it is linear in the readings, so that a matrix is the whole evaluation. With the uncertainty
of a reading from the budget it gives the publication's Table 4. What is not printed (edges, legs,
which beam gives a straightness, lengths by which angles are multiplied) was chosen after the table
had been seen: agreement is an inference, not a confirmation. `variants` shows other choices.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...instruments.laser_frame import Segment
from .setting import (
    POSITIONING,
    ROLLS,
    SQUARENESSES,
    STRAIGHTNESSES,
    THIRTEEN,
    TRAVEL,
    Layout,
    reading_u,
)

_AXES = "XYZ"
PLANES = {"EA0Z": "YZ", "EB0Z": "XZ", "EC0Y": "XY"}
SIGNS = {"EA0Z": -1.0, "EB0Z": 1.0, "EC0Y": -1.0}
"""The plane of a squareness, and the sign with which the slopes in it count: EB0Z turns Z towards
+X, the others turn the second axis of their plane away from the first.
"""


@dataclass(frozen=True)
class Lever:
    """Lengths by which the publication seems to give angles as micrometres."""

    roll: float
    """m."""
    square: float

    @classmethod
    def seen(cls) -> "Lever":
        """The space diagonal of the travel for rolls, its longest side for squarenesses: chosen
        after the printed table was seen.
        """
        sides = [high - low for low, high in TRAVEL.values()]
        return cls(float(np.linalg.norm(sides)), max(sides))

    def of(self, name: str) -> float:
        """Metre per unit of an error: one for translations."""
        if name in SQUARENESSES:
            return self.square
        return self.roll if name in ROLLS else 1.0


@dataclass(frozen=True)
class Recipe:
    """An evaluation that is linear in the readings."""

    names: tuple[str, ...]
    """Error of every output."""
    x: Float[np.ndarray, " q"]
    """Position along its axis that the output holds for, m; NaN where it has none."""
    matrix: Float[np.ndarray, "q nm"]
    """From readings (point by point, both components) to m or rad."""

    def u(self, reading_u: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " q"]:
        """Standard uncertainty of every output from independent readings, m or rad."""
        return np.sqrt(self.matrix**2 @ np.ravel(reading_u) ** 2)


def largest(
    names: Sequence[str], values: Float[np.ndarray, " q"], lever: Lever
) -> dict[str, float]:
    """The largest value of every error along its axis, in um, angles times their lever."""
    own = np.asarray(names)
    return {n: float(values[own == n].max()) * lever.of(n) / 1e-6 for n in THIRTEEN}


def recipe(
    segments: Sequence[Segment],
    *,
    straight: Mapping[str, Sequence[int]] | None = None,
    slope: Mapping[str, Sequence[int]] | None = None,
) -> Recipe:
    """The evaluation for a path along one plane and up, segments 1 to 5.

    `straight` and `slope` name the beams that give the straightness and the slope along an axis,
    of several the mean; without them the first beam along it. Raises `ValueError` for a path whose
    beams 1 to 4 do not lie in one plane.
    """
    if len({round(z, 9) for one in segments[:4] for z in (one.start[2], one.end[2])}) != 1:
        raise ValueError(
            "segments: found beams 1 to 4 at different Z, expected them in one plane, as parallel "
            "beams are subtracted from each other; identify the errors by least squares instead"
        )
    first: dict[str, Sequence[int]] = {}
    for one in segments:
        first.setdefault(one.axis, (one.number,))
    beams = _Beams(segments)
    rows: list[tuple[str, np.ndarray, np.ndarray]] = []
    straight, slope = straight or first, slope or first
    for name in STRAIGHTNESSES:
        own = straight[name[2]]
        parts = [beams.on(own[0], n) @ beams.straight(n, name[1]) for n in own]
        rows.append((name, beams.x[own[0]], np.mean(parts, axis=0)))
    for name, (far, near) in zip(POSITIONING, ((3, 1), (2, 4)), strict=True):
        change = beams.mean(far, name[1]) - beams.mean(near, name[1])
        rows.append((name, np.full(1, np.nan), 0.5 * change))
    for name, (far, near), across in zip(ROLLS, ((2, 4), (3, 1)), "YX", strict=True):
        distance = beams.places[far, across] - beams.places[near, across]
        change = beams.readings(far, "Z") - beams.on(far, near) @ beams.readings(near, "Z")
        # The roll about Y lowers Z towards +X.
        angle = (change - change.mean(0)) / distance * (1.0 if name == "EAX" else -1.0)
        rows.append((name, beams.x[far], angle))
    for name, (a, b) in PLANES.items():
        both = [np.mean([beams.slope(n, v) for n in slope[w]], axis=0) for w, v in (a + b, b + a)]
        rows.append((name, np.full(1, np.nan), SIGNS[name] * (both[0] + both[1])))
    return Recipe(
        tuple(name for name, x, _ in rows for _ in x),
        np.concatenate([x for _, x, _ in rows]),
        np.concatenate([m for *_, m in rows]),
    )


class _Beams:
    """Matrices that act on all readings, of one beam each."""

    def __init__(self, segments: Sequence[Segment]):
        self.x: dict[int, np.ndarray] = {}
        self.places: dict[tuple[int, str], float] = {}
        self._where: dict[tuple[int, str], np.ndarray] = {}
        start = 0
        for one in segments:
            n = one.points
            self.x[one.number] = one.positions[:, _AXES.index(one.axis)]
            for axis, place in zip(_AXES, one.start, strict=True):
                self.places[one.number, axis] = place
            for j, across in enumerate(one.across):
                self._where[one.number, _AXES[across]] = 2 * (start + np.arange(n)) + j
            start += n
        self._size = 2 * start

    def readings(self, beam: int, component: str) -> np.ndarray:
        """The readings of one beam in one direction."""
        return np.eye(self._size)[self._where[beam, component]]

    def mean(self, beam: int, component: str) -> np.ndarray:
        return self.readings(beam, component).mean(0, keepdims=True)

    def slope(self, beam: int, component: str) -> np.ndarray:
        return line(self.x[beam])[1:] @ self.readings(beam, component)

    def straight(self, beam: int, component: str) -> np.ndarray:
        """Readings less their least-squares line."""
        return less_line(self.x[beam], self.readings(beam, component))

    def on(self, beam: int, other: int) -> np.ndarray:
        """From places on a parallel beam to those on this one, linear between them."""
        x, y = self.x[other], self.x[beam]
        order = np.argsort(x)
        unit = np.eye(len(x))[:, order]
        return np.stack([np.interp(y, x[order], row) for row in unit], 1)


def line(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
    """From values to offset and slope of their least-squares line."""
    return np.linalg.pinv(np.stack([np.ones_like(x), x], 1))


def less_line(x: Float[np.ndarray, " n"], values: Float[np.ndarray, "n k"]) -> np.ndarray:
    """Values less their least-squares line."""
    return values - np.stack([np.ones_like(x), x], 1) @ (line(x) @ values)


PRINTED: Mapping[str, float] = {
    "EYX": 1.3,
    "EZX": 1.6,
    "EXY": 1.5,
    "EZY": 3.9,
    "EXZ": 1.5,
    "EYZ": 3.4,
    "EXX": 0.4,
    "EYY": 0.4,
    "EAX": 8.2,
    "EBY": 6.4,
    "EA0Z": 4.2,
    "EB0Z": 4.9,
    "EC0Y": 4.4,
}
"""U (k = 2), um; angles as the largest linear uncertainty that results in the volume."""
_SWAP = {"EXZ": "EZY", "EZY": "EXZ"}


@dataclass(frozen=True)
class Variant:
    """The table under one set of choices."""

    name: str
    U: dict[str, float]
    """um."""

    @property
    def exchanged(self) -> float:
        """`distance` with the printed labels of EXZ and EZY exchanged."""
        return distance(self.U, exchanged())

    @property
    def as_printed(self) -> float:
        """`distance` with the labels as they are."""
        return distance(self.U, PRINTED)


def exchanged() -> dict[str, float]:
    """The printed table with EXZ and EZY exchanged: segment 5, along Z, is the noisiest, and EXZ
    is read there.
    """
    return {name: PRINTED[_SWAP.get(name, name)] for name in THIRTEEN}


def distance(found: Mapping[str, float], printed: Mapping[str, float]) -> float:
    """Root mean square of the natural logarithm of the ratio, over the thirteen entries."""
    logs = [math.log(found[name] / printed[name]) for name in THIRTEEN]
    return math.sqrt(sum(v * v for v in logs) / len(logs))


def variants() -> tuple[Variant, ...]:
    """Noise alone, in closed form; the choice that was made first."""
    layout = Layout.named("planar")
    sides = {axis: high - low for axis, (low, high) in TRAVEL.items()}
    both = {"X": (2, 4), "Y": (3, 1), "Z": (5,)}
    eleven = {"X": (2,), "Y": (3,), "Z": (5,)}

    def one(name: str, *, straight=None, slope=None, **noise) -> Variant:
        evaluation = recipe(layout.segments, straight=straight, slope=slope)
        u = evaluation.u(np.asarray(reading_u(layout.segments, layout.shares, **noise)))
        return Variant(name, largest(evaluation.names, 2.0 * u, Lever.seen()))

    return (
        one("first beam along an axis, noise × 2, legs of the frame"),
        one("beams of eleven points: 3 instead of 1", straight=eleven, slope=eleven),
        one("slopes from both beams", slope=both),
        one("straightness and slopes from both beams", straight=both, slope=both),
        one("noise × √2 for a difference", factor=math.sqrt(2.0)),
        one("noise × 1", factor=1.0),
        one("legs as long as the travel", legs=sides),
    )
