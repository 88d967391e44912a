"""Effects of a laser frame: measuring head, frame, beam, diode."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response, Setup
from .forms import AtInstrument, Constants, OneAmplitude
from .registry import register
from .thermal import REFERENCE_DEGC

_HEAD = "T_head"


def _excess(plan: Plan) -> Array:
    return plan.covariate(_HEAD) - REFERENCE_DEGC


@register
class HeadExpansion(AtInstrument, OneAmplitude):
    """The measuring head grows away from the spindle, along -Z of the tool: k (T_head - 20 degC).

    k is the length times the expansion coefficient: 0.33 um/K for 0.193 m of invar at 1.7 um/(m K),
    2.2 um/K for steel.
    """

    name = "head_expansion"
    summary = "thermal growth of the measuring head"
    remedy = (
        "Let the measuring head reach its temperature, and correct its growth; the machine is not "
        "affected."
    )
    requires_port = "head.Z"
    port = "head.Z"
    amplitude = Parameter("k", "um/K", sigma=2.0)
    uses = (_HEAD,)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return -_excess(plan)


@register
class FrameExpansion(Effect):
    """The frame grows by k (T_head - 20 degC) from end to end in one direction; the displacement at
    a position x is (k s + shift) (T_head - 20 degC), s = (x - middle) / length.

    The frame is held in the middle of the travel, or, with `shift`, at an unknown place: shift =
    k / 2 if it is held at the low end, -k / 2 at the high end; the structure that carries the frame
    may grow too. The temperature in the head stands for that of the frame. The beams move with the
    frame, so the growth shows in the direction across them, in proportion to their position between
    the ends of the travel.
    """

    name = "frame_expansion"
    summary = "thermal growth of the frame that carries the beams"
    remedy = (
        "Shield the frame from draught and sun, and correct its growth by its temperature; the "
        "machine is not affected."
    )
    where = "instrument"
    uses = (_HEAD, "{axis}")
    low: float
    high: float
    held: bool = eqx.field(static=True, default=True)
    """Whether it is held in the middle."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        growth = Parameter("k", "um/K", sigma=1.0)
        return (growth,) if self.held else (growth, Parameter("shift", "um/K", sigma=0.5))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        share = (plan.x(self.placement) - 0.5 * (self.low + self.high)) / (self.high - self.low)
        port, warm = f"frame.{self.placement}", _excess(plan)
        moved: Response = {(port, "k"): warm * share}
        return moved if self.held else {**moved, (port, "shift"): warm}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis, low, high in _spans(setup):
            yield cls(low=low, high=high, placement=axis)
            yield cls(low=low, high=high, held=False, placement=axis)


