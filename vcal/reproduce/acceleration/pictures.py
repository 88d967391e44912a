"""The pictures of the page, each with a caption that says what to see in it."""

import numpy as np

from ...plots import png
from ...plots.style import AFTER, BEFORE
from ...report import Picture
from . import plots
from .results import Results, element, true_z
from .setting import MEASURED_M_S2, SIMULATED_M_S2

_MAGNIFICATION = 60.0


def pictures(results: Results) -> dict[str, tuple[Picture, ...]]:
    """All pictures by the section they belong to."""
    r = results
    tests = {"measured": r.measured, "simulated": r.simulated}
    return {
        "circles": (
            _picture(
                "crosstalk_measured",
                plots.across(r.measured, MEASURED_M_S2, BEFORE),
                "Circle in YZ seen along Y, measured (the publication's Fig. 4): the tool point "
                "leaves the plane in proportion to the acceleration of Z.",
            ),
            _picture(
                "crosstalk_simulated",
                plots.across(r.simulated, SIMULATED_M_S2, AFTER),
                "The same by the catalogue's machine (its Fig. 7).",
            ),
            _picture(
                "intalk",
                plots.within(tests, (MEASURED_M_S2, SIMULATED_M_S2), _MAGNIFICATION),
                "Circles in ZX, deviations from the mean internal circle × "
                f"{_MAGNIFICATION:g} (its Figs. 5 and 8). In-talk makes an ellipse of the external "
                "circle, cross-talk tilts it; an even ellipse alone does not follow.",
            ),
        ),
        "evaluations": (
            _picture(
                "dispersion",
                plots.dispersion(r.measured, r.joint.matrix),
                "Left: how far the elements from single circles are from those of all circles at "
                "once; it falls with the acceleration (the publication's section 2.4). Right: the "
                "radius that the axes really travel; who evaluates with nominal accelerations "
                "scales the matrix by it.",
            ),
        ),
        "identified": (
            _picture(
                "identified",
                plots.intervals(r.found, true_z()),
                "What the catalogue leaves open and what the circles say, each with k = 2.",
            ),
        ),
        "moves": (
            _picture(
                "positioning",
                plots.positioning(r.catalogue.move, element(r.catalogue.matrix, "XZ")),
                "20 mm along Z by the catalogue's machine (its Fig. 9).",
            ),
            _picture(
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
            _picture(
                "left_over",
                plots.left_over(
                    {"E from circles": r.by_circles, "E of the\nmachine": r.by_machine}
                ),
                "What compensation with the matrix leaves of movements that no circle resembles.",
            ),
        ),
        "campaign": (
            _picture(
                "pulls",
                plots.pulls(r.campaign),
                f"Errors of {int(np.sum(r.campaign.converged))} identified machines over their "
                "standard uncertainties. Within the band lie 95 % of a normal distribution.",
            ),
        ),
    }


def _picture(name: str, drawn, caption: str) -> Picture:
    return Picture(name, "", caption, png(drawn))
