"""Forms that many effects share. An effect of one of them is a declaration: name, ports, parameter,
covariates, and the formula.
"""

import abc
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, along


@dataclass(frozen=True)
class JointPorts:
    """The error motions of joints on which an effect may act, ISO 230-1."""

    components: str = "XYZABC"
    """Translations X, Y, Z along and rotations A, B, C about the axes of the joint's frame."""
    own: bool | None = None
    """Only the motion of the joint itself (True), all but this one (False), or all of them."""
    linear: bool = False
    """Only linear axes."""

    def of(self, chain: Chain) -> Iterator[tuple[str, str]]:
        """Ports with the joint of each, in the order of the chain: ``("EYX", "X")``."""
        for joint in chain.joints:
            if self.linear and joint.kind != "prismatic":
                continue
            itself, _ = along(chain, joint.name)
            for port in (f"E{c}{joint.name}" for c in self.components):
                if self.own is None or self.own == (port == itself):
                    yield port, joint.name


class OneAmplitude(Effect):
    """Base class of effects with one amplitude on one port: deviation = amplitude * factor.

    A subclass declares its `amplitude`, the covariates that it `uses`, and the factor. One that
    acts on an error motion of a joint is a `JointAmplitude`; any other one declares its `port`, and
    its `candidates` where there are some.
    """

    amplitude: ClassVar[Parameter]
    """The amplitude; in its name ``{port}`` stands for the port."""
    port: ClassVar[str]
    """The port on which it acts; a field or a property where instances differ in it."""

    @abc.abstractmethod
    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        """Deviation of the port per SI unit of the amplitude, in every row (n,)."""

    @property
    def size(self) -> Parameter:
        """The amplitude of this instance."""
        port = self.port.replace(".", "_")
        return replace(self.amplitude, name=self.amplitude.name.format(port=port))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, self.size.name): self.factor(plan, shape)}


class JointAmplitude(OneAmplitude):
    """Base class of effects with one amplitude on one error motion of one joint.

    A subclass declares `acts_on` in addition to the attributes of `OneAmplitude`. There is one
    candidate for every error motion in it.
    """

    acts_on: ClassVar[JointPorts] = JointPorts()
    port: str = eqx.field(static=True)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for port, axis in cls.acts_on.of(setup.chain):
            yield cls(port=port, placement=axis)


class AtInstrument(Effect):
    """Base class of effects that every instrument with a certain port may have, once."""

    where = "instrument"
    requires_port: ClassVar[str]
    """A port of such an instrument."""

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if cls.requires_port in setup.layout:
            yield cls()


class Tones(NamedTuple):
    """A scan of waves whose phase is 2 pi f x, with f = first + k step, k < count."""

    x: np.ndarray
    """Coordinate (n,) of every row."""
    first: float
    """A whole multiple of `step`."""
    step: float
    count: int


class Wave(Effect):
    """Base class of periodic effects on one port: a sin(phase) + b cos(phase)."""

    uses = ("{axis}",)
    port: ClassVar[str]
    """The port on which it acts; a field or a property where instances differ in it."""

    waves: ClassVar[tuple[Parameter, Parameter]]
    """Amplitudes of the sine and of the cosine (`sine_and_cosine`). It has no others."""

    @abc.abstractmethod
    def phase(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        """Phase in every row, rad."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.waves

    def tones(self, plan: Plan) -> Tones | None:
        """The scan as equally spaced frequencies; None where it is something else."""
        return None

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phase = self.phase(plan, shape)
        sine, cosine = (wave.name for wave in self.waves)
        xp = namespace(phase)
        return {(self.port, sine): xp.sin(phase), (self.port, cosine): xp.cos(phase)}


def sine_and_cosine(unit: str, sigma: float, order: int | str = "") -> tuple[Parameter, Parameter]:
    """Amplitudes of a `Wave`, of one prior standard deviation."""
    sine, cosine = (Parameter(f"{wave}{order}", unit, sigma=sigma) for wave in ("sine", "cosine"))
    return sine, cosine


class Constants(Effect):
    """Base class of effects that displace every port of a group by a constant of its own.

    With ``kind = "random"``, they are drawn independently for every reading.
    """

    group: ClassVar[str]
    """Group of the ports: ``"tool"`` of ``"tool.X"``."""
    components: ClassVar[str] = "XYZ"
    """Components of the group, which are the names of the amplitudes too."""
    sigma: ClassVar[float]
    """Prior standard deviation of every amplitude, um."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(c, "um", sigma=self.sigma) for c in self.components)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = np.ones(plan.rows)
        return {(f"{self.group}.{c}", c): one for c in self.components}
