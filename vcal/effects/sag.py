"""A ram, a quill or a column that bends under what it carries."""

from collections.abc import Iterable, Mapping
from typing import Literal

import equinox as eqx
import numpy as np

from ..arrays import Array, namespace
from ..parameters import Parameter
from ..plan import Plan
from .base import Effect, Response, Setup
from .registry import register

_LEVEL = 1e-9
"""Upward part of an axis's direction below which it is horizontal."""


@register
class PayloadSag(Effect):
    """The tip of a horizontal ram falls under a payload: a cantilever of the length that is out.

    With s the overhang as a share of the travel L, m the payload in kg and c the deflection per kg
    at full overhang, the tip falls by c m s^3 (F l^3 / 3 E I) and turns downwards by
    1.5 c m s^2 / L (F l^2 / 2 E I). The ram is clamped at the low or the high end of the travel;
    gravity acts along -Z of the workpiece frame.
    """

    name = "payload_sag"
    summary = "ram or column that bends as a beam under a payload"
    low: float
    high: float
    clamped: Literal["low", "high"] = eqx.field(static=True, default="low")
    """End of the travel at which nothing of the ram is out."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"sag_{self.clamped}", "um/kg", sigma=0.5),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement, "payload_kg")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        length, axis = self.high - self.low, self.placement
        out = plan.x(axis) - self.low if self.clamped == "low" else self.high - plan.x(axis)
        s = namespace(out).clip(out / length, 0.0, 1.0)
        load = plan.covariate("payload_kg")
        away = 1.0 if self.clamped == "low" else -1.0
        # A positive rotation about X lifts what is at +Y, one about Y lowers what is at +X.
        turn, sign = ("A", -away) if axis == "Y" else ("B", away)
        name = self.parameters[0].name
        return {
            (f"EZ{axis}", name): -load * s**3,
            (f"E{turn}{axis}", name): sign * 1.5 * load * s**2 / length,
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            level = abs(float(np.asarray(joint.direction)[2])) < _LEVEL
            carries = joint.kind == "prismatic" and joint.side == "tool"
            if carries and level and np.isfinite(joint.travel).all():
                low, high = (float(v) for v in joint.travel)
                for clamped in ("low", "high"):
                    yield cls(low=low, high=high, clamped=clamped, placement=joint.name)
