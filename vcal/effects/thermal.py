"""Effects of temperature: growth of scales, thermal offsets and tilts, warming up."""

from collections.abc import Iterable, Iterator, Mapping

import equinox as eqx
import numpy as np

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Reference, Response, Setup, unit_of
from .clock import SinceStart, started
from .forms import JointAmplitude, JointPorts, OneAmplitude
from .registry import register

SECONDARY_ODDS = 0.2
"""Prior odds of effects that seldom occur alone: their cause shows in another effect first."""
TIME_ODDS = 0.2
"""Prior odds of effects of time alone: time is not a cause, it stands for causes that were not
recorded. Where a recorded temperature explains a residual as well as time does, it is preferred."""

REFERENCE_DEGC = 20.0
"""ISO 1: the reference temperature for length."""


class _Thermal(JointAmplitude):
    """Base class of errors in proportion to the temperature of an axis: k (T_axis - 20 degC)."""

    uses = ("T_{axis}",)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return plan.covariate(f"T_{self.placement}") - REFERENCE_DEGC


class _ThermalSlope(_Thermal):
    """Base class of those that grow with the position of the axis too: k (T_axis - 20 degC) x."""

    uses = ("T_{axis}", "{axis}")

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return super().factor(plan, shape) * plan.x(self.placement)


@register
class ScaleGrowth(_ThermalSlope):
    """A scale that expands: alpha (T_axis - 20 degC) x along the axis, in the joint's frame.

    alpha is positive for a scale that expands on an axis that carries the tool. An axis that
    carries the workpiece moves against its command, and so does the error of its scale: alpha is
    then minus the expansion coefficient.
    """

    name = "scale_growth"
    summary = "thermal expansion of an axis's scale or screw"
    remedy = (
        "Check the coefficient of expansion in the control and the temperature sensor of the "
        "axis; compensate by temperature, or cool the screw."
    )
    acts_on = JointPorts(own=True, linear=True)
    amplitude = Parameter("alpha", "um/(m K)", sigma=10.0)


@register
class ThermalOffset(_Thermal):
    """A structure that grows: k (T_axis - 20 degC) as one translation of the joint's frame."""

    name = "thermal_offset"
    summary = "translation of a joint with its temperature"
    remedy = (
        "Look for the heat source near the axis; compensate by its temperature, or warm the "
        "machine up before work."
    )
    acts_on = JointPorts("XYZ")
    amplitude = Parameter("k_{port}", "um/K", sigma=10.0)


@register
class ThermalTilt(_Thermal):
    """A structure that bends: k (T_axis - 20 degC) as one rotation of the joint's frame."""

    name = "thermal_tilt"
    summary = "rotation of a joint with its temperature (column bending)"
    remedy = (
        "Look for heat on one side of the structure (motor, hydraulics, sun); compensate by "
        "temperature, or warm the machine up before work."
    )
    acts_on = JointPorts("ABC")
    amplitude = Parameter("k_{port}", "urad/K", sigma=50.0)


@register
class SquarenessTemperature(_ThermalSlope):
    """An axis that turns away from its direction: k (T_axis - 20 degC) x across the axis.

    A slope of a straightness that grows with the temperature: the axis's squareness to the others.
    Many plans cannot separate it from `thermal_tilt`, which has the higher prior odds: a guideway
    that turns also turns what it carries.
    """

    name = "squareness_temperature"
    summary = "squareness of an axis that changes with its temperature"
    remedy = (
        "Look for heat on one side of the structure; compensate by temperature, or keep the "
        "shop's temperature constant."
    )
    odds = SECONDARY_ODDS
    acts_on = JointPorts("XYZ", own=False, linear=True)
    amplitude = Parameter("k_{port}", "urad/K", sigma=20.0)


def _warming(chain: Chain) -> Iterator[tuple[str, str]]:
    """Ports at which a machine may change with time, and their placement: the error motions of
    every axis; for a spindle in a head that turns, also its displacements, which turn with it.
    """
    yield from JointPorts().of(chain)
    if any(chain.joints[i].kind == "rotary" for i in chain.tool_side):
        for c in "XYZ":
            yield f"tool.{c}", "tool"


class _InTime(SinceStart, OneAmplitude):
    """Base class of changes of a machine with time."""

    odds = TIME_ODDS
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    """``"um"`` or ``"urad"``."""

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        time = started(setup)
        for port, placement in _warming(setup.chain):
            yield cls(port=port, unit=unit_of(port), placement=placement, **time)

    def _named(self, name: str) -> str:
        return f"{name}_{self.port.replace('.', '_')}"


@register
class WarmUp(_InTime):
    """An axis, or the spindle in a head, that warms up: A (1 - exp(-t / tau)) on one of its error
    motions, t from `start`; zero before. Where the poses of an arm have numbers and no time, t is
    the number of the pose, and tau a number of poses.

    tau is scanned in equal steps of its logarithm, from a twentieth of the duration of the
    measurement to all of it: a slower approach cannot be separated from a drift.
    """

    name = "warm_up"
    summary = "exponential approach to a steady state"
    remedy = (
        "Warm the machine up before work for three time constants; record temperatures, so that "
        "the growth can be compensated by them."
    )

    @property
    def size(self) -> Parameter:
        return Parameter(self._named("size"), self.unit, sigma=20.0)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size, Parameter("tau", self.clock.long, shape=True, coordinate="log"))

    @property
    def reference(self) -> Reference:
        """The machine may have been warm already at the first reading."""
        return Reference(self.clock.name, "1", 1.0)

    def constant_part(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, self.size.name): np.ones(plan.rows)}

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        since = self.elapsed(plan)
        # Check points may be older than the data: before the start the effect is zero.
        elapsed = namespace(since).maximum(since, 0.0) / shape["tau"]
        return 1.0 - namespace(elapsed).exp(-elapsed)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        span = float(np.ptp(np.asarray(self.clock.read(plan)))) or 1.0
        return {"tau": np.geomspace(span / 20.0, span, 14)}


@register
class Drift(_InTime):
    """A joint, or the spindle in a head, that drifts in proportion to time: A t on one of its error
    motions, t from `start`. Where the poses of an arm have numbers and no time, t is the number of
    the pose.
    """

    name = "drift"
    summary = "linear drift of a joint with time"
    remedy = (
        "Wait until the machine and the shop have settled; record temperatures, so that the drift "
        "can be compensated by them."
    )

    @property
    def size(self) -> Parameter:
        unit = f"{self.unit}/{self.clock.long}"
        return Parameter(self._named("rate"), unit, sigma=self.clock.usual)

    @property
    def reference(self) -> Reference:
        """The machine may have drifted before the first reading."""
        return Reference(self.clock.name, self.clock.long, self.clock.before)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return self.elapsed(plan)
