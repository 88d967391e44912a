"""The commands: each reads its arguments, calls one verb and prints the result.

Modules that only some commands need are imported inside them, so that ``vcal --help`` answers at
once.
"""

import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .. import __version__
from ..demo import starts
from ..words import counted
from . import interruption, output
from .printing import browser_for, print_with, require_page
from .session import MISTAKE, guarded, import_modules, say, start, telling, working

if TYPE_CHECKING:
    from ..fleet.one_study import Settings

app = typer.Typer(
    name="vcal",
    help="Virtual calibration of machine tools and robots. From a measurement, vcal identifies the "
    "errors of the machine and the effects that the declared model lacks; before a measurement, it "
    "predicts the uncertainty of a plan and improves the plan. Start with vcal demo, or with vcal "
    "init for a study of your own.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _folder(text: str | Path) -> Path:
    """The named folder. An empty name is refused, as it would be the working directory."""
    if not str(text).strip():
        raise typer.BadParameter(f"found {text!r}, expected the name of a folder; give one")
    return Path(text)


Setup = Annotated[
    Path, typer.Argument(help="Study file (TOML), or a folder with a setup.toml.", metavar="SETUP")
]
Override = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Replace a key of the study file for this run, for example loop.alpha=0.05. "
        "Repeatable.",
    ),
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust",
        help="Run the Python files with effects and instruments that the study names. Read them "
        "first: they can do anything that you can.",
    ),
]
Outside = Annotated[
    bool,
    typer.Option(
        "--allow-outside",
        help="Read data and tables that the study names outside its folder, also by links.",
    ),
]
ReportFolder = Annotated[
    Path,
    typer.Option(
        "--out",
        parser=_folder,
        metavar="PATH",
        help="Folder for the report: a new folder, or the folder of an earlier report, which is "
        "replaced unless a file in it was changed.",
    ),
]
Pdf = Annotated[
    bool,
    typer.Option(
        "--pdf",
        help="Print the page to a PDF beside it, with an installed Chromium, Chrome or Edge.",
    ),
]
Seed = Annotated[
    int, typer.Option(metavar="N", min=0, max=2**63 - 1, help="Seed of all random draws.")
]
NoiseFactor = Annotated[
    float, typer.Option(metavar="X", help="Factor on the declared noise of the instrument.")
]


def main() -> None:
    """Run the command line; the process ends with its exit code."""
    interruption.listen()
    output.guard()
    end: int | str | None = 0
    try:
        app()
    except KeyboardInterrupt:  # outside a command
        pass
    except SystemExit as stop:
        end = stop.code
    except Exception:
        # Where a compiled module is imported, `KeyboardInterrupt` becomes an `ImportError`.
        if not interruption.received():
            raise
    try:
        interruption.quiet()
    except KeyboardInterrupt:  # at the very end
        pass
    if interruption.received():
        what = "interrupted; all results were written before" if not end else "interrupted"
        interruption.tell_end(what)
        interruption.leave(interruption.code())
    raise SystemExit(MISTAKE if output.lost() and not end else end)


def _consent(trust: bool, allow_outside: bool) -> list[str]:
    """The options of a command that say what a study may do."""
    return ["--trust"] * trust + ["--allow-outside"] * allow_outside


def _version(wanted: bool) -> None:
    if wanted:
        say(f"vcal {__version__}")
        raise typer.Exit


_OF_A_REPORT = ("compensate", "verify")
"""Commands that begin with a report, and need nothing of the loop that wrote it."""


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    del version
    of_a_report = context.invoked_subcommand in _OF_A_REPORT
    import_modules("compensation", *(() if of_a_report else ("loop", "study.study")))


