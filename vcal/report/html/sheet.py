"""A page of any content in the look of the reports: self-contained HTML."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from .picture import Picture
from .template import render

Tone = Literal["good", "plain", "caution", "bad"]
_CLASSES = {
    "good": "nothing_missing",
    "plain": "named",
    "caution": "ambiguous",
    "bad": "unexplained",
}
_SIDES = {"l": "", "r": "n"}


@dataclass(frozen=True)
class Badge:
    """A word in a frame before the summary."""

    word: str
    tone: Tone = "plain"


@dataclass(frozen=True)
class Tile:
    """One figure that a reader looks for first: what it is, its value, a remark."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of text under a header."""

    header: tuple[str, ...]
    """Empty texts throughout for a table without one."""
    rows: Sequence[Sequence[str]]
    align: str = ""
    """One letter per column: ``l`` or ``r`` (numbers); all ``l`` where it is empty."""
    note: str = ""
    """Small print below it."""
    fold: str = ""
    """What to call it where it is folded away until it is asked for; empty: it is open."""
    strong: frozenset[int] = frozenset()
    """Places of the rows that are set in bold."""
    links: Mapping[str, str] = field(default_factory=dict)
    """Addresses of cells, by their text."""

    def __post_init__(self):
        if self.align and len(self.align) != len(self.header) or set(self.align) - set(_SIDES):
            raise ValueError(
                f"align: found {self.align!r}, expected {len(self.header)} letters l or r, one per "
                "column"
            )
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(
                    f"found a row of {len(row)} cells ({', '.join(row)}), expected "
                    f"{len(self.header)}, one per column"
                )

    @property
    def classes(self) -> tuple[str, ...]:
        """The style of every column."""
        return tuple(_SIDES[side] for side in self.align or "l" * len(self.header))


@dataclass(frozen=True)
class Section:
    """A heading and what is below it: paragraphs, points, tables, pictures, small print."""

    title: str
    paragraphs: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    """Paragraphs of a list."""
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    note: str = ""
    """Small print at the end."""
    minor: bool = False
    """Whether it belongs to the section before: a smaller heading, not named at the top."""


def sheet(
    title: str,
    summary: str,
    sections: Sequence[Section],
    *,
    kicker: str = "vcal",
    badge: Badge | None = None,
    facts: Sequence[tuple[str, str]] = (),
    warnings: Sequence[str] = (),
    tiles: Sequence[Tile] = (),
) -> str:
    """A page as one self-contained HTML text, pictures included; all texts are plain, not HTML.

    `summary` is the sentence at the top, after the `badge`; `kicker` the line above the title;
    `facts` are terms with what they are; `warnings` stand in a frame before the `tiles`.
    """
    return render(
        "sheet.html.j2",
        title=title,
        summary=summary,
        kicker=kicker,
        badge=badge,
        badge_class=_CLASSES[badge.tone] if badge else "",
        facts=facts,
        warnings=warnings,
        tiles=tiles,
        sections=sections,
    )
