"""Effects of the direction of travel: repeatability, backlash, lateral and angular reversal errors,
friction.
"""

import abc
from collections.abc import Iterable, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, unit_of
from .forms import JointAmplitude, JointPorts
from .registry import register


class _Positioning(JointAmplitude):
    """Base class of errors of the positioning of an axis: one length, or one angle."""

    acts_on = JointPorts(own=True)
    usual: ClassVar[Mapping[str, float]]
    """Prior standard deviation by the unit of the axis."""
    unit: str = eqx.field(static=True)
    """``"um"`` or ``"urad"``."""

    @property
    def size(self) -> Parameter:
        return Parameter("size", self.unit, sigma=self.usual[self.unit])

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for port, axis in cls.acts_on.of(setup.chain):
            yield cls(port=port, unit=unit_of(port), placement=axis)


@register
class Repeatability(_Positioning):
    """Unidirectional positioning repeatability of an axis, ISO 230-2:2014, 3.17: a normal error of
    its position, drawn independently at every approach, with the standard deviation `size`.
    """

    name = "repeatability"
    summary = "random positioning error of an axis, independent at every approach"
    remedy = (
        "Check play, friction and the settling time of the axis; a random error cannot be "
        "compensated."
    )
    kind = "random"
    usual: ClassVar = {"um": 1.0, "urad": 10.0}

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return np.ones(plan.rows)


class _Reversal(JointAmplitude):
    """Base class of reversal errors b: b/2 sgn(direction of approach)."""

    uses = ("dir_{axis}",)
    shown_by = ("dir_{axis}", "{axis}")

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return 0.5 * plan.covariate(f"dir_{self.placement}")


@register
class Backlash(_Positioning, _Reversal):
    """Reversal error of the positioning of an axis: b/2 sgn(direction of approach), ISO 230-2:2014,
    3.10.

    The sign of b is that in the joint's own frame: a positive b is a lead of an axis that carries
    the tool, and a lag of one that carries the workpiece, which moves against its command. For a
    rotary axis, b is an angle.
    """

    name = "backlash"
    summary = "reversal error along (or about) the axis"
    remedy = (
        "Check the preload of nut, pinion or gear and the coupling of the drive; compensate the "
        "reversal error in the control."
    )
    usual: ClassVar = {"um": 10.0, "urad": 100.0}


@register
class LateralReversal(_Reversal):
    """Reversal error across a linear axis: b/2 sgn(direction of approach) on one straightness."""

    name = "lateral_reversal"
    summary = "reversal error across a linear axis"
    remedy = (
        "Check the preload and the clearance of the guideway across the axis; it can be "
        "compensated only by a table that depends on the direction."
    )
    acts_on = JointPorts("XYZ", own=False, linear=True)
    amplitude = Parameter("size_{port}", "um", sigma=5.0)


@register
class AngularReversal(_Reversal):
    """Reversal error of a rotation: b/2 sgn(direction of approach) on roll, pitch or yaw."""

    name = "angular_reversal"
    summary = "roll, pitch or yaw that depends on the direction of approach"
    remedy = (
        "Check the clearance of the guideway, and that the drive pulls near the centre of "
        "friction; it can be compensated only by a table that depends on the direction."
    )
    acts_on = JointPorts("ABC", own=False)
    amplitude = Parameter("size_{port}", "urad", sigma=10.0)


