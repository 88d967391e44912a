"""Units of lengths and angles as the headers of exports write them."""

import math
import re
from collections.abc import Sequence

LENGTHS_MM = {
    "mm": 1.0,
    "millimeter": 1.0,
    "millimetre": 1.0,
    "cm": 10.0,
    "centimeter": 10.0,
    "centimetre": 10.0,
    "m": 1000.0,
    "meter": 1000.0,
    "metre": 1000.0,
    "um": 1e-3,
    "µm": 1e-3,
    "micrometer": 1e-3,
    "micrometre": 1e-3,
    "micron": 1e-3,
    "nm": 1e-6,
    "in": 25.4,
    "inch": 25.4,
    "inches": 25.4,
    '"': 25.4,
    "ft": 304.8,
    "foot": 304.8,
    "feet": 304.8,
}
"""Length of a unit in millimetre. The international inch is 25.4 mm exactly."""
ANGLES_RAD = {
    "rad": 1.0,
    "radian": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "µrad": 1e-6,
    "deg": math.pi / 180.0,
    "degree": math.pi / 180.0,
    "°": math.pi / 180.0,
    "arcmin": math.pi / 10_800.0,
    "arcsec": math.pi / 648_000.0,
    "gon": math.pi / 200.0,
    "grad": math.pi / 200.0,
    "turn": 2.0 * math.pi,
}
"""Angle of a unit in radian."""
_OTHER = ("s", "sec", "ms", "c", "°c", "degc", "f", "°f", "degf", "k", "kg", "%", "-", "1", "hpa")
"""Units of further quantities, which tell a row of units from a row of names."""


def unit_of(text: str) -> str | None:
    """The unit of a length or an angle in a text, as a key of the tables here; None for others.

    Case does not matter, and neither do brackets and a plural s.
    """
    plain = text.strip().strip("[](){}").strip().casefold().replace("\u03bc", "µ")
    for known in (plain, plain.removesuffix("s"), plain.removesuffix(".")):
        if known in LENGTHS_MM or known in ANGLES_RAD:
            return known
    return None


def is_unit(text: str) -> bool:
    """Whether a text is the symbol of a unit, of any quantity."""
    plain = text.strip().strip("[](){}").strip().casefold()
    return unit_of(text) is not None or plain in _OTHER


def stated_units(texts: Sequence[str], words: str = "units?") -> tuple[str | None, str | None]:
    """Unit of the lengths and of the angles that comment lines state; None where they state none.

    Taken from what stands behind one of the words (a pattern), as in ``// Units: inches, degrees``.
    The word ``in`` is an inch where no other unit of length follows it, as in ``Units in mm``.
    """
    length = angle = None
    for text in texts:
        if not (said := re.search(rf"\b(?:{words})\b\W*(.*)", text, re.IGNORECASE)):
            continue
        found = [unit_of(word) for word in re.findall(r"[^\s,;:=()\[\]]+", said[1])]
        lengths = [unit for unit in found if unit in LENGTHS_MM]
        if lengths[:1] == ["in"] and len(lengths) > 1:
            del lengths[0]
        angles = [unit for unit in found if unit in ANGLES_RAD]
        length = length or next(iter(lengths), None)
        angle = angle or next(iter(angles), None)
    return length, angle
