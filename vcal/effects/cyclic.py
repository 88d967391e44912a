"""Periodic effects: screws, gears."""

import math
from collections.abc import Iterable, Mapping
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, along
from .registry import register

_FINEST_SHARE, _PER_PERIOD = 0.01, 2.0
"""Where an axis stood so closely that finer pitches are seen: the finest one as a share of the
travel, and how many places every period needs."""
_TEETH = (
    *(36, 40, 45, 48, 50, 60, 72, 80, 90, 96, 100, 120, 128, 144, 150),
    *(160, 180, 200, 240, 256, 320, 360),
)
"""Teeth of usual worm wheels, cycles per turn of inductive scales, and ratios of strain wave gears
and twice these."""
_SLOWEST = 4.5
"""Periods per turn of the longest pitch of a rotary axis: slower ones are `gear_harmonic`."""


class _Pitches(NamedTuple):
    """Pitches that are looked for, of the linear axes or of the rotary ones; m or rad."""

    unit: str
    """At the edges."""
    shortest: float
    """The finest that is looked for wherever the axis stood."""
    finest: float
    """The finest of all, where it stood closely."""
    longest: float
    nominal: tuple[float, ...]
    """What is usual."""


_PITCHES = {
    # Nominal leads of ball screws, ISO 3408-2, and pole pitches of magnetic and inductive scales. A
    # plan of nearly equal steps s cannot tell a pitch p from its aliases 1/p +/- 1/s; that real
    # ones have these often can.
    "um": _Pitches(
        unit="mm",
        shortest=4e-3,
        finest=0.25e-3,
        longest=math.inf,
        nominal=(
            *(0.5e-3, 1e-3, 2e-3, 2.5e-3),
            *(4e-3, 5e-3, 6e-3, 8e-3, 10e-3, 12e-3, 16e-3, 20e-3, 25e-3, 32e-3, 40e-3),
        ),
    ),
    "urad": _Pitches(
        unit="deg",
        shortest=math.radians(1.0),
        finest=math.radians(0.1),
        longest=2.0 * math.pi / _SLOWEST,
        nominal=tuple(2.0 * math.pi / teeth for teeth in _TEETH),
    ),
}
"""By the unit of the error along the axis, or about it."""


SIGNAL_PERIODS_M = (2e-6, 4e-6, 10e-6, 20e-6, 40e-6, 100e-6, 200e-6)
"""Signal periods of linear encoders."""
_PERIODS = 500.0
"""Most periods that a plan may cover: an error of a scale of two parts in a thousand is one."""


