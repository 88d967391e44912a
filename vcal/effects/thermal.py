"""Effects of temperature: growth of scales, thermal offsets and tilts, warming up."""

from collections.abc import Iterable, Iterator, Mapping

import equinox as eqx
import numpy as np

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, across, along
from .clock import TIME, Clock, beginning, clock
from .registry import register

SECONDARY_ODDS = 0.2
"""Prior odds of effects that hardly come alone: what causes them shows in another way first."""
TIME_ODDS = 0.2
"""Prior odds of effects of time alone: time causes nothing, it stands for causes that were not
recorded. Where a recorded temperature explains a residual as well as time does, it is preferred."""

REFERENCE_DEGC = 20.0
"""ISO 1: the reference temperature for length."""


def _excess(plan: Plan, axis: str) -> Array:
    return plan.covariate(f"T_{axis}") - REFERENCE_DEGC


@register
class ScaleGrowth(Effect):
    """A scale that expands: alpha (T_axis - 20 degC) x along the axis, in the joint's frame.

    alpha is positive for a scale that expands on an axis that carries the tool. An axis that
    carries the workpiece moves against its command, and so does what its scale is wrong by: alpha
    is then minus the expansion.
    """

    name = "scale_growth"
    summary = "thermal expansion of an axis's scale or screw"
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("alpha", "um/(m K)", sigma=10.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"T_{self.placement}", self.placement)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        growth = _excess(plan, self.placement) * plan.x(self.placement)
        return {(self.port, "alpha"): growth}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind == "prismatic":
                port, _ = along(setup.chain, joint.name)
                yield cls(port=port, placement=joint.name)


@register
class ThermalOffset(Effect):
    """A structure that grows: k (T_axis - 20 degC) as one translation of the joint's frame."""

    name = "thermal_offset"
    summary = "translation of a joint with its temperature"
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"k_{self.port}", "um/K", sigma=10.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"T_{self.placement}",)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, f"k_{self.port}"): _excess(plan, self.placement)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            for c in "XYZ":
                yield cls(port=f"E{c}{axis}", placement=axis)


@register
class ThermalTilt(Effect):
    """A structure that bends: k (T_axis - 20 degC) as one rotation of the joint's frame."""

    name = "thermal_tilt"
    summary = "rotation of a joint with its temperature (column bending)"
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"k_{self.port}", "urad/K", sigma=50.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"T_{self.placement}",)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, f"k_{self.port}"): _excess(plan, self.placement)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            for c in "ABC":
                yield cls(port=f"E{c}{axis}", placement=axis)


@register
class SquarenessTemperature(Effect):
    """An axis that turns away from its direction: k (T_axis - 20 degC) x across the axis.

    A slope of a straightness that grows with the temperature: the axis's squareness to the others.
    Many plans do not tell it from `thermal_tilt`, which has the better prior odds: a guideway that
    turns, turns what it carries as well.
    """

    name = "squareness_temperature"
    summary = "squareness of an axis that changes with its temperature"
    odds = SECONDARY_ODDS
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"k_{self.port}", "urad/K", sigma=20.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"T_{self.placement}", self.placement)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        turned = _excess(plan, self.placement) * plan.x(self.placement)
        return {(self.port, f"k_{self.port}"): turned}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind == "prismatic":
                for port in across(setup.chain, joint.name):
                    yield cls(port=port, placement=joint.name)


def _warming(chain: Chain) -> Iterator[tuple[str, str, str]]:
    """Ports where a machine may change with time, their unit and place: the error motions of every
    axis; of a spindle in a head that turns its displacements as well, which turn with it.
    """
    for axis in chain.axes:
        for c in "XYZABC":
            yield f"E{c}{axis}", "um" if c in "XYZ" else "urad", axis
    if any(chain.joints[i].kind == "rotary" for i in chain.tool_side):
        for c in "XYZ":
            yield f"tool.{c}", "um", "tool"


def _plain(port: str) -> str:
    return port.replace(".", "_")


@register
class WarmUp(Effect):
    """An axis, or the spindle in a head, that warms up: A (1 - exp(-t / tau)) on one of its error
    motions, t from `start`; nothing before. Where an arm's poses have numbers and no time, t is the
    number of the pose, and tau so many poses.

    tau is scanned in equal steps of its logarithm, from a twentieth of the run to the run: what
    takes longer is a drift in all it shows.
    """

    name = "warm_up"
    summary = "exponential approach to a steady state"
    odds = TIME_ODDS
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    start: float = 0.0
    """Time of the first reading, SI."""
    clock: Clock = eqx.field(static=True, default=TIME)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter(f"size_{_plain(self.port)}", self.unit, sigma=20.0),
            Parameter("tau", self.clock.long, shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.clock.name,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        since = self.clock.read(plan) - self.start
        # Check points may be older than the data: what had not begun is nothing, and not exp(t).
        elapsed = namespace(since).maximum(since, 0.0) / shape["tau"]
        return {(self.port, f"size_{_plain(self.port)}"): 1.0 - namespace(elapsed).exp(-elapsed)}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        span = float(np.ptp(np.asarray(self.clock.read(plan)))) or 1.0
        return {"tau": np.geomspace(span / 20.0, span, 14)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        by, start = clock(setup), beginning(setup)
        for port, unit, placement in _warming(setup.chain):
            yield cls(port=port, unit=unit, start=start, clock=by, placement=placement)


@register
class Drift(Effect):
    """A joint, or the spindle in a head, that drifts in proportion to time: A t on one of its error
    motions, t from `start`. Where an arm's poses have numbers and no time, t is the number of the
    pose.
    """

    name = "drift"
    summary = "linear drift of a joint with time"
    odds = TIME_ODDS
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    start: float = 0.0
    """Time of the first reading, SI."""
    clock: Clock = eqx.field(static=True, default=TIME)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        unit = f"{self.unit}/{self.clock.long}"
        return (Parameter(f"rate_{_plain(self.port)}", unit, sigma=self.clock.usual),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.clock.name,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elapsed = self.clock.read(plan) - self.start
        return {(self.port, f"rate_{_plain(self.port)}"): elapsed}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        by, start = clock(setup), beginning(setup)
        for port, unit, placement in _warming(setup.chain):
            yield cls(port=port, unit=unit, start=start, clock=by, placement=placement)
