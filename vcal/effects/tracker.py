"""Effects of a laser tracker: range, encoders, axes, station."""

from collections.abc import Iterable, Mapping

import equinox as eqx

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, unit_of
from .clock import Clock, SinceStart, started
from .forms import AtInstrument, OneAmplitude, Wave, sine_and_cosine
from .registry import register
from .thermal import TIME_ODDS


@register
class RangeScale(AtInstrument):
    """Range offset and scale of a tracker: a + b r."""

    name = "range_scale"
    summary = "offset and scale error of the range"
    requires_port = "read.range"
    uses = ("range",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("offset", "um", sigma=10.0), Parameter("scale", "um/m", sigma=5.0))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        r = plan.covariate("range")
        return {("read.range", "offset"): namespace(r).ones_like(r), ("read.range", "scale"): r}


@register
class EncoderEccentricity(Wave):
    """Eccentric angle encoder: e sin(angle + phase) added to the azimuth or the elevation."""

    name = "encoder_eccentricity"
    summary = "once-per-turn error of an angle encoder of the tracker"
    where = "instrument"
    waves = sine_and_cosine("urad", 10.0)
    angle: str = eqx.field(static=True)

    @property
    def port(self) -> str:  # type: ignore[override]
        return f"read.{self.angle}"

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.angle,)

    def phase(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return plan.covariate(self.angle)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for angle in ("azimuth", "elevation"):
            if f"read.{angle}" in setup.layout:
                yield cls(angle=angle, placement=angle)


@register
class TrackerAxes(AtInstrument):
    """Axes of a tracker that are not square: i tan(el) + c / cos(el) added to the azimuth.

    i is the tilt of the transit axis against the standing axis, c the collimation error of the
    beam against the transit axis (ASME B89.4.19; VDI/VDE 2617-10). The constant part of the error
    is a rotation of the station about its standing axis.
    """

    name = "tracker_axes"
    summary = "tilt of the transit axis and collimation error of a tracker"
    requires_port = "read.azimuth"
    uses = ("elevation",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("tilt", "urad", sigma=10.0), Parameter("collimation", "urad", sigma=10.0))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elevation = plan.covariate("elevation")
        xp = namespace(elevation)
        return {
            ("read.azimuth", "tilt"): xp.tan(elevation),
            ("read.azimuth", "collimation"): 1.0 / xp.cos(elevation),
        }


def _rate(c: str, by: Clock) -> Parameter:
    """The rate at which one component of the instrument's frame drifts."""
    return Parameter(f"rate_{c}", f"{unit_of(f'frame.{c}')}/{by.long}", sigma=by.usual)


@register
class StationDrift(SinceStart):
    """The instrument's frame drifts in proportion to time: three translations X, Y, Z along the
    axes of the machine, and three rotations A, B, C about the frame's own axes, which
    `euler_xyz_deg` turns.
    """

    name = "station_drift"
    summary = "drift of the instrument's frame with time"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(_rate(c, self.clock) for c in COMPONENTS)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elapsed = self.elapsed(plan)
        return {(f"frame.{c}", f"rate_{c}"): elapsed for c in COMPONENTS}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "frame.X" in setup.layout:
            yield cls(**started(setup))


@register
class StationSettling(SinceStart, OneAmplitude):
    """The instrument's frame drifts along, or about, one axis in proportion to time: a stand that
    settles, or tilts.

    Along an axis, it has the same effect on all readings as a `drift` of the machine in the
    opposite direction: the readings cannot separate the two.
    """

    name = "station_settling"
    summary = "the instrument's stand gives way in one direction"
    where = "instrument"
    odds = 0.3 * TIME_ODDS
    """So that no placement of it is likelier than a `drift` with the same effect."""

    @property
    def port(self) -> str:  # type: ignore[override]
        return f"frame.{self.placement}"

    @property
    def size(self) -> Parameter:
        return _rate(self.placement, self.clock)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return self.elapsed(plan)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "frame.X" in setup.layout:
            for c in COMPONENTS:
                yield cls(placement=c, **started(setup))
