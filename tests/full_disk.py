"""A disk that is full from the n-th write on: every way of Python to write a file fails then."""

import builtins
import errno
import io
import os
from contextlib import contextmanager
from pathlib import Path

_WRITING = os.O_CREAT | os.O_WRONLY | os.O_RDWR


class FullDisk:
    """Counts the writes below a folder, and has them fail from number `fails_at` on.

    Opening a file to write, every block of bytes that goes to the system, folders, links and
    renames count. Files can still be removed, as on a real disk.
    """

    def __init__(self, folder: Path, fails_at: int | None = None):
        self.folder, self.fails_at = str(Path(folder).resolve()), fails_at
        self.count = 0
        self.failed = ""

    def spend(self, path, named=True):
        name = os.path.abspath(os.fsdecode(path))
        if not name.startswith(self.folder):
            return
        self.count += 1
        if self.fails_at is not None and self.count >= self.fails_at:
            self.failed = self.failed or name
            number = errno.ENOSPC
            raise OSError(number, os.strerror(number), *([name] if named else []))


class _Raw(io.FileIO):
    def __init__(self, disk, place, mode, path, **more):
        super().__init__(place, mode, **more)
        self.disk, self.path = disk, path

    def write(self, data):
        self.disk.spend(self.path, named=False)  # as the system: the error of a write has no name
        return super().write(data)


@contextmanager
def full_disk(folder, fails_at=None):
    """Context in which the disk below a folder is full from write number `fails_at` on."""
    disk = FullDisk(folder, fails_at)
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
