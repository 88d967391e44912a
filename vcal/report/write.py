"""Writing a report into a folder, whole or not at all."""

import contextlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..io.messages import refusal
from ..io.study import Study
from ..loop.closure import Closure
from .compensation import compensation_csv, effects_csv, error_motion_tables
from .page import page
from .pictures import pictures
from .record import record

_RECORD = "report.json"
_KEPT = ".earlier"


def check_folder(out: Path | str) -> None:
    """Refuse a place that a report must not be written to.

    Raises `StudyError` for a file, and for a folder that holds something but no earlier report.
    """
    out = Path(out)
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
    if any(out.iterdir()) and not _files_of(out):
        raise refusal(
            str(out),
            "output folder",
            f"other files ({', '.join(sorted(p.name for p in out.iterdir())[:3])}, ...)",
            "an empty folder, one that holds an earlier report, or a name that is free",
            "choose another folder",
        )


def write_report(
    closure: Closure, study: Study, out: Path | str, *, command: str = "", seconds: float = math.nan
) -> Path:
    """Write the report of a closure into the folder `out`; returns the path of its page.

    `index.html` is the page, self-contained; `report.json` the record for programs;
    `compensation.csv` the error motions and `effects.csv` the named effects; beside them the
    pictures. Files of an earlier report are replaced, others are left alone. All is made in a
    temporary folder and moved at the end: on failure or interruption `out` stays as it was.

    `command` and `seconds` (how long the loop took) are quoted. Raises `StudyError` where `out` is
    a file, or a folder with other things in it (`check_folder`).
    """
    out = Path(out)
    check_folder(out)
    with _workshop(out) as work:
        files = _make(closure, study, work, command, seconds)
        _install(work, out, files)
    return out / "index.html"


def _make(
    closure: Closure, study: Study, work: Path, command: str, seconds: float
) -> Sequence[str]:
    """All files of the report in the folder `work`; returns their names."""
    tables = error_motion_tables(closure.after)
    drawn = list(pictures(closure, tables))
    texts = {
        "index.html": page(closure, study, tables, drawn, command=command, seconds=seconds),
        "compensation.csv": compensation_csv(tables),
        "effects.csv": effects_csv(closure),
    }
    # The record comes last: a folder counts as a report by it.
    files = [*(picture.file for picture in drawn), *texts, _RECORD]
    content = record(closure, study, command=command, seconds=seconds) | {"files": files}
    texts[_RECORD] = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    for picture in drawn:
        (work / picture.file).write_bytes(picture.data)
    for name, text in texts.items():
        (work / name).write_text(text, encoding="utf-8")
    return files


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


def _files_of(out: Path) -> list[str]:
    """Names of the files of the report in a folder; none where there is no report."""
    try:
        content = json.loads((out / _RECORD).read_text(encoding="utf-8"))
        ours = str(content["schema"]).startswith("vcal-report/")
        names = [str(name) for name in content.get("files", [])]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    # Names only: a record that was tampered with must not reach outside the folder.
    return [_RECORD, *(n for n in names if Path(n).name == n and n != _RECORD)] if ours else []


def _install(work: Path, out: Path, files: Sequence[str]) -> None:
    """Move the files from `work` to `out`, those of an earlier report out of the way; undo all of
    it if anything comes in between.
    """
    fresh = not out.exists()
    out.mkdir(exist_ok=True)
    kept = work / _KEPT
    kept.mkdir()
    stale = list(dict.fromkeys([*_files_of(out), *files]))
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
