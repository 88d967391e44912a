"""The page system of all reports: self-contained HTML from plain texts, tables and pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import jinja2

from ...words import printable
from .picture import Picture, address
from .scene import Scene
from .scripts import SCENE, SORT, script, script_hash

Tone = Literal["good", "plain", "caution", "bad"]
_SIDES = {"l": "", "r": "n", "c": "code"}
_FEW_ROWS, _MANY_COLUMNS = 8, 8


@dataclass(frozen=True)
class Badge:
    """A framed word: before the summary of a page, or after the heading of a section."""

    word: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class Tile:
    """A key figure at the top of a page: its name, its value and a remark."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of text under a header."""

    header: tuple[str, ...]
    """All texts empty for a table without a header."""
    rows: Sequence[Sequence[str]]
    align: str = ""
    """One letter per column: ``l`` (left), ``r`` (right, for numbers) or ``c`` (code, line breaks
    kept); empty: ``l`` throughout."""
    note: str = ""
    """Small print below the table."""
    fold: str = ""
    """Label of a table that is folded until the reader opens it; empty: an open table."""
    strong: frozenset[int] = frozenset()
    """Indices of the rows in bold."""
    links: Mapping[str, str] = field(default_factory=dict)
    """Addresses of cells, by their text."""
    caption: str = ""
    """A paragraph above the table."""
    marked: frozenset[tuple[int, int]] = frozenset()
    """Row and column of the cells that are highlighted."""
    sortable: bool = False
    """Whether a click on the head of a column sorts the rows of a page."""

    def __post_init__(self):
        if self.align and len(self.align) != len(self.header) or set(self.align) - set(_SIDES):
            raise ValueError(
                f"align: found {self.align!r}, expected {len(self.header)} letters l, r or c, one "
                "per column"
            )
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(
                    f"found a row of {len(row)} cells ({', '.join(row)}), expected "
                    f"{len(self.header)}, one per column"
                )

    @property
    def classes(self) -> tuple[str, ...]:
        """Style class of every column."""
        return tuple(_SIDES[side] for side in self.align or "l" * len(self.header))

    @property
    def kind(self) -> str:
        """Style class of the whole: few rows stay on one printed page, many columns are small."""
        few, many = len(self.rows) <= _FEW_ROWS, len(self.header) >= _MANY_COLUMNS
        return " ".join(["short"] * few + ["wide"] * many + ["sortable"] * self.sortable)

    def style(self, row: int, column: int) -> str:
        """Style classes of one cell."""
        hit = "hit" if (row, column) in self.marked else ""
        return " ".join(filter(None, (self.classes[column], hit)))

    def _repr_html_(self) -> str:
        return Fragment((Section("", tables=(self,)),))._repr_html_()


@dataclass(frozen=True)
class Section:
    """A heading, then in this order: paragraphs, points, tables, pictures, small print."""

    title: str
    paragraphs: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    """Items of a list."""
    tables: tuple[Table, ...] = ()
    """Tables without rows are not shown."""
    pictures: tuple[Picture, ...] = ()
    note: str = ""
    """Small print at the end."""
    minor: bool = False
    """Whether it is a subsection: a smaller heading, and no link at the top of the page."""
    badge: Badge | None = None
    """A framed word after the heading of a subsection."""
    scenes: tuple[Scene, ...] = ()
    """Pictures that the reader can turn, above the others; a page shows them with a script only."""


@dataclass(frozen=True)
class Fragment:
    """Some sections of a page, which a notebook shows as HTML."""

    sections: tuple[Section, ...]

    def _repr_html_(self) -> str:
        return _render("fragment.html.j2", sections=self.sections)


def sheet(
    title: str,
    summary: str,
    sections: Sequence[Section],
    *,
    kicker: str = "vcal",
    lead: str = "",
    badge: Badge | None = None,
    facts: Sequence[tuple[str, str]] = (),
    warnings: Sequence[str] = (),
    tiles: Sequence[Tile] = (),
) -> str:
    """A page as one self-contained HTML text, pictures included; all texts are plain, not HTML.

    `summary` is the sentence at the top, after the `badge`, `lead` a paragraph below it; `kicker`
    is the line above the title; `facts` are terms with their descriptions; framed `warnings` stand
    before the `tiles`.
    """
    return _render(
        "sheet.html.j2",
        title=title,
        summary=summary,
        kicker=kicker,
        lead=lead,
        badge=badge,
        facts=facts,
        warnings=warnings,
        tiles=tiles,
        sections=sections,
        scripts=_scripts(sections),
    )


def _scripts(sections: Sequence[Section]) -> list[str]:
    """The scripts that these sections need."""
    scenes = any(section.scenes for section in sections)
    sortable = any(table.sortable for section in sections for table in section.tables)
    return [*[SCENE] * scenes, *[SORT] * sortable]


def _render(template: str, **values: Any) -> str:
    """A template of this folder; every value is escaped for HTML, an undefined one is an error.

    Control characters, which a text of the user may hold, are written as escapes.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"address": address, "script": script, "script_hash": script_hash}
    return printable(environment.get_template(template).render(**values))
