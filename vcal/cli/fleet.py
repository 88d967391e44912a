"""The command `vcal loop` with several studies."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import typer

from ..fleet import Settings, close_fleet
from ..fleet.one_study import Member
from ..words import counted
from . import interruption
from .cluster import check_one, client_of
from .printing import browser_for, print_with
from .session import MISTAKE, say, start, tell, working

_FEW = 10
"""Most studies without a report that are listed."""


def close_all(
    setups: list[Path],
    out: Path,
    overrides: list[str],
    command: str,
    *,
    trust: bool,
    allow_outside: bool,
    compensate_anyway: bool,
    again: bool,
    workers: int | None,
    scheduler: str | None,
    pdf: bool,
) -> None:
    """Close the loop on several studies and print what has become of them.

    Exits with code 2 where a study has no report, and with 130 after an interruption.
    """
    check_one(workers, scheduler)
    browser = browser_for(pdf)
    start()
    settings = Settings(tuple(overrides), trust, compensate_anyway, again, allow_outside)
    members: list[Member] = []
    try:
        with (
            client_of(None, scheduler) as client,
            working(f"closing the loop on {counted(len(setups), 'study', 'studies')}") as progress,
        ):
            fleet = close_fleet(
                setups, out, settings,
                workers=workers or 1, client=client, command=command, progress=progress,
                ended=members.extend,
            )  # fmt: skip
    finally:
        if members:  # whatever becomes of the page
            _show(members)
    say(f"Page: {fleet.page}")
    print_with(browser, fleet.page)
    if fleet.interrupted:
        interruption.tell_end("interrupted: repeat the command to go on")
        raise typer.Exit(interruption.code())
    if not all(one.done for one in fleet.members):
        raise typer.Exit(MISTAKE)


def _show(members: Sequence[Member]) -> None:
    """Print what has become of all studies."""
    counts = Counter(one.status for one in members)
    closed, kept = counts["closed"], counts["up to date"]
    said = f"{counted(closed, 'study', 'studies')} closed"
    say(f"{said}, {kept} up to date, {len(members) - kept - closed} without a report.")
    without = [one for one in members if one.status in ("refused", "failed", "lost")]
    for one in without[:_FEW]:
        tell(f"{one.job.name}: {one.message}")
    if len(without) > _FEW:
        tell(f"... and {len(without) - _FEW} more; the page lists all")
