"""Effects of a laser frame: its measuring head, its frame, the beam, the diode."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response, Setup
from .registry import register
from .thermal import REFERENCE_DEGC

_HEAD = "T_head"


def _excess(plan: Plan) -> Array:
    return plan.covariate(_HEAD) - REFERENCE_DEGC


@register
class HeadExpansion(Effect):
    """The measuring head grows away from the spindle, against tool Z: k (T_head - 20 degC).

    k = length times expansion coefficient: 0.193 m of invar at 1.7 um/(m K) make 0.33 um/K, of
    steel 2.2 um/K.
    """

    name = "head_expansion"
    summary = "thermal growth of the measuring head"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("k", "um/K", sigma=2.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (_HEAD,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {("head.Z", "k"): -_excess(plan)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "head.Z" in setup.layout:
            yield cls()


@register
class FrameExpansion(Effect):
    """The frame grows by k (T_head - 20 degC) from end to end in one direction: at a place x by
    (k s + shift) (T_head - 20 degC), s = (x - middle) / length.

    It is held in the middle of the travel; or, with `shift`, it is not known where: at the low end
    shift = k / 2, at the high end -k / 2, and what carries the frame may grow too. The temperature
    in the head stands for that of the frame. The beams move with the frame, so that it shows in the
    direction across them, by their place between the ends of the travel.
    """

    name = "frame_expansion"
    summary = "thermal growth of the frame that carries the beams"
    where = "instrument"
    low: float
    high: float
    held: bool = eqx.field(static=True, default=True)
    """Whether it is held in the middle."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        growth = Parameter("k", "um/K", sigma=1.0)
        return (growth,) if self.held else (growth, Parameter("shift", "um/K", sigma=0.5))

    @property
    def needs(self) -> tuple[str, ...]:
        return (_HEAD, self.placement)

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
    """A frame of one material grows alike in all directions, from wherever it is held: at a place x
    by (alpha (x - middle) + shift) (T_head - 20 degC) in each direction.

    The temperature in the head stands for that of the frame, and each direction shows across the
    beams, as with `frame_expansion`.
    """

    name = "frame_growth"
    summary = "thermal growth of the frame alike in all directions"
    where = "instrument"
    middles: tuple[tuple[str, float], ...] = eqx.field(static=True)
    """Of the travel of every axis, m."""

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
    """The axes that move on a laser frame, and from where to where."""
    if "head.Z" not in setup.layout:
        return []
    ends = [(axis, np.asarray(setup.plan.x(axis))) for axis in setup.chain.axes]
    return [(axis, float(x.min()), float(x.max())) for axis, x in ends if x.max() > x.min()]


@register
class Refraction(Effect):
    """A beam bent by a temperature gradient of the air: -1/2 c (dT/dz) s^2 along z.

    s is the length of the beam from its source and c = -dn/dT, about 0.95e-6 / K for air at
    20 degC; 0.7 K/m bend it by s^2/3 (um, m; Jatzkowski 2011). It bends towards the denser, colder
    air: down where it is warmer above, so that the tool seems to be higher. A beam parallel to the
    gradient is not bent.
    """

    name = "refraction"
    summary = "beam bent by a temperature gradient of the air"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("c", "um/(m K)", sigma=1.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return ("T_gradient_z_K_per_m", "path_mm")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        s = plan.covariate("path_mm") * 1e-3
        return {("frame.Z", "c"): -0.5 * plan.covariate("T_gradient_z_K_per_m") * s**2}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "head.Z" in setup.layout:
            yield cls()


@register
class PsdLinearity(Effect):
    """A diode that is not linear: a x + b x^3 in one reading, x its place on the diode.

    The reference position is taken to be the middle of the diode, where the error is zero.
    """

    name = "psd_linearity"
    summary = "linear and cubic error of the position-sensitive diode"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("a", "um/mm", sigma=1.0), Parameter("b", "um/mm3", sigma=1.0))

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"psd_{self.placement}_mm",)

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
            # Without the column it is to be told what it wants; a map that is zero has no place.
            if not setup.plan.has(column) or np.any(np.asarray(setup.plan.covariate(column))):
                yield cls(placement=name)


@register
class HeadTemperature(Effect):
    """The head's growth is corrected with a temperature that is wrong: k dT, against tool Z."""

    name = "head_temperature"
    summary = "wrong temperature behind the correction of the head's growth"
    where = "instrument"
    growth: float = eqx.field(default=0.193 * 1.7)
    """Growth that is corrected, um/K."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sensor", "K", sigma=0.15), Parameter("chain", "K", sigma=0.06))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        grown = np.full(plan.rows, -self.growth * 1e-6)
        return {("head.Z", "sensor"): grown, ("head.Z", "chain"): grown}


@register
class ToolInterface(Effect):
    """The head was changed after the reference run: it sits a little elsewhere in the spindle."""

    name = "tool_interface"
    summary = "repeatability of the tool interface after a tool change"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(c, "um", sigma=0.1) for c in "XYZ")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(f"head.{c}", c): np.ones(plan.rows) for c in "XYZ"}


@register
class FilterRefraction(Effect):
    """Shift of the beam in the filter that the rotation of the head leaves uncertain, drawn afresh
    for every reading.
    """

    name = "filter_refraction"
    summary = "shift of the beam in the diode's filter, fresh for every reading"
    kind = "random"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return _both(0.3)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return _fresh(plan)


@register
class PsdResolution(Effect):
    """Resolution of the averaged reading, drawn afresh for every reading."""

    name = "psd_resolution"
    summary = "resolution of the diode, fresh for every reading"
    kind = "random"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return _both(0.06)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return _fresh(plan)


def _both(sigma: float) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, "um", sigma=sigma) for name in "uv")


def _fresh(plan: Plan) -> Response:
    return {(f"read.{name}", name): np.ones(plan.rows) for name in "uv"}
