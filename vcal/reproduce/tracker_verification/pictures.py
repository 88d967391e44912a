"""The pictures of the page, each with a caption that says what to see in it."""

from ...report import Picture
from ..registry import Pictures, picture
from . import plots
from .results import Results
from .setting import FINAL_UM, INITIAL_UM


def pictures(results: Results) -> Pictures:
    """All pictures by the section they belong to."""
    return {
        "rank": _rank(results),
        "initial": _initial(results),
        "final": _final(results),
        "gum": _gum(results),
        "influences": _influences(results),
        "probing": _probing(results),
    }


def _rank(results: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "rank",
            plots.singular_values(results.rank),
            "Singular values of the whitened Jacobian, in prior standard deviations of the "
            "machines per standard deviation of the readings. Above the dashed line the data "
            "say more than the family did; triangles are directions that change no reading.",
        ),
    )


def _initial(results: Results) -> tuple[Picture, ...]:
    few, many = (next(iter(t.values())) for t in (results.few, results.many))
    campaigns = {f"{t.ensemble.draws} tests": t for t in (many, few)}
    return (
        picture(
            "initial_error",
            plots.histograms("initial", campaigns, INITIAL_UM[0]),
            "Initial error of all points and tests (the publication's Fig. 5).",
        ),
    )


def _final(results: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "final_error",
            plots.histograms("residual", results.many, FINAL_UM[0]),
            "Residual of the readings after identification (the publication's Fig. 6), for "
            "three readings of the printed noise.",
        ),
        picture(
            "error_left",
            plots.histograms("left", results.many, None),
            "Error that is really left, true less predicted tool point, on the same tests: "
            "smaller than the residual, since the tracker's noise averages out over the points "
            "and is no error of the machine.",
        ),
    )


def _gum(results: Results) -> tuple[Picture, ...]:
    one, rungs = next(iter(results.rungs.values())), results.rungs
    corner, centre = one.lengths[0].label, one.lengths[len(one.lengths) // 2].label
    return (
        picture(
            "gum_monte_carlo",
            plots.agreement(rungs),
            "Standard uncertainty of the Monte Carlo over that of the GUM, for error motions "
            "at three positions of their axis and components of the error at the points. Band: "
            "two standard deviations of the Monte Carlo's own scatter about one.",
        ),
        picture(
            "lengths",
            plots.lengths(one, (corner, centre)),
            "Length of the error left at a corner and in the middle. The GUM gives no "
            "uncertainty for the length itself; the line is the length of a normal vector with "
            "the covariance that the GUM gives for the components.",
        ),
    )


def _influences(results: Results) -> tuple[Picture, ...]:
    bars = [
        (name, t.pooled["left", "distance"].mean, t.pooled["aligned", "distance"].mean)
        for name, t in results.influences.items()
    ]
    return (
        picture(
            "influences",
            plots.bars(bars),
            "Mean error left with what the publication names and leaves out; assumed sizes.",
        ),
    )


def _probing(results: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "probing",
            plots.maps(results.probing),
            "Expanded uncertainty of the coordinates of a probed point over the area.",
        ),
    )
