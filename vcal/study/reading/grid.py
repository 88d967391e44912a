"""A file as a grid of cells: the names in its header, and the cells of every column."""

import collections
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...errors import StudyError
from ...words import printable
from ..messages import refusal, shown
from .formats import TableFormat
from .units import is_unit_cell, units_of

_MINUS = str.maketrans({"−": "-", "–": "-", "\u00a0": "", "\u202f": "", "\u2009": ""})
_BLANKS = " \u00a0\u202f\u2009"
_GROUPED = re.compile(r"[+-]?\d{1,3}([.,' \u00a0\u202f\u2009])\d{3}(\1\d{3})*([.,]\d+)?")
_AMBIGUOUS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
NO_NUMBER = "\u200b"
"""End of a cell that is no number for its marks, such as 1.5 where decimal commas are declared. It
is not shown."""
_FEWEST_AMBIGUOUS = 3
"""Least number of cells such as 1,234 that make the meaning of the comma unclear."""
_TITLES = 40
"""Most lines above a header that are looked at."""


def number(cell: str) -> float:
    """The number in a cell; NaN for anything else."""
    try:
        return math.nan if "_" in cell else float(cell)
    except ValueError:
        return math.nan


class Cells:
    """The cells of a column, as texts or as numbers."""

    def __init__(self, texts: Sequence[str] | None = None, values: np.ndarray | None = None):
        self._texts, self._values = texts, values

    def __len__(self) -> int:
        of = self._values if self._texts is None else self._texts
        return 0 if of is None else len(of)

    @cached_property
    def values(self) -> np.ndarray:
        """The cells as numbers (n,); NaN for a cell that is none."""
        if self._values is not None:
            return np.asarray(self._values, float)
        texts = self.texts
        try:
            if "_" not in "".join(texts):
                return np.fromiter(map(float, texts), float, len(texts))
        except ValueError:
            pass
        return np.fromiter(map(number, texts), float, len(texts))

    @cached_property
    def texts(self) -> Sequence[str]:
        """The cells as texts, of numbers as few digits as needed."""
        if self._texts is not None:
            return self._texts
        return [self.text(row) for row in range(len(self))]

    def first(self, count: int) -> list[str]:
        """The texts of the first cells, at most `count`."""
        return [self.text(row) for row in range(min(count, len(self)))]

    def text(self, row: int) -> str:
        """The text of one cell, whose row counts from 0."""
        if self._texts is not None:
            return self._texts[row]
        value = float(self.values[row])
        return f"{value:.0f}" if value.is_integer() and abs(value) < 1e15 else repr(value)

    @property
    def blank(self) -> np.ndarray:
        """Which cells are empty or NaN (n,), as programs mark a missing reading."""
        if self._texts is None:
            return np.isnan(self.values)
        return np.array([cell.strip().lower() in ("", "nan") for cell in self._texts])


@dataclass
class Grid:
    """The cells of one table of a file."""

    name: str
    """Name of the file in messages."""
    kind: str
    """What the file is and how it was read, in words."""
    names: tuple[str, ...]
    """The cells of the header; empty for a column without a name."""
    columns: Sequence[Cells]
    lines: Sequence[int]
    """Line of the file per data row, from 1."""
    units: tuple[str, ...] = ()
    """The cells of the units row; none without one."""
    form: TableFormat = field(default_factory=TableFormat)

    @property
    def has_numbers(self) -> bool:
        """Whether one of the first rows holds mostly numbers, as those of a table do."""
        first = [column.first(_TITLES) for column in self.columns]
        return any(_are_numbers(row) for row in zip(*first, strict=True))

    def __post_init__(self) -> None:
        # Names of a stranger's file go to the terminal, to pages and to pictures.
        self.names = tuple(printable(name, lines=False) for name in self.names)

    def unit(self, place: int) -> str:
        """The unit of a column in the units row; empty without one."""
        text = self.units[place] if self.units else ""
        return "" if is_unit_cell(text) else text


def grid_of_rows(
    name: str, kind: str, rows: list[tuple[int, list[str]]], form: TableFormat, mark: str
) -> Grid:
    """The grid of rows of cells with their lines, of which the first one is the header.

    `mark` names the separators for messages; it is empty for a spreadsheet. Raises `StudyError` for
    an empty table, for a header of another length than the rows, and for a repeated name.
    """
    if not rows:
        raise refusal(name, "file", "nothing in it", "a header line and rows", "write the table")
    if form.header_row == 0:
        width = collections.Counter(len(cells) for _, cells in rows).most_common(1)[0][0]
        header: tuple[str, ...] = ("",) * width
    else:
        (line, cells), *rows = rows
        header = tuple(" ".join(cell.split()) for cell in cells)
        _check_header(name, header, line, rows, mark)
    _check_lengths(name, header, rows, mark, form)
    units: tuple[str, ...] = ()
    if rows and form.header_row != 0 and _are_units(rows[0][1]):
        units = tuple(cell.strip() for cell in rows[0][1])
        del rows[0]
    lines = [line for line, _ in rows]
    columns = [*zip(*(row for _, row in rows), strict=True)] or [()] * len(header)
    columns, marks = _with_points(name, lines, columns, header, form, mark)
    kind += marks + (", units row" if units else "")
    return Grid(name, kind, header, [Cells(texts) for texts in columns], lines, units, form)