@app.command()
@guarded
def loop(
    setups: Annotated[
        list[Path],
        typer.Argument(
            help="Study file (TOML), or a folder with a setup.toml. With several, each has a "
            "report of its own below PATH/reports, and a page lists them.",
            metavar="SETUP...",
        ),
    ],
    out: ReportFolder,
    alpha: Annotated[
        float | None,
        typer.Option(
            metavar="P",
            help="False-alarm probability: share of measurements without a missing effect in which "
            "the loop may name one.",
        ),
    ] = None,
    effects: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Names of the effects to test; all of the catalogue without this option.",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of all random draws.")] = None,
    draws: Annotated[
        int | None,
        typer.Option(metavar="N", help="Simulated measurements behind every significance."),
    ] = None,
    max_effects: Annotated[
        int | None, typer.Option(metavar="N", help="Number of added effects at which to stop.")
    ] = None,
    compensate_anyway: Annotated[
        bool,
        typer.Option(
            "--compensate-anyway",
            help="Write the compensation table even where compensation does not reduce the error.",
        ),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Processes that close the loop on several studies side by side; one by default. "
            "Each takes about 1 GB of memory.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Scheduler of a Dask cluster, tcp://HOST:PORT, whose workers close the loop on "
            "several studies. They must see the same folders.",
        ),
    ] = None,
    again: Annotated[
        bool,
        typer.Option(
            "--again",
            help="Close the loop also on those of several studies whose report is up to date.",
        ),
    ] = False,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
    pdf: Pdf = False,
) -> None:
    """Find the effects that the declared model lacks, identify them, and write a report.

    An option that is not given has the value of the loop table of the study file, or the default
    of that table. With several studies, a study that cannot be used does not affect the others,
    and a repeated command leaves out those whose report is up to date.
    """
    options = {"alpha": alpha, "seed": seed, "draws": draws, "max_effects": max_effects}
    given = list(override or [])
    command = ["vcal", "loop", *map(str, setups), "--out", str(out)]
    for name, value in options.items():
        if value is not None:
            given.append(f"loop.{name}={value}")
            command += [f"--{name.replace('_', '-')}", str(value)]
    if effects is not None:
        names = [name.strip() for name in effects.split(",") if name.strip()]
        quoted = ", ".join(f'"{name}"' for name in names)
        given.append(f"loop.effects=[{quoted}]")
        command += ["--effects", effects]
    if compensate_anyway:
        command.append("--compensate-anyway")
    for text in override or []:
        command += ["--set", text]
    command += [*_consent(trust, allow_outside), *["--pdf"] * pdf, *["--again"] * again]
    from ..fleet.one_study import Settings

    if len(setups) == 1 and workers is None and scheduler is None and not again:
        settings = Settings(tuple(given), trust, compensate_anyway, allow_outside=allow_outside)
        _close(setups[0], out, settings, shlex.join(command), pdf)
        return
    command += ["--workers", str(workers)] * (workers is not None)
    command += ["--scheduler", scheduler] if scheduler is not None else []
    from .fleet import close_all

    close_all(
        setups, out, given, shlex.join(command), trust=trust, allow_outside=allow_outside,
        compensate_anyway=compensate_anyway, again=again, workers=workers, scheduler=scheduler,
        pdf=pdf,
    )  # fmt: skip


@app.command()
@guarded
def demo(
    out: ReportFolder = Path("vcal-demo"),
    pdf: Pdf = False,
) -> None:
    """Run `loop` on a bundled laser-tracker measurement with an undeclared effect."""
    from ..demo import FOLDER
    from ..fleet.one_study import Settings

    command = ["vcal", "demo", "--out", str(out), *["--pdf"] * pdf]
    _close(FOLDER / "setup.toml", out, Settings(), shlex.join(command), pdf)


def _close(
    setup: Path,
    out: Path,
    settings: "Settings",
    command: str,
    pdf: bool,
) -> None:
    began = time.perf_counter()
    start()
    from ..fleet.one_study import close_into
    from ..report import check_folder
    from .show import decision_in, show_closure
    from .so_far import SoFar

    check_folder(out)  # before the work, not after it
    browser = browser_for(pdf)
    so_far, closures = SoFar(out, command), []
    try:
        with working("reading the study") as progress:
            study, _, page = close_into(
                setup, out, settings, command, progress,
                began=began, known=so_far.known, closed=closures.append,
            )  # fmt: skip
        so_far.written()
    finally:
        for closure in closures:  # the verdict is told, whatever becomes of the report
            show_closure(closure)
    (closure,) = closures
    if study.settings.acceptance is not None and (decision := decision_in(out)):
        say(decision)
    say(f"Report: {page}")
    print_with(browser, page)
    if closure.interrupted:
        interruption.tell_end("interrupted: the report holds the results so far")
        raise typer.Exit(interruption.code())


@app.command()
@guarded
def init(
    folder: Annotated[
        Path,
        typer.Argument(
            parser=_folder, metavar="FOLDER", help="Folder to write: a new or an empty one."
        ),
    ],
    instrument: Annotated[
        str,
        typer.Option(metavar="KIND", help=f"Kind of the instrument: one of {', '.join(starts())}."),
    ] = "laser_tracker",
) -> None:
    """Write a study folder to start from: a commented study file with data or a plan."""
    from .start_studies import plans_in, write_start

    names = write_start(instrument, folder)
    say(f"Wrote {folder}: {', '.join(names)}.")
    plans = plans_in(folder)
    for name, is_plan in plans.items():
        if is_plan:
            say(f"{name} is a plan without readings: measure them, or use vcal simulate.")
        else:
            its = f"The readings in {name} were" if len(plans) > 1 else "Its data were"
            say(f"{its} simulated from the declared model, without any other effect.")
    say(f"Put your machine and data in, then: vcal check {folder / 'setup.toml'}")


@app.command("import")
@guarded
def import_(
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FILE...", help="Exports to import, with at most one URDF file."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", parser=_folder, metavar="PATH", help="Folder to write: a new or an empty one."
        ),
    ] = None,
    machine: Annotated[
        str | None,
        typer.Option(
            metavar="CHAIN|FILE",
            help="The machine: a chain such as 'w X b Y Z t', a study file or folder whose machine "
            "is taken, or a URDF file.",
        ),
    ] = None,
    tool_offset: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Vector from the frame of the last axis to the measured point, mm.",
        ),
    ] = None,
    positions: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Table of the positions of the axes or joints at the measured points, where the "
            "export does not hold them.",
        ),
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option("--format", metavar="NAME", help="Format of the files; found by default."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            metavar="UNIT[,UNIT]",
            help="Unit of lengths, and of deviations, for which the export states none.",
        ),
    ] = None,
    angle_unit: Annotated[
        str | None,
        typer.Option(metavar="UNIT", help="Unit of angles for which the export states none."),
    ] = None,
    angles: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help="Meaning of the two angles of spherical coordinates, in the order of the columns: "
            "azimuth,elevation or azimuth,zenith or zenith,azimuth.",
        ),
    ] = None,
    axis: Annotated[
        str | None,
        typer.Option(
            metavar="X|EBX|XY",
            help="Axis or error motion of an interferometer, or plane of a ball-bar record, where "
            "the export names none.",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="X=V,Y=V,...",
            help="Positions of axes that the export does not hold, mm or deg: those that stand "
            "still on a line, or of the centre of a circle.",
        ),
    ] = None,
    artefact: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Table of the calibrated centres of probed balls, or faces of a step gauge.",
        ),
    ] = None,
    contacts: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Number of contacts of a probe with each ball, or in each clamping.",
        ),
    ] = None,
    time_format: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="Format of time stamps, such as '%d/%m/%Y %H:%M:%S'."),
    ] = None,
    override: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set a key of the study file that is written, for example "
            "instrument.angle_sigma_urad=2.5. Repeatable.",
        ),
    ] = None,
    unchecked: Annotated[
        bool,
        typer.Option(
            "--unchecked", help="Write the folder even where it does not pass vcal check."
        ),
    ] = False,
    allow_outside: Annotated[
        bool,
        typer.Option(
            "--allow-outside",
            help="Read a URDF file that the study of --machine names outside its folder, also by "
            "a link.",
        ),
    ] = False,
    list_: Annotated[
        bool, typer.Option("--list", help="List the formats with their sources, and exit.")
    ] = False,
) -> None:
    """Write a study folder from exports of instruments, controllers and metrology software."""
    from .importing import run_import, show_formats

    if list_:
        show_formats()
        return
    start()
    with working("importing"):
        sentences = run_import(
            files or [],
            out,
            machine=machine,
            tool_offset=tool_offset,
            positions=positions,
            format_name=format_,
            unit=unit,
            angle_unit=angle_unit,
            angles=angles,
            axis=axis,
            at=at,
            artefact=artefact,
            contacts=contacts,
            time_format=time_format,
            overrides=override or [],
            checked=not unchecked,
            allow_outside=allow_outside,
        )
    for sentence in sentences:
        say(sentence)


