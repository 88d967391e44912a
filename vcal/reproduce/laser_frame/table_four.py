"""The publication's Table 4 beside what its own budget gives.

The budget says how uncertain a reading is, the evaluation beam by beam what becomes of it. What the
publication does not print (edges, legs, which beam gives a straightness, lengths by which angles
are multiplied) was chosen after its table had been seen: agreement is an inference, not a
confirmation. `variants` shows what other choices give.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .recipe import Lever, largest, recipe
from .setting import THIRTEEN, TRAVEL, Layout, reading_u

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
