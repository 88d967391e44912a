"""Gears of an arm that do not yield in proportion to their load."""

from collections.abc import Iterable, Mapping
from typing import get_args

import equinox as eqx
import numpy as np

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .arm import Load, gravity_arms, stretched
from .base import Effect, Response, Setup
from .registry import register

_SHARPEST, _SOFTEST, _KNEES = 0.004, 1.5, 17
"""The knee is scanned between these shares of the reach, from 3 mm of an arm of 0.7 m on: below, it
is a step at no load; above, the departure is the cubic that it is at the upper end."""
_APART = 1e-3
"""Share of the arm, beside what is proportional to the other one, that makes two loads differ; of
the reach, by which an arm changes.
"""
_NO_LEVER_M = 1e-6
"""Arm that is none."""


@register
class GearWindUp(Effect):
    """A gear that yields more to the first part of a load than to the rest: teeth change flanks,
    then a soft and at last a stiff range (lost motion, torsional stiffness K1 < K2 < K3 of gears).

    Rotation about the axis by size g(a), over the lever arm a of the weight that the joint carries,

        g(a) = (tanh(a / knee) / tanh(L / knee) - a / L) / tanh(L / (2 knee))^2,

    its departure from the straight line through both ends +-L of the reach, 1/2 at half of it. A
    sharp one jumps from -size to size where the load changes sign, a soft one gets to half of that;
    what the knee amounts to where there is no reading takes nothing from what is known of the size.
    What is proportional is `joint_compliance`. The weight is that of masses which are alike in all
    joints behind and at the flange (`size_arm`), or at the flange alone (`size_tool`); a is that of
    their common centre, positive where the weight pulls the way in which the joint counts, and so
    is the size of a gear that yields to it. L is what a would be with all links behind the joint in
    one level line across its axis. A knee far below the arms that occur is backlash that gravity
    takes up, one beyond them a stiffness that grows with the square of the load.
    """

    name = "gear_wind_up"
    summary = "gear of a joint that yields most to small loads: lost motion, soft wind-up"
    chain: Chain
    load: Load = eqx.field(static=True)
    reach: float = eqx.field(static=True)
    """L, m."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter(f"size_{self.load}", "urad", sigma=100.0),
            Parameter("knee", "mm", shape=True, coordinate="log"),
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return self.chain.axes

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        own = self.chain.axes.index(self.placement)
        return (*self.chain.axes[own : own + 2],)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        arm = gravity_arms(self.chain, plan, self.placement, self.load)
        xp, knee = namespace(shape["knee"]), shape["knee"]
        bent = xp.tanh(arm / knee) / xp.tanh(self.reach / knee) - arm / self.reach
        half = xp.tanh(0.5 * self.reach / knee)
        return {(f"EC{self.placement}", f"size_{self.load}"): bent / half**2}

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        del plan
        return {"knee": self.reach * np.geomspace(_SHARPEST, _SOFTEST, _KNEES)}

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind != "revolute":
                continue
            known: list[np.ndarray] = []
            for load in get_args(Load):
                arm = gravity_arms(setup.chain, setup.plan, joint.name, load)
                reach = stretched(setup.chain, setup.plan, joint.name, load)
                if np.ptp(arm) > max(_APART * reach, _NO_LEVER_M) and _differs(arm, known):
                    known.append(arm)
                    yield cls(chain=setup.chain, load=load, reach=reach, placement=joint.name)


def _differs(arm: np.ndarray, known: list[np.ndarray]) -> bool:
    """Whether an arm (n,) is in proportion to none of those that are known."""
    rest = (arm - other * (other @ arm) / (other @ other) for other in known)
    return all(np.linalg.norm(r) > _APART * np.linalg.norm(arm) for r in rest)
