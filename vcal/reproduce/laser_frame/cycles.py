"""The publication's Monte Carlo: errors drawn, measured along the beams, identified, many times.

Every cycle draws a machine (or none, for the noise alone), the noise of all readings by the budget,
and identifies; besides, the readings are evaluated beam by beam where the path allows it. What
comes out is compared with what was drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ...effects.base import Effect
from ...model.forward import Model
from ...uncertainty import Campaign, monte_carlo
from .defined import Asked, LinearErrors
from .influences import under_conditions
from .recipe import Lever, largest, recipe
from .setting import OTHERS, THIRTEEN, WIDE_M, Layout, ReadingNoise, errors, frame_setup, sizes

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

    `effects` are there beside the errors instead of independent noise; the identification takes
    the noise of the budget for independent all the same.
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
