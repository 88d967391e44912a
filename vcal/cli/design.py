"""What `vcal design` does: from its arguments to the report."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..design.next_measurement import plan_next
from ..design.optimise import optimise, seen
from ..design.separation import Separation
from ..errors import StudyError
from ..report.design import record as design_record
from ..report.design.write import check_design_folder, write_design
from ..report.next_measurement.record import carried_over, sentence
from ..report.next_measurement.write import write_next
from ..study import Study, load_study
from ..study.design.rivals import Wanted, parse_rivals, rivals_of
from ..study.design.task import check_designed, design_task
from .loop import close_study

_MORE = {"pose": 1, "point": 10}
"""Groups of the next measurement, where the study does not say."""


class Done(NamedTuple):
    """How it ended."""

    page: Path
    sentences: list[str]


def run_design(
    setup: Path,
    out: Path,
    *,
    following: bool,
    separate: Sequence[str],
    seed: int,
    overrides: Sequence[str],
    command: str,
    progress: Callable[[str], None],
) -> Done:
    """Read a study, make its plan better, or find what to measure next, and write it into `out`.

    Raises `StudyError` for what cannot be used, before anything is written.
    """
    began = time.perf_counter()
    check_design_folder(out)
    if separate and not following:
        raise StudyError(
            "--separate: found it without --next, expected both, as it is a further measurement "
            "that tells effects apart; add --next"
        )
    study = load_study(setup, overrides)
    if following:
        return _next(study, out, separate, seed, command, began, progress)
    task = design_task(study)
    settings = study.single.design
    done = optimise(
        task, seed=seed, starts=settings.starts, steps=settings.steps, progress=progress
    )
    check_designed(study, task.space, done.best)
    both = seen(task, done.nominal), seen(task, done.best)
    progress("writing the report")
    page = write_design(
        done,
        both,
        study,
        out,
        overrides=overrides,
        seed=seed,
        command=command,
        seconds=time.perf_counter() - began,
    )
    return Done(page, [design_record.sentence(done)])


def _next(
    study: Study,
    out: Path,
    separate: Sequence[str],
    seed: int,
    command: str,
    began: float,
    progress: Callable[[str], None],
) -> Done:
    settings = study.single.design
    task = design_task(study)
    wanted, why = _wanted(study, separate, progress)
    separation = None
    if wanted is not None:
        task = design_task(study, wanted.declared, wanted.others)
        separation = Separation.of(task.families[0].model, *wanted.rivals)
    done = plan_next(
        task,
        settings.more or _MORE[task.space.group],
        separation=separation,
        seed=seed,
        starts=settings.starts,
        steps=settings.steps,
        progress=progress,
    )
    progress("writing the report")
    seconds = time.perf_counter() - began
    page = write_next(done, study, out, why=why, seed=seed, command=command, seconds=seconds)
    told = [why, sentence(done), carried_over(done, study)]
    return Done(page, [line for line in told if line])


def _wanted(
    study: Study, separate: Sequence[str], progress: Callable[[str], None]
) -> tuple[Wanted | None, str]:
    """The effects to tell apart, if any, and why these or none."""
    task = design_task(study)
    if separate:
        return parse_rivals(separate, study), "The two effects were named by --separate."
    if study.measurement is None or not task.space.taken:
        return None, "There are no readings yet: what counts is the criterion of [design]."
    closure = close_study(study, study.measurement, progress)
    if closure.interrupted:
        raise KeyboardInterrupt
    wanted = rivals_of(closure, study, task)
    if wanted is not None:
        first, second = (rival.effect.key for rival in wanted.rivals)
        return wanted, (
            f"The loop was run on the data and left open whether it is {first} or {second}."
        )
    told = {
        "nothing_missing": "found nothing missing",
        "named": "named what is missing without doubt",
        "unexplained": "found something that no known effect explains",
        "ambiguous": "left open what is missing, between effects that have no size to plan with",
    }[closure.verdict or "nothing_missing"]
    return None, (
        f"The loop was run on the data and {told}: what counts is the criterion of [design]."
    )
