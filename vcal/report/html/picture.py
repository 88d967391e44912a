"""One picture of a report."""

import base64
import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Picture:
    """One picture of a report."""

    name: str
    """What it shows; names the file."""
    section: str
    """Where the page of a closure shows it: ``"effect 1"``, or the name of a section."""
    caption: str
    data: bytes
    """PNG."""

    @property
    def file(self) -> str:
        """Name of the file, of characters that every file system takes: the places of effects
        have names that users gave them.
        """
        return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', self.name)}.png"

    @property
    def source(self) -> str:
        """The picture itself as an address, so that a page needs no other file."""
        return "data:image/png;base64," + base64.b64encode(self.data).decode("ascii")
