"""The pictures of the page, each with a caption that says what to see in it."""

import numpy as np

from ...report import Picture
from ..registry import Pictures, picture
from . import plots
from .budget import point_parts
from .results import Results
from .setting import ROTATION_URAD, TRANSLATION_UM, Layout, way_of_light
from .table_four import exchanged


def pictures(results: Results) -> Pictures:
    """All pictures by the section they belong to."""
    return {
        "seen": _seen(results),
        "budget": _budget(results),
        "cycles": _cycles(results),
        "influences": _influences(results),
        "verification": _verification(results),
        "better": _better(results),
    }


def _seen(results: Results) -> tuple[Picture, ...]:
    flat, three, best = Layout.named("planar"), Layout.named("3d"), results.better.steps[-2]
    return (
        picture(
            "beams",
            plots.beams({"“3d”": three, "“planar”": flat, "found": best.layout}),
            "Beam paths with their 51 points, in the work space of the axes. The light starts "
            "at the square. Right: the path and the places found below.",
        ),
        picture(
            "bias",
            plots.bars(
                {name: one.bias for name, one in list(results.seen.items())[:1]},
                "Bias by the eight that are taken for zero",
                value="standard deviation, µm or µrad",
            ),
            "Path “3d”: standard deviation that the other eight errors put on the thirteen, "
            f"in µm and µrad, if every coefficient of theirs has {TRANSLATION_UM:g} µm or "
            f"{ROTATION_URAD:.0f} µrad.",
        ),
    )


def _budget(results: Results) -> tuple[Picture, ...]:
    light, parts, cuts = _along(Layout.named("planar"))
    return (
        picture(
            "budget",
            plots.along_the_beam(light, parts, cuts),
            "Variance of a reading, influence on influence, along the path “planar”, first "
            "reading. Dotted: pentaprisms. The diode's part grows from the middle of a "
            "segment to its ends, the beam's deflection with the light's whole way.",
        ),
    )


def _cycles(results: Results) -> tuple[Picture, ...]:
    noise, everything = (results.cycles[f"planar, {n}"] for n in ("noise", "all errors"))
    assert noise.by_beams is not None and everything.by_beams is not None
    return (
        picture(
            "table_four",
            plots.bars(
                {
                    "printed, EXZ and EZY exchanged": exchanged(),
                    "noise alone": noise.by_beams,
                    "with all 21 errors": everything.by_beams,
                },
                "Table 4: path “planar”, beam by beam",
                log=True,
            ),
            "Expanded uncertainties of the thirteen, angles times the lengths said below.",
        ),
    )


def _influences(results: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "influences",
            plots.bars(
                {
                    "independent noise": results.cycles["3d, noise"].identified,
                    "as effects of a run": results.as_effects["3d"].identified,
                },
                "The nine influences, path “3d”, least squares",
            ),
            "What the influences do to the thirteen if they are what they are: most of them "
            "are one number per run.",
        ),
    )


def _verification(results: Results) -> tuple[Picture, ...]:
    return (
        picture(
            "second_device",
            plots.second_device(results.verification.agreements),
            "Change between two runs as the laser frame saw it, less that of the second "
            "device, for three of the repeats (the publication's Fig. 4). Band: 3 µm.",
        ),
    )


def _better(results: Results) -> tuple[Picture, ...]:
    steps = results.better.steps
    return (
        picture(
            "better",
            plots.bars(
                {
                    "evenly, “3d”": results.checked[steps[0].freedom].identified,
                    "places, beams and path found": results.checked[steps[-2].freedom].identified,
                    "and a sixth beam": results.checked[steps[-1].freedom].identified,
                },
                "51 points better placed (Monte Carlo)",
            ),
            "Least squares on all three; angles as in Table 4. The largest is what was "
            "minimised: at the end several are equally large.",
        ),
    )


def _along(layout: Layout) -> tuple[np.ndarray, dict[str, np.ndarray], list[float]]:
    """Way of the light, parts of the budget in the first reading, and places of the prisms."""
    fine = [np.linspace(0.0, 1.0, 41) for _ in layout.segments]
    light = [np.asarray(way) for way in way_of_light(layout.segments, fine)]
    parts: dict[str, list[np.ndarray]] = {}
    for one, s, way in zip(layout.segments, fine, light, strict=True):
        own = point_parts(1e3 * one.psd_range[0] * (2.0 * s - 1.0), way)
        for name, u in own.items():
            parts.setdefault(name, []).append(np.asarray(u))
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    grouped = {
        group: np.sqrt(sum(u**2 for name, u in whole.items() if name.startswith(group)))
        for group in dict.fromkeys(name.split()[0] for name in whole)
    }
    cuts = [0.5 * (a[-1] + b[0]) for a, b in zip(light, light[1:], strict=False)]
    return np.concatenate(light), grouped, cuts