@app.command()
@guarded
def simulate(
    setup: Setup,
    out: Annotated[
        Path,
        typer.Option(
            "--out", parser=_folder, metavar="PATH", help="Folder to write: a new or an empty one."
        ),
    ],
    with_: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="EFFECT",
            help="An effect of the simulated machine that the study does not declare, as "
            "NAME:PLACEMENT:KEY=VALUE,...; values that are not given are drawn from their priors. "
            "Repeatable.",
        ),
    ] = None,
    seed: Seed = 0,
    noise_factor: NoiseFactor = 1.0,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
) -> None:
    """Simulate the measurement of a study on a machine drawn from the priors.

    OUT becomes a study folder with the simulated readings at the positions of the study.
    """
    start()
    from .. import load_study
    from ..study.simulated import parse_every_with, write_simulated

    with working("simulating"):
        study = load_study(setup, override or [], trust=trust, allow_outside=allow_outside)
        place, files = study.model.setup(study.plan), study.files
        effects = parse_every_with(with_ or [], study.catalogue, place, files)
        result = write_simulated(
            study,
            out,
            effects=effects,
            seed=seed,
            noise_factor=noise_factor,
            overrides=override or [],
        )
    rows = counted(result.measurement.rows, "row")
    say(f"Wrote {out}: {rows} of a machine drawn with seed {seed}.")
    for effect in effects:
        values = (f"{p.label} = {value:.4g}" for p, value in result.values(effect))
        say(f"In it, undeclared: {effect.key}, {', '.join(values)}")


@app.command()
@guarded
def uncertainty(
    setup: Setup,
    out: ReportFolder,
    draws: Annotated[
        str,
        typer.Option(
            metavar="N|adaptive",
            help="Number of Monte Carlo draws, or adaptive: as many as JCGM 101, 7.9 requires.",
        ),
    ] = "20000",
    with_: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="EFFECT",
            help="An effect of the simulated machines that is not fitted, as "
            "NAME:PLACEMENT:KEY=VALUE,...; values that are not given are drawn from their priors. "
            "Repeatable.",
        ),
    ] = None,
    seed: Seed = 0,
    noise_factor: NoiseFactor = 1.0,
    digits: Annotated[
        int,
        typer.Option(
            metavar="N", min=1, max=2, help="Significant digits required of a standard uncertainty."
        ),
    ] = 1,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Processes with one core each that compute the draws (extra cluster), instead of "
            "threads of this one.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Scheduler of a Dask cluster, tcp://HOST:PORT, whose workers compute the draws.",
        ),
    ] = None,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
    pdf: Pdf = False,
) -> None:
    """Predict the uncertainty that a measurement plan will give, by GUM and by Monte Carlo.

    No readings are needed: of a measured study only the plan is used. The state of an interrupted
    run is kept in OUT/draws, and the same command resumes it. The folder is removed when the report
    is complete.
    """
    start()
    from .cluster import client_of
    from .uncertainty import run_virtual

    browser = browser_for(pdf)
    command = ["vcal", "uncertainty", str(setup), "--out", str(out), "--draws", draws]
    command += ["--seed", str(seed), "--noise-factor", f"{noise_factor:g}"]
    command += ["--digits", str(digits)]
    for option, texts in (("--with", with_), ("--set", override)):
        for text in texts or []:
            command += [option, text]
    command += [*_consent(trust, allow_outside), *["--pdf"] * pdf]
    command += ["--workers", str(workers)] * (workers is not None)
    command += ["--scheduler", scheduler] if scheduler is not None else []
    with client_of(workers, scheduler) as client:
        done = run_virtual(
            setup,
            out,
            draws=draws,
            effects=with_ or [],
            seed=seed,
            noise_factor=noise_factor,
            digits=2 if digits == 2 else 1,
            overrides=override or [],
            trust=trust,
            allow_outside=allow_outside,
            command=shlex.join(command),
            client=client,
        )
    say(done.sentence)
    say(f"Report: {done.page}")
    print_with(browser, done.page)
    if done.interrupted:
        interruption.tell_end(
            "interrupted: the report holds the results so far; the same command resumes"
        )
        raise typer.Exit(interruption.code())


@app.command()
@guarded
def design(
    setup: Setup,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            parser=_folder,
            metavar="PATH",
            help="Folder for the design: a new folder, or the folder of an earlier design, which "
            "is replaced unless a file in it was changed.",
        ),
    ],
    following: Annotated[
        bool,
        typer.Option("--next", help="Keep the data, and design the next rows to measure."),
    ] = False,
    separate: Annotated[
        list[str] | None,
        typer.Option(
            "--separate",
            metavar="EFFECT",
            help="With --next, given twice: separate these two effects. Written as in simulate "
            "--with.",
        ),
    ] = None,
    seed: Seed = 0,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
    pdf: Pdf = False,
) -> None:
    """Improve a measurement plan before measuring, or plan the next measurement.

    The design table of the study file sets what may vary and which criterion is minimised. OUT
    becomes a study folder of the designed plan. With --next, the present rows are kept, and OUT
    holds the rows to measure next. They minimise the criterion or, where the loop cannot decide
    between two effects, they separate these two.
    """
    start()
    from .design import run_design

    browser = browser_for(pdf)
    command = ["vcal", "design", str(setup), "--out", str(out), *(["--next"] if following else [])]
    command += ["--seed", str(seed)]
    for option, texts in (("--separate", separate), ("--set", override)):
        for text in texts or []:
            command += [option, text]
    command += [*_consent(trust, allow_outside), *["--pdf"] * pdf]
    with working("reading the study") as progress:
        done = run_design(
            setup,
            out,
            following=following,
            separate=separate or [],
            seed=seed,
            overrides=override or [],
            trust=trust,
            allow_outside=allow_outside,
            command=shlex.join(command),
            progress=progress,
        )
    for sentence in done.sentences:
        say(sentence)
    say(f"Report: {done.page}")
    print_with(browser, done.page)


