"""The identified machine as the displacement that the correction of NC programs needs."""

from collections.abc import Mapping

import numpy as np

from ..errors import StudyError
from .base import conditions_inside
from .machine import IdentifiedMachine
from .nc.options import Displacement

_AXES = ("X", "Y", "Z")


def nc_displacement(
    machine: IdentifiedMachine, covariates: Mapping[str, float] | None = None
) -> Displacement:
    """Displacement of the tool point, actual minus nominal, by axis positions (n, 3), m, and
    directions of approach (n, 3), for `vcal.compensation.nc`.

    `covariates` are the conditions of the program, as sensors read them (temperatures in degC); by
    default those of the measurement. The offset of the tool is that of the calibration.

    Raises `StudyError` for a machine that has other axes than the linear axes X, Y and Z, and as
    `conditions_inside` does.
    """
    conditions = conditions_inside(machine, covariates or {})
    if machine.chain.arm or sorted(machine.axes) != [*_AXES]:
        raise StudyError(
            f"machine {machine.chain.text!r}: found the axes {', '.join(machine.axes)}, expected "
            "the three linear axes X, Y and Z; the correction of programs knows no others"
        )
    order = [_AXES.index(axis) for axis in machine.axes]

    def displacement(positions: np.ndarray, directions: np.ndarray, *_: np.ndarray) -> np.ndarray:
        plan = machine.plan(positions[:, order], directions[:, order], conditions)
        return machine.displacement(plan)

    return displacement
