"""Effects of velocity."""

from collections.abc import Iterable, Mapping

import equinox as eqx

from ..arrays import Array
from ..parameters import Parameter
from ..plan import Plan
from .base import Effect, Response, Setup, along
from .registry import register


@register
class ServoLag(Effect):
    """An axis that follows its command late: -v T along the axis, T = 1/Kv for a position loop.

    Placed on one axis, or on all of them with one T: axes with equal gains, or, where positions and
    readings are taken by two devices, clocks that differ by T.
    """

    name = "servo_lag"
    summary = "an axis, or a clock, that is late: displacement in proportion to velocity"
    ports: tuple[tuple[str, str], ...] = eqx.field(static=True)
    """(axis, port along it)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("T", "ms", sigma=1.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"v_{axis}" for axis, _ in self.ports)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(port, "T"): -plan.covariate(f"v_{axis}") for axis, port in self.ports}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        axes = [joint.name for joint in setup.chain.joints if joint.kind == "prismatic"]
        own = tuple((axis, along(setup.chain, axis)[0]) for axis in axes)
        if len(axes) == len(setup.chain.joints):
            yield cls(ports=own)
            if len(axes) > 1:
                for axis, port in own:
                    yield cls(ports=((axis, port),), placement=axis)
