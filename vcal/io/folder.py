"""The files beside a study file, each with its fingerprint once it was read."""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from ..catalogue import run_file, unchanged
from ..instruments.base import Column
from .messages import refusal
from .table import Table, read_header, read_table


def check_way(out: Path) -> None:
    """Raises `StudyError` where a folder `out` could not be made, before any work is done for it:
    below a file, or where the user may not write.
    """
    above = out.absolute()
    while not above.exists() and above != above.parent:
        above = above.parent
    if above == out.absolute() and not above.is_dir():
        return  # what is there itself is for the caller to judge
    if not above.is_dir():
        raise refusal(
            str(out),
            "output folder",
            f"the file {above} in its path",
            "a place in which a folder can be made",
            "choose another",
        )
    if not os.access(above, os.W_OK | os.X_OK):
        raise refusal(
            str(out),
            "output folder",
            f"that {above} cannot be written to",
            "a place in which a folder can be made",
            "choose another",
        )


@dataclass(frozen=True)
class Folder:
    """Reads the tables of one study and keeps the hash of everything it read."""

    root: Path
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 in hexadecimal by file name as the study names it."""
    _modules: dict[str, ModuleType] = field(default_factory=dict)

    def path(self, name: str, expected: str = "a CSV table with a header line") -> Path:
        """Path of a file that is about to be read; raises `StudyError` if there is none."""
        path = self.root / name
        if not path.is_file():
            raise refusal(
                name,
                "file",
                "a folder" if path.is_dir() else f"no such file in {self.root}",
                expected,
                "add the file or correct its name",
            )
        self.hashes[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        return path

    def has(self, name: str) -> bool:
        """Whether a file is there."""
        return (self.root / name).is_file()

    def module(self, name: str, what: str) -> ModuleType:
        """A Python file of the user's own, with classes of `what`s.

        It is run once for a study, however often the study names it. What it registers itself must
        not be left to the next study, and is forgotten. Raises `StudyError` as `run_file` does.
        """
        path = self.path(name, f"a Python file with {what} classes")
        if name not in self._modules:
            with unchanged():
                self._modules[name] = run_file(path, what)
        return self._modules[name]

    def header(self, name: str) -> tuple[str, ...]:
        """Names of a table's columns."""
        return read_header(self.path(name), name)

    def table(
        self,
        name: str,
        columns: Sequence[Column],
        optional: Callable[[str], Column | None] | None = None,
        labels: Sequence[str] = (),
    ) -> Table:
        """A checked table (`io.table.read_table`)."""
        more: Mapping = {} if optional is None else {"optional": optional}
        return read_table(self.path(name), columns, name, labels=labels, **more)
