"""The files beside a study file, each with its fingerprint once it was read."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from ..instruments.base import Column
from ..registry import run_file, unchanged
from .csv_table import Table, read_header, read_table
from .messages import refusal


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
        readings: Collection[str] = (),
    ) -> Table:
        """A checked table (`io.table.read_table`)."""
        more: Mapping = {} if optional is None else {"optional": optional}
        return read_table(self.path(name), columns, name, labels=labels, readings=readings, **more)


def require_empty(out: Path) -> None:
    """Raise `StudyError` if there is something at `out` that writing there would overwrite,
    or nothing can be made there.
    """
    check_way(out)
    if out.is_dir() and not any(out.iterdir()):
        return
    if out.exists() or out.is_symlink():
        kind = "a folder that is not empty" if out.is_dir() else "a file"
        raise refusal(
            str(out), "folder", kind, "a new or an empty folder", "choose another or remove it"
        )


@contextmanager
def made_whole(out: Path) -> Iterator[Path]:
    """A temporary folder that gets the name `out` when everything is in it, with the permissions of
    any new folder; gone where something comes in between.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        yield work
        mask = os.umask(0)
        os.umask(mask)
        work.chmod(0o777 & ~mask)
        if out.is_dir():
            out.rmdir()
        work.replace(out)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise
