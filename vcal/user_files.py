"""Folders of the user for caches, settings and what is remembered; who may write to a file."""

import os
import stat
import sys
from pathlib import Path

_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def cache_base() -> Path | None:
    """The folder of vcal below ``XDG_CACHE_HOME``, or below the cache folder of the platform; None
    for a user without a home directory.
    """
    return _base("XDG_CACHE_HOME", ".cache", "Library/Caches")


def config_base() -> Path | None:
    """The folder of the settings of vcal, below ``XDG_CONFIG_HOME`` or that of the platform."""
    return _base("XDG_CONFIG_HOME", ".config", "Library/Application Support")


def state_base() -> Path | None:
    """The folder of what vcal remembers, below ``XDG_STATE_HOME`` or that of the platform."""
    return _base("XDG_STATE_HOME", ".local/state", "Library/Application Support")


def _base(variable: str, usual: str, apple: str) -> Path | None:
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home directory
        return None
    if root := os.environ.get(variable):
        return Path(root) / "vcal"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "vcal"
    return home / (apple if sys.platform == "darwin" else usual) / "vcal"


def is_own(path: Path) -> bool:
    """Whether a file or folder belongs to the user and nobody else may write to it, or put another
    one in its place.

    A folder above it may be writable for others where its entries are protected, as in ``/tmp``
    (sticky bit). Access lists of Windows, where these folders are in the profile of the user, are
    not read.
    """
    if not hasattr(os, "getuid"):
        return True
    real = Path(os.path.realpath(path))
    found = real.stat()
    if found.st_uid != os.getuid() or found.st_mode & _OTHERS:
        return False
    return all(_is_safe(above.stat()) for above in real.parents)


def _is_safe(above: os.stat_result) -> bool:
    """Whether nobody but the user and root can replace what lies in a folder. The group of a folder
    of the user's own is that of the user alone on many systems, and is accepted.
    """
    known = above.st_uid in (0, os.getuid())
    protected = bool(above.st_mode & stat.S_ISVTX)
    return protected or (known and not above.st_mode & stat.S_IWOTH)
