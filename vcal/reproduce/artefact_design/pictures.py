"""The pictures of the page, each with a caption that says what to see in it."""

import numpy as np

from ...report import Picture
from ..registry import Pictures, picture
from . import plots
from .results import PLACES, SHOWN, Results, nominal_poses
from .setting import BALLS, KNOWN, NOMINAL, OFFSETS, TRAVEL, Known
from .sweep import Varied
from .timing import NOMINAL_S

_SWEEPS: dict[Varied, tuple[str, str, str]] = {
    "N": ("number of balls", "balls", "Fig. 8"),
    "a": ("horizontal offset a", "a, mm", "Fig. 10"),
    "b": ("vertical offset b", "b, mm", "Fig. 11"),
}
_SHORT = {
    "poses": "poses",
    "60 mm": "poses, balls within 60 mm",
    "250 mm": "poses, artefact within 250 mm",
}
"""What was searched, by a name for which there is room."""


def pictures(results: Results) -> Pictures:
    """All pictures by the section they belong to."""
    return {
        "family": _family(results),
        "sweeps": _sweeps(results),
        "influences": _influences(results),
        "searched": _searched(results),
        "time": _time(results),
        "star": _star(results),
    }


def _family(r: Results) -> tuple[Picture, ...]:
    nominal = r.exact["S"]["N", 11]
    return (
        picture(
            "family",
            plots.functions(1e3 * np.linspace(*TRAVEL["X"], PLACES), r.functions, nominal.before),
            f"Left: EXX of {SHOWN} machines (the publication's Fig. 4). Right: error of "
            f"{r.draws} machines at points of the grid, after rigid alignment (its Fig. 5).",
        ),
    )


def _sweeps(r: Results) -> tuple[Picture, ...]:
    nominal = r.exact["S"]["N", 11]
    return (
        *(_sweep(r, varied) for varied in _SWEEPS),
        picture(
            "distributions",
            plots.distributions(
                nominal.before,
                {f"{n} balls": r.exact["S"]["N", n].after for n in (5, 11, 17)},
            ),
            f"Error at single points of {r.draws} machines, before and after compensation "
            "(Fig. 9), artefact S.",
        ),
    )


def _influences(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "influences",
            plots.bars(
                {
                    "ignored": {n: c.ignored for n, c in r.costs["S"].items()},
                    "identified": {n: c.identified for n, c in r.costs["S"].items()},
                },
                "Influences in the truth, artefact S",
                dots={n: {"all": one.rms} for n, one in r.influenced.items()},
                width=10.5,
            ),
            "Expected error after compensation with one influence in the truth, and with all.",
        ),
    )


def _searched(r: Results) -> tuple[Picture, ...]:
    return _gains(r), _artefacts(r), _poses(r)


def _gains(r: Results) -> Picture:
    found = {
        short: {k: r.searched[k][name].optimised.rms_um for k in KNOWN}
        for short, name in _SHORT.items()
    }
    checked = {
        short: {k: r.searched[k][name].checked.rms for k in KNOWN} for short, name in _SHORT.items()
    }
    return picture(
        "gains",
        plots.bars(
            {"nominal": {k: r.theory[k]["N", 11].aligned for k in KNOWN}, **found},
            "Twelve poses of eleven balls, searched by gradient",
            dots={"nominal": {k: r.nominal[k].rms for k in KNOWN}, **checked},
        ),
        f"Bars: theory. Dots: {r.fresh} fresh machines with exact kinematics that the "
        "search never saw.",
    )


def _artefacts(r: Results) -> Picture:
    found = {
        f"found for {k}, {short}": np.asarray(r.searched[k][_SHORT[short]].optimised.poses.balls)
        for k in ("S", "P")
        for short in ("60 mm", "250 mm")
    }
    return picture(
        "artefacts",
        plots.artefacts({"nominal": np.asarray(nominal_poses().balls), **found}),
        "Balls of the artefacts, from above (left) and from the side, 1500 mm long.",
    )


def _poses(r: Results) -> Picture:
    found = r.searched["S"][_SHORT["60 mm"]].optimised.poses
    return picture(
        "poses",
        plots.poses({"nominal": nominal_poses(), "found for S, 60 mm": found}),
        "The artefact in its twelve poses, in the work space of the tool point.",
    )


def _time(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "time",
            plots.front(
                {
                    k: [
                        (d.seconds / 3600.0, d.rms_um, f"{d.count} x {d.balls}")
                        for d in r.trade[k].front
                    ]
                    for k in KNOWN
                },
                {k: (NOMINAL_S / 3600.0, r.trade[k].nominal_um) for k in KNOWN},
            ),
            "Designs that no other one beats in both, poses x balls at the line of P;"
            " the others have the same. Crosses: the nominal one.",
        ),
    )


def _star(r: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "star",
            plots.bars(
                {
                    "one straight stylus": {k: r.star[k].straight for k in KNOWN},
                    "straight and to the side": {k: r.star[k].alternating for k in KNOWN},
                    "tips and poses searched": {k: r.star[k].found for k in KNOWN},
                },
                "A star stylus, equal touches",
                width=8.2,
                legend=2.3,
            ),
            "Expected error. First two: the nominal poses.",
        ),
    )


def _sweep(r: Results, varied: Varied) -> Picture:
    title, label, figure = _SWEEPS[varied]
    values = BALLS if varied == "N" else OFFSETS
    factor = 1.0 if varied == "N" else 1e3
    machines: dict[Known, tuple[list[float], list[float]]] = {}
    for known in KNOWN:
        own = [v for v in values if (varied, v) in r.exact[known]]
        machines[known] = (
            [factor * v for v in own],
            [r.exact[known][varied, v].rms for v in own],
        )
    return picture(
        f"sweep_{varied}",
        plots.sweep(
            f"Error and {title}",
            label,
            [factor * v for v in values],
            {k: [r.theory[k][varied, v].aligned for v in values] for k in KNOWN},
            machines,
            [r.theory["S"][varied, v].plain.aligned_um for v in values],
        ),
        f"The publication's {figure}: N = {NOMINAL[0]}, a = b = {1e3 * NOMINAL[1]:g} mm but for "
        f"what varies. Lines: theory. Dots: {r.draws} machines. Least squares: the best order of "
        "1 to 5, artefact S.",
    )
