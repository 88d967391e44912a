"""Maxima of a candidate over its scan: shapes that the readings may not distinguish."""

from collections.abc import Sequence

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit
from .score_test import Peak, ScoreTest, Tested

_MOST = 100
"""Most local maxima that are examined."""
_NEAR = 0.5
"""Share of the highest statistic on the grid below which a local maximum is not examined: the grid
resolves every maximum to more than that."""
_SAME = 0.5
"""Steps of the scan within which two maxima are one."""


def refined_maxima(test: ScoreTest, tested: Tested, rounds: int) -> list[Peak]:
    """The maxima of an effect over its scan, between the steps of the grid, highest first.

    `rounds` is the number of refinements, each by a factor of four.
    """
    highest = tested.drops.stat.max()
    near = [peak for peak in tested.peaks(_MOST) if peak.statistic > _NEAR * highest]
    refined = sorted((test.refine(peak, rounds) for peak in near), key=lambda p: -p.statistic)
    return without_duplicates(tested.effect, refined, test.fit)


def without_duplicates(effect: Effect, peaks: Sequence[Peak], fit: Fit) -> list[Peak]:
    """The peaks in their order, without those that converged to the shape of one before."""
    grids = effect.scan(fit.measurement.plan)
    kept: list[Peak] = []
    for peak in peaks:
        if not any(
            all(
                abs(float(_steps(grids[n], peak.shape[n]) - _steps(grids[n], other.shape[n])))
                < _SAME
                for n in peak.shape
            )
            for other in kept
        ):
            kept.append(peak)
    return kept


def _steps(grid: np.ndarray, value: float) -> float:
    """A value in steps of its scan."""
    order = np.argsort(grid)
    return float(np.interp(value, grid[order], np.arange(len(grid))))
