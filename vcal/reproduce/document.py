"""A page from its description: sections of text with places for tables and pictures.

A blank line or a mark at the start of a line begins a block of a section: a paragraph, or with its
mark a point of a list (``- ``), small print (``~ ``), and ``:name`` for the table or the picture of
that name, with the rest of the block as its note or caption.

Texts, tables and pictures are functions of what is computed, called when they are shown: a section
costs what it shows.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..report import Picture, Section, Table
from ..report.html.text import DASH, number, unit


@dataclass(frozen=True)
class Row:
    """One published number and what came out here."""

    quantity: str
    published: float | None
    """None where the publication has no such number."""
    vcal: float
    unit: str
    note: str = ""


def section(title: str, text: str, shown: Callable[[str], Table | Figure]) -> Section:
    """A section of a text; `shown` gives its tables and pictures by name, and raises for others."""
    found = Section(title)
    for block in re.split(r"\n\s*\n|\n(?=:|- |~ )", text):
        block = " ".join(block.split())
        mark, _, words = block.partition(" ")
        if mark == "-":
            found = replace(found, points=(*found.points, words))
        elif mark == "~":
            found = replace(found, note=words)
        elif mark.startswith(":"):
            one = shown(mark[1:])
            if isinstance(one, Table):
                found = replace(found, tables=(*found.tables, replace(one, note=words)))
            else:
                picture = Picture.of(mark[1:], "", words, one)
                found = replace(found, pictures=(*found.pictures, picture))
        elif block:
            found = replace(found, paragraphs=(*found.paragraphs, block))
    return found


def table(
    header: str, rows: Iterable[Sequence[Any]], *, fold: str = "", strong: Iterable[int] = ()
) -> Table:
    """A table of raw values under a header ``"a | b"``: numbers with three digits, a dash for None.

    Columns of numbers, also of those that were made texts, stand on the right.
    """
    cells = [[cell(value) for value in row] for row in rows]
    columns = zip(*cells, strict=True) if cells else [()] * len(header.split(" | "))
    align = "".join("r" if any(map(_numeric, c)) and not any(map(_wordy, c)) else "l"
                    for c in map(list, columns))  # fmt: skip
    titles = tuple(title.strip() for title in header.split(" | "))
    return Table(titles, cells, align, fold=fold, strong=frozenset(strong))


def cell(value: Any) -> str:
    """A value as the text of a cell."""
    if isinstance(value, str):
        return value
    if value is None:
        return DASH
    return str(value) if isinstance(value, int | np.integer) else number(float(value))


def _numeric(text: str) -> bool:
    return bool(re.match(r"[−+\[]?\d", text))


def _wordy(text: str) -> bool:
    return bool(text) and text != DASH and not _numeric(text)


def rows_table(rows: Sequence[Row]) -> Table:
    """All published numbers, as they are printed, beside those that came out."""
    lines = [
        (
            row.quantity,
            None if row.published is None else _printed(row.published),
            f"{row.vcal:.0f}" if row.unit == "1" and row.vcal % 1 == 0 else number(row.vcal, 4),
            unit(row.unit),
            row.note,
        )
        for row in rows
    ]
    return table("quantity | printed | vcal | unit | note", lines, fold="All numbers")


def _printed(value: float) -> str:
    """A number of a publication: whole ones in full, others without zeros at their end."""
    return f"{value:.0f}" if value % 1 == 0 else f"{value:.4g}".replace("-", "−")


def picked(one: Any, *keys: str) -> dict[str, Any]:
    """Attributes of an object by their names, ``"rms_um=rms"`` under another one."""
    pairs = [key.partition("=") for key in keys]
    return {key: getattr(one, attribute or key) for key, _, attribute in pairs}
