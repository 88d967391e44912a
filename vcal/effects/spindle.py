"""Effects of a spindle."""

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from ..numerics.record import Record
from .base import Effect, Response, Setup
from .registry import register


class _History(Record):
    """Speed over time as it was recorded: from every time on, until the next."""

    t: Float[np.ndarray, " k"]
    """s, rising."""
    share: Float[np.ndarray, " k"]
    """Speed over the highest one."""


@register
class SpindleGrowth(Effect):
    """A spindle that warms up with its speed and grows along the tool axis (ISO 230-3).

    First order: tau g' = A n / n_max - g, cold at the first reading; the speed n counts from every
    row to the next. A is the displacement towards +Z at the highest speed in the long run: of a
    spindle that points down, and grows out of its housing, it is negative. Without a recorded speed
    nothing tells it from the `warm_up` of the axis that carries the spindle.
    """

    name = "spindle_growth"
    summary = "growth of the spindle along the tool axis with its speed"
    history: _History

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter("size", "um", sigma=20.0),
            Parameter("tau", "h", shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return ("t", "speed_rpm")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        # Superposition of the steps of the speed: each is answered by 1 - exp(-(t - t_k) / tau).
        steps = np.diff(self.history.share, prepend=0.0)
        t, grown = plan.covariate("t"), np.zeros(())
        for at, step in zip(self.history.t, steps, strict=True):
            if step != 0.0:
                since = namespace(t).maximum(t - at, 0.0) / shape["tau"]
                grown = grown - step * namespace(since).expm1(-since)
        return {("tool.Z", "size"): grown}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        span = float(np.ptp(np.asarray(plan.covariate("t")))) or 1.0
        return {"tau": np.geomspace(span / 20.0, span * 2.0, 16)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if not setup.plan.has("t", "speed_rpm"):
            yield cls(history=_History(np.zeros(0), np.zeros(0)))  # to be told what it wants
            return
        t = np.asarray(setup.plan.covariate("t"), float)
        speed = np.abs(np.asarray(setup.plan.covariate("speed_rpm"), float))
        order = np.argsort(t, kind="stable")
        if speed.max() > 0.0:
            yield cls(history=_History(t[order], speed[order] / speed.max()))