@register
class FrameGrowth(Effect):
    """A frame of one material grows alike in all directions from the point that holds it: at a
    position x by (alpha (x - middle) + shift) (T_head - 20 degC) in each direction.

    The temperature in the head stands for that of the frame, and the growth in each direction shows
    across the beams, as with `frame_expansion`.
    """

    name = "frame_growth"
    summary = "thermal growth of the frame alike in all directions"
    remedy = (
        "Shield the frame from draught and sun, and correct its growth by its temperature; the "
        "machine is not affected."
    )
    where = "instrument"
    middles: tuple[tuple[str, float], ...] = eqx.field(static=True)
    """Axis and the middle of its travel, m."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        shifts = (Parameter(f"shift_{axis}", "um/K", sigma=0.5) for axis, _ in self.middles)
        return (Parameter("alpha", "um/(m K)", sigma=2.0), *shifts)

    @property
    def needs(self) -> tuple[str, ...]:
        return (_HEAD, *(axis for axis, _ in self.middles))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        warm, moved = _excess(plan), {}
        for axis, middle in self.middles:
            moved[f"frame.{axis}", "alpha"] = warm * (plan.x(axis) - middle)
            moved[f"frame.{axis}", f"shift_{axis}"] = warm
        return moved

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        middles = tuple((axis, 0.5 * (low + high)) for axis, low, high in _spans(setup))
        if len(middles) > 1:
            yield cls(middles=middles)


def _spans(setup: Setup) -> list[tuple[str, float, float]]:
    """The axes that move on a laser frame, with the ends of their travel, m."""
    if "head.Z" not in setup.layout:
        return []
    ends = [(axis, np.asarray(setup.plan.x(axis))) for axis in setup.chain.axes]
    return [(axis, float(x.min()), float(x.max())) for axis, x in ends if x.max() > x.min()]


@register
class Refraction(AtInstrument, OneAmplitude):
    """A beam bent by a temperature gradient of the air: -1/2 c (dT/dz) s^2 along z.

    s is the length of the beam from its source and c = -dn/dT, about 0.95e-6 / K for air at
    20 degC; 0.7 K/m bend the beam by s^2/3 (um, m; Jatzkowski 2011). It bends towards the denser,
    colder air: downwards where the air above is warmer, so that the tool appears too high. A beam
    parallel to the gradient is not bent.
    """

    name = "refraction"
    summary = "beam bent by a temperature gradient of the air"
    remedy = (
        "Avoid temperature gradients along the beams: cover them, move the air, or measure at a "
        "quiet time; the machine is not affected."
    )
    requires_port = "head.Z"
    port = "frame.Z"
    amplitude = Parameter("c", "um/(m K)", sigma=1.0)
    uses = ("T_gradient_z_K_per_m", "path_mm")

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        s = plan.covariate("path_mm") * 1e-3
        return -0.5 * plan.covariate("T_gradient_z_K_per_m") * s**2


@register
class PsdLinearity(Effect):
    """A diode that is not linear: a x + b x^3 in one reading, x the position on the diode.

    The reference position is assumed to be the middle of the diode, where the error is zero.
    """

    name = "psd_linearity"
    summary = "linear and cubic error of the position-sensitive diode"
    remedy = "Calibrate the diode, or work near its centre; the machine is not affected."
    where = "instrument"
    uses = ("psd_{axis}_mm",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("a", "um/mm", sigma=1.0), Parameter("b", "um/mm3", sigma=1.0))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        # The column is in mm; the response is in metres per SI unit of a (m/m) and of b (m/m^3).
        x = plan.covariate(f"psd_{self.placement}_mm") * 1e-3
        port = f"read.{self.placement}"
        return {(port, "a"): x, (port, "b"): x**3}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for name in "uv":
            column = f"psd_{name}_mm"
            if "head.Z" not in setup.layout:
                continue
            # Without the column, the report says that it is needed; zeros have no effect.
            if not setup.plan.has(column) or np.any(np.asarray(setup.plan.covariate(column))):
                yield cls(placement=name)


@register
class HeadTemperature(Effect):
    """The head's growth is corrected with a wrong temperature: k dT along -Z of the tool."""

    name = "head_temperature"
    summary = "wrong temperature behind the correction of the head's growth"
    remedy = "Check the temperature sensor of the measuring head; the machine is not affected."
    where = "instrument"
    growth: float = eqx.field(default=0.193 * 1.7)
    """Corrected growth, um/K."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sensor", "K", sigma=0.15), Parameter("chain", "K", sigma=0.06))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        grown = np.full(plan.rows, -self.growth * 1e-6)
        return {("head.Z", "sensor"): grown, ("head.Z", "chain"): grown}


@register
class ToolInterface(Constants):
    """The head was changed after the reference run: its position in the spindle has changed."""

    name = "tool_interface"
    summary = "repeatability of the tool interface after a tool change"
    remedy = "Clean the tool interface, and check its clamping force."
    where = "instrument"
    group = "head"
    sigma = 0.1


class _PerReading(Constants):
    """Base class of independent random errors of both readings of the diode."""

    kind = "random"
    where = "instrument"
    group = "read"
    components = "uv"


@register
class FilterRefraction(_PerReading):
    """Shift of the beam in the filter that depends on the rotation of the head: unknown, and
    independent for every reading.
    """

    name = "filter_refraction"
    summary = "shift of the beam in the diode's filter, independent for every reading"
    remedy = "Align the filter of the diode, or replace it; the machine is not affected."
    sigma = 0.3


@register
class PsdResolution(_PerReading):
    """Resolution of the averaged reading, independent for every reading."""

    name = "psd_resolution"
    summary = "resolution of the diode, independent for every reading"
    remedy = "Average more readings; the machine is not affected."
    sigma = 0.06
