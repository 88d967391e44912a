"""The files of a study folder, each with its hash once it was read; new folders written whole."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from ..instruments.base import Column
from ..registry import run_file, unchanged
from .csv_table import Table, read_header, read_table
from .messages import refusal


def check_way(out: Path) -> None:
    """Raise `StudyError` where the folder `out` cannot be created, before any work is done for it.

    Its path leads through a file, or the user has no permission to write there.
    """
    above = out.absolute()
    while not above.exists() and above != above.parent:
        above = above.parent
    if above == out.absolute() and not above.is_dir():
        return  # an existing file at `out` itself is checked by the caller
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
            f"no permission to write to {above}",
            "a place in which a folder can be made",
            "choose another place, or change its permissions",
        )


@dataclass(frozen=True)
class Folder:
    """The folder of one study; it reads the tables and keeps the hash of every file read."""

    root: Path
    trust: bool = False
    """Whether Python files that the study names may be run."""
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 in hexadecimal, by the file name in the study."""
    _modules: dict[str, ModuleType] = field(default_factory=dict)

    def path(self, name: str, expected: str = "a CSV table with a header line") -> Path:
        """Path of a file to be read; raises `StudyError` where it does not exist."""
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
        """Whether a file exists."""
        return (self.root / name).is_file()

    def module(self, name: str, what: str) -> ModuleType:
        """A Python file of the user's own with `what` classes, as a module.

        The file is executed once per study, however often the study names it. Its registrations
        are undone, so that they do not leak into the next study. Raises `StudyError` as `run_file`
        does, and for a file of a study that is not trusted: a study may come from somebody else,
        and to check it must not run their code.
        """
        path = self.path(name, f"a Python file with {what} classes")
        if not self.trust:
            raise refusal(
                name,
                "file",
                f"Python code with {what} classes, which the study names",
                "permission to run it, as it can do anything that you can",
                "read it, then repeat the command with --trust "
                "(in Python: load_study(..., trust=True))",
            )
        if name not in self._modules:
            with unchanged():
                self._modules[name] = run_file(path, what)
        return self._modules[name]

    def header(self, name: str) -> tuple[str, ...]:
        """Names of the columns of a table."""
        return read_header(self.path(name), name)

    def table(
        self,
        name: str,
        columns: Sequence[Column],
        optional: Callable[[str], Column | None] | None = None,
        labels: Sequence[str] = (),
        readings: Collection[str] = (),
        read_by: str = "",
    ) -> Table:
        """A checked table; see `vcal.study.csv_table.read_table`."""
        more: dict = {} if optional is None else {"optional": optional}
        more |= {"labels": labels, "readings": readings, "read_by": read_by}
        return read_table(self.path(name), columns, name, **more)


def require_empty(out: Path) -> None:
    """Raise `StudyError` where `out` exists and is no empty folder, or cannot be created."""
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
    """A temporary folder that is renamed to `out` when it is complete.

    It gets the permissions of any new folder. After an exception it is removed.
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
