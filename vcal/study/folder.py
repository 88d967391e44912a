"""The files of a study folder, each with its hash once it was read; new folders written whole."""

import contextlib
import hashlib
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from ..files import moving, temporary_folder
from ..instruments.base import Column
from ..registry import run_file, unchanged
from .consent import require_consent, require_inside
from .csv_table import Table, load_grid, table_of
from .messages import refusal
from .reading.assign import Assigned, Place, assign
from .reading.formats import DEFAULT, TableFormat
from .reading.grid import Grid
from .reading.times import Clock

_LARGEST = 4 << 30
"""Largest size of a file, in bytes. Reading a table takes several times as much memory."""
_PART = 1 << 20
"""Bytes of a file that are hashed at a time."""


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
    outside: bool = False
    """Whether data and tables outside the folder may be read."""
    hashes: dict[str, str] = field(default_factory=dict)
    """SHA-256 in hexadecimal, by the file name in the study."""
    formats: dict[str, tuple[TableFormat, Place]] = field(default_factory=dict)
    """How tables are read, by the file name in the study; others are read by what they look like.
    """
    tables: dict[str, Table] = field(default_factory=dict)
    """The tables that were read, by the file name in the study."""
    keys: dict[str, str] = field(default_factory=dict)
    """The key of the study file that names a file, in words, by the file name in the study."""
    clock: Clock = field(default_factory=Clock)
    """The zero of all times with a date."""
    _modules: dict[str, ModuleType] = field(default_factory=dict)
    _grids: dict[str, Grid] = field(default_factory=dict)

    def path(self, name: str, expected: str = "a CSV table with a header line") -> Path:
        """Path of a file to be read; raises `StudyError` where it does not exist, where it is no
        regular file or larger than 4 GiB, and as `require_inside` does.
        """
        return self._found(name, expected)[0]

    def _found(self, name: str, expected: str, code: bool = False) -> tuple[Path, str]:
        """Path of a file to be read, and its name without a sheet; its hash is kept."""
        name = self.plain(name)
        path = self.root / name
        require_inside(self.root, name, code=code, allowed=self.outside)
        if not _is_file(path):
            raise refusal(
                name,
                "file",
                _instead(path),
                expected,
                f"add the file or correct its name{self.named_by(name)}",
            )
        size = path.stat().st_size
        if size > _LARGEST:
            found = f"{size / 2**30:.1f} GiB"
            raise refusal(name, "file", found, f"at most {_LARGEST >> 30} GiB", "divide the file")
        digest = hashlib.sha256()
        with path.open("rb") as file:
            while part := file.read(_PART):
                digest.update(part)
        self.hashes[name] = digest.hexdigest()
        return path, name

    def named_by(self, name: str) -> str:
        """``", key instrument.artefact of setup.toml"``: what names a file; empty where no key is
        known.
        """
        return f", {self.keys[name]}" if name in self.keys else ""

    def plain(self, name: str) -> str:
        """Name of a file without a sheet: ``run.xlsx`` of ``run.xlsx#check``."""
        file, mark, _ = name.rpartition("#")
        return file if mark and not _is_file(self.root / name) else name

    def has(self, name: str) -> bool:
        """Whether a file exists."""
        return _is_file(self.root / self.plain(name))

    def module(self, name: str, what: str) -> ModuleType:
        """A Python file of the user's own with `what` classes, as a module.

        The file is executed once per study, however often the study names it. Its registrations
        are undone, so that they do not leak into the next study. Raises `StudyError` as `run_file`,
        `require_inside` and `require_consent` do: a study may come from somebody else, and to check
        it must not run their code.
        """
        path, plain = self._found(name, f"a Python file with {what} classes", code=True)
        if name not in self._modules:
            source = path.read_bytes()  # what is agreed to is what is run
            require_consent(self.root, plain, source, what, self.trust)
            self.hashes[plain] = hashlib.sha256(source).hexdigest()
            with unchanged():
                self._modules[name] = run_file(path, what, source)
        return self._modules[name]

    def written(self, name: str) -> tuple[str, ...]:
        """Names of the columns of a table as the file and the mapping of the study give them."""
        grid = self._grid(name)
        return (*grid.form.columns, *grid.names)

    def header(
        self,
        name: str,
        columns: Sequence[Column],
        optional: Callable[[str], Column | None],
        labels: Sequence[str] = (),
    ) -> tuple[str, ...]:
        """Names of the columns of a table, where `columns` are expected: those that vcal knows by
        its own name for them.
        """
        found = self._assigned(name, columns, optional, labels)
        return tuple(one.column for one in found if one.column)

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
        optional = optional or _nothing
        found = self._assigned(name, columns, optional, labels)
        table = table_of(
            self._grids.pop(name),
            found,
            columns,
            optional=optional,
            labels=labels,
            readings=readings,
            clock=self.clock,
            read_by=read_by,
        )
        self.tables[name] = table
        return table

    def _assigned(
        self,
        name: str,
        columns: Sequence[Column],
        optional: Callable[[str], Column | None],
        labels: Sequence[str],
    ) -> list[Assigned]:
        place = self.formats.get(name, (DEFAULT, Place()))[1]
        asked = {*labels, *(column.name for column in columns)}
        return assign(self._grid(name), asked, optional, place)

    def _grid(self, name: str) -> Grid:
        path = self.path(name)
        if name not in self._grids:
            plain = self.plain(name)
            sheet = name[len(plain) + 1 :] if plain != name else None
            form = self.formats.get(name, (DEFAULT, Place()))[0]
            self._grids[name] = load_grid(path, name, form, sheet)
        return self._grids[name]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


def _instead(path: Path) -> str:
    """What is found in place of a regular file. A device, a pipe or a socket is not opened."""
    with contextlib.suppress(OSError):  # a name that is too long
        if path.is_dir():
            return "a folder"
        if path.exists():
            return "a device, a pipe or a socket"
    return f"no such file in {path.parent}"


def _nothing(name: str) -> Column | None:
    del name
    return None


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


@contextlib.contextmanager
def made_whole(out: Path) -> Iterator[Path]:
    """A temporary folder that is renamed to `out` when it is complete.

    It gets the permissions of any new folder. After an exception it is removed.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with temporary_folder(out) as work:
        yield work
        mask = os.umask(0)
        os.umask(mask)
        work.chmod(0o777 & ~mask)
        with moving():
            if out.is_dir():
                out.rmdir()
            work.replace(out)
