"""Effects of the structure that carries the tool: a ram that bends under a payload, a spindle that
grows while it turns.
"""

from collections.abc import Iterable, Mapping
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from ..numerics.record import Record
from .base import Effect, Reference, Response, Setup
from .forms import OneAmplitude
from .registry import register

_LEVEL = 1e-9
"""Upward part of an axis's direction below which the axis is horizontal."""


@register
class PayloadSag(Effect):
    """The tip of a horizontal ram falls under a payload: a cantilever as long as the overhang.

    With s the overhang as a share of the travel L, m the payload in kg and c the deflection per kg
    at full overhang, the tip falls by c m s^3 (F l^3 / 3 E I) and turns downwards by
    1.5 c m s^2 / L (F l^2 / 2 E I). The ram is clamped at the low or the high end of the travel.
    """

    name = "payload_sag"
    summary = "ram or column that bends as a beam under a payload"
    remedy = (
        "Check the counterweight and the stiffness of ram or column; compensate by position and "
        "payload."
    )
    uses = ("{axis}", "payload_kg")
    low: float
    high: float
    clamped: Literal["low", "high"] = eqx.field(static=True, default="low")
    """End of the travel at which the overhang is zero."""
    up: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 0.0, 1.0))
    """Unit vector against gravity."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"sag_{self.clamped}", "um/kg", sigma=0.5),)

    @property
    def reference(self) -> Reference:
        """The geometry may be that of the ram with a payload."""
        return Reference("payload_kg", "kg", 50.0)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        length, axis = self.high - self.low, self.placement
        out = plan.x(axis) - self.low if self.clamped == "low" else self.high - plan.x(axis)
        s = namespace(out).clip(out / length, 0.0, 1.0)
        load = plan.covariate("payload_kg")
        away = np.eye(3)["XYZ".index(axis)] * (1.0 if self.clamped == "low" else -1.0)
        down = -np.array(self.up)
        name, falls = self.parameters[0].name, {}
        # The free end of the ram turns towards the side to which it falls.
        for size, components, way in (
            (load * s**3, "XYZ", down),
            (1.5 * load * s**2 / length, "ABC", np.cross(away, down)),
        ):
            for component, part in zip(components, way, strict=True):
                if part:
                    falls[f"E{component}{axis}", name] = float(part) * size
        return falls

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            level = abs(float(np.dot(joint.direction, setup.chain.up))) < _LEVEL
            carries = joint.kind == "prismatic" and joint.side == "tool"
            if carries and level and np.isfinite(joint.travel).all():
                low, high = (float(v) for v in joint.travel)
                for end in ("low", "high"):
                    up, axis = setup.chain.up, joint.name
                    yield cls(low=low, high=high, clamped=end, up=up, placement=axis)


class _History(Record):
    """Recorded speed over time: each value holds from its time until the next."""

    t: Float[np.ndarray, " k"]
    """s, rising."""
    share: Float[np.ndarray, " k"]
    """Speed over the highest one."""


@register
class SpindleGrowth(OneAmplitude):
    """A spindle that warms up with its speed and grows along the tool axis (ISO 230-3).

    The model is of first order: tau g' = A n / n_max - g, cold at the first reading; the speed n of
    a row holds until the next row. A is the displacement towards +Z at the highest speed in the
    steady state: for a spindle that points down, and grows out of its housing, it is negative.
    Without a recorded speed it cannot be separated from the `warm_up` of the axis that carries the
    spindle.
    """

    name = "spindle_growth"
    summary = "growth of the spindle along the tool axis with its speed"
    remedy = (
        "Warm the spindle up before work; compensate its growth by speed or by a temperature of "
        "the spindle."
    )
    port = "tool.Z"
    amplitude = Parameter("size", "um", sigma=20.0)
    uses = ("t", "speed_rpm")
    history: _History

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size, Parameter("tau", "h", shape=True, coordinate="log"))

    @property
    def reference(self) -> Reference:
        """The machine may be adjusted with a warm spindle."""
        return Reference("speed_rpm", "1", 1.0)

    def constant_part(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(self.port, self.size.name): np.ones(plan.rows)}

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        # Superposition of the steps of the speed: the response to each is 1 - exp(-(t - t_k)/tau).
        steps = np.diff(self.history.share, prepend=0.0)
        t, grown = plan.covariate("t"), np.zeros(())
        for at, step in zip(self.history.t, steps, strict=True):
            if step != 0.0:
                since = namespace(t).maximum(t - at, 0.0) / shape["tau"]
                grown = grown - step * namespace(since).expm1(-since)
        return grown

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        span = float(np.ptp(np.asarray(plan.covariate("t")))) or 1.0
        return {"tau": np.geomspace(span / 20.0, span * 2.0, 16)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        if not setup.plan.has("t", "speed_rpm"):
            # A candidate that cannot be evaluated: the report says which columns it needs.
            yield cls(history=_History(np.zeros(0), np.zeros(0)))
            return
        t = np.asarray(setup.plan.covariate("t"), float)
        speed = np.abs(np.asarray(setup.plan.covariate("speed_rpm"), float))
        order = np.argsort(t, kind="stable")
        if speed.max() > 0.0:
            yield cls(history=_History(t[order], speed[order] / speed.max()))
