"""A picture of a report."""

import base64
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass


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
        kind = "svg+xml" if self._drawn else "png"
        return f"data:image/{kind};base64," + base64.b64encode(self.data).decode("ascii")


Shown = Mapping[str, tuple[Picture, ...]]
"""Pictures by the part of the page that shows them; no entry for a part without any."""


def by_section(pictures: Iterable[Picture]) -> Shown:
    """The pictures by their sections."""
    found: dict[str, tuple[Picture, ...]] = {}
    for picture in pictures:
        found[picture.section] = (*found.get(picture.section, ()), picture)
    return found
