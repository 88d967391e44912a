"""The command `vcal history`: the reports of one machine over time."""

import shlex
import time
from pathlib import Path
from typing import Annotated

import typer

from .commands import Pdf, ReportFolder, app
from .printing import browser_for, print_with
from .session import guarded, say, start, telling, working


@app.command()
@guarded
def history(
    reports: Annotated[
        Path,
        typer.Argument(
            help="Folder below which the reports of one machine lie, each in a folder of its own.",
            metavar="DIR",
        ),
    ],
    out: ReportFolder,
    dates: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV table with the columns folder and date (2026-03-14): dates of measurement "
            "of reports whose studies do not state them.",
        ),
    ] = None,
    date_written: Annotated[
        bool,
        typer.Option(
            "--date-written",
            help="Where the date of measurement is not stated, take the day on which the report "
            "was written.",
        ),
    ] = False,
    alpha: Annotated[
        float,
        typer.Option(
            metavar="P",
            min=1e-6,
            max=0.5,
            help="Probability that any change is found where nothing has changed.",
        ),
    ] = 0.05,
    seed: Annotated[
        int,
        typer.Option(metavar="N", min=0, help="Seed of the draws behind numbers of tests."),
    ] = 0,
    pdf: Pdf = False,
) -> None:
    """Compare the reports of one machine over time: what has changed, when, and by how much."""
    began = time.perf_counter()
    browser = browser_for(pdf)
    start()
    from ..history import read_dates, read_history
    from ..report.history.sentences import lines, sentence
    from ..report.history.write import check_history_folder, write_history

    check_history_folder(out, [reports])  # before the work, not after it
    words = ["vcal", "history", str(reports), "--out", str(out)]
    words += ["--dates", str(dates)] * (dates is not None) + ["--date-written"] * date_written
    words += ["--alpha", f"{alpha:g}", "--seed", str(seed)]
    with working("reading the reports") as progress:
        given = {} if dates is None else read_dates(dates)
        found = read_history(reports, given, written=date_written, alpha=alpha, seed=seed)
        progress("writing the report")
        seconds = time.perf_counter() - began
        with telling(lambda: [sentence(found), *lines(found)]):
            page = write_history(found, out, command=shlex.join(words), seconds=seconds)
    say(sentence(found))
    for line in lines(found):
        say(f"  {line}")
    for note in found.notes:
        say(note)
    say(f"Report: {page}")
    print_with(browser, page)
