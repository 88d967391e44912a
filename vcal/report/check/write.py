"""Writing the page of `vcal check --out`."""

from collections.abc import Sequence
from pathlib import Path

from ...study.study import Study
from ..html.folder import Contents, ReportFolder
from ..html.provenance import plain, provenance_section, versions
from ..html.sheet import Section, Table, sheet
from ..machine.record import machine_record
from ..machine.section import machine_pictures, machine_section, of_study

_FOLDER = ReportFolder("check.json", "vcal-check/")


def check_check_folder(out: Path | str) -> None:
    """Check that the page of a checked study may be written to `out`.

    Raises `StudyError` as `ReportFolder.check` does.
    """
    _FOLDER.check(Path(out))


def write_check(
    study: Study, rows: Sequence[tuple[str, str]], out: Path | str, *, command: str = ""
) -> Path:
    """Write what was read of a study into the folder `out`; returns the path of its page.

    `rows` are the lines that `vcal check` prints, label and text. `index.html` is the
    self-contained page with the pictures of the declared machine, `check.json` the record for
    programs. Raises `StudyError` as `check_check_folder` does.
    """

    def make(work: Path) -> Contents:
        machine = of_study(study)
        drawn = machine_pictures(machine)
        page = sheet(
            study.name,
            f"{study.path.name} can be used.",
            [
                machine_section(machine, drawn),
                Section("What was read", tables=(Table(("", ""), list(rows)),)),
                provenance_section(study, {}, {"check.json": "the same, for programs"}, command,
                                   float("nan")),  # fmt: skip
            ],
            kicker="vcal check",
            facts=[
                ("Machine", study.chain.text),
                study.observers,
                ("Measurement", study.observations),
            ],
        )
        record = {
            "schema": f"{_FOLDER.schema}1",
            "name": study.name,
            "lines": [{"label": label, "text": text} for label, text in rows],
            "machine": plain(machine_record(machine)),
            "input_files": dict(study.hashes),
            "versions": versions(),
            "command": command,
        }
        return Contents(record, {"index.html": page}, drawn)

    return _FOLDER.publish(out, make)
