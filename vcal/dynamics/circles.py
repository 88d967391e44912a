"""Circles as phasors: one complex amplitude per reading.

A linear machine on a circle responds at the frequency of the circle, so that amplitude and phase of
the fundamental contain all information of a run. They are estimated by least squares from the
samples. For white noise sigma and n samples over whole turns, the real and the imaginary part have
the standard uncertainty sigma sqrt(2 / n) each.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ..instruments.r_test import PLANES, RTest
from ..model.measurement import Measurement
from ..numerics.arrays import Array
from .closed_loop import ClosedLoop, steady
from .setpoints import SetCircle

_ALIKE = 1e-3
"""Relative difference up to which two speeds count as one."""
_LEAD, _LAG = 20.0, 150.0
"""Largest lead and lag of a scale relative to its set point, degrees."""


class Phasors(eqx.Module):
    """Fundamental of many circles, x(t) = Re(X exp(i omega t)), t from the start of a run."""

    axes: tuple[str, ...] = eqx.field(static=True)
    omega: Float[Array, " r"]
    """Angular velocity, rad/s."""
    asked: Complex[Array, "r axes"]
    """Set points, m."""
    internal: Complex[Array, "r axes"]
    """Readings of the scales, m."""
    error: Complex[Array, "r 3"]
    """External minus internal reading, m."""
    internal_u: Float[Array, "r axes"]
    """Standard uncertainty of real and imaginary part of `internal`, m; infinite for a scale
    without information, such as that of an axis at rest.
    """
    external_u: Float[Array, "r 3"]
    """Standard uncertainty of real and imaginary part of the probes' reading, m. The error contains
    this noise and that of the scales.
    """


def answers(
    loop: ClosedLoop, omega: Float[Array, " w"]
) -> tuple[Complex[Array, "w axes axes"], Complex[Array, "w 3 axes"]]:
    """Steady-state internal reading and error per set position exp(i omega t) of every axis."""
    states = jax.vmap(lambda w: steady(loop, w))(omega)
    return loop.scale @ states, loop.structural @ states


def predicted(
    loop: ClosedLoop, omega: Float[Array, " r"], asked: Complex[Array, "r axes"]
) -> tuple[Complex[Array, "r axes"], Complex[Array, "r 3"]]:
    """Steady-state internal reading and error of circles."""
    internal, error = answers(loop, omega)
    return jnp.einsum("rxa,ra->rx", internal, asked), jnp.einsum("rxa,ra->rx", error, asked)


def set_phasors(
    circles: Sequence[SetCircle], axes: tuple[str, ...]
) -> tuple[Float[np.ndarray, " r"], Complex[np.ndarray, "r axes"]]:
    """Angular velocities and set points of circles."""
    return (
        np.array([circle.omega for circle in circles]),
        np.array([circle.phasor(axes) for circle in circles]),
    )


def measured_phasors(measurement: Measurement, instrument: RTest) -> Phasors:
    """The phasors of an R-test with readings of coordinates.

    Set points are circles of the commanded radius that start at time zero of a run, as in a trace
    of the controller. Raises `ValueError` for readings of single probes, for scales of undeclared
    noise, and where the scales do not follow such circles.
    """
    instrument.check_coordinates()
    if instrument.internal_sigma == 0.0:
        raise ValueError(
            "[instrument]: found no internal_sigma_um, expected the noise of the scales, which "
            "weights their readings; declare it"
        )
    plan = measurement.plan
    run, t = np.asarray(plan.groups["run"]), np.asarray(plan.covariate("t_run"))
    position, external = np.asarray(plan.position), np.asarray(measurement.readings)
    found = {name: [] for name in ("omega", "asked", "internal", "error", "n")}
    circles = instrument.circles(plan)
    level = {k: float(np.asarray(plan.covariate("a_set_m_s2"))[run == k][0]) for k in circles}
    for number, circle in circles.items():
        mine = run == number
        # Circles of one acceleration have one set speed. The mean of their estimates is used, as
        # the initial phase of a run is twice as uncertain if its own speed is estimated with it.
        alike = [
            c.omega
            for k, c in circles.items()
            if np.isclose(level[k], level[number]) and np.isclose(c.omega, circle.omega, _ALIKE)
        ]
        omega = float(np.mean(alike))
        angle = omega * t[mine]
        turned = np.column_stack([np.ones(mine.sum()), np.cos(angle), np.sin(angle)])
        both = np.column_stack([position[mine], external[mine] - position[mine]])
        _, cosine, sine = np.linalg.lstsq(turned, both, rcond=None)[0]
        internal, error = np.split(cosine - 1j * sine, [position.shape[1]])
        sense = int(np.asarray(plan.covariate("sense"))[mine][0])
        plane = PLANES[int(np.asarray(plan.groups["plane"])[mine][0])]
        try:
            asked = SetCircle(plane, sense, instrument.radius, level[number]).phasor(plan.axes)
        except ValueError as error:
            raise ValueError(f"run {number}: {error}") from error
        _check_follows(number, plan.axes, circle.moving, internal, asked)
        found["omega"].append(omega)
        found["asked"].append(asked)
        found["internal"].append(np.where(circle.moving, internal, 0.0))
        found["error"].append(error)
        found["n"].append(mine.sum())
    arrays = {name: np.array(values) for name, values in found.items()}
    each = np.sqrt(2.0 / arrays.pop("n"))
    # The reading of the scale of an axis at rest is not part of a plan.
    resting = arrays["internal"] == 0.0
    known = np.where(resting, np.inf, instrument.internal_sigma)
    # Its noise is part of the error nevertheless.
    at_rest = np.zeros(arrays["error"].shape)
    places = ["XYZ".index(axis) for axis in plan.axes]
    at_rest[:, places] = np.where(resting, instrument.internal_sigma, 0.0)
    return Phasors(
        axes=plan.axes,
        **{name: jnp.asarray(values) for name, values in arrays.items()},
        internal_u=jnp.asarray(each[:, None] * known),
        external_u=jnp.asarray(each[:, None] * np.hypot(instrument.sigma, at_rest)),
    )


def _check_follows(
    run: int,
    axes: tuple[str, ...],
    moving: np.ndarray,
    internal: Complex[np.ndarray, " axes"],
    asked: Complex[np.ndarray, " axes"],
) -> None:
    """Raise `ValueError` where a scale leads its set point, or lags by almost half a turn.

    The circle then has the opposite sense, or another starting point.
    """
    for axis, part in zip(np.array(axes)[moving], (internal / np.where(asked, asked, 1.0))[moving],
                          strict=True):  # fmt: skip
        lag = -np.degrees(np.angle(part))
        if not -_LEAD <= lag <= _LAG:
            raise ValueError(
                f"run {run}: found the scale of {axis} {lag:.0f} degrees behind its set point, "
                "expected a circle x_1 = r cos, x_2 = sense r sin, with the first axis of XY, YZ "
                "or ZX at its largest at the start of the run; correct the column sense, or count "
                "t_s from there"
            )
