"""A folder for the report of every study."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from ..study.messages import refusal
from .one_study import Job, Settings

REPORTS = "reports"
"""Folder of the reports, beside the page that lists them."""
_STUDY_FILE = "setup.toml"


def jobs_of(setups: Sequence[Path], out: Path, settings: Settings) -> list[Job]:
    """One job for every study, in their order.

    A report has the path of its study below the folder that all studies have in common. Raises
    `StudyError` for a study that is named twice.
    """
    places = [_place(setup) for setup in setups]
    for i, place in enumerate(places):
        if place in places[:i]:
            raise refusal(
                "arguments", "SETUP", f"{setups[i]} twice", "every study once", "leave one out"
            )
    top = Path(os.path.commonpath([place.parent for place in places])) if places else Path()
    names = [place.relative_to(top) for place in places]
    # A report may not lie in the folder of another one.
    inside = {parent for name in names for parent in name.parents}
    names = [name / "setup" if name in inside else name for name in names]
    return [
        Job(setup, name.as_posix(), out / REPORTS / name, _command(setup, name, out, settings))
        for setup, name in zip(setups, names, strict=True)
    ]


def _place(setup: Path) -> Path:
    """The folder of a study, or its file where that has a name of its own."""
    path = Path(os.path.abspath(setup))
    if path.name == _STUDY_FILE:
        return path.parent
    return path.with_suffix("") if path.suffix == ".toml" else path


def _command(setup: Path, name: Path, out: Path, settings: Settings) -> str:
    words = ["vcal", "loop", str(setup), "--out", str(out / REPORTS / name)]
    for text in settings.overrides:
        words += ["--set", text]
    words += ["--trust"] * settings.trust + ["--allow-outside"] * settings.allow_outside
    words += ["--compensate-anyway"] * settings.compensate_anyway
    return shlex.join(words)
