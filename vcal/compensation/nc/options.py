"""What has to be known beside an NC program to correct it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from ...errors import StudyError
from .codes import EXTENDED_OFFSETS, OFFSETS


class Displacement(Protocol):
    """Displacement of the tool point of the machine, actual minus nominal.

    Called with the commanded positions of three linear axes (n, 3) in m and the directions from
    which they were approached (n, 3): +1, -1, or 0 where no move of the axis is known. Returns
    (n, 3) in m, along X, Y, Z. Where `NcOptions.tool_lengths_mm` is given, a third argument
    (n,) holds the length of the active tool in m. The number of rows n is one of few.
    """

    def __call__(
        self, positions: np.ndarray, directions: np.ndarray, *args: np.ndarray
    ) -> ArrayLike: ...


@dataclass(frozen=True)
class NcOptions:
    """Options of the correction of an NC program. Raises `StudyError` for values out of range."""

    tolerance_um: float = 1.0
    """Largest deviation of the corrected path between the ends of its blocks; rounding to the
    output resolution comes in addition."""
    resolution_mm: float = 0.0001
    """Of numbers that are written, in a program in millimetres."""
    resolution_inch: float = 0.00001
    work_offsets_mm: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Axis positions of the zero of `G54` to `G59.3`, `"G54.1 P3"`. Without any, program
    coordinates are axis positions."""
    tool_lengths_mm: Mapping[int, float] | None = None
    """Length of each H number. Without it, the tool of the calibration is assumed."""
    units: str = "mm"
    """Of a program that does not say: `mm` or `inch`."""
    skip_deleted: bool = False
    """Whether the control skips blocks that begin with a slash."""
    shortest_period_mm: float = 5.0
    """Shortest period of the displacement along a path. Samples lie four to a period, and the bound
    of the deviation between them holds for this period and longer ones."""
    travels_mm: Sequence[Sequence[float]] = ()
    """Lowest and highest calibrated position of X, Y and Z. Moves that end beyond are reported."""
    ignored_codes: Sequence[str] = ()
    """Further G codes that move nothing and do not change how coordinates are read, as `"G187"`."""

    def __post_init__(self) -> None:
        for name in ("tolerance_um", "resolution_mm", "resolution_inch", "shortest_period_mm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                _refuse(name, value, "a number above zero", "give it in the unit of its name")
        coarsest = 1e3 * max(self.resolution_mm, 25.4 * self.resolution_inch)
        if self.tolerance_um < coarsest:
            least = f"at least the output resolution, {coarsest:g} um"
            _refuse("tolerance_um", self.tolerance_um, least, "raise it")
        if self.units not in ("mm", "inch"):
            _refuse("units", repr(self.units), "mm or inch", "give the unit of the program")
        for name, offset in self.work_offsets_mm.items():
            _check_offset(name, offset)
        for number, length in (self.tool_lengths_mm or {}).items():
            if not math.isfinite(length):
                _refuse(f"tool length H{number}", length, "a finite number in mm", "correct it")
        for code in self.ignored_codes:
            if tenths_of(code) is None:
                _refuse("ignored_codes", repr(code), "a G code such as G187", "correct it")

    @property
    def ignored(self) -> frozenset[int]:
        """`ignored_codes` in tenths."""
        return frozenset(t for t in map(tenths_of, self.ignored_codes) if t is not None)


def tenths_of(code: str) -> int | None:
    """``"G38.2"`` is 382; None for a text that is no G code."""
    try:
        return round(10 * float(code[1:])) if code[:1] in ("G", "g") else None
    except ValueError:
        return None


def _check_offset(name: str, offset: Sequence[float]) -> None:
    system, _, number = name.partition(" P")
    extended = system in EXTENDED_OFFSETS.values()
    if (number.isdigit() if extended else system in OFFSETS.values() and not number) is False:
        known = "G54 to G59, G59.1 to G59.3, or such as 'G54.1 P3'"
        _refuse("work offset", repr(name), known, "correct the name")
    if len(offset) != 3 or not all(math.isfinite(value) for value in offset):
        _refuse(f"work offset {name}", list(offset), "three numbers X, Y, Z in mm", "correct it")


def _refuse(name: str, found: object, expected: str, do: str) -> None:
    raise StudyError(f"option {name}: found {found}, expected {expected}; {do}")
