"""The publication's Monte Carlo: errors drawn, measured along the beams, identified, many times.

Every cycle draws a machine (or none, for the noise alone), the noise of all readings by the budget,
and identifies; the readings are also evaluated beam by beam where the path allows it. The results
are compared with what was drawn.

The publication adds nine standard uncertainties and takes the sum for independent noise of every
reading. `influences` are the same nine as effects. Most of them are one number per run: the head's
temperature, its coefficient of expansion, the frame's growth, the repeatability of the tool
interface, the gradient of the air, the linearity of the diode. Their common part goes into the
frame's unknown pose, or into an error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

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
from ...model.forward import Model
from ...uncertainty import Campaign, monte_carlo
from .budget import Facts, refraction
from .defined import Asked, LinearErrors
from .recipe import Lever, largest, recipe
from .setting import (
    HEAD_K,
    OTHERS,
    THIRTEEN,
    TRAVEL,
    WIDE_M,
    Layout,
    ReadingNoise,
    errors,
    frame_setup,
    sizes,
    way_of_light,
)

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


Machine = Literal["none", "thirteen", "all"]
"""What is drawn: no errors at all, the thirteen, or all twenty-one."""
Fitted = Literal["thirteen", "thirteen with prior", "all with prior"]
"""What is identified, and whether the sizes of the family are its prior; the first is least
squares.
"""
_COVERAGE = 2.0


@dataclass(frozen=True)
class Cycles:
    """Results of a campaign; expanded uncertainties k = 2, angles times their lever, um."""

    campaign: Campaign
    identified: dict[str, float]
    """Largest along the axis of every error, by the identification."""
    by_beams: dict[str, float] | None
    """The same by the evaluation beam by beam."""
    tool: Float[np.ndarray, "places 3"]
    """Of the tool's displacement by the thirteen, at places of the volume, by the identification.
    """
    tool_by_beams: Float[np.ndarray, "places 3"] | None


def cycles(
    layout: Layout | str,
    machine: Machine,
    fitted: Fitted,
    *,
    draws: int,
    seed: int,
    effects: Sequence[Effect] | None = None,
    lever: Lever | None = None,
) -> Cycles:
    """Run a campaign on a layout of the beams, or a named path with its points evenly spaced.

    `effects` take the place of independent noise in the truth; the identification assumes the
    noise of the budget to be independent nevertheless.
    """
    flat = layout == "planar"
    layout = Layout.named(layout) if isinstance(layout, str) else layout
    chain, instrument, plan = frame_setup(layout, sigma_m=0.0)
    plan = under_conditions(plan, layout)
    lever = lever or Lever.seen()
    drawn = {"none": (), "thirteen": THIRTEEN, "all": (*THIRTEEN, *OTHERS)}[machine]
    truth_errors = (errors(chain, drawn, sizes()),) if drawn else ()
    own = ReadingNoise(layout.u())
    truth = Model(chain, instrument, (*truth_errors, *((own,) if effects is None else effects)))
    asked = (*THIRTEEN, *OTHERS) if fitted == "all with prior" else THIRTEEN
    wide = {str(name): WIDE_M for name in THIRTEEN}
    prior = wide if fitted == "thirteen" else sizes()
    fit = Model(chain, instrument, (errors(chain, asked, prior), *instrument.effects(plan), own))
    usual = Asked.usual()
    true, found = usual.of(truth), usual.of(fit)
    quantities = [
        LinearErrors("errors", true, found),
        LinearErrors("tool", usual.tool(chain, true), usual.tool(chain, found)),
    ]
    evaluation = recipe(layout.segments) if flat else None
    if evaluation is not None:
        at, matrix = Asked.by(evaluation), evaluation.matrix
        # The straightness of the first beam along X is that of its line, which lies at its Y.
        real = at.of(truth, {"EZX": ("EAX", layout.segments[1].start[1])})
        quantities += [
            LinearErrors("errors by beams", real, readings=matrix),
            LinearErrors("tool by beams", at.tool(chain, real), readings=at.tool(chain, matrix)),
        ]
    campaign = monte_carlo(truth, fit, plan, draws=draws, seed=seed, quantities=quantities)

    def U(name: str) -> np.ndarray:
        return _COVERAGE * campaign.ensemble.fields[name].u

    return Cycles(
        campaign=campaign,
        identified=largest(usual.names, 1e-6 * U("errors"), lever),
        by_beams=None
        if evaluation is None
        else largest(evaluation.names, 1e-6 * U("errors by beams"), lever),
        tool=U("tool").reshape(-1, 3),
        tool_by_beams=None if evaluation is None else U("tool by beams").reshape(-1, 3),
    )
