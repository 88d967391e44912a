"""The text of an export: encoding, comment lines, header, units, cells and decimal mark."""

import codecs
import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import StudyError
from ..study.messages import refusal, shown
from .units import is_unit, unit_of

_LARGEST = 500_000_000
"""Largest file, bytes."""
COMMENTS = ("//", "#", "%", "!")
"""Beginnings of comment lines."""
_SIGN = r"[-+−]?"
_POINT = re.compile(rf"{_SIGN}(\d+(\.\d*)?|\.\d+)([eEdD][-+]?\d+)?")
_COMMA = re.compile(rf"{_SIGN}(\d+(,\d*)?|,\d+)([eEdD][-+]?\d+)?")
_THOUSANDS_POINT = re.compile(rf"{_SIGN}\d{{1,3}}([.' \u00a0\u202f]\d{{3}})+(,\d+)?")
_THOUSANDS_COMMA = re.compile(rf"{_SIGN}\d{{1,3}}([,' \u00a0\u202f]\d{{3}})+(\.\d+)?")
_PREAMBLE = re.compile(r"[^\d\W][^:=]{0,40}[:=].*")
_TWO_WORDS = re.compile(
    r"\b(point|pt|target|group|collection|date|time)[ \t]+(name|id|no|number|time|stamp)\b",
    re.IGNORECASE,
)
_TOKEN = re.compile(
    r'"[^"]*"|\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[ \t]+\d{1,2}:\d\d:\d\d\S*([ \t]+[AaPp][Mm]\b)?|\S+'
)
"""A text in quotes, a date with a time, or what stands between blanks."""


