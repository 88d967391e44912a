"""How precise a Monte Carlo campaign is, and when it is precise enough: JCGM 101, 7.9.

The draws are taken in consecutive sub-blocks of M = max(J, 10 000), J the smallest integer not
below 100/(1 - p), rounded up to whole blocks. Estimate y, standard uncertainty u and both ends of
the coverage interval of every sub-block scatter about their averages, which tells the standard
deviation of an average over h sub-blocks: s^2 = sum (. - mean)^2 / (h (h - 1)).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .intervals import Kind, coverage_interval

_STEP = 10_000
"""Least number of draws in a sub-block (JCGM 101, 7.9.4 b)."""


class Precision(NamedTuple):
    """Standard deviations of Monte Carlo results, one per scalar output, in its unit.

    Infinite where there are fewer than two sub-blocks to tell them from.
    """

    y: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class Adaptive:
    """How an adaptive campaign ended (JCGM 101, 7.9.4)."""

    settled: bool
    """Whether every output is stable; otherwise the greatest number of draws was reached."""
    digits: int
    """Significant decimal digits of u that were asked for."""
    steps: int
    """Sub-blocks of draws, h."""
    tolerance: Float[np.ndarray, " k"]
    """delta of every scalar output."""
    precision: Precision
    """Standard deviations s; an output is stable where 2 s <= delta for all four."""

    @property
    def stable(self) -> np.ndarray:
        """Whether each output is stable (k,)."""
        return np.all([2.0 * s <= self.tolerance for s in self.precision], axis=0)


class Steps:
    """Results of consecutive sub-blocks of draws, of which running averages are kept."""

    def __init__(self, size: int, step: int, coverage: float, kind: Kind):
        self.step, self.coverage = step, coverage
        self.kind: Kind = kind
        self.steps = 0
        """Sub-blocks finished."""
        self.count = np.zeros(size, np.int64)
        """Those of them in which the output has an interval: enough values that are finite."""
        self.mean = np.zeros((4, size))
        self.squares = np.zeros((4, size))
        self.waiting: list[np.ndarray] = []
        """Draws of the sub-block under way."""

    def add(self, values: Float[np.ndarray, "n k"]) -> None:
        """Add draws in order."""
        for start in range(0, len(values), self.step):
            self._add(values[start : start + self.step])

    def precision(self, steps: int | None = None) -> Precision:
        """Standard deviations of averages over so many sub-blocks (default: all of these)."""
        enough = self.count > 1
        variance = self.squares / np.where(enough, self.count - 1, 1)
        over = self.count if steps is None else np.full_like(self.count, steps)
        deviation = np.sqrt(variance / np.maximum(over, 1))
        return Precision(*np.where(enough, deviation, np.inf))

    def adaptive(self, u: Float[np.ndarray, " k"], digits: int) -> Adaptive:
        """Verdict on the draws so far, whose standard uncertainty is `u`."""
        delta = np.array([numerical_tolerance(float(value), digits) for value in u])
        precision = self.precision()
        # An output that is finite in no draw has no interval that more draws would tell.
        told = self.count > 0
        settled = self.steps > 1 and all(bool(np.all((2.0 * s <= delta)[told])) for s in precision)
        return Adaptive(settled, digits, self.steps, delta, precision)

    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers that change, as `restore` takes them back."""
        size = len(self.count)
        return {
            "steps": np.array(self.steps),
            "count": self.count,
            "mean": self.mean,
            "squares": self.squares,
            "waiting": np.concatenate([np.empty((0, size)), *self.waiting]),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from what `arrays` gave."""
        self.steps = int(arrays["steps"])
        self.count, self.mean = arrays["count"], arrays["mean"]
        self.squares, self.waiting = arrays["squares"], [arrays["waiting"]]

    def _add(self, values: Float[np.ndarray, "n k"]) -> None:
        """Add draws that finish one sub-block at most."""
        missing = self.step - sum(map(len, self.waiting))
        self.waiting.append(values[:missing])
        if len(values) >= missing:
            self._finish(np.concatenate(self.waiting))
            self.waiting = [values[missing:].copy()]

    def _finish(self, values: Float[np.ndarray, "step k"]) -> None:
        self.steps += 1
        columns, finite = np.ascontiguousarray(values.T), np.isfinite(values).T
        for k, (column, good) in enumerate(zip(columns, finite, strict=True)):
            found = column[good]
            if len(found) - math.floor(self.coverage * len(found) + 0.5) < 1:
                continue  # too few draws that did not fail: this sub-block says nothing here
            low, high = coverage_interval(found, self.coverage, self.kind)
            result = np.array([found.mean(), found.std(ddof=1), low, high])
            self.count[k] += 1
            apart = result - self.mean[:, k]
            self.mean[:, k] += apart / self.count[k]
            self.squares[:, k] += apart * (result - self.mean[:, k])


def step_size(p: float, block: int = 1) -> int:
    """Draws of a sub-block for coverage probability `p`, in whole blocks (JCGM 101, 7.9.4 b)."""
    # 100/(1 - p) itself comes out a rounding error above the integer it should be.
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
