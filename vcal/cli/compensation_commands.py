"""The commands `vcal compensate` and `vcal verify`: from an identified machine to a control."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import StudyError
from ..startup import importing
from .commands import Outside, Override, Trust, _folder, app
from .session import guarded, say, start, working

if TYPE_CHECKING:
    from ..compensation import Compensation, IdentifiedMachine, Verified

SOURCE = typer.Argument(
    help="Report of vcal loop (its folder, report.json or machine.json), or a study file or "
    "folder, whose loop is closed first.",
    metavar="REPORT|STUDY",
)
OptionsOf = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="KEY=VALUE",
        help="An option of the format, such as points=21. Repeatable; --list shows all of them.",
    ),
]
At = Annotated[
    list[str] | None,
    typer.Option(
        "--at",
        metavar="CONDITION=VALUE",
        help="Condition for which tables are made that cannot vary with it, such as T_Z=23.5 "
        "(degC); by default its mean in the measurement. Repeatable.",
    ),
]


@app.command()
@guarded
def compensate(
    source: Annotated[Path | None, SOURCE] = None,
    to: Annotated[
        str | None, typer.Option("--to", metavar="FORMAT", help="The format; --list shows all.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            parser=_folder,
            metavar="PATH",
            help="Folder for the files: a new folder, or that of an earlier compensation.",
        ),
    ] = None,
    option: OptionsOf = None,
    at: At = None,
    nc: Annotated[
        Path | None,
        typer.Option(
            "--nc",
            metavar="PROGRAM",
            help="Correct the positions of this NC program instead; --out is the new program.",
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            "--tolerance", metavar="UM", help="Largest chordal error of the correction, um."
        ),
    ] = None,
    work_offset: Annotated[
        list[str] | None,
        typer.Option(
            "--work-offset",
            metavar="NAME=X,Y,Z",
            help="Work offset of the program in mm, such as G54=150,80,-300. Repeatable.",
        ),
    ] = None,
    ignore_code: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore-code",
            metavar="CODE",
            help="A further G code that moves nothing, such as G187. Repeatable.",
        ),
    ] = None,
    anyway: Annotated[
        bool,
        typer.Option(
            "--compensate-anyway", help="Also where compensation does not reduce the error."
        ),
    ] = False,
    list_: Annotated[
        bool, typer.Option("--list", help="List the formats with their options, and end.")
    ] = False,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
) -> None:
    """Write the files with which a control compensates the identified errors."""
    if list_:
        _list_formats()
        return
    given = {"REPORT|STUDY": source, "--to": nc or to, "--out": out}
    for name, value in given.items():
        if value is None:
            raise StudyError(
                f"{name}: found none, expected one; give it, or list the formats with --list"
            )
    assert source is not None and out is not None
    for flag, text in (("--tolerance", tolerance), ("--work-offset", work_offset),
                       ("--ignore-code", ignore_code)):  # fmt: skip
        if text and nc is None:
            raise StudyError(
                f"{flag}: found it without --nc, expected an NC program; name the program with --nc"
            )
    if nc is not None and to is not None:
        raise StudyError(
            "--nc: found it together with --to, expected one of them; a program is corrected for "
            "any control"
        )
    start()
    if nc is not None:
        from .nc_program import corrected_program, nc_options

        wanted = nc_options(tolerance, work_offset or [], ignore_code or [])
        conditions = options_of(option or [], at or []).get("at", {})
        with working("reading the identified machine") as progress:
            machine = machine_of(source, override or [], (trust, allow_outside), progress)
            _check_gain(machine, source, anyway)
        corrected_program(machine, nc, out, wanted, conditions)
        return
    assert to is not None
    from ..compensation import FORMATS
    from ..compensation import compensate as built
    from ..report.compensation.write import check_compensation_folder, write_compensation

    if to == "dcc":
        raise StudyError(
            "--to: found 'dcc', expected a format of compensation; write a digital calibration "
            "certificate with vcal certificate"
        )
    FORMATS.named(to)  # before the work, not after it
    options = options_of(option or [], at or [])
    reads = [source if source.is_dir() else source.parent]
    check_compensation_folder(out, reads)
    words = ["vcal", "compensate", str(source), "--to", to, "--out", str(out)]
    for flag, texts in (("--option", option), ("--at", at), ("--set", override)):
        words += [word for text in texts or [] for word in (flag, text)]
    with working("reading the identified machine") as progress:
        machine = machine_of(source, override or [], (trust, allow_outside), progress)
        _check_gain(machine, source, anyway)
        progress("building the compensation")
        found = built(machine, to, options)
        files = write_compensation(found, out, command=shlex.join(words))
    _show(found, out, files)


def _check_gain(machine: "IdentifiedMachine", source: Path, anyway: bool) -> None:
    if machine.no_gain and not anyway:
        raise StudyError(
            f"{source}: {machine.no_gain} Nothing was written; use --compensate-anyway to "
            "write the files all the same"
        )


@app.command()
@guarded
def verify(
    source: Annotated[Path, SOURCE],
    to: Annotated[
        list[str] | None,
        typer.Option(
            "--to", metavar="FORMAT", help="A format to compare; repeatable. All without it."
        ),
    ] = None,
    option: OptionsOf = None,
    at: At = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="Without the best rigid alignment of the points.")
    ] = False,
    draws: Annotated[
        int, typer.Option(metavar="N", min=2, help="Machines drawn from the posterior.")
    ] = 400,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the draws.")] = 0,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
) -> None:
    """Predict the volumetric error before and after compensation, for every format."""
    start()
    from ..compensation import FORMATS, Verified
    from ..compensation import compensate as built
    from ..compensation import verify as verified

    asked = [FORMATS.named(name).name for name in to or FORMATS]
    if option and len(asked) != 1:
        raise StudyError(
            "--option: found options for several formats, expected one format with --to; name it"
        )
    options = options_of(option or [], at or [])
    found: dict[str, Verified] = {}
    refused: dict[str, str] = {}
    with working("reading the identified machine") as progress:
        machine = machine_of(source, override or [], (trust, allow_outside), progress)
        found["without"] = verified(machine, draws=draws, seed=seed)
        for name in asked:
            progress(f"simulating the machine with {name}")
            try:
                tables = built(machine, name, options, parts=False).tables
            except StudyError as error:
                refused[name] = str(error)
                continue
            found[name] = verified(machine, tables, draws=draws, seed=seed)
    if machine.no_gain:
        say(machine.no_gain)
    _show_verified(found, raw)
    for text in refused.values():
        say(f"refused: {text}")
    if refused and not found.keys() - {"without"}:
        raise StudyError(f"{source}: no format that was asked for takes this machine")


def _show_verified(found: "Mapping[str, Verified]", raw: bool) -> None:
    """One line per format: rms and largest error at every place, with standard uncertainty."""
    from ..report.html.text import rounded

    how = "without alignment" if raw else "after the best rigid alignment"
    places = list(found["without"].raw)
    heads = [head for place in places for head in (f"{place}: rms", "largest")]
    rows = [["expected error, um", *heads]]
    for name, one in found.items():
        each = one.raw if raw else one.aligned
        drawn = [d for place in places for d in (each[place].rms, each[place].largest)]
        rows.append([name, *(" ± ".join(rounded(d.mean, d.u)) for d in drawn)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *cells in rows:
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        say("  ".join([first.ljust(widths[0]), *padded]))
    say(f"Mean ± standard deviation over machines drawn from the posterior, {how}.")


def machine_of(
    source: Path,
    overrides: Sequence[str],
    consent: tuple[bool, bool],
    progress: Callable[[str], None],
) -> "IdentifiedMachine":
    """The identified machine of a report, or of a study whose loop is closed.

    `consent` holds whether code of the study may be run, and whether files outside its folder may
    be read. Raises `StudyError` where it is neither, and as the loop does.
    """
    from ..study.identified_machine import identified_machine, is_report, load_machine

    if is_report(source):
        if overrides:
            raise StudyError(
                f"--set: found an override of a study with the report {source}, expected a study; "
                "name the study instead"
            )
        return load_machine(source)
    with importing():  # the loop and all it stands on, which a report does not need
        from .. import load_study
        from ..study.close_study import close_study
    study = load_study(source, list(overrides), trust=consent[0], allow_outside=consent[1])
    if study.measurement is None:
        raise StudyError(
            f"{study.sets[0].file}, header: found a plan without readings, expected a measurement; "
            "add the measured readings, or simulate some with `vcal simulate`"
        )
    return identified_machine(close_study(study, study.measurement, progress), study)


def options_of(option: Sequence[str], at: Sequence[str]) -> dict[str, Any]:
    """Options of a format from ``KEY=VALUE``. Raises `StudyError` for a text of another form."""
    found: dict[str, Any] = dict(_pairs("--option", option))
    conditions: dict[str, float] = {}
    for name, text in _pairs("--at", at).items():
        try:
            conditions[name] = float(text)
        except ValueError as error:
            raise StudyError(
                f"--at: found {name}={text!r}, expected a number, as in T_Z=23.5; correct it"
            ) from error
    return found | ({"at": conditions} if conditions else {})


def _pairs(flag: str, texts: Sequence[str]) -> dict[str, str]:
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (equals and name.strip()):
            raise StudyError(f"{flag}: found {text!r}, expected KEY=VALUE; correct it")
        found[name.strip()] = value.strip()
    return found


def _list_formats() -> None:
    from ..compensation import FORMATS

    for name, kind in FORMATS.items():
        say(f"{name}: {kind.summary}")
        say(f"  sign: {kind.sign}")
        say(f"  units: {kind.units}; resolution: {kind.resolution}")
        say(f"  limits: {kind.limits}")
        say(f"  source: {kind.source}")
        for key, about in kind.options.model_fields.items():
            if key != "at":
                what = f" ({about.description})" if about.description else ""
                say(f"  option {key}={about.get_default()}{what}")


def _show(found: "Compensation", out: Path, files: Sequence[str]) -> None:
    for part in found.carried:
        say(f"carried:        {part.name} ({part.rms_um:.3g} um rms at the tool)")
    for part in found.not_carried:
        because = f": {part.reason}" if part.reason else ""
        say(
            f"not carried:    {part.name}: {part.stays_rms_um:.3g} um rms, largest "
            f"{part.stays_largest_um:.3g} um stay of {part.rms_um:.3g} um rms{because}"
        )
    for name in found.not_identified:
        say(f"not identified: {name}: the readings know nothing of it; zero in the files")
    say(f"Wrote {out}: {', '.join(files)}.")
