"""Writing the page of `vcal check --out`."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...geometry.declared_machine import DeclaredMachine, declared_machine
from ...study.outline import Outline
from ...study.study import Study
from ..html.folder import Contents, ReportFolder
from ..html.picture import by_section
from ..html.provenance import plain, provenance_section, versions
from ..html.sheet import Badge, Section, Table, sheet
from ..machine.record import machine_record
from ..machine.section import machine_pictures, machine_sections, of_study

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
                *machine_sections(machine, by_section(drawn)),
                Section("What was read", tables=(Table(("", ""), list(rows)),)),
                provenance_section(
                    study, {}, {"check.json": "the same, for programs"}, command, math.nan
                ),  # fmt: skip
            ],
            kicker="vcal check",
            facts=[
                ("Machine", study.chain.text),
                study.observers,
                ("Measurement", study.observations),
            ],
        )
        lines = [{"label": label, "text": text} for label, text in rows]
        record = {**_record(study.name, machine, study.hashes, command), "lines": lines}
        return Contents(record, {"index.html": page}, drawn)

    return _FOLDER.publish(out, make)


def write_refused(refused: Outline, why: str, out: Path | str, *, command: str = "") -> Path:
    """Write why a study is refused into the folder `out`, with the machine that it declares;
    returns the path of the page.

    As `write_check`; ``refused`` of the record is the message `why`, and None in that of a study
    that can be used. Raises `StudyError` as `check_check_folder` does.
    """

    def make(work: Path) -> Contents:
        machine = declared_machine(refused.chain, refused.sets)
        drawn = machine_pictures(machine)
        lines = [("SHA-256 of " + name, value) for name, value in refused.hashes.items()]
        page = sheet(
            refused.name,
            why,
            [
                *machine_sections(machine, by_section(drawn)),
                Section("What was read", tables=(Table(("", ""), lines),)),
            ],
            kicker="vcal check",
            badge=Badge("Refused", "bad"),
            facts=[("Machine", refused.chain.text)],
        )
        record = {**_record(refused.name, machine, refused.hashes, command), "refused": why}
        return Contents(record, {"index.html": page}, drawn)

    return _FOLDER.publish(out, make)


def _record(
    name: str, machine: DeclaredMachine, hashes: Mapping[str, str], command: str
) -> dict[str, Any]:
    return {
        "schema": f"{_FOLDER.schema}1",
        "name": name,
        "refused": None,
        "machine": plain(machine_record(machine)),
        "input_files": dict(hashes),
        "versions": versions(),
        "command": command,
    }