@app.command()
@guarded
def reproduce(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="Name of the campaign; without a name, all are listed."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            parser=_folder,
            metavar="PATH",
            help="Folder for the results: a new folder, or the folder of earlier results, which "
            "are replaced unless a file in it was changed.",
        ),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(metavar="N", help="Monte Carlo draws; by default those of the campaign."),
    ] = None,
    seed: Seed = 0,
    pdf: Pdf = False,
) -> None:
    """Reproduce a published campaign and compare the results with the published values."""
    start()
    from ..errors import StudyError
    from ..reproduce import REPRODUCTIONS, reproduction

    if name is None:
        for one in REPRODUCTIONS.values():
            say(f"{one.name}: {one.summary}.")
        return
    wanted = reproduction(name)
    if out is None:
        raise StudyError(
            f"--out: found none, expected a folder for the results of {name}; give one"
        )
    browser = browser_for(pdf)
    number, summary = wanted.draws if draws is None else draws, []
    with working("starting") as progress, telling(lambda: summary):
        page = wanted.run(out, number, seed, progress, summary.append)
    say(f"Report: {page}")
    print_with(browser, page)


@app.command()
@guarded
def check(
    setup: Setup,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            parser=_folder,
            metavar="PATH",
            help="Folder for a page with the summary and pictures of the declared machine.",
        ),
    ] = None,
    override: Override = None,
    trust: Trust = False,
    allow_outside: Outside = False,
    pdf: Pdf = False,
) -> None:
    """Read and check a study without a fit, and print a summary of it."""
    require_page(pdf, out)
    start()
    from .. import load_study
    from .show import show_rows, study_rows

    if out is None:
        study = load_study(setup, override or [], trust=trust, allow_outside=allow_outside)
        show_rows(study, study_rows(study))
        return
    from ..errors import StudyError
    from ..report.check.write import check_check_folder, write_check, write_refused
    from ..study.outline import outline

    check_check_folder(out)  # before the work, not after it
    browser = browser_for(pdf)
    words = ["vcal", "check", str(setup), "--out", str(out)]
    for text in override or []:
        words += ["--set", text]
    command = shlex.join([*words, *["--trust"] * trust, *["--pdf"] * pdf])
    try:
        study = load_study(setup, override or [], trust=trust, allow_outside=allow_outside)
    except StudyError as error:
        # The picture of the declared machine may show why.
        seen = outline(setup, override or [], allow_outside=allow_outside)
        if seen is not None:
            mistake = str(error)
            with telling(lambda: [mistake]):
                page = write_refused(seen, mistake, out, command=command)
            say(f"Page: {page}")
            print_with(browser, page)
        raise
    rows = study_rows(study)
    show_rows(study, rows)
    page = write_check(study, rows, out, command=command)
    say(f"Page: {page}")
    print_with(browser, page)


@app.command()
@guarded
def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Name of the effect to describe in full.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            parser=_folder,
            metavar="PATH",
            help="Folder for a page with pictures of every effect, or of the named one.",
        ),
    ] = None,
    pdf: Pdf = False,
) -> None:
    """List the effects of the catalogue, or describe one of them."""
    require_page(pdf, out)
    from ..effects import CATALOGUE, effect_class
    from .show import show_catalogue, show_effect
    from .start_studies import example

    chosen = list(CATALOGUE.values()) if name is None else [effect_class(name)]
    if out is not None:
        from ..report.effects.write import write_effects

        start()
        browser = browser_for(pdf)
        page = write_effects(chosen, {e.name: example(e) for e in chosen}, out)
        say(f"Effects: {page}")
        print_with(browser, page)
    elif name is None:
        show_catalogue(chosen)
    else:
        start()
        show_effect(chosen[0], example(chosen[0]))
