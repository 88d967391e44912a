"""Covariates: all recorded quantities that a residual may depend on."""

import numpy as np

from ...effects.clock import CLOCKS
from ...instruments.circle_averages import SAMPLES
from ...instruments.conditions import file_column
from ...instruments.recorded import response_column
from ...machine.plan import Plan, of_set

_SAME = 0.9999
"""Correlation from which two columns count as identical."""
_UNITS = {"_deg": np.pi / 180.0, "_rad": 1.0}
"""Endings of the names of columns of angles, and their factors to rad."""
_GAP = 0.25
"""Largest gap, as a share of a turn, in angles that cover a full turn."""
_SEAM = 2.0
"""Largest ratio of the gap at the seam, where angles within one turn wrap around, to the other
gaps."""


def distinct_covariates(plan: Plan) -> dict[str, np.ndarray]:
    """Axes, covariates and groups by their internal names, (n,) each; of columns that are identical
    but for scale and offset only the first. Recorded responses (`vcal.instruments.recorded`) and
    numbers of samples are no causes, and are left out.

    Quantities that only one data set has are nan in the rows of the others. The axes are given for
    all rows together and for each data set.
    """
    tables = [plan.axes, plan.covariates, plan.groups]
    names = [name for table in tables for name in table]
    names += [of_set(one, axis) for one in plan.sets for axis in plan.axes]
    distinct: dict[str, np.ndarray] = {}
    directions: list[tuple[np.ndarray, np.ndarray]] = []
    for name in names:
        if response_column(name) is not None or name.rpartition(":")[2] == SAMPLES:
            continue
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
    """Covariates that are angles, by the units in the names of their columns, and cover a full
    turn.

    The angle that a joint has moved since the previous pose is not a position on a turn.
    """
    return [
        name
        for name, x in distinct_covariates(plan).items()
        if name in plan.covariates
        and not name.startswith("move_")
        and np.isfinite(x).all()
        and file_column(name, plan.axes)[0][-4:] in _UNITS
        and _goes_round(x * in_rad(plan, name))
    ]


def has_zero(plan: Plan, name: str) -> bool:
    """Whether a quantity has a natural zero. Positions, clocks, run numbers and temperatures in
    degC have none.
    """
    if name in plan.axes or name in plan.groups or name in CLOCKS:
        return False
    return not file_column(name, plan.axes)[0].endswith("_degC")


def _goes_round(angle: np.ndarray) -> bool:
    """Whether angles (n,) in rad cover a full turn, unlike those of a swivel axis."""
    turn = 2.0 * np.pi
    places = np.unique(np.mod(angle, turn))
    widest = np.diff(places, append=places[0] + turn).max()
    if widest >= _GAP * turn:
        return False
    seam = turn - np.ptp(angle)
    return seam <= _SEAM * np.diff(np.unique(angle)).max()


def in_rad(plan: Plan, name: str) -> float:
    """Factor that converts the values of an angular covariate to rad, by the unit in the name of
    its column.
    """
    column, factor = file_column(name, plan.axes)
    return factor * _UNITS[column[-4:]]


def correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Magnitude of the correlation of two columns; zero where one of them is constant."""
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return 0.0
    return float(abs(_direction(x) @ _direction(y)))


def _direction(x: np.ndarray) -> np.ndarray:
    """A column without its mean, of unit length."""
    centred = x - x.mean()
    return centred / np.linalg.norm(centred)
