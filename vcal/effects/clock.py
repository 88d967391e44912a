"""What effects of time count by: the recorded time, or the numbers of the poses."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Setup


@dataclass(frozen=True)
class Clock:
    """A covariate that increases during a measurement.

    Where no time was recorded but the poses are numbered in the order in which they were taken,
    the numbers stand for it: rates are per pose, time constants and moments are numbers of poses.
    """

    name: str
    """The covariate."""
    short: str
    """Unit of a moment."""
    long: str
    """Unit of time constants, and of the denominator of rates."""
    usual: float
    """Prior standard deviation of a rate, in um or urad per `long`."""
    before: float
    """How long a machine may have been drifting before the first reading, in `long`."""

    def read(self, plan: Plan) -> Array:
        """Its value in every row (n,)."""
        return plan.covariate(self.name)


TIME = Clock("t", "s", "h", 20.0, 1.0)
_POSES = Clock("order", "pose", "pose", 0.2, 100.0)
"""An arm takes about a hundred poses in an hour."""


CLOCKS = (TIME.name, _POSES.name)
"""Covariates that start from zero in every data set, unless the data sets follow each other."""


class SinceStart(Effect):
    """Base class of effects of the time, or of the number of poses, since the first reading."""

    start: float = eqx.field(default=0.0, kw_only=True)
    """Time of the first reading, SI."""
    clock: Clock = eqx.field(static=True, default=TIME, kw_only=True)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.clock.name,)

    def elapsed(self, plan: Plan) -> Array:
        """Time since the first reading, SI, in every row (n,)."""
        return self.clock.read(plan) - self.start


def started(setup: Setup) -> Mapping[str, Any]:
    """Fields of a `SinceStart`: the clock of a setup, and when the first reading was taken."""
    return {"start": beginning(setup), "clock": clock(setup)}


def clock(setup: Setup) -> Clock:
    """Time; or the numbers of the poses where only these were recorded."""
    plan = setup.plan
    return _POSES if plan.has(_POSES.name) and not plan.has(TIME.name) else TIME


def beginning(setup: Setup) -> float:
    """When the first reading was taken, by `clock`; zero where that was not recorded."""
    name = clock(setup).name
    return float(np.min(setup.plan.covariate(name))) if setup.plan.has(name) else 0.0
