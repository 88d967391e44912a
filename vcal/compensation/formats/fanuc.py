"""FANUC: stored pitch error compensation, in both directions.

Every axis has compensation points at a constant interval (3624) around its reference position,
which has the number 3620. The value at a number is the change of the compensation in one section: a
whole number from -7 to +7, times the magnification (3623), in detection units. Number 3620 + k
belongs to the section from (k - 1) to k intervals from the reference. With bidirectional
compensation (3605#0), a second table from number 3626 on holds for the negative direction, and 3627
is the compensation at the reference in that direction. The compensation at the reference in the
positive direction is zero: a shift of the machine's zero stays.

The change of a section is output at one position in it. Not found in the public pages: which one,
for which the middle is taken, so that the value of the nearest point holds; the sign, for which a
positive value is taken to lengthen a travel in the positive direction; the unit of 3627, for which
the detection unit is taken; and the smallest interval. Straightness compensation and compensation
over a volume are not offered: their parameters were not found in public pages.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field as Key

from ..base import FORMATS, Covariates, Format, Options, Tables, at_inside
from ..headers import conditions_in_words, header
from ..machine import IdentifiedMachine
from ..refusals import AXES, refuse_axes, refuse_travel

_MOST, _LARGEST = 128, 7
_NUMBER = r"[+-]?\d+(\.\d*)?"


class FanucOptions(Options):
    """Options of the pitch error compensation."""

    interval_mm: float = Key(
        default=20.0, ge=0.001, description="distance of the points (parameter 3624), mm"
    )
    magnification: int = Key(default=1, ge=1, le=100, description="parameter 3623")
    unit_um: float = Key(default=1.0, gt=0.0, le=10.0, description="detection unit, um")
    reference_mm: str = Key(
        default="0,0,0",
        pattern=rf"^{_NUMBER},{_NUMBER},{_NUMBER}$",
        description="reference positions of X, Y and Z, mm",
    )

    def reference(self, axis: str) -> float:
        """Reference position of an axis, m."""
        return 1e-3 * float(self.reference_mm.split(",")[AXES.index(axis)])


@dataclass(frozen=True)
class Pitch:
    """The table of one axis; counts are of magnification times detection unit."""

    axis: str
    first: int
    """Number of the point at the lowest position."""
    below: int
    """Intervals from there to the reference."""
    nodes: Float[np.ndarray, " nodes"]
    """Positions, m."""
    up: Int[np.ndarray, " nodes"]
    """Compensation in the positive direction, counts; 0 at the reference."""
    down: Int[np.ndarray, " nodes"]
    """The same in the negative direction, also 0 at the reference."""
    back: int
    """Parameter 3627, detection units."""

    @property
    def origin(self) -> int:
        """Parameter 3620."""
        return self.first + self.below

    @property
    def values(self) -> dict[int, int]:
        """The stored values by their numbers, in both directions."""
        found = {}
        for start, counts in ((self.first, self.up), (self.second, self.down)):
            found |= {start + 1 + k: int(v) for k, v in enumerate(np.diff(counts))}
        return found

    @property
    def second(self) -> int:
        """Number of the lowest point in the table of the negative direction."""
        return self.first + len(self.nodes)

    def at(
        self, position: Float[np.ndarray, " n"], direction: Float[np.ndarray, " n"], count_m: float
    ) -> Float[np.ndarray, " n"]:
        """Compensation of the nearest point, m, without `back`."""
        h = self.nodes[1] - self.nodes[0]
        k = np.floor((position - self.nodes[0]) / h + 0.5).astype(int)
        k = np.clip(k, 0, len(self.nodes) - 1)
        return count_m * np.where(direction < 0.0, self.down[k], self.up[k])


@dataclass(frozen=True)
class FanucTables(Tables):
    """The stored values."""

    machine: IdentifiedMachine
    options: FanucOptions
    at: Mapping[str, float]
    pitch: tuple[Pitch, ...]

    def applied(
        self,
        position: Float[np.ndarray, "n axes"],
        directions: Float[np.ndarray, "n axes"],
        covariates: Covariates,
    ) -> Float[np.ndarray, "n axes"]:
        del covariates
        unit = 1e-6 * self.options.unit_um
        found = np.zeros_like(position)
        for i, one in enumerate(self.pitch):
            back = np.where(directions[:, i] < 0.0, one.back * unit, 0.0)
            count = unit * self.options.magnification
            found[:, i] = one.at(position[:, i], directions[:, i], count) + back
        return found

    @cached_property
    def files(self) -> Mapping[str, str]:
        about = [*header(self.machine, Fanuc), *conditions_in_words(self.machine, None, self.at)]
        return {
            "pitch.txt": "\n".join(["%", *self._parameters(), *self._values(), "%"]) + "\n",
            "readme.txt": "\n".join([*about, "", *self._readme()]) + "\n",
        }

    def _parameters(self) -> Iterator[str]:
        of = {
            3605: lambda one: "00000001",
            3620: lambda one: one.origin,
            3621: lambda one: one.first + 1,
            3622: lambda one: one.first + len(one.nodes) - 1,
            3623: lambda one: self.options.magnification,
            3624: lambda one: f"{self.options.interval_mm:.6g}",
            3626: lambda one: one.second + 1,
            3627: lambda one: one.back,
        }
        for number, value in of.items():
            words = "".join(f"A{n}P{value(one)}" for n, one in enumerate(self.pitch, 1))
            yield f"N{number:05d}{words};"

    def _values(self) -> Iterator[str]:
        for one in self.pitch:
            for number, value in one.values.items():
                yield f"N{10000 + number}P{value};"

    def _readme(self) -> Iterator[str]:
        yield f"detection unit: {self.options.unit_um:.6g} um; reference positions of X, Y, Z: "
        yield f"{self.options.reference_mm} mm"
        for n, one in enumerate(self.pitch, 1):
            yield (
                f"A{n} is {one.axis}: numbers {one.first + 1} to {one.second - 1} (positive "
                f"direction) and {one.second + 1} to {one.second + len(one.nodes) - 1} (negative)"
            )
        yield "Compare the form of the words with a punched-out file of the control; other bits of"
        yield "3605 are zero in this file. The interval (3624) is in mm with a decimal point."
        yield "Set the backlash compensation (1851, 1852) to zero: the tables contain it."
        yield "Switch off and on, and return to the reference positions in the positive direction."
        yield "Check the sign with an indicator on one axis."


@FORMATS.register
class Fanuc(Format[FanucOptions]):
    """Bidirectional pitch error compensation of a FANUC control."""

    name = "fanuc"
    summary = "FANUC 16i, 18i, 0i: pitch error compensation per axis in both directions"
    source = (
        "FANUC, Series 0i-PB Parameter Manual, B-63980EN/01, page 100 (sections); Series 16i/18i "
        "Bidirectional pitch error compensation, A-77810E (parameters 3605, 3620 to 3627); Series "
        "15i Parameter Manual, B-63330EN/03, page 25 (form of a record)"
    )
    sign = "added to the position: a positive value lengthens a travel in the positive direction"
    units = "detection units times magnification (3623); positions in mm"
    resolution = (
        "detection unit times magnification; the value of the nearest point, constant beyond them"
    )
    limits = (
        f"linear axes X, Y, Z, each by its own position; at most {_MOST} points per axis and "
        f"direction; a change of at most {_LARGEST} counts per interval"
    )
    options = FanucOptions

    def refuse(self, machine: IdentifiedMachine, options: FanucOptions) -> str | None:
        unfit = refuse_axes(machine) or refuse_travel(machine)
        if unfit is not None:
            return unfit
        for axis, travel in zip(machine.axes, machine.volume, strict=True):
            below, above = _intervals(travel, options.reference(axis), options.interval_mm)
            if below + above > _MOST:
                return (
                    f"option interval_mm: found {options.interval_mm:g}, which makes "
                    f"{below + above} points of {axis}, expected at most {_MOST}; choose a larger "
                    "interval"
                )
        for one in self.tables(machine, options).pitch:
            largest = max(map(abs, one.values.values()))
            if largest > _LARGEST:
                enough = options.magnification * -(-largest // _LARGEST)
                return (
                    f"found a change of {largest} counts between two points of {one.axis}, "
                    f"expected at most {_LARGEST}; choose a smaller interval_mm, or magnification "
                    f"{enough}"
                )
        return None

    def reason(self, machine: IdentifiedMachine, part: str) -> str:
        needs = next((p.needs for p in machine.parts if p.name == part), ())
        others = [n for n in needs if n not in machine.axes and not n.startswith("dir_")]
        if others:
            return f"depends on {', '.join(others)}, for which the table has one value"
        return "one axis by its own position, in steps of the detection unit, zero at its reference"

    def tables(self, machine: IdentifiedMachine, options: FanucOptions) -> FanucTables:
        at = at_inside(machine, options)
        unit = 1e-6 * options.unit_um
        count = unit * options.magnification
        found, first = [], 0
        for axis, travel in zip(machine.axes, machine.volume, strict=True):
            reference = options.reference(axis)
            below, above = _intervals(travel, reference, options.interval_mm)
            nodes = reference + 1e-3 * options.interval_mm * np.arange(-below, above + 1)
            inside = np.clip(nodes, *travel)
            up, down = (machine.line_correction(axis, inside, d, at) for d in (1.0, -1.0))
            back = round((down[below] - up[below]) / unit)
            plus, minus = (np.round((v - v[below]) / count).astype(int) for v in (up, down))
            found.append(Pitch(axis, first, below, nodes, plus, minus, back))
            first += 2 * len(nodes)
        return FanucTables(machine, options, at, tuple(found))


def _intervals(travel: np.ndarray, reference: float, interval_mm: float) -> tuple[int, int]:
    """Intervals below and above the reference that cover the travel."""
    low, high = (round(1e6 * (v - reference) / interval_mm) * 1e-3 for v in travel)
    return max(0, int(np.ceil(-low))), max(0, int(np.ceil(high)))
