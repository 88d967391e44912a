"""Writing the report of a closure into a folder, whole or not at all."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from ...geometry.acceptance import geometric_tests
from ...geometry.error_motions import error_motion_tables
from ...loop.outcome.closure import Closure
from ...study.messages import listed, refusal
from ...study.study import Study
from ..html.folder import ReportFolder
from .own_effect import FILE, own_effect
from .page import page
from .pictures import pictures
from .record import record
from .tables import compensation_csv, effects_csv

_PLACE = ReportFolder(record="report.json", schema="vcal-report/", sometimes=(FILE,))


def check_folder(out: Path | str, reads: Iterable[Path] = ()) -> None:
    """Refuse a place that a report must not be written to; `reads` are the files of the study.

    Raises `StudyError` for a file, for a folder that holds something but no earlier report, and
    for one in which the report would replace what was changed since, or what the study reads.
    """
    out = Path(out)
    _PLACE.check(out)
    replaced = {(out / name).resolve() for name in _PLACE.files(out)}
    used = sorted(path.name for path in reads if path.resolve() in replaced)
    if used:
        raise refusal(
            str(out),
            "output folder",
            f"{listed(used)}, which the study reads",
            "no file of the study among those to be replaced",
            "rename or move it and name it so in the study, or choose another folder",
        )


def write_report(
    closure: Closure, study: Study, out: Path | str, *, command: str = "", seconds: float = math.nan
) -> Path:
    """Write the report of a closure into the folder `out`; returns the path of its page.

    `index.html` is the page, self-contained; `report.json` the record for programs;
    `compensation.csv` the error motions and `effects.csv` the effects, named and declared;
    `own_effect.py`, where something is left unexplained, an effect of the user's own to start from;
    beside them the pictures. Files of an earlier report are replaced, others are left alone. All is
    made in a temporary folder and moved at the end: on failure or interruption `out` stays as it
    was.

    `command` and `seconds` (how long the loop took) are quoted. Raises `StudyError` where `out` is
    a file, or a folder with other things or with changed files in it (`check_folder`).
    """
    out = Path(out)
    _PLACE.fill(out, lambda work: _make(closure, study, work, command, seconds))
    return out / "index.html"


def _make(
    closure: Closure, study: Study, work: Path, command: str, seconds: float
) -> Sequence[str]:
    """All files of the report in the folder `work`; returns their names."""
    tables = error_motion_tables(closure.after, alternatives=closure.alternatives)
    size = 0 if closure.check is None else closure.check.plan.rows
    tests = geometric_tests(closure.after, alternatives=closure.alternatives, size=size)
    drawn = list(pictures(closure, tables))
    told = {"command": command, "seconds": seconds}
    texts = {
        "index.html": page(closure, study, tables, drawn, tests, **told),
        "compensation.csv": compensation_csv(tables),
        "effects.csv": effects_csv(closure),
    }
    template = own_effect(closure)
    if template is not None:
        texts[FILE] = template
    return _PLACE.write(work, texts, drawn, record(closure, study, tests, **told))
