"""The nine influences of the budget as effects, each as what it is: common to a run, or not.

The publication adds up nine standard uncertainties and takes the sum for independent noise of every
reading. Most of them are one number per run: the head's temperature, its coefficient of expansion,
the frame's growth, the repeatability of the tool interface, the gradient of the air, the linearity
of the diode. What they have in common goes into the frame's unknown pose, or into an error.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...distributions import Normal, Uniform
from ...effects.base import Effect
from ...effects.laser_frame import (
    FilterRefraction,
    FrameExpansion,
    HeadExpansion,
    HeadTemperature,
    PsdLinearity,
    PsdResolution,
    Refraction,
    ToolInterface,
)
from ...machine.parameters import Prior
from ...machine.plan import Plan
from .budget import Facts, refraction
from .setting import HEAD_K, TRAVEL, Layout, ReadingNoise, way_of_light

GRADIENT = 0.7
"""Of the air's temperature, K/m."""


def influences(
    layout: Layout, factor: float = 2.0, facts: Facts | None = None
) -> dict[str, tuple[Effect, ...]]:
    """Effects by the name of the influence in the publication's Table 3.

    `factor` as in `setting.reading_u`. The gradient is vertical, as warm air is above: it bends
    level beams, upwards or downwards, and not the upright one.
    """
    f = facts or Facts()

    def half(width: float) -> Uniform:
        return Uniform(-factor * width, factor * width)

    growth = f.frame * f.alpha * f.frame_change / HEAD_K
    frame = tuple(
        FrameExpansion(
            low=TRAVEL[axis][0],
            high=TRAVEL[axis][1],
            placement=axis,
            priors=(Prior("k", half(growth)),),
        )
        for axis in "XYZ"
    )
    interface = ToolInterface(
        priors=tuple(Prior(c, Normal(0.0, factor * f.rotational.u)) for c in "XYZ")
    )
    bend = 2.0 * f.deflection / GRADIENT
    repeated = np.full((layout.points, 2), factor * f.repeatability * 1e-6)
    return {
        "refraction in the filter": (
            FilterRefraction(priors=tuple(Prior(c, half(refraction(f))) for c in "uv")),
        ),
        "resolution": (PsdResolution(priors=tuple(Prior(c, half(f.resolution)) for c in "uv")),),
        "measuring frame": frame,
        "head: coefficient of expansion": (
            HeadExpansion(priors=(Prior("k", half(f.head * f.alpha_share * f.alpha)),)),
        ),
        "head: sensor and measuring chain": (
            HeadTemperature(
                growth=f.head * f.alpha,
                priors=(Prior("sensor", half(f.sensor)), Prior("chain", half(f.chain))),
            ),
        ),
        "tool interface": (interface,),
        "deflection of the beam": (Refraction(priors=(Prior("c", Normal(0.0, factor * bend)),)),),
        "diode and measuring chain": (
            *(
                PsdLinearity(
                    placement=c, given=(("b", 0.0, 0.0),), priors=(Prior("a", half(slope(f))),)
                )
                for c in "uv"
            ),
            ReadingNoise(repeated),
        ),
    }


def slope(facts: Facts) -> float:
    """Half-width of the diode's error over the place on it, um/mm."""
    return facts.linearity * 1e3


def under_conditions(plan: Plan, layout: Layout) -> Plan:
    """A plan with what the influences need: temperatures, and the light's way with the legs."""
    path = 1e3 * np.concatenate(way_of_light(layout.segments, layout.shares))
    added: Mapping[str, np.ndarray] = {
        "T_head": np.full(plan.rows, 20.0 + HEAD_K),
        "T_gradient_z_K_per_m": np.full(plan.rows, GRADIENT),
        "path_mm": path,
    }
    return replace(plan, covariates={**plan.covariates, **added})
