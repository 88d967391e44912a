"""The description of this reproduction: printed numbers, record and page."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...design import ArrayPoses
from ...plots.panels import GREEN, Mark, Panel, bars, mark, panels, spaces
from ...plots.style import AFTER, BEFORE, DOTS, INK, MARK
from ...plots.style import NOMINAL as GREY
from ...report import Table, Tile
from ...report.html.text import DASH, number, percent, unit
from ..document import Row, picked, table
from ..registry import Reproduction
from .influences import AIR_K, LOAD_KG, SIZES, TAU_H, WARM_K
from .results import LEAST, MACHINES, PLACES, Results, Searched, nominal_poses
from .searches import FREEDOMS, NOMINAL_DESIGN, Robust
from .setting import (
    BALLS,
    GRID,
    KNOWN,
    LENGTH,
    NOMINAL,
    OFFSETS,
    PAIR_UM,
    POSES,
    PROBE_UM,
    SQUARENESS_URAD,
    TABLE_ONE,
    TOOL,
    TRAVEL,
    WAVES,
    Known,
)
from .stylus import SIDE_M
from .sweep import Drawn, Varied
from .timing import BALL_S, NOMINAL_S, SETUP_S

_SWEEPS = {
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
_TIPS = {
    "one straight stylus": "straight",
    "straight and to the side": "alternating",
    "tips and poses searched": "found",
}
_NOMINAL: tuple[Varied, float] = "N", 11
_AT_POINT, _DENSITY = "|error| at a point, µm", "density, 1/µm"
_COLOURS = AFTER, BEFORE, MARK, GREEN
_COLOUR: Mapping[Known, str] = {"S": AFTER, "P": BEFORE, "B": GREEN}


def rows(r: Results) -> list[Row]:
    """Printed numbers, of which the publication has few, and what belongs beside them."""
    found = [
        Row("balls", 11, NOMINAL[0], "1"),
        Row("offset a", 30, 1e3 * NOMINAL[1], "mm"),
        Row("offset b", 30, 1e3 * NOMINAL[2], "mm"),
        Row("standard deviation of reference distances", 2, PAIR_UM, "um"),
        Row("poses", 12, nominal_poses().rotation.shape[0], "1"),
        Row("points of the grid", 60 * 20 * 20, float(GRID[0] * GRID[1] * GRID[2]), "1"),
        Row("machines of a campaign", None, float(r.draws), "1"),
        Row("rms before compensation", None, r.before_um[0], "um", "aligned, expected"),
        Row("rms before compensation, raw", None, r.before_um[1], "um", "expected"),
    ]

    def add(what: str, known: Known, value: float, note: str, unit: str = "um") -> None:
        found.append(Row(f"{what}, {known}", None, value, unit, note))

    for k in KNOWN:
        nominal, best = r.theory[k][_NOMINAL], min(r.plain[k], key=lambda p: p.aligned_um)
        add("rms, nominal design", k, nominal.aligned,
            f"aligned, expected; the bound of all linear estimates; raw {nominal.raw:.2f} um; "
            f"{r.fresh} drawn machines {r.nominal[k].rms:.3f} um")  # fmt: skip
        add("rms, plain least squares", k, best.aligned_um,
            f"order {best.order}, {best.rank} of {best.columns} columns seen; "
            f"ratio {nominal.aligned / best.aligned_um:.3f}")  # fmt: skip
        for name in FREEDOMS:
            if name in r.searched[k]:
                one = r.searched[k][name]
                note = (
                    f"expected; {100 * one.optimised.gain:.1f} % below nominal; {r.fresh} fresh "
                    f"machines {one.checked.rms:.3f} um, theory {100 * one.off:+.1f} %"
                )
                add(f"rms, {name}", k, one.optimised.rms_um, note)
        star, cheapest = r.star[k], r.trade[k].cheapest()
        add("rms, star stylus", k, star.alternating,
            f"equal touches, same poses; {100 * star.gain:.1f} % below one stylus; with tips "
            f"and poses searched {star.found:.3f} um")  # fmt: skip
        if cheapest is not None:
            note = (
                f"{cheapest.count} poses of {cheapest.balls} balls, {cheapest.rms_um:.3f} um; "
                f"{100 * cheapest.seconds / NOMINAL_S:.0f} % of {NOMINAL_S:.0f} s"
            )
            add("time for the nominal rms", k, cheapest.seconds, note, "s")
        for name, cost in r.costs[k].items():
            what = f"{SIZES[name][0]}: {SIZES[name][1]:g}" if name in SIZES else ""
            add(f"rms, influence {name}", k, cost.ignored,
                f"ignored; identified {cost.identified:.3f} um. {what}".strip())  # fmt: skip
    return found


def record(r: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""

    def machines(one: Drawn | None) -> dict[str, Any] | None:
        return picked(one, "rms_um=rms", "failed", "gradients") if one else None

    def design(poses: ArrayPoses) -> dict[str, Any]:
        return {
            "balls_mm": 1e3 * np.asarray(poses.balls),
            "rotation": np.asarray(poses.rotation),
            "origin_mm": 1e3 * np.asarray(poses.origin),
        }

    start = ("rms_um=value", "from_um=start", "steps=iterations", "converged")
    return {
        "settings": {
            "observable": "coordinates of touches; distances for plain least squares",
            "probe_um": PROBE_UM,
            "pair_um": PAIR_UM,
            "tool_mm": [1e3 * v for v in TOOL],
            "table_one": TABLE_ONE,
            "waves": WAVES,
            "squareness_urad": SQUARENESS_URAD,
            "poses": {
                name: [{"centre_mm": [1e3 * v for v in p.centre], "direction": p.direction}
                       for p in make()]
                for name, make in POSES.items()
            },
        },
        "before_um": {"aligned": r.before_um[0], "raw": r.before_um[1]},
        "pose_sets_um": r.sets,
        "plain_least_squares": {k: [asdict(p) for p in r.plain[k]] for k in KNOWN},
        "sweeps": {
            k: [
                {"varied": varied, "value": value, "aligned_um": t.aligned, "raw_um": t.raw,
                 "plain_um": t.plain.aligned_um, "plain_order": t.plain.order,
                 "machines": machines(r.exact[k].get((varied, value)))}
                for (varied, value), t in r.theory[k].items()
            ]
            for k in KNOWN
        },
        "influences": {
            "assumed": {n: {"what": w, "sigma": s} for n, (w, s) in SIZES.items()},
            "conditions": {"axes_K": WARM_K, "tau_h": TAU_H, "air_K": AIR_K, "load_kg": LOAD_KG},
            "rms_um": {k: {n: asdict(c) for n, c in r.costs[k].items()} for k in KNOWN},
            "machines_S": {name: machines(one) for name, one in r.influenced.items()},
        },
        "searched": {
            k: {
                name: {**picked(one.optimised, "rms_um", "nominal_um", "gain"),
                       "machines": machines(one.checked),
                       "starts": [picked(f, *start) for f in one.optimised.found],
                       "design": design(one.optimised.poses)}
                for name, one in r.searched[k].items()
            }
            for k in KNOWN
        },
        "nominal": {k: machines(one) for k, one in r.nominal.items()},
        "star_stylus": {
            k: picked(s, "straight_um=straight", "alternating_um=alternating", "searched_um=found",
                      "gain") for k, s in r.star.items()
        },
        "time": {
            k: {"share_for_nominal": t.share,
                "designs": [
                    {**picked(d, "balls", "poses=count", "seconds"),
                     "exchange_um": d.chosen.rms_um, **picked(d.chosen, "bound_um"),
                     **picked(d, "rms_um", "freedom")} for d in t.designs],
                "front": [[d.balls, d.count] for d in t.front]}
            for k, t in r.trade.items()
        },
        "families": {
            shape: {**picked(one, "known", "names=families", "rms_um"),
                    "average_um": {name: one.average_um(name) for name in one.rms_um}}
            for shape, one in r.robust.items()
        },
    }  # fmt: skip


def _head(r: Results) -> tuple[str, list[Tile]]:
    nominal = {k: r.theory[k][_NOMINAL] for k in KNOWN}
    gains = [percent(r.searched[k][_SHORT["60 mm"]].optimised.gain) for k in KNOWN]
    shares = [DASH if (share := r.trade[k].share) is None else percent(share) for k in KNOWN]
    best = min(p.aligned_um for p in r.plain["S"])
    text = f"""\
