"""A machine with friction in its guideways, under its controllers.

LuGre (Canudas de Wit, Olsson, Astrom, Lischinsky 1995): contacts are bristles that bend by z while
surfaces move at w against each other,

    z' = w - s |w| z / g(w),    g(w) = Fc + (Fs - Fc) exp(-(w / w_s)^2),    s = Fc / z_0,
    force = s z + s_1 z' + c w,

and that yield where s z reaches g. Friction before sliding is a spring, sliding starts at Fs and
continues with Fc, and a reversal passes through the spring again. This causes the peaks at the
quadrants of a circle, which no linear model has. Plant and bristles are integrated from one change
of the forces to the next by diffrax; the controllers are those of `controlled`, sample by sample.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..numerics.arrays import Array
from .bodies import Machine
from .closed_loop import PENDING, Response, set_points
from .control import Controller
from .structure import Structure, assemble, between

_PACE = 1e3
"""rad/s. Velocities are integrated in units of it, so that one tolerance suits all states."""
_ABSOLUTE_M = 1e-13
_STEPS = 4096
"""Largest number of integrator steps between two changes of the forces."""
_DAMPED = 0.7
"""Damping ratio of a slide on its bristles, which gives s_1."""


class Rubbing(eqx.Module):
    """Friction of several guideways as arrays, with its points of application."""

    rows: Float[Array, "f n"]
    """Sliding velocity per velocity of the coordinates."""
    coulomb: Float[Array, " f"]
    stiction: Float[Array, " f"]
    stribeck: Float[Array, " f"]
    stiffness: Float[Array, " f"]
    """s, N/m."""
    damping: Float[Array, " f"]
    """s_1, N s/m."""
    viscous: Float[Array, " f"]

    def slide(self, w: Float[Array, " f"], z: Float[Array, " f"]) -> tuple[Array, Array]:
        """Friction force (N) and z' (m/s) at a sliding velocity w and a deflection z."""
        g = self.coulomb + (self.stiction - self.coulomb) * jnp.exp(-((w / self.stribeck) ** 2))
        rate = w - self.stiffness * jnp.abs(w) * z / g
        return self.stiffness * z + self.damping * rate + self.viscous * w, rate


def rubbing(machine: Machine, structure: Structure) -> Rubbing:
    """The friction of a machine; raises `ValueError` for a machine without friction."""
    if not machine.friction:
        raise ValueError(
            "machine: found no friction, expected some; add [[friction]] to its description, or "
            "use run, which is exact without friction"
        )
    drives = {drive.axis: drive for drive in machine.drives}
    q = jnp.zeros(len(machine.axes))
    places = [(drives[f.axis].body, drives[f.axis].base, f.link, f.point) for f in machine.friction]
    G = between(machine, structure.size, q, places)
    along = jnp.stack([machine.along(f.axis) for f in machine.friction])
    mass = structure.moved_mass[jnp.array([machine.axes.index(f.axis) for f in machine.friction])]

    def each(name: str) -> Array:
        return jnp.stack([jnp.asarray(getattr(f, name), float) for f in machine.friction])

    stiffness = each("coulomb") / each("presliding")
    return Rubbing(
        jnp.einsum("fx,fxn->fn", along, G[:, :3]),
        each("coulomb"),
        each("stiction"),
        each("stribeck"),
        stiffness,
        2.0 * _DAMPED * jnp.sqrt(stiffness * mass),
        each("viscous"),
    )


def run_with_friction(
    machine: Machine,
    controller: Controller,
    position: Float[Array | np.ndarray, "n axes"],
    velocity: Float[Array | np.ndarray, "n axes"],
    *,
    tolerance: float = 1e-8,
) -> Response:
    """The response to set points at the samples, from rest at zero, with friction.

    `tolerance` is the relative error of a step of the integrator (Tsitouras 5(4)). Raises
    `ValueError` for a machine without friction, where positions and velocities differ in shape or
    have no column per axis, and where an interval takes more than 4096 steps, as for an unstable
    loop.
    """
    structure = assemble(machine)
    rub = rubbing(machine, structure)
    asked = set_points(machine.axes, position, velocity)
    found, done = _run(structure, controller, rub, asked, jnp.asarray(tolerance))
    if not bool(done):
        raise ValueError(
            f"found more than {_STEPS} steps of the integrator within a sample, expected fewer: "
            "the loop is unstable, or the friction too stiff; lower the gains, lengthen presliding "
            "or shorten the sample time"
        )
    return found


@eqx.filter_jit
def _run(
    structure: Structure, controller: Controller, rub: Rubbing, asked: Array, tolerance: Array
) -> tuple[Response, Array]:
    n, axes, T = structure.size, len(structure.axes), controller.sample_time
    inverse = jnp.linalg.inv(structure.mass)
    free = jnp.concatenate([structure.stiffness, _PACE * structure.damping], axis=1)

    def speed(y: Array, force: Array) -> tuple[Array, Array]:
        """Acceleration of the coordinates, and z'."""
        w = rub.rows @ (_PACE * y[n : 2 * n])
        against, rate = rub.slide(w, y[2 * n :])
        pushed = structure.force @ force - rub.rows.T @ against - free @ y[: 2 * n]
        return inverse @ pushed, rate

    def flow(_, y: Array, args: tuple[Array, Array]) -> Array:
        h, force = args
        acceleration, rate = speed(y, force)
        return h * jnp.concatenate([_PACE * y[n : 2 * n], acceleration / _PACE, rate])

    control = diffrax.PIDController(rtol=tolerance, atol=_ABSOLUTE_M)

    def integrate(y: Array, force: Array, h: Array) -> tuple[Array, Array]:
        # Time in units of the interval, which may have zero length.
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(flow),
            diffrax.Tsit5(),
            0.0,
            1.0,
            None,
            y,
            (h, force),
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=control,
            max_steps=_STEPS,
            throw=False,
        )
        assert found.ys is not None
        return found.ys[0], jnp.asarray(found.result == diffrax.RESULTS.successful)

    late = jnp.floor(controller.delay / T).astype(int)
    part = controller.delay - late * T

    def sample(state, r: Array):
        y, integral, past = state
        q, v = y[:n], _PACE * y[n : 2 * n]
        e = controller.position_gain * (r[:axes] - structure.scale @ q)
        e = e + controller.feed_forward * r[axes:] - structure.pace @ v
        forces = jnp.concatenate([(controller.velocity_gain * (e + integral))[None], past])
        before, now = forces[late + 1], forces[late]
        acceleration, _ = speed(y, jnp.where(part > 0.0, before, now))
        shown = q, v, acceleration
        y, first = integrate(y, before, part)
        y, second = integrate(y, now, T - part)
        integral = integral + T / controller.integral_time * e
        return (y, integral, forces[:-1]), (*shown, first & second)

    start = jnp.zeros(2 * n + len(rub.coulomb)), jnp.zeros(axes), jnp.zeros((PENDING, axes))
    _, (q, v, a, done) = jax.lax.scan(sample, start, asked)
    read, tool = q @ structure.scale.T, q @ structure.tool.T
    place = jnp.array(["XYZ".index(axis) for axis in structure.axes])
    return (
        Response(
            T * jnp.arange(asked.shape[0]),
            read,
            v @ structure.scale.T,
            a @ structure.scale.T,
            tool,
            tool.at[:, place].add(-read),
        ),
        jnp.all(done),
    )
