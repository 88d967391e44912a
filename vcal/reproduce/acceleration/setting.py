"""What the publication prints, and what had to be assumed."""

import functools
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ...dynamics.bodies import Machine
from ...dynamics.control import Controller
from ...dynamics.quasi_static import compliance
from ...dynamics.setpoints import Limits, Profile, SetCircle, positioning
from ...dynamics.structure import assemble
from ...dynamics.unknowns import (
    CentreShift,
    DampingFactor,
    Delay,
    DriveFactor,
    SpringFactor,
    Unknown,
    applied,
)
from ...study.dynamic_machine import Described, load_machine

DESCRIPTION = Path(__file__).with_name("machine.toml")
AXES = ("X", "Y", "Z")
RADIUS_M = 2e-3
MEASURED_M_S2, SIMULATED_M_S2 = 4.5, 4.7
"""Accelerations of the circles whose cross-talk it prints."""
MEASURED, SIMULATED = -1.55, -0.55
"""EXZ from the measured and from the simulated circle, um s^2/m."""
MOVE_M, MOVE_LIMITS = 0.02, Limits(0.5, 10.0, 250.0)
SET_PEAK, ACTUAL_PEAK = 8.55, 7.9
"""m/s^2. The set peak is not printed; it follows from length and jerk."""
MOVE_UM, MOVE_RATIO = 3.7, -0.48
"""Cross-talk at the actual peak of the positioning, and what it prints as their ratio."""
DEVICE_U_UM, RANGE_MM = 2.8, 3.0
"""Expanded uncertainty (k = 2) of the R-test, and the end of its range."""

LEVELS = (0.5, 1.0, 2.0, 3.0, 4.5)
EXTERNAL_UM, INTERNAL_UM, SAMPLES = 0.25, 0.02, 240
"""Noise and samples per turn: assumed."""
STIFFER = {"carriages of X": 0.40, "carriages of Y": 0.45}
"""Stiffness of the machine that is measured, over the catalogue's; that of the carriages of Z
follows from `MEASURED`.
"""

UNKNOWNS: tuple[Unknown, ...] = (
    *(SpringFactor(spring=f"carriages of {axis}", spread=math.log(2.5)) for axis in AXES),
    *(DriveFactor(axis=axis, spread=math.log(1.5)) for axis in AXES),
    SpringFactor(spring="foundation", spread=math.log(2.0)),
    DampingFactor(spread=math.log(2.0)),
    CentreShift("Z", "X", 20.0),
    CentreShift("Y", "Z", 30.0),
    CentreShift("X", "Z", 20.0),
    Delay(sigma_ms=0.1),
)
"""What a catalogue leaves open, and how far."""


@functools.cache
def described() -> Described:
    """The machine by its catalogue."""
    return load_machine(DESCRIPTION)


@functools.cache
def real() -> tuple[Machine, Controller]:
    """The machine that is measured: softer carriages, so that EXZ is the printed one."""
    machine, controller, _ = described()
    first = [SpringFactor(spring=name, spread=1.0) for name in STIFFER]
    z = jnp.log(jnp.array(list(STIFFER.values())))
    machine, controller = applied(first, machine, controller, z)
    last = SpringFactor(spring="carriages of Z", spread=1.0)

    def crosstalk(log_factor: float) -> float:
        softer, _ = last.apply(machine, controller, log_factor)
        return 1e6 * float(compliance(assemble(softer))[0, 2])

    low, high = math.log(0.05), 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if crosstalk(middle) < MEASURED else (low, middle)
    return last.apply(machine, controller, high)


def carriage_factors() -> dict[str, float]:
    """Stiffness of the carriages that are measured, over the catalogue's."""
    by_name = {s.name: s for s in described().machine.springs}
    return {
        s.name: float(np.max(s.stiffness) / np.max(by_name[s.name].stiffness))
        for s in real()[0].springs
        if s.name.startswith("carriages")
    }


def circle(plane: str, acceleration: float, sense: int = 1) -> SetCircle:
    """One circle of the publication's radius."""
    return SetCircle(plane, sense, RADIUS_M, acceleration)


def move() -> Profile:
    """The positioning of its section 3.4."""
    return positioning(MOVE_M, MOVE_LIMITS)
