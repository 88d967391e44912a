"""Effects of a laser tracker: its range, its encoders, its station."""

from collections.abc import Iterable, Mapping

import equinox as eqx

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .clock import TIME, Clock, beginning, clock
from .registry import register
from .thermal import TIME_ODDS


@register
class RangeScale(Effect):
    """Range offset and scale of a tracker: a + b r."""

    name = "range_scale"
    summary = "offset and scale error of the range"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("offset", "um", sigma=10.0), Parameter("scale", "um/m", sigma=5.0))

    @property
    def needs(self) -> tuple[str, ...]:
        return ("range",)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        r = plan.covariate("range")
        return {("read.range", "offset"): namespace(r).ones_like(r), ("read.range", "scale"): r}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "read.range" in setup.layout:
            yield cls()


@register
class EncoderEccentricity(Effect):
    """Eccentric angle encoder: e sin(angle + phase) added to the azimuth or the elevation."""

    name = "encoder_eccentricity"
    summary = "once-per-turn error of an angle encoder of the tracker"
    where = "instrument"
    angle: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("sine", "urad", sigma=10.0), Parameter("cosine", "urad", sigma=10.0))

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.angle,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        angle = plan.covariate(self.angle)
        port = f"read.{self.angle}"
        xp = namespace(angle)
        return {(port, "sine"): xp.sin(angle), (port, "cosine"): xp.cos(angle)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for angle in ("azimuth", "elevation"):
            if f"read.{angle}" in setup.layout:
                yield cls(angle=angle, placement=angle)


@register
class TrackerAxes(Effect):
    """Axes of a tracker that are not square: i tan(el) + c / cos(el) added to the azimuth.

    i is the tilt of the transit axis against the standing axis, c the collimation error of the
    beam against the transit axis (ASME B89.4.19; VDI/VDE 2617-10). What of it is constant is the
    station's turn about its standing axis.
    """

    name = "tracker_axes"
    summary = "tilt of the transit axis and collimation error of a tracker"
    where = "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("tilt", "urad", sigma=10.0), Parameter("collimation", "urad", sigma=10.0))

    @property
    def needs(self) -> tuple[str, ...]:
        return ("elevation",)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elevation = plan.covariate("elevation")
        xp = namespace(elevation)
        return {
            ("read.azimuth", "tilt"): xp.tan(elevation),
            ("read.azimuth", "collimation"): 1.0 / xp.cos(elevation),
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "read.azimuth" in setup.layout:
            yield cls()


def _rate(c: str, by: Clock) -> Parameter:
    """The rate at which one component of the instrument's frame drifts."""
    unit = "um" if c in "XYZ" else "urad"
    return Parameter(f"rate_{c}", f"{unit}/{by.long}", sigma=by.usual)


@register
class StationDrift(Effect):
    """The instrument's frame drifts in proportion to time: three translations X, Y, Z along the
    axes of the machine, three rotations A, B, C about its own, which `euler_xyz_deg` turns.
    """

    name = "station_drift"
    summary = "drift of the instrument's frame with time"
    where = "instrument"
    start: float = 0.0
    """Time of the first reading, SI."""
    clock: Clock = eqx.field(static=True, default=TIME)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(_rate(c, self.clock) for c in COMPONENTS)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.clock.name,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elapsed = self.clock.read(plan) - self.start
        return {(f"frame.{c}", f"rate_{c}"): elapsed for c in COMPONENTS}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "frame.X" in setup.layout:
            yield cls(start=beginning(setup), clock=clock(setup))


@register
class StationSettling(Effect):
    """The instrument's frame drifts in one direction: along, or about, one axis with time.

    A stand that settles, or tilts. Along an axis it is the same to all readings as a `drift` of
    the machine the other way: which of the two it is they cannot tell.
    """

    name = "station_settling"
    summary = "the instrument's stand gives way in one direction"
    where = "instrument"
    odds = 0.3 * TIME_ODDS
    """So that no place of it is likelier than one of the `drift` that looks the same."""
    start: float = 0.0
    """Time of the first reading, SI."""
    clock: Clock = eqx.field(static=True, default=TIME)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (_rate(self.placement, self.clock),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.clock.name,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elapsed = self.clock.read(plan) - self.start
        return {(f"frame.{self.placement}", f"rate_{self.placement}"): elapsed}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if "frame.X" in setup.layout:
            for c in COMPONENTS:
                yield cls(start=beginning(setup), clock=clock(setup), placement=c)
