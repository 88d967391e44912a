"""Mass, damping and stiffness matrices of a machine, with its inputs and outputs.

    M q'' + D q' + K q = B F,    q_i = (x, y, z, a, b, c) of every body at its centre of gravity,

followed by one coordinate for the motor of every screw. A point p of body i moves by
u + theta x (p - c),
G(p) q_i with G = [1, -skew(p - c)]; a spring between two bodies contributes
(G_a - G_b)' diag(k) (G_a - G_b).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..numerics.arrays import Array
from ..numerics.spatial import require_float64, skew
from .bodies import GROUND, Machine


class Structure(eqx.Module):
    """The matrices of a machine at one position of its axes."""

    axes: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, "n n"]
    damping: Float[Array, "n n"]
    stiffness: Float[Array, "n n"]
    force: Float[Array, "n axes"]
    """B: generalised forces per drive force."""
    scale: Float[Array, "axes n"]
    """Reading of every scale, m, positive with the command."""
    pace: Float[Array, "axes n"]
    """Feedback of the velocity loop: the motor of a screw, or the scale."""
    tool: Float[Array, "3 n"]
    """Tool point relative to the workpiece, m."""
    travel: Float[Array, "n axes"]
    """Rigid motion of the coordinates per travel of an axis, which only the drives resist."""

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return self.mass.shape[0]

    @property
    def undamped(self) -> bool:
        """Whether no spring or screw has any damping; not for traced matrices."""
        return not np.asarray(self.damping).any()

    @property
    def moved_mass(self) -> Float[Array, " axes"]:
        """Mass that every drive accelerates, including its motor, kg."""
        return jnp.einsum("na,nm,ma->a", self.travel, self.mass, self.travel)


def assemble(machine: Machine, positions: Float[Array, " axes"] | None = None) -> Structure:
    """The matrices at given axis positions, m, in the order of `Machine.axes`; zero by default.

    Masses, stiffnesses and positions may be traced. Raises `RuntimeError` in float32, and
    `ValueError` for a wrong number of positions.
    """
    require_float64()
    q = jnp.zeros(len(machine.axes)) if positions is None else jnp.asarray(positions)
    if q.shape != (len(machine.axes),):
        raise ValueError(
            f"positions: found an array of shape {q.shape}, expected ({len(machine.axes)},), one "
            f"for each of {', '.join(machine.axes)}; correct it"
        )
    screws = [d.axis for d in machine.drives if d.stiffness is not None]
    bodies = 6 * len(machine.bodies)
    size = bodies + len(screws)
    # All points at once, as a program of few large steps compiles and runs in less time.
    kinds = (machine.springs, machine.drives, machine.scales)
    end = machine.tool_point
    joints = [(j.body, j.base, j.link, j.point) for kind in kinds for j in kind]
    relative = between(machine, size, q, [*joints, (end.tool, end.work, end.link, end.point)])
    first = np.cumsum([0, *map(len, kinds)])
    at_springs, at_drives, at_scales = (
        relative[a:b] for a, b in zip(first[:-1], first[1:], strict=True)
    )

    def motor(axis: str) -> jax.Array:
        return jnp.zeros(size).at[bodies + screws.index(axis)].set(1.0)

    M, D, K = (jnp.zeros((size, size)) for _ in range(3))
    for i, body in enumerate(machine.bodies):
        at = slice(6 * i, 6 * i + 3), slice(6 * i + 3, 6 * i + 6)
        M = M.at[at[0], at[0]].set(body.mass * jnp.eye(3)).at[at[1], at[1]].set(body.inertia)
    if machine.springs:
        stiff = jnp.stack([jnp.concatenate([s.stiffness, s.turning]) for s in machine.springs])
        viscous = jnp.stack([s.damping for s in machine.springs])
        G, turned = at_springs.reshape(-1, size), at_springs[:, :3].reshape(-1, size)
        K = K + G.T @ (stiff.reshape(-1, 1) * G)
        D = D + turned.T @ (viscous.reshape(-1, 1) * turned)
    force, travel = [], []
    for drive, G in zip(machine.drives, at_drives, strict=True):
        push = jnp.asarray(machine.along(drive.axis) @ G[:3])
        if drive.stiffness is None:
            force.append(push)
        else:
            own = motor(drive.axis)
            K = K + drive.stiffness * jnp.outer(push - own, push - own)
            M = M + drive.motor_mass * jnp.outer(own, own)
            force.append(own)
        rigid = jnp.zeros(size) if drive.stiffness is None else motor(drive.axis)
        for i, body in enumerate(machine.bodies):
            if drive.axis in machine.carrying(body.link):
                rigid = rigid.at[6 * i : 6 * i + 3].set(machine.along(drive.axis))
        travel.append(rigid)
    D = D + machine.loss * K
    read, pace = [], []
    for scale, G in zip(machine.scales, at_scales, strict=True):
        read.append(motor(scale.axis) if scale.on_motor else machine.along(scale.axis) @ G[:3])
        pace.append(motor(scale.axis) if scale.axis in screws else read[-1])
    return Structure(
        axes=machine.axes,
        mass=M,
        damping=D,
        stiffness=K,
        force=jnp.stack(force, 1),
        scale=jnp.stack(read),
        pace=jnp.stack(pace),
        tool=relative[-1, :3],
        travel=jnp.stack(travel, 1),
    )


def between(
    machine: Machine, size: int, q: Array, joints: Sequence[tuple[str, str, str, Array]]
) -> Float[Array, "p 6 n"]:
    """Displacement and rotation of a body relative to its base, at points carried by a link."""
    number = {body.name: i for i, body in enumerate(machine.bodies)}
    centres = jnp.stack([b.centre + machine.moved(b.link, q) for b in machine.bodies])
    links = list(dict.fromkeys(link for _, _, link, _ in joints))
    travelled = jnp.stack([machine.moved(link, q) for link in links])
    points = jnp.stack([jnp.asarray(point) for *_, point in joints])
    points = points + travelled[np.array([links.index(link) for _, _, link, _ in joints])]

    def motion(names: Sequence[str]) -> Array:
        # The ground has no coordinates, so that its rows stay zero.
        place = np.array([number.get(name, 0) for name in names])
        chosen = np.zeros((len(names), 6, size))
        for row, name in enumerate(names):
            if name != GROUND:
                chosen[row, :, 6 * number[name] : 6 * number[name] + 6] = np.eye(6)
        levers = -jax.vmap(skew)(points - centres[place])
        own = jnp.tile(jnp.eye(6), (len(names), 1, 1)).at[:, :3, 3:].set(levers)
        return own @ chosen

    return motion([body for body, *_ in joints]) - motion([base for _, base, *_ in joints])