The artefact of {NOMINAL[0]} balls in twelve poses brings a machine from {number(r.before_um[0])} µm
to {_each(t.aligned for t in nominal.values())} µm, depending on what the {PAIR_UM:g} µm of its
reference distances mean (S, P, B), if the family's own functions are identified with their prior;
plain least squares does not get below {number(best)} µm. The same balls in as many poses, placed by
gradient, leave {" / ".join(gains)} less.
"""
    aligned = [number(t.aligned) for t in nominal.values()]
    tiles = [
        Tile("expected error, nominal", f"{aligned[0]} µm",
             f"S; P {aligned[1]}, B {aligned[2]} µm"),
        Tile("plain least squares", f"{number(best)} µm", "best order of 1 to 5, S"),
        Tile("poses and balls by gradient", f"−{gains[0]}",
             f"S; P −{gains[1]}, B −{gains[2]}, within 60 mm"),
        Tile("time for the nominal error", shares[0], f"S; P {shares[1]}, B {shares[2]}"),
    ]  # fmt: skip
    return text, tiles


def _each(values: Iterable[float]) -> str:
    return " / ".join(number(v) for v in values)


def _caption(r: Results, varied: str) -> str:
    return (
        f"The publication's {_SWEEPS[varied][2]}: N = {NOMINAL[0]}, a = b = {1e3 * NOMINAL[1]:g} "
        f"mm but for what varies. Lines: theory. Dots: {r.draws} machines. Least squares: the best "
        "order of 1 to 5, artefact S."
    )


def _cheapest(r: Results, known: Known) -> str:
    d = r.trade[known].cheapest()
    if d is None:
        return f"{known}: none of these designs reaches the nominal error."
    return (
        f"{known}: {d.count} poses of {d.balls} balls reach {number(d.rms_um)} µm in "
        f"{number(d.seconds / 60.0)} min, {percent(d.seconds / NOMINAL_S)} of the nominal time, "
        f"for nominally {number(r.trade[known].nominal_um)} µm."
    )


def _worst(r: Results) -> float:
    return max(abs(one.off) for own in r.searched.values() for one in own.values())


def _relative(r: Results) -> float:
    """Relative standard uncertainty of the rms of a campaign."""
    square = (r.exact["S"][_NOMINAL].after.reshape(r.draws, -1) ** 2).mean(1)
    return float(0.5 * square.std() / square.mean() / np.sqrt(r.draws))


def _robust(r: Results, i: int) -> tuple[str, Robust]:
    return list(r.robust.items())[i]


def _sweeps(r: Results) -> Table:
    drawn = {(k, key): one.rms for k in KNOWN for key, one in r.exact[k].items()}
    sweeps = []
    for key, t in r.theory["S"].items():
        varied, value = key
        name = f"N = {value}" if varied == "N" else f"{varied} = {1e3 * value:g} mm"
        both = [v for k in KNOWN for v in (r.theory[k][key].aligned, drawn.get((k, key)))]
        sweeps.append((name, *both, f"{number(t.plain.aligned_um)} ({t.plain.order})"))
    header = "design | S | drawn | P | drawn | B | drawn | least squares (order)"
    return table(header, sweeps, fold="All designs")


def _searched(r: Results) -> Table:
    header = "free | artefact | expected, µm | gain | drawn, µm | theory less drawn"
    nominal = [
        ("nominal", k, r.theory[k][_NOMINAL].aligned, "", r.nominal[k].rms, "") for k in KNOWN
    ]
    found = [
        (name, k, one.optimised.rms_um, f"−{percent(one.optimised.gain)}", one.checked.rms,
         f"{100 * one.off:+.1f} %")
        for name in r.searched["S"] for k in KNOWN for one in [r.searched[k][name]]
    ]  # fmt: skip
    return table(header, nominal + found)


def _families(shape: str, one: Robust) -> Table:
    return table(
        " | ".join([shape, *one.families, "average"]),
        [(name if name == NOMINAL_DESIGN else f"optimised for {name}", *values,
          one.average_um(name)) for name, values in one.rms_um.items()],
    )  # fmt: skip


def _results(r: Results) -> dict[str, dict[Known, Searched]]:
    """What was searched, by short names."""
    return {short: {k: r.searched[k][name] for k in KNOWN} for short, name in _SHORT.items()}


def _before(r: Results) -> Mark:
    before = r.exact["S"][_NOMINAL].before
    edges = np.linspace(0.0, float(np.quantile(before, 0.999)), 50)
    return mark("hist", before, edges, density=True, color=GREY)


def _family(r: Results) -> Figure:
    x = 1e3 * np.linspace(*TRAVEL["X"], PLACES)
    return panels(
        [Panel("EXX of drawn machines", "X, mm", "µm",
               [mark("plot", x, values, lw=1.1, color=_COLOURS[i % 4])
                for i, values in enumerate(r.functions)]),
         Panel("Volumetric error, not compensated", _AT_POINT, _DENSITY, [_before(r)])],
        width=9.6, height=3.3,
    )  # fmt: skip


def _distributions(r: Results) -> Figure:
    after = {n: r.exact["S"]["N", n].after for n in (5, 11, 17)}
    most = np.linspace(0.0, max(float(np.quantile(v, 0.998)) for v in after.values()), 50)
    return panels(
        [Panel("before compensation", _AT_POINT, _DENSITY, [_before(r)]),
         Panel("after compensation", _AT_POINT, _DENSITY,
               [mark("hist", v, most, density=True, histtype="step", lw=1.6, color=colour,
                     label=f"{n} balls")
                for (n, v), colour in zip(after.items(), (MARK, AFTER, GREEN), strict=True)],
               "inside")],
        width=8.2, height=3.4,
    )  # fmt: skip


def _gains(r: Results) -> Figure:
    found = _results(r)
    return _bars(
        "Twelve poses of eleven balls, searched by gradient",
        {"nominal": {k: r.theory[k][_NOMINAL].aligned for k in KNOWN},
         **{n: {k: one.optimised.rms_um for k, one in by.items()}
            for n, by in found.items()}},
        {"nominal": {k: r.nominal[k].rms for k in KNOWN},
         **{n: {k: one.checked.rms for k, one in by.items()} for n, by in found.items()}},
    )  # fmt: skip


def _artefacts(r: Results) -> Figure:
    shapes = {"nominal": nominal_poses()} | {
        f"found for {k}, {short}": r.searched[k][_SHORT[short]].optimised.poses
        for k in KNOWN[:2] for short in ("60 mm", "250 mm")
    }  # fmt: skip
    balls = {name: 1e3 * np.asarray(poses.balls) for name, poses in shapes.items()}
    high = 1.15 * max(float(np.abs(b[:, 1:]).max()) for b in balls.values())
    return panels(
        *([Panel("" if i > 1 else name, "x, mm", f"{'xyz'[i]}, mm",
                 [mark("plot", b[:, 0], b[:, i], "-", color=DOTS, lw=0.8),
                  mark("plot", b[:, 0], b[:, i], "o", color=AFTER, ms=6)],
                 settings={"ylim": (-high, high)}) for i in (1, 2)]
          for name, b in balls.items()),
        width=9.6, height=2.0 * len(balls) + 0.5,
    )  # fmt: skip


def _bars(title: str, series: Any, dots: Any = None, width: float = 9.0) -> Figure:
    marks = bars(series, dots=dots, dots_label="drawn machines")
    panel = Panel(title, "", "rms on the grid, µm", marks, "right")
    return panels([panel], width=width, height=3.4)


def _sweep(r: Results, varied: Any) -> Figure:
    """Expected error against one number of the design: lines theory, dots drawn machines."""
    title, label, _ = _SWEEPS[varied]
    values, factor = (BALLS, 1.0) if varied == "N" else (OFFSETS, 1e3)
    x = [factor * v for v in values]
    plain = [r.theory["S"][varied, v].plain.aligned_um for v in values]
    marks = [mark("plot", x, plain, "s--", color=GREY, ms=4, lw=1.0, label="least squares")]
    for k, colour in _COLOUR.items():
        line = [r.theory[k][varied, v].aligned for v in values]
        drawn = [one.rms if (one := r.exact[k].get((varied, v))) else np.nan for v in values]
        marks.append(mark("plot", x, line, "-", color=colour, lw=1.6, label=k))
        marks.append(mark("plot", x, drawn, "o", color=colour, ms=5, mfc="white"))
    ticks = [1, 2, 5, 10, 20]
    marks += [
        mark("plot", [], [], "o", color=INK, ms=5, mfc="white", label="drawn machines"),
        mark("set_yscale", "log"),
        mark("set_yticks", ticks, list(map(str, ticks))),
        mark("minorticks_off"),
    ]
    panel = Panel(f"Error and {title}", label, "rms on the grid, µm", marks, "right")
    return panels([panel], width=6.4, height=3.6)


def _front(r: Results) -> Panel:
    """Error against measuring time; the nominal design as a cross."""
    marks = []
    for k, t in r.trade.items():
        style = {"color": _COLOUR[k]}
        line = [(d.seconds / 3600.0, d.rms_um) for d in t.front]
        marks.append(mark("plot", *zip(*line, strict=True), "o-", ms=4.5, lw=1.2, label=k, **style))
        marks.append(mark("plot", NOMINAL_S / 3600.0, t.nominal_um, "x", ms=9, mew=2, **style))
        marks += [
            mark("annotate", f"{d.count} x {d.balls}", place, fontsize=7, color=INK,
                 xytext=(3, 4), textcoords="offset points")
            for d, place in zip(t.front, line, strict=True) if k == "P"
        ]  # fmt: skip
    label = "nominal 12 x 11"
    marks.append(mark("plot", [], [], "x", color=INK, ms=8, mew=2, ls="", label=label))
    return Panel("Error against measuring time", "measuring time, h", "expected rms, µm", marks,
                 "right", {"ylim": (0.0, None)})  # fmt: skip


TEXTS: dict[str, Callable[[Results], str]] = {
    "The machine before": lambda r: f"""\
