"""The page: what was asked, what came out, and what the publication leaves open."""

from collections.abc import Mapping, Sequence

import numpy as np

from ...report import Picture, Section, Table, Tile, sheet
from ...report.html.text import DASH, number, percent, unit
from ..registry import Row
from .influences import AIR_K, LOAD_KG, SIZES, TAU_H, WARM_K
from .results import Results
from .robust import NOMINAL_DESIGN
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
    TOOL,
)
from .stylus import SIDE_M
from .sweep import VARIED
from .timing import BALL_S, NOMINAL_S, SETUP_S

_WITHIN_60, _WITHIN_250 = "poses, balls within 60 mm", "poses, artefact within 250 mm"


def page(results: Results, rows: Sequence[Row], pictures: Mapping[str, tuple[Picture, ...]]) -> str:
    """The results as one self-contained HTML text."""
    r = results
    nominal = {k: r.theory[k]["N", 11] for k in KNOWN}
    gains = {k: r.searched[k][_WITHIN_60].optimised.gain for k in KNOWN}
    shares = {k: r.trade[k].share for k in KNOWN}
    best = {k: min(p.aligned_um for p in r.plain[k]) for k in KNOWN}
    summary = (
        f"The artefact of {NOMINAL[0]} balls in twelve poses brings a machine from "
        f"{number(r.before_um[0])} µm to {_each(nominal[k].aligned for k in KNOWN)} µm, depending "
        f"on what the {PAIR_UM:g} µm of its reference distances mean (S, P, B), if the family's "
        f"own functions are identified with their prior; plain least squares does not get below "
        f"{number(best['S'])} µm. The same balls in as many poses, placed by gradient, leave "
        f"{_each_percent(gains.values())} less."
    )
    tiles = [
        Tile("expected error, nominal", f"{number(nominal['S'].aligned)} µm",
             f"S; P {number(nominal['P'].aligned)}, B {number(nominal['B'].aligned)} µm"),
        Tile("plain least squares", f"{number(best['S'])} µm", "best order of 1 to 5, S"),
        Tile("poses and balls by gradient", f"−{percent(gains['S'])}",
             f"S; P −{percent(gains['P'])}, B −{percent(gains['B'])}, within 60 mm"),
        Tile("time for the nominal error", _share(shares["S"]),
             f"S; P {_share(shares['P'])}, B {_share(shares['B'])}"),
    ]  # fmt: skip
    sections = [
        _family(r, pictures["family"]),
        _sweeps(r, pictures["sweeps"]),
        _influences(r, pictures["influences"]),
        _searched(r, pictures["searched"]),
        _time(r, pictures["time"]),
        _star(r, pictures["star"]),
        _families(r),
        _table(rows),
        _settings(r),
    ]
    return sheet(
        "A ball artefact and its poses, designed",
        summary,
        sections,
        kicker="vcal – a published campaign, done again",
        facts=[
            ("publication", "Aguirre, Iñigo, Cilla, Urreta (2019), Optimal design of artefacts for "
             "machine tool calibration"),
            ("machines", f"{r.draws} per design, {r.fresh} for designs that were searched for, "
             f"exact kinematics, every one identified; seed {r.seed}"),
        ],
        tiles=tiles,
    )  # fmt: skip


def _each(values) -> str:
    return " / ".join(number(v) for v in values)


def _each_percent(values) -> str:
    return " / ".join(percent(v) for v in values)


def _share(value: float | None) -> str:
    return DASH if value is None else percent(value)


# --- sections ---


def _family(r: Results, pictures: tuple[Picture, ...]) -> Section:
    return Section(
        "The machine before",
        (
            f"Errors of the family of Table 1 amount to {number(r.before_um[0])} µm (root mean "
            f"square over {GRID[0]} x {GRID[1]} x {GRID[2]} points and all machines) after the "
            f"best rigid alignment, to {number(r.before_um[1])} µm without. An artefact whose "
            "poses are unknown cannot see a rigid motion of the whole work space: the aligned "
            "figure is what it can lower, and is meant below where nothing else is said.",
        ),
        pictures=pictures,
    )


