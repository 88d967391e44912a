"""Errors of one joint that depend on the position of another, and constants at the tool."""

import itertools
from collections.abc import Iterable, Mapping

import equinox as eqx
import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from .base import Effect, Response, Setup, unit_of
from .forms import Constants, OneAmplitude
from .registry import register


@register
class CrossAxis(Effect):
    """An error motion of one axis that depends on the position of another one too (a moving mass).

    E = a u v + b u^2 v + c u v^2, with u and v the positions of the two axes over their travel, -1
    to 1. It requires a declared travel: a mass that moves by the few millimetres of a circle does
    not bend the structure noticeably, and the polynomials would fit anything periodic with the
    circle.
    """

    name = "cross_axis"
    summary = "error motion that depends on a second axis's position"
    remedy = (
        "Check the straightness and the alignment of the guideways that carry the second axis; "
        "compensate by a volumetric table or a cross-error table."
    )
    motion: str = eqx.field(static=True)
    other: str = eqx.field(static=True)
    travel: tuple[float, float, float, float] = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        own, other = self.placement.lower(), self.other.lower()
        terms = (f"{own}_{other}", f"{own}2_{other}", f"{own}_{other}2")
        unit = unit_of(self.motion)
        return tuple(Parameter(f"{self.motion}_{term}", unit, sigma=10.0) for term in terms)

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
        for joint, other in itertools.permutations(setup.chain.joints, 2):
            if joint.turns or other.turns:
                continue
            (a, b), (c, d) = joint.travel.tolist(), other.travel.tolist()
            travel, axis = (a, b, c, d), joint.name
            if np.isfinite(travel).all():
                for letter in "XYZABC":
                    motion = f"E{letter}{axis}"
                    yield cls(motion=motion, other=other.name, travel=travel, placement=axis)


@register
class JointCoupling(OneAmplitude):
    """A revolute joint that turns in proportion to the angle of another joint: k q_other.

    It is typical of wrists whose gears share shafts.
    """

    name = "joint_coupling"
    summary = "joint angle that depends linearly on another joint"
    remedy = (
        "Check the coupling factors of the joints in the control, and the mechanical coupling of "
        "the wrist."
    )
    other: str = eqx.field(static=True)

    @property
    def port(self) -> str:  # type: ignore[override]
        return f"EC{self.placement}"

    @property
    def size(self) -> Parameter:
        return Parameter(f"k_{self.other}", "urad/rad", sigma=200.0)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement, self.other)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        return plan.x(self.other)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint, other in itertools.permutations(setup.chain.joints, 2):
            if joint.kind == other.kind == "revolute":
                yield cls(other=other.name, placement=joint.name)


@register
class ToolOffset(Constants):
    """A constant error of the tool point in the last joint's frame (X, Y, Z).

    It is observable only through the rotations that carry it; a pure translation is absorbed by the
    pose of the station or of the artefact.
    """

    name = "tool_offset"
    summary = "constant error of the tool point"
    remedy = "Measure the tool point again, and check the seat of the tool."
    group = "tool"
    sigma = 100.0

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        # Where the instrument estimates points on the tool, this error is one of its parameters.
        if not any(group.startswith("point") for group in setup.layout.groups):
            yield cls()
