"""Compiled programs that are kept from process to process, in the cache folder of the user."""

import os
import stat
import warnings
from pathlib import Path

import jax

from ..user_files import cache_base, is_own

_WORTH_KEEPING_S = 0.1
"""Programs that compile in less time are not cached: reading them back would take as long."""


def cache_folder() -> Path | None:
    """The folder in which compiled programs are kept between runs; None without a cache.

    It is ``vcal`` in ``XDG_CACHE_HOME``, or in the cache folder of the platform. The environment
    variable ``VCAL_NO_CACHE`` switches the cache off.
    """
    if os.environ.get("VCAL_NO_CACHE"):
        return None
    base = cache_base()
    return None if base is None else base / f"jax-{jax.__version__}"


def keep_programs() -> None:
    """Keep compiled programs in the user's cache folder, unless JAX is configured with another one.

    What is read from it is run. A folder that belongs to another user, or in which others may
    write, is therefore not used. Like one that cannot be written it is ignored silently, as the
    cache only saves time.
    """
    folder = cache_folder()
    if folder is None or jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK | os.X_OK) or not _is_safe(folder):
        return
    # A truncated file, or one that another process is writing, is compiled again.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _WORTH_KEEPING_S)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _is_safe(folder: Path) -> bool:
    """Whether a folder and all programs in it belong to the user, and nobody else may write them.

    Programs that somebody else wrote before the folder was closed to others would be run too. The
    permissions of a file count where others can reach it: a folder that vcal makes is closed.
    """
    if not is_own(folder):
        return False
    if not hasattr(os, "getuid"):
        return True
    reached = folder.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH)
    others = (stat.S_IWGRP | stat.S_IWOTH) if reached else 0
    with os.scandir(folder) as entries:
        return all(_is_own_file(entry, others) for entry in entries)


def _is_own_file(entry: "os.DirEntry[str]", others: int) -> bool:
    found = entry.stat(follow_symlinks=False)
    return found.st_uid == os.getuid() and not entry.is_symlink() and not found.st_mode & others
