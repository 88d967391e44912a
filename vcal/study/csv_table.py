"""Tables of a study, checked cell by cell; CSV files with ten digits on the way out."""

import csv
import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..errors import StudyError
from ..files import naming
from ..instruments.base import Column
from ..registry import closest
from ..words import printable
from .messages import listed, refusal
from .reading.assign import Assigned, Place, assign, cells_of, expected_cell, values_of
from .reading.formats import DEFAULT, TableFormat
from .reading.grid import NO_NUMBER, Cells, Grid, marks_of, no_table
from .reading.parquet import read_parquet
from .reading.text import SEPARATORS, read_text
from .reading.times import Clock
from .reading.units import DMS, known, unit_of_kind
from .reading.workbook import read_workbook

__all__ = ["SEPARATORS", "Table", "load_grid", "read_header", "read_table", "write_table"]

_MOST_WHOLE, _MOST = 1e9, 1e15
"""Largest size of an index, and of a quantity in a column without bounds of its own."""
_DIGITS, _WHOLE_DIGITS = 10, 15
"""Least number of digits to write, and the number that every decimal number keeps in float64."""
_OF_A_STEP = 1e-7
_MOST_UNITS = 5
"""Most units that a message lists."""
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""First bytes of XLSX and ODS, and of XLS, whatever the name of the file."""


class Table(dict[str, np.ndarray]):
    """Columns by name, with the row and line numbers of the file for messages.

    Data rows count from 1 below the header. Line numbers differ from them where lines are empty.
    """

    def __init__(
        self, name: str, lines: Sequence[int], numbers: Sequence[int] = (), read: Sequence[str] = ()
    ):
        super().__init__()
        self.name = name
        """Name of the file in messages."""
        self.lines = lines
        """Line of the file per data row."""
        self.numbers = numbers if len(numbers) else range(1, len(lines) + 1)
        """Number per data row, from 1, as the file counts them."""
        self.read = frozenset(read)
        """Columns of readings, in which cells may be blank."""
        self.blank = np.zeros(len(self.lines), bool)
        """Rows with a blank reading; the cell holds the value of a neighbouring row."""
        self.left_out: tuple[int, ...] = ()
        """Numbers of rows with a blank reading that it has no more."""
        self.kind = ""
        """What the file is and how it was read, in words."""
        self.assigned: tuple[Assigned, ...] = ()
        """What every column of the file is."""

    @property
    def rows(self) -> int:
        """Number of data rows."""
        return len(self.lines)

    @property
    def header(self) -> tuple[str, ...]:
        """Names of all columns of the file, those that vcal knows by its own name for them."""
        return tuple(one.column for one in self.assigned if one.column)

    @property
    def unused(self) -> tuple[str, ...]:
        """Columns of the file in whose place the mapping names another one."""
        return tuple(
            one.source for one in self.assigned if not one.column and not one.source.isdigit()
        )

    @property
    def changed(self) -> tuple[Assigned, ...]:
        """The columns that have another name or other values than in the file."""
        return tuple(one for one in self.assigned if one.column in self and one.changed)

    @property
    def complete(self) -> "Table":
        """The rows without a blank reading."""
        if not self.blank.any():
            return self
        return self.taken(np.flatnonzero(~self.blank))

    def taken(self, rows: np.ndarray) -> "Table":
        """Some rows, which keep their numbers."""
        lines, numbers = ([of[row] for row in rows.tolist()] for of in (self.lines, self.numbers))
        found = Table(self.name, lines, numbers, tuple(self.read))
        found.kind, found.assigned, found.left_out = self.kind, self.assigned, self.left_out
        found.blank = self.blank[rows]
        found.update({name: values[rows] for name, values in self.items()})
        return found

    @property
    def blank_rows(self) -> tuple[int, ...]:
        """Numbers of the rows with a blank reading."""
        return self.left_out + tuple(
            self.numbers[row] for row in np.flatnonzero(self.blank).tolist()
        )

    def where(self, row: int) -> str:
        """Number and line in the file of a row, which counts from 0."""
        return f"row {self.numbers[row]} (line {self.lines[row]})"

    def refusal(self, row: int, column: str, found: str, expected: str, do: str) -> StudyError:
        """The error to raise for one cell; `row` counts from 0."""
        return refusal(self.name, f"{self.where(row)}, column {column}", found, expected, do)


def _nothing(name: str) -> Column | None:
    del name
    return None


def load_grid(
    path: Path | str, name: str | None = None, form: TableFormat = DEFAULT, sheet: str | None = None
) -> Grid:
    """The cells of a file: text, a spreadsheet or parquet, by its first bytes.

    `name` is that of the file in messages, `sheet` one that is given beside the keys of `form`.
    Raises `StudyError` for a file that is missing, empty or damaged.
    """
    path = Path(path)
    name = name or path.name
    if not path.is_file():
        raise refusal(
            name,
            "file",
            f"no such file in {path.parent}",
            "a CSV table with a header line",
            "add the file or correct its name",
        )
    data = path.read_bytes()
    if data.startswith(_WORKBOOKS):
        return read_workbook(data, name, sheet if sheet is not None else form.sheet, form)
    if sheet is not None or form.sheet is not None:
        raise refusal(
            name,
            "file",
            f"a sheet, {sheet or form.sheet!r}, of a file that is no spreadsheet",
            "it for an XLSX or ODS file only",
            "remove the key sheet, or correct the name of the file",
        )
    if data.startswith(b"PAR1"):
        return read_parquet(data, name, form)
    return read_text(data, name, form)


def read_header(path: Path | str, base_name: str | None = None) -> tuple[str, ...]:
    """Names of the columns of a file; raises `StudyError` as `read_table` does."""
    return load_grid(path, base_name).names


def read_table(
    path: Path | str,
    columns: Sequence[Column],
    base_name: str | None = None,
    *,
    optional: Callable[[str], Column | None] = _nothing,
    labels: Sequence[str] = (),
    readings: Collection[str] = (),
    form: TableFormat = DEFAULT,
    read_by: str = "",
) -> Table:
    """Columns of a file with a header line, as float64 in the units of their names.

    The file is text (separated by commas, semicolons or tabs, with decimal points or commas, in
    UTF-8, UTF-16, Windows-1252 or Latin-1), a spreadsheet, or parquet; `form` says what cannot be
    seen from it. A column in another unit than that of the name, such as ``x_in`` or ``Range [m]``,
    or with a units row below the header, is converted; times of ISO 8601 become seconds from the
    first one.

    - `columns` are required and checked against their declarations.
    - `optional` gives the declaration of a column that may be missing.
    - `labels` are columns of text.
    - A further column is kept if it is numeric, that is, if more than half of its cells are numbers
      (then all must be numbers). It is ignored otherwise, as is an optional `sparse` column and a
      column without a name.
    - `base_name` is the name of the file in messages.

    A cell in a column of `readings` may be blank, that is, empty or NaN, where nothing was read.
    `Table.blank` marks these rows. The cell gets the number of the row before, or of the next row
    at the beginning, so that a look at the whole table finds plausible numbers. With an index
    column `read_by`, readings that are blank in all rows of an index are not part of these rows:
    they are NaN, and do not make the rows blank.

    Raises `StudyError` for a file that is missing, empty or truncated, for a column that is missing
    or repeated, for a cell that is not a finite number, not whole where it must be, or outside its
    range, for a repeated index, and for readings that are all blank.
    """
    grid = load_grid(path, base_name, form)
    asked = {*labels, *(column.name for column in columns)}
    found = assign(grid, asked, optional, Place())
    return table_of(
        grid,
        found,
        columns,
        optional=optional,
        labels=labels,
        readings=readings,
        clock=Clock(),
        read_by=read_by,
    )


def table_of(
    grid: Grid,
    assigned: Sequence[Assigned],
    columns: Sequence[Column],
    *,
    optional: Callable[[str], Column | None],
    labels: Sequence[str],
    readings: Collection[str],
    clock: Clock,
    read_by: str = "",
) -> Table:
    """The checked table of a grid whose columns are assigned; see `read_table`.

    `clock` is that of all tables of a study: instants of ISO 8601 count from its zero.
    """
    table = Table(grid.name, grid.lines, read=tuple(readings))
    table.kind, table.assigned = grid.kind, tuple(assigned)
    header = table.header
    asked = {column.name: column for column in columns}
    for name in (*labels, *asked):
        if name not in header:
            # A column that has a meaning of its own is not a misspelling of this one.
            free = [c for c in header if c not in asked and c not in labels and not optional(c)]
            if len(free) == len(header) and len(grid.lines) and not grid.has_numbers:
                raise no_table(table.name, grid.lines[0])
            raise _missing(table.name, name, header, free)
    unread: dict[str, np.ndarray] = {}
    if not grid.lines:
        raise refusal(table.name, "row 1", "no row below the header", "data", "add the rows")
    known = []
    for one in assigned:
        name, cells = one.column, cells_of(grid, one)
        if not name:  # separators at the ends of lines, or numbers without a meaning
            known.append(one)
            continue
        if name in labels:
            table[name] = np.array(
                [printable(c.strip().removesuffix(NO_NUMBER), lines=False) for c in cells.texts]
            )
            known.append(one)
            continue
        column = asked.get(name) or optional(name)
        values = values_of(cells, one, clock)
        if one.format and clock.text:
            one = dataclasses.replace(one, zero=clock.text)
        known.append(one)
        if name not in asked and (column is None or column.sparse):
            if 2 * int(np.isfinite(values).sum()) <= len(values):
                continue
        if name in readings:
            blank = cells.blank
            if blank.all():
                raise _nothing_read(table, name)
            for other in assigned:
                if read_by and other.column == read_by:
                    index = np.array([cell.strip() for cell in cells_of(grid, other).texts])
                    unread[name] = ~np.isin(index, index[~blank])
            table.blank |= blank & ~unread.get(name, np.zeros(len(blank), bool))
        else:
            blank = np.zeros(len(values), bool)
        table[name] = _checked(
            table, column or Column(name=name), cells, values, name in asked, blank, one, grid.form
        )
        if name in unread:
            table[name] = np.where(unread[name], np.nan, table[name])
        table[name].flags.writeable = False
    table.assigned = tuple(known)
    for column in columns:
        if column.unique_with:
            _check_unique(table, column)
    return table


def write_table(path: Path | str, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns of equal length as a CSV file.

    Numbers have ten significant digits, or as many as are needed to resolve the difference of
    neighbouring rows, such as times on a clock that started long ago. Raises `ValueError` where the
    lengths differ.
    """
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns of different lengths: found {lengths}, expected one length")
    with naming(path), open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*map(_written, columns.values()), strict=True))


