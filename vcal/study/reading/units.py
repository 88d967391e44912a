"""Units of measured columns: their spellings in headers, and their conversion to vcal's units.

The exact factors of customary units are those of `scipy.constants`. vcal's own columns have few
units; a general package of units (pint) takes 0.3 s to import for the same thirty factors.
"""

import functools
import re
from dataclasses import dataclass

import numpy as np
from scipy import constants

_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Unit:
    """A unit of one kind of quantity."""

    kind: str
    """``"length"``, ``"angle"``, ``"time"``, ``"temperature"``, ..."""
    name: str
    """Its usual spelling, as messages show it."""
    factor: float
    """Factor to the SI unit; to kelvin for a temperature, without its zero."""
    zero: float = 0.0
    """Reading of a temperature in this unit at 0 degC."""

    def converted(self, values: np.ndarray, to: "Unit") -> np.ndarray:
        """Values in this unit as values in `to`, of the same kind."""
        if self == to:
            return values
        # A ratio such as 25.4 or 5/9 is applied as it is printed, to the last digit of float64.
        ratio = _ratio(self.factor, to.factor)
        with np.errstate(over="ignore"):  # infinite, which is refused with the place of the cell
            if self.zero or to.zero:
                return (values - self.zero) * ratio + to.zero
            return values * ratio


def _ratio(one: float, other: float) -> float:
    ratio = one / other
    short = float(f"{ratio:.15g}")
    return short if abs(short - ratio) <= 2.0 * np.spacing(ratio) else ratio


DMS = Unit("angle", "deg-min-sec", constants.degree)
"""Degrees, minutes and seconds in one cell, such as ``12°34'56.7"``."""

_SPELLINGS: tuple[tuple[Unit, str], ...] = (
    (Unit("length", "m", 1.0), "m metre metres meter meters"),
    (Unit("length", "cm", 1e-2), "cm"),
    (Unit("length", "mm", 1e-3), "mm millimetre millimetres millimeter millimeters"),
    (Unit("length", "um", 1e-6), "um µm micron microns micrometre micrometer"),
    (Unit("length", "nm", 1e-9), "nm"),
    (Unit("length", "inch", constants.inch), 'in inch inches " ″'),
    (Unit("length", "mil", constants.mil), "mil mils thou"),
    (Unit("length", "uin", 1e-6 * constants.inch), "uin µin uinch µinch microinch microinches"),
    (Unit("length", "ft", constants.foot), "ft foot feet ' ′"),
    (Unit("angle", "rad", 1.0), "rad radian radians"),
    (Unit("angle", "mrad", 1e-3), "mrad"),
    (Unit("angle", "urad", 1e-6), "urad µrad"),
    (Unit("angle", "deg", constants.degree), "deg degree degrees °"),
    (Unit("angle", "gon", _TURN / 400.0), "gon grad grads gons grade g"),
    (Unit("angle", "mgon", _TURN / 400e3), "mgon"),
    (Unit("angle", "arcmin", constants.arcmin), "arcmin ' ′"),
    (Unit("angle", "arcsec", constants.arcsec), 'arcsec arcs arcsecond arcseconds " ″'),
    (Unit("angle", "turn", _TURN), "turn turns rev revs"),
    (DMS, "dms deg-min-sec"),
    (Unit("time", "s", 1.0), "s sec secs second seconds"),
    (Unit("time", "ms", 1e-3), "ms msec"),
    (Unit("time", "us", 1e-6), "us µs"),
    (Unit("time", "min", 60.0), "min mins minute minutes"),
    (Unit("time", "h", 3600.0), "h hr hrs hour hours"),
    (Unit("time", "day", 86400.0), "d day days"),
    (Unit("temperature", "degC", 1.0), "degC °C C celsius deg_C"),
    (Unit("temperature", "degF", 5.0 / 9.0, 32.0), "degF °F F fahrenheit deg_F"),
    (Unit("temperature", "K", 1.0, 273.15), "K kelvin"),
    (Unit("mass", "kg", 1.0), "kg"),
    (Unit("mass", "g", 1e-3), "g"),
    (Unit("mass", "lb", constants.lb), "lb lbs lbm"),
    (Unit("speed", "m/s", 1.0), "m/s m_s m_per_s"),
    (Unit("speed", "mm/s", 1e-3), "mm/s mm_s mm_per_s"),
    (Unit("speed", "m/min", 1.0 / 60.0), "m/min m_min m_per_min"),
    (Unit("speed", "mm/min", 1e-3 / 60.0), "mm/min mm_min mm_per_min"),
    (Unit("speed", "in/min", constants.inch / 60.0), "in/min in_min ipm in_per_min"),
    (Unit("acceleration", "m/s2", 1.0), "m/s2 m/s² m/s^2 m_s2"),
    (Unit("acceleration", "mm/s2", 1e-3), "mm/s2 mm/s² mm/s^2 mm_s2"),
    (Unit("acceleration", "g", constants.g), "g"),
    (Unit("rotation", "rad/s", 1.0), "rad/s rad_s rad_per_s"),
    (Unit("rotation", "deg/s", constants.degree), "deg/s °/s deg_s deg_per_s"),
    (Unit("rotation acceleration", "rad/s2", 1.0), "rad/s2 rad/s² rad/s^2 rad_s2"),
    (Unit("rotation acceleration", "deg/s2", constants.degree), "deg/s2 °/s² deg/s^2 deg_s2"),
    (Unit("turning speed", "rpm", 1.0), "rpm 1/min min-1 rev/min"),
    (Unit("turning speed", "1/s", 60.0), "1/s s-1 Hz rev/s"),
)

