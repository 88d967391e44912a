"""One picture of a report."""

import base64
from dataclasses import dataclass


@dataclass(frozen=True)
class Picture:
    """One picture of a report."""

    name: str
    """File name without its ending."""
    section: str
    """Where the page of a closure shows it: ``"effect 1"``, or the name of a section."""
    caption: str
    data: bytes
    """PNG."""

    @property
    def file(self) -> str:
        """Name of the file."""
        return f"{self.name}.png"

    @property
    def source(self) -> str:
        """The picture itself as an address, so that a page needs no other file."""
        return "data:image/png;base64," + base64.b64encode(self.data).decode("ascii")
