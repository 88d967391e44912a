"""The description of this reproduction: printed numbers, record and page."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...plots.panels import PALETTE, Mark, Panel, bars, mark, panels, spaces
from ...plots.style import AFTER, BEFORE, DOTS, INK, MARK, NOMINAL
from ...report import Table, Tile
from ...report.html.text import number, percent, unit
from ..document import Row, picked, table
from ..registry import Reproduction
from .better import GAP_M, Step
from .budget import Facts, point_parts
from .cycles import Cycles
from .recipe import PRINTED, Lever, exchanged
from .results import CYCLES, LEAST, Results
from .setting import (
    LEGS,
    LEVER_M,
    OTHERS,
    ROTATION_URAD,
    THIRTEEN,
    TRANSLATION_UM,
    TRAVEL,
    Layout,
    way_of_light,
)
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


def rows(r: Results) -> list[Row]:
    """All printed numbers, and those that belong beside them."""
    found = []
    for f in r.figures:
        note = f"with the publication's roundings {f.rounded:.{f.digits}f}. {f.note}".rstrip(". ")
        found.append(Row(f.quantity, f.published, f.exact, f.unit, note))
    found.append(Row("cycles", 30_000, float(r.draws), "1"))
    noise, everything = (r.cycles[f"planar, {n}"] for n in ("noise", "all errors"))
    swapped, U = exchanged(), _beams(noise)
    for name in THIRTEEN:
        note = f"noise alone; with all 21 errors {_beams(everything)[name]:.3g} um"
        if swapped[name] != PRINTED[name]:
            note += f"; printed {swapped[name]:g} with EXZ and EZY exchanged"
        found.append(Row(f"U of {name}", PRINTED[name], U[name], "um", note))
    first, v = r.variants[0], r.verification
    found += [
        Row("rms of ln(vcal / printed), EXZ and EZY exchanged", None, first.exchanged, "1",
            "thirteen entries, noise alone, closed form"),
        Row("rms of ln(vcal / printed), labels as printed", None, first.as_printed, "1"),
        *(Row("largest linear uncertainty in the volume, a component", None, _tool(one), "um",
              f"path “planar”, beam by beam, {what}")
          for one, what in ((noise, "noise alone"), (everything, "all 21 errors"))),
        Row("largest linear uncertainty of an angle in the volume",
            max(PRINTED[n] for n in _ANGLES), max(U[n] for n in _ANGLES), "um",
            "entries with an asterisk, noise alone"),
        *(Row(f"largest U of the thirteen, {step.freedom}", None, _checked(r, step), "um",
              f"Monte Carlo, path “3d” and least squares; closed form {step.largest:.3f} um")
          for step in (r.better.steps[0], *r.better.steps[-2:])),
        Row("differences to the second device within 3 um", 1.0, v.inside, "1",
            f"share, over {v.repeats} repeats; printed: all, of three repeats"),
        Row("repeats with all differences within 3 um", None, v.all_inside, "1", "share"),
        Row("normalised errors of at most one", None, v.agreeing, "1",
            "share; 0.954 where both uncertainties are right"),
    ]  # fmt: skip
    return found


def _beams(one: Cycles) -> dict[str, float]:
    return one.by_beams or {}


def _tool(one: Cycles) -> float:
    """Largest of the tool's displacement; beam by beam where the path allows it."""
    return float((one.tool if one.tool_by_beams is None else one.tool_by_beams).max())


def _checked(r: Results, step: Step) -> float:
    return max(r.checked[step.freedom].identified.values())


