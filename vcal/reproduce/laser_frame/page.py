"""The page: what was asked, what came out, and where it parts from the publication."""

from collections.abc import Mapping, Sequence

import numpy as np

from ...report import Picture, Section, Table, Tile, sheet
from ...report.html.text import DASH, number, percent, unit
from ...uncertainty import Budget
from ..registry import Row
from .better import GAP_M, PathBound, Step
from .budget import Facts, point_budget
from .cycles import Cycles
from .recipe import Lever
from .results import Results
from .setting import LEGS, LEVER_M, OTHERS, ROTATION_URAD, THIRTEEN, TRANSLATION_UM, TRAVEL
from .table_four import PRINTED, exchanged
from .verification import (
    BAND_UM,
    BESIDE_M,
    DEVICE_U_UM,
    DRIFT_UM,
    DRIFT_URAD,
    MANIPULATED_UM,
    Agreement,
)

_ANGLES = THIRTEEN[8:]


def page(results: Results, rows: Sequence[Row], pictures: Mapping[str, tuple[Picture, ...]]) -> str:
    """The results as one self-contained HTML text."""
    first, best = results.variants[0], _checked(results, results.better.steps[-2])
    even = _checked(results, results.better.steps[0])
    gain = 1.0 - best / even
    wrong = [f for f in results.figures if abs(f.exact - f.seed) > 10.0**-f.digits * (1 + 1e-9)]
    summary = (
        f"{len(results.figures) - len(wrong)} of {len(results.figures)} figures of the budget are "
        "met to one unit of their last printed digit. The table of thirteen errors follows from "
        f"that budget with a mean ratio of {_ratio(first.exchanged)} if the labels of EXZ and EZY "
        f"are exchanged, and of {_ratio(first.as_printed)} as it is printed. On the path “planar” "
        "one of the thirteen cannot be seen at all, and the eight errors that are taken for zero "
        "weigh more than all noise. The same 51 points, better placed, have a largest "
        f"uncertainty that is {percent(gain)} smaller."
    )
    three, flat = results.seen["“3d”"], results.seen["“planar”"]
    tiles = [
        Tile("largest U of a reading", "2.26 µm printed", f"{_largest_U(results)} µm unrounded"),
        Tile("Table 4, rms of ln ratio", number(first.exchanged, 2),
             f"{number(first.as_printed, 2)} with the labels as printed"),
        Tile("parameters that are seen", f"{three.rank} of {three.columns}",
             f"path “3d”; “planar” {flat.rank}"),
        Tile("largest U of the thirteen", f"{number(best)} µm", f"{number(even)} µm evenly"),
    ]  # fmt: skip
    sections = [
        _seen(results, pictures["seen"]),
        _budget(results, pictures["budget"]),
        _cycles(results, pictures["cycles"]),
        _influences(results, pictures["influences"]),
        _verification(results, pictures["verification"]),
        _better(results, pictures["better"]),
        _table(rows),
        _settings(results),
    ]
    return sheet(
        "Thermo-elastic errors by a laser frame",
        summary,
        sections,
        kicker="vcal – a published campaign, done again",
        facts=[
            ("publication", "Brecher, Spierling, Fey (2022), Measurement uncertainty of a new "
             "machine-integrated, PSD based approach for thermo-elastic error measurement, "
             "MM Science Journal"),
            ("cycles", f"{results.draws}, every one with an identification; seed {results.seed}"),
        ],
        tiles=tiles,
    )  # fmt: skip


def _checked(results: Results, step: Step) -> float:
    return max(results.checked[step.freedom].identified.values())


def _ratio(rms: float) -> str:
    return number(float(np.exp(rms)), 3)


def _largest_U(results: Results) -> str:
    return number(next(f.exact for f in results.figures if f.quantity.startswith("expanded")), 3)


# --- sections ---


def _seen(results: Results, pictures: tuple[Picture, ...]) -> Section:
    lines = [
        (name, f"{one.rank} of {one.columns}", ", ".join(one.mixed) or DASH,
         ", ".join(one.invisible) or DASH)
        for name, one in results.seen.items()
    ]  # fmt: skip
    bias = [
        (name, *(number(_or_zero(one.bias[name]), 2) for one in results.seen.values()))
        for name in THIRTEEN
    ]
    return Section(
        "What the beams can see",
        (
            "Thirteen errors and the frame's pose have 37 parameters: Legendre polynomials up to "
            "the fourth degree, a slope for positioning errors. The path decides how many of them "
            "the 102 readings tell apart. The publication does not print the edges its beams run "
            "along; “planar”, once round a plane and up, agrees best with its table, “3d” is what "
            "should be built.",
            f"{', '.join(OTHERS)} are taken for zero. Where they are not, the thirteen take up "
            "what the beams show of them. A lever of the diode makes even those visible that no "
            "reading showed without it, and with them their bias.",
        ),
        tables=(
            Table(
                ("path", "rank", "part of what no reading shows", "others that no reading shows"),
                lines,
                "lrll",
            ),
            Table(
                ("error", *results.seen),
                bias,
                "l" + "r" * len(results.seen),
                note="Standard deviation of the bias, µm or µrad, where every coefficient of the "
                f"other eight has {TRANSLATION_UM:g} µm or {ROTATION_URAD:.0f} µrad (assumed); in "
                "proportion for other sizes.",
            ),
        ),
        pictures=pictures,
    )


