"""A picture of a report."""

import base64
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ... import plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEAST_PX = 8.0
"""Least size of text on a page, CSS pixels: pictures do not shrink below it."""


@dataclass(frozen=True)
class Picture:
    """A picture of a report with its caption."""

    name: str
    """Subject; the file is named after it."""
    section: str
    """Part of the page that shows it, such as ``"effect 1"`` or ``"noise"``."""
    caption: str
    """Words below it; empty for none."""
    data: bytes
    """PNG or SVG."""
    alt: str = ""
    """What it shows, for readers who do not see it; the caption where this is empty."""
    half: bool = False
    """Whether two of them stand side by side where the page is wide enough."""
    rows: "tuple[tuple[plots.Piece, ...], ...]" = ()
    """Its pieces, which stand below one another where the page is narrow; empty: one piece."""
    text_px: float = 0.0
    """Size of its smallest text at its own size, pixels; zero where that is not known."""
    colours: bool = False
    """Whether its colours stand for numbers, so that a dark page may not change them."""

    @classmethod
    def of(cls, name: str, section: str, caption: str, drawn: "Figure") -> "Picture":
        """A figure as a picture that a narrow page shows in pieces."""
        found = plots.cut(drawn)
        return cls(
            name,
            section,
            caption,
            found.whole,
            rows=found.rows,
            text_px=found.text_px,
            colours=found.colours,
        )

    @property
    def classes(self) -> str:
        """Style classes on a page."""
        return " ".join(["half"] * self.half + ["colours"] * self.colours)

    @property
    def least(self) -> float:
        """Smallest scale at which all texts are readable."""
        return min(LEAST_PX / self.text_px, 1.0) if self.text_px else 1.0

    @property
    def _drawn(self) -> bool:
        """Whether it is SVG."""
        return self.data.startswith(b"<?xml")

    @property
    def file(self) -> str:
        """File name, of characters that every file system accepts: users name placements."""
        ending = "svg" if self._drawn else "png"
        return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', self.name)}.{ending}"

    @property
    def source(self) -> str:
        """The picture as a data URL, so that a page needs no other file."""
        return address(self.data, "svg+xml" if self._drawn else "png")


def address(data: bytes, kind: str = "png") -> str:
    """An image as a data URL."""
    return f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")


Shown = Mapping[str, tuple[Picture, ...]]
"""Pictures by the part of the page that shows them; no entry for a part without any."""


def by_section(pictures: Iterable[Picture]) -> Shown:
    """The pictures by their sections."""
    found: dict[str, tuple[Picture, ...]] = {}
    for picture in pictures:
        found[picture.section] = (*found.get(picture.section, ()), picture)
    return found
