"""Everything that was recorded and that a residual may depend on."""

import numpy as np

from ..instruments.conditions import file_column
from ..plan import Plan, of_set

_SAME = 0.9999
"""Correlation from which two columns count as the same."""
_UNITS = {"_deg": np.pi / 180.0, "_rad": 1.0}
"""Ends of the names of columns of angles, and their factors to rad."""
_GAP = 0.25
"""Share of a turn that may be missing in angles that go round."""


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


def angles_around(plan: Plan) -> list[str]:
    """Covariates that are angles, by the units in the names of their columns, and go round."""
    found = []
    for name, x in distinct_covariates(plan).items():
        if name not in plan.covariates or not np.isfinite(x).all():
            continue
        if file_column(name, plan.axes)[0][-4:] in _UNITS:
            turn = np.unique(np.mod(x * in_rad(plan, name), 2.0 * np.pi))
            if np.diff(turn, append=turn[0] + 2.0 * np.pi).max() < _GAP * 2.0 * np.pi:
                found.append(name)
    return found


def in_rad(plan: Plan, name: str) -> float:
    """Factor that turns the values of a covariate that is an angle into rad, by the unit in the
    name of its column.
    """
    column, factor = file_column(name, plan.axes)
    return factor * _UNITS[column[-4:]]


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Size of the correlation of two columns; zero where one of them does not vary."""
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return 0.0
    return float(abs(_direction(x) @ _direction(y)))


def _direction(x: np.ndarray) -> np.ndarray:
    """A column without its offset, of unit length."""
    centred = x - x.mean()
    return centred / np.linalg.norm(centred)
