"""The pictures of the page, each with a caption that says what to see in it."""

import numpy as np

from ...plots import png
from ...report import Picture
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


def pictures(results: Results) -> dict[str, tuple[Picture, ...]]:
    """All pictures by the section they belong to."""
    r = results
    nominal = r.exact["S"]["N", 11]
    best = r.searched["S"]
    names = {
        "poses": "poses",
        "60 mm": "poses, balls within 60 mm",
        "250 mm": "poses, artefact within 250 mm",
    }
    return {
        "family": (
            _picture(
                "family",
                plots.functions(
                    1e3 * np.linspace(*TRAVEL["X"], PLACES), r.functions, nominal.before
                ),
                f"Left: EXX of {SHOWN} machines (the publication's Fig. 4). Right: error of "
                f"{r.draws} machines at points of the grid, after rigid alignment (its Fig. 5).",
            ),
        ),
        "sweeps": (
            *(_sweep(r, varied) for varied in _SWEEPS),
            _picture(
                "distributions",
                plots.distributions(
                    nominal.before,
                    {f"{n} balls": r.exact["S"]["N", n].after for n in (5, 11, 17)},
                ),
                f"Error at single points of {r.draws} machines, before and after compensation "
                "(Fig. 9), artefact S.",
            ),
        ),
        "influences": (
            _picture(
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
        ),
        "searched": (
            _picture(
                "gains",
                plots.bars(
                    {
                        "nominal": {k: r.theory[k]["N", 11].aligned for k in KNOWN},
                        **{
                            short: {k: r.searched[k][n].optimised.rms_um for k in KNOWN}
                            for short, n in names.items()
                        },
                    },
                    "Twelve poses of eleven balls, searched by gradient",
                    dots={
                        "nominal": {k: r.nominal[k].rms for k in KNOWN},
                        **{
                            short: {k: r.searched[k][n].checked.rms for k in KNOWN}
                            for short, n in names.items()
                        },
                    },
                ),
                f"Bars: theory. Dots: {r.fresh} fresh machines with exact kinematics that the "
                "search never saw.",
            ),
            _picture(
                "artefacts",
                plots.artefacts(
                    {
                        "nominal": np.asarray(nominal_poses().balls),
                        **{
                            f"found for {k}, {short}": np.asarray(
                                r.searched[k][names[short]].optimised.poses.balls
                            )
                            for k in ("S", "P")
                            for short in ("60 mm", "250 mm")
                        },
                    }
                ),
                "Balls of the artefacts, from above (left) and from the side, 1500 mm long.",
            ),
            _picture(
                "poses",
                plots.poses(
                    {
                        "nominal": nominal_poses(),
                        "found for S, 60 mm": best[names["60 mm"]].optimised.poses,
                    }
                ),
                "The artefact in its twelve poses, in the work space of the tool point.",
            ),
        ),
        "time": (
            _picture(
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
        ),
        "star": (
            _picture(
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
        ),
    }


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
    return _picture(
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


def _picture(name: str, drawn, caption: str) -> Picture:
    return Picture(name, "", caption, png(drawn))
