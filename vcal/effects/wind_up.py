"""Gears of an arm whose compliance is not proportional to their load."""

from collections.abc import Iterable, Mapping
from typing import get_args

import equinox as eqx
import numpy as np

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from .arm import Load, gravity_arms, stretched
from .base import Effect, Setup
from .forms import OneAmplitude
from .registry import register

_SHARPEST, _SOFTEST, _KNEES = 0.004, 1.5, 17
"""The knee is scanned between these shares of the reach, from 3 mm for an arm of 0.7 m: below, the
departure is a step at zero load; above, it keeps the cubic form that it has at the upper end."""
_APART = 1e-3
"""Least part of a lever arm, as a share of it, that is not proportional to another one, so that the
two loads differ; and least change of a lever arm, as a share of the reach.
"""
_NO_LEVER_M = 1e-6
"""Changes of a lever arm below this are none."""


@register
class GearWindUp(OneAmplitude):
    """A gear that yields more to the first part of a load than to the rest: teeth change flanks,
    then follow a soft and a stiff range (lost motion, torsional stiffness K1 < K2 < K3 of gears).

    The joint rotates about its axis by size g(a), with a the lever arm of the weight that it
    carries::

        g(a) = (tanh(a / knee) / tanh(L / knee) - a / L) / tanh(L / (2 knee))^2

    This is the departure of the rotation from the straight line through both ends +-L of the reach;
    it is 1/2 at half of the reach. A sharp departure jumps from -size to size where the load
    changes sign, a soft one reaches half of that; so the size is well determined where the knee is
    not. The part in proportion to the load is `joint_compliance`. The weight is that of equal
    masses in all joints behind this one and at the flange (`size_arm`), or at the flange alone
    (`size_tool`); a is the lever arm of their common centre, positive where the weight pulls in the
    positive direction of the joint, and so is the size of a gear that yields to it. L is the value
    of a with all links behind the joint in one horizontal line across its axis. A knee far below
    the lever arms that occur is backlash that gravity takes up, one beyond them a stiffness that
    grows with the square of the load.
    """

    name = "gear_wind_up"
    summary = "gear of a joint that yields most to small loads: lost motion, soft wind-up"
    remedy = (
        "Check the play and the preload of the gear of the joint; a bidirectional or "
        "load-dependent compensation is needed."
    )
    chain: Chain
    load: Load = eqx.field(static=True)
    reach: float = eqx.field(static=True)
    """L, m."""

    @property
    def port(self) -> str:  # type: ignore[override]
        return f"EC{self.placement}"

    @property
    def size(self) -> Parameter:
        return Parameter(f"size_{self.load}", "urad", sigma=100.0)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (self.size, Parameter("knee", "mm", shape=True, coordinate="log"))

    @property
    def needs(self) -> tuple[str, ...]:
        return self.chain.axes

    @property
    def indicators(self) -> tuple[str, ...]:
        own = self.chain.axes.index(self.placement)
        return (*self.chain.axes[own : own + 2],)

    def factor(self, plan: Plan, shape: Mapping[str, Array]) -> Array:
        arm = gravity_arms(self.chain, plan, self.placement, self.load)
        xp, knee = namespace(shape["knee"]), shape["knee"]
        bent = xp.tanh(arm / knee) / xp.tanh(self.reach / knee) - arm / self.reach
        half = xp.tanh(0.5 * self.reach / knee)
        return bent / half**2

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
    """Whether a lever arm (n,) is proportional to none of the known ones."""
    rest = (arm - other * (other @ arm) / (other @ other) for other in known)
    return all(np.linalg.norm(r) > _APART * np.linalg.norm(arm) for r in rest)
