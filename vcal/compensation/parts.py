"""The parts of which the error of an identified machine is composed, each with its name.

A part is an error motion (``"EXX"``), a location error (``"EC0Y"``), or an effect with its place
(``"backlash Y"``). The displacement of the tool point is that of all parts together.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from ..effects.base import Effect
from ..effects.geometric import GeometricErrors, GeometricOrder
from ..effects.previous import PreviousGeometry

Kind = Literal["error motion", "location error", "effect"]
GEOMETRY = (GeometricErrors, PreviousGeometry, GeometricOrder)
"""Effects whose parts are error motions and location errors."""
_LOCATION = re.compile(r"E[ABCXYZ]0\w+")
NOT_IDENTIFIED = 0.01
"""Share of information below which the readings say nothing about a part, at no position: the part
is zero in every compensation, and is marked as not identified."""


@dataclass(frozen=True)
class Part:
    """One part of the error of a machine."""

    name: str
    """ISO 230-1 name of an error motion or a location error, or the effect with its place."""
    kind: Kind
    unit: str
    """``"um"`` or ``"urad"``; of an effect, the unit of its first amplitude."""
    needs: tuple[str, ...]
    """Covariates, axes or groups without which an effect cannot be evaluated."""
    information: float
    """Largest share of information from the data over the travel: 1 - variance / prior variance."""
    declared: bool
    """Whether it was known before the measurement, with a value other than zero."""

    @property
    def identified(self) -> bool:
        """Whether the readings (`NOT_IDENTIFIED`) or a declared value say anything about it."""
        return self.declared or self.information >= NOT_IDENTIFIED


def part_names(effects: Sequence[Effect]) -> list[str]:
    """The name of every effect as a part of its own; a number is added to a name that repeats."""
    names: list[str] = []
    for effect in effects:
        same = sum(name.partition(" #")[0] == effect.key for name in names)
        names.append(f"{effect.key} #{same + 1}" if same else effect.key)
    return names


def part_of(effect: Effect, own: str, port: str, amplitude: str) -> tuple[str, Kind]:
    """Name and kind of the part to which a port's response to an amplitude belongs; `own` is the
    name of the effect as a part.
    """
    if not isinstance(effect, GEOMETRY):
        return own, "effect"
    if _LOCATION.fullmatch(amplitude):
        return amplitude, "location error"
    return port, "error motion"


def in_order(names: Iterable[str], axes: Sequence[str]) -> list[str]:
    """Names with the error motions first, axis by axis, then location errors, then effects."""
    motions = [f"E{c}{axis}" for axis in axes for c in "XYZABC"]

    def place(name: str) -> tuple[int, int]:
        if name in motions:
            return 0, motions.index(name)
        return (1, 0) if _LOCATION.fullmatch(name) else (2, 0)

    return sorted(names, key=place)