def _written(values: np.ndarray) -> list[str]:
    """The cells of a column: numbers to `_OF_A_STEP` of the median difference of two rows."""
    values = np.asarray(values)
    if values.dtype.kind not in "biuf":
        return [v if isinstance(v, str) else f"{v:.{_DIGITS}g}" for v in values]
    values = values.astype(float)
    finite = values[np.isfinite(values)]
    sizes, steps = np.abs(finite), np.abs(np.diff(finite))
    # Differences at the level of rounding do not count as steps.
    steps = steps[steps > 4.0 * np.spacing(sizes.max(initial=0.0))]
    digits = _WHOLE_DIGITS
    if len(steps):
        digits = math.ceil(math.log10(sizes.max() / np.median(steps) / _OF_A_STEP))
    digits = max(digits, _DIGITS)
    if digits > _WHOLE_DIGITS:
        return [repr(float(v)) for v in values]  # the shortest text that reads back exactly
    return [f"{v:.{digits}g}" for v in values]


def _missing(file: str, name: str, header: Sequence[str], free: Sequence[str]) -> StudyError:
    do = "add the column"
    if similar := closest(name, free):
        do += f"; if {similar} holds this quantity, give it the name and the unit of {name}"
        do += f', or map it: [data.columns] {name} = {{ from = "{similar}", unit = "..." }}'
    elif len(header) > 1:
        do += f', or map one: [data.columns] {name} = {{ from = "...", unit = "..." }}'
    found = f"no such column among {listed(header)}"
    return refusal(file, f"column {name}", found, "a column of this name", do)


