"""The meaning of the names of columns: the quantity, its unit, and whether it was measured."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .export import TextTable
from .units import unit_of

_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*)\s*[\])]\s*(.*)")
_MEASURED = (
    *("meas", "measured", "act", "actual", "read", "readback", "observed", "obs", "tracker"),
    *("reading", "ist"),
)
_NOMINAL = (
    *("nom", "nominal", "cmd", "command", "commanded", "ref", "reference", "set", "soll"),
    *("machine", "axis", "pos", "position", "program", "programmed"),
)
_WORDS = {
    "name": (
        *("name", "point", "point name", "point id", "point no", "point number", "pt", "pt name"),
        *("pt id", "target", "target name", "target id", "id", "no", "nr", "number", "index"),
    ),
    "group": ("group", "group name", "collection", "collection name", "point group"),
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "a": ("a",),
    "b": ("b",),
    "c": ("c",),
    "u": ("u",),
    "v": ("v",),
    "w": ("w",),
    "range": ("r", "range", "rho", "distance", "dist", "slope distance", "slope dist", "sd"),
    "radius": ("radius", "radial"),
    "azimuth": ("azimuth", "az", "azim", "hz", "horizontal", "horizontal angle", "hz angle"),
    "elevation": ("elevation", "el", "elev", "elevation angle"),
    "zenith": ("zenith", "zenith angle", "zenith distance", "polar", "polar angle"),
    "theta": ("theta", "θ", "angle"),
    "phi": ("phi", "φ"),
    "vertical": ("vertical", "vertical angle", "v angle"),
    "time": ("time", "timestamp", "time stamp", "date time", "datetime", "utc"),
    "date": ("date",),
    "ux": ("ux", "u x", "uncertainty x", "x uncertainty", "sigma x", "sx", "std x"),
    "uy": ("uy", "u y", "uncertainty y", "y uncertainty", "sigma y", "sy", "std y"),
    "uz": ("uz", "u z", "uncertainty z", "z uncertainty", "sigma z", "sz", "std z"),
    "air": ("air temperature", "air temp", "t air", "temp air", "ambient temperature"),
}
_ROLE = {word: role for role, words in _WORDS.items() for word in words}


@dataclass(frozen=True)
class Name:
    """What the name of a column says."""

    text: str
    """The words without the unit, in small letters, separated by single blanks."""
    unit: str | None
    """The unit of a length or angle; None where the name has none."""
    symbol: str
    """The unit as the file writes it, of any quantity; empty where there is none."""
    kind: str
    """``"nominal"``, ``"measured"``, or empty."""
    role: str | None
    """Its key in `_WORDS`; None for another quantity."""


def parsed(text: str) -> Name:
    """The meaning of a name such as ``"X [mm]"``, ``"Nominal X (in)"`` or ``"x_nom_mm"``."""
    symbol, rest = "", text.strip()
    if found := _BRACKETS.fullmatch(rest):
        symbol, rest = found[2].strip(), f"{found[1]} {found[3]}"
    words = re.sub(r"[\s_.:\-]+", " ", rest).strip().casefold()
    if not symbol:
        before, _, last = words.rpartition(" ")
        if not before:
            before, _, last = words.rpartition("/")
        # The m of `T m` is no unit of a name, and neither is a letter that names an axis.
        if before and unit_of(last) and last != '"':
            symbol, words = last, before.rstrip(" /")
    kind = ""
    parts = words.split(" ")
    for prefixes, meant in ((_MEASURED, "measured"), (_NOMINAL, "nominal")):
        left = [part for part in parts if part not in prefixes]
        if left and len(left) < len(parts):
            kind, parts = meant, left
    words = " ".join(parts)
    return Name(words, unit_of(symbol) if symbol else None, symbol, kind, _ROLE.get(words))


def names_of(table: TextTable) -> list[Name]:
    """The meaning of every column of a table with a header; units may stand in a row of their own.

    A file without a header has none.
    """
    found = [parsed(text) for text in table.header]
    if not table.units:
        return found
    return [
        name if name.symbol else Name(name.text, unit_of(unit), unit, name.kind, name.role)
        for name, unit in zip(found, table.units, strict=True)
    ]


def places(names: Sequence[Name], kind: str | None = None) -> Mapping[str, int]:
    """The first column of every role, with `kind` where it is given."""
    found: dict[str, int] = {}
    for place, name in enumerate(names):
        if name.role is not None and (kind is None or name.kind == kind):
            found.setdefault(name.role, place)
    return found
