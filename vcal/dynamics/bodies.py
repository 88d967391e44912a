"""The components of a dynamic machine: bodies, springs, drives, scales and the tool point.

All positions are given in the machine frame with all axes at zero. Every component is carried by a
link of the kinematic chain: ``"bed"``, or the slide of an axis.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from ..machine.chain import Chain
from ..numerics.arrays import Array

GROUND = "ground"
"""Name of the ground, on which a foundation stands."""
BED = "bed"

Scalar = float | Float[Array, ""]
Vector3 = Float[Array, "3"]


class Body(eqx.Module):
    """A rigid body with six degrees of freedom at its centre of gravity."""

    name: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    """The link that carries it: ``"bed"``, or an axis."""
    mass: Scalar
    """Mass, kg."""
    inertia: Float[Array, "3 3"]
    """Inertia tensor about its centre of gravity, along the axes of the machine frame, kg m^2."""
    centre: Vector3
    """Centre of gravity, m."""


class Spring(eqx.Module):
    """A spring and a damper at one point between two bodies, such as a guideway carriage."""

    name: str = eqx.field(static=True)
    """Springs with the same name are one group in an identification."""
    body: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    """The other body, or ``"ground"``."""
    link: str = eqx.field(static=True)
    """The link that carries the point."""
    point: Vector3
    stiffness: Vector3
    """Stiffness along X, Y, Z, N/m."""
    turning: Vector3
    """Rotational stiffness about X, Y, Z, N m/rad."""
    damping: Vector3
    """Viscous damping along X, Y, Z, N s/m, in addition to the machine's `loss`."""


class Drive(eqx.Module):
    """The drive of an axis: a force between slide and base at the point of application.

    A ball screw is a spring between the nut and a mass that the motor drives; a linear motor
    acts on the slide directly.
    """

    axis: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    point: Vector3
    """Point of application of the force, m."""
    stiffness: Scalar | None
    """Axial stiffness of screw, nut and bearings, N/m; None for a linear motor."""
    motor_mass: Scalar
    """Inertia of motor and screw as a mass along the axis, J (2 pi / pitch)^2, kg; 0 for none."""


class Friction(eqx.Module):
    """Friction of a guideway along its axis, between slide and base (see `friction`)."""

    axis: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    point: Vector3
    """Point of application, m."""
    coulomb: Scalar
    """Coulomb (sliding) friction force, N."""
    stiction: Scalar
    """Static friction force, N; at least `coulomb`."""
    stribeck: Scalar
    """Stribeck velocity, m/s, of the transition from static to sliding friction."""
    presliding: Scalar
    """Presliding deflection of the contacts, m: bristle stiffness = coulomb / presliding."""
    viscous: Scalar
    """Viscous friction, N s/m."""


class Scale(eqx.Module):
    """The position measurement of an axis: the slide relative to its base at one point."""

    axis: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    base: str = eqx.field(static=True)
    link: str = eqx.field(static=True)
    point: Vector3
    on_motor: bool = eqx.field(static=True, default=False)
    """Whether the encoder of the motor is used instead."""


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
    """Friction, which only `run_with_friction` includes; `run` and `run_circle` are linear."""

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
        """Displacement of a link at given axis positions (m, in the order of `axes`)."""
        place = {axis: i for i, axis in enumerate(self.axes)}
        travelled = jnp.zeros(3)
        for axis in self.carrying(link):
            if axis in place:
                travelled = travelled + self.along(axis) * positions[place[axis]]
        return travelled
