"""Seven values of the number of balls, of either offset: by theory, and machine by machine.

All designs meet the same machines (common random numbers), so that the trends show what the design
does and not which machines were drawn.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal

import numpy as np

from ...design import ArrayPoses
from ...numerics.processes import cores
from ...uncertainty.programs import Programs
from .expected import Plain, Task, bayes_um, best_plain
from .machines import Machines, calibrate
from .setting import BALLS, NOMINAL, OFFSETS, POSES, Known, ball_line, placed

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
    least_squares: Callable[[], Plain]

    @cached_property
    def plain(self) -> Plain:
        """The best plain least squares of order 1 to 5."""
        return self.least_squares()


def theory(task: Task, design: Design, known: Known) -> Theory:
    """Both estimates for a design."""
    aligned, raw = bayes_um(task, design.poses, known)
    return Theory(aligned, raw, partial(best_plain, task, design.poses, known))


@dataclass(frozen=True)
class Drawn:
    """Many machines calibrated with one design, errors in um, aligned."""

    rms: float
    """Root mean square over machines and grid, after compensation."""
    before: np.ndarray
    """At single points of single machines."""
    after: np.ndarray
    gradients: float
    """Exact gradients per identification, on average."""
    failed: int


def exact(
    task: Task,
    known: Known,
    *,
    draws: int,
    seed: int,
    programs: Programs | None = None,
    progress: Progress = lambda step: None,
    only: Sequence[tuple[Varied, float]] | None = None,
) -> dict[tuple[Varied, float], Drawn]:
    """Machines with exact kinematics, measured and identified, with every design or with some.

    Designs are computed side by side, one per core, as each number of balls is compiled anew, for
    which the compiler uses hardly more than one core.
    """
    programs = programs or Programs(brief=True)

    def one(design: Design) -> tuple[tuple[Varied, float], Drawn]:
        progress(f"machines, {known}, {design.varied} = {design.value:g}")
        made: Machines = calibrate(
            task, design.poses, known, draws=draws, seed=seed, programs=programs
        )
        return design.key, drawn(made)

    wanted = [design for design in designs() if only is None or design.key in only]
    with ThreadPoolExecutor(cores()) as pool:
        return dict(pool.map(one, wanted))


def drawn(made: Machines) -> Drawn:
    """What is kept of a campaign."""
    return Drawn(
        rms=made.rms(),
        before=made.at_points("before").ravel(),
        after=made.at_points("after").ravel(),
        gradients=made.campaign.gradients,
        failed=made.campaign.failed,
    )
