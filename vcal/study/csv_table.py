"""Tables in CSV files, checked cell by cell."""

import csv
import io
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..errors import StudyError
from ..instruments.base import Column
from ..registry import closest
from .messages import listed, refusal, shown

_PREAMBLE = re.compile(r'#.*|"?sep=."?', re.IGNORECASE)
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}
"""Separators of cells with their names; the first one that occurs in the header is used."""
_MOST_WHOLE, _MOST = 1e9, 1e15
"""Largest size of an index, and of a quantity in a column without bounds of its own."""
_DIGITS, _WHOLE_DIGITS = 10, 15
"""Least number of digits to write, and the number that every decimal number keeps in float64."""
_OF_A_STEP = 1e-7


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
        self.lines = tuple(lines)
        """Line of the file per data row."""
        self.numbers = tuple(numbers) or tuple(range(1, len(self.lines) + 1))
        """Number per data row, from 1, as the file counts them."""
        self.read = frozenset(read)
        """Columns of readings, in which cells may be blank."""
        self.blank = np.zeros(len(self.lines), bool)
        """Rows with a blank reading; the cell holds the value of a neighbouring row."""

    @property
    def rows(self) -> int:
        """Number of data rows."""
        return len(self.lines)

    @property
    def complete(self) -> "Table":
        """The rows without a blank reading."""
        if not self.blank.any():
            return self
        rows = np.flatnonzero(~self.blank)
        lines, numbers = ([of[row] for row in rows] for of in (self.lines, self.numbers))
        found = Table(self.name, lines, numbers, tuple(self.read))
        found.update({name: values[rows] for name, values in self.items()})
        return found

    @property
    def blank_rows(self) -> tuple[int, ...]:
        """Numbers of the rows with a blank reading."""
        return tuple(self.numbers[row] for row in np.flatnonzero(self.blank))

    def where(self, row: int) -> str:
        """Number and line in the file of a row, which counts from 0."""
        return f"row {self.numbers[row]} (line {self.lines[row]})"

    def refusal(self, row: int, column: str, found: str, expected: str, do: str) -> StudyError:
        """The error to raise for one cell; `row` counts from 0."""
        return refusal(self.name, f"{self.where(row)}, column {column}", found, expected, do)


def _nothing(name: str) -> Column | None:
    del name
    return None


def read_header(path: Path | str, base_name: str | None = None) -> tuple[str, ...]:
    """Names of the columns of a CSV file; raises `StudyError` as `read_table` does."""
    name = base_name or Path(path).name
    return _cells(Path(path), name)[0]