_PLAIN = frozenset(("", "-", "–", "1", "#", "none", "n/a", "no", "nr"))
"""Cells of a units row for a column without a unit."""


def _spelled(text: str) -> str:
    """A spelling with one character for each of the micro, minus, degree and quotation signs."""
    found = text.strip().replace("μ", "µ").replace("º", "°").replace("˚", "°")
    return found.replace("”", '"').replace("’", "'").replace("''", '"')


@functools.cache
def _table() -> tuple[dict[str, list[Unit]], dict[str, list[Unit]]]:
    exact: dict[str, list[Unit]] = {}
    folded: dict[str, list[Unit]] = {}
    for unit, spellings in _SPELLINGS:
        for one in spellings.split():
            exact.setdefault(one, []).append(unit)
            folded.setdefault(one.casefold(), []).append(unit)
    return exact, folded


def units_of(text: str) -> tuple[Unit, ...]:
    """The units that a spelling may stand for: ``'"'`` is an inch or a second of arc. Empty for an
    unknown one.
    """
    exact, folded = _table()
    text = _spelled(text).strip("[](){}<>").strip()
    return tuple(exact.get(text) or folded.get(text.casefold()) or ())


def unit_of_kind(text: str, kind: str) -> Unit | None:
    """The unit of a kind that a spelling stands for; None without any."""
    return next((unit for unit in units_of(text) if unit.kind == kind), None)


def known(kind: str) -> list[str]:
    """Names of the units of a kind, for messages."""
    return list(dict.fromkeys(unit.name for unit, _ in _SPELLINGS if unit.kind == kind))


def is_unit_cell(text: str) -> bool:
    """Whether a cell of a units row says that a column has no unit."""
    return _spelled(text).strip("[](){}<>").strip().casefold() in _PLAIN


def split_unit(name: str) -> tuple[str, str]:
    """Name of a column without its unit, and the spelling of the unit; empty without a known one.

    The unit is in brackets (``X [mm]``, ``Range (inch)``), after a slash (``X / mm``), or the last
    part of the name (``x_mm``, ``T_y_degF``, ``v_x_m_s``).
    """
    name = name.strip()
    if match := re.fullmatch(r"(.*?)[\s_,]*[\[({<]\s*([^\[\](){}<>]*?)\s*[\])}>]", name):
        return (match[1], match[2]) if units_of(match[2]) else (name, "")
    if (match := re.fullmatch(r"(.*?\S)\s*/\s*(\S+)", name)) and units_of(match[2]):
        if not units_of(f"{match[1].rpartition('_')[2]}/{match[2]}"):
            return match[1], match[2]
    parts = re.split(r"([_\s]+)", name)
    for count in (5, 3, 1):
        stem, unit = "".join(parts[: -count - 1]), "_".join(parts[-count::2])
        if len(parts) > count and stem and units_of(unit):
            return stem, unit
    return name, ""


def unit_of_name(name: str) -> Unit | None:
    """The unit in the name of one of vcal's own columns; None for a column without one."""
    unit = split_unit(name)[1]
    # vcal's own names are written in exactly these spellings, which are unambiguous there.
    found = [one for one in units_of(unit) if unit in (one.name, one.name.replace("/", "_"))]
    return found[0] if found else None


_DMS = re.compile(
    r"""\s*([+\-−]?)\s*(\d+(?:[.,]\d+)?)\s*(?:[°d:\s-]\s*(\d+(?:[.,]\d+)?)\s*
    (?:['′m:\s-]\s*(\d+(?:[.,]\d+)?)\s*(?:["″s]|'')?)?\s*['′m]?)?\s*°?\s*""",
    re.VERBOSE,
)


def degrees(text: str) -> float:
    """Degrees of a cell of degrees, minutes and seconds; NaN for anything else.

    The parts are separated by their signs, by blanks, colons or hyphens. A sign in front applies to
    the whole angle.
    """
    match = _DMS.fullmatch(_spelled(text))
    if match is None:
        return np.nan
    d, m, s = (float((part or "0").replace(",", ".")) for part in match.groups()[1:])
    if m >= 60.0 or s >= 60.0:
        return np.nan
    value = d + m / 60.0 + s / 3600.0
    return -value if match[1] in ("-", "−") else value
