"""The whole of the reproduction as numbers."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...dynamics.bodies import Machine
from ...dynamics.circles import measured_phasors
from ...dynamics.closed_loop import ClosedLoop, check_stable, controlled
from ...dynamics.control import Controller
from ...dynamics.ellipse_evaluation import Evaluated
from ...dynamics.identify import Identified, identify_machine, task
from ...dynamics.modal_analysis import modes
from ...dynamics.monte_carlo import Campaign, Noise, campaign
from ...dynamics.quasi_static import compliance
from ...dynamics.setpoints import circle_set
from ...dynamics.structure import assemble
from ...dynamics.unknowns import SpringFactor, applied
from ...numerics.arrays import Array
from .measured import MATRIX_U, Joint, RTestRun, both_ways, fit_matrix, measure
from .moves import Compensated, Positioning, compensated, positioned
from .setting import (
    EXTERNAL_UM,
    INTERNAL_UM,
    LEVELS,
    MEASURED_M_S2,
    RADIUS_M,
    SAMPLES,
    SIMULATED_M_S2,
    UNKNOWNS,
    carriage_factors,
    circle,
    described,
    real,
)

CAMPAIGN, LEAST = 1000, 20
"""Machines of the campaign, and how many there have to be."""
SIMULATED_LEVELS = (*LEVELS[:-1], SIMULATED_M_S2)


@dataclass(frozen=True)
class Model:
    """One machine under its controllers."""

    machine: Machine
    controller: Controller
    loop: ClosedLoop
    matrix: Float[np.ndarray, "3 3"]
    """E, um s^2/m."""
    hz: Float[np.ndarray, " m"]
    """Natural frequencies."""
    move: Positioning

    @classmethod
    def of(cls, machine: Machine, controller: Controller) -> "Model":
        """With everything that follows; raises `ValueError` where its loop is unstable."""
        structure = assemble(machine)
        loop = controlled(structure, controller)
        check_stable(loop, structure)
        matrix = 1e6 * np.asarray(compliance(structure))
        return cls(machine, controller, loop, matrix, modes(structure).hz, positioned(loop))


@dataclass(frozen=True)
class RTestOf:
    """An R-test and its evaluations."""

    run: RTestRun
    ways: dict[str, Evaluated]
    """The publication's evaluation with actual and with nominal accelerations."""
    ratio: dict[float, Float[np.ndarray, " axes"]]
    """Amplitude of every axis over the commanded radius, by set acceleration."""

    def place(self, plane: str, acceleration: float) -> int:
        """Number of the run of that plane and acceleration in the positive sense."""
        plan = self.run.measurement.plan
        runs = np.asarray(plan.groups["run"])
        first = [int(np.flatnonzero(runs == k)[0]) for k in np.unique(runs)]
        kinds = [self.run.instrument.circles(plan)[k].moving for k in np.unique(runs)]
        wanted = np.array([c in plane for c in "XYZ"])
        for k, (row, moving) in enumerate(zip(first, kinds, strict=True)):
            level = float(np.asarray(plan.covariate("a_set_m_s2"))[row])
            sense = int(np.asarray(plan.covariate("sense"))[row])
            if (moving == wanted).all() and np.isclose(level, acceleration) and sense == 1:
                return k
        raise KeyError((plane, acceleration))

    def element(self, name: str, plane: str, acceleration: float, way: str = "actual") -> float:
        """One element of the matrix from one circle, um s^2/m; ``"XZ"`` is EXZ."""
        i, j = ("XYZ".index(c) for c in name)
        return float(self.ways[way].runs[self.place(plane, acceleration), i, j])


@dataclass(frozen=True)
class Results:
    """Everything that was computed."""

    seed: int
    draws: int
    catalogue: Model
    true: Model
    """The machine that is measured."""
    identified: Model
    simulated: RTestOf
    """R-test of the catalogue's machine, without noise: what the publication simulated."""
    measured: RTestOf
    joint: Joint
    """E from all circles of `measured` at once."""
    joint_no_device: Joint
    """The same as if the probes had no errors but noise."""
    found: Identified
    catalogue_matrix_u: Float[np.ndarray, "3 3"]
    """Standard deviation of E by what the catalogue leaves open, um s^2/m."""
    by_circles: dict[str, Compensated]
    """What the joint matrix leaves of other movements of the true machine."""
    by_machine: dict[str, Compensated]
    """What the matrix of the identified machine leaves of them."""
    campaign: Campaign


