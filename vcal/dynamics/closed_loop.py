"""A machine under its controllers, exactly discretised.

Between two samples the plant is linear and the forces are constant, so that

    x(t + h) = e^(A h) x(t) + G(h) F,    G(h) = int_0^h e^(A s) ds B

holds exactly. A force acts one delay after its sample: with the delay d T + f T, 0 <= f < 1, the
force of d + 1 samples ago acts for f T in a sample interval, and then the force of d samples ago.
Plant, integrators and pending forces form one linear system,

    X[k+1] = Phi X[k] + Gamma r[k],    y[k] = C X[k],    r = (z_s, v_s).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Complex, Float

from ..numerics.arrays import Array
from .control import Controller
from .structure import Structure

PENDING = 3
"""Number of pending forces, which limits the delay to this number of samples minus one."""
_SQUARINGS = 7
_SAMPLED = 1e-9
"""Tolerance of the remaining amplitude of a mode after one sample time."""
_DOUBLINGS = 24
"""Number of squarings of Phi in the stability check, which covers hours of samples."""
_PACE = 1e3
"""rad/s. Velocities are scaled by it, so that the numbers of a state have similar sizes."""


class ClosedLoop(eqx.Module):
    """The discrete system of a machine and its controllers."""

    axes: tuple[str, ...] = eqx.field(static=True)
    sample_time: float = eqx.field(static=True)
    transition: Float[Array, "m m"]
    """Phi."""
    input: Float[Array, "m 2*axes"]
    """Gamma, for set positions and set velocities."""
    scale: Float[Array, "axes m"]
    """Rows of C: position read by every scale, m."""
    velocity: Float[Array, "axes m"]
    """Rows of C for the velocity at every scale, m/s."""
    acceleration: Float[Array, "axes m"]
    """Rows of C for the acceleration at every scale just after the sample, m/s^2."""
    through: Float[Array, "axes 2*axes"]
    """Direct feed-through of the set points to the acceleration, for forces without delay."""
    tool: Float[Array, "3 m"]
    """Rows of C for the tool point relative to the workpiece, m."""

    @property
    def structural(self) -> Float[Array, "3 m"]:
        """Tool point relative to the position given by the scales: the error of the structure."""
        return (
            jnp.asarray(self.tool)
            .at[jnp.array(["XYZ".index(a) for a in self.axes])]
            .add(-self.scale)
        )


class Response(eqx.Module):
    """The response to set points at the samples."""

    t: Float[Array, " n"]
    scale: Float[Array, "n axes"]
    """Actual positions, m."""
    velocity: Float[Array, "n axes"]
    acceleration: Float[Array, "n axes"]
    """Actual accelerations, m/s^2."""
    tool: Float[Array, "n 3"]
    """Tool point, m."""
    error: Float[Array, "n 3"]
    """Tool point relative to the position given by the scales, m."""


def controlled(structure: Structure, controller: Controller) -> ClosedLoop:
    """The closed loop; structure and controller may be traced."""
    n, axes, T = structure.size, len(structure.axes), controller.sample_time
    inverse = jnp.linalg.inv(structure.mass)
    flow = jnp.zeros((2 * n, 2 * n)).at[:n, n:].set(_PACE * jnp.eye(n))
    flow = flow.at[n:, :n].set(-inverse @ structure.stiffness / _PACE)
    flow = flow.at[n:, n:].set(-inverse @ structure.damping)
    push = jnp.zeros((2 * n, axes)).at[n:].set(inverse @ structure.force / _PACE)

    whole = jnp.floor(jax.lax.stop_gradient(controller.delay) / T)
    part = controller.delay - whole * T
    first, late = _step(flow, push, part)
    rest, soon = _step(flow, push, T - part)
    # Column block j belongs to the force of j samples ago.
    age = jnp.arange(PENDING)
    now, before = (age == whole) * 1.0, (age == whole + 1) * 1.0
    forces = jnp.concatenate(
        [now[j] * soon + before[j] * (rest @ late) for j in range(PENDING)], axis=1
    )

    # State: plant, integrators, forces of the last PENDING - 1 samples, newest first.
    places = np.cumsum([0, 2 * n, axes, (PENDING - 1) * axes])
    plant, integral, past = (slice(a, b) for a, b in zip(places[:-1], places[1:], strict=True))
    size = int(places[-1])
    scale = jnp.zeros((axes, size)).at[:, :n].set(structure.scale)
    velocity = jnp.zeros((axes, size)).at[:, n : 2 * n].set(_PACE * structure.scale)
    tool = jnp.zeros((3, size)).at[:, :n].set(structure.tool)
    Kv, Kp = controller.position_gain[:, None], controller.velocity_gain[:, None]
    paced = jnp.zeros((axes, size)).at[:, n : 2 * n].set(_PACE * structure.pace)
    lag = -Kv * scale - paced
    asked = jnp.concatenate([jnp.diag(Kv[:, 0]), jnp.diag(controller.feed_forward)], 1)
    force = Kp * jnp.asarray(lag).at[:, integral].add(jnp.eye(axes))
    by_set = Kp * asked

    Phi, Gamma = jnp.zeros((size, size)), jnp.zeros((size, 2 * axes))
    Phi = Phi.at[plant, plant].set(rest @ first).at[plant, past].set(forces[:, axes:])
    Phi = Phi.at[plant].add(forces[:, :axes] @ force)
    Gamma = Gamma.at[plant].set(forces[:, :axes] @ by_set)
    share = T / controller.integral_time[:, None]
    Phi = Phi.at[integral].add(share * lag).at[integral, integral].add(jnp.eye(axes))
    Gamma = Gamma.at[integral].set(share * asked)
    newest = slice(past.start, past.start + axes)
    Phi, Gamma = Phi.at[newest].set(force), Gamma.at[newest].set(by_set)
    older = slice(past.start + axes, past.stop)
    Phi = Phi.at[older, past.start : past.stop - axes].set(jnp.eye((PENDING - 2) * axes))

    # Of the force that acts from the sample on: the newest one with no delay.
    acting = _PACE * push[n:]
    acceleration = jnp.zeros((axes, size)).at[:, plant].set(_PACE * structure.scale @ flow[n:])
    held = structure.scale @ acting
    for j in range(1, PENDING):
        older = slice(past.start + (j - 1) * axes, past.start + j * axes)
        acts = jnp.where(part > 0.0, before[j], now[j])
        acceleration = acceleration.at[:, older].add(acts * held)
    fresh = jnp.where(part > 0.0, before[0], now[0])
    acceleration, through = acceleration + fresh * held @ force, fresh * held @ by_set
    return ClosedLoop(structure.axes, T, Phi, Gamma, scale, velocity, acceleration, through, tool)


def _step(flow: Array, push: Array, h: Array | float) -> tuple[Array, Array]:
    """e^(A h) and G(h)."""
    size, axes = push.shape
    both = jnp.zeros((size + axes, size + axes)).at[:size, :size].set(flow)
    found = _exponential(h * both.at[:size, size:].set(push))
    return found[:size, :size], found[:size, size:]


def _exponential(X: Array) -> Array:
    """e^X for a 1-norm of up to 2^(_SQUARINGS - 1), by its Taylor series to the sixteenth power.

    The number of products is fixed, so that the function and its derivatives compile to small
    programs, mapped or not.
    """
    X = X / 2.0**_SQUARINGS
    powers = [jnp.eye(X.shape[0]), X, X @ X]
    powers.append(powers[2] @ X)
    fourth = powers[2] @ powers[2]
    found = jnp.zeros_like(X)
    for start in (16, 12, 8, 4, 0):
        part = sum(powers[i] / math.factorial(start + i) for i in range(4 if start < 16 else 1))
        found = found @ fourth + part
    for _ in range(_SQUARINGS):
        found = found @ found
    return found


def check_sampled(structure: Structure, sample_time: float) -> None:
    """Raise `ValueError` where a mode oscillates or decays too fast for the matrix exponential over
    one sample time (`controlled`).
    """
    n = structure.size
    inverse = np.linalg.inv(np.asarray(structure.mass))
    flow = np.zeros((2 * n, 2 * n))
    flow[:n, n:] = _PACE * np.eye(n)
    flow[n:, :n] = -inverse @ np.asarray(structure.stiffness) / _PACE
    flow[n:, n:] = -inverse @ np.asarray(structure.damping)
    poles = np.linalg.eigvals(flow)
    parts = 2.0**_SQUARINGS
    with np.errstate(over="ignore", invalid="ignore"):
        series = np.polyval([1.0 / math.factorial(k) for k in range(16, -1, -1)], poles *
                            sample_time / parts) ** parts  # fmt: skip
        wrong = ~(np.abs(series - np.exp(poles * sample_time)) <= _SAMPLED)
    if wrong.any():
        worst = np.abs(poles[wrong]).max()
        raise ValueError(
            f"controller: found a mode of {worst / (2.0 * np.pi):.3g} Hz, far too stiff for the "
            f"sample time of {sample_time:g} s, expected modes whose motion over one sample can be "
            "computed; shorten the sample time, correct the stiffness, the damping and the masses, "
            "or merge the bodies that such a spring connects"
        )


def check_stable(loop: ClosedLoop, structure: Structure | None = None) -> None:
    """Raise `ValueError` where the loop is unstable.

    The message gives the doubling time log(2) / s of the growth exp(s t). With the structure, it
    also reports springs without damping, for which no gain compensates, and a sample time that is
    too long for the machine.
    """
    if structure is not None:
        check_sampled(structure, loop.sample_time)
    if not np.isfinite(loop.transition).all():
        raise ValueError(
            "controller: found a motion over one sample that is not finite, expected numbers; "
            "correct the stiffness and the masses, or shorten the sample time"
        )
    values, shapes = np.linalg.eig(np.asarray(loop.transition))
    worst = int(np.argmax(np.abs(values)))
    radius = float(np.abs(values[worst]))
    if radius < 1.0:
        return
    moved = np.abs(np.asarray(loop.scale) @ shapes[:, worst])
    axis = loop.axes[int(np.argmax(moved))]
    hz = float(np.abs(np.angle(values[worst]))) / (2.0 * np.pi * loop.sample_time)
    rate = float(np.log(radius)) / loop.sample_time
    fast = f"growing twofold within {math.log(2.0) / rate:.3g} s" if rate > 0.0 else "without decay"
    do = "lower position_gain or bandwidth, shorten the delay, or stiffen the machine"
    if structure is not None and structure.undamped:
        # Even at low gains, a delay or a scale off the drive excites an undamped mode.
        do = f"declare the damping of the springs, which have none; if that is not enough, {do}"
    raise ValueError(
        f"controller: found an unstable loop, {fast} at {hz:.3g} Hz, mostly in axis {axis}, "
        f"expected one that settles; {do}"
    )


def settles(loop: ClosedLoop) -> Bool[Array, ""]:
    """Whether a loop is stable, as a value that may be jitted and mapped: ||Phi^(2^24)|| < 1."""
    power = loop.transition
    for _ in range(_DOUBLINGS):
        power = power @ power
    # An overflow gives no number, which compares as not below one.
    return jnp.sqrt(jnp.sum(power**2)) < 1.0


def run(
    loop: ClosedLoop, position: Float[Array, "n axes"], velocity: Float[Array, "n axes"]
) -> Response:
    """The response to set points at the samples, from rest at zero.

    Raises `ValueError` where positions and velocities differ in shape or have no column per axis.
    """
    asked = set_points(loop.axes, position, velocity)

    def step(state: Array, r: Array) -> tuple[Array, Array]:
        return loop.transition @ state + loop.input @ r, state

    _, states = jax.lax.scan(step, jnp.zeros(loop.transition.shape[0]), asked)
    return _response(loop, loop.sample_time * jnp.arange(asked.shape[0]), states, asked)


def set_points(
    axes: tuple[str, ...],
    position: Float[Array | np.ndarray, "n axes"],
    velocity: Float[Array | np.ndarray, "n axes"],
) -> Float[Array, "n 2*axes"]:
    """r = (z_s, v_s) of every sample.

    Raises `ValueError` where positions and velocities differ in shape or have no column per axis.
    """
    position, velocity = jnp.asarray(position), jnp.asarray(velocity)
    if position.shape != velocity.shape or position.shape[1:] != (len(axes),):
        raise ValueError(
            f"set points: found positions of shape {position.shape} and velocities of shape "
            f"{velocity.shape}, expected (n, {len(axes)}) of both, a row per sample and a column "
            f"for each of {', '.join(axes)}; correct them"
        )
    return jnp.concatenate([position, velocity], axis=1)


def steady(loop: ClosedLoop, omega: Float[Array, ""] | float) -> Complex[Array, "m axes"]:
    """Steady-state states per set position exp(i omega t) of every axis.

    (z - Phi) X = Gamma (1, i omega), z = exp(i omega T). This solution also exists for an unstable
    loop, which never reaches it; use `check_stable`, or `settles` within a program.
    """
    axes = len(loop.axes)
    z = jnp.exp(1j * omega * loop.sample_time)
    asked = loop.input[:, :axes] + 1j * omega * loop.input[:, axes:]
    return jnp.linalg.solve(z * jnp.eye(loop.transition.shape[0]) - loop.transition, asked)


def run_circle(
    loop: ClosedLoop, phasor: Complex[Array, " axes"], omega: float, t: Float[Array, " n"]
) -> Response:
    """The steady-state response to a circle at any times.

    Raises `ValueError` for a phasor without one number per axis, and as `check_stable` does for an
    unstable loop; the caller checks the stability of a traced loop.
    """
    phasor = jnp.asarray(phasor)
    if phasor.shape != (len(loop.axes),):
        raise ValueError(
            f"phasor: found an array of shape {phasor.shape}, expected ({len(loop.axes)},), one "
            f"number for each of {', '.join(loop.axes)}; correct it"
        )
    if not isinstance(loop.transition, Tracer):
        check_stable(loop)
    turned = jnp.exp(1j * omega * jnp.asarray(t))[:, None]
    states = (turned * (steady(loop, omega) @ phasor)).real
    asked = (turned * jnp.concatenate([phasor, 1j * omega * phasor])).real
    return _response(loop, jnp.asarray(t), states, asked)


def _response(loop: ClosedLoop, t: Array, states: Array, asked: Array) -> Response:
    return Response(
        t,
        states @ loop.scale.T,
        states @ loop.velocity.T,
        states @ loop.acceleration.T + asked @ loop.through.T,
        states @ loop.tool.T,
        states @ loop.structural.T,
    )
