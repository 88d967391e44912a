"""Mass, damping and stiffness matrices of a machine, its inputs and outputs.

    M q'' + D q' + K q = B F,    q_i = (x, y, z, a, b, c) of every body at its centre of gravity,

then one coordinate for the motor of every screw. A point p of body i moves by u + theta x (p - c),
G(p) q_i with G = [1, -skew(p - c)]; a spring between two bodies contributes
(G_a - G_b)' diag(k) (G_a - G_b).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..arrays import Array
from ..spatial import skew
from .bodies import GROUND, Machine


class Structure(eqx.Module):
    """A machine at one place of its travel, as matrices."""

    axes: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, "n n"]
    damping: Float[Array, "n n"]
    stiffness: Float[Array, "n n"]
    force: Float[Array, "n axes"]
    """B: generalised forces per drive force."""
    scale: Float[Array, "axes n"]
    """Reading of every scale, m, positive with the command."""
    pace: Float[Array, "axes n"]
    """What the velocity loop sees: the motor of a screw, or the scale."""
    tool: Float[Array, "3 n"]
    """Tool point against the workpiece, m."""
    travel: Float[Array, "n axes"]
    """Coordinates per travel of an axis, all bodies rigid: what nothing but the drives resists."""

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return self.mass.shape[0]

    @property
    def moved_mass(self) -> Float[Array, " axes"]:
        """Mass that every drive accelerates, its motor's included, kg."""
        return jnp.einsum("na,nm,ma->a", self.travel, self.mass, self.travel)


def assemble(machine: Machine, positions: Float[Array, " axes"] | None = None) -> Structure:
    """The matrices at given axis positions, m, in the order of `Machine.axes`; zero without.

    Masses, stiffnesses and places may be traced.
    """
    q = jnp.zeros(len(machine.axes)) if positions is None else jnp.asarray(positions)
    number = {body.name: i for i, body in enumerate(machine.bodies)}
    screws = [d.axis for d in machine.drives if d.stiffness is not None]
    bodies = 6 * len(machine.bodies)
    size = bodies + len(screws)
    centres = [body.centre + machine.moved(body.link, q) for body in machine.bodies]

    def motion(name: str, point: Array) -> jax.Array:
        """Displacement and rotation (6, n) of a point of a body."""
        found = jnp.zeros((6, size))
        if name == GROUND:
            return found
        i = number[name]
        own = jnp.eye(6).at[:3, 3:].set(-skew(point - centres[i]))
        return found.at[:, 6 * i : 6 * i + 6].set(own)

    def between(body: str, base: str, point: Array) -> jax.Array:
        return motion(body, point) - motion(base, point)

    def motor(axis: str) -> jax.Array:
        return jnp.zeros(size).at[bodies + screws.index(axis)].set(1.0)

    M, D, K = (jnp.zeros((size, size)) for _ in range(3))
    for i, body in enumerate(machine.bodies):
        at = slice(6 * i, 6 * i + 3), slice(6 * i + 3, 6 * i + 6)
        M = M.at[at[0], at[0]].set(body.mass * jnp.eye(3)).at[at[1], at[1]].set(body.inertia)
    for spring in machine.springs:
        G = between(spring.body, spring.base, spring.point + machine.moved(spring.link, q))
        K = K + G.T @ (jnp.concatenate([spring.stiffness, spring.turning])[:, None] * G)
        D = D + G[:3].T @ (spring.damping[:, None] * G[:3])
    force, travel = [], []
    for drive in machine.drives:
        G = between(drive.body, drive.base, drive.point + machine.moved(drive.link, q))
        push = jnp.asarray(machine.along(drive.axis) @ G[:3])
        if drive.stiffness is None:
            force.append(push)
        else:
            own = motor(drive.axis)
            K = K + drive.stiffness * jnp.outer(push - own, push - own)
            M = M + drive.motor_mass * jnp.outer(own, own)
            force.append(own)
        rigid = jnp.zeros(size) if drive.stiffness is None else motor(drive.axis)
        for name, i in number.items():
            if drive.axis in machine.carrying(machine.body(name).link):
                rigid = rigid.at[6 * i : 6 * i + 3].set(machine.along(drive.axis))
        travel.append(rigid)
    D = D + machine.loss * K
    read, pace = [], []
    for scale in machine.scales:
        G = between(scale.body, scale.base, scale.point + machine.moved(scale.link, q))
        read.append(motor(scale.axis) if scale.on_motor else machine.along(scale.axis) @ G[:3])
        pace.append(motor(scale.axis) if scale.axis in screws else read[-1])
    end = machine.tool_point
    tool = between(end.tool, end.work, end.point + machine.moved(end.link, q))[:3]
    return Structure(
        axes=machine.axes,
        mass=M,
        damping=D,
        stiffness=K,
        force=jnp.stack(force, 1),
        scale=jnp.stack(read),
        pace=jnp.stack(pace),
        tool=tool,
        travel=jnp.stack(travel, 1),
    )
