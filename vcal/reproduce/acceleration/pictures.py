"""The pictures of the page, each with a caption that says what to see in it."""

import numpy as np

from ...plots.style import AFTER, BEFORE
from ...report import Picture
from ..registry import Pictures, picture
from . import plots
from .results import Results, element, true_z
from .setting import MEASURED_M_S2, SIMULATED_M_S2

_MAGNIFICATION = 60.0


def pictures(results: Results) -> Pictures:
    """All pictures by the section they belong to."""
    return {
        "circles": _circles(results),
        "evaluations": _evaluations(results),
        "identified": _identified(results),
        "moves": _moves(results),
        "campaign": _campaign(results),
    }


def _circles(r: Results) -> tuple[Picture, ...]:
    tests = {"measured": r.measured, "simulated": r.simulated}
    return (
        picture(
            "crosstalk_measured",
            plots.across(r.measured, MEASURED_M_S2, BEFORE),
            "Circle in YZ seen along Y, measured (the publication's Fig. 4): the tool point "
            "leaves the plane in proportion to the acceleration of Z.",
        ),
        picture(
            "crosstalk_simulated",
            plots.across(r.simulated, SIMULATED_M_S2, AFTER),
            "The same by the catalogue's machine (its Fig. 7).",
        ),
        picture(
            "intalk",
            plots.within(tests, (MEASURED_M_S2, SIMULATED_M_S2), _MAGNIFICATION),
            "Circles in ZX, deviations from the mean internal circle × "
            f"{_MAGNIFICATION:g} (its Figs. 5 and 8). In-talk makes an ellipse of the external "
            "circle, cross-talk tilts it; an even ellipse alone does not follow.",
        ),
    )


def _evaluations(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "dispersion",
            plots.dispersion(r.measured, r.joint.matrix),
            "Left: how far the elements from single circles are from those of all circles at "
            "once; it falls with the acceleration (the publication's section 2.4). Right: the "
            "radius that the axes really travel; who evaluates with nominal accelerations "
            "scales the matrix by it.",
        ),
    )


def _identified(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "identified",
            plots.intervals(r.found, true_z()),
            "What the catalogue leaves open and what the circles say, each with k = 2.",
        ),
    )


def _moves(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "positioning",
            plots.positioning(r.catalogue.move, element(r.catalogue.matrix, "XZ")),
            "20 mm along Z by the catalogue's machine (its Fig. 9).",
        ),
        picture(
            "foretold",
            plots.foretold(
                {
                    "catalogue": r.catalogue.move,
                    "machine that is measured": r.true.move,
                    "identified from circles": r.identified.move,
                }
            ),
            "The same move by three machines. The identification saw circles alone.",
        ),
        picture(
            "left_over",
            plots.left_over({"E from circles": r.by_circles, "E of the\nmachine": r.by_machine}),
            "What compensation with the matrix leaves of movements that no circle resembles.",
        ),
    )


def _campaign(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "pulls",
            plots.pulls(r.campaign),
            f"Errors of {int(np.sum(r.campaign.converged))} identified machines over their "
            "standard uncertainties. Within the band lie 95 % of a normal distribution.",
        ),
    )
