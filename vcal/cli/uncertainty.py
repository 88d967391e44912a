"""The command `vcal uncertainty`: from its arguments to the report."""

import contextlib
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ..errors import StudyError
from ..model.forward import Model
from ..report import DRAWS, check_uncertainty_folder, sentence, write_uncertainty
from ..study import Study, load_study
from ..study.messages import refusal
from ..study.simulated import check_noise_factor, parse_every_with
from ..uncertainty.checkpoint import STATE
from ..uncertainty.virtual import check_keys, virtual_calibration
from . import interruption
from .session import compiling, telling

_FEWEST = 11
"""Fewest draws from which a 95 % coverage interval can be formed."""
_MOST = 2**32
"""Draws have indices of 32 bits."""


class Done(NamedTuple):
    """The written report, its main sentence, and whether the run was interrupted."""

    page: Path
    sentence: str
    interrupted: bool


def run_virtual(
    setup: Path,
    out: Path,
    *,
    draws: str,
    effects: Sequence[str],
    seed: int,
    noise_factor: float,
    digits: Literal[1, 2],
    overrides: Sequence[str],
    trust: bool = False,
    allow_outside: bool = False,
    command: str,
    client: Any = None,
) -> Done:
    """Predict the uncertainty of a study's plan and write the report to `out`.

    The state of an unfinished campaign is kept in the folder ``draws`` of `out`, which is removed
    when the report is complete. Raises `StudyError` for a mistake in the input, before anything is
    written, and for an unfinished campaign with other settings.
    """
    began = time.perf_counter()
    number = parse_draws(draws)
    check_noise_factor(noise_factor)
    check_uncertainty_folder(out)
    study = load_study(setup, overrides, trust=trust, allow_outside=allow_outside)
    _check_shapes(study)
    truth = _truth(study, effects)
    settings: dict[str, Any] = {
        "draws": number,
        "seed": seed,
        "with": list(effects),
        "noise_factor": noise_factor,
        "digits": digits,
    }
    with _campaign(out) as folder, drawing() as (step, progress):
        interruption.keep(partial(_resumable, folder))
        result = virtual_calibration(
            truth,
            study.model,
            study.plan,
            draws=number,
            seed=seed,
            noise_factor=noise_factor,
            digits=digits,
            folder=folder,
            progress=progress,
            step=step,
            client=client,
        )
        step("writing the report")
        seconds = time.perf_counter() - began
        with telling(lambda: [sentence(result)]):
            page = write_uncertainty(
                result, study, out, settings=settings, command=command, seconds=seconds
            )
    if not result.ensemble.interrupted:
        interruption.keep(lambda: f"interrupted; the report in {out} is complete")
        shutil.rmtree(folder)
    return Done(page, sentence(result), result.ensemble.interrupted)


def _resumable(folder: Path) -> str:
    """What an interruption leaves of the draws."""
    if not (folder / STATE).exists():
        return "interrupted; nothing was written"
    return f"interrupted: the draws so far are in {folder}; the same command resumes"


def parse_draws(text: str) -> int | Literal["adaptive"]:
    """The requested number of draws; raises `StudyError` for any other text."""
    if text == "adaptive":
        return "adaptive"
    try:
        number = int(text)
    except ValueError:
        number = 0
    if not _FEWEST <= number <= _MOST:
        raise refusal(
            "--draws",
            "value",
            repr(text),
            f"a whole number from {_FEWEST} to 2^32, or 'adaptive'",
            "correct it",
        )
    return number


def _check_shapes(study: Study) -> None:
    """Raise `StudyError` for a free shape of an effect without a size.

    The plan is linearised at the nominal machine, where an effect of zero size has no derivative by
    its shape.
    """
    for effect in study.model.effects:
        sizes = effect.amplitudes
        declared = {name for name, *_ in effect.given}
        for p in effect.shapes:
            if p.moves and p.name not in declared and not any(size.mean for size in sizes):
                raise refusal(
                    study.path.name,
                    f"[[model.effect]] {effect.key}, key {p.label}",
                    f"no value, and no {' or '.join(size.label for size in sizes)} at which a "
                    f"measurement would determine {p.name}",
                    "one of them, as the uncertainty is computed at the declared values",
                    f"give {p.label}, or a size with its sigma",
                )


def _truth(study: Study, effects: Sequence[str]) -> Model:
    """The declared model with the effects of ``--with``, which are simulated but not fitted."""
    model = study.model
    found = parse_every_with(effects, study.catalogue, model.setup(study.plan), study.files)
    for i, (text, effect) in enumerate(zip(effects, found, strict=True)):
        try:
            check_keys(model.with_effects(*found[: i + 1]))
        except ValueError:
            raise StudyError(
                f"--with {text}: found {effect.key!r} a second time, expected an effect that is "
                "neither declared in the study nor given before; leave it out"
            ) from None
    return model.with_effects(*found)


@contextlib.contextmanager
def _campaign(out: Path) -> Iterator[Path]:
    """The folder of the campaign in `out`; removed after a failure, with `out`, if it is empty."""
    missing = [p for p in (out, *out.absolute().parents) if not p.exists()]
    folder = out / DRAWS
    try:
        yield folder
    except BaseException:
        for path in (folder, *missing):
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


@contextlib.contextmanager
def drawing() -> Iterator[tuple[Callable[[str], None], Callable[[int, int], None]]]:
    """Show the progress of the draws on a terminal; yields two functions.

    The first takes the name of the current step, the second the number of finished draws and of all
    draws, from which the time left is estimated. Compilations are counted beside the step, as the
    draws do not move meanwhile. Silent where stderr is not a terminal. The display is removed at
    the end.
    """
    if not sys.stderr.isatty():
        yield lambda step: None, lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    what = {"step": "reading the study", "compiling": ""}
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what["step"], total=None)

        def show(**changes: str) -> None:
            what.update(changes)
            bar.update(task, description=", ".join(filter(None, what.values())))

        def step(text: str) -> None:
            show(step=text)

        def progress(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        with compiling(lambda text: show(compiling=text)):
            yield step, progress
