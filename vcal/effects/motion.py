"""Effects of velocity: axes that lag behind their commands."""

from collections.abc import Iterable, Mapping

import equinox as eqx

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response, Setup, along
from .registry import register


@register
class ServoLag(Effect):
    """An axis that lags behind its command by a time T: it is at x - v T; T = 1/Kv for a position
    loop.

    It is a lag of the tool against the workpiece on either side of the bed: a table lags along its
    own motion, which is against its command.

    It is placed on one axis, or on all of them with one T: axes with equal gains, or, where
    positions and readings are taken by two devices, clocks that differ by T. On a circle, a common
    lag displaces the tool along the path; the lag of one axis alone is the servo mismatch of ISO
    230-4, an ellipse at 45 degrees that turns over with the sense.
    """

    name = "servo_lag"
    summary = "an axis, or a clock, that lags: displacement in proportion to velocity"
    remedy = (
        "Check the velocity feed-forward and the loop gains of the axes, and that all axes have "
        "the same gain; check the clock of the recording."
    )
    ports: tuple[tuple[str, str, float], ...] = eqx.field(static=True)
    """(axis, port along it, `vcal.machine.chain.Joint.sign`)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("T", "ms", sigma=1.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"v_{axis}" for axis, *_ in self.ports)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(port, "T"): -sign * plan.covariate(f"v_{axis}") for axis, port, sign in self.ports}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        linear = [joint for joint in setup.chain.joints if joint.kind == "prismatic"]
        own = [(joint.name, along(setup.chain, joint.name)[0], joint.sign) for joint in linear]
        if len(own) == len(setup.chain.joints):
            yield cls(ports=tuple(own))
            if len(own) > 1:
                for one in own:
                    yield cls(ports=(one,), placement=one[0])
