"""The folder of a report: what may be written to, and files that arrive whole or not at all."""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..io.messages import refusal

_KEPT = ".earlier"


@dataclass(frozen=True)
class Place:
    """How the folder of one kind of report is known."""

    record: str
    """Name of its record, which lists all its files (``files``) and names its ``schema``."""
    schema: str
    """How the schema of such a record begins."""
    beside: str = ""
    """Name of a folder that may lie beside the files; none where it is empty."""

    def check(self, out: Path) -> None:
        """Refuse a place that such a report must not be written to.

        Raises `StudyError` for a file, and for a folder that holds something but no earlier report
        of this kind.
        """
        if not out.exists():
            return
        if not out.is_dir():
            raise refusal(
                str(out),
                "output folder",
                "a file",
                "a folder, or a name that is free",
                "choose another",
            )
        others = sorted(p.name for p in out.iterdir() if p.name != self.beside or not p.is_dir())
        if others and not self.files(out):
            raise refusal(
                str(out),
                "output folder",
                f"other files ({', '.join(others[:3])}, ...)",
                "an empty folder, one that holds an earlier report, or a name that is free",
                "choose another folder",
            )

    def fill(self, out: Path, make: Callable[[Path], Sequence[str]]) -> None:
        """Have the files made in a temporary folder, which `make` is given, and move those that it
        names to `out`.

        Files of an earlier report are replaced, others are left alone. On failure or interruption
        `out` stays as it was. Raises as `check` does.
        """
        self.check(out)
        with _workshop(out) as work:
            files = make(work)
            _install(work, out, files, self.files(out))

    def files(self, out: Path) -> list[str]:
        """Names of the files of the report in a folder; none where there is no report."""
        try:
            content = json.loads((out / self.record).read_text(encoding="utf-8"))
            ours = str(content["schema"]).startswith(self.schema)
            names = [str(name) for name in content.get("files", [])]
        except (OSError, ValueError, KeyError, TypeError):
            return []
        # Names only: a record that was tampered with must not reach outside the folder.
        others = [n for n in names if Path(n).name == n and n != self.record]
        return [self.record, *others] if ours else []


@contextlib.contextmanager
def _workshop(out: Path) -> Iterator[Path]:
    """A temporary folder on the file system of `out`, gone afterwards; so are parents of `out`
    that had to be made, if they are still empty.
    """
    made = [p for p in out.absolute().parents if not p.exists()]
    home = out.absolute().parent
    home.mkdir(parents=True, exist_ok=True)
    elsewhere = out.is_dir() and (
        out.stat().st_dev != home.stat().st_dev or not os.access(home, os.W_OK)
    )
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out if elsewhere else home))
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()


def _install(work: Path, out: Path, files: Sequence[str], earlier: Sequence[str]) -> None:
    """Move the files from `work` to `out`, those of an earlier report out of the way; undo all of
    it if anything comes in between.
    """
    fresh = not out.exists()
    out.mkdir(exist_ok=True)
    kept = work / _KEPT
    kept.mkdir()
    stale = list(dict.fromkeys([*earlier, *files]))
    aside, placed = [], []
    try:
        for name in stale:
            if (out / name).is_file():
                aside.append(name)
                os.replace(out / name, kept / name)
        for name in files:
            placed.append(name)
            os.replace(work / name, out / name)
    except BaseException:
        for name in placed:
            with contextlib.suppress(OSError):
                os.replace(out / name, work / name)
        for name in aside:
            with contextlib.suppress(OSError):
                os.replace(kept / name, out / name)
        if fresh:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise
