"""A ram, a quill or a column that bends under what it carries."""

from collections.abc import Iterable, Mapping
from typing import Literal

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .registry import register

_LEVEL = 1e-9
"""Upward part of an axis's direction below which it is horizontal."""


@register
class PayloadSag(Effect):
    """The tip of a horizontal ram falls under a payload: a cantilever of the length that is out.

    With s the overhang as a share of the travel L, m the payload in kg and c the deflection per kg
    at full overhang, the tip falls by c m s^3 (F l^3 / 3 E I) and turns downwards by
    1.5 c m s^2 / L (F l^2 / 2 E I). The ram is clamped at the low or the high end of the travel.
    """

    name = "payload_sag"
    summary = "ram or column that bends as a beam under a payload"
    low: float
    high: float
    clamped: Literal["low", "high"] = eqx.field(static=True, default="low")
    """End of the travel at which nothing of the ram is out."""
    up: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 0.0, 1.0))
    """Unit vector against gravity."""

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
        away = np.eye(3)["XYZ".index(axis)] * (1.0 if self.clamped == "low" else -1.0)
        down = -np.array(self.up)
        name, falls = self.parameters[0].name, {}
        # Away from where it is clamped the ram turns towards where it falls to.
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
                for clamped in ("low", "high"):
                    yield cls(
                        low=low,
                        high=high,
                        clamped=clamped,
                        up=setup.chain.up,
                        placement=joint.name,
                    )
