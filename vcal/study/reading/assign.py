"""Which column of a file holds which quantity: by a mapping, by names and units, by dates."""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...errors import StudyError
from ...instruments.base import Column
from ...registry import nearest
from ...words import printable
from ..messages import listed, refusal
from . import times
from .formats import ColumnSettings
from .grid import Cells, Grid
from .units import DMS, Unit, degrees, known, split_unit, unit_of_kind, unit_of_name, units_of

_TIME_NAMES = frozenset(
    "t time times timestamp time_stamp datetime date_time date zeit datum uhrzeit".split()
)
_SUFFIXES = {
    "length": ("mm", "um", "m"),
    "angle": ("deg", "rad", "urad", "mrad"),
    "time": ("s",),
    "temperature": ("degC",),
    "mass": ("kg",),
    "speed": ("m_s",),
    "acceleration": ("m_s2",),
    "rotation": ("rad_s",),
    "rotation acceleration": ("rad_s2",),
    "turning speed": ("rpm",),
}
"""Units in the names of vcal's own columns, by kind."""
_ABSOLUTE_K = 200.0
"""Least temperature in kelvin; smaller numbers are differences."""
_TIME = "t_s"


@dataclass(frozen=True)
class Assigned:
    """A column of the file as one quantity, with its conversion."""

    column: str
    """Name of the quantity; that in the file where vcal does not know it."""
    places: tuple[int, ...]
    """Columns of the file, from 0."""
    source: str
    """Their names in the file."""
    unit: Unit | None = None
    """Unit of the numbers in the file; None where they are taken as they are."""
    to: Unit | None = None
    """Unit in the name of the quantity."""
    sign: int = 1
    offset: float = 0.0
    format: str = ""
    """Format of a time; empty for a number."""
    declared: bool = False
    """Whether the mapping names it."""
    in_unit: bool = False
    """Whether the mapping declares the unit."""
    zero: str = field(default="", compare=False)
    """The instant that is zero, of a time."""

    @property
    def changed(self) -> bool:
        """Whether name or values differ from those in the file."""
        return self.declared or self.source != self.column or self.converts

    @property
    def converts(self) -> bool:
        """Whether the values differ from those in the file."""
        return bool(self.format) or self.unit != self.to or self.sign < 0 or self.offset != 0.0

    @property
    def words(self) -> str:
        """How the quantity is read, such as ``x_mm from 'X pos', inch, sign -1``."""
        said = [f"{self.column} from {self.source!r}"]
        if self.format:
            said.append(self.format + (f", 0 is {self.zero}" if self.zero else ""))
        if self.unit is not None and self.unit != self.to:
            said.append(f"{self.unit.name} to {self.to.name if self.to else 'plain numbers'}")
        said += ["sign -1"] if self.sign < 0 else []
        said += [f"offset {self.offset:+g}"] if self.offset else []
        return ", ".join(said)

    @property
    def record(self) -> dict[str, object]:
        """The same for programs."""
        return {
            "column": self.column,
            "from": self.source,
            "unit": None if self.unit is None else self.unit.name,
            "sign": self.sign,
            "offset": self.offset,
            "format": self.format or None,
            "zero": self.zero or None,
        }


@dataclass(frozen=True)
class Place:
    """Where the mapping of a table stands, for messages."""

    file: str = "setup.toml"
    key: str = "data."

    def of(self, column: str, key: str) -> str:
        """The dotted key of an entry."""
        return f"key {self.key}columns.{column}.{key}"


def assign(
    grid: Grid,
    asked: Collection[str],
    optional: Callable[[str], Column | None],
    place: Place,
) -> list[Assigned]:
    """What every column of a grid is, in the order of the file; columns of the mapping first.

    `asked` are names of expected columns. Raises `StudyError` for a mapping that does not fit the
    file, for units that contradict each other, and for two columns of one quantity.
    """
    found = [_mapped(grid, name, one, place) for name, one in grid.form.columns.items()]
    used = {i for one in found for i in one.places}
    taken = {one.column for one in found}
    free = [i for i in range(len(grid.names)) if i not in used]
    names = {grid.names[i] for i in free} | taken
    for i in free:
        one = _read(grid, i, asked, optional, names)
        if one.column in taken and one.column:
            # The mapping says which column is the quantity; this one is another.
            one = Assigned("", one.places, one.source)
        found.append(one)
    first: dict[str, Assigned] = {}
    for one in found:
        if not one.column:
            continue
        if one.column in first:
            both = f"{first[one.column].source!r} and {one.source!r}"
            raise refusal(
                grid.name,
                f"header, columns {both}",
                "two columns of one quantity",
                f"one, {one.column}",
                "remove one of them, rename it where it is another quantity, or name the right one "
                "in [data.columns]",
            )
        first[one.column] = one
    return found


