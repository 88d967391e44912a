"""Writing the report of a closed loop."""

import datetime
import json
import math
from collections.abc import Iterable
from pathlib import Path

from ...compensation.computed_tests import line_tests
from ...compensation.machine import IdentifiedMachine
from ...compensation.stored import machine_record
from ...geometry.acceptance import geometric_tests
from ...geometry.error_motions import error_motion_tables
from ...geometry.positioning_lines import positioning_tests
from ...loop.outcome.closure import Closure
from ...startup import collected_afterwards
from ...study.identified_machine import FILE as MACHINE
from ...study.identified_machine import identified_machine
from ...study.messages import listed, refusal
from ...study.study import Study
from ..formats import FORMATS, Results
from ..html.folder import Contents, ReportFolder
from ..machine.section import machine_pictures, of_study
from .could_be_seen import could_be_seen
from .decision import decided
from .own_effect import FILE, own_effect
from .page import page
from .pictures import pictures
from .record import record
from .volumetric import scenes, volumetric_errors


def _folder() -> ReportFolder:
    return ReportFolder("report.json", "vcal-report/", sometimes=(FILE, MACHINE, *FORMATS))


def check_folder(out: Path | str, reads: Iterable[Path] = ()) -> None:
    """Check that a report may be written to `out`; `reads` are the files of the study.

    Raises `StudyError` as `ReportFolder.check` does, and where the report would replace a file
    that the study reads.
    """
    out, folder = Path(out), _folder()
    folder.check(out)
    replaced = {(out / name).resolve() for name in folder.files(out)}
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
    closure: Closure,
    study: Study,
    out: Path | str,
    *,
    command: str = "",
    seconds: float = math.nan,
    compensate_anyway: bool = False,
) -> Path:
    """Write the report of a closed loop into the folder `out`; returns the path of its page.

    `index.html` is the self-contained page, `report.json` the record for programs, `machine.json`
    the identified machine (`load_machine`); every one of the `FORMATS` adds its file. Where
    something is left unexplained, `own_effect.py` is an effect of the user's own to start from.
    Pictures lie beside them.

    The compensation table is left out where compensation does not reduce the error, unless
    `compensate_anyway`.

    Page and record quote `command` and `seconds`, the run time of the loop. Raises `StudyError` as
    `check_folder` does.
    """

    def make(work: Path) -> Contents:
        fit, others = closure.after, closure.alternatives
        tables = error_motion_tables(fit, alternatives=others)
        found = identified_machine(closure, study, datetime.date.today().isoformat())
        tests = geometric_tests(fit, alternatives=others, size=found.block)
        lines = line_tests(found)
        positioned = positioning_tests(fit)
        results = Results(closure, study, tables, tests, compensate_anyway)
        written = {name: kind().text(results) for name, kind in FORMATS.items()}
        about = {name: kind.summary for name, kind in FORMATS.items()}
        written[FILE] = own_effect(closure)
        about[FILE] = "an effect of your own to start from"
        written[MACHINE] = machine_text(found)
        about[MACHINE] = "the identified machine, for vcal compensate and vcal verify"
        texts = {name: text for name, text in written.items() if text is not None}
        files = {"report.json": "all results, for programs"} | {n: about[n] for n in texts}
        machine = of_study(study)
        errors = volumetric_errors(closure)
        with collected_afterwards():
            drawn = [*pictures(closure, tables, errors), *machine_pictures(machine)]
        run = {"command": command, "seconds": seconds}
        seen, volumetric = could_be_seen(closure, study), decided(found)
        shown = page(
            closure, study, tables, drawn, tests, positioned, lines,
            scenes=scenes(closure, errors), machine=machine, files=files, seen=seen,
            volumetric=volumetric, **run,
        )  # fmt: skip
        content = record(
            closure, study, tests, positioned, lines,
            motions=tables, seen=seen, volumetric=volumetric, **run,
        )  # fmt: skip
        return Contents(content, {"index.html": shown, **texts}, drawn)

    return _folder().publish(out, make)


def machine_text(machine: IdentifiedMachine) -> str:
    """The identified machine as strict JSON, from which it is made again without its data."""
    return json.dumps(machine_record(machine), allow_nan=False, ensure_ascii=False) + "\n"
