"""The command `vcal certificate`: a digital calibration certificate of an identified machine."""

import datetime
from pathlib import Path
from typing import Annotated

import typer

from ..errors import StudyError
from ..files import replace_file
from .commands import Outside, Trust, app
from .compensation_commands import SOURCE, machine_of
from .session import guarded, say, start, working


@app.command()
@guarded
def certificate(
    source: Annotated[Path, SOURCE],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="The certificate, a new XML file.")
    ],
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A key of the tables machine, measurement and certificate, such as "
            "certificate.number=2026-17, in place of that in the study; of a study any key. "
            "Repeatable.",
        ),
    ] = None,
    draft: Annotated[
        bool,
        typer.Option(
            "--draft",
            help="Also where keys are missing that a certificate must state; their places then "
            "read 'not stated', and the file calls itself a draft.",
        ),
    ] = False,
    trust: Trust = False,
    allow_outside: Outside = False,
) -> None:
    """Write a digital calibration certificate (DCC) of the identified machine."""
    if out.exists():
        what = "a folder" if out.is_dir() else "a file that is there"
        raise StudyError(
            f"{out}: found {what}, expected the name of a new file; choose another name"
        )
    if not out.parent.is_dir():
        raise StudyError(
            f"{out}: found no folder {out.parent}, expected an existing one; make it first"
        )
    start()
    from ..report.certificate.contents import certificate as stated
    from ..report.certificate.dcc import dcc
    from ..study.identified_machine import is_report

    given = tuple(override or ())
    with working("reading the identified machine") as progress:
        of_study = () if is_report(source) else given
        machine = machine_of(source, of_study, (trust, allow_outside), progress)
        progress("evaluating the tests")
        found = stated(machine, () if of_study else given, draft=draft)
        text = dcc(found, datetime.date.today())
    replace_file(out, text)
    for result in found.results:
        count = len(result.values) + len(result.series)
        say(f"{result.norm}: {result.name}, {count} stated, {len(result.unknown)} not determined")
    if found.draft:
        say("This is a draft: keys that a certificate must state are missing.")
    say(f"Wrote {out}.")