def _mapped(grid: Grid, name: str, one: ColumnSettings, place: Place) -> Assigned:
    """An entry of the mapping, checked against the file."""
    places = tuple(_place(grid, name, source, place) for source in one.sources)
    source = " ".join(grid.names[i] or str(i + 1) for i in places)
    to = unit_of_name(name)
    if one.format is not None:
        if to is None or to.kind != "time":
            raise refusal(
                place.file,
                place.of(name, "format"),
                f"a format of times for {name}",
                "a quantity whose name ends in a unit of time, such as t_s",
                "remove the key, or correct the name",
            )
        return Assigned(name, places, source, format=one.format, offset=one.offset, declared=True)
    text = one.unit
    if text is None and len(places) == 1:
        text = grid.unit(places[0]) or split_unit(grid.names[places[0]])[1] or None
        if to is None or (text is not None and unit_of_kind(text, to.kind) is None):
            if to is not None and grid.unit(places[0]):
                raise _unlike(grid, name, source, text or "", to)
            text = None
    unit = to
    if text is not None:
        unit = _unit(text, to, name, place)
    elif (
        to is not None and to.kind == "time" and times.looks_like_times(_joined(grid, places)[:50])
    ):
        kind = times.looks_like_times(_joined(grid, places)[:50])
        return Assigned(
            name, places, source, format=_iso(grid, name, places, kind), offset=one.offset,
            declared=True,
        )  # fmt: skip
    return Assigned(
        name,
        places,
        source,
        unit,
        to,
        one.sign,
        one.offset,
        declared=True,
        in_unit=one.unit is not None,
    )


def _place(grid: Grid, name: str, source: str | int, place: Place) -> int:
    names = grid.names
    if isinstance(source, int):
        if source <= len(names):
            return source - 1
        found, expected = f"column {source} of {len(names)}", f"a number from 1 to {len(names)}"
    else:
        source = printable(" ".join(source.split()), lines=False)
        alike = [i for i, one in enumerate(names) if one == source] or [
            i for i, one in enumerate(names) if one.casefold() == source.casefold()
        ]
        if len(alike) == 1:
            return alike[0]
        found = f"{source!r}, no such column in {grid.name}{nearest(source, names)}"
        expected = f"one of {listed(one for one in names if one)}"
    raise refusal(place.file, place.of(name, "from"), found, expected, "correct the name")


def _unit(text: str, to: Unit | None, name: str, place: Place) -> Unit:
    """The unit that a mapping declares, of the kind of the quantity."""
    if to is None:
        raise refusal(
            place.file,
            place.of(name, "unit"),
            f"the unit {text!r} for {name}, whose name has no unit",
            "a unit only for a quantity with a unit in its name",
            "remove the key, or correct the name of the quantity",
        )
    unit = unit_of_kind(text, to.kind)
    if unit is None:
        other = units_of(text)
        raise refusal(
            place.file,
            place.of(name, "unit"),
            f"{text!r}, " + (f"a unit of {other[0].kind}" if other else "an unknown unit"),
            f"a unit of {to.kind}: {listed(known(to.kind))}",
            "correct the unit",
        )
    return unit


def _read(
    grid: Grid,
    i: int,
    asked: Collection[str],
    optional: Callable[[str], Column | None],
    names: Collection[str],
) -> Assigned:
    """A column that the mapping does not name."""
    name, unit = grid.names[i], grid.unit(i)
    if name in asked or (name and optional(name) is not None):
        return _own(grid, i, name, unit)
    if not name:
        return Assigned("", (i,), str(i + 1))
    stem, own = split_unit(name)
    if own and unit and not _same(own, unit):
        own = ""  # a column that vcal does not know
    text = own or unit
    target = _target(stem if own else name, text, asked, optional, names) if text else None
    if target is not None and target not in asked and target.casefold() == name.casefold():
        target = None  # a condition in other letters, whose name the effects that need it suggest
    if target is not None:
        to = unit_of_name(target)
        assert to is not None
        kelvin = unit_of_kind(text, to.kind)
        if kelvin is not None and kelvin.name == "K":
            values = grid.columns[i].values
            values = values[np.isfinite(values)]
            if not len(values) or values.min() < _ABSOLUTE_K:
                return Assigned(name, (i,), name)
        return _own(grid, i, target, text, source=name)
    if _TIME not in names and _words(name) in _TIME_NAMES and optional(_TIME) is not None:
        kind = times.looks_like_times(grid.columns[i].first(50))
        if kind:
            return Assigned(_TIME, (i,), name, format=_iso(grid, name, (i,), kind))
    return Assigned(name, (i,), name)


def _own(grid: Grid, i: int, name: str, text: str, source: str = "") -> Assigned:
    """A column of a known quantity, in the unit `text` of the header or of the units row."""
    source, to = source or name, unit_of_name(name)
    if to is not None and to.kind == "time":
        kind = times.looks_like_times(grid.columns[i].first(50))
        if kind:
            return Assigned(name, (i,), source, format=_iso(grid, source, (i,), kind))
    if not text:
        return Assigned(name, (i,), source, to, to)
    if to is None:
        return Assigned(name, (i,), source)
    unit = unit_of_kind(text, to.kind)
    if unit is None or (source == name and unit != to):
        raise _unlike(grid, name, source, text, to)
    return Assigned(name, (i,), source, unit, to)


