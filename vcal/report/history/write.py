"""Writing the report of a history."""

import math
from collections.abc import Iterable
from pathlib import Path

from ...history import History
from ...study.messages import refusal
from ..html.folder import Contents, ReportFolder
from .page import page
from .pictures import pictures
from .record import record

_FOLDER = ReportFolder("history.json", "vcal-history/")


def check_history_folder(out: Path | str, reads: Iterable[Path | str] = ()) -> None:
    """Check that a history may be written to `out`, which must not be a folder that is read.

    Raises `StudyError` as `ReportFolder.check` does.
    """
    if any(Path(out).resolve() == Path(one).resolve() for one in reads):
        raise refusal(
            str(out), "output folder", "the folder that is read", "a folder of its own",
            "choose another",
        )  # fmt: skip
    _FOLDER.check(Path(out))


def write_history(
    history: History, out: Path | str, *, command: str = "", seconds: float = math.nan
) -> Path:
    """Write the report of a history into `out`; returns the path of its page.

    `index.html` is the self-contained page, `history.json` the record for programs; the pictures
    lie beside them. Raises `StudyError` as `check_history_folder` does.
    """

    def make(work: Path) -> Contents:
        drawn = list(pictures(history))
        shown = page(history, drawn, command=command, seconds=seconds)
        return Contents(
            record(history, command=command, seconds=seconds), {"index.html": shown}, drawn
        )

    return _FOLDER.publish(out, make)
