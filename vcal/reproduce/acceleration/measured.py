"""The R-test of a simulated machine: its data and their evaluations."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...dynamics.closed_loop import ClosedLoop, run_circle
from ...dynamics.ellipse_evaluation import Evaluated, evaluate
from ...dynamics.setpoints import SetCircle
from ...effects.acceleration import AccelerationCrosstalk
from ...identification.identify import identify
from ...instruments.r_test import RTest, RTestSettings
from ...machine.chain import Chain
from ...model.forward import Model
from ...model.measurement import Measurement
from .setting import DEVICE_U_UM, EXTERNAL_UM, INTERNAL_UM, RADIUS_M, RANGE_MM, SAMPLES

_OFFSET_M = 5e-6
MATRIX_U = 0.5e-3 * DEVICE_U_UM / RANGE_MM
"""Standard uncertainty of an element of the probes' matrix."""


@dataclass(frozen=True)
class RTestRun:
    """A measurement and the instrument that made it."""

    measurement: Measurement
    instrument: RTest


def measure(
    loop: ClosedLoop,
    chain: Chain,
    circles: Sequence[SetCircle],
    seed: int,
    *,
    noise: float = 1.0,
    device: float = 1.0,
) -> RTestRun:
    """One turn of every circle, steady, with the noise and the errors of the device.

    `noise` and `device` multiply them.
    """
    rng = np.random.default_rng(seed)
    skew = device * MATRIX_U * rng.standard_normal((3, 3))
    place = [("XYZ".index(axis)) for axis in loop.axes]
    one = jax.jit(run_circle)
    columns: dict[str, list] = {n: [] for n in ("run", "plane", "sense", "a_set_m_s2", "t_s")}
    internal, external = [], []
    for number, circle in enumerate(circles):
        t = (np.arange(SAMPLES) + 0.5) / SAMPLES * 2.0 * np.pi / circle.omega
        found = one(loop, jnp.asarray(circle.phasor(loop.axes)), circle.omega, t)
        read = np.zeros((SAMPLES, 3))
        read[:, place] = np.asarray(found.scale)
        seen = read + np.asarray(found.error) + read @ skew.T
        seen = seen + rng.uniform(-_OFFSET_M, _OFFSET_M, 3)
        internal.append(read + 1e-6 * noise * INTERNAL_UM * rng.standard_normal(read.shape))
        external.append(seen + 1e-6 * noise * EXTERNAL_UM * rng.standard_normal(read.shape))
        values = (number, circle.plane, circle.sense, circle.acceleration, t)
        for name, value in zip(columns, values, strict=True):
            columns[name] += list(np.broadcast_to(value, SAMPLES))
    table = {name: np.array(values) for name, values in columns.items()}
    for kind, parts in (("int", internal), ("ext", external)):
        joined = 1e3 * np.concatenate(parts)
        table |= {f"{c}_{kind}_mm": joined[:, i] for i, c in enumerate("xyz")}
    settings = RTestSettings(
        kind="r_test",
        radius_mm=1e3 * RADIUS_M,
        external_sigma_um=EXTERNAL_UM,
        internal_sigma_um=INTERNAL_UM,
        external_u_um=0.5 * DEVICE_U_UM,
        range_mm=RANGE_MM,
    )
    instrument = RTest.build(settings, chain, table, lambda name, columns: {})
    plan = instrument.plan(chain, table)
    return RTestRun(Measurement(plan, instrument.measured(table)), instrument)


@dataclass(frozen=True)
class Joint:
    """The matrix from all circles at once, um s^2/m."""

    matrix: Float[np.ndarray, "3 3"]
    u: Float[np.ndarray, "3 3"]
    """Standard uncertainties."""
    chi2_per_dof: float


def fit_matrix(run: RTestRun, chain: Chain, *, device: bool = True) -> Joint:
    """All nine elements, with the offsets of the runs and, unless `device` is false, the errors of
    the probes.
    """
    plan = run.measurement.plan
    own = [e for e in run.instrument.effects(plan) if device or e.kind == "nuisance"]
    effect = AccelerationCrosstalk(axes=chain.axes)
    fit = identify(Model(chain, run.instrument, (*own, effect)), run.measurement)
    last = len(fit.model.entries) - 9
    step = np.array([e.parameter.step / e.parameter.si for e in fit.model.entries[last:]])
    u = np.sqrt(np.diag(np.asarray(fit.covariance))[last : last + 9]) * step
    values = np.asarray(fit.theta)[last : last + 9] * step
    return Joint(values.reshape(3, 3), u.reshape(3, 3), fit.chi2 / fit.dof)


def both_ways(run: RTestRun) -> dict[str, Evaluated]:
    """The publication's evaluation with actual and with nominal accelerations."""
    return {kind: evaluate(run.measurement, run.instrument, kind) for kind in ("actual", "nominal")}
