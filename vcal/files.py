"""Files that are written whole or not at all, folders that change places in one step.

An error of the system, such as a full disk, names the file: `OSError.filename` is set, which
Python leaves out where a write fails and not the opening of the file.
"""

import contextlib
import ctypes
import errno
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
try:
    import msvcrt
except ImportError:  # elsewhere
    msvcrt = None

_EXCHANGE = 2
"""RENAME_EXCHANGE of Linux and RENAME_SWAP of macOS."""
_AT_FDCWD = -100
_MOVING = threading.Lock()
"""Held while folders change places, and for good once the process ends."""
_WAIT_S = 0.5
_OPEN: dict[Path, Any] = {}
"""Temporary folders of this process, with the descriptors that hold their locks."""


@contextlib.contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Context in which an `OSError` without a file is raised with that of `path`."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def write_file(path: Path, data: bytes | str) -> None:
    """Write a new file; text in UTF-8. Raises `OSError` with the name of the file."""
    raw = data.encode() if isinstance(data, str) else data
    with naming(path), open(path, "wb") as file:
        file.write(raw)


def replace_file(path: Path, data: bytes | str) -> None:
    """Write a file, in the place of an earlier one, in one step: it is old or new at any time.

    Raises `OSError` with the name of the file; the earlier one is then as it was.
    """
    with naming(path):
        try:
            number, new = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        except OSError as error:
            error.filename = str(path)
            raise
        try:
            os.close(number)
            write_file(Path(new), data)
            mask = os.umask(0)
            os.umask(mask)
            os.chmod(new, path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~mask)
            os.replace(new, path)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.unlink(new)
            if isinstance(error, OSError):
                error.filename = str(path)
            raise


@contextlib.contextmanager
def temporary_folder(out: Path, home: Path | None = None) -> Iterator[Path]:
    """A folder beside `out`, or in `home`, for the files that will be those of `out`; removed
    afterwards.

    An `OSError` in this context names the file that it will be. Folders of that kind that a killed
    process has left are removed first.
    """
    home = out.absolute().parent if home is None else home
    _remove_left(out.name, home)
    try:
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".new", dir=home))
    except OSError as error:
        error.filename = str(out)
        raise
    _OPEN[work] = _locked(work)
    try:
        with naming(out):
            yield work
    except OSError as error:
        if error.filename is not None:
            named = Path(os.fsdecode(error.filename))
            if named.is_relative_to(work):
                error.filename = str(out / named.relative_to(work))
        raise
    finally:
        _remove(work)


def remove_temporary() -> None:
    """Remove all temporary folders of this process, which is about to end: from now on, no folder
    changes its place.
    """
    if _MOVING.acquire(timeout=_WAIT_S):
        for work in list(_OPEN):
            shutil.rmtree(work, ignore_errors=True)


def _remove(work: Path) -> None:
    shutil.rmtree(work, ignore_errors=True)
    number = _OPEN.pop(work, None)
    if number is not None:
        with contextlib.suppress(OSError):
            os.close(number)


def _locked(folder: Path) -> int | None:
    """A descriptor that locks a folder until it is closed or the process ends; None where that
    is not possible or another process has it.
    """
    if fcntl is None:
        return None
    number = None
    try:
        number = os.open(folder, os.O_RDONLY)
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return number
    except OSError:
        if number is not None:
            os.close(number)
        return None


def _remove_left(name: str, home: Path) -> None:
    """Remove the temporary folders of processes that were killed. Those of a living process are
    locked; where there are no locks they stay.
    """
    with contextlib.suppress(OSError):
        for left in home.glob(f".{_plain(name)}.????????.new"):
            if left.is_symlink() or left in _OPEN:
                continue
            number = _locked(left)
            if number is not None:
                shutil.rmtree(left, ignore_errors=True)
                os.close(number)


def _plain(name: str) -> str:
    """A name whose characters have no meaning in a pattern."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def exchange(one: Path, other: Path) -> bool:
    """Let two folders change places in one step; False where the system cannot do that.

    By renameat2 of Linux and renamex_np of macOS.
    """
    names = os.fsencode(one), os.fsencode(other)
    try:
        library = ctypes.CDLL(None, use_errno=True)
        swap = library.renameat2 if sys.platform == "linux" else library.renamex_np
    except (AttributeError, OSError, TypeError):  # no library, or no such function in it
        return False
    with moving():
        if sys.platform == "linux":
            done = swap(_AT_FDCWD, names[0], _AT_FDCWD, names[1], ctypes.c_uint(_EXCHANGE))
        else:
            done = swap(*names, ctypes.c_uint(_EXCHANGE))
    return done == 0


@contextlib.contextmanager
def moving() -> Iterator[None]:
    """Context in which files change their place, which is whole before the process ends."""
    with _MOVING:
        yield


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file or folder a second name, or copy it where that is not possible."""
    if source.is_dir() and not source.is_symlink():
        shutil.copytree(source, target, symlinks=True, copy_function=_link)
    else:
        _link(str(source), str(target))


def _link(source: str, target: str, *, follow_symlinks: bool = False) -> None:
    del follow_symlinks
    try:
        os.link(source, target, follow_symlinks=False)
    except (OSError, NotImplementedError) as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        shutil.copy2(source, target, follow_symlinks=False)


class FileLock:
    """A lock that one process has at a time, until it is released or the process ends.

    Raises `BlockingIOError` where another process has it. On file systems without locks nobody is
    kept out.
    """

    def __init__(self, path: Path):
        self.path = path
        while True:
            with naming(path):
                self._number = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                _lock(self._number)
                if os.path.samestat(os.fstat(self._number), os.stat(path)):
                    return
            except FileNotFoundError:
                pass  # it was released and removed in between
            except BaseException:
                os.close(self._number)
                raise
            os.close(self._number)

    def release(self) -> None:
        """Let others have it; the file is removed."""
        with contextlib.suppress(OSError):
            if os.name != "nt":  # there, an open file cannot be removed
                os.unlink(self.path)
        os.close(self._number)


def _lock(number: int) -> None:
    if fcntl is not None:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:  # a file system without locks
            return
    elif msvcrt is not None:
        try:
            msvcrt.locking(number, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        except OSError as error:
            raise BlockingIOError(*error.args) from error
