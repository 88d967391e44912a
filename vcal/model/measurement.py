"""A plan with the readings taken at it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..machine.plan import Plan


@dataclass(frozen=True)
class Measurement:
    """Plan + readings: what came from the measuring instrument, in the order of time."""

    plan: Plan
    readings: np.ndarray
    """(n, m), SI."""
    name: str = ""
    aside: np.ndarray | None = field(default=None, repr=False)
    """Rows (n,) that are neither fitted nor foretold, as they do not belong; None: all count."""
    blank: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Numbers of the rows of each table, from 1, that are not in it as a reading of them is blank,
    by the name of the file.
    """

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
    """How many rows, and the numbers of the first `most`: ``"7 rows (2, 3, 5, 8, 9, ...)"``."""
    shown = [*map(str, numbers[:most]), *(["..."] if len(numbers) > most else [])]
    return f"{len(numbers)} row{'s' * (len(numbers) > 1)} ({', '.join(shown)})"


@dataclass(frozen=True)
class CheckPoints:
    """Independent check: conditions, and the true tool point in the workpiece frame."""

    plan: Plan
    tool_point: np.ndarray = field(repr=False)
    """(n, 3), m."""
