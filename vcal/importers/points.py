"""Point lists: Cartesian, cylindrical or spherical coordinates to Cartesian ones, with names, times
and uncertainties.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..study.messages import listed, refusal
from .base import Needs, Options
from .columns import Name, names_of
from .export import TextTable
from .times import seconds
from .units import ANGLES_RAD, LENGTHS_MM, stated_units

_ANGLES = ("azimuth", "elevation", "zenith")
_UNCLEAR = ("theta", "phi", "vertical")
"""Words that mean the azimuth in one program and the zenith distance in another one."""
_LENGTH_NEED = "unit of the lengths, which the file does not state: mm, m, inch, ..."
_ANGLE_NEED = "unit of the angles, which the file does not state: deg, rad, gon, ..."


@dataclass(frozen=True)
class Points:
    """Measured points in the frame of the instrument."""

    lines: Sequence[int]
    """Line of the file per point."""
    system: str
    """``"cartesian"``, ``"cylindrical"`` or ``"spherical"``: as the file gives them."""
    cartesian_mm: Float[np.ndarray, "n 3"]
    """Coordinates."""
    polar: Float[np.ndarray, "n 3"]
    """Range, mm, azimuth and elevation, rad: as in the file where it gives them."""
    names: Sequence[str] | None
    """Name of each point."""
    t_s: np.ndarray | None
    """Seconds since the first point."""
    u_mm: Float[np.ndarray, "n 3"] | None
    """Uncertainty of each Cartesian coordinate; its coverage factor is not documented."""
    used: frozenset[int]
    """Columns of the file that were read."""
    notes: Sequence[str]
    """What was converted."""


class Units:
    """Units of the columns of one table: their own, those of the comments, or those of the user."""

    def __init__(self, table: TextTable, options: Options, needs: Needs):
        self.length, self.angle = stated_units(table.comments)
        self.options, self.needs = options, needs
        self.used: dict[str, str] = {}

    @staticmethod
    def given_mm(options: Options) -> float:
        """Factor to millimetre of lengths in a file that never states a unit."""
        return LENGTHS_MM[options.unit or "mm"]

    def length_mm(self, name: Name | None) -> float:
        """Factor of a length to millimetre."""
        unit = (name and name.unit) or self.length or self.options.unit
        if unit is None:
            self.needs.add("--unit", _LENGTH_NEED)
        if unit is not None and unit not in LENGTHS_MM:
            return 1.0
        self.used["lengths"] = unit or "mm"
        return LENGTHS_MM[unit or "mm"]

    def angle_rad(self, name: Name | None) -> float:
        """Factor of an angle to radian."""
        unit = (name and name.unit) or self.angle or self.options.angle_unit
        if unit is None:
            self.needs.add("--angle-unit", _ANGLE_NEED)
        self.used["angles"] = unit or "rad"
        return ANGLES_RAD[unit or "rad"]


def read_points(table: TextTable, options: Options, needs: Needs) -> Points:
    """The points of a table with or without a header.

    Without a header, a row is ``[names] c1 c2 c3``: Cartesian coordinates, unless a comment names
    another coordinate system. Raises `StudyError` where the columns are none of these.
    """
    if not table.header:
        return _without_header(table, options, needs)
    names = names_of(table)
    measured: dict[str, int] = {}
    for place, name in enumerate(names):
        if name.role is not None and name.kind != "nominal":
            # A column that says that it was measured counts before one that does not.
            if name.role not in measured or (
                name.kind == "measured" and names[measured[name.role]].kind != "measured"
            ):
                measured[name.role] = place
    polar = _polar_columns(table, names, measured, options, needs)
    if polar is not None:
        columns, meaning = polar
        return _points(table, names, columns, meaning, measured, options, needs)
    if all(c in measured for c in "xyz"):
        columns = tuple(measured[c] for c in "xyz")
        return _points(table, names, columns, ("x", "y", "z"), measured, options, needs)
    raise refusal(
        table.name,
        "header",
        f"columns {listed(table.header)}",
        "x, y, z, or range, azimuth and elevation (or zenith), or radius, azimuth and z",
        "rename the columns, or declare them in [data.columns] of a study of your own",
    )


def _without_header(table: TextTable, options: Options, needs: Needs) -> Points:
    numeric = [place for place in range(table.width) if table.is_numeric(place)]
    # The number of the point may stand in front of its coordinates.
    if len(numeric) == 4:
        first = table.numbers(numeric[0])
        if (first == np.round(first)).all() and len(set(first)) == len(first):
            numeric = numeric[1:]
    coordinates = numeric[:3]
    rest = [p for p in range(table.width) if p > (coordinates or [0])[-1]]
    times = [p for p in rest if ":" in table.rows[0][p]]
    if len(numeric) != 3 or coordinates != list(range(coordinates[0], coordinates[0] + 3)):
        raise refusal(
            table.name,
            f"line {table.lines[0]}",
            f"{len(numeric)} numbers in a row and no header",
            "three coordinates, with names in front of them and a time behind them",
            "add a line with the names of the columns above the rows, such as "
            "`name,x_mm,y_mm,z_mm`",
        )
    system = stated_system(table)
    meaning = {"cartesian": ("x", "y", "z"), "cylindrical": ("radius", "azimuth", "z")}.get(system)
    if meaning is None:
        meaning = ("range", *_two_angles(options, needs))
    places = {"time": times[0]} if times else {}
    if coordinates[0] > 0:
        places["name"] = coordinates[0] - 1
    names = [Name("", None, "", "", None)] * table.width
    return _points(table, names, tuple(coordinates), meaning, places, options, needs)


def stated_system(table: TextTable) -> str:
    """The coordinate system that a comment names; Cartesian without any."""
    for comment in table.comments:
        words = comment.casefold()
        if any(word in words for word in ("spherical", "polar")):
            return "spherical"
        if "cylindric" in words:
            return "cylindrical"
        if "cartesian" in words:
            return "cartesian"
    return "cartesian"


def _two_angles(options: Options, needs: Needs) -> tuple[str, str]:
    given = tuple(part.strip() for part in (options.angles or "").split(","))
    if len(given) == 2 and sorted(given) in (["azimuth", "elevation"], ["azimuth", "zenith"]):
        return given[0], given[1]
    needs.add(
        "--angles",
        "the two angles in the order of their columns, as theta and phi mean either: "
        "azimuth,elevation or azimuth,zenith or zenith,azimuth",
    )
    return "azimuth", "elevation"


def _polar_columns(
    table: TextTable,
    names: Sequence[Name],
    measured: dict[str, int],
    options: Options,
    needs: Needs,
) -> tuple[tuple[int, ...], tuple[str, ...]] | None:
    """The columns of cylindrical or spherical coordinates with their meaning; None for others."""
    clear = {role: measured[role] for role in _ANGLES if role in measured}
    unclear = [role for role in _UNCLEAR if role in measured]
    if "azimuth" not in clear and len(unclear) < 1:
        return None
    reach = measured.get("range", measured.get("radius"))
    if reach is None:
        return None
    cylindrical = "z" in measured and "x" not in measured
    if cylindrical and len(clear) + len(unclear) == 1:
        angle = clear.get("azimuth", measured[unclear[0]] if unclear else -1)
        return (reach, angle, measured["z"]), ("radius", "azimuth", "z")
    upright = next((role for role in ("elevation", "zenith") if role in clear), None)
    if "azimuth" in clear and upright is not None:
        return (reach, clear["azimuth"], clear[upright]), ("range", "azimuth", upright)
    angles = sorted([*clear.values(), *(measured[role] for role in unclear)])
    if len(angles) == 2:
        return (reach, *angles), ("range", *_two_angles(options, needs))
    return None


def _points(
    table: TextTable,
    names: Sequence[Name],
    columns: tuple[int, ...],
    meaning: tuple[str, ...],
    measured: dict[str, int],
    options: Options,
    needs: Needs,
) -> Points:
    units = Units(table, options, needs)
    found: dict[str, np.ndarray] = {}
    for place, what in zip(columns, meaning, strict=True):
        angle = what in _ANGLES
        factor = (units.angle_rad if angle else units.length_mm)(names[place])
        found[what] = table.numbers(place) * factor
    if "zenith" in found:
        found["elevation"] = np.pi / 2.0 - found.pop("zenith")
    notes = [
        ", ".join(f"{what} in {unit}" for what, unit in units.used.items()) + " were converted"
    ]
    if "x" in found:
        system, xyz = "cartesian", np.column_stack([found[c] for c in "xyz"])
        polar = to_polar(xyz)
    elif "radius" in found:
        system = "cylindrical"
        level, azimuth = found["radius"], found["azimuth"]
        xyz = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), found["z"]])
        polar = np.column_stack(
            [np.hypot(level, found["z"]), azimuth, np.arctan2(found["z"], level)]
        )
    else:
        system = "spherical"
        polar = np.column_stack([found[c] for c in ("range", "azimuth", "elevation")])
        level = polar[:, 0] * np.cos(polar[:, 2])
        xyz = np.column_stack(
            [
                level * np.cos(polar[:, 1]),
                level * np.sin(polar[:, 1]),
                polar[:, 0] * np.sin(polar[:, 2]),
            ]
        )
    used = {*columns}
    labels = None
    if "name" in measured:
        used.add(measured["name"])
        labels = table.cells(measured["name"])
    t_s, of_time = _times(table, names, measured, options)
    used |= of_time
    u_mm = None
    if all(f"u{c}" in measured for c in "xyz"):
        factors = [units.length_mm(names[measured[f"u{c}"]]) for c in "xyz"]
        u_mm = np.column_stack(
            [f * table.numbers(measured[f"u{c}"]) for f, c in zip(factors, "xyz", strict=True)]
        )
        used |= {measured[f"u{c}"] for c in "xyz"}
    if "group" in measured:
        used.add(measured["group"])
    return Points(table.lines, system, xyz, polar, labels, t_s, u_mm, frozenset(used), tuple(notes))


def _times(
    table: TextTable, names: Sequence[Name], measured: dict[str, int], options: Options
) -> tuple[np.ndarray | None, set[int]]:
    """Seconds since the first point, and the columns that they were taken from."""
    if "time" not in measured:
        return None, set()
    place = measured["time"]
    if table.is_numeric(place):
        symbol = names[place].symbol.casefold()
        factor = {"ms": 1e-3, "min": 60.0, "h": 3600.0}.get(symbol, 1.0)
        # A number without a unit may be a date of a spreadsheet, so that only seconds are read.
        if symbol in ("s", "sec", "ms", "min", "h"):
            return table.numbers(place) * factor, {place}
        return None, set()
    cells = table.cells(place)
    taken = {place}
    if "date" in measured:
        taken.add(measured["date"])
        dates = table.cells(measured["date"])
        cells = [f"{date} {time}" for date, time in zip(dates, cells, strict=True)]
    found = seconds(cells, table.name, table.lines, options.time_format)
    return found, taken if found is not None else set()


def to_polar(xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Range, azimuth atan2(y, x) and elevation of points: the elevation is computed by the arc
    tangent, which keeps its digits near the zenith.
    """
    level = np.hypot(xyz[:, 0], xyz[:, 1])
    return np.column_stack(
        [
            np.hypot(level, xyz[:, 2]),
            np.arctan2(xyz[:, 1], xyz[:, 0]),
            np.arctan2(xyz[:, 2], level),
        ]
    )
