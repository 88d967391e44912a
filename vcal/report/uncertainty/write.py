"""Writing the report of a virtual calibration."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...study.study import Study
from ...uncertainty.virtual import VirtualCalibration
from ..html.folder import Contents, ReportFolder
from ..machine.section import machine_pictures, of_study
from .page import page
from .pictures import pictures
from .record import record

DRAWS = "draws"
"""Folder beside the report that holds an unfinished campaign."""
_FOLDER = ReportFolder("result.json", "vcal-uncertainty/", beside=DRAWS)


def check_uncertainty_folder(out: Path | str) -> None:
    """Check that the report of a virtual calibration may be written to `out`.

    An unfinished campaign may be there. Raises `StudyError` as `ReportFolder.check` does.
    """
    _FOLDER.check(Path(out))


def write_uncertainty(
    result: VirtualCalibration,
    study: Study,
    out: Path | str,
    *,
    settings: Mapping[str, Any],
    command: str = "",
    seconds: float = math.nan,
) -> Path:
    """Write the report of a virtual calibration into `out`; returns the path of its page.

    `index.html` is the self-contained page, `result.json` the record for programs; the pictures
    lie beside them. `settings` are those of the campaign, among them ``with``, the keys of the
    effects that are present but not identified; page and record quote them, `command` and
    `seconds`, the run time. Raises `StudyError` as `check_uncertainty_folder` does.
    """

    def make(work: Path) -> Contents:
        machine = of_study(study)
        drawn = [*pictures(result), *machine_pictures(machine)]
        run = {"settings": settings, "command": command, "seconds": seconds}
        shown = page(result, study, drawn, machine=machine, **run)
        return Contents(record(result, study, **run), {"index.html": shown}, drawn)

    return _FOLDER.publish(out, make)