def _check_header(
    name: str, header: tuple[str, ...], line: int, rows: Sequence[tuple[int, list[str]]], mark: str
) -> None:
    if not any(_are_numbers(re.split(r"[\s|:]+", " ".join(cells))) for _, cells in rows[:_TITLES]):
        if len(header) == 1 and re.search(r"\w[\s|:]+\w", header[0]):
            raise no_table(name, line)
    below = _named_below(header, rows)
    if below:
        raise refusal(
            name,
            f"header (line {line})",
            f"{shown(' '.join(cell for cell in header if cell))}, which is a title above the table",
            f"the names of the columns, as they seem to be in line {below}",
            f"set header_row = {below} in the table of the study file that names this file, or "
            "remove the lines above",
        )
    if len(header) == 1 and re.search(r"\w[\s|:]+\w", header[0]):
        raise refusal(
            name,
            f"header (line {line})",
            f"one name, {shown(header[0])}",
            "several, separated by commas or semicolons or tabs",
            "save the table with one of these separators, or declare another one as delimiter: a "
            'character such as "|", " " for blanks, or "fixed" for columns of fixed width',
        )
    filled = [cell for cell in header if cell]
    if rows and len(filled) > 1 and all(math.isfinite(number(c.translate(_MINUS))) for c in filled):
        raise refusal(
            name,
            f"header (line {line})",
            f"numbers ({shown(', '.join(filled))})",
            "the names of the columns",
            "add a header line; or set header_row = 0 and give the number of every column in "
            "[data.columns], such as x_mm = { from = 1 }",
        )
    often = collections.Counter(header)
    for column in header:
        if column and often[column] > 1:
            places = [str(i + 1) for i, c in enumerate(header) if c == column]
            raise refusal(
                name,
                f"header (line {line}), column {column}",
                f"it {len(places)} times (places {', '.join(places)})",
                "every name once",
                "rename or remove one of them",
            )


def no_table(name: str, line: int) -> StudyError:
    """The error for a file of text that is no table. It shows none of its contents: the file may
    be another one than was meant, and a message may be passed on.
    """
    return refusal(
        name,
        f"line {line}",
        "text without columns of numbers",
        "a CSV table with a header line",
        "correct the name of the file, or save it as a table",
    )


def _are_numbers(cells: Sequence[str]) -> bool:
    """Whether more than half of the filled cells are numbers, with any decimal mark."""
    filled = [cell for cell in cells if cell.strip()]
    return 2 * sum(math.isfinite(_loose(cell)) for cell in filled) > len(filled)


def _named_below(header: Sequence[str], rows: Sequence[tuple[int, list[str]]]) -> int:
    """The line of a header below one or more titles; 0 where the first line is the header.

    A title has fewer cells than the rows of numbers, above which a line has a text in every column.
    """
    filled = sum(1 for cell in header if cell)
    for k, (_, cells) in enumerate(rows[:_TITLES]):
        there = [cell for cell in cells if cell.strip()]
        if len(there) > 1 and sum(math.isfinite(_loose(c)) for c in there) > len(there) / 2:
            above = [r for r in rows[:k] if not _are_units(r[1])]
            wide = [r for r in above if sum(1 for c in r[1] if c.strip()) >= len(there)]
            return wide[-1][0] if wide and filled < len(there) else 0
    return 0


def _loose(cell: str) -> float:
    """The number in a cell with any decimal mark."""
    return number(cell.translate(_MINUS).replace(",", ".", 1))