def _unlike(grid: Grid, name: str, source: str, text: str, to: Unit) -> StudyError:
    """The error for a unit in the units row that is unknown, or another than in the name."""
    return refusal(
        grid.name,
        f"units row, column {source}",
        f"the unit {text!r}" + ("" if units_of(text) else ", which vcal does not know"),
        f"{to.name}, as in the name of the column"
        if source == name
        else f"a unit of {to.kind}: {listed(known(to.kind))}",
        f"correct one of them, or declare the unit in [data.columns]: {name} = "
        f'{{ from = "{source}", unit = "..." }}',
    )


def _same(one: str, other: str) -> bool:
    return bool({*units_of(one)} & {*units_of(other)})


def _words(name: str) -> str:
    """A name in lower case with its words joined by underscores."""
    return re.sub(r"[\W_]+", "_", name.strip().casefold()).strip("_")


def _target(
    stem: str,
    text: str,
    asked: Collection[str],
    optional: Callable[[str], Column | None],
    names: Collection[str],
) -> str | None:
    """The quantity that a name with a unit stands for; None for an unknown one, and for one that
    has a column of its own.
    """
    plain = re.sub(r"[\W_]+", "_", stem.strip()).strip("_")
    spelled = list(dict.fromkeys((stem, plain, plain.lower())))
    if plain[:2] in ("t_", "T_"):
        spelled += [f"T_{plain[2:]}", f"T_{plain[2:].lower()}"]
    for kind in dict.fromkeys(unit.kind for unit in units_of(text)):
        for suffix in _SUFFIXES[kind]:
            for one in spelled:
                name = f"{one}_{suffix}"
                if one.casefold().startswith("dir_"):
                    continue
                if name in asked or (optional(name) is not None):
                    return None if name in names else name
    return None


def _iso(grid: Grid, name: str, places: Sequence[int], kind: str) -> str:
    """The format of a column of dates; raises `StudyError` where day and month may be exchanged."""
    if kind != "local":
        return times.ISO
    cells = _joined(grid, places)
    raise refusal(
        grid.name,
        f"row 1 (line {grid.lines[0]}), column {name}",
        f"the date {cells[0].strip()!r}, in which day and month may be exchanged",
        "seconds, or times of ISO 8601 such as 2025-01-31T08:00:00",
        f'declare the format in [data.columns]: t_s = {{ from = "{name}", format = "%d.%m.%Y '
        '%H:%M:%S" }, with the order and the separators of the file',
    )


def _joined(grid: Grid, places: Sequence[int]) -> Sequence[str]:
    if len(places) == 1:
        return grid.columns[places[0]].texts
    return [" ".join(part) for part in zip(*(grid.columns[i].texts for i in places), strict=True)]


def cells_of(grid: Grid, one: Assigned) -> Cells:
    """The cells of a quantity as the file has them; several columns are joined by blanks."""
    if len(one.places) == 1:
        return grid.columns[one.places[0]]
    return Cells(_joined(grid, one.places))


def values_of(cells: Cells, one: Assigned, clock: times.Clock) -> np.ndarray:
    """The numbers of a quantity in its own unit (n,); NaN for cells that are none."""
    if one.format:
        return _seconds(cells, one, clock) + one.offset
    if one.unit is DMS:
        values = np.array([degrees(cell) for cell in cells.texts])
    else:
        values = cells.values
    if one.unit is not None and one.to is not None:
        values = one.unit.converted(values, one.to)
    if one.sign < 0:
        values = -values
    return values + one.offset if one.offset else values


def _seconds(cells: Cells, one: Assigned, clock: times.Clock) -> np.ndarray:
    if one.format == times.EXCEL:
        found = [
            times.excel_ns(v) if np.isfinite(v) else times.iso_ns(cells.text(i))
            for i, v in enumerate(cells.values.tolist())
        ]
    elif one.format == times.ISO:
        found = [times.iso_ns(cell) for cell in cells.texts]
        offsets = [times.has_offset(cell) for cell in cells.texts]
        if any(offsets) and not all(offsets):
            usual = sum(offsets) > len(offsets) / 2
            found = [ns if has == usual else None for ns, has in zip(found, offsets, strict=True)]
    else:
        found = [times.pattern_ns(cell, one.format) for cell in cells.texts]
    good = np.array([ns is not None for ns in found], bool)
    instants = np.array([0 if ns is None else ns for ns in found], np.int64)
    seconds = np.full(len(instants), np.nan)
    if good.any():
        seconds[good] = clock.seconds(instants[good])
    return seconds


def expected_cell(one: Assigned) -> str:
    """What a cell of a quantity has to be; empty for a plain number."""
    if one.format == times.ISO:
        return "a time of ISO 8601, such as 2025-01-31T08:00:00, all with or all without an offset"
    if one.format == times.EXCEL:
        return "days since 1899-12-30, such as 45000 in the year 2023"
    if one.format:
        return f"a time of the form {one.format!r}"
    if one.unit is DMS:
        return "an angle such as 12°34'56.7\""
    return ""