Errors of the family of Table 1 amount to {number(r.before_um[0])} µm (root mean square over
{" x ".join(map(str, GRID))} points and all machines) after the best rigid alignment, to
{number(r.before_um[1])} µm without. An artefact whose poses are unknown cannot see a rigid motion
of the whole work space: only the aligned figure can be lowered. It is given below unless stated
otherwise.
:family Left: EXX of {len(r.functions)} machines (the publication's Fig. 4). Right: error of
{r.draws} machines at points of the grid, after rigid alignment (its Fig. 5).
""",
    "Balls and offsets": lambda r: f"""\
More balls and larger offsets lower the error, as published, for every meaning of the {PAIR_UM:g}
µm: S, distances of one artefact that is the same in all poses; P, distances with a new error in
every pose; B, ball centres. All designs meet the same machines.

Plain least squares fits Legendre polynomials to the distances of all pairs. The family has waves
that polynomials of these orders cannot follow and that a few balls alias: orders of two and more
can be worse than none. With the family's own functions and their prior the estimate is the best
linear one, and the lines are that bound. Not aligned, {number(r.theory["S"][_NOMINAL].raw)} µm are
left of {number(r.before_um[1])} µm: rigid motion, which no pose sees.
:sweeps rms on the grid, µm: theory and {r.draws} drawn machines; least squares: the best order, S.
:plain Plain least squares of least norm at the nominal design, µm.
:sets Three sets of twelve diagonals; the publication's figure does not say which. All results are
judged against the first, the strongest. µm.
:sweep_N {_caption(r, "N")}
:sweep_a {_caption(r, "a")}
:sweep_b {_caption(r, "b")}
:distributions Error at single points of {r.draws} machines, before and after compensation (Fig. 9),
artefact S.
""",
    "Heat and weight": lambda r: f"""\
What the publication leaves for later, as effects in the truth: the axes warm up by {WARM_K:g} K
with a time constant of {TAU_H:g} h while the artefact is measured, the air swings by {AIR_K:g} K,
the ram carries {LOAD_KG:g} kg, the artefact grows and sags with its inclination. The machine is
judged at 20 °C with the load.

With all of them, {r.draws} machines drawn with exact kinematics have
{number(r.influenced["ignored"].rms)} µm if they are ignored (theory
{number(r.costs["S"]["all"].ignored)} µm), {number(r.influenced["identified"].rms)} µm if they are
identified as well (theory {number(r.costs["S"]["all"].identified)} µm).
:costs Expected rms on the grid, µm; assumed: standard deviation. The sag of the ram is
{number(r.costs['S']['ram sags'].size)} µm of the machine's own error.
:influences Expected error after compensation with one influence in the truth, and with all.
""",
    "Poses and balls by gradient": lambda r: f"""\
Expected error as a function of orientations, places and balls, minimised along its exact gradient
from several starts. Balls keep to the travel, 50 mm from each other and {1e3 * LENGTH:g} mm from
first to last. Every design found was then judged on {r.fresh} machines that the search did not use;
theory was off by {percent(_worst(r))} at most.
:searched
:gains Bars: theory. Dots: {r.fresh} fresh machines with exact kinematics.
:artefacts Balls of the artefacts, from above (left) and from the side, 1500 mm long.
:poses The artefact in its twelve poses, in the work space of the tool point.
""",
    "Error against time": lambda r: f"""\
A pose takes {SETUP_S:g} s, a ball {BALL_S:g} s, the nominal design {number(NOMINAL_S / 60.0)} min.
For every number of balls and poses the poses were chosen out of many by exchange; the bound holds
for every other choice from these. Then the gradient moved poses and balls, within 60 mm.
- {_cheapest(r, "S")}
- {_cheapest(r, "P")}
- {_cheapest(r, "B")}
:designs
:time Designs that no other one beats in both, poses x balls at the line of P; the others have the
same. Crosses: the nominal one.
""",
    "A star stylus": lambda r: f"""\
Every second ball of a pose is touched with a stylus {1e3 * SIDE_M:g} mm to the side, as many
touches in the same poses. With one tip the rotations of Z move all touches of a pose alike, which
its unknown place takes up; two tips see them. In the last column tips (by as much again) and poses
were searched by gradient.
:stylus
:star Expected error. First two: the nominal poses.
""",
    "If the machine is another one": lambda r: f"""\
Designs against families of machines, each identified with its own prior: the gain of a design that
was searched for one family, and of one that was searched for the average over all. With many
touches the prior has little weight, and the design hardly matters; with few of them it does.
:families_0 Expected rms, µm, artefact {_robust(r, 0)[1].known}; average: root mean square.
:families_1 Expected rms, µm, artefact {_robust(r, 1)[1].known}; average: root mean square.
""",
    "All numbers": lambda r: """\
The publication prints what it assumes; its results are in figures without numbers.
:numbers
""",
    "What is printed and what is assumed": lambda r: f"""\
- Printed: chain [w b X Y Z t] and work space, Table 1, the balls and their offsets, {PAIR_UM:g} µm,
twelve diagonal poses, the grid.
- Assumed: the tool ({", ".join(f"{1e3 * v:g}" for v in TOOL)}) mm; a touch is off by {PROBE_UM:g}
µm in every direction; all observed are coordinates of touches, with six unknowns per pose (the
distances of the publication for plain least squares).
- Table 1 names two squarenesses B; the third is taken to be EC0Y. All three are uniform within
±{SQUARENESS_URAD:g} µrad.
- Offsets: a to either side in turn, b up and down in pairs.
- Sets of twelve poses: {", ".join(f"“{name}”" for name in POSES)}; centres and directions are in
result.json.
- Uncertainty of a campaign's rms: about {percent(_relative(r))}, from {r.draws} machines.
""",
}  # fmt: skip

SHOWN: dict[str, Callable[[Results], Table | Figure]] = {
    "sweeps": _sweeps,
    "plain": lambda r: table(
        f"order | columns seen | {' | '.join(KNOWN)} | raw, S",
        [(p.order, f"{p.rank} of {p.columns}", *(r.plain[k][i].aligned_um for k in KNOWN),
          p.raw_um) for i, p in enumerate(r.plain["S"])],
    ),
    "sets": lambda r: table(f"poses | {' | '.join(KNOWN)}",
                  [(name, *(own[k] for k in KNOWN)) for name, own in r.sets.items()]),
    "costs": lambda r: table(
        "influence | assumed | S ignored | identified | P ignored | identified | B ignored | "
        "identified",
        [(name, f"{SIZES[name][1]:g} {unit(SIZES[name][0].split(', ')[-1])}"
          if name in SIZES else "", *(v for k in KNOWN for v in
          (r.costs[k][name].ignored, r.costs[k][name].identified))) for name in r.costs["S"]],
    ),
    "searched": _searched,
    "designs": lambda r: table(
        "artefact | poses x balls | min | share | exchange, µm | bound, µm | gradient, µm | "
        "on the front",
        [(k, f"{d.count} x {d.balls}", d.seconds / 60.0, percent(d.seconds / NOMINAL_S),
          d.chosen.rms_um, d.chosen.bound_um, d.rms_um, "yes" if d in t.front else "")
         for k, t in r.trade.items() for d in t.designs],
        fold="All designs",
    ),
    "stylus": lambda r: table(
        "artefact | straight, µm | alternating, µm | gain | searched, µm",
        [(k, s.straight, s.alternating, f"−{percent(s.gain)}", s.found)
         for k, s in r.star.items()],
    ),
    "families_0": lambda r: _families(*_robust(r, 0)),
    "families_1": lambda r: _families(*_robust(r, 1)),
    "family": _family,
    "sweep_N": lambda r: _sweep(r, "N"),
    "sweep_a": lambda r: _sweep(r, "a"),
    "sweep_b": lambda r: _sweep(r, "b"),
    "distributions": _distributions,
    "influences": lambda r: _bars(
        "Influences in the truth, artefact S",
        {name: {n: getattr(c, name) for n, c in r.costs["S"].items()}
         for name in ("ignored", "identified")},
        {n: {"all": one.rms} for n, one in r.influenced.items()}, 10.5,
    ),
    "gains": _gains,
    "artefacts": _artefacts,
    "poses": lambda r: spaces(
        {name: [mark("plot", *balls.T, "o-", color=_COLOURS[i % 4], ms=2.6, lw=0.8)
                for i, balls in enumerate(1e3 * np.asarray(one.centres))]
         for name, one in (
             ("nominal", nominal_poses()),
             ("found for S, 60 mm", r.searched["S"][_SHORT["60 mm"]].optimised.poses))},
        np.array([TRAVEL[c] for c in "XYZ"]) + np.array(TOOL)[:, None], 4.6,
    ),
    "time": lambda r: panels([_front(r)], width=8.2, height=4.2),
    "star": lambda r: _bars(
        "A star stylus, equal touches",
        {label: {k: getattr(r.star[k], name) for k in KNOWN} for label, name in _TIPS.items()},
        width=8.2,
    ),
}  # fmt: skip

ARTEFACT_DESIGN = Reproduction(
    name="artefact-design",
    summary="A ball artefact and its poses designed for a machine tool: Aguirre et al. 2019",
    title="A ball artefact and its poses, designed",
    publication="Aguirre, Iñigo, Cilla, Urreta (2019), Optimal design of artefacts for machine "
    "tool calibration",
    compute=Results,
    rows=rows,
    record=record,
    head=_head,
    texts=TEXTS,
    shown=SHOWN,
    counted="machines",
    draws=MACHINES,
    least=LEAST,
)
