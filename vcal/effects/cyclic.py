"""Periodic effects: screws, worms, scales, gears."""

import math
from collections.abc import Iterable, Mapping
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.lattice import lattice_step
from .base import Effect, Setup, along
from .forms import Tones, Wave, sine_and_cosine
from .registry import register

_FINEST_SHARE, _PER_PERIOD = 0.01, 2.0
"""Where an axis was measured at closely spaced positions, finer pitches can be found: the finest of
them as a share of the travel, and the positions that each period requires."""
_TEETH = (
    *(36, 40, 45, 48, 50, 60, 72, 80, 90, 96, 100, 120, 128, 144, 150),
    *(160, 180, 200, 240, 256, 320, 360),
)
"""Teeth of usual worm wheels, cycles per turn of inductive scales, and ratios of strain wave gears
and twice these."""
_OFF_LATTICE = 0.01
"""Share of the shortest pitch by which positions may be off a lattice that still hides pitches."""
_SLOWEST = 4.5
"""Periods per turn of the longest pitch of a rotary axis: longer ones are `gear_harmonic`."""


class _Pitches(NamedTuple):
    """Pitches that are searched, of the linear axes or of the rotary ones; m or rad."""

    unit: str
    """Unit of the parameter."""
    shortest: float
    """The shortest that is searched at any spacing of the positions."""
    finest: float
    """The shortest that is searched at closely spaced positions."""
    longest: float
    nominal: tuple[float, ...]
    """Nominal ones."""
    usual: float
    """The most usual one, which is named as an example."""


class Aliases(NamedTuple):
    """Pitches that positions in equal steps cannot distinguish, or do not show; m or rad."""

    step: float
    alike: tuple[float, ...]
    """Pitches of which each gives the same readings as the first, a usual one; the nearest first.
    """
    unseen: tuple[float, ...]
    """Pitches of which the step is a whole multiple: they give a constant."""


_PITCHES = {
    # Nominal leads of ball screws, ISO 3408-2, and pole pitches of magnetic and inductive scales. A
    # plan of nearly equal steps s cannot separate a pitch p from its aliases 1/p +/- 1/s; the
    # prior on the nominal values often can.
    "um": _Pitches(
        unit="mm",
        shortest=4e-3,
        finest=0.25e-3,
        longest=math.inf,
        nominal=(
            *(0.5e-3, 1e-3, 2e-3, 2.5e-3),
            *(4e-3, 5e-3, 6e-3, 8e-3, 10e-3, 12e-3, 16e-3, 20e-3, 25e-3, 32e-3, 40e-3),
        ),
        usual=10e-3,
    ),
    "urad": _Pitches(
        unit="deg",
        shortest=math.radians(1.0),
        finest=math.radians(0.1),
        longest=2.0 * math.pi / _SLOWEST,
        nominal=tuple(2.0 * math.pi / teeth for teeth in _TEETH),
        usual=math.radians(5.0),
    ),
}
"""By the unit of the error along, or about, the axis."""


SIGNAL_PERIODS_M = (2e-6, 4e-6, 10e-6, 20e-6, 40e-6, 100e-6, 200e-6)
"""Signal periods of linear encoders."""
_PERIODS = 500.0
"""Most periods that a plan may cover: a scale error of two parts in a thousand shifts the phase by
one period."""


