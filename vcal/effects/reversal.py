"""Effects of the direction of travel: backlash, lateral and angular reversal errors, friction."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup, across, along
from .registry import register


def _half_sign(plan: Plan, axis: str) -> Array:
    return 0.5 * plan.covariate(f"dir_{axis}")


@register
class Backlash(Effect):
    """Reversal value along the axis: b/2 sgn(direction of approach), ISO 230-2:2014, 3.10.

    In the joint's own frame, signed: a positive b is a lead of an axis that carries the tool, and a
    lag of one that carries the workpiece, which moves against its command. For an axis that turns
    it is an angle.
    """

    name = "backlash"
    summary = "reversal error along (or about) the axis"
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("size", self.unit, sigma=10.0 if self.unit == "um" else 100.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"dir_{self.placement}",)

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        return (f"dir_{self.placement}", self.placement)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, "size"): _half_sign(plan, self.placement)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            port, unit = along(setup.chain, axis)
            yield cls(port=port, unit=unit, placement=axis)


@register
class LateralReversal(Effect):
    """Reversal error across the axis: b/2 sgn(direction of approach) on one straightness."""

    name = "lateral_reversal"
    summary = "reversal error across a linear axis"
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"size_{self.port}", "um", sigma=5.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"dir_{self.placement}",)

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        return (f"dir_{self.placement}", self.placement)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, f"size_{self.port}"): _half_sign(plan, self.placement)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind == "prismatic":
                for port in across(setup.chain, joint.name):
                    yield cls(port=port, placement=joint.name)


@register
class AngularReversal(Effect):
    """Reversal error of a rotation: b/2 sgn(direction of approach) on roll, pitch or yaw."""

    name = "angular_reversal"
    summary = "roll, pitch or yaw that depends on the direction of approach"
    port: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"size_{self.port}", "urad", sigma=10.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (f"dir_{self.placement}",)

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        return (f"dir_{self.placement}", self.placement)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, f"size_{self.port}"): _half_sign(plan, self.placement)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            own, _ = along(setup.chain, axis)
            for c in "ABC":
                if f"E{c}{axis}" != own:
                    yield cls(port=f"E{c}{axis}", placement=axis)


class _AlongAxes(Effect):
    """Base class of what friction does along one axis, or along all of them with one size."""

    axes: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        axes = [joint.name for joint in setup.chain.joints if joint.kind == "prismatic"]
        if len(axes) == len(setup.chain.joints):
            yield cls(axes=tuple(axes))
            if len(axes) > 1:
                for axis in axes:
                    yield cls(axes=(axis,), placement=axis)


@register
class ReversalSpike(_AlongAxes):
    """Friction after a reversal: -a sgn(v) exp(-s/s0) along every axis that reverses, a > 0.

    s is the distance travelled since the reversal. Until the drive has built up the force that
    overcomes friction in the new direction, the axis lags (ISO 230-4 shows it as quadrant peaks).
    Where positions are those that the scales read, as in an R-test, it is only that part of the lag
    which the scales do not see: wind-up of a screw behind the motor's encoder, bending of a slide.
    Placed on one axis, or on all of them with one size and one decay.
    """

    name = "reversal_spike"
    summary = "quadrant peak: friction holds an axis back after its reversal"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "um", sigma=5.0),
            Parameter("decay", "mm", shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"{kind}_{axis}" for axis in self.axes for kind in ("since", "dir"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        found = {}
        for axis in self.axes:
            away = plan.covariate(f"since_{axis}") / shape["decay"]
            left = namespace(away).exp(-away)
            found[f"tool.{axis}", "size"] = -plan.covariate(f"dir_{axis}") * left
        return found

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        moving = [np.asarray(plan.covariate(f"dir_{axis}")) != 0.0 for axis in self.axes]
        since = [np.asarray(plan.covariate(f"since_{axis}")) for axis in self.axes]
        reached = np.concatenate([s[m] for s, m in zip(since, moving, strict=True)])
        longest = float(reached.max()) if len(reached) else 1e-3
        # A spike of less than a hundredth of the way is a matter of one or two rows.
        # What takes longer than a quarter of it has no end before the next reversal.
        return {"decay": np.geomspace(2e-3 * longest, 0.25 * longest, 22)}


@register
class StribeckFriction(_AlongAxes):
    """Friction that falls with the speed: -a sgn(v) exp(-|v|/v_s) along every axis, a > 0.

    The part of the friction curve F(v) = sgn(v) (F_c + (F_s - F_c) exp(-|v|/v_s)) + F_v v
    (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30, 1083-1138) that is neither
    Coulomb's, which bends a structure as a play does (`backlash`; `coulomb_friction` where it sets
    in smoothly), nor viscous (`servo_lag`). A
    `reversal_spike` falls with the distance since the reversal instead, at any speed. Placed on one
    axis, or on all of them with one size and one speed.
    """

    name = "stribeck_friction"
    summary = "friction that is larger the slower the axis moves"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "um", sigma=5.0),
            Parameter("speed", "mm/s", shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"{kind}_{axis}" for axis in self.axes for kind in ("v", "dir"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        found = {}
        for axis in self.axes:
            v = plan.covariate(f"v_{axis}") / shape["speed"]
            xp = namespace(v)
            found[f"tool.{axis}", "size"] = -plan.covariate(f"dir_{axis}") * xp.exp(-xp.abs(v))
        return found

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        # Slower than a hundredth of the fastest is a matter of one or two rows; what has not fallen
        # to a tenth at the highest speed cannot be told from play and lag.
        return {"speed": np.geomspace(1e-2, 0.4, 16) * _fastest(plan, self.axes)}


@register
class CoulombFriction(_AlongAxes):
    """Friction that sets in smoothly: -a tanh(v/v_c) along every axis, a > 0.

    Coulomb's friction, the direction of which changes with the speed instead of at once: the usual
    smooth law, of rolling guideways and of seals that creep. Far above v_c it bends a structure as
    a play does (`backlash`, where the reversal is sudden), far below as viscous friction does
    (`servo_lag`). Placed on one axis, or on all of them with one size and one speed.
    """

    name = "coulomb_friction"
    summary = "friction that changes its direction smoothly at a reversal"
    odds = 0.05
    """Most friction is told as the play, or the lag, that it looks like."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "um", sigma=5.0),
            Parameter("speed", "mm/s", shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"v_{axis}" for axis in self.axes)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        found = {}
        for axis in self.axes:
            v = plan.covariate(f"v_{axis}") / shape["speed"]
            found[f"tool.{axis}", "size"] = -namespace(v).tanh(v)
        return found

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        # Faster at its reversals it is a play but for a few rows, slower at all times a lag.
        return {"speed": np.geomspace(0.03, 0.4, 12) * _fastest(plan, self.axes)}


def _fastest(plan: Plan, axes: Iterable[str]) -> float:
    """The highest speed of some axes, m/s."""
    return max(float(np.abs(np.asarray(plan.covariate(f"v_{a}"))).max()) for a in axes) or 1.0
