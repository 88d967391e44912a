"""The precision of a Monte Carlo campaign, and the stopping rule of an adaptive one: JCGM 101, 7.9.

The draws are taken in consecutive sub-blocks of M = max(J, 10 000), J the smallest integer not
below 100/(1 - p), rounded up to whole blocks. Estimate y, standard uncertainty u and both ends of
the coverage interval of every sub-block scatter about their averages. This scatter gives the
standard deviation of an average over h sub-blocks: s^2 = sum (. - mean)^2 / (h (h - 1)).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .intervals import Kind, coverage_interval

_STEP = 10_000
"""Least number of draws in a sub-block (JCGM 101, 7.9.4 b)."""


class Precision(NamedTuple):
    """Standard deviations of Monte Carlo results, one per scalar output, in its unit.

    Infinite for fewer than two sub-blocks.
    """

    y: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class Adaptive:
    """The end state of an adaptive campaign (JCGM 101, 7.9.4)."""

    settled: bool
    """Whether every output is stable. Otherwise the largest number of draws was reached, or an
    output is finite in no draw.
    """
    digits: int
    """Required significant decimal digits of u."""
    steps: int
    """Sub-blocks of draws, h."""
    tolerance: Float[np.ndarray, " k"]
    """delta of every scalar output."""
    precision: Precision
    """Standard deviations s; an output is stable where 2 s <= delta for all four."""
    done: bool = False
    """Whether further draws would change nothing: every output is stable, or finite in no draw."""

    @property
    def stable(self) -> np.ndarray:
        """Whether each output is stable (k,)."""
        return np.all([2.0 * s <= self.tolerance for s in self.precision], axis=0)


class StepResults(NamedTuple):
    """Results of one sub-block of draws."""

    results: Float[np.ndarray, "4 k"]
    """Estimate, standard uncertainty and both ends of the coverage interval of every output."""
    enough: Bool[np.ndarray, " k"]
    """Whether the output has enough finite values for an interval."""


class Steps:
    """Running averages of the results of consecutive sub-blocks of draws."""

    def __init__(self, size: int, step: int, coverage: float, kind: Kind):
        self.step, self.coverage = step, coverage
        self.kind: Kind = kind
        self.steps = 0
        """Sub-blocks finished."""
        self.count = np.zeros(size, np.int64)
        """Sub-blocks in which the output has an interval, that is, enough finite values."""
        self.mean = np.zeros((4, size))
        self.squares = np.zeros((4, size))
        self.waiting: list[np.ndarray] = []
        """Draws of the unfinished sub-block."""

    def add(self, values: Float[np.ndarray, "n k"]) -> None:
        """Add draws in order."""
        for start in range(0, len(values), self.step):
            self._add(values[start : start + self.step])

    def precision(self, steps: int | None = None) -> Precision:
        """Standard deviations of averages over `steps` sub-blocks (default: all of these)."""
        enough = self.count > 1
        variance = self.squares / np.where(enough, self.count - 1, 1)
        over = self.count if steps is None else np.full_like(self.count, steps)
        deviation = np.sqrt(variance / np.maximum(over, 1))
        return Precision(*np.where(enough, deviation, np.inf))

    def adaptive(self, u: Float[np.ndarray, " k"], digits: int) -> Adaptive:
        """Verdict on the draws so far, whose standard uncertainty is `u`."""
        delta = np.array([numerical_tolerance(float(value), digits) for value in u])
        precision = self.precision()
        # An output that is finite in no draw has no interval, whatever the number of draws: nothing
        # more can be reached, but it is not stable.
        finite = self.count > 0
        done = self.steps > 1 and all(bool(np.all((2.0 * s <= delta)[finite])) for s in precision)
        settled = done and bool(finite.all())
        return Adaptive(settled, digits, self.steps, delta, precision, done)

    def arrays(self) -> dict[str, np.ndarray]:
        """The state as arrays, for `restore`."""
        size = len(self.count)
        return {
            "steps": np.array(self.steps),
            "count": self.count,
            "mean": self.mean,
            "squares": self.squares,
            "waiting": np.concatenate([np.empty((0, size)), *self.waiting]),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore the state from `arrays`."""
        self.steps = int(arrays["steps"])
        self.count, self.mean = arrays["count"], arrays["mean"]
        self.squares, self.waiting = arrays["squares"], [arrays["waiting"]]

    def _add(self, values: Float[np.ndarray, "n k"]) -> None:
        """Add draws that finish at most one sub-block."""
        missing = self.step - sum(map(len, self.waiting))
        self.waiting.append(values[:missing])
        if len(values) >= missing:
            self.merge(step_results(np.concatenate(self.waiting), self.coverage, self.kind))
            self.waiting = [values[missing:].copy()]

    def merge(self, found: StepResults) -> None:
        """Add the results of the next sub-block."""
        self.steps += 1
        for k in np.flatnonzero(found.enough):
            result = found.results[:, k]
            self.count[k] += 1
            apart = result - self.mean[:, k]
            self.mean[:, k] += apart / self.count[k]
            self.squares[:, k] += apart * (result - self.mean[:, k])


def step_results(values: Float[np.ndarray, "step k"], coverage: float, kind: Kind) -> StepResults:
    """The results of the draws of one sub-block."""
    columns, finite = np.ascontiguousarray(values.T), np.isfinite(values).T
    results, enough = np.full((4, len(columns)), np.nan), np.zeros(len(columns), bool)
    for k, (column, good) in enumerate(zip(columns, finite, strict=True)):
        found = column if good.all() else column[good]
        if len(found) - math.floor(coverage * len(found) + 0.5) < 1:
            continue  # too few finite values for an interval of this output
        low, high = coverage_interval(found, coverage, kind)
        mean = found.mean()
        apart = found - mean  # a third of the time of numpy's standard deviation
        results[:, k] = mean, math.sqrt(apart @ apart / (len(found) - 1)), low, high
        enough[k] = True
    return StepResults(results, enough)


def step_size(p: float, block: int = 1) -> int:
    """Draws of a sub-block for coverage probability `p`, in whole blocks (JCGM 101, 7.9.4 b)."""
    # In float64, 100/(1 - p) may lie a rounding error above the exact integer.
    least = max(math.ceil(100.0 / (1.0 - p) * (1.0 - 1e-12)), _STEP)
    return math.ceil(least / block) * block


def numerical_tolerance(u: float, digits: int) -> float:
    """Numerical tolerance delta = 10^l / 2 of a standard uncertainty u = c 10^l (JCGM 101, 7.9.2).

    c is an integer of `digits` decimal digits. Zero for u = 0, NaN for a u that is not finite.
    """
    if not math.isfinite(u):
        return math.nan
    if u == 0.0:
        return 0.0
    exponent = int(f"{u:.{digits - 1}e}".partition("e")[2])
    return 0.5 * 10.0 ** (exponent - digits + 1)