def _sweeps(r: Results, pictures: tuple[Picture, ...]) -> Section:
    rows = []
    for varied in VARIED:
        for value in BALLS if varied == "N" else OFFSETS:
            key = varied, value
            name = f"{varied} = {value if varied == 'N' else 1e3 * value:g}"
            cells = [name + ("" if varied == "N" else " mm")]
            for known in KNOWN:
                drawn = r.exact[known].get(key)
                cells.append(number(r.theory[known][key].aligned))
                cells.append(DASH if drawn is None else number(drawn.rms))
            plain = r.theory["S"][key].plain
            cells.append(f"{number(plain.aligned_um)} ({plain.order})")
            rows.append(cells)
    plain = [
        (str(p.order), f"{p.rank} of {p.columns}", *(number(r.plain[k][i].aligned_um)
         for k in KNOWN), number(p.raw_um))
        for i, p in enumerate(r.plain["S"])
    ]  # fmt: skip
    sets = [(name, *(number(own[k]) for k in KNOWN)) for name, own in r.sets.items()]
    raw = r.theory["S"]["N", 11]
    return Section(
        "Balls and offsets",
        (
            "More balls and larger offsets lower the error, as published, for every meaning of the "
            f"{PAIR_UM:g} µm: S, distances of one artefact that is the same in all poses; P, "
            "distances that are off anew in every pose; B, ball centres. All designs meet the "
            "same machines.",
            "Plain least squares fits Legendre polynomials to the distances of all pairs. The "
            "family has waves that polynomials of these orders cannot follow and that a few balls "
            "alias: orders of two and more can be worse than none. With the family's own functions "
            "and their prior the estimate is the best linear one there is, and the lines are that "
            "bound.",
            f"Not aligned, {number(raw.raw)} µm are left of {number(r.before_um[1])} µm: rigid "
            "motion, which no pose sees.",
        ),
        tables=(
            Table(
                ("design", "S", "drawn", "P", "drawn", "B", "drawn", "least squares (order)"),
                rows,
                "lrrrrrrr",
                note=f"rms on the grid, µm: theory and {r.draws} drawn machines; least squares: "
                "the best order, S.",
                fold="All designs",
            ),
            Table(
                ("order", "columns seen", *KNOWN, "raw, S"),
                plain,
                "rrrrrr",
                note="Plain least squares of least norm at the nominal design, µm.",
            ),
            Table(
                ("poses", *KNOWN),
                sets,
                "lrrr",
                note="Three sets of twelve diagonals; the publication's figure does not say which. "
                "All results are judged against the first, the strongest. µm.",
            ),
        ),
        pictures=pictures,
    )