def _check_lengths(
    name: str,
    header: Sequence[str],
    rows: Sequence[tuple[int, list[str]]],
    mark: str,
    form: TableFormat,
) -> None:
    if {len(row) for _, row in rows} <= {len(header)}:
        return
    if not any(_are_numbers(cells) for _, cells in rows[:_TITLES]):
        raise no_table(name, rows[0][0])
    for count, (line, row) in enumerate(rows, start=1):
        if len(row) == len(header):
            continue
        last = " (the last row: is the file cut off?)" if count == len(rows) else ""
        place = header[len(row)] if len(row) < len(header) else "after the last one"
        more = ""
        if mark == "commas" and len(row) > len(header):
            more = (
                "; numbers with decimal commas need semicolons between the columns, or quotation "
                "marks"
            )
        raise refusal(
            name,
            f"row {count} (line {line}), column {place}",
            f"{len(row)} cells{last}",
            f"{len(header)} as in the header" + (f", separated by {mark}" if mark else ""),
            f"complete the row or remove it{more}",
        )


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a row is one of units: no number in it, and units in half of the filled cells."""
    filled = [cell.strip() for cell in cells if not is_unit_cell(cell)]
    known = sum(1 for cell in filled if units_of(cell))
    return 2 * known >= max(len(filled), 1) and not any(
        math.isfinite(_loose(cell)) for cell in filled
    )


def _with_points(
    name: str,
    lines: Sequence[int],
    columns: Sequence[Sequence[str]],
    header: Sequence[str],
    form: TableFormat,
    mark: str,
) -> tuple[Sequence[Sequence[str]], str]:
    """The columns with a decimal point in every number and without separators of thousands; and the
    marks in words.
    """
    decimal, thousands = form.decimal, form.thousands
    if decimal is not None or thousands is not None:
        if decimal is None:
            decimal = "," if thousands == "." or (thousands != "," and _commas(columns)) else "."
        words = f", decimal {'comma' if decimal == ',' else 'point'}"
        words += f", thousands separated by {thousands!r}" if thousands is not None else ""
        return [[_declared(cell, decimal, thousands) for cell in c] for c in columns], words
    columns = [c if "".join(c).isascii() else [_ascii(cell) for cell in c] for c in columns]
    with_commas = [k for k, c in enumerate(columns) if "," in "".join(c)]
    if mark == "commas" or not with_commas:
        return columns, ""
    if any("." in cell and math.isfinite(number(cell)) for c in columns for cell in c):
        return columns, ""
    commas = [(k, i) for k in with_commas for i, cell in enumerate(columns[k]) if _is_comma(cell)]
    if not commas:
        return columns, ""
    if len(commas) >= _FEWEST_AMBIGUOUS and all(
        _AMBIGUOUS.fullmatch(columns[k][i].strip()) for k, i in commas
    ):
        k, i = commas[0]
        raise refusal(
            name,
            f"row {i + 1} (line {lines[i]}), column {header[k] or k + 1}",
            f"{columns[k][i].strip()!r}, and commas only before three digits in all numbers",
            "commas that are clearly decimal commas or separators of thousands",
            'declare decimal = "," or thousands = "," in the table of the study file that names '
            "this file",
        )
    return [
        [_decimal_point(cell) if "," in cell else cell for cell in c] if k in with_commas else c
        for k, c in enumerate(columns)
    ], ", decimal comma"


def _is_comma(cell: str) -> bool:
    """Whether a cell is a number with a decimal comma, or with separators of thousands."""
    return "," in cell and bool(_COMMA.fullmatch(cell.strip()) or _AMBIGUOUS.fullmatch(cell))


def _commas(columns: Sequence[Sequence[str]]) -> bool:
    """Whether commas are decimal marks, in a table without decimal points."""
    points = any("." in c and re.search(r"\d\.\d", c) for column in columns for c in column)
    return not points and any(re.search(r"\d,\d", c) for column in columns for c in column)


def _ascii(cell: str) -> str:
    """A number with the signs of ASCII; other texts unchanged."""
    plain = cell.translate(_MINUS)
    return plain if math.isfinite(_loose(plain)) else cell


def _declared(cell: str, decimal: str, thousands: str | None) -> str:
    """The cell with a decimal point, where it is a number with the declared marks."""
    found = cell.strip()
    if thousands is not None:
        marks = _BLANKS if thousands == " " else "'’" if thousands == "'" else thousands
        grouped = rf"[+\-−]?\d{{1,3}}(?:[{re.escape(marks)}]\d{{3}})+(?!\d)"
        if match := re.match(grouped, found):
            found = re.sub(f"[{re.escape(marks)}]", "", match[0]) + found[match.end() :]
    found = found.translate(_MINUS)
    if decimal == ",":
        if "." in found and math.isfinite(number(found)):
            return found + NO_NUMBER
        found = found.replace(",", ".", 1)
    return found if math.isfinite(number(found)) else cell


def _decimal_point(cell: str) -> str:
    """The cell with a decimal point in place of a single decimal comma, where that is a number."""
    point = cell.replace(",", ".", 1)
    return cell if math.isnan(number(point)) else point


def marks_of(cell: str, form: TableFormat) -> str:
    """What to do about a cell that is a number with other marks; empty for other texts."""
    cell = cell.strip()
    if cell.endswith(NO_NUMBER):
        return "write it with a decimal comma as declared, or correct decimal or thousands"
    if match := _GROUPED.fullmatch(cell):
        mark = match[1] if match[1] in ".,'" else " "
        if not match[3] and mark in ".,":
            other = ',"' if mark == "," else '."'
            return f'declare thousands = "{mark}", or decimal = "{other} if that is what it is'
        decimal = f' and decimal = "{match[3][0]}"' if match[3] and match[3][0] != mark else ""
        return f'declare thousands = "{mark}"{decimal}'
    if _COMMA.fullmatch(cell):
        return "write all numbers with the same decimal mark" + (
            "" if form.decimal else ', or declare decimal = ","'
        )
    return ""


def unreadable(name: str, why: str, do: str = "save it in UTF-8") -> StudyError:
    """The error for a file that cannot be decoded."""
    return refusal(name, "file", f"unreadable text ({why})", "a table of text in UTF-8", do)