def record(r: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""
    found, v = r.better, r.verification
    path = ("corners", "evenly_um=evenly", "bound_um=bound", "points=shares")
    return {
        "budget": [
            picked(f, "quantity", "seed=published", "exact", "rounded", "digits", "unit", "note")
            for f in r.figures
        ],
        "seen": {name: asdict(one) for name, one in r.seen.items()},
        "table_four": {
            "printed": dict(PRINTED),
            "levers_m": asdict(Lever.seen()),
            "variants": [
                picked(one, "choices=name", "U_um=U", "exchanged", "as_printed")
                for one in r.variants
            ],
        },
        "cycles": {name: _cycles(one) for name, one in r.cycles.items()},
        "influences_as_effects": {n: _cycles(one) for n, one in r.as_effects.items()},
        "second_device": {
            **picked(v, "repeats", "within_3_um=inside", "repeats_within_3_um=all_inside",
                     "normalised_errors_up_to_one=agreeing"),
            "straightnesses": [
                picked(a, "segment", "component") | {"rmse_um": a.rmse[:3]}
                | picked(a, "expected_um=expected", "within_3_um=inside")
                for a in v.agreements
            ],
            "reversals": [asdict(one) for one in v.reversals],
        },
        "layouts": {
            "steps": [_step(s) for s in found.steps],
            "for_tool": _step(found.for_tool),
            "paths_tried": list(found.tried),
            "five_beams": [picked(p, *path) for p in found.five],
            "six_beams": [picked(p, *path) for p in found.six[:10]],
            "monte_carlo": {n: _cycles(one) for n, one in r.checked.items()},
        },
    }  # fmt: skip


def _cycles(one: Cycles) -> dict[str, Any]:
    tool = {"tool_U_um": one.tool, "tool_by_beams_U_um": one.tool_by_beams}
    return {
        **picked(one, "identified_U_um=identified", "by_beams_U_um=by_beams"),
        **{key: None if U is None else U.max(0) for key, U in tool.items()},
        "failed": one.campaign.failed,
    }


def _step(step: Step) -> dict[str, Any]:
    layout = step.layout
    return {
        **picked(step, "freedom", "U_um=U", "largest_um=largest", "tool_um=tool"),
        "lever_mm": 1e3 * layout.lever,
        "segments": [
            {"number": s.number, "start_mm": [1e3 * v for v in s.start],
             "end_mm": [1e3 * v for v in s.end], "places_mm": 1e3 * p * s.length}
            for s, p in layout.beams
        ],
    }  # fmt: skip


def _head(r: Results) -> tuple[str, list[Tile]]:
    met = [abs(f.exact - f.published) <= 10.0**-f.digits * (1 + 1e-9) for f in r.figures]
    first, three, flat = r.variants[0], r.seen["“3d”"], r.seen["“planar”"]
    ratio, printed = (float(np.exp(rms)) for rms in (first.exchanged, first.as_printed))
    best, even = (_checked(r, r.better.steps[i]) for i in (-2, 0))
    text = f"""\
{sum(met)} of {len(met)} figures of the budget are met to one unit of their last printed digit. The
table of thirteen errors follows from that budget with a mean ratio of {number(ratio)} if the labels
of EXZ and EZY are exchanged, and of {number(printed)} as it is printed. On the path “planar” one of
the thirteen cannot be seen, and the eight errors that are taken for zero weigh more than all noise.
The same 51 points, better placed, have a largest uncertainty that is {percent(1 - best / even)}
smaller.
"""
    U = next(f.exact for f in r.figures if f.quantity.startswith("expanded"))
    tiles = [
        Tile("largest U of a reading", "2.26 µm printed", f"{number(U)} µm unrounded"),
        Tile("Table 4, rms of ln ratio", number(first.exchanged, 2),
             f"{number(first.as_printed, 2)} with the labels as printed"),
        Tile("parameters that are seen", f"{three.rank} of {three.columns}",
             f"path “3d”; “planar” {flat.rank}"),
        Tile("largest U of the thirteen", f"{number(best)} µm", f"{number(even)} µm evenly"),
    ]  # fmt: skip
    return text, tiles


def _as_effects(r: Results) -> list[list[dict[str, float]]]:
    """U of the thirteen by path: with independent noise, and with the influences as effects."""
    ways: dict[str, Callable[[Cycles], dict[str, float]]]
    ways = {"3d": lambda one: one.identified, "planar": _beams}
    return [[U(r.cycles[f"{n}, noise"]), U(r.as_effects[n])] for n, U in ways.items()]


def _changed(r: Results, low: float, high: float) -> str:
    """Those of the thirteen whose U changes by a factor in this range with them, path “3d”."""
    noise, effects = _as_effects(r)[0]
    return ", ".join(n for n in THIRTEEN if low < effects[n] / noise[n] < high)


def _worse(r: Results) -> float:
    """Largest factor by which drawing all errors makes one of the thirteen more uncertain."""
    noise, drawn = (
        [_beams(r.cycles[f"planar, {what}"]), r.cycles[f"3d, {what}"].identified]
        for what in ("noise", "all errors")
    )
    return max(b[n] / a[n] for a, b in zip(noise, drawn, strict=True) for n in THIRTEEN)


def _lengths(sides: Any) -> str:
    return ", ".join(f"{axis} {1e3 * v:.0f}" for axis, v in sides.items())


def _inputs(r: Results) -> Table:
    budget, source = r.largest, r.largest.source
    share = (budget.contribution[0] / budget.u[0]) ** 2
    return table(
        "input | distribution | u | sensitivity | contribution | share",
        [(label, source.distributions[i], float(np.sqrt(source.covariance[i, i])),
          budget.sensitivity[0, i], f"{number(float(budget.contribution[0, i]))} µm",
          percent(float(share[i]))) for i, label in enumerate(source.labels)],
    )  # fmt: skip


def _cycles_table(r: Results) -> Table:
    swapped = exchanged()
    ways = [(r.cycles[f"planar, {n}"], True) for n in ("noise", "all errors")]
    ways += [(r.cycles[f"3d, {n}"], False) for n in ("noise", "all errors", "all errors fitted")]
    cycles: list[tuple] = []
    for n in THIRTEEN:
        printed = f"{PRINTED[n]:g}" + (f" ({swapped[n]:g})" if swapped[n] != PRINTED[n] else "")
        values = [(_beams(one) if beams else one.identified)[n] for one, beams in ways]
        cycles.append((n + ("*" if n in _ANGLES else ""), printed, *values))
    cycles.append(("tool in the volume", None, *(_tool(one) for one, _ in ways)))
    return table(
        "error | printed | “planar”, noise | all 21 | “3d”, noise | all 21 | all 21, all fitted",
        cycles, strong=[len(cycles) - 1],
    )  # fmt: skip


def _steps(r: Results) -> Table:
    steps = r.better.steps
    return table(
        "freedom | largest U | gain | Monte Carlo | tool in the volume | lever, mm | "
        "points per beam",
        [(s.freedom, number(s.largest, 4),
          None if s is steps[0] else percent(1.0 - s.largest / steps[0].largest),
          number(_checked(r, s), 4) if s.freedom in r.checked else None, s.tool,
          f"{1e3 * s.layout.lever:.1f}", ", ".join(str(len(p)) for p in s.layout.shares))
         for s in (*steps, r.better.for_tool)],
        strong=[len(steps) - 2],
    )  # fmt: skip


def _places(r: Results) -> Table:
    best = r.better.steps[-2].layout
    return table(
        "beam | points | places from its start, mm",
        [(f"{one.number}: {one.axis} from ({', '.join(f'{1e3 * x:.0f}' for x in one.start)})",
          len(s), ", ".join(f"{1e3 * x * one.length:.0f}" for x in s))
         for one, s in best.beams],
    )  # fmt: skip


def _agreement(a: Agreement) -> Panel:
    """Difference of two devices along a beam, for three of the repeats."""
    return Panel(
        f"segment {a.segment}, {a.component}: RMSE {', '.join(f'{x:.1f}' for x in a.rmse[:3])} µm",
        "place on the beam, mm", "µm",
        [mark("axhspan", -BAND_UM, BAND_UM, color=DOTS, alpha=0.25, lw=0),
         *(mark("plot", a.place_mm, d, ".-", color=colour, lw=0.9, ms=5)
           for d, colour in zip(a.difference, (AFTER, BEFORE, MARK), strict=False))],
        settings={"ylim": (-1.7 * BAND_UM, 1.7 * BAND_UM)},
    )  # fmt: skip


def _bars(title: str, series: Any, y: str = "U (k = 2), µm", **settings: Any) -> Figure:
    """The thirteen, one group of bars each."""
    legend = "inside" if len(series) > 1 else ""
    panel = Panel(title, "", y, bars(series), legend, settings)
    return panels([panel], width=9.0, height=3.4)


def _path(layout: Layout) -> Sequence[Mark]:
    """Beams with their numbers, points, and the start of the light."""
    marks = []
    for one in layout.segments:
        ends = 1e3 * np.array([one.start, one.end])
        marks.append(mark("plot", *ends.T, color=BEFORE, lw=1.2))
        marks.append(mark("text", *ends.mean(0), str(one.number), fontsize=9, color=INK))
    start = 1e3 * np.array([layout.segments[0].start])
    marks.append(mark("plot", *(1e3 * layout.position).T, ".", color=AFTER, ms=4.5))
    return [*marks, mark("plot", *start.T, "s", color=BEFORE, ms=6)]


def _along(layout: Layout) -> Panel:
    """Variance of the first reading along the beam, influence on influence."""
    fine = [np.linspace(0.0, 1.0, 41) for _ in layout.segments]
    light = [np.asarray(way) for way in way_of_light(layout.segments, fine)]
    parts: dict[str, list[np.ndarray]] = {}
    for one, s, way in zip(layout.segments, fine, light, strict=True):
        for name, u in point_parts(1e3 * one.psd_range[0] * (2.0 * s - 1.0), way).items():
            parts.setdefault(name, []).append(np.asarray(u))
    grouped: dict[str, np.ndarray] = {}
    for name, values in parts.items():
        group = name.split()[0]
        grouped[group] = grouped.get(group, 0.0) + np.concatenate(values) ** 2
    cuts = [0.5 * (a[-1] + b[0]) for a, b in zip(light, light[1:], strict=False)]
    at, shades = np.concatenate(light), [NOMINAL, DOTS, MARK, "#CC79A7", *PALETTE[3:0:-1]]
    stack = mark("stackplot", at, *grouped.values(), labels=list(grouped), colors=shades, lw=0)
    marks = [stack, *(mark("axvline", cut, color=INK, lw=0.7, ls=":") for cut in cuts)]
    settings = {"xlim": (at.min(), at.max())}
    return Panel(
        "Variance of a reading", "way of the light, m", "u², µm²", marks, "right", settings
    )


TEXTS: dict[str, Callable[[Results], str]] = {
    "What the beams can see": lambda r: f"""\
Thirteen errors and the frame's pose have 37 parameters: Legendre polynomials up to the fourth
degree, a slope for positioning errors. The path decides how many of them the 102 readings tell
apart. The publication does not print the edges along which its beams run; “planar”, once round a
plane and up, agrees best with its table, “3d” is what should be built.

{", ".join(OTHERS)} are taken for zero. Where they are not, the thirteen take up what the beams show
of them. A lever of the diode makes even those visible that no reading showed without it, and with
them their bias.
:seen
:biases Standard deviation of the bias, µm or µrad, where every coefficient of the other eight has
{TRANSLATION_UM:g} µm or {ROTATION_URAD:.0f} µrad (assumed); in proportion for other sizes.
:beams Beam paths with their 51 points, in the work space of the axes. The light starts at the
square. Right: the path and the places found below.
:bias Path “3d”: standard deviation that the other eight errors put on the thirteen.
""",
    "Budget of a reading": lambda r: f"""\
Every figure is computed twice: without rounding, and with every influence rounded before it is
added, as the publication does. The head's growth is corrected with its measured temperature; its
part is the uncertainty of that correction. The shift in the filter is the publication's upper
bound, which leaves out the glass.
:inputs The largest: 1.3 mm from the middle of the diode, {Facts().longest:g} m from the source. u =
{number(float(r.largest.u[0]), 4)} µm, U = {number(2.0 * float(r.largest.u[0]))} µm (k = 2), JCGM
100.
:figures
:budget Variance of a reading, influence on influence, along the path “planar”, first reading.
Dotted: pentaprisms. The diode's part grows from the middle of a segment to its ends, the beam's
deflection with the light's whole way.
""",
    "Monte Carlo of the thirteen errors": lambda r: f"""\
{r.draws} cycles: errors drawn, 51 points measured, noise of the budget times two, evaluation. On
the path “planar” beam by beam: line removed, slopes, differences of parallel beams. On “3d” by
least squares, for the thirteen alone, or for all 21 with the sizes of their family as prior.

The publication's numbers are those of the noise. With all 21 errors drawn, the thirteen are
uncertain by what the other eight do to them, up to {number(_worse(r), 2)} times more: on “planar”,
EBY is read off beams that show EAX. A fit of all 21 with a prior makes this uncertainty known, and
smaller.
:cycles U (k = 2), µm. In brackets: EXZ and EZY exchanged, as segment 5, where EXZ is read, is the
noisiest. * times {1e3 * Lever.seen().roll:.0f} mm (rolls, space diagonal) or
{1e3 * Lever.seen().square:.0f} mm (squarenesses, longest travel), the rolls less their mean. Last
row: largest component of the tool's displacement by the thirteen, at 27 places of the volume.
:variants Noise alone in closed form, thirteen entries. Edges, legs, lengths and beams were chosen
after the printed table had been seen: an inference, not a confirmation.
:table_four Expanded uncertainties of the thirteen, angles times the lengths given above.
""",
    "Influences as effects": lambda r: f"""\
The same nine influences with the same distributions, as what they are: temperature and expansion of
the head, growth of the frame, tool interface, gradient of the air and linearity of the diode are
drawn once per run; refraction, resolution and repeatability for every reading. The identification
still takes them for independent.

On “3d” {_changed(r, 0.0, 0.95)} become less uncertain, {_changed(r, 1.05, np.inf)} more: a diode
that is not linear tilts every beam, and a bent beam looks like a squareness. The assumption of
independent noise is not conservative for them.
:as_effects U (k = 2), µm; noise alone. “3d” by least squares, “planar” beam by beam.
:influences Effect of the influences on the thirteen; most of them are one number per run.
""",
    "Second device, and both directions": lambda r: f"""\
A reference run, a run with the NC path manipulated by {MANIPULATED_UM:g} µm, and a machine that
drifts meanwhile ({DRIFT_UM:g} µm, {DRIFT_URAD:g} µrad per coefficient of all 21 errors). The second
device, {1e3 * BESIDE_M:g} mm beside the head, has {DEVICE_U_UM:g} µm (k = 2).
{percent(r.verification.inside)} of the differences lie within {BAND_UM:g} µm, and all 102 of a
repeat in {percent(r.verification.all_inside)} of {r.verification.repeats} repeats. The publication
saw all of them inside three times: for two runs within ten minutes its budget is conservative, as
little of what it sums up changes meanwhile. {percent(r.verification.agreeing)} of the normalised
errors are at most one; 95 % should be.

A run back over the same points gives the lateral reversal errors of the axes: by the difference of
both runs, and identified with all other errors.
:agreements µm. Expected: from the uncertainties of both devices.
:reversals µm; one machine.
:second_device Change between two runs as the laser frame saw it, less that of the second device,
for three of the repeats (the publication's Fig. 4). Band: 3 µm.
""",
    "The same 51 points, better placed": lambda r: f"""\
The largest U of the thirteen is minimised, with one freedom more at a time. {r.better.tried[0]}
paths of five beams and {r.better.tried[1]} of six run along edges of the work space (less their
mirror images in X); {len(r.better.five)} and {len(r.better.six)} of them see all thirteen. For
each, a convex problem gives the shares of the beams and the least that any places can reach; then
the places, at least {1e3 * GAP_M:g} mm apart, and the diode's lever up to {1e3 * LEVER_M:g} mm
follow the gradient.

Points crowd near the ends and at a quarter of a beam: slopes want the ends, straightness the
middle, and the beam's deflection the start. A lever helps where the path is bad; it also lets in
errors that were taken for zero.
:steps µm, k = 2, least squares on the thirteen.
:places The best with five beams.
:paths Largest U, µm: candidates evenly measured, and the convex bound.
:better Least squares on all three; angles as in Table 4. The largest is minimised: at the end
several are equally large.
""",
    "Printed and found": lambda r: """\
:numbers
""",
    "Settings": lambda r: f"""\
- Printed: chain w b X Y Z t, travel {_lengths({c: high for c, (_, high) in TRAVEL.items()})} mm, 7
+ 4 × 11 points, ranges of the diode, all numbers of the budget, noise doubled for the reference
run, volume of the beam {_lengths(LEGS)} mm.
- Not printed: edges along which the beams run, travel in the middle of the legs, the functions of
the errors (Legendre polynomials up to the fourth degree), their sizes ({TRANSLATION_UM:g} µm and
{ROTATION_URAD:.0f} µrad per coefficient: three of the rotation are the 100 µrad that the
publication takes for its machine as a safe bound).
- The straightness of the first beam along X is judged as that of its line, the others at the axes'
own zero; a squareness has the slopes of the straightnesses in its plane.
~ JCGM 100:2008; JCGM 101:2008; ISO 230-1:2012 names of errors; ISO 17043 for E_n.
""",
}  # fmt: skip

SHOWN: dict[str, Callable[[Results], Table | Figure]] = {
    "seen": lambda r: table(
        "path | rank | part of what no reading shows | others that no reading shows",
        [(name, f"{one.rank} of {one.columns}", ", ".join(one.mixed) or None,
          ", ".join(one.invisible) or None) for name, one in r.seen.items()],
    ),
    # What is zero but for rounding is shown as zero.
    "biases": lambda r: table(
        " | ".join(["error", *r.seen]),
        [(n, *(number(one.bias[n] if one.bias[n] > 1e-9 else 0.0, 2)
               for one in r.seen.values())) for n in THIRTEEN],
    ),
    "inputs": _inputs,
    "figures": lambda r: table(
        "quantity | printed | unrounded | rounded on the way | unit | note",
        [(f.quantity, f"{f.published:.{f.digits}f}", number(f.exact, 4),
          f"{f.rounded:.{f.digits}f}", unit(f.unit), f.note) for f in r.figures],
        fold="All figures",
    ),
    "cycles": _cycles_table,
    "variants": lambda r: table(
        "choice | rms of ln ratio | labels as printed",
        [(one.name, number(one.exchanged, 2), number(one.as_printed, 2))
         for one in r.variants],
    ),
    "agreements": lambda r: table(
        f"segment | RMSE of three repeats | mean | expected | within {BAND_UM:g} µm | "
        "largest U of the difference",
        [(f"{a.segment} {a.component}", ", ".join(f"{x:.2f}" for x in a.rmse[:3]),
          a.rmse.mean(), a.expected, percent(a.inside), a.U.max())
         for a in r.verification.agreements],
    ),
    "reversals": lambda r: table(
        "reversal error | true | forth less back | identified | U (k = 2)",
        [(one.name, one.true, one.by_difference, one.identified, number(2.0 * one.u, 2))
         for one in r.verification.reversals],
    ),
    "as_effects": lambda r: table(
        "error | “3d”, independent | as effects | “planar”, independent | as effects",
        [(name, *(U[name] for pair in _as_effects(r) for U in pair)) for name in THIRTEEN],
    ),
    "steps": _steps,
    "places": _places,
    "paths": lambda r: table(
        "corners (X Y Z) | evenly | bound | points per beam",
        [(" → ".join("".join("−+"[x] for x in corner) for corner in p.corners), p.evenly,
          p.bound, ", ".join(f"{x:.1f}" for x in p.shares)) for p in r.better.five[:6]],
        fold="The best paths of five beams",
    ),
    "beams": lambda r: spaces(
        {"“3d”": _path(Layout.named("3d")), "“planar”": _path(Layout.named("planar")),
         "found": _path(r.better.steps[-2].layout)},
        np.array([TRAVEL[c] for c in "XYZ"]), 3.2,
    ),
    "bias": lambda r: _bars(
        "Bias by the eight that are taken for zero", {"": r.seen["“3d”"].bias},
        y="standard deviation, µm or µrad",
    ),
    "budget": lambda r: panels([_along(Layout.named("planar"))], width=9.0, height=3.8),
    "table_four": lambda r: _bars(
        "Table 4: path “planar”, beam by beam",
        {"printed, EXZ and EZY exchanged": exchanged(),
         "noise alone": _beams(r.cycles["planar, noise"]),
         "with all 21 errors": _beams(r.cycles["planar, all errors"])},
        yscale="log",
    ),
    "influences": lambda r: _bars(
        "The nine influences, path “3d”, least squares",
        {"independent noise": r.cycles["3d, noise"].identified,
         "as effects of a run": r.as_effects["3d"].identified},
    ),
    "second_device": lambda r: panels(
        *zip(*[map(_agreement, r.verification.agreements)] * 2, strict=True),
        width=9.6, height=10.5,
    ),
    "better": lambda r: _bars(
        "51 points better placed (Monte Carlo)",
        {name: r.checked[step.freedom].identified
         for name, step in zip(
             ("evenly, “3d”", "places, beams and path found", "and a sixth beam"),
             [r.better.steps[i] for i in (0, -2, -1)], strict=True)},
    ),
}  # fmt: skip

LASER_FRAME = Reproduction(
    name="laser-frame",
    summary="A laser frame measures thermo-elastic errors, and its budget: Brecher et al. 2022",
    title="Thermo-elastic errors by a laser frame",
    publication="Brecher, Spierling, Fey (2022), Measurement uncertainty of a new "
    "machine-integrated, PSD based approach for thermo-elastic error measurement, MM Science "
    "Journal",
    compute=Results,
    rows=rows,
    record=record,
    head=_head,
    texts=TEXTS,
    shown=SHOWN,
    counted="cycles",
    draws=CYCLES,
    least=LEAST,
)
