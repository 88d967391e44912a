"""Stations: the rows of a table that were read from one place of an instrument."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ..machine.plan import Plan
from .base import Setup

STATION = "station"
"""The group that holds the index of the station of every row."""


def at_station(plan: Plan, number: int) -> Float[np.ndarray, " n"]:
    """One in the rows (n,) of a station by its index in the group ``"station"``, zero in others;
    one in all rows for a negative index. It is zero in a plan without stations, such as that of
    check points.
    """
    if number < 0:
        return np.ones(plan.rows)
    if STATION not in plan.groups:
        return np.zeros(plan.rows)
    return (np.asarray(plan.groups[STATION]) == number).astype(float)


def stations_of(setup: Setup) -> Iterator[tuple[int, str]]:
    """Index and name of every station of an instrument; (-1, "") where it has only one."""
    yield from enumerate(setup.stations) if setup.stations else ((-1, ""),)
