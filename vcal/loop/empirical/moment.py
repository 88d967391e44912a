"""Errors that start at one moment."""

from collections.abc import Mapping

import numpy as np

from ...effects.base import Response
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...numerics.arrays import Array, namespace
from .base import Code, Empirical, Interval, Read, written


class Since(Empirical):
    """An error proportional to the position from one moment on: (a + b (t - at)) x for t > at. It
    occurs where a compensation no longer receives its input.
    """

    name = "scale_since"
    summary = "empirical: error in proportion to the position, from one moment on"
    words = "an error that grows with the position from one moment on"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        per = "rad" if self._length() == "rad" else "m"
        return (
            Parameter("step", f"{self.unit}/{per}", sigma=20.0),
            Parameter("ramp", f"{self.unit}/({per} h)", sigma=20.0),
            Parameter("at", "s", shape=True, smooth=False),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement, "t")

    @property
    def joint(self) -> bool:
        return True

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        x, after = plan.x(self.placement), plan.covariate("t") - shape["at"]
        xp = namespace(x, after)
        return {
            (self.port, "step"): xp.where(after > 0.0, x, 0.0),
            (self.port, "ramp"): x * xp.maximum(after, 0.0),
        }

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        t = np.unique(np.asarray(plan.covariate("t")))
        return {"at": np.unique(np.quantile(t, np.linspace(0.05, 0.95, 31)))}

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        return (Interval("t", shape["at"], float(np.max(plan.covariate("t")))),)

    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        at = written(shape["at"], float(np.ptp(plan.covariate("t"))))
        return (
            [f"x = {read(self.placement)}", f"after = {read('t')} - {at}  # s"],
            {
                (self.port, "step"): "jnp.where(after > 0, x, 0.0)",
                (self.port, "ramp"): "x * jnp.maximum(after, 0.0)",
            },
        )