def _or_zero(value: float) -> float:
    """Rounding is not shown."""
    return value if value > 1e-9 else 0.0


def _budget(results: Results, pictures: tuple[Picture, ...]) -> Section:
    rows = [
        (f.quantity, f"{f.seed:.{f.digits}f}", number(f.exact, 4), f"{f.rounded:.{f.digits}f}",
         unit(f.unit), f.note)
        for f in results.figures
    ]  # fmt: skip
    largest = point_budget(1.3, Facts().longest)
    return Section(
        "Budget of a reading",
        (
            "Every figure is computed twice: without rounding, and with every influence rounded "
            "before it is added, as the publication does. The head's growth is corrected with its "
            "measured temperature; its part is the uncertainty of that correction. The shift in "
            "the filter is the publication's upper bound, which leaves out the glass.",
        ),
        tables=(
            Table(
                ("input", "distribution", "u", "sensitivity", "contribution", "share"),
                _inputs(largest),
                "llrrrr",
                note="The largest: 1.3 mm from the middle of the diode, "
                f"{Facts().longest:g} m from the source. u = {number(float(largest.u[0]), 4)} µm, "
                f"U = {number(2.0 * float(largest.u[0]), 3)} µm (k = 2), JCGM 100.",
            ),
            Table(
                ("quantity", "printed", "unrounded", "rounded on the way", "unit", "note"),
                rows,
                "lrrrll",
                fold="All figures",
            ),
        ),
        pictures=pictures,
    )


def _inputs(budget: Budget) -> list[tuple[str, ...]]:
    source, share = budget.source, (budget.contribution[0] / budget.u[0]) ** 2
    return [
        (label, source.distributions[i], number(float(np.sqrt(source.covariance[i, i]))),
         number(float(budget.sensitivity[0, i])), f"{number(float(budget.contribution[0, i]))} µm",
         percent(float(share[i])))
        for i, label in enumerate(source.labels)
    ]  # fmt: skip