def _nothing_read(table: Table, column: str) -> StudyError:
    return refusal(
        table.name,
        f"{table.where(0)} to {table.where(table.rows - 1)}, column {column}",
        "an empty cell in every row",
        "a reading in most of them",
        "fill them in, or remove all columns of readings where nothing was measured yet",
    )


def _checked(
    table: Table,
    column: Column,
    cells: Cells,
    values: np.ndarray,
    needed: bool,
    blank: np.ndarray,
    one: Assigned,
    form: TableFormat,
) -> np.ndarray:
    # A file with ten digits may round a value at the bound to a number just beyond it.
    slack = 1e-9 * max((abs(b) for b in (column.low, column.high) if math.isfinite(b)), default=0)
    expected = _range(column)
    if blank.any():
        # A blank cell gets the number of the row before, or of the next one at the beginning.
        there = np.flatnonzero(~blank)
        before = np.searchsorted(there, np.arange(len(values)), side="right") - 1
        values = values[there[np.maximum(before, 0)]]
    low, high = column.low - slack, column.high + slack
    most = _MOST_WHOLE if column.integer else _MOST
    bad = np.zeros(len(values), bool)
    # NaN is the least and the largest value wherever there is one.
    least, largest = (values.min(), values.max()) if len(values) else (0.0, 0.0)
    if not (math.isfinite(least) and math.isfinite(largest)):
        bad = ~np.isfinite(values)
    elif column.integer and (values != np.round(values)).any():
        bad = values != np.round(values)
    elif len(values) and (least < low or largest > high):
        bad = (values < low) | (values > high)
    elif max(-least, largest) > most:
        bad = np.abs(values) > most
        expected = f"{expected}, no more than {most:g} in size"
    if bad.any():
        row = int(np.argmax(bad & ~blank))
        cell = cells.text(row).strip().removesuffix(NO_NUMBER)
        found, do = cell, "correct the value"
        if not math.isfinite(values[row]):
            # A reading or condition that was not recorded cannot be corrected.
            remove = "remove the row" if needed else "remove the row, or the column"
            do = f"{'correct the value' if cell else 'fill it in'}, or {remove}"
            marks = marks_of(cells.text(row), form)
            do += f"; {marks}" if marks else ""
            found = repr(cell) if cell else "an empty cell"
            expected = expected_cell(one) or expected
        elif one.converts:
            assert one.unit is not None or one.format
            unit = f" {one.unit.name}" if one.unit is not None else ""
            to = f" {one.to.name}" if one.to is not None else ""
            found = f"{cell}{unit} in {one.source!r}, that is {values[row]:.10g}{to}"
            do = "correct the value, or the unit of the column"
        elif units := _within(column, one, values[~blank]):
            do += (
                f"; or, if the column is in {' or '.join(units)}, say so in its name, or with unit "
                f'= "{units[0]}" in [data.columns]'
            )
        elif column.why:
            do += f": {column.why}"
        raise table.refusal(row, column.name, found, expected, do)
    return values


