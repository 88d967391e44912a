"""Writing the next measurement."""

import math
from pathlib import Path

from ...design.next_measurement import NextMeasurement
from ...study.design.written_plan import write_plan
from ...study.study import Study
from ..design.write import FOLDER
from ..html.folder import Contents
from ..machine.section import machine_pictures, of_study
from .page import page
from .pictures import pictures
from .record import record


def write_next(
    done: NextMeasurement,
    study: Study,
    out: Path | str,
    *,
    why: str,
    seed: int = 0,
    command: str = "",
    seconds: float = math.nan,
) -> Path:
    """Write the next measurement into `out`; returns the path of its page.

    As `write_design`, but `plan.csv` holds only the further rows, without a study around them.
    `why` states the purpose of the measurement. Raises `StudyError` as `check_design_folder` does.
    """

    def make(work: Path) -> Contents:
        files = write_plan(study, done.task.space, done.best.placed, work)
        machine = of_study(study)
        drawn = [*pictures(done), *machine_pictures(machine)]
        run = {"seed": seed, "why": why, "command": command, "seconds": seconds}
        shown = page(done, study, drawn, machine=machine, **run)
        return Contents(record(done, study, **run), {"index.html": shown}, drawn, files)

    return FOLDER.publish(out, make)
