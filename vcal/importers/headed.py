"""Tables with one or several rows of headers and a column per run, as standards print them."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..study.messages import refusal
from .base import Machine, Needs
from .export import Export, decimal_of, number

_UP = (
    "↑",
    "⇑",
    "+",
    "up",
    "pos",
    "positive",
    "forward",
    "fwd",
    "forwards",
    "increasing",
    "ccw",
    "counterclockwise",
    "counter-clockwise",
    "anticlockwise",
    "anti-clockwise",
)
_DOWN = (
    *("↓", "⇓", "-", "−", "–", "down", "neg", "negative", "reverse", "rev", "backward", "bwd"),
    *("backwards", "return", "decreasing", "cw", "clockwise"),
)
SNIFFED = 400
"""Lines that suffice to recognise a format."""
_HEAD = 200
"""Lines at the beginning of a file among which the headers are."""
_ARROWS = "↑⇑↓⇓+−–"


@dataclass(frozen=True)
class Headed:
    """The numbers of a table, with the texts above every column."""

    name: str
    """Name of the file in messages."""
    comments: list[str]
    """Comment lines, and lines above the table."""
    titles: list[str]
    """The cells above every column, joined."""
    lines: list[int]
    """Line of the file per row."""
    values: np.ndarray
    """Numbers; NaN where a cell is blank or text."""
    texts: list[list[str]]
    """Cells."""


def read_headed(export: Export, most: int | None = None, fewest: int = 2) -> Headed:
    """The table of an export whose headers may stand in several rows.

    The headers end with the last row that names a direction (an arrow, ``+``, ``forward``, ...), or
    with the row above the first row of numbers. A row whose first cell is a word, such as a mean
    below the table, is left out. With `most`, only that many lines are read. Raises `StudyError`
    for a file without such a table.
    """
    comments, rows = export.raw
    rows = rows[:most]
    decimal = decimal_of([cell for _, row in rows for cell in row]) or "."
    width = max((len(row) for _, row in rows), default=0)
    rows = [(line, [*row, *[""] * (width - len(row))]) for line, row in rows]
    numbers = [[number(cell, decimal) for cell in row] for _, row in rows]
    directed = [
        k
        for k, (_, row) in enumerate(rows[:_HEAD])
        if sum(direction(cell) is not None for cell in row) >= 2
        and not sum(map(math.isfinite, numbers[k])) > 0.5 * len(row)
    ]
    body = [
        k
        for k in range(len(rows))
        if sum(map(math.isfinite, numbers[k])) >= fewest
        and (not directed or k > directed[0])
        and not re.match(r"[^\W\d]", rows[k][1][0].strip())
    ]
    if not body:
        raise refusal(
            export.name, "file", "no row of numbers", "a table of deviations", "name another file"
        )
    heads = [row for _, row in rows[: body[0]]]
    heads = [row for row in heads if sum(map(bool, row)) >= 2]
    above = [" ".join(row).strip() for _, row in rows[: body[0]] if sum(map(bool, row)) < 2]
    # A preamble such as `Axis: X` may hold the separator of the cells, and is short.
    while len(heads) > 1 and sum(map(bool, heads[0])) < 0.5 * width:
        above.append(" ".join(heads.pop(0)).strip())
    last = ""
    for row in heads:
        # A run that is named once stands above all its columns.
        for place, cell in enumerate(row):
            last = cell or last
            if not cell and place > 1 and row is not heads[-1] and len(heads) > 1:
                row[place] = last
    titles = [" ".join(row[place] for row in heads if row[place]) for place in range(width)]
    return Headed(
        export.name,
        [*comments, *above],
        titles,
        [rows[k][0] for k in body],
        np.array([numbers[k] for k in body]),
        [rows[k][1] for k in body],
    )


def direction(text: str) -> int | None:
    """+1 or -1 for a text that names a direction of approach or travel; None for others."""
    if found := re.search(r"\(([+\-−])\)", text):
        return 1 if found[1] == "+" else -1
    plain = re.sub(r"\[.*?\]|\(.*?[^+\-−].*?\)", "", text).strip().casefold()
    for sign, words in ((1, _UP), (-1, _DOWN)):
        for word in words:
            if plain.strip("()") == word:
                return sign
            if word in _ARROWS and word in plain:
                return sign
            if len(word) > 1 and word[0].isalpha() and re.search(rf"(?<![^\W\d]){word}\b", plain):
                return sign
    return -1 if re.search(r"\d ?-$", plain) else None


def run_of(text: str) -> int | None:
    """The number of the run in a title; None without any."""
    found = re.search(r"\d+", re.sub(r"\[.*?\]|\(.*?\)", "", text))
    return int(found[0]) if found else None


def number_in(comments: Sequence[str], words: str) -> tuple[float, str] | None:
    """The first number behind a word (a pattern) in comment lines, and what follows it."""
    for comment in comments:
        found = re.search(
            rf"\b(?:{words})\b[^\d+\-]*([-+]?\d[\d.,]*)\s*([^\s,;]*)", comment, re.IGNORECASE
        )
        if found:
            value = number(found[1].rstrip(".,"), "," if "," in found[1] else ".")
            if math.isfinite(value):
                return value, found[2]
    return None


def still(
    machine: Machine, moving: Sequence[str], at: Mapping[str, float], needs: Needs, why: str
) -> dict[str, float]:
    """Positions of the axes that do not move, mm or deg, from ``--at``; `needs` has those that
    lack.
    """
    given = dict(at)
    lacking = [axis for axis in machine.chain.axes if axis not in moving and axis not in given]
    if lacking:
        needs.add("--at " + ",".join(f"{axis}=VALUE" for axis in lacking), why)
    return {axis: given.get(axis, 0.0) for axis in machine.chain.axes if axis not in moving}