def _within(column: Column, one: Assigned, values: np.ndarray) -> list[str]:
    """Units in which all numbers of a column would be within its range; none of them in its own."""
    if one.to is None or not math.isfinite(column.low) or not math.isfinite(column.high):
        return []
    units = (unit_of_kind(name, one.to.kind) for name in known(one.to.kind))
    found = []
    for unit in units:
        if unit is None or unit in (one.to, DMS):
            continue
        other = unit.converted(values, one.to)
        if (other >= column.low).all() and (other <= column.high).all():
            found.append(unit.name)
    return found[:_MOST_UNITS]


def _range(column: Column) -> str:
    kind = "a whole number" if column.integer else "a number"
    low, high = math.isfinite(column.low), math.isfinite(column.high)
    if low and high:
        return f"{kind} from {column.low:.7g} to {column.high:.7g}"
    if low or high:
        return f"{kind} of at " + (f"least {column.low:.7g}" if low else f"most {column.high:.7g}")
    return kind


def _check_unique(table: Table, column: Column) -> None:
    names = list(dict.fromkeys((*column.unique_with, column.name)))
    index = np.column_stack([table[name] for name in names])
    order = np.lexsort(index.T[::-1])
    again = np.flatnonzero((np.diff(index[order], axis=0) == 0.0).all(axis=1))
    if not len(again):
        return
    # The sort is stable: of equal rows, the later one follows.
    row = int(order[again + 1].min())
    first = int(np.flatnonzero((index == index[row]).all(axis=1))[0])
    value = ", ".join(f"{n} {v:.10g}" for n, v in zip(names, index[row], strict=True))
    raise table.refusal(
        row,
        column.name,
        f"{value} again, first in row {first + 1}",
        f"every {' and '.join(names)} once",
        "correct the index or remove one of the rows",
    )
