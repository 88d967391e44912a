"""Closing the loop on one study of many, and what the list of all of them says about it."""

import json
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ..errors import StudyError
from ..loop.outcome.closure import Closure
from ..report.html.provenance import plain, versions
from ..report.loop.write import check_folder, write_report
from ..study.close_study import close_study
from ..study.plugins.trial import own_code_error
from ..study.study import Study, load_study

RECORD = "report.json"
Status = Literal["closed", "up to date", "refused", "failed", "lost", "not begun"]
"""How it ended: with a new report; with an earlier one that is still right; with a message about
the study; with an error that is not the user's; with the end of its process; not begun."""


@dataclass(frozen=True)
class Settings:
    """What holds for all studies."""

    overrides: tuple[str, ...] = ()
    """Keys that are replaced, ``"loop.alpha=0.05"``."""
    trust: bool = False
    compensate_anyway: bool = False
    again: bool = False
    """Whether studies whose report is up to date are closed again."""
    allow_outside: bool = False
    """Whether files outside the folder of a study may be read."""


@dataclass(frozen=True)
class Job:
    """One study and the folder of its report."""

    setup: Path
    """Study file or folder, as it was named."""
    name: str
    """Path of the report below the folder of all reports."""
    out: Path
    command: str = ""
    """The command that makes this report alone."""


@dataclass(frozen=True)
class Member:
    """What has become of one study."""

    job: Job
    status: Status
    message: str = ""
    """Why there is no report."""
    trace: str = field(default="", repr=False)
    """Where an error that is not the user's was raised."""
    seconds: float = 0.0
    content: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """``report.json``; empty without a report."""

    @property
    def done(self) -> bool:
        """Whether there is a report."""
        return bool(self.content)


def close_into(
    setup: Path,
    out: Path,
    settings: Settings,
    command: str = "",
    progress: Callable[[str], None] = lambda step: None,
    checked: Callable[[Study], None] = lambda study: None,
    began: float | None = None,
    known: Callable[[list[dict[str, Any]]], None] = lambda found: None,
    closed: Callable[[Closure], None] = lambda closure: None,
) -> tuple[Study, Closure, Path]:
    """Read a study, close the loop on it and write the report into `out`; the study, the closure
    and the path of the page.

    `checked` is called with the study before the loop is closed, `known` with the effects found so
    far, and `closed` with the result before the report is written. The report states the time since
    `began` (`time.perf_counter`), by default since this call. Raises `StudyError` for every
    mistake in the study, and as `check_folder` does.
    """
    began = time.perf_counter() if began is None else began
    check_folder(out)  # before the work, not after it
    study = load_study(
        setup, settings.overrides, trust=settings.trust, allow_outside=settings.allow_outside
    )
    check_folder(out, (study.folder / name for name in study.hashes))
    checked(study)
    if study.measurement is None:
        raise StudyError(
            f"{study.sets[0].file}, header: found a plan without columns of readings, expected "
            f"the readings of a {study.sets[0].settings.kind}; add the measured readings, or "
            "simulate some with `vcal simulate`"
        )
    closure = close_study(study, study.measurement, progress, known)
    closed(closure)
    progress("writing the report")
    page = write_report(
        closure,
        study,
        out,
        command=command,
        seconds=time.perf_counter() - began,
        compensate_anyway=settings.compensate_anyway,
    )
    return study, closure, page


class _UpToDateError(Exception):
    """The report of a study is what would be written again."""


def close_one(job: Job, settings: Settings) -> Member:
    """Close the loop on one study; whatever fails is told in the member, and nothing is raised but
    interruptions.
    """
    began = time.perf_counter()

    def ended(status: Status, message: str = "", trace: str = "") -> Member:
        content = content_of(job.out) if status in ("closed", "up to date") else {}
        return Member(job, status, message, trace, time.perf_counter() - began, content)

    def compare(study: Study) -> None:
        if not settings.again and up_to_date(study, job.out, settings):
            raise _UpToDateError

    try:
        close_into(job.setup, job.out, settings, job.command, checked=compare)
    except _UpToDateError:
        return ended("up to date")
    except StudyError as error:
        return ended("refused", str(error))
    except OSError as error:
        if error.filename is None:
            return ended("failed", repr(error), traceback.format_exc())
        return ended("refused", f"{error.filename}: {error.strerror}")
    except Exception as error:
        if (text := own_code_error(error)) is not None:
            return ended("refused", text)
        return ended("failed", f"{type(error).__name__}: {error}", traceback.format_exc())
    return ended("closed")


def up_to_date(study: Study, out: Path, settings: Settings) -> bool:
    """Whether the report in a folder is of the same input files, settings and versions."""
    content = content_of(out)
    if not content or content.get("interrupted") or not (out / "index.html").is_file():
        return False
    before = content.get("settings", {}).get("study"), content.get("versions")
    now = json.loads(json.dumps([plain(study.as_dict), versions()]))
    same_files = content.get("input_files") == dict(study.hashes)
    asked_for = not settings.compensate_anyway or "compensation.csv" in content.get("files", [])
    return same_files and asked_for and list(before) == now


def content_of(out: Path) -> dict[str, Any]:
    """The record of a report; empty where there is none."""
    try:
        content = json.loads((out / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
