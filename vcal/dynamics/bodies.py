"""What a machine is made of, for its dynamics: bodies, springs, drives, scales, a tool point.

Everything stands where it is at the axis positions zero, in the machine's frame, and rides with a
link of the kinematic chain: ``"bed"``, or the slide of an axis.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from ..machine.chain import Chain
from ..numerics.arrays import Array

GROUND = "ground"
"""What a foundation stands on."""
BED = "bed"

Scalar = float | Float[Array, ""]
Vector3 = Float[Array, "3"]


class Body(eqx.Module):
    """A rigid body with six degrees of freedom at its centre of gravity."""

    name: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    """What it rides with: ``"bed"``, or an axis."""
    mass: Scalar
    """kg."""
    inertia: Float[Array, "3 3"]
    """About its centre of gravity, along the machine's axes, kg m^2."""
    centre: Vector3
    """Centre of gravity, m."""


class Spring(eqx.Module):
    """A spring and a damper at one point between two bodies, such as a guideway carriage."""

    name: str = eqx.field(static=True)
    """Several may share a name, and are then one group for an identification."""
    body: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    """The other body, or ``"ground"``."""
    link: str = eqx.field(static=True)
    """What the point rides with."""
    point: Vector3
    stiffness: Vector3
    """Along X, Y, Z, N/m."""
    turning: Vector3
    """About X, Y, Z, N m/rad."""
    damping: Vector3
    """Viscous, along X, Y, Z, N s/m, beside that of the machine's `loss`."""


class Drive(eqx.Module):
    """What moves an axis: its force acts between slide and base at the point of attack.

    A ball screw is a spring between the nut and a mass that the motor drives; a linear motor
    pushes the slide itself.
    """

    axis: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    point: Vector3
    """Where the force attacks, m."""
    stiffness: Scalar | None
    """Of screw, nut and bearings along the axis, N/m; None for a linear motor."""
    motor_mass: Scalar
    """Inertia of motor and screw as a mass along the axis, J (2 pi / pitch)^2, kg; 0 for none."""


class Friction(eqx.Module):
    """Friction of a guideway along its axis, between slide and base (see `friction`)."""

    axis: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    point: Vector3
    """Where it acts, m."""
    coulomb: Scalar
    """Force of sliding, N."""
    stiction: Scalar
    """Force at which sliding sets in, N; no less than `coulomb`."""
    stribeck: Scalar
    """Velocity over which the one goes over into the other, m/s."""
    presliding: Scalar
    """How far contacts bend before they slide, m: bristle stiffness = coulomb / presliding."""
    viscous: Scalar
    """N s/m."""


class Scale(eqx.Module):
    """Where an axis is measured: the slide against its base at one point."""

    axis: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    point: Vector3
    on_motor: bool = eqx.field(static=True, default=False)
    """Whether it is the motor's encoder instead."""


class ToolPoint(eqx.Module):
    """The point at which tool and workpiece meet."""

    tool: str = eqx.field(static=True)
    """Body that carries the tool."""
    work: str = eqx.field(static=True)
    """Body that carries the workpiece."""
    link: str = eqx.field(static=True)
    point: Vector3


class Machine(eqx.Module):
    """Bodies on springs, and the drives that move them."""

    chain: Chain
    bodies: tuple[Body, ...]
    springs: tuple[Spring, ...]
    drives: tuple[Drive, ...]
    scales: tuple[Scale, ...]
    tool_point: ToolPoint
    loss: Scalar
    """Damping of every spring over its stiffness, 2 zeta / omega, s."""
    friction: tuple[Friction, ...] = ()
    """What `run` and `run_circle`, which are linear, leave out and `run_with_friction` has."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that have a drive, in the order of inputs and outputs."""
        return tuple(drive.axis for drive in self.drives)

    def body(self, name: str) -> Body:
        """A body by name."""
        return next(body for body in self.bodies if body.name == name)

    def carrying(self, link: str) -> tuple[str, ...]:
        """The axes that move a link, from the bed outwards."""
        if link == BED:
            return ()
        for side in (self.chain.tool_side, self.chain.workpiece_side):
            names = [self.chain.joints[i].name for i in side]
            if link in names:
                return tuple(names[: names.index(link) + 1])
        raise ValueError(f"no link named {link!r}; this machine has bed, {', '.join(self.axes)}")

    def along(self, axis: str) -> Array:
        """Unit vector (3,) in which the slide of an axis moves when its command grows."""
        joint = self.chain.joint(axis)
        return joint.sign * jnp.asarray(joint.direction)

    def moved(self, link: str, positions: Float[Array, " axes"]) -> Array:
        """By how much a link has travelled at given axis positions (m, in the order of `axes`)."""
        place = {axis: i for i, axis in enumerate(self.axes)}
        travelled = jnp.zeros(3)
        for axis in self.carrying(link):
            if axis in place:
                travelled = travelled + self.along(axis) * positions[place[axis]]
        return travelled
