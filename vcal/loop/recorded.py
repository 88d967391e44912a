"""Everything that was recorded and that a residual may depend on."""

import numpy as np

from ..plan import Plan, of_set

_SAME = 0.9999
"""Correlation from which two columns count as the same."""


def distinct_covariates(plan: Plan) -> dict[str, np.ndarray]:
    """Axes, covariates and groups by their names inside vcal; of columns that are the same but for
    scale and offset only the first.

    What only the rows of one data set have is nan in the others; the axes are there for all rows
    and for those of every data set.
    """
    tables = [plan.axes, plan.covariates, plan.groups]
    names = [name for table in tables for name in table]
    names += [of_set(one, axis) for one in plan.sets for axis in plan.axes]
    distinct: dict[str, np.ndarray] = {}
    directions: list[tuple[np.ndarray, np.ndarray]] = []
    for name in names:
        x = plan.values(name)
        there = np.isfinite(x)
        if name.rpartition(":")[2] == "point" or not there.any() or np.ptp(x[there]) == 0:
            continue
        direction = _direction(x[there])
        if not any(
            np.array_equal(there, others) and abs(direction @ other) >= _SAME
            for others, other in directions
        ):
            distinct[name] = x
            directions.append((there, direction))
    return distinct


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Size of the correlation of two columns; zero where one of them does not vary."""
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return 0.0
    return float(abs(_direction(x) @ _direction(y)))


def _direction(x: np.ndarray) -> np.ndarray:
    """A column without its offset, of unit length."""
    centred = x - x.mean()
    return centred / np.linalg.norm(centred)
