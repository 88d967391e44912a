"""A folder that is written: a new or an empty one, whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .folder import check_way
from .messages import refusal


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
