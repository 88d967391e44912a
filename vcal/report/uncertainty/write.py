"""Writing the report of a virtual calibration into a folder, whole or not at all."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...study.study import Study
from ...uncertainty.virtual import VirtualCalibration
from ..html.folder import ReportFolder
from .page import virtual_page
from .pictures import virtual_pictures
from .record import virtual_record

DRAWS = "draws"
"""Folder beside the report in which an unfinished campaign is kept."""
_PLACE = ReportFolder(record="result.json", schema="vcal-uncertainty/", beside=DRAWS)


def check_virtual_folder(out: Path | str) -> None:
    """Refuse a place that the report of a virtual calibration must not be written to.

    Raises `StudyError` for a file, for a folder that holds something but no earlier report of this
    kind and no unfinished campaign, and for one in which a file was changed since.
    """
    _PLACE.check(Path(out))


def write_virtual(
    result: VirtualCalibration,
    study: Study,
    out: Path | str,
    *,
    settings: Mapping[str, Any],
    command: str = "",
    seconds: float = math.nan,
) -> Path:
    """Write the report of a virtual calibration into `out`; returns the path of its page.

    `index.html` is the page, self-contained; `result.json` the record for programs; beside them
    the pictures. Files of an earlier report are replaced; on failure or interruption `out` stays
    as it was.

    `settings` are those of the campaign, among them ``with``, the keys of the effects that are not
    fitted; they, `command` and `seconds` (how long it took) are quoted. Raises `StudyError` as
    `check_virtual_folder` does.
    """

    def make(work: Path) -> Sequence[str]:
        drawn = list(virtual_pictures(result))
        told = {"command": command, "seconds": seconds}
        page = virtual_page(result, study, settings, drawn, **told)
        record = virtual_record(result, study, settings, **told)
        return _PLACE.write(work, {"index.html": page}, drawn, record)

    out = Path(out)
    _PLACE.fill(out, make)
    return out / "index.html"
