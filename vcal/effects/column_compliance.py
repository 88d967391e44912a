"""A column that bends under the moment of what it carries."""

from collections.abc import Iterable, Mapping
from typing import Any, Literal

import equinox as eqx
import numpy as np

from ..machine.chain import Chain
from ..numerics.arrays import Array, namespace
from .base import Effect, Setup
from .carried import Carried, GravityTilt, carried, carriers, moments
from .registry import register

_UPRIGHT = 0.9
"""Least vertical part of the direction of a column."""
Clamp = tuple[float, Literal[-1, 1], bool]
"""Position of the clamp along the axis from the end of the link before, m; the sense along the axis
in which the column extends from it; and whether it is a ram that hangs.
"""
_FOOT: Clamp = (0.0, 1, False)


@register
class ColumnCompliance(GravityTilt):
    """A column, clamped at one end, bends under the moment of what it carries: a cantilever with a
    moment at its free end.

    Equations, with h the distance of the end of the joint's link from the clamp (m), E I the
    bending stiffness (N m^2), M = sum_k G_k (c_k - p) x g the moment of the unknown weights G_k at
    the places c_k about the free end p, and u the direction from the clamp to p:

    tilt of the free end w = M h / (E I); displacement of the free end d = (w x u) h / 2, that is
    M h^2 / (2 E I).

    The column of an arm is clamped at the end of the link before it. That of a machine tool is
    clamped at the low end of the travel or, as a ram that hangs, at the high end.

    Parameters are the rms tilts of the free end due to independent patterns of h M, in urad:
    ``tilt1``, ... where the stiffness is equal about all horizontal axes, ``about_x1``,
    ``about_y1``, ... where it differs; those of a ram that hangs start with ``hanging``. A tilt of
    the foot that does not grow with the height is `base_compliance`.

    Source: Euler-Bernoulli beam theory, the cantilever with an end moment.
    """

    name = "column_compliance"
    summary = "bending of a column under the moment of what it carries"
    remedy = (
        "Check the joint between column and base, and the counterweight; reduce what the column "
        "carries, or compensate by position."
    )
    usual = 200.0
    amount_unit = "urad/m^2"
    clamp: Clamp = eqx.field(static=True, default=_FOOT)

    @property
    def more(self) -> Mapping[str, Any]:
        return {"clamp": self.clamp}

    @property
    def prefix(self) -> str:
        return "hanging" if self.clamp[2] else ""

    @classmethod
    def load(cls, chain: Chain, it: Carried, *, clamp: Clamp = _FOOT, **more: Any) -> Array:
        return _height(it, clamp)[:, None, None] * moments(chain, it, it.end)

    def moved(self, it: Carried, tilt: Array) -> tuple[Array, Array]:
        away = self.clamp[1] * _height(it, self.clamp)[:, None] * it.axis
        return it.end, 0.5 * namespace(tilt).cross(tilt, away)

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        chain = setup.chain
        still = np.zeros((1, len(chain.axes)))
        for joint in carriers(chain):
            it = carried(chain, still, joint.name)
            rises = float(it.axis[0] @ np.asarray(chain.up))
            if abs(rises) < _UPRIGHT:
                continue
            low, high = (float(v) for v in joint.travel)
            clamps = [_FOOT]
            if not chain.arm:
                ends: list[Clamp] = [(low, 1, rises < 0.0), (high, -1, rises > 0.0)]
                clamps = ends if np.isfinite([low, high]).all() else []
            for clamp in clamps:
                yield from cls.at(setup, joint.name, joint.name, clamp=clamp)


def _height(it: Carried, clamp: Clamp) -> Array:
    """Distance (n,), m, of the end of the link from the clamp."""
    xp = namespace(it.end)
    return xp.abs(((it.end - it.start) * it.axis).sum(1) - clamp[0])
