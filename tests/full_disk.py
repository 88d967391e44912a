"""A disk that is full from the n-th write on, or that can no longer be written: every way of Python
to write a file fails then.
"""

import builtins
import errno
import io
import json
import os
import select
import shutil
import signal
import tempfile
import threading
import time
import warnings
from contextlib import contextmanager
from pathlib import Path

_WRITING = os.O_CREAT | os.O_WRONLY | os.O_RDWR


class FullDisk:
    """Counts the writes below a folder, and has them fail from number `fails_at` on.

    Opening a file to write, every block of bytes that goes to the system, folders, links and
    renames count. Files can still be removed, as on a real disk.
    """

    def __init__(self, folder: Path, fails_at: int | None = None, error: int = errno.ENOSPC):
        self.folder, self.fails_at = str(Path(folder).resolve()), fails_at
        self.error = error
        self.forked = False
        self.count = 0
        self.failed = ""

    def spend(self, path, named=True):
        name = os.path.abspath(os.fsdecode(path))
        if not name.startswith(self.folder):
            return
        self.count += 1
        if self.fails_at is not None and self.count >= self.fails_at:
            self.failed = self.failed or name
            raise OSError(self.error, os.strerror(self.error), *([name] if named else []))


class EveryWrite(FullDisk):
    """At every write below a folder, a process forks off for which the disk is full from then on.

    It says with `answer` what has become of it, and ends. This process waits for it, makes the
    folder again as it was, and goes on as if nothing had happened: all faults of a command take
    little more time than the command. Answers are in `answers`, by the number of the write. There
    is none of a write while there are other threads, which a forked process would not have, and of
    a process that took longer than `limit_s`.
    """

    def __init__(self, folder: Path, limit_s: float = 60.0):
        super().__init__(folder)
        self.limit_s, self.answers = limit_s, {}
        self._busy = False
        self._pipe = -1

    def spend(self, path, named=True):
        if self.forked:
            super().spend(path, named)
            return
        before = self.count
        if not self._busy:
            super().spend(path, named)
        if self.count == before or threading.active_count() > 1:
            return
        self._busy = True
        store = Path(tempfile.mkdtemp(dir=Path(self.folder).parent))
        _link_all(Path(self.folder), store)
        ours, theirs = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of JAX, which has threads
            number = os.fork()
        if number == 0:
            os.close(ours)
            self.forked, self._pipe, self.fails_at = True, theirs, self.count
            super().spend(path, named)  # counts once more, and raises
        os.close(theirs)
        text = _all_of(ours, self.limit_s)
        os.close(ours)
        if not text:
            os.kill(number, signal.SIGKILL)
        os.waitpid(number, 0)
        _restore(Path(self.folder), store)
        shutil.rmtree(store)
        if text:
            self.answers[self.count] = json.loads(text)
        self._busy = False

    def answer(self, content):
        """Say what has become of a forked process, which ends."""
        with os.fdopen(self._pipe, "wb") as pipe:
            pipe.write(json.dumps(content).encode())
        os._exit(0)


def _all_of(pipe, seconds):
    """All bytes from a pipe; none where its end does not come in time."""
    end, found = time.monotonic() + seconds, b""
    while (left := end - time.monotonic()) > 0:
        if select.select([pipe], [], [], left)[0]:
            if not (more := os.read(pipe, 1 << 16)):
                return found
            found += more
    return b""


def _link_all(source, target):
    """A second name in `target` for every file below `source`."""
    for place, folders, files in os.walk(source):
        here = target / os.path.relpath(place, source)
        for name in folders:
            (here / name).mkdir()
        for name in files:
            os.link(Path(place, name), here / name, follow_symlinks=False)


def _restore(folder, store):
    """Make the files below a folder again those of `store`; open files stay the same."""
    for place, folders, files in os.walk(folder, topdown=False):
        kept = store / os.path.relpath(place, folder)
        for name in files:
            path = Path(place, name)
            if not (kept / name).is_file() or not os.path.samefile(path, kept / name):
                path.unlink()
        for name in folders:
            if not (kept / name).is_dir():
                shutil.rmtree(Path(place, name))
    for place, folders, files in os.walk(store):
        here = folder / os.path.relpath(place, store)
        for name in folders:
            (here / name).mkdir(exist_ok=True)
        for name in files:
            if not (here / name).exists():
                os.link(Path(place, name), here / name)


class _Raw(io.FileIO):
    def __init__(self, disk, place, mode, path, **more):
        super().__init__(place, mode, **more)
        self.disk, self.path = disk, path

    def write(self, data):
        self.disk.spend(self.path, named=False)  # as the system: the error of a write has no name
        return super().write(data)


@contextmanager
def full_disk(folder, fails_at=None, disk=None):
    """Context in which the disk below a folder is full from write number `fails_at` on, or as
    `disk` says.
    """
    disk = FullDisk(folder, fails_at) if disk is None else disk
    real = {name: getattr(os, name) for name in ("open", "mkdir", "replace", "rename", "link")}
    opened = io.open

    def open_file(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None,
                  closefd=True, opener=None):  # fmt: skip
        if not {*mode} & {*"wax+"} or opener is not None:
            return opened(file, mode, buffering, encoding, errors, newline, closefd, opener)
        path = os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else os.fspath(file)
        if not isinstance(file, int):
            disk.spend(path)
        raw = _Raw(disk, file, mode.replace("b", "").replace("t", ""), path, closefd=closefd)
        whole = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return whole
        return io.TextIOWrapper(whole, encoding, errors, newline)

    def open_number(path, flags, *more, **keys):
        if flags & _WRITING:
            disk.spend(path)
        return real["open"](path, flags, *more, **keys)

    def one(name):
        def call(path, *more, **keys):
            disk.spend(path)
            return real[name](path, *more, **keys)

        return call

    def two(name):
        def call(source, target, *more, **keys):
            disk.spend(target)
            return real[name](source, target, *more, **keys)

        return call

    changed = {"open": open_number, "mkdir": one("mkdir")}
    changed |= {name: two(name) for name in ("link",)}
    try:
        io.open = builtins.open = open_file
        for name, call in changed.items():
            setattr(os, name, call)
        yield disk
    finally:
        io.open = builtins.open = opened
        for name, call in real.items():
            setattr(os, name, call)
