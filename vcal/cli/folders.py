"""Folders that come with the package: the demo, and studies to start from."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path

from ..errors import StudyError
from ..io.messages import listed, nearest
from ..io.simulated import publish, require_empty

_PACKAGE = "vcal"


@contextmanager
def demo_folder() -> Iterator[Path]:
    """The study of `vcal demo` as a folder on the disk."""
    with as_file(files(_PACKAGE) / "demo") as folder:
        yield folder


def starts() -> list[str]:
    """Instruments for which there is a study to start from."""
    found = (files(_PACKAGE) / "demo" / "start").iterdir()
    return sorted(entry.name for entry in found if entry.is_dir())


def write_start(instrument: str, out: Path) -> list[str]:
    """Copy the study to start from for an instrument to `out`; names of the files written.

    Raises `StudyError` for an instrument without one, and where `out` is there and not empty.
    """
    known = starts()
    if instrument not in known:
        raise StudyError(
            f"--instrument: found {instrument!r}{nearest(instrument, known)}, expected one of "
            f"{listed(known)}; correct the name"
        )
    require_empty(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        names = []
        for entry in (files(_PACKAGE) / "demo" / "start" / instrument).iterdir():
            (work / entry.name).write_bytes(entry.read_bytes())
            names.append(entry.name)
        publish(work, out)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise
    return sorted(names)
