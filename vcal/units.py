"""Conversion between the units of files and reports and the SI units used inside.

All internal values are in metre, radian, second and kelvin. Temperatures are differences in kelvin,
or values in degree Celsius, which has the same scale. Units appear in the *names* of columns and
parameters.
"""

import functools
import math
import re

_FACTORS = {
    "m": 1.0,
    "mm": 1e-3,
    "um": 1e-6,
    "nm": 1e-9,
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "deg": 0.017453292519943295,
    "s": 1.0,
    "ms": 1e-3,
    "h": 3600.0,
    "pose": 1.0,
    "K": 1.0,
    "degC": 1.0,
    "kg": 1.0,
    "N": 1.0,
    "%": 0.01,
}


@functools.cache
def si_factor(unit: str) -> float:
    """Factor from a value in `unit` to SI.

    `unit` is a product of symbols separated by spaces, optionally divided by one symbol or one
    product in parentheses. A power is a digit after the symbol: ``"um"``, ``"um/(m K)"``,
    ``"urad/m2"``. ``"1"`` or an empty text is a plain number.

    Raises `ValueError` for an unknown symbol.
    """
    numerator, _, denominator = unit.partition("/")
    return _product(numerator, unit) / _product(denominator.strip("() "), unit)


_SI = {
    **dict.fromkeys(("m", "mm", "um", "nm"), "m"),
    **dict.fromkeys(("rad", "mrad", "urad", "deg"), "rad"),
    **dict.fromkeys(("s", "ms", "h"), "s"),
    "%": "1",
}


def si_unit(unit: str) -> str:
    """The SI unit of the same kind as `unit`: ``"um/(m K)"`` gives ``"m/(m K)"``, ``"deg"`` gives
    ``"rad"``; ``"1"`` for a plain number. A temperature in degC stays in degC.
    """
    return re.sub(r"[^\d\s()/]+", lambda found: _SI.get(found[0], found[0]), unit) or "1"


def _product(text: str, unit: str) -> float:
    value = 1.0
    for token in text.split():
        if token == "1":
            continue
        parts = re.fullmatch(r"(\D+)(\d*)", token)
        if parts is None or parts[1] not in _FACTORS:
            raise ValueError(
                f"unit {unit!r}: found {token!r}, expected one of {sorted(_FACTORS)}, with a digit "
                "behind it where it is a power"
            )
        value *= _FACTORS[parts[1]] ** int(parts[2] or 1)
    return value


def times(unit: str, other: str) -> str:
    """The unit times a symbol: ``"um/(m K)"`` times ``"K"`` is ``"um/m"``, ``"um"`` times ``"K"``
    is ``"um K"``.
    """
    if other == "1":
        return unit
    numerator, _, denominator = unit.partition("/")
    below = denominator.strip("() ").split()
    if other not in below:
        numerator = f"{numerator} {other}" if numerator != "1" else other
    else:
        below.remove(other)
    if not below:
        return numerator
    return f"{numerator}/{below[0]}" if len(below) == 1 else f"{numerator}/({' '.join(below)})"


_OF_LENGTH = ("m", "mm", "um", "nm")
_OF_ANGLE = ("rad", "mrad", "urad", "deg")
_OF_TIME = ("s", "ms", "h")
_KINDS = {symbol: kind for kind in (_OF_LENGTH, _OF_ANGLE, _OF_TIME) for symbol in kind}
"""Symbols of one kind of quantity, by each of them; the others are the only ones of their kind."""
_SPELLED = {"pct": "%", "percent": "%"}
"""Symbols that a name cannot hold, by the words that stand for them."""


def unit_of_column(name: str) -> tuple[str, float]:
    """The first symbol of the unit in the name of a column, and the factor from that unit to SI.

    ``"gap_mm"`` gives ``("mm", 1e-3)``, ``"feed_mm_per_s"`` the same, ``"humidity_pct"`` gives
    ``("%", 0.01)``. A name without a unit, or with one that vcal does not know, gives ``("", 1)``.
    """
    stem, _, below = name.rpartition("_per_") if "_per_" in name else (name, "", "")
    symbol = stem.rpartition("_")[2] if "_" in stem else ""
    symbol = _SPELLED.get(symbol, symbol)
    parts = [_SPELLED.get(part, part) for part in below.split("_") if part]
    if symbol not in _FACTORS or any(part not in _FACTORS for part in parts):
        return "", 1.0
    return symbol, _FACTORS[symbol] / math.prod(_FACTORS[part] for part in parts)


def is_per(unit: str, symbol: str) -> bool:
    """Whether a unit is one per quantity of the kind of `symbol`: ``"um/m"`` and ``"mm"``."""
    below = re.findall(r"[^\d\s()]+", unit.partition("/")[2])
    return any(one in _KINDS.get(symbol, (symbol,)) for one in below)


def in_name(unit: str) -> str:
    """The unit as the suffix of a name: ``"um/(m K)"`` gives ``"um_per_m_K"``."""
    text = unit.replace("/", " per ").replace("(", "").replace(")", "").replace("%", "percent")
    return "_".join(text.split())
