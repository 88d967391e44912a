"""An arm's base that yields to the moment of the arm's weight."""

from collections.abc import Iterable
from typing import Any

from ..machine.chain import Chain
from ..numerics.arrays import Array, namespace
from .base import Effect, Setup
from .carried import Carried, GravityTilt, moments
from .registry import register


@register
class BaseCompliance(GravityTilt):
    """The base of an arm, with all that stands on it, tilts in proportion to the moment of the
    arm's weight.

    Equation: w = C sum_k G_k (c_k - b) x g, with w the rotation vector of the base (rad) about its
    foot b, g the unit vector of gravity, c_k the places of the unknown weights G_k behind the base,
    and C the compliance about the two horizontal axes of the base (rad/(N m)), equal or not. A
    point p of the arm is displaced by w x (p - b).

    Parameters are the rms tilts due to independent patterns of this moment, in urad: ``tilt1``, ...
    where the compliance is equal about all horizontal axes, ``about_x1``, ``about_y1``, ... where
    it differs. A compliance that is equal about all axes cannot be distinguished from
    `bearing_compliance` of a vertical first joint.

    Source: Hooke's law for the mounting of the base.
    """

    name = "base_compliance"
    summary = "tilt of an arm's base under the moment of the arm's weight"
    remedy = (
        "Tighten the bolts of the base, check the plate under it and the floor; stiffen them, or "
        "compensate by the control's gravity model."
    )
    usual = 200.0

    @classmethod
    def load(cls, chain: Chain, it: Carried, **more: Any) -> Array:
        return moments(chain, it, it.start)

    def moved(self, it: Carried, tilt: Array) -> tuple[Array, Array]:
        return it.start, namespace(tilt).zeros_like(tilt)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        # Where the workpiece stands on the same bed, nothing measures the bed's tilt.
        chain = setup.chain
        if chain.arm and not chain.workpiece_side:
            yield from cls.at(setup, chain.axes[chain.tool_side[0]], "")
