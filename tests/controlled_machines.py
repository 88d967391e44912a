"""Simulated machines behind a running controller: their error at the tool before and after."""

from dataclasses import dataclass

import jax
import numpy as np

import linuxcnc_controller
import vcal
from vcal.compensation import Use
from vcal.compensation.expected import after_alignment, drawn_errors, expected
from vcal.demo import FOLDER
from vcal.model.simulate import simulate

POINTS = 220


def measured(name, seed):
    """A simulated machine with one effect in Y, and what was identified of it."""
    study = vcal.load_study(FOLDER / "setup.toml")
    setup = study.model.setup(study.plan)
    effect = next(e for e in vcal.CATALOGUE[name].candidates(setup) if e.placement == "Y")
    true = simulate(study.model, study.plan, jax.random.key(seed), effects=(effect,))
    fit = vcal.identify(true.model, true.measurement)
    return true, vcal.IdentifiedMachine.of_fit(fit)


def route(machine, points=POINTS, seed=1):
    """Random points in the volume, the direction in which each is reached, and temperatures: those
    of the measurement, then five kelvin more.
    """
    random = np.random.default_rng(seed)
    low, high = machine.volume.T
    position = np.round(random.uniform(low, high, (points, len(low))), 8)
    before = np.vstack([low, position[:-1]])
    covariates = {
        name: np.full(points, one.mean) + 5.0 * (np.arange(points) >= points // 2)
        for name, one in machine.ranges.items()
    }
    return Use(position, np.sign(position - before), covariates)


@dataclass(frozen=True)
class Driven:
    """What a controller with a compensation did with a machine."""

    moved: np.ndarray
    """Position of the motors less the command (n, axes), m or rad."""
    applied: np.ndarray
    """The same as vcal says it (n, axes)."""
    rms_um: dict[str, float]
    """Error of the true machine at the tool, before and after."""
    foretold: object
    """The error after, as `vcal verify` foretells it."""


def driven_to(true, machine, name, seed=1):
    """Drive a controller to random points with the compensation of an identified machine, and put
    the positions of its motors through the true machine.
    """
    found = vcal.compensate(machine, name, parts=False)
    use = route(machine, seed=seed)
    pins = [{} for _ in use.position]
    if name == "linuxcnc":
        for i, values in enumerate(pins):
            values |= {f"vcal-comp.{n.replace('_', '-')}": v[i] for n, v in use.covariates.items()}
    motors = 1e-3 * linuxcnc_controller.driven(
        found.files,
        "XYZ",
        1e3 * machine.volume,
        1e3 * use.position,
        pins,
        active="vcal-comp.active" if name == "linuxcnc" else "",
        off_before=POINTS // 3,
    )
    nominal = machine.nominal(use.position)
    rms = {}
    for what, position in (("before", use.position), ("after", motors)):
        plan = machine.plan(position, use.directions, use.covariates)
        errors = (true.tool_points(plan) - nominal)[None]
        rms[what] = expected(after_alignment(errors, nominal)).rms.mean
    foretold = expected(after_alignment(drawn_errors(machine, use, found.tables), nominal)).rms
    applied = found.applied(use.position, use.directions, use.covariates)
    return Driven(motors - use.position, applied, rms, foretold)
