"""A picture of a report."""

import base64
import re
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Picture:
    """A picture of a report with its caption."""

    name: str
    """Subject; the file is named after it."""
    section: str
    """Part of the page that shows it, such as ``"effect 1"`` or ``"noise"``."""
    caption: str
    data: bytes
    """PNG."""

    @property
    def file(self) -> str:
        """File name, of characters that every file system accepts: users name placements."""
        return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', self.name)}.png"

    @property
    def source(self) -> str:
        """The picture as a data URL, so that a page needs no other file."""
        return "data:image/png;base64," + base64.b64encode(self.data).decode("ascii")


def by_section(pictures: Iterable[Picture]) -> dict[str, tuple[Picture, ...]]:
    """Pictures by the part of the page that shows them; no entry for a part without any."""
    found: dict[str, tuple[Picture, ...]] = {}
    for picture in pictures:
        found[picture.section] = (*found.get(picture.section, ()), picture)
    return found
