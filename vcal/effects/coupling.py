"""Errors of one joint that depend on the position of another, and constants at the tool."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response, Setup
from .registry import register


@register
class CrossAxis(Effect):
    """An error motion of one axis that depends on another's position too (a moving mass).

    E = a u v + b u^2 v + c u v^2, u and v the two axes' positions over their travel, -1 to 1. It
    is for axes of a declared travel: a mass that moves by the millimetres of a circle bends nothing
    by how far it went, and as polynomials the terms would describe whatever goes round with it.
    """

    name = "cross_axis"
    summary = "error motion that depends on a second axis's position"
    motion: str = eqx.field(static=True)
    other: str = eqx.field(static=True)
    travel: tuple[float, float, float, float] = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        unit = "um" if self.motion[1] in "XYZ" else "urad"
        own, other = self.placement.lower(), self.other.lower()
        return (
            Parameter(f"{self.motion}_{own}_{other}", unit, sigma=10.0),
            Parameter(f"{self.motion}_{own}2_{other}", unit, sigma=10.0),
            Parameter(f"{self.motion}_{own}_{other}2", unit, sigma=10.0),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement, self.other)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        a, b, c, d = self.travel
        u = (2.0 * plan.x(self.placement) - a - b) / (b - a)
        v = (2.0 * plan.x(self.other) - c - d) / (d - c)
        first, second, third = (p.name for p in self.parameters)
        return {
            (self.motion, first): u * v,
            (self.motion, second): u * u * v,
            (self.motion, third): u * v * v,
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            for other in setup.chain.joints:
                if joint is other or joint.turns or other.turns:
                    continue
                (a, b), (c, d) = joint.travel.tolist(), other.travel.tolist()
                travel = (a, b, c, d)
                if not np.isfinite(travel).all():
                    continue
                for letter in "XYZABC":
                    yield cls(
                        motion=f"E{letter}{joint.name}",
                        other=other.name,
                        travel=travel,
                        placement=joint.name,
                    )


@register
class JointCoupling(Effect):
    """A revolute joint that turns in proportion to another joint's angle: k q_other.

    Typical of wrists whose gears share shafts.
    """

    name = "joint_coupling"
    summary = "joint angle that depends linearly on another joint"
    other: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(f"k_{self.other}", "urad/rad", sigma=200.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement, self.other)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(f"EC{self.placement}", f"k_{self.other}"): plan.x(self.other)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            for other in setup.chain.joints:
                if joint is not other and joint.kind == other.kind == "revolute":
                    yield cls(other=other.name, placement=joint.name)


@register
class ToolOffset(Effect):
    """A constant error of the tool point in the last joint's frame (X, Y, Z).

    Seen only through the rotations that carry it; a pure translation is absorbed by the station or
    the artefact's pose.
    """

    name = "tool_offset"
    summary = "constant error of the tool point"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(c, "um", sigma=100.0) for c in "XYZ")

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        one = np.ones(plan.rows)
        return {(f"tool.{c}", c): one for c in "XYZ"}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        # Where the instrument finds the points on the tool itself, this is already free.
        if not any(group.startswith("point") for group in setup.layout.groups):
            yield cls()
