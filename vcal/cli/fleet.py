"""The command `vcal loop` with several studies."""

from pathlib import Path
from typing import Any

import typer

from ..errors import StudyError
from ..fleet import Fleet, Settings, close_fleet
from ..study.messages import refusal
from ..words import counted
from .printing import browser_for, print_with
from .session import INTERRUPTED, MISTAKE, say, start, tell, working

_FEW = 10
"""Most studies without a report that are listed."""


def close_all(
    setups: list[Path],
    out: Path,
    overrides: list[str],
    command: str,
    *,
    trust: bool,
    compensate_anyway: bool,
    again: bool,
    workers: int | None,
    scheduler: str | None,
    pdf: bool,
) -> None:
    """Close the loop on several studies and print what has become of them.

    Exits with code 2 where a study has no report, and with 130 after an interruption.
    """
    if workers is not None and scheduler is not None:
        raise refusal(
            "options", "--workers and --scheduler", "both", "one of them",
            "leave --workers out: the cluster has workers of its own",
        )  # fmt: skip
    browser = browser_for(pdf)
    start()
    settings = Settings(tuple(overrides), trust, compensate_anyway, again)
    client = None if scheduler is None else _client(scheduler)
    with working(f"closing the loop on {counted(len(setups), 'study', 'studies')}") as progress:
        fleet = close_fleet(
            setups, out, settings,
            workers=workers or 1, client=client, command=command, progress=progress,
        )  # fmt: skip
    _show(fleet)
    say(f"Page: {fleet.page}")
    print_with(browser, fleet.page)
    if fleet.interrupted:
        tell("interrupted: repeat the command to go on")
        raise typer.Exit(INTERRUPTED)
    if not all(one.done for one in fleet.members):
        raise typer.Exit(MISTAKE)


def _client(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise refusal(
            "option", "--scheduler", "no package distributed", "Dask",
            "install it with pip install 'vcal[cluster]'",
        ) from None  # fmt: skip
    try:
        return Client(address)
    except (OSError, ValueError) as error:
        raise StudyError(
            f"option --scheduler: found {address!r}, at which no scheduler answers ({error}), "
            "expected the address of a running Dask scheduler, tcp://HOST:PORT; start one with "
            "dask scheduler, and workers with dask worker ADDRESS"
        ) from error


def _show(fleet: Fleet) -> None:
    kept, closed = len(fleet.having("up to date")), len(fleet.having("closed"))
    said = f"{counted(closed, 'study', 'studies')} closed"
    say(f"{said}, {kept} up to date, {len(fleet.members) - kept - closed} without a report.")
    without = fleet.having("refused", "failed", "lost")
    for one in without[:_FEW]:
        tell(f"{one.job.name}: {one.message}")
    if len(without) > _FEW:
        tell(f"... and {len(without) - _FEW} more; the page lists all")