@register
class ScrewCyclic(Wave):
    """Error of a screw within one turn: a sin(2 pi x/p) + b cos(2 pi x/p) along the axis; or of a
    worm, whose wheel has 360/p teeth, about a rotary axis.

    The pitch p is scanned in steps of 1/(4 L) in 1/p, L the travel that was covered: wider steps
    can miss a peak between two of them. The scan goes down to 4 mm, or 1 degree, and further where
    the axis was measured at two or more positions in every period. Pitches longer than a quarter of
    the travel belong to the geometry where that is fitted; where it is not, the scan goes up to the
    whole travel. The pitches of a rotary axis end where `gear_harmonic` begins.
    """

    name = "screw_cyclic"
    summary = "periodic error of a screw, a rack, a worm or a scale, pitch unknown"
    remedy = (
        "Check the bearings and the alignment of the screw or rack, and the mounting of the "
        "rotary encoder; compensate by a table with at least eight points per pitch."
    )
    _usual: ClassVar[Mapping[str, float]] = {"prismatic": 3.0, "rotary": 15.0}
    """Prior standard deviation, um or urad, by the kinds of joints that may have it."""
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="um")
    """``"um"`` along a linear axis, ``"urad"`` about a rotary one."""
    usual: float = eqx.field(static=True, default=3.0, repr=False)
    """Prior standard deviation of the amplitudes, in that unit."""
    periods: float = eqx.field(static=True, default=4.0, repr=False)
    """Number of periods of the longest searched pitch within the travel."""

    @property
    def waves(self) -> tuple[Parameter, Parameter]:
        return sine_and_cosine(self.unit, self.usual)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        pitch = Parameter("pitch", self._pitches.unit, shape=True, coordinate="reciprocal")
        return (*self.waves, pitch)

    @property
    def _pitches(self) -> _Pitches:
        return _PITCHES[self.unit]

    def phase(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return 2.0 * np.pi * plan.x(self.placement) / shape["pitch"]

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
        # Both ends, and one step beyond the finest, so that the finest lies inside the scan.
        steps = math.ceil((highest - lowest) * 4.0 * covered) + 1
        return {"pitch": 1.0 / (lowest + 0.25 / covered * np.arange(steps + 1))}

    def tones(self, plan: Plan) -> Tones | None:
        x = np.asarray(plan.x(self.placement))
        f = 1.0 / self.scan(plan)["pitch"]
        if len(f) < 2:
            return None
        step = float((f[-1] - f[0]) / (len(f) - 1))
        skipped = float(f[0]) / step
        whole = abs(skipped - round(skipped)) < 1e-9 * (1.0 + skipped)
        return Tones(x, float(f[0]), step, len(f)) if whole else None

    def aliases(self, plan: Plan) -> Aliases | None:
        """The pitches within the scan that positions x0 + n s cannot distinguish: those of
        1/p' = |1/p + k/s|. None where the positions are on no lattice, or on one whose step is so
        short that there are no such pitches.
        """
        grid = self.scan(plan)["pitch"]
        shortest, longest = float(grid.min()), float(grid.max())
        step = lattice_step(np.asarray(plan.x(self.placement)), _OFF_LATTICE * shortest)
        if step is None or step <= 0.5 * shortest:
            return None
        low, high = (1.0 - 1e-9) / longest, (1.0 + 1e-9) / shortest
        usual = [p for p in self._pitches.nominal if low <= 1.0 / p <= high]
        # A wave is seen where the step is no whole multiple of its pitch.
        seen = [p for p in usual if abs(step / p - round(step / p)) > _OFF_LATTICE]
        whole = np.arange(1, math.ceil(step * high) + 1) / step
        unseen = 1.0 / whole[(whole >= low) & (whole <= high)]
        alike = np.zeros(0)
        if seen:
            first = min(seen, key=lambda p: abs(math.log(p / self._pitches.usual)))
            k = np.arange(math.ceil(step * (high + 1.0 / first)) + 1) / step
            aliases = np.unique(np.round(np.abs([k + 1.0 / first, k - 1.0 / first]), 9))
            alike = 1.0 / aliases[(aliases >= low) & (aliases <= high)]
            alike = alike[np.argsort(np.abs(np.log(alike / first)))]
        return Aliases(step, tuple(alike.tolist()), tuple(unseen.tolist()))

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        # Half of the prior lies on the nominal pitches, half is uniform over the scan in 1/pitch.
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
            # For an arm's joints, the geometry is only a constant.
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
    """Error of the gear of an arm's joint that repeats many times per turn of the joint:
    a sin(2 pi q/p) + b cos(2 pi q/p) about it.

    The wave of a strain wave gear has two lobes: with a ratio of N, its error repeats 2 N times per
    turn (to a lesser extent N times), p = 360 deg/(2 N). Other gears have errors of their input
    shaft and of the mesh of their teeth. The pitch is scanned as for `screw_cyclic`, from the end
    of `gear_harmonic` down to 1 degree.
    """

    name = "gear_ripple"
    summary = "periodic error of the gear of a joint within a turn of its input shaft"
    remedy = "Check the gear and the motor encoder of the joint; a worn gear has to be replaced."
    _usual: ClassVar[Mapping[str, float]] = {"revolute": 50.0}


@register
class ScaleInterpolation(Wave):
    """Error of a scale within one signal period p: a sin(2 pi x/p) + b cos(2 pi x/p) along it.

    Encoders interpolate the period of a grating; unequal amplitudes and offsets of the two signals
    leave an error of up to a hundredth of the period. It can be identified only where the axis
    moves by a few hundred periods at most and its positions are known to a fraction of one, as on
    the circles of an R-test: over the whole travel, the errors of the scale itself amount to
    several periods. The periods of usual gratings are tried.
    """

    name = "scale_interpolation"
    summary = "error of a scale within its signal period"
    remedy = (
        "Clean the scale and adjust the reading head: distance, tilt and the amplitude of its "
        "signals."
    )
    waves = sine_and_cosine("um", 0.5)
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*self.waves, Parameter("period", "um", shape=True, smooth=False))

    def phase(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return 2.0 * np.pi * plan.x(self.placement) / shape["period"]

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
class GearHarmonic(Wave):
    """Harmonic n of the angle of a rotary axis or a revolute joint: a sin(n q) + b cos(n q) about
    it, n = 1..4.
    """

    name = "gear_harmonic"
    summary = "eccentric gear or encoder of a rotary axis or a revolute joint"
    remedy = (
        "Check the centring of the gear wheel or of the encoder disc on its axis; compensate by a "
        "table over one turn."
    )
    order: int = eqx.field(static=True)
    port: str = eqx.field(static=True)

    @property
    def waves(self) -> tuple[Parameter, Parameter]:
        return sine_and_cosine("urad", 200.0, self.order)

    def phase(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return self.order * plan.x(self.placement)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.turns:
                port, _ = along(setup.chain, joint.name)
                for order in (1, 2, 3, 4):
                    yield cls(order=order, port=port, placement=joint.name)
