"""Effects of a laser tracker: range, encoders, axes, station."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, unit_of
from .clock import Clock, SinceStart, started
from .forms import AtInstrument, OneAmplitude, Wave, sine_and_cosine
from .registry import register
from .station import at_station, stations_of
from .thermal import TIME_ODDS


@register
class RangeScale(AtInstrument):
    """Range offset and scale of a tracker: a + b r."""

    name = "range_scale"
    summary = "offset and scale error of the range"
    remedy = (
        "Check the meteorological correction of the instrument and the constant of the reflector; "
        "the machine is not affected."
    )
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
    remedy = (
        "Have the angle encoders of the tracker checked, and use its two-face test; the machine "
        "is not affected."
    )
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
    remedy = (
        "Use the two-face test of the tracker and its compensation; the machine is not affected."
    )
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


def _components(setup: Setup) -> str:
    """Components of the instrument's frame that its readings depend on; empty without a frame."""
    return "".join(c for c in COMPONENTS if f"frame.{c}" in setup.layout)


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
    remedy = (
        "Let the stand settle, fasten it to the floor, and observe reference points again at the "
        "end; the machine is not affected."
    )
    where = "instrument"
    components: str = eqx.field(static=True, default="XYZABC")
    """The components that the readings depend on: ``"XYZ"`` for ranges alone."""
    station: int = eqx.field(static=True, default=-1)
    """Index of the station that drifts; -1 where there is only one."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(_rate(c, self.clock) for c in self.components)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        elapsed = self.elapsed(plan) * at_station(plan, self.station)
        return {(f"frame.{c}", f"rate_{c}"): elapsed for c in self.components}

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return at_station(plan, self.station) > 0.0

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        components = _components(setup)
        for number, name in stations_of(setup) if components else ():
            yield cls(components=components, station=number, placement=name, **started(setup))


@register
class StationSettling(SinceStart, OneAmplitude):
    """The instrument's frame drifts along, or about, one axis in proportion to time: a stand that
    settles, or tilts.

    Along an axis, it has the same effect on all readings as a `drift` of the machine in the
    opposite direction: the readings cannot separate the two.
    """

    name = "station_settling"
    summary = "the instrument's stand gives way in one direction"
    remedy = (
        "Fasten the stand to the floor, and let it settle before the measurement; the machine is "
        "not affected."
    )
    where = "instrument"
    odds = 0.3 * TIME_ODDS
    """So that no placement of it is likelier than a `drift` with the same effect."""
    station: int = eqx.field(static=True, default=-1)
    """Index of the station that gives way; -1 where there is only one."""

    @property
    def _component(self) -> str:
        return self.placement[-1]

    @property
    def port(self) -> str:  # type: ignore[override]
        return f"frame.{self._component}"

    @property
    def size(self) -> Parameter:
        return _rate(self._component, self.clock)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return self.elapsed(plan) * at_station(plan, self.station)

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return at_station(plan, self.station) > 0.0

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for number, name in stations_of(setup):
            for c in _components(setup):
                place = f"{name} {c}".strip()
                yield cls(placement=place, station=number, **started(setup))