@dataclass(frozen=True)
class Export:
    """One file to import."""

    path: Path

    @property
    def name(self) -> str:
        """Name in messages."""
        return self.path.name

    @cached_property
    def data(self) -> bytes:
        """Its content. Raises `StudyError` for a missing, empty or huge file."""
        if not self.path.is_file():
            found = "a folder" if self.path.is_dir() else f"no such file in {self.path.parent}"
            raise refusal(self.name, "file", found, "an export to import", "correct the path")
        if not (size := self.path.stat().st_size) or size > _LARGEST:
            found = f"{size} bytes"
            raise refusal(self.name, "file", found, "an export of at most 500 MB", "name another")
        return self.path.read_bytes()

    @property
    def sha256(self) -> str:
        """Its hash, in hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    @cached_property
    def text(self) -> str | None:
        """Its content as text; None for a binary file.

        A byte order mark, or zeros in every other byte, give UTF-16. Otherwise the text is UTF-8
        or, where that is impossible, Windows-1252, which contains Latin-1.
        """
        data = self.data
        marks = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16"}
        marks[codecs.BOM_UTF16_BE] = "utf-16"
        coding = next((c for mark, c in marks.items() if data.startswith(mark)), None)
        if coding is None:
            even, odd = data[0:4000:2].count(0), data[1:4000:2].count(0)
            if max(even, odd) > 0.3 * min(len(data), 4000) / 2 and not min(even, odd):
                coding = "utf-16-le" if odd else "utf-16-be"
        for name in (coding,) if coding else ("utf-8", "cp1252"):
            try:
                text = data.decode(name)
            except UnicodeDecodeError:
                continue
            return None if "\0" in text else text
        return None

    @cached_property
    def table(self) -> "TextTable":
        """Its rows. Raises `StudyError` for a file that is no table of numbers."""
        return read_text(self.name, self.text)

    @cached_property
    def raw(self) -> tuple[list[str], list[tuple[int, list[str]]]]:
        """Comments, and the cells of every other line with its number; for tables with several
        rows of headers. Raises `StudyError` for a binary file.
        """
        comments, plain, split = split_text(self.name, self.text)
        return comments, [(i, split(line)) for i, line in plain]

    @cached_property
    def attempted(self) -> "TextTable | None":
        """Its rows, or None for a file that is no table: for sniffing."""
        try:
            return self.table
        except StudyError:
            return None


@dataclass(frozen=True)
class TextTable:
    """Rows of cells below comment lines and a header."""

    name: str
    """Name of the file in messages."""
    comments: list[str]
    """Comment lines, and lines above the table that are no header, without their marks."""
    header: list[str]
    """Name per column; empty where the file has none."""
    units: list[str]
    """Cell of a row of units per column; empty where the file has none."""
    lines: list[int]
    """Line of the file per row."""
    rows: list[list[str]]
    """Cells."""
    decimal: str
    """Decimal mark of the numbers: ``"."`` or ``","``."""
    _numbers: dict[int, np.ndarray] = field(default_factory=dict, compare=False)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.rows[0])

    def column(self, place: int) -> str:
        """Name of a column in messages."""
        return self.header[place] if self.header else f"{place + 1}"

    def cells(self, place: int) -> list[str]:
        """The cells of one column."""
        return [row[place] for row in self.rows]

    def numbers(self, place: int) -> np.ndarray:
        """The numbers of one column; raises `StudyError` for a cell that is none."""
        if place not in self._numbers:
            cells = self.cells(place)
            values = np.array([number(cell, self.decimal) for cell in cells])
            if (bad := ~np.isfinite(values)).any():
                row = int(np.argmax(bad))
                raise refusal(
                    self.name,
                    f"line {self.lines[row]}, column {self.column(place)}",
                    repr(cells[row]) if cells[row] else "an empty cell",
                    "a number",
                    "correct the value or remove the line",
                )
            self._numbers[place] = values
        return self._numbers[place]

    def is_numeric(self, place: int) -> bool:
        """Whether all cells of a column are numbers."""
        return all(math.isfinite(number(cell, self.decimal)) for cell in self.cells(place))


def number(cell: str, decimal: str = ".") -> float:
    """The number in a cell with that decimal mark; NaN for anything else.

    Thousands may be separated by the other mark, an apostrophe or a space.
    """
    text = cell.strip()
    # Most cells are numbers as Python writes them, apart from the decimal mark.
    if decimal == "." or "." not in text:
        try:
            value = float(text if decimal == "." else text.replace(",", ".", 1))
        except ValueError:
            value = math.nan
        if math.isfinite(value) and "_" not in text and ("," not in text or decimal == ","):
            return value
    plain, thousands = (_POINT, _THOUSANDS_COMMA) if decimal == "." else (_COMMA, _THOUSANDS_POINT)
    if not plain.fullmatch(text):
        if not thousands.fullmatch(text):
            return math.nan
        text = re.sub(r"[' \u00a0\u202f]|" + ("," if decimal == "." else r"\."), "", text)
    text = text.replace("−", "-").replace(decimal, ".")
    return float(re.sub("[dD]", "e", text))


def decimal_of(cells: Sequence[str]) -> str | None:
    """The decimal mark of numbers in cells; None where both occur."""
    point = comma = False
    for cell in cells:
        text = cell.strip()
        if "," in text:
            comma |= math.isnan(number(text, ".")) and not math.isnan(number(text, ","))
        elif not point and "." in text:
            point = not math.isnan(number(text, ".")) and math.isnan(number(text, ","))
    # A dot that could part thousands is a decimal point unless a decimal comma says otherwise.
    return None if point and comma else "," if comma else "."


def read_text(name: str, text: str | None, fewest: int = 2) -> TextTable:
    """The rows of a text: lines of which at least `fewest` cells are numbers, below the last line
    of names.

    Raises `StudyError` for a binary file, for a file without such rows, for rows of different
    length, and for numbers with decimal points and decimal commas.
    """
    comments, plain, split = split_text(name, text)
    cells = [(i, split(line)) for i, line in plain]
    first = next((k for k, (_, row) in enumerate(cells) if _is_row(row, fewest)), None)
    if first is None:
        raise refusal(
            name,
            "file",
            "no row of numbers",
            f"rows with {fewest} numbers or more, separated by commas, semicolons, tabs or blanks",
            "correct the file, or name another",
        )
    body = cells[first:]
    above = plain[:first]
    width = len(body[0][1])
    units: list[str] = []
    header: list[str] = []
    if above and _is_units(split(above[-1][1])):
        units = split(above[-1][1])
        above = above[:-1]
    if above and not (_PREAMBLE.fullmatch(above[-1][1]) and len(split(above[-1][1])) != width):
        header = _header(above[-1][1], split, width)
        above = above[:-1]
    if not header:
        # A header may stand in the last comment lines.
        for k in reversed(range(len(comments))):
            tried = _header(comments[k], split, width)
            if len(tried) == width and all(map(_is_name, tried)):
                header = tried
                del comments[k]
                break
    for k, (line, row) in enumerate(body):
        if len(row) != width:
            raise refusal(
                name,
                f"line {line}",
                f"{len(row)} cells ({shown(' '.join(row))})"
                + (" at the end: is the file cut off?" if k == len(body) - 1 else ""),
                f"{width}, as in line {body[0][0]}",
                "complete the line, or remove it",
            )
    if header and len(header) != width:
        raise refusal(
            name,
            "header",
            f"{len(header)} names ({shown(', '.join(header))})",
            f"{width}, one per column of line {body[0][0]}",
            "correct the header; put names with blanks in quotes",
        )
    if units and len(units) != width:
        units = []
    decimal = decimal_of([cell for _, row in body for cell in row])
    if decimal is None:
        raise refusal(
            name,
            "file",
            "numbers with decimal points and others with decimal commas",
            "one decimal mark in the whole file",
            "correct the numbers",
        )
    above_lines = [line for _, line in above]
    rows = [row for _, row in body]
    return TextTable(
        name, [*comments, *above_lines], header, units, [i for i, _ in body], rows, decimal
    )


def split_text(
    name: str, text: str | None
) -> tuple[list[str], list[tuple[int, str]], Callable[[str], list[str]]]:
    """Comment lines without their marks, all other lines that hold something, with their numbers,
    and the function that splits such a line into cells. Raises `StudyError` for a binary file.
    """
    if text is None:
        raise refusal(
            name,
            "file",
            "a binary file",
            "a text export",
            "export it as text from the program that wrote it",
        )
    parts = enumerate(re.split(r"\r\n|\r|\n", text), 1)
    lines = [(i, line.strip("\ufeff \x1a")) for i, line in parts]
    lines = [(i, line) for i, line in lines if line.strip("\t ,;")]
    comments = [line.lstrip("/#%! \t") for _, line in lines if line.startswith(COMMENTS)]
    plain = [(i, line) for i, line in lines if not line.startswith(COMMENTS)]
    split = _splitter([line for _, line in plain])
    return comments, plain, split


def _splitter(lines: Sequence[str]) -> Callable[[str], list[str]]:
    """The function that splits a line into cells, by the separator that the lines have."""
    sample = lines[:2000]
    # The end of a file is its table; what stands above it may be text.
    tail = sample[len(sample) // 3 :] or sample
    for mark in "\t;":
        if tail and sum(mark in line for line in tail) > 0.5 * len(tail):
            return lambda line: _csv(line, mark)
    if tail and sum("," in line for line in tail) > 0.5 * len(tail):
        for line in tail:
            tokens = _blanks(line)
            commas = [token for token in tokens if "," in token]
            if len(tokens) < 2 or not all(_COMMA.fullmatch(token) for token in commas):
                return lambda line: _csv(line, ",")
    return _blanks


def _csv(line: str, mark: str) -> list[str]:
    found = _quoted(line, mark) if '"' in line else line.split(mark)
    cells = [cell.strip() for cell in found]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _quoted(line: str, mark: str) -> list[str]:
    """The cells of a line with texts in quotes."""
    try:
        return next(csv.reader(io.StringIO(line), delimiter=mark), [])
    except csv.Error:  # a cell of more than 100 000 characters
        return line.split(mark)


def _blanks(line: str) -> list[str]:
    return [found[0].strip('"') for found in _TOKEN.finditer(line)]


def _header(line: str, split: Callable[[str], list[str]], width: int) -> list[str]:
    """The names in a line: units in brackets belong to the name in front of them."""
    found = split(line)
    if split is not _blanks:
        return found + [""] * (width - len(found))
    joined: list[str] = []
    depth = 0
    for token in _blanks(_TWO_WORDS.sub(lambda m: f"{m[1]}_{m[2]}", line)):
        if joined and (depth > 0 or token[0] in "[("):
            joined[-1] += f" {token}"
        else:
            joined.append(token)
        depth += sum(token.count(c) for c in "[(") - sum(token.count(c) for c in "])")
    return joined


def _is_row(cells: Sequence[str], fewest: int) -> bool:
    found = sum(
        math.isfinite(number(cell, ".")) or math.isfinite(number(cell, ",")) for cell in cells
    )
    return found >= fewest and 2 * found >= len(cells)


def _is_units(cells: Sequence[str]) -> bool:
    """Whether a row holds units: symbols in more than half of the cells, and no other words."""
    there = [cell for cell in cells if cell]
    known = sum(map(is_unit, there))
    return known > 0 and 2 * known > len(there) and any(map(unit_of, there))


def _is_name(cell: str) -> bool:
    return not math.isfinite(number(cell, ".")) and re.search(r"[^\W\d]", cell) is not None
