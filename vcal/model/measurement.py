"""A plan with its readings, and check points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..machine.plan import Plan
from ..words import counted


@dataclass(frozen=True)
class HoldOut:
    """Which rows are held out, in place of the choice of the instrument."""

    folds: np.ndarray = field(repr=False)
    """Fold of every row (n,), -1 where it is never held out."""
    apart: np.ndarray = field(repr=False)
    """Rows (n,) that no fit includes; the other folds are predicted in turn."""
    words: str
    """What is held out: ``"a random 20 %"``."""
    caution: str = ""
    """Why another choice was not followed; empty where it was."""
    unpredicted: np.ndarray | None = field(default=None, repr=False)
    """Held-out rows (n,) that the others do not predict; they count in no held-out error."""


@dataclass(frozen=True)
class Measurement:
    """A plan and the readings of the measuring instrument, in the order of time.

    Raises `ValueError` where the readings do not fit the plan, or are not finite.
    """

    plan: Plan
    readings: np.ndarray
    """(n, m), SI."""
    name: str = ""
    aside: np.ndarray | None = field(default=None, repr=False)
    """Rows (n,) that are excluded from fits and predictions, such as outliers; None: no row."""
    blank: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Numbers, from 1, of the rows of each table that were left out because of a blank reading, by
    the name of the file.
    """
    holdout: "HoldOut | None" = field(default=None, repr=False)
    """Choice of the held-out rows; None: that of the instrument."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "readings", np.asarray(self.readings, float))
        if self.readings.ndim != 2 or len(self.readings) != self.plan.rows:
            raise ValueError(
                f"readings of shape {self.readings.shape} do not fit a plan of {self.plan.rows} "
                "rows: expected (rows, components); give one row of readings for each position"
            )
        if not np.isfinite(self.readings).all():
            row, column = np.argwhere(~np.isfinite(self.readings))[0]
            raise ValueError(
                f"reading {column} of row {row} is {self.readings[row, column]}: expected a number"
            )

    @property
    def rows(self) -> int:
        """Number of observations."""
        return self.plan.rows


def rows_in_words(numbers: Sequence[int], most: int = 5) -> str:
    """Number of rows, with the numbers of the first `most`: ``"7 rows (2, 3, 5, 8, 9, ...)"``."""
    shown = [*map(str, numbers[:most]), *(["..."] if len(numbers) > most else [])]
    return f"{counted(len(numbers), 'row')} ({', '.join(shown)})"


@dataclass(frozen=True)
class CheckPoints:
    """Check points of an independent measurement: conditions, and the true tool point in the
    workpiece frame.
    """

    plan: Plan
    tool_point: np.ndarray = field(repr=False)
    """(n, 3), m."""
