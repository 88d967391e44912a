"""Effects that are drawn afresh for every reading: they widen the covariance of the readings."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response, Setup, along
from .registry import register


@register
class Repeatability(Effect):
    """Unidirectional positioning repeatability of an axis, ISO 230-2:2014, 3.17: a normal error of
    its position, drawn afresh at every approach, with the standard deviation `size`.
    """

    name = "repeatability"
    summary = "random positioning error of an axis, fresh at every approach"
    kind = "random"
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("size", self.unit, sigma=1.0 if self.unit == "um" else 10.0),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, "size"): np.ones(plan.rows)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            port, unit = along(setup.chain, axis)
            yield cls(port=port, unit=unit, placement=axis)
