"""Circles as the numbers that determine them: one complex amplitude per reading.

A linear machine on a circle answers with the circle's frequency, so that amplitude and phase of the
fundamental hold all that a run says. They are estimated by least squares from the samples; with
white noise sigma and n samples over whole turns, the real and the imaginary part have the standard
uncertainty sigma sqrt(2 / n) each.
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
"""Degrees by which a scale may be ahead of its set point, and behind it."""


class Phasors(eqx.Module):
    """Fundamental of many circles, x(t) = Re(X exp(i omega t)), t from the start of a run."""

    axes: tuple[str, ...] = eqx.field(static=True)
    omega: Float[Array, " r"]
    """rad/s."""
    asked: Complex[Array, "r axes"]
    """Set points, m."""
    internal: Complex[Array, "r axes"]
    """Scales, m."""
    error: Complex[Array, "r 3"]
    """External less internal reading, m."""
    internal_u: Float[Array, "r axes"]
    """Standard uncertainty of real and imaginary part of `internal`, m; infinite where nothing is
    known of a scale, such as that of an axis at rest.
    """
    external_u: Float[Array, "r 3"]
    """The same of what the probes show and of nothing that `internal` tells, m: their noise is in
    the error, and so is that of the scales.
    """


def answers(
    loop: ClosedLoop, omega: Float[Array, " w"]
) -> tuple[Complex[Array, "w axes axes"], Complex[Array, "w 3 axes"]]:
    """Internal reading and error per set position exp(i omega t) of every axis, once settled."""
    states = jax.vmap(lambda w: steady(loop, w))(omega)
    return loop.scale @ states, loop.structural @ states


def predicted(
    loop: ClosedLoop, omega: Float[Array, " r"], asked: Complex[Array, "r axes"]
) -> tuple[Complex[Array, "r axes"], Complex[Array, "r 3"]]:
    """Internal reading and error of circles that go on for ever."""
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
    """Those of an R-test that reads coordinates.

    Set points are circles of the commanded radius that begin with the time of a run, as a trace of
    the controller does. Raises `ValueError` for readings of probes, for scales of undeclared noise,
    and where the scales do not follow such circles.
    """
    instrument.check_coordinates()
    if instrument.internal_sigma == 0.0:
        raise ValueError(
            "[instrument]: found no internal_sigma_um, expected the noise of the scales, by which "
            "their readings count; declare it"
        )
    plan = measurement.plan
    run, t = np.asarray(plan.groups["run"]), np.asarray(plan.covariate("t_run"))
    position, external = np.asarray(plan.position), np.asarray(measurement.readings)
    found = {name: [] for name in ("omega", "asked", "internal", "error", "n")}
    circles = instrument.circles(plan)
    level = {k: float(np.asarray(plan.covariate("a_set_m_s2"))[run == k][0]) for k in circles}
    for number, circle in circles.items():
        mine = run == number
        # Circles of one level are asked for at one speed: the mean of what they show, as a phase at
        # the start of a single run is twice as uncertain where its own speed is to be found.
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
    # What the scale of an axis at rest read is not part of a plan.
    resting = arrays["internal"] == 0.0
    known = np.where(resting, np.inf, instrument.internal_sigma)
    # Its noise is in the error, all the same.
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
    """Raise `ValueError` where a scale leads its set point, or is further behind than half a turn
    less some: the circle then has another sense, or begins elsewhere.
    """
    for axis, part in zip(np.array(axes)[moving], (internal / np.where(asked, asked, 1.0))[moving],
                          strict=True):  # fmt: skip
        lag = -np.degrees(np.angle(part))
        if not -_LEAD <= lag <= _LAG:
            raise ValueError(
                f"run {run}: found the scale of {axis} {lag:.0f} degrees behind its set point, "
                "expected a circle x_1 = r cos, x_2 = sense r sin, with the first axis of XY, YZ "
                "or ZX at its largest where the time of the run begins; correct the column sense, "
                "or count t_s from there"
            )
