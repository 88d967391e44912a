"""Writing a designed measurement."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...design.optimiser import Designed, Seen
from ...study.design.written_plan import ARTEFACT, PLAN, SETUP, write_designed
from ...study.study import Study
from ..html.folder import Contents, ReportFolder
from ..machine.section import machine_pictures, of_study
from .page import page
from .pictures import pictures
from .record import record

FOLDER = ReportFolder("result.json", "vcal-design/", sometimes=(PLAN, ARTEFACT, SETUP))


def check_design_folder(out: Path | str) -> None:
    """Check that a design or a next measurement may be written to `out`.

    Raises `StudyError` as `ReportFolder.check` does, for instance for a plan that holds readings
    by now.
    """
    FOLDER.check(Path(out))


def write_design(
    done: Designed,
    seen: tuple[Seen, Seen],
    study: Study,
    out: Path | str,
    *,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    seed: int = 0,
    command: str = "",
    seconds: float = math.nan,
) -> Path:
    """Write the design into `out`, which becomes a study of its own; returns the path of its page.

    `index.html` is the self-contained page, `result.json` the record for programs; `setup.toml`,
    `plan.csv` and the other files of the study describe the designed plan; the pictures lie beside
    them. `seen` is what the present and the designed plan determine; `overrides` are those with
    which the study was read. Raises `StudyError` as `check_design_folder` and `write_designed` do.
    """

    def make(work: Path) -> Contents:
        files = write_designed(study, overrides, done.task.space, done.best, work)
        machine = of_study(study)
        drawn = [*pictures(done), *machine_pictures(machine)]
        run = {"seed": seed, "command": command, "seconds": seconds}
        shown = page(done, seen, study, drawn, machine=machine, **run)
        return Contents(record(done, seen, study, **run), {"index.html": shown}, drawn, files)

    return FOLDER.publish(out, make)
