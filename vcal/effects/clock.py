"""By what effects of time count: by the time that was recorded, or by the numbers of the poses."""

from dataclasses import dataclass

import numpy as np

from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Setup


@dataclass(frozen=True)
class Clock:
    """What counts up while a machine is measured.

    Where no time was recorded, but the poses are numbered as they were taken, they stand for it:
    rates are per pose, and time constants and moments are numbers of poses.
    """

    name: str
    """The covariate."""
    short: str
    """Unit of a moment."""
    long: str
    """Unit of time constants, and of what rates are per."""
    usual: float
    """Size that is expected of a rate, in um or urad per `long`."""

    def read(self, plan: Plan) -> Array:
        """It in every row (n,)."""
        return plan.covariate(self.name)


TIME = Clock("t", "s", "h", 20.0)
_POSES = Clock("order", "pose", "pose", 0.2)
"""An arm takes a hundred poses or so in an hour."""


CLOCKS = (TIME.name, _POSES.name)
"""Covariates that count from a start of their own in every data set, unless these follow each
other."""


def clock(setup: Setup) -> Clock:
    """Time; the numbers of the poses where it was not recorded and they were."""
    plan = setup.plan
    return _POSES if plan.has(_POSES.name) and not plan.has(TIME.name) else TIME


def beginning(setup: Setup) -> float:
    """When the first reading was taken, by `clock`; zero where nothing tells."""
    name = clock(setup).name
    return float(np.min(setup.plan.covariate(name))) if setup.plan.has(name) else 0.0