@register
class ScrewCyclic(Effect):
    """Error of a screw within one turn: a sin(2 pi x/p) + b cos(2 pi x/p) along the axis; of a worm
    about a rotary axis, whose wheel has 360/p teeth.

    The pitch p is scanned in steps of 1/(4 L) in 1/p, L the travel really covered: wider steps
    lose the peak between two of them. It goes down to 4 mm, or 1 degree, and further where the axis
    stood at two places of every period or more. Pitches longer than a quarter of the travel belong
    to the geometry, where that is fitted; where it is not, up to the whole travel is looked for.
    Those of a rotary axis end where `gear_harmonic` begins.
    """

    name = "screw_cyclic"
    summary = "periodic error of a screw, a rack, a worm or a scale, pitch unknown"
    _usual: ClassVar[Mapping[str, float]] = {"prismatic": 3.0, "rotary": 15.0}
    """Size that is expected, um or urad, by the kinds of joints that may have it."""
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="um")
    """``"um"`` along a linear axis, ``"urad"`` about a rotary one."""
    usual: float = eqx.field(static=True, default=3.0, repr=False)
    """Size that is expected, in that unit."""
    periods: float = eqx.field(static=True, default=4.0, repr=False)
    """Of the longest pitch that is looked for, within the travel."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("sine", self.unit, sigma=self.usual),
            Parameter("cosine", self.unit, sigma=self.usual),
            Parameter("pitch", self._pitches.unit, shape=True, coordinate="reciprocal"),
        )

    @property
    def _pitches(self) -> _Pitches:
        return _PITCHES[self.unit]

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phase = 2.0 * np.pi * plan.x(self.placement) / shape["pitch"]
        xp = namespace(phase)
        return {(self.port, "sine"): xp.sin(phase), (self.port, "cosine"): xp.cos(phase)}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        places = np.unique(np.asarray(plan.x(self.placement)))
        covered = float(np.ptp(places)) or 1.0
        apart = float(np.diff(places).max(initial=0.0)) or covered
        sought = self._pitches
        shortest = max(sought.finest, _FINEST_SHARE * covered, _PER_PERIOD * apart)
        lowest = max(self.periods / covered, 1.0 / sought.longest)
        highest = 1.0 / min(sought.shortest, shortest)
        if highest <= lowest:
            return {"pitch": np.array([1.0 / lowest])}
        # Both ends, and a step beyond the finest: a pitch there is within the scan, not its end.
        steps = math.ceil((highest - lowest) * 4.0 * covered) + 1
        return {"pitch": 1.0 / (lowest + 0.25 / covered * np.arange(steps + 1))}

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        # Half of the prior on the nominal pitches, half even over the scan in 1/pitch.
        ends = 1.0 / self.scan(plan)["pitch"]
        pitch, u = values["pitch"], uncertainties["pitch"]
        # A lead is made to a few parts in ten thousand.
        width = np.hypot(u, 2e-4 * pitch)
        even = 1.0 / (pitch**2 * max(float(np.ptp(ends)), 1e-9))
        nominal = np.asarray(self._pitches.nominal)
        peaks = np.exp(-0.5 * ((pitch - nominal) / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
        return 0.5 + 0.5 * float(peaks.mean()) / even

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind not in cls._usual:
                continue
            port, unit = along(setup.chain, joint.name)
            # Of an arm's joints only a constant is.
            fitted = joint.kind != "revolute" and any(
                motion.name == port
                for effect in setup.declared
                for motion in getattr(effect, "motions", ())
            )
            yield cls(
                port=port,
                unit=unit,
                usual=cls._usual[joint.kind],
                periods=cls.periods if fitted else 1.0,
                placement=joint.name,
            )


@register
class GearRipple(ScrewCyclic):
    """Error of the gear of an arm's joint that comes again many times per turn of the joint:
    a sin(2 pi q/p) + b cos(2 pi q/p) about it.

    The wave of a strain wave gear has two lobes: with a ratio of N its error comes again 2 N times
    per turn (and less N times), p = 360 deg/(2 N). Other gears have errors of their input shaft,
    and of the mesh of their teeth. The pitch is scanned as that of `screw_cyclic`, from where
    `gear_harmonic` ends down to 1 degree.
    """

    name = "gear_ripple"
    summary = "periodic error of the gear of a joint within a turn of its input shaft"
    _usual: ClassVar[Mapping[str, float]] = {"revolute": 50.0}


@register
class ScaleInterpolation(Effect):
    """Error of a scale within one signal period p: a sin(2 pi x/p) + b cos(2 pi x/p) along it.

    Encoders divide the period of a grating; amplitudes and offsets of its two signals that are not
    equal leave an error of up to a hundredth of it. Seen only where the axis moves by some hundred
    periods at most and its positions are known to a fraction of one, as on the circles of an
    R-test: over a whole travel the errors of the scale itself are several periods long. The periods
    of usual gratings are tried.
    """

    name = "scale_interpolation"
    summary = "error of a scale within its signal period"
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("sine", "um", sigma=0.5),
            Parameter("cosine", "um", sigma=0.5),
            Parameter("period", "um", shape=True, smooth=False),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phase = 2.0 * np.pi * plan.x(self.placement) / shape["period"]
        xp = namespace(phase)
        return {(self.port, "sine"): xp.sin(phase), (self.port, "cosine"): xp.cos(phase)}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        covered = float(np.ptp(np.asarray(plan.x(self.placement))))
        seen = [p for p in SIGNAL_PERIODS_M if p <= covered <= _PERIODS * p]
        return {"period": np.array(seen or SIGNAL_PERIODS_M[-1:])}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind != "prismatic":
                continue
            covered = float(np.ptp(np.asarray(setup.plan.x(joint.name))))
            if any(p <= covered <= _PERIODS * p for p in SIGNAL_PERIODS_M):
                port, _ = along(setup.chain, joint.name)
                yield cls(port=port, placement=joint.name)


@register
class GearHarmonic(Effect):
    """Harmonic n of the angle of a rotary axis or a revolute joint: a sin(n q) + b cos(n q) about
    it, n = 1..4.
    """

    name = "gear_harmonic"
    summary = "eccentric gear or encoder of a rotary axis or a revolute joint"
    order: int = eqx.field(static=True)
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{wave}{self.order}", "urad", sigma=200.0) for wave in ("sine", "cosine")
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phase = self.order * plan.x(self.placement)
        xp = namespace(phase)
        return {
            (self.port, f"sine{self.order}"): xp.sin(phase),
            (self.port, f"cosine{self.order}"): xp.cos(phase),
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.turns:
                port, _ = along(setup.chain, joint.name)
                for order in (1, 2, 3, 4):
                    yield cls(order=order, port=port, placement=joint.name)
