"""The working volume of a machine: positions, directions and conditions in which it is used."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..machine.plan import Plan
from .machine import IdentifiedMachine

POINTS = 7
"""Default number of positions per axis at which errors in the working volume are computed."""
_SPEED = re.compile(r"v_(\w+)")


@dataclass(frozen=True)
class Use:
    """Positions with the conditions in which each of them is approached."""

    position: Float[np.ndarray, "n axes"]
    directions: Float[np.ndarray, "n axes"]
    """+1 or -1; 0 where an axis stands still."""
    covariates: Mapping[str, Float[np.ndarray, " n"]]

    def plan(self, machine: IdentifiedMachine) -> Plan:
        """As a plan of a machine."""
        return machine.plan(self.position, self.directions, self.covariates)


def working_volume(machine: IdentifiedMachine, points: int = POINTS, seed: int = 0) -> Use:
    """A grid of `points` positions per axis over the working volume; each position is approached in
    a random direction of every axis, and under conditions drawn uniformly from the measured ranges.
    """
    low, high = machine.volume.T
    lines = [np.linspace(a, b, points if b > a else 1) for a, b in zip(low, high, strict=True)]
    position = np.stack([v.ravel() for v in np.meshgrid(*lines, indexing="ij")], 1)
    random = np.random.default_rng(seed)
    directions = random.choice([-1.0, 1.0], size=position.shape)
    covariates = {
        name: random.uniform(one.low, one.high, len(position))
        for name, one in sorted(machine.ranges.items())
        if not name.startswith(("commanded_", "read_"))
    }
    for name, values in covariates.items():
        speed = _SPEED.fullmatch(name)
        if speed and speed[1] in machine.axes:
            directions[:, machine.axes.index(speed[1])] = np.sign(values)
    return Use(position, directions, covariates)


def check_use(machine: IdentifiedMachine) -> Use | None:
    """The check points of the measurement with their conditions; None without any."""
    plan = machine.check
    if plan is None:
        return None
    directions = np.zeros((plan.rows, len(machine.axes)))
    for i, axis in enumerate(machine.axes):
        if plan.has(f"dir_{axis}"):
            directions[:, i] = plan.values(f"dir_{axis}")
    covariates = {n: plan.values(n) for n in machine.ranges if plan.has(n)}
    return Use(np.asarray(plan.position), directions, covariates)