def read_table(
    path: Path | str,
    columns: Sequence[Column],
    base_name: str | None = None,
    *,
    optional: Callable[[str], Column | None] = _nothing,
    labels: Sequence[str] = (),
    readings: Collection[str] = (),
    read_by: str = "",
) -> Table:
    """Columns of a CSV file with a header line, as float64 in the units of the file.

    Cells are separated by commas. Where the header has no comma, they are separated by semicolons
    or tabs, and numbers may have a decimal comma, as spreadsheets of many countries write them.

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
    path = Path(path)
    header, lines, rows = _cells(path, base_name or path.name)
    table = Table(base_name or path.name, lines, read=tuple(readings))
    asked = {column.name: column for column in columns}
    for name in (*labels, *asked):
        if name not in header:
            # A column that has a meaning of its own is not a misspelling of this one.
            free = [c for c in header if c not in asked and c not in labels and not optional(c)]
            raise _missing(table.name, name, header, free)
    unread: dict[str, np.ndarray] = {}
    if not rows:
        raise refusal(table.name, "row 1", "no row below the header", "data", "add the rows")
    for place, name in enumerate(header):
        if not name:  # separators at the ends of lines, or numbers without a meaning
            continue
        cells = [row[place] for row in rows]
        if name in labels:
            table[name] = np.array([cell.strip() for cell in cells])
            continue
        column = asked.get(name) or optional(name)
        if name not in asked and (column is None or column.sparse):
            numbers = sum(math.isfinite(_number(cell)) for cell in cells)
            if 2 * numbers <= len(cells):
                continue
        blank = np.array([name in readings and _is_blank(cell) for cell in cells])
        if blank.all():
            raise _nothing_read(table, name)
        if read_by and blank.any() and read_by in header:
            index = [row[header.index(read_by)].strip() for row in rows]
            filled = {own for own, empty in zip(index, blank, strict=True) if not empty}
            unread[name] = np.array([own not in filled for own in index])
        table.blank |= blank & ~unread.get(name, np.zeros(len(rows), bool))
        table[name] = _checked(table, column or Column(name=name), cells, name in asked, blank)
        if name in unread:
            table[name] = np.where(unread[name], np.nan, table[name])
        table[name].flags.writeable = False
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
    with open(path, "w", encoding="utf-8", newline="") as file:
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


def _cells(path: Path, name: str) -> tuple[tuple[str, ...], list[int], list[list[str]]]:
    """Header, line number per data row and cells per data row, each row as long as the header."""
    if not path.is_file():
        raise refusal(
            name,
            "file",
            f"no such file in {path.parent}",
            "a CSV table with a header line",
            "add the file or correct its name",
        )
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            text = _without_preamble(file.read())
        mark = _separator(text)
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=mark)
        found = [(reader.line_num, row) for row in reader if any(c.strip() for c in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise refusal(
            name,
            "file",
            f"unreadable text ({error})",
            "a CSV table in UTF-8",
            "save it in UTF-8",
        ) from error
    if not found:
        raise refusal(name, "file", "nothing in it", "a header line and rows", "write the table")
    (line, cells), *rows = found
    # In a file with decimal points, a comma would separate thousands.
    if mark != "," and not any("." in c and math.isfinite(_number(c)) for _, r in rows for c in r):
        rows = [(number, [_decimal_point(cell) for cell in row]) for number, row in rows]
    header = tuple(cell.strip() for cell in cells)
    if len(header) == 1 and re.search(r"\w[\s|:]+\w", header[0]):
        raise refusal(
            name,
            f"header (line {line})",
            f"one name, {shown(header[0])}",
            f"several, separated by {' or '.join(SEPARATORS.values())}",
            "save the table with one of these separators",
        )
    for column in header:
        if column and header.count(column) > 1:
            places = [str(i + 1) for i, c in enumerate(header) if c == column]
            raise refusal(
                name,
                f"header (line {line}), column {column}",
                f"it {len(places)} times (places {', '.join(places)})",
                "every name once",
                "rename or remove one of them",
            )
    for number, (line, row) in enumerate(rows, start=1):
        if len(row) != len(header):
            last = " (the last row: is the file cut off?)" if number == len(rows) else ""
            raise refusal(
                name,
                f"row {number} (line {line}), column "
                + (header[len(row)] if len(row) < len(header) else "after the last one"),
                f"{len(row)} cells{last}",
                f"{len(header)} as in the header, separated by {SEPARATORS[mark]}",
                "complete the row or remove it"
                + (
                    "; numbers with decimal commas need semicolons between the columns"
                    if mark == "," and len(row) > len(header)
                    else ""
                ),
            )
    return header, [line for line, _ in rows], [row for _, row in rows]


def _without_preamble(text: str) -> str:
    """The text with empty lines in place of a preamble: ``sep=;``, as spreadsheets write it, and
    ``# comments``.
    """
    lines = text.splitlines(keepends=True)
    for i, line in enumerate(lines):
        if not (_PREAMBLE.fullmatch(line.strip()) or not line.strip()):
            break
        lines[i] = "\n"
    return "".join(lines)


def _separator(text: str) -> str:
    """The separator of the cells: a comma, or another one of `SEPARATORS` in the header."""
    header = next((line for line in text.splitlines() if line.strip()), "")
    return next((mark for mark in SEPARATORS if mark in header), ",")


def _decimal_point(cell: str) -> str:
    """The cell with a decimal point in place of a single decimal comma, where that is a number."""
    point = cell.replace(",", ".", 1)
    return cell if math.isnan(_number(point)) else point


def _missing(file: str, name: str, header: Sequence[str], free: Sequence[str]) -> StudyError:
    do = "add the column"
    if similar := closest(name, free):
        do += f"; if {similar} holds this quantity, give it the name and the unit of {name}"
    found = f"no such column among {listed(header)}"
    return refusal(file, f"column {name}", found, "a column of this name", do)


def _number(cell: str) -> float:
    """The number in a cell; NaN for anything else."""
    try:
        return math.nan if "_" in cell else float(cell)
    except ValueError:
        return math.nan


def _is_blank(cell: str) -> bool:
    """Whether a cell is empty or NaN, as spreadsheets and programs mark a missing reading."""
    return cell.strip().lower() in ("", "nan")


def _nothing_read(table: Table, column: str) -> StudyError:
    return refusal(
        table.name,
        f"{table.where(0)} to {table.where(table.rows - 1)}, column {column}",
        "an empty cell in every row",
        "a reading in most of them",
        "fill them in, or remove all columns of readings where nothing was measured yet",
    )


def _checked(
    table: Table, column: Column, cells: Sequence[str], needed: bool, blank: np.ndarray
) -> np.ndarray:
    values = np.array([_number(cell) for cell in cells])
    # A file with ten digits may round a value at the bound to a number just beyond it.
    slack = 1e-9 * max((abs(b) for b in (column.low, column.high) if math.isfinite(b)), default=0)
    expected = _range(column)
    # A blank cell gets the number of the row before, or of the next one at the beginning.
    there = np.flatnonzero(~blank)
    before = np.searchsorted(there, np.arange(len(values)), side="right") - 1
    values = values[there[np.maximum(before, 0)]]
    bad = ~np.isfinite(values)
    if not bad.any() and column.integer:
        bad = values != np.round(values)
    if not bad.any():
        bad = (values < column.low - slack) | (values > column.high + slack)
    if not bad.any():
        most = _MOST_WHOLE if column.integer else _MOST
        bad = np.abs(values) > most
        expected = f"{expected}, no more than {most:g} in size"
    if bad.any():
        row = int(np.argmax(bad & ~blank))
        found, do = cells[row].strip(), "correct the value"
        if not math.isfinite(values[row]):
            # A reading or condition that was not recorded cannot be corrected.
            remove = "remove the row" if needed else "remove the row, or the column"
            do = f"{'correct the value' if found else 'fill it in'}, or {remove}"
            found = repr(found) if found else "an empty cell"
        raise table.refusal(row, column.name, found, expected, do)
    return values


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
    first: dict[tuple[float, ...], int] = {}
    for row, index in enumerate(zip(*(table[name] for name in names), strict=True)):
        if index in first:
            value = ", ".join(f"{n} {v:.10g}" for n, v in zip(names, index, strict=True))
            raise table.refusal(
                row,
                column.name,
                f"{value} again, first in row {first[index] + 1}",
                f"every {' and '.join(names)} once",
                "correct the index or remove one of the rows",
            )
        first[index] = row
