"""Averages of long recordings of circles, by the angle of the circle.

On repeated turns of one speed, positions, velocities, accelerations and directions are functions of
the angle alone. The samples of all turns of a run at nearly one angle then have one mean for the
identification: the noise of N samples is smaller by sqrt(N), and nothing is lost but what changes
from turn to turn (a drift within a run) and what repeats within the arc of an average. The mean of
an error that is a sine of the angle is smaller by (pi / N)^2 / 6 for N averages per turn, 2 x 10^-5
for 300.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..machine.circles import Circle
from ..machine.plan import Plan
from ..words import counted

SAMPLES = "samples"
"""Covariate: number of samples of which a row is the mean."""
_LONG = 50_000
"""Number of samples from which a recording is averaged without being asked for."""
_ROWS = 20_000
"""Number of averages that it then has."""
_FEWEST = 60
"""Least number of averages per turn."""


@dataclass(frozen=True)
class Averages:
    """Groups of the samples of a plan (n) that have nearly the same angle: one group per average
    (g), in the order of runs and times.
    """

    rows: Int[np.ndarray, " g"]
    """First sample of every group."""
    run: Int[np.ndarray, " g"]
    time: Float[np.ndarray, " g"]
    """Time of its mean angle in the middle turn of the run, s."""
    samples: Float[np.ndarray, " g"]
    """Number of samples."""
    group: Int[np.ndarray, " n"]
    """Group of every sample."""
    weights: Float[np.ndarray, " n"]
    """Number of samples of which every row is already the mean."""

    def of(self, values: np.ndarray) -> np.ndarray:
        """Means (g, ...) of a quantity (n, ...)."""
        columns = np.asarray(values, float).reshape(len(self.group), -1).T
        sums = [np.bincount(self.group, self.weights * column) for column in columns]
        return (np.array(sums) / self.samples).T.reshape(-1, *np.shape(values)[1:])


def samples_of(plan: Plan) -> Float[np.ndarray, " n"]:
    """Number of samples of which every row is the mean; one where it is not recorded."""
    return np.asarray(plan.covariates.get(SAMPLES, np.ones(plan.rows)), float)


def automatic(rows: int, runs: int) -> int:
    """Number of averages per turn for a recording; 0 where all samples are used."""
    return max(4 * (_ROWS // (4 * runs)), _FEWEST) if rows > _LONG else 0


def averages(
    t: Float[np.ndarray, " n"],
    run: Int[np.ndarray, " n"],
    circles: Mapping[int, Circle],
    angles: int,
    weights: Float[np.ndarray, " n"],
) -> Averages:
    """The samples of every run by their angle, in `angles` equal parts of a turn.

    The parts begin at a reversal of the axis that moves most, so that with a multiple of four none
    of them contains a reversal. Parts without a sample are left out.
    """
    group, first = np.empty(len(t), int), 0
    rows, times, runs = [], [], []
    for number, circle in circles.items():
        mine = np.flatnonzero(run == number)
        axis = int(np.argmax(circle.amplitude))
        start = float(np.arctan2(-circle.sine[axis], circle.cosine[axis]))
        turns = (circle.omega * t[mine] + start) / (2.0 * np.pi)
        within = np.mod(turns, 1.0)
        part = np.minimum((within * angles).astype(int), angles - 1)
        found, begin, index = np.unique(part, return_index=True, return_inverse=True)
        mean = np.bincount(index, weights[mine] * within) / np.bincount(index, weights[mine])
        group[mine] = first + index
        rows.append(mine[begin])
        times.append((2.0 * np.pi * (mean + np.floor(np.median(turns))) - start) / circle.omega)
        runs.append(np.full(len(found), number))
        first += len(found)
    return Averages(
        rows=np.concatenate(rows),
        run=np.concatenate(runs),
        time=np.concatenate(times),
        samples=np.bincount(group, weights),
        group=group,
        weights=weights,
    )


def words_of(rows: int, means: Averages, angles: int, radius: float) -> str:
    """What was averaged, and what that hides, in a sentence."""
    arc = 2.0 * np.pi * radius / angles
    return (
        f"{counted(rows, 'sample')} are averaged to {counted(len(means.rows), 'row')}: {angles} "
        f"angles of the circle, over all turns of a run; what repeats within {1e6 * arc:.3g} um of "
        "the path, or changes from turn to turn, cannot be seen (averages_per_turn = 0 uses all "
        "samples)"
    )