def _influences(r: Results, pictures: tuple[Picture, ...]) -> Section:
    rows = []
    for name in r.costs["S"]:
        what, sigma = SIZES.get(name, ("", 0.0))
        cells = [name, f"{sigma:g} {unit(what.split(', ')[-1])}" if what else ""]
        for known in KNOWN:
            cost = r.costs[known][name]
            cells += [number(cost.ignored), number(cost.identified)]
        rows.append(cells)
    both = r.influenced
    return Section(
        "Heat and weight",
        (
            "What the publication leaves for later, as effects in the truth: the axes warm up by "
            f"{WARM_K:g} K with a time constant of {TAU_H:g} h while the artefact is measured, the "
            f"air swings by {AIR_K:g} K, the ram carries {LOAD_KG:g} kg, the artefact grows and "
            "sags with its inclination. The machine is judged at 20 °C with the load.",
            f"With all of them, {r.draws} machines drawn with exact kinematics: "
            f"{number(both['ignored'].rms)} µm if they are ignored (theory "
            f"{number(r.costs['S']['all'].ignored)} µm), {number(both['identified'].rms)} µm if "
            f"they are identified as well (theory {number(r.costs['S']['all'].identified)} µm).",
        ),
        tables=(
            Table(
                ("influence", "assumed", "S ignored", "identified", "P ignored", "identified",
                 "B ignored", "identified"),
                rows,
                "llrrrrrr",
                note="Expected rms on the grid, µm; assumed: standard deviation. The sag of the "
                f"ram is {number(r.costs['S']['ram sags'].size)} µm of the machine's own error.",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _searched(r: Results, pictures: tuple[Picture, ...]) -> Section:
    rows = [
        ("nominal", k, number(r.theory[k]["N", 11].aligned), "", number(r.nominal[k].rms), "")
        for k in KNOWN
    ]
    for name in r.searched["S"]:
        for k in KNOWN:
            one = r.searched[k][name]
            rows.append(
                (name, k, number(one.optimised.rms_um), f"−{percent(one.optimised.gain)}",
                 number(one.checked.rms), f"{100 * one.off:+.1f} %")
            )  # fmt: skip
    worst = max(abs(one.off) for own in r.searched.values() for one in own.values())
    return Section(
        "Poses and balls by gradient",
        (
            "Expected error as a function of orientations, places and balls, minimised along its "
            "exact gradient from several starts. Balls keep to the travel, 50 mm from each other "
            f"and {1e3 * LENGTH:g} mm from first to last. Every design found was then judged on "
            f"{r.fresh} machines it never saw; theory was off by {percent(worst)} at most.",
        ),
        tables=(
            Table(
                ("free", "artefact", "expected, µm", "gain", "drawn, µm", "theory less drawn"),
                rows,
                "llrrrr",
            ),
        ),
        pictures=pictures,
    )


def _time(r: Results, pictures: tuple[Picture, ...]) -> Section:
    rows = []
    for k in KNOWN:
        for d in r.trade[k].designs:
            rows.append(
                (k, f"{d.count} x {d.balls}", number(d.seconds / 60.0), percent(
                    d.seconds / NOMINAL_S), number(d.chosen.rms_um), number(d.chosen.bound_um),
                 number(d.rms_um), "yes" if d in r.trade[k].front else "")
            )  # fmt: skip
    found = []
    for k in KNOWN:
        cheapest = r.trade[k].cheapest()
        if cheapest is None:
            found.append(f"{k}: none of these designs reaches the nominal error.")
        else:
            found.append(
                f"{k}: {cheapest.count} poses of {cheapest.balls} balls reach "
                f"{number(cheapest.rms_um)} µm in {number(cheapest.seconds / 60.0)} min, "
                f"{percent(cheapest.seconds / NOMINAL_S)} of the nominal time, for nominally "
                f"{number(r.trade[k].nominal_um)} µm."
            )
    return Section(
        "Error against time",
        (
            f"A pose takes {SETUP_S:g} s, a ball {BALL_S:g} s, the nominal design "
            f"{number(NOMINAL_S / 60.0)} min. For every number of balls and poses the poses were "
            "chosen out of many by exchange; the bound says what no other choice from these goes "
            "below. Then the gradient moved poses and balls, within 60 mm.",
        ),
        points=tuple(found),
        tables=(
            Table(
                ("artefact", "poses x balls", "min", "share", "exchange, µm", "bound, µm",
                 "gradient, µm", "on the front"),
                rows,
                "llrrrrrl",
                fold="All designs",
            ),
        ),
        pictures=pictures,
    )  # fmt: skip


def _star(r: Results, pictures: tuple[Picture, ...]) -> Section:
    rows = [
        (k, number(s.straight), number(s.alternating), f"−{percent(s.gain)}", number(s.found))
        for k, s in r.star.items()
    ]
    return Section(
        "A star stylus",
        (
            f"Every second ball of a pose is touched with a stylus {1e3 * SIDE_M:g} mm to the "
            "side, as many touches in the same poses. With one tip the rotations of Z move all "
            "touches of a pose alike, which its unknown place takes up; two tips see them. In the "
            "last column tips (by as much again) and poses were searched by gradient.",
        ),
        tables=(
            Table(
                ("artefact", "straight, µm", "alternating, µm", "gain", "searched, µm"),
                rows,
                "lrrrr",
            ),
        ),
        pictures=pictures,
    )


def _families(r: Results) -> Section:
    tables = []
    for shape, one in r.robust.items():
        rows = [
            (name if name == NOMINAL_DESIGN else f"optimised for {name}",
             *(number(v) for v in values), number(one.average_um(name)))
            for name, values in one.rms_um.items()
        ]  # fmt: skip
        tables.append(
            Table(
                (shape, *one.families, "average"),
                rows,
                "l" + "r" * (len(one.families) + 1),
                note=f"Expected rms, µm, artefact {one.known}; average: root mean square.",
            )
        )
    return Section(
        "If the machine is another one",
        (
            "Designs against families of machines, each identified with its own prior: what a "
            "design gains that was searched for one family, and one that was searched for the "
            "average over all. Many touches outweigh the prior, and the design hardly matters; "
            "with few of them it does.",
        ),
        tables=tuple(tables),
    )


def _table(rows: Sequence[Row]) -> Section:
    lines = [
        (row.quantity, DASH if row.seed is None else f"{row.seed:g}", number(row.vcal, 4),
         unit(row.unit), row.note)
        for row in rows
    ]  # fmt: skip
    return Section(
        "All numbers",
        ("The publication prints what it assumes; its results are in figures without numbers.",),
        tables=(
            Table(("quantity", "printed", "vcal", "unit", "note"), lines, "lrrll", fold="Table"),
        ),
    )


def _settings(r: Results) -> Section:
    listed = ", ".join(f"“{name}”" for name in POSES)
    return Section(
        "What is printed and what is assumed",
        points=(
            "Printed: chain [w b X Y Z t] and work space, Table 1, the balls and their offsets, "
            f"{PAIR_UM:g} µm, twelve diagonal poses, the grid.",
            f"Assumed: the tool ({', '.join(f'{1e3 * v:g}' for v in TOOL)}) mm; a touch is off by "
            f"{PROBE_UM:g} µm in every direction; all observed are coordinates of touches, with "
            "six unknowns per pose (the distances of the publication for plain least squares).",
            "Table 1 names two squarenesses B; the third is taken to be EC0Y. All three are "
            f"uniform within ±{SQUARENESS_URAD:g} µrad.",
            "Offsets: a to either side in turn, b up and down in pairs.",
            f"Sets of twelve poses: {listed}; centres and directions are in result.json.",
            f"Uncertainty of a campaign's rms: about {percent(_relative(r))}, from "
            f"{r.draws} machines.",
        ),
    )


def _relative(r: Results) -> float:
    """Relative standard deviation of the rms over the machines of a campaign."""
    after = r.exact["S"]["N", 11].after.reshape(r.draws, -1)
    square = (after**2).mean(1)
    return float(0.5 * square.std() / square.mean() / np.sqrt(r.draws))
