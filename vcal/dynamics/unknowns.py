"""Unknown parameters of a machine and its controllers, each with its catalogue value and prior.

z is the deviation in prior standard deviations, so that zero is the catalogue value. A new kind of
unknown is a class with `apply`.
"""

import abc
import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..numerics.arrays import Array
from ..registry import nearest
from .bodies import Machine, Scalar
from .control import Controller

_ROUNDED = 0.02
"""Of a sample time: how near to its ends a delay is bent away from them."""


class Unknown(eqx.Module):
    """Base class; subclasses are final."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The name, such as ``"stiffness of carriage Z"``."""

    @property
    @abc.abstractmethod
    def unit(self) -> str:
        """The unit of `value`."""

    @abc.abstractmethod
    def value(self, z: Scalar, controller: Controller) -> Scalar:
        """The quantity in `unit` at z prior standard deviations from its catalogue value.

        For a parameter of the controllers, it is the difference from the declared value.
        """

    def check(self, machine: Machine) -> None:
        """Raise `ValueError` where the machine has no such component."""
        del machine

    @abc.abstractmethod
    def apply(
        self, machine: Machine, controller: Controller, z: Scalar
    ) -> tuple[Machine, Controller]:
        """Machine and controller with the value at z."""


class _Factor(Unknown):
    """A quantity that is wrong by a factor: log-normal about its catalogue value."""

    spread: float = eqx.field(static=True, default=math.log(2.0), kw_only=True)
    """Standard deviation of the natural logarithm; log 2 for "a factor of two"."""

    @property
    def unit(self) -> str:
        return "1"

    def value(self, z: Scalar, controller: Controller) -> Scalar:
        del controller
        return jnp.exp(self.spread * z)


class SpringFactor(_Factor):
    """Stiffness of all springs of one name, relative to the catalogue."""

    spring: str = eqx.field(static=True)

    @property
    def name(self) -> str:
        return f"stiffness of {self.spring}"

    def check(self, machine):
        _known(self, self.spring, [spring.name for spring in machine.springs], "springs")

    def apply(self, machine, controller, z):
        factor = self.value(z, controller)
        springs = tuple(
            dataclasses.replace(s, stiffness=s.stiffness * factor, turning=s.turning * factor)
            if s.name == self.spring
            else s
            for s in machine.springs
        )
        return dataclasses.replace(machine, springs=springs), controller


class DriveFactor(_Factor):
    """Stiffness of a screw, relative to the catalogue."""

    axis: str = eqx.field(static=True)

    @property
    def name(self) -> str:
        return f"stiffness of drive {self.axis}"

    def check(self, machine):
        screws = [drive.axis for drive in machine.drives if drive.stiffness is not None]
        _known(self, self.axis, screws, "drives with a screw")

    def apply(self, machine, controller, z):
        drives = tuple(
            dataclasses.replace(d, stiffness=d.stiffness * self.value(z, controller))
            if d.axis == self.axis and d.stiffness is not None
            else d
            for d in machine.drives
        )
        return dataclasses.replace(machine, drives=drives), controller


class DampingFactor(_Factor):
    """Damping of all springs and screws, structural and viscous, relative to the catalogue."""

    @property
    def name(self) -> str:
        return "damping"

    def apply(self, machine, controller, z):
        factor = self.value(z, controller)
        springs = tuple(
            dataclasses.replace(spring, damping=factor * spring.damping)
            for spring in machine.springs
        )
        machine = dataclasses.replace(machine, springs=springs, loss=factor * machine.loss)
        return machine, controller


class CentreShift(Unknown):
    """Position of a body's centre of gravity relative to the drawing, along one axis."""

    body: str = eqx.field(static=True)
    along: str = eqx.field(static=True)
    sigma_mm: float = eqx.field(static=True, default=20.0)

    @property
    def name(self) -> str:
        return f"centre of gravity of {self.body} along {self.along}"

    @property
    def unit(self) -> str:
        return "mm"

    def value(self, z, controller):
        del controller
        return self.sigma_mm * z

    def check(self, machine):
        _known(self, self.body, [body.name for body in machine.bodies], "bodies")
        _known(self, self.along, list("XYZ"), "directions")

    def apply(self, machine, controller, z):
        shift = 1e-3 * self.value(z, controller) * jnp.eye(3)["XYZ".index(self.along)]
        bodies = tuple(
            dataclasses.replace(b, centre=b.centre + shift) if b.name == self.body else b
            for b in machine.bodies
        )
        return dataclasses.replace(machine, bodies=bodies), controller


class Delay(Unknown):
    """Delay of the controllers from a sample to its force, relative to the declared one.

    Where the declared delay is at a bound, zero or two samples, a value of zero is a hundredth of a
    sample inside it.
    """

    sigma_ms: float = eqx.field(static=True, default=0.5)

    @property
    def name(self) -> str:
        return "controller delay"

    @property
    def unit(self) -> str:
        return "ms"

    def value(self, z, controller):
        return 1e3 * (self._applied(controller, z) - controller.delay)

    def apply(self, machine, controller, z):
        return machine, dataclasses.replace(controller, delay=self._applied(controller, z))

    def _applied(self, controller: Controller, z: Scalar) -> Scalar:
        later = controller.delay + 1e-3 * self.sigma_ms * z
        # No force acts before its sample, and the latest is the last stored one. The bounds are
        # smooth, as a search would get stuck at their corners.
        T, latest = controller.sample_time, 1.999 * controller.sample_time
        soft = _ROUNDED * T
        later = soft * jax.nn.softplus(later / soft)
        return latest - soft * jax.nn.softplus((latest - later) / soft)


def _known(unknown: Unknown, name: str, known: Sequence[str], what: str) -> None:
    if name not in known:
        raise ValueError(
            f"unknown {unknown.name!r}: found {name!r}{nearest(name, known)}, expected one of the "
            f"machine's {what}, {', '.join(dict.fromkeys(known)) or 'of which it has none'}; "
            "correct the name"
        )


def applied(
    unknowns: Sequence[Unknown], machine: Machine, controller: Controller, z: Float[Array, " k"]
) -> tuple[Machine, Controller]:
    """Machine and controller with the values of all unknowns at z."""
    for i, unknown in enumerate(unknowns):
        machine, controller = unknown.apply(machine, controller, z[i])
    return machine, controller
