"""The whole of the reproduction as numbers."""

import math
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
from ..registry import Computed, part
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


class Results(Computed):
    """Everything: the machine is measured and identified from its catalogue, and `draws` others."""

    @part("the machine by its catalogue")
    def catalogue(self) -> Model:
        return Model.of(*described()[:2])

    @part("the machine that is measured")
    def true(self) -> Model:
        return Model.of(*real())

    @part("the R-test of the catalogue's machine")
    def simulated(self) -> RTestOf:
        """Without noise: what the publication simulated."""
        circles, chain = circle_set(RADIUS_M, SIMULATED_LEVELS), self.catalogue.machine.chain
        return _evaluated(
            measure(self.catalogue.loop, chain, circles, self.seed, noise=0.0, device=0.0)
        )

    @part("the R-test of the machine that is measured")
    def measured(self) -> RTestOf:
        circles, chain = circle_set(RADIUS_M, LEVELS), self.catalogue.machine.chain
        return _evaluated(measure(self.true.loop, chain, circles, self.seed))

    @part("the matrix from all circles")
    def joint(self) -> Joint:
        return fit_matrix(self.measured.run, self.catalogue.machine.chain)

    @part("the matrix as if the probes had no errors but noise")
    def joint_no_device(self) -> Joint:
        return fit_matrix(self.measured.run, self.catalogue.machine.chain, device=False)

    @part("the machine from all circles")
    def found(self) -> Identified:
        run, c = self.measured.run, self.catalogue
        seen = measured_phasors(run.measurement, run.instrument)
        given = task(c.machine, c.controller, UNKNOWNS, seen, matrix_u=MATRIX_U)
        return identify_machine(given, seen)

    @part("the identified machine")
    def identified(self) -> Model:
        return Model.of(self.found.machine, self.found.controller)

    @part("what the catalogue leaves open of the matrix")
    def catalogue_matrix_u(self) -> Float[np.ndarray, "3 3"]:
        """Standard deviation, um s^2/m, by drawing: factors are no matter of derivatives."""

        def matrix(z: Array) -> Array:
            machine, _ = applied(UNKNOWNS, self.catalogue.machine, self.catalogue.controller, z)
            return compliance(assemble(machine))

        z = jax.random.normal(jax.random.key(0), (2000, len(UNKNOWNS)))
        return 1e6 * np.asarray(jax.jit(jax.vmap(matrix))(jnp.asarray(z))).std(0)

    @part("other movements, less the matrix from all circles")
    def by_circles(self) -> dict[str, Compensated]:
        return compensated(self.true.loop, self.joint.matrix)

    @part("other movements, less the matrix of the identified machine")
    def by_machine(self) -> dict[str, Compensated]:
        return compensated(self.true.loop, self.identified.matrix)

    @part("many machines, each of 30 circles")
    def campaign(self) -> Campaign:
        noise = Noise(1e-6 * INTERNAL_UM, 1e-6 * EXTERNAL_UM, SAMPLES)
        given = self.catalogue.machine, self.catalogue.controller, UNKNOWNS
        circles = circle_set(RADIUS_M, LEVELS)
        return campaign(*given, circles, noise, draws=self.draws, seed=self.seed, matrix_u=MATRIX_U)

    @property
    def exz_of_the_circle(self) -> tuple[float, float]:
        """EXZ of the publication's circles: simulated, measured."""
        return (
            self.simulated.element("XZ", "YZ", SIMULATED_M_S2),
            self.measured.element("XZ", "YZ", MEASURED_M_S2),
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


def element(matrix: Float[np.ndarray, "3 3"], name: str) -> float:
    """An element by its name, such as ``"XZ"``."""
    i, j = ("XYZ".index(c) for c in name)
    return float(matrix[i, j])


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