def _cycles(results: Results, pictures: tuple[Picture, ...]) -> Section:
    c, swapped = results.cycles, exchanged()
    columns = ("planar, noise", "planar, all errors")
    rest = ("3d, noise", "3d, all errors", "3d, all errors fitted")
    rows = []
    for name in THIRTEEN:
        printed = f"{PRINTED[name]:g}"
        if swapped[name] != PRINTED[name]:
            printed += f" ({swapped[name]:g})"
        values = [_by_beams(c[k])[name] for k in columns] + [c[k].identified[name] for k in rest]
        rows.append((name + ("*" if name in _ANGLES else ""), printed, *map(number, values)))
    tools = [_tool_by_beams(c[k]) for k in columns] + [float(c[k].tool.max()) for k in rest]
    rows.append(("tool in the volume", DASH, *map(number, tools)))
    lever = Lever.seen()
    variants = [(v.name, number(v.exchanged, 2), number(v.as_printed, 2)) for v in results.variants]
    return Section(
        "Monte Carlo of the thirteen errors",
        (
            f"{results.draws} cycles: errors drawn, 51 points measured, noise of the budget times "
            "two, evaluation. On the path “planar” beam by beam: line removed, slopes, differences "
            "of parallel beams. On “3d” by least squares, for the thirteen alone, or for all 21 "
            "with the sizes of their family as prior.",
            "The publication's numbers are those of the noise. With all 21 errors drawn, the "
            "thirteen are uncertain by what the other eight do to them, up to "
            f"{number(_worse(c), 2)} times more: on “planar”, EBY is read off beams that show "
            "EAX. Fitting all 21 with a prior is what can be done about it: a known rather than an "
            "unknown uncertainty, and a smaller one.",
        ),
        tables=(
            Table(
                ("error", "printed", "“planar”, noise", "all 21", "“3d”, noise", "all 21",
                 "all 21, all fitted"),
                rows,
                "lrrrrrr",
                note="U (k = 2), µm. In brackets: EXZ and EZY exchanged, as segment 5, where EXZ "
                f"is read, is the noisiest. * times {1e3 * lever.roll:.0f} mm (rolls, space "
                f"diagonal) or {1e3 * lever.square:.0f} mm (squarenesses, longest travel), the "
                "rolls less their mean. Last row: largest component of the tool's displacement by "
                "the thirteen, at 27 places of the volume.",
                strong=frozenset({len(rows) - 1}),
            ),
            Table(
                ("choice", "rms of ln ratio", "labels as printed"),
                variants,
                "lrr",
                note="Noise alone in closed form, thirteen entries. Edges, legs, lengths and beams "
                "were chosen after the printed table had been seen: an inference, not a "
                "confirmation.",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _worse(cycles: Mapping[str, Cycles]) -> float:
    """Largest factor by which drawing all errors makes one of the thirteen more uncertain."""
    planar = [_by_beams(cycles[f"planar, {what}"]) for what in ("noise", "all errors")]
    space = [cycles[f"3d, {what}"].identified for what in ("noise", "all errors")]
    return max(all21[n] / noise[n] for noise, all21 in (planar, space) for n in THIRTEEN)


def _by_beams(one: Cycles) -> dict[str, float]:
    assert one.by_beams is not None
    return one.by_beams


def _tool_by_beams(one: Cycles) -> float:
    assert one.tool_by_beams is not None
    return float(one.tool_by_beams.max())


def _influences(results: Results, pictures: tuple[Picture, ...]) -> Section:
    noise = {path: results.cycles[f"{path}, noise"] for path in ("3d", "planar")}
    effects = results.as_effects
    sides = [
        *((noise["3d"].identified, effects["3d"].identified),),
        *((_by_beams(noise["planar"]), _by_beams(effects["planar"])),),
    ]
    rows = [(name, *(number(v[name]) for pair in sides for v in pair)) for name in THIRTEEN]
    more = [n for n in THIRTEEN if sides[0][1][n] > 1.05 * sides[0][0][n]]
    less = [n for n in THIRTEEN if sides[0][1][n] < 0.95 * sides[0][0][n]]
    return Section(
        "Influences as effects",
        (
            "The same nine influences with the same distributions, as what they are: temperature "
            "and expansion of the head, growth of the frame, tool interface, gradient of the air "
            "and linearity of the diode are drawn once per run; refraction, resolution and "
            "repeatability afresh for every reading. The identification still takes them for "
            "independent.",
            f"On “3d” {', '.join(less)} become less uncertain, {', '.join(more)} more: a diode "
            "that is not linear tilts every beam, and a bent beam looks like a squareness. Noise "
            "that is independent by assumption is no safe side for them.",
        ),
        tables=(
            Table(
                ("error", "“3d”, independent", "as effects", "“planar”, independent",
                 "as effects"),
                rows,
                "lrrrr",
                note="U (k = 2), µm; noise alone. “3d” by least squares, “planar” beam by beam.",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _verification(results: Results, pictures: tuple[Picture, ...]) -> Section:
    v = results.verification
    lines = [_agreement(a) for a in v.agreements]
    reversals = [
        (r.name, number(r.true), number(r.by_difference), number(r.identified),
         number(2.0 * r.u, 2))
        for r in v.reversals
    ]  # fmt: skip
    return Section(
        "Second device, and both directions",
        (
            f"A reference run, a run with the NC path manipulated by {MANIPULATED_UM:g} µm, and a "
            f"machine that drifts meanwhile ({DRIFT_UM:g} µm, {DRIFT_URAD:g} µrad per coefficient "
            f"of all 21 errors). The second device, {1e3 * BESIDE_M:g} mm beside the head, has "
            f"{DEVICE_U_UM:g} µm (k = 2). {percent(v.inside)} of the differences lie within "
            f"{BAND_UM:g} µm, and all 102 of a repeat in {percent(v.all_inside)} of {v.repeats} "
            "repeats. The publication saw all of them inside three times: for two runs within ten "
            "minutes its budget is on the safe side, as little of what it sums up changes "
            f"meanwhile. Of the normalised errors {percent(v.agreeing)} are at most one; 95 % "
            "should be.",
            "A run back over the same points gives the lateral reversal errors of the axes: by "
            "the difference of both runs, and identified with all other errors.",
        ),
        tables=(
            Table(
                ("segment", "RMSE of three repeats", "mean", "expected", f"within {BAND_UM:g} µm",
                 "largest U of the difference"),
                lines,
                "lrrrrr",
                note="µm. Expected: from the uncertainties of both devices.",
            ),
            Table(
                ("reversal error", "true", "forth less back", "identified", "U (k = 2)"),
                reversals,
                "lrrrr",
                note="µm; one machine.",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _agreement(a: Agreement) -> tuple[str, ...]:
    three = ", ".join(f"{v:.2f}" for v in a.rmse[:3])
    return (
        f"{a.segment} {a.component}", three, number(float(a.rmse.mean())), number(a.expected),
        percent(a.inside), number(float(a.U.max())),
    )  # fmt: skip


def _better(results: Results, pictures: tuple[Picture, ...]) -> Section:
    b = results.better
    first = b.steps[0]
    lines = [
        _step(step, first, results.checked.get(step.freedom)) for step in (*b.steps, b.for_tool)
    ]
    best = b.steps[-2].layout
    places = [
        (
            f"{one.number}: {one.axis} from ({', '.join(f'{1e3 * v:.0f}' for v in one.start)})",
            str(len(s)),
            ", ".join(f"{1e3 * v * one.length:.0f}" for v in s),
        )
        for one, s in zip(best.segments, best.shares, strict=True)
    ]
    five = [_path(p) for p in b.five[:6]]
    return Section(
        "The same 51 points, better placed",
        (
            "What is minimised is the largest U of the thirteen, with one freedom more at a time. "
            f"{b.tried[0]} paths of five beams and {b.tried[1]} of six run along edges of the work "
            f"space (less their mirror images in X); {len(b.five)} and {len(b.six)} of them see "
            "all thirteen. For each, a convex problem gives the shares of the beams and the least "
            f"that any places can reach; then the places, at least {1e3 * GAP_M:g} mm apart, and "
            f"the diode's lever up to {1e3 * LEVER_M:g} mm follow the gradient.",
            "Points crowd near the ends and at a quarter of a beam: slopes want the ends, "
            "straightness the middle, and the beam's deflection the start. A lever helps where the "
            "path is bad; it also lets in errors that were taken for zero.",
        ),
        tables=(
            Table(
                ("freedom", "largest U", "gain", "Monte Carlo", "tool in the volume", "lever, mm",
                 "points per beam"),
                lines,
                "lrrrrrl",
                note="µm, k = 2, least squares on the thirteen.",
                strong=frozenset({len(b.steps) - 2}),
            ),
            Table(
                ("beam", "points", "places from its start, mm"),
                places,
                "lrl",
                note="The best with five beams.",
            ),
            Table(
                ("corners (X Y Z)", "evenly", "bound", "points per beam"),
                five,
                "lrrl",
                note="Largest U, µm: candidates evenly measured, and the convex bound.",
                fold="The best paths of five beams",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _step(step: Step, first: Step, checked: Cycles | None) -> tuple[str, ...]:
    layout = step.layout
    return (
        step.freedom,
        number(step.largest, 4),
        percent(1.0 - step.largest / first.largest) if step is not first else DASH,
        DASH if checked is None else number(max(checked.identified.values()), 4),
        number(step.tool),
        f"{1e3 * layout.lever:.1f}",
        ", ".join(str(len(s)) for s in layout.shares),
    )


def _path(path: PathBound) -> tuple[str, ...]:
    corners = " → ".join("".join("−+"[v] for v in c) for c in path.corners)
    points = ", ".join(f"{v:.1f}" for v in path.shares)
    return corners, number(path.evenly), number(path.bound), points


def _table(rows: Sequence[Row]) -> Section:
    lines = [
        (
            r.quantity,
            DASH if r.seed is None else f"{r.seed:.5g}",
            f"{r.vcal:.0f}" if r.unit == "1" and r.vcal > 10.0 else number(r.vcal, 4),
            unit(r.unit),
            r.note,
        )
        for r in rows
    ]
    return Section(
        "Printed and found",
        tables=(
            Table(
                ("quantity", "printed", "vcal", "unit", "note"), lines, "lrrll", fold="All numbers"
            ),
        ),
    )


def _settings(results: Results) -> Section:
    legs = ", ".join(f"{axis} {1e3 * v:.0f}" for axis, v in LEGS.items())
    travel = ", ".join(f"{axis} {1e3 * (b - a):.0f}" for axis, (a, b) in TRAVEL.items())
    return Section(
        "Settings",
        points=(
            f"Printed: chain w b X Y Z t, travel {travel} mm, 7 + 4 × 11 points, ranges of the "
            "diode, all numbers of the budget, noise doubled for the reference run, "
            f"volume of the beam {legs} mm.",
            "Not printed: edges that the beams run along, travel in the middle of the legs, the "
            "functions of the errors (Legendre polynomials up to the fourth degree), their sizes "
            f"({TRANSLATION_UM:g} µm and {ROTATION_URAD:.0f} µrad per coefficient: three of the "
            "rotation are the 100 µrad that the publication takes on the safe side).",
            "The straightness of the first beam along X is judged as that of its line, the others "
            "at the axes' own zero; a squareness has the slopes of the straightnesses in its "
            "plane.",
        ),
        note="JCGM 100:2008; JCGM 101:2008; ISO 230-1:2012 names of errors; ISO 17043 for E_n.",
    )
