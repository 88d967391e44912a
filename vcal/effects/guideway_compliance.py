"""A guideway that yields to the lever arm of the slides that it carries."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .carried import Carried, GravityTilt, carried, carriers, moments
from .registry import register

_SAG_UM = 20.0


@register
class GuidewayCompliance(GravityTilt):
    """The carriage of a linear axis tilts and sinks in proportion to the lever arm of the weight of
    a heavy slide, or of an arm, that it carries.

    Equations, with M = sum_k G_k (c_k - o) x g the moment of the unknown weights G_k at the places
    c_k about the origin o of the carriage: tilt w = M / k with the angular stiffness k of the
    guideway (N m/rad), as rotation about o; and a displacement z = b M_l along the vertical, with
    M_l the part of M along its main direction, where o is not the centre of the stiffness. With X
    carried by Y, both are proportional to the position of X.

    Parameters: the rms tilt due to every independent pattern of M, in urad (``tilt1``, or
    ``about_x1`` and ``about_y1`` where the stiffness differs between two horizontal axes), and the
    rms vertical displacement due to the strongest one, in um (``sag``). A stiffness that changes
    along the guideway is `cross_axis`. Error motions of the carried axis itself may describe the
    same: what they span is not attributed to the guideway.

    Source: linear elasticity; ISO 230-1:2012, 3.4 for the error motions, which act at the carriage.
    """

    name = "guideway_compliance"
    summary = "tilt and sag of an axis in proportion to the lever arm of the weight it carries"
    remedy = (
        "Check the preload of the guideway carriages and the load they carry; compensate by "
        "position."
    )
    usual = 50.0

    @classmethod
    def load(cls, chain: Chain, it: Carried, **more: Any) -> Array:
        return moments(chain, it, it.origin)

    def moved(self, it: Carried, tilt: Array) -> tuple[Array, Array]:
        return it.origin, namespace(tilt).zeros_like(tilt)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*super().parameters, Parameter("sag", "um", sigma=_SAG_UM))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        found = dict(super().response(plan, shape))
        it = carried(self.chain, plan.position, self.joint)
        xp = namespace(it.origin)
        up = xp.einsum("nba,b->na", it.frame, np.array(self.chain.up))
        load, patterns = self.load(self.chain, it), self.patterns
        lever = xp.einsum("nkc,k,c->n", load, patterns.weights[:, 0], patterns.main[0])
        for k, letter in enumerate("XYZ"):
            found[f"E{letter}{self.joint}", "sag"] = up[:, k] * lever
        return found

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in carriers(setup.chain):
            yield from cls.at(setup, joint.name, joint.name)
