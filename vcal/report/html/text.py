"""Numbers, uncertainties and units as text."""

import math
import re

from ...plots.labels import SUPERSCRIPTS, pretty_unit

DASH = "–"
COVERAGE = 2.0
"""Coverage factor k of the expanded uncertainty U = k u."""
STATED = ("value", "standard uncertainty u", "U (k = 2)", "unit")
"""Header of the cells of `stated`."""


def number(value: float | None, digits: int = 3) -> str:
    """A number with this many significant digits; a dash for None and for non-finite numbers."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0.0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return scientific(value, digits)
    places = digits - 1 - math.floor(math.log10(abs(value)))
    return _minus(f"{round(value, places):.{max(places, 0)}f}")


def rounded(value: float, u: float) -> tuple[str, str]:
    """A value and its uncertainty to two significant digits of the latter (GUM 7.2.6)."""
    if not math.isfinite(u) or u <= 0.0:
        return number(value, 5), DASH
    places = 1 - math.floor(math.log10(u))
    if round(u, places) >= 10.0 ** (2 - places):  # 0.0996 is 0.10, not 0.100
        places -= 1
    shown = max(places, 0)
    return (_minus(f"{round(value, places):.{shown}f}"), f"{round(u, places):.{shown}f}")


def stated(value: float, u: float, unit_: str) -> tuple[str, str, str, str]:
    """Value, standard and expanded uncertainty, unit: four cells under `STATED`."""
    shown, shown_u = rounded(value, u)
    return shown, shown_u, rounded(value, COVERAGE * u)[1], unit(unit_)


def with_uncertainty(value: float | None, u: float | None) -> str:
    """Value and standard uncertainty in one text: ``"0.94 ± 0.18"``."""
    if value is None or not math.isfinite(value):
        return DASH
    if u is None or not math.isfinite(u) or u <= 0.0:
        return number(value)
    return " ± ".join(rounded(value, u))


def scientific(value: float, digits: int = 2) -> str:
    """``"1.1 × 10⁻⁵"``."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{_minus(mantissa)} × 10{str(int(exponent)).translate(SUPERSCRIPTS)}"


def probability(p: float) -> str:
    """A p-value: plain down to 0.001, as a power of ten below."""
    if p < 1e-300:
        return "< 10⁻³⁰⁰"
    if p < 1e-3:
        return scientific(p)
    return "> 0.99" if p > 0.99 else f"{p:.2g}"


def percent(share: float) -> str:
    """A share in percent; a dash for a share that is not finite."""
    if not math.isfinite(share):
        return DASH
    return _minus(f"{100.0 * share:.0f} %" if abs(share) >= 0.1 else f"{100.0 * share:.1f} %")


def duration(seconds: float) -> str:
    """A time in hours and minutes: ``"2 h 05 min"``."""
    minutes = round(seconds / 60.0)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def unit(text: str) -> str:
    """A unit as it is printed."""
    return pretty_unit(text)


def sentence_of(words: str) -> str:
    """The words with a capital letter and a full stop. An identifier, such as ``screw_cyclic``, is
    left as it is written in files.
    """
    first = words[:1] if "_" in words.split(" ", 1)[0] else words[:1].upper()
    return f"{first}{words[1:]}{'' if words.endswith('.') else '.'}"


def _minus(text: str) -> str:
    """With a minus sign, which zero does not have."""
    return re.sub(r"^-(?=[0.]+\D*$)", "", text).replace("-", "−")