def compute(draws: int, seed: int, progress: Callable[[str], None]) -> Results:
    """Measure the machine, identify it from its catalogue, and do so for `draws` machines."""
    progress("the machines")
    catalogue, true = Model.of(*described()[:2]), Model.of(*real())
    chain = catalogue.machine.chain
    progress("the R-tests")
    levels = circle_set(RADIUS_M, LEVELS)
    simulated = _evaluated(
        measure(catalogue.loop, chain, circle_set(RADIUS_M, SIMULATED_LEVELS), seed,
                noise=0.0, device=0.0)
    )  # fmt: skip
    measured = _evaluated(measure(true.loop, chain, levels, seed))
    progress("the matrix from all circles")
    joint, bare = (fit_matrix(measured.run, chain, device=d) for d in (True, False))
    progress("the machine from all circles")
    found = _identify(catalogue, measured.run)
    identified = Model.of(found.machine, found.controller)
    progress("other movements")
    by_circles, by_machine = (compensated(true.loop, E) for E in (joint.matrix, identified.matrix))
    progress(f"{draws} machines, each of 30 circles")
    many = campaign(
        catalogue.machine,
        catalogue.controller,
        UNKNOWNS,
        levels,
        Noise(1e-6 * INTERNAL_UM, 1e-6 * EXTERNAL_UM, SAMPLES),
        draws=draws,
        seed=seed,
        matrix_u=MATRIX_U,
    )
    return Results(
        seed=seed,
        draws=draws,
        catalogue=catalogue,
        true=true,
        identified=identified,
        simulated=simulated,
        measured=measured,
        joint=joint,
        joint_no_device=bare,
        found=found,
        catalogue_matrix_u=_prior_of_matrix(catalogue),
        by_circles=by_circles,
        by_machine=by_machine,
        campaign=many,
    )


def _evaluated(run: RTestRun) -> RTestOf:
    plan = run.measurement.plan
    levels = np.asarray(plan.covariate("a_set_m_s2"))
    runs = np.asarray(plan.groups["run"])
    found: dict[float, list] = {}
    for k, turn in run.instrument.circles(plan).items():
        size = np.where(turn.moving, turn.amplitude / run.instrument.radius, np.nan)
        found.setdefault(float(levels[runs == k][0]), []).append(size)
    ratio = {a: np.nanmean(sizes, axis=0) for a, sizes in found.items()}
    return RTestOf(run, both_ways(run), ratio)


def _identify(catalogue: Model, run: RTestRun) -> Identified:
    seen = measured_phasors(run.measurement, run.instrument)
    given = task(catalogue.machine, catalogue.controller, UNKNOWNS, seen, matrix_u=MATRIX_U)
    return identify_machine(given, seen)


def _prior_of_matrix(catalogue: Model, draws: int = 2000) -> Float[np.ndarray, "3 3"]:
    """By drawing from it: what is open by factors is no matter of derivatives."""

    def matrix(z: Array) -> Array:
        return compliance(
            assemble(applied(UNKNOWNS, catalogue.machine, catalogue.controller, z)[0])
        )

    z = jax.random.normal(jax.random.key(0), (draws, len(UNKNOWNS)))
    return 1e6 * np.asarray(jax.jit(jax.vmap(matrix))(jnp.asarray(z))).std(0)


def element(matrix: Float[np.ndarray, "3 3"], name: str) -> float:
    """An element by its name, such as ``"XZ"``."""
    i, j = ("XYZ".index(c) for c in name)
    return float(matrix[i, j])


def exz_of_the_circle(results: Results) -> tuple[float, float]:
    """EXZ of the publication's circles: simulated, measured."""
    return (
        results.simulated.element("XZ", "YZ", SIMULATED_M_S2),
        results.measured.element("XZ", "YZ", MEASURED_M_S2),
    )


def single_circle_U() -> float:
    """Expanded uncertainty (k = 2) of an element from one circle of the measured level by the
    device alone, um s^2/m: its errors grow as the position, which is acceleration over omega^2.
    """
    return 2e6 * MATRIX_U / circle("YZ", MEASURED_M_S2).omega ** 2


def true_z() -> Float[np.ndarray, " k"]:
    """The machine that is measured, in standard deviations of the catalogue."""
    factors = carriage_factors()
    return np.array(
        [
            math.log(factors[u.name.removeprefix("stiffness of ")]) / u.spread
            if isinstance(u, SpringFactor) and u.spring in factors
            else 0.0
            for u in UNKNOWNS
        ]
    )
