"""The command `vcal design`: from its arguments to the report."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..design.next_measurement import plan_next
from ..design.optimiser import Task, optimise, seen
from ..design.separation import Separation
from ..errors import StudyError
from ..report.design import record as design_record
from ..report.design.write import check_design_folder, write_design
from ..report.next_measurement.record import carried_over, sentence
from ..report.next_measurement.write import write_next
from ..study import Study, load_study
from ..study.close_study import close_study
from ..study.design.rivals import Wanted, parse_rivals, rivals_of
from ..study.design.task import StudyDesign, check_designed
from .session import telling

_MORE = {"pose": 1, "point": 10, "setup": 1}
"""Default size of the next measurement, by the group that a space places."""


class Done(NamedTuple):
    """The written report and the sentences to print."""

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
    trust: bool = False,
    allow_outside: bool = False,
    command: str,
    progress: Callable[[str], None],
) -> Done:
    """Improve the plan of a study, or design its next measurement, and write the report to `out`.

    Raises `StudyError` for a mistake in the input, before anything is written.
    """
    began = time.perf_counter()
    check_design_folder(out)
    if separate and not following:
        raise StudyError(
            "--separate: found it without --next, expected both, as a further measurement is what "
            "separates effects; add --next, or leave out --separate"
        )
    study = load_study(setup, overrides, trust=trust, allow_outside=allow_outside)
    if following:
        return _next(study, out, separate, seed, command, began, progress)
    task = StudyDesign.of(study).task()
    settings = study.single.design
    done = optimise(
        task, seed=seed, starts=settings.starts, steps=settings.steps, progress=progress
    )
    check_designed(study, task.space, done.best)
    both = seen(task, done.nominal), seen(task, done.best)
    progress("writing the report")
    with telling(lambda: [design_record.sentence(done)]):
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
    task, separation, why = _question(study, separate, progress)
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
    sentences = [why, sentence(done), carried_over(done, study)]
    with telling(lambda: [line for line in sentences if line]):
        page = write_next(done, study, out, why=why, seed=seed, command=command, seconds=seconds)
    return Done(page, [line for line in sentences if line])


def _question(
    study: Study, separate: Sequence[str], progress: Callable[[str], None]
) -> tuple[Task, Separation | None, str]:
    """The design task of the next measurement, the effects to separate, if any, and the reason.

    Without rivals it is the task of the study. With rivals, these leave the declared model, and the
    other effects that the loop found join it.
    """
    design = StudyDesign.of(study)
    if separate:
        wanted = parse_rivals(separate, study)
        return *_separating(design.task(wanted.declared), wanted), (
            "The two effects were named by --separate."
        )
    task = design.task()
    if study.measurement is None or not task.space.taken:
        return task, None, "There are no readings yet: the criterion of [design] decides."
    closure = close_study(study, study.measurement, progress)
    if closure.interrupted:
        raise KeyboardInterrupt
    wanted = rivals_of(closure, study, task)
    if wanted is not None:
        first, second = (rival.effect.key for rival in wanted.rivals)
        if wanted.declared or wanted.others:
            task = design.task(wanted.declared, wanted.others)
        return *_separating(task, wanted), (
            f"The loop was run on the data and could not decide between {first} and {second}."
        )
    outcome = {
        "nothing_missing": "found nothing missing",
        "named": "identified the missing effect with certainty",
        "unexplained": "found a significant deviation that no known effect explains",
        "ambiguous": "could not decide between effects that have no size to plan with",
    }[closure.verdict or "nothing_missing"]
    why = f"The loop was run on the data and {outcome}: the criterion of [design] decides."
    return task, None, why


def _separating(task: Task, wanted: Wanted) -> tuple[Task, Separation]:
    return task, Separation.of(task.families[0].model, *wanted.rivals)
