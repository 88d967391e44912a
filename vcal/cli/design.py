"""What `vcal design` does: from its arguments to the report."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from ..design.optimise import optimise
from ..design.seen import seen
from ..io import load_study
from ..io.design import check_designed, design_task
from ..report.design import check_design_folder, write_design
from ..report.design_record import design_sentence


class Done(NamedTuple):
    """How it ended."""

    page: Path
    sentences: list[str]


def run_design(
    setup: Path,
    out: Path,
    *,
    seed: int,
    overrides: Sequence[str],
    command: str,
    progress: Callable[[str], None],
) -> Done:
    """Read a study, make its plan better and write both into `out`.

    Raises `StudyError` for what cannot be used, before anything is written.
    """
    began = time.perf_counter()
    check_design_folder(out)
    study = load_study(setup, overrides)
    task = design_task(study)
    settings = study.settings.design
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
    return Done(page, [design_sentence(done)])
