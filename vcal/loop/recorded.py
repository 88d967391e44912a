"""Everything that was recorded and that a residual may depend on."""

import numpy as np

from ..plan import Plan, of_set


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
    for name in names:
        x = plan.values(name)
        there = np.isfinite(x)
        if name.rpartition(":")[2] == "point" or not there.any() or np.ptp(x[there]) == 0:
            continue
        if not any(_same(x, other) for other in distinct.values()):
            distinct[name] = x
    return distinct


def _same(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether two columns are there for the same rows and the same but for scale and offset."""
    there = np.isfinite(x)
    if not np.array_equal(there, np.isfinite(y)):
        return False
    return correlation(x[there], y[there]) >= 0.9999


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Size of the correlation of two columns; zero where one of them does not vary."""
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return 0.0
    return float(abs(np.corrcoef(x, y)[0, 1]))