class _Friction(Effect):
    """Base class of the displacement by friction along one axis, or along all axes with one size
    and one shape parameter: size * pull.
    """

    kinds: ClassVar[tuple[str, ...]]
    """Kinds of covariates that it needs of every axis: ``"v"`` of ``"v_X"``."""
    scale: ClassVar[Parameter]
    """The shape parameter."""
    axes: tuple[str, ...] = eqx.field(static=True)

    @abc.abstractmethod
    def pull(self, plan: Plan, axis: str, scale: Array) -> Array:
        """Displacement along one axis per unit of the size, in every row (n,)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("size", "um", sigma=5.0), self.scale)

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"{kind}_{axis}" for axis in self.axes for kind in self.kinds)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        scale = shape[self.scale.name]
        return {(f"tool.{axis}", "size"): self.pull(plan, axis, scale) for axis in self.axes}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        axes = setup.chain.axes
        if all(joint.kind == "prismatic" for joint in setup.chain.joints):
            yield cls(axes=axes)
            if len(axes) > 1:
                for axis in axes:
                    yield cls(axes=(axis,), placement=axis)

    def _fastest(self, plan: Plan) -> float:
        """The highest speed of the axes, m/s."""
        speeds = (np.abs(np.asarray(plan.covariate(f"v_{axis}"))) for axis in self.axes)
        return max(float(speed.max()) for speed in speeds) or 1.0


@register
class ReversalSpike(_Friction):
    """Friction after a reversal: -a sgn(v) exp(-s/s0) along every axis that reverses, a > 0.

    s is the distance travelled since the reversal. Until the drive has built up the force that
    overcomes friction in the new direction, the axis lags (ISO 230-4 shows it as quadrant peaks).
    Where positions are readings of the scales, as in an R-test, the effect is only the part of the
    lag that the scales do not see: wind-up of a screw behind the motor's encoder, bending of a
    slide. It is placed on one axis, or on all of them with one size and one decay.
    """

    name = "reversal_spike"
    summary = "quadrant peak: friction holds an axis back after its reversal"
    remedy = (
        "Check friction and lubrication; tune the friction compensation (quadrant errors) of the "
        "control."
    )
    kinds = ("since", "dir")
    scale = Parameter("decay", "mm", shape=True, coordinate="log")

    def pull(self, plan: Plan, axis: str, scale: Array) -> Array:
        away = plan.covariate(f"since_{axis}") / scale
        return -plan.covariate(f"dir_{axis}") * namespace(away).exp(-away)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        moving = [np.asarray(plan.covariate(f"dir_{axis}")) != 0.0 for axis in self.axes]
        since = [np.asarray(plan.covariate(f"since_{axis}")) for axis in self.axes]
        reached = np.concatenate([s[m] for s, m in zip(since, moving, strict=True)])
        longest = float(reached.max()) if len(reached) else 1e-3
        # A spike shorter than a hundredth of the way shows in one or two rows only.
        # One longer than a quarter of it does not end before the next reversal.
        return {"decay": np.geomspace(2e-3 * longest, 0.25 * longest, 22)}


@register
class StribeckFriction(_Friction):
    """Friction that falls with the speed: -a sgn(v) exp(-abs(v)/v_s) along every axis, a > 0.

    This is the part of the friction curve F(v) = sgn(v) (F_c + (F_s - F_c) exp(-abs(v)/v_s)) + F_v
    v (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30, 1083-1138) that is neither
    Coulomb friction, which bends a structure as backlash does (`backlash`; `coulomb_friction` where
    it changes sign smoothly), nor viscous friction (`servo_lag`). A `reversal_spike` falls with the
    distance since the reversal instead, at any speed. It is placed on one axis, or on all of them
    with one size and one speed.
    """

    name = "stribeck_friction"
    summary = "friction that is larger the slower the axis moves"
    remedy = (
        "Check lubrication and the tension of wipers; tune the friction compensation of the "
        "control."
    )
    kinds = ("v", "dir")
    scale = Parameter("speed", "mm/s", shape=True, coordinate="log")

    def pull(self, plan: Plan, axis: str, scale: Array) -> Array:
        v = plan.covariate(f"v_{axis}") / scale
        xp = namespace(v)
        return -plan.covariate(f"dir_{axis}") * xp.exp(-xp.abs(v))

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        # Below a hundredth of the highest speed, it shows in one or two rows only; if it has not
        # fallen to a tenth at the highest speed, it cannot be separated from backlash and lag.
        return {"speed": np.geomspace(1e-2, 0.4, 16) * self._fastest(plan)}


@register
class CoulombFriction(_Friction):
    """Friction that changes sign smoothly: -a tanh(v/v_c) along every axis, a > 0.

    Coulomb friction whose direction changes gradually with the speed: the usual smooth law, for
    rolling guideways and for seals that creep. Far above v_c, it bends a structure as backlash does
    (`backlash`, where the reversal is sudden); far below, as viscous friction does (`servo_lag`).
    It is placed on one axis, or on all of them with one size and one speed.
    """

    name = "coulomb_friction"
    summary = "friction that changes its direction smoothly at a reversal"
    remedy = (
        "Check lubrication and the tension of wipers; tune the friction compensation of the "
        "control."
    )
    odds = 0.05
    """Most friction is reported as the backlash, or the lag, that it resembles."""
    kinds = ("v",)
    scale = Parameter("speed", "mm/s", shape=True, coordinate="log")

    def pull(self, plan: Plan, axis: str, scale: Array) -> Array:
        v = plan.covariate(f"v_{axis}") / scale
        return -namespace(v).tanh(v)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        # With a faster scale, it is backlash but for a few rows; with a slower one, always a lag.
        return {"speed": np.geomspace(0.03, 0.4, 12) * self._fastest(plan)}
