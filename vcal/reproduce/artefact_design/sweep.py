"""Seven values of the number of balls, of either offset: by theory, and machine by machine.

All designs meet the same machines (common random numbers), so that the trends show what the design
does and not which machines were drawn.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...design import ArrayPoses
from ...uncertainty.programs import Programs
from .expected import Plain, Task, bayes_um, best_plain
from .machines import Machines, calibrate
from .setting import BALLS, KNOWN, NOMINAL, OFFSETS, POSES, Known, ball_line, placed

Varied = Literal["N", "a", "b"]
VARIED: tuple[Varied, ...] = ("N", "a", "b")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Design:
    """One artefact of a sweep."""

    varied: Varied
    value: float
    """Of N, or of an offset in m."""
    poses: ArrayPoses

    @property
    def key(self) -> tuple[Varied, float]:
        """What it is called in results."""
        return self.varied, self.value


def designs() -> list[Design]:
    """The 21 designs of the publication, in its twelve strongest poses."""
    lines = POSES[next(iter(POSES))]()
    found = []
    for place, varied in enumerate(VARIED):
        for value in BALLS if varied == "N" else OFFSETS:
            numbers: list[float] = list(NOMINAL)
            numbers[place] = value
            line = ball_line(int(numbers[0]), numbers[1], numbers[2])
            found.append(Design(varied, value, placed(lines, line)))
    return found


@dataclass(frozen=True)
class Theory:
    """Expected rms on the grid, um."""

    aligned: float
    raw: float
    plain: Plain
    """The best plain least squares of order 1 to 5."""


def theory(task: Task, known: Known) -> dict[tuple[Varied, float], Theory]:
    """Both estimates for all designs."""
    found = {}
    for design in designs():
        aligned, raw = bayes_um(task, design.poses, known)
        found[design.key] = Theory(aligned, raw, best_plain(task, design.poses, known))
    return found


@dataclass(frozen=True)
class Drawn:
    """Errors of many machines, um, aligned."""

    before: np.ndarray
    after: np.ndarray

    @property
    def rms(self) -> float:
        """Root mean square over the machines, after compensation."""
        return float(np.sqrt((self.after**2).mean()))


def exact(
    task: Task,
    known: Known,
    *,
    draws: int,
    seed: int,
    programs: Programs | None = None,
    progress: Progress = lambda step: None,
) -> dict[tuple[Varied, float], Drawn]:
    """Machines with exact kinematics, measured and identified, with every design."""
    programs = programs or Programs()
    found = {}
    for design in designs():
        progress(f"machines, {known}, {design.varied} = {design.value:g}")
        made: Machines = calibrate(
            task, design.poses, known, draws=draws, seed=seed, programs=programs
        )
        found[design.key] = Drawn(made.errors("before"), made.errors("after"))
    return found


def all_theory(task: Task) -> dict[Known, dict[tuple[Varied, float], Theory]]:
    """Of all three meanings of the 2 um."""
    return {known: theory(task, known) for known in KNOWN}
