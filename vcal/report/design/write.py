"""Writing a designed measurement into a folder, whole or not at all."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...design.next_measurement import NextMeasurement
from ...design.optimiser import Designed, Seen
from ...study.design.written_plan import ARTEFACT, PLAN, SETUP, write_designed, write_plan
from ...study.study import Study
from ..html.folder import ReportFolder
from ..html.picture import Picture
from .next_page import following_record, next_page, next_pictures
from .page import design_page
from .pictures import design_pictures
from .record import design_record

_PLACE = ReportFolder(
    record="result.json", schema="vcal-design/", sometimes=(PLAN, ARTEFACT, SETUP)
)


def check_design_folder(out: Path | str) -> None:
    """Refuse a place that a designed measurement must not be written to.

    Raises `StudyError` for a file, for a folder that holds something but no earlier report of this
    kind, and for one in which a file was changed since, such as a plan with readings.
    """
    _PLACE.check(Path(out))


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

    `index.html` is the page, self-contained; `result.json` the record for programs; `setup.toml`,
    `plan.csv` and what else the study names the study of the designed plan; beside them the
    pictures. Files of an earlier report are replaced; on failure or interruption `out` stays as it
    was. `seen` is what the plan sees as it is and as designed; `overrides` are those the study was
    read with. Raises `StudyError` as `check_design_folder` and `write_designed` do.
    """
    told = {"seed": seed, "command": command, "seconds": seconds}
    return fill(
        Path(out),
        list(design_pictures(done)),
        lambda work: write_designed(study, overrides, done.task.space, done.best, work),
        lambda drawn: design_page(done, seen, study, drawn, **told),
        lambda: design_record(done, seen, study, **told),
    )


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

    As `write_design`, but `plan.csv` holds the further rows alone, and there is no study around
    them. `why` says what it is good for. Raises `StudyError` as `check_design_folder` does.
    """
    told = {"seed": seed, "why": why, "command": command, "seconds": seconds}
    return fill(
        Path(out),
        list(next_pictures(done)),
        lambda work: write_plan(study, done.task.space, done.best.placed, work),
        lambda drawn: next_page(done, study, drawn, **told),
        lambda: following_record(done, study, **told),
    )


def fill(
    out: Path,
    drawn: Sequence[Picture],
    tables: Callable[[Path], list[str]],
    page: Callable[[Sequence[Picture]], str],
    record: Callable[[], dict[str, Any]],
) -> Path:
    """Write pictures, tables, page and record of a design; returns the path of the page."""

    def make(work: Path) -> Sequence[str]:
        others = tables(work)
        return _PLACE.write(work, {"index.html": page(drawn)}, drawn, record(), others)

    _PLACE.fill(out, make)
    return out / "index.html"
