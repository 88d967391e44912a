"""The page: what was asked, what came out, and what the publication leaves open."""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ...report import Picture, Section, Table, Tile, sheet
from ...report.html.text import COVERAGE, DASH, number, percent, rounded, unit
from ..registry import Row
from .results import Results, element, exz_of_the_circle, single_circle_U, true_z
from .setting import (
    DEVICE_U_UM,
    EXTERNAL_UM,
    INTERNAL_UM,
    LEVELS,
    MEASURED,
    MEASURED_M_S2,
    MOVE_RATIO,
    MOVE_UM,
    RADIUS_M,
    RANGE_MM,
    SAMPLES,
    SIMULATED,
    SIMULATED_M_S2,
    carriage_factors,
    circle,
)

_E = "µm s²/m"
_NONE = 1e-9
"""What is zero but for rounding, um s^2/m."""
_SEEN_UM = 1.0
"""Root mean square of an error that is worth taking off."""


def page(results: Results, rows: Sequence[Row], pictures: Mapping[str, tuple[Picture, ...]]) -> str:
    """The results as one self-contained HTML text."""
    r = results
    simulated, measured = exz_of_the_circle(r)
    there, joint = element(r.identified.matrix, "XZ"), element(r.joint.matrix, "XZ")
    U = COVERAGE * 1e6 * element(r.found.matrix_u, "XZ")
    peaks = [abs(one.move.at_peak_um) for one in (r.catalogue, r.identified, r.true)]
    summary = (
        f"The publication measures EXZ = {number(MEASURED)} {_E} and simulates "
        f"{number(SIMULATED)}: nothing was identified. Here stiffness, damping, centres of gravity "
        "and controller delay are identified from the circles of the R-test through the "
        "differentiable simulation: "
        f"{number(there, 4)} {_E} with U = {number(U, 2)}. The 20 mm positioning, which it never "
        f"saw, is foretold with {number(peaks[1])} µm of cross-talk where it has "
        f"{number(peaks[2])} µm; the catalogue foretells {number(peaks[0])} µm."
    )
    c = r.campaign
    within = float((np.abs(c.pulls) < COVERAGE).mean())
    tiles = [
        Tile("EXZ, measured, all circles", f"{number(joint, 4)} {_E}",
             f"one circle {number(measured)}; printed {number(MEASURED)}"),
        Tile("EXZ, catalogue", f"{number(simulated)} {_E}", f"printed {number(SIMULATED)}"),
        Tile("EXZ, identified", f"{number(there, 4)} {_E}", f"U = {number(U, 2)}, k = 2"),
        Tile("20 mm positioning", percent(abs(peaks[1] / peaks[2] - 1.0)),
             f"off; catalogue {percent(abs(peaks[0] / peaks[2] - 1.0))}"),
        Tile("within U", percent(within), f"of {c.pulls.size} values of {len(c.pulls)} machines"),
    ]  # fmt: skip
    sections = [
        _circles(r, pictures["circles"]),
        _evaluations(r, pictures["evaluations"]),
        _identified(r, pictures["identified"]),
        _moves(r, pictures["moves"]),
        _campaign(r, pictures["campaign"]),
        Section("Printed and found", tables=(_printed(rows),)),
        _settings(r),
    ]
    return sheet(
        "Acceleration-correlated errors",
        summary,
        sections,
        kicker="vcal reproduce acceleration",
        facts=[
            ("publication", "Nguyen, Weikert, Wegener: measurement and simulation of acceleration "
             "correlated position errors in machine tools, IWF, ETH Zürich"),
            ("draws", f"{r.draws} machines, seed {r.seed}"),
        ],
        tiles=tiles,
    )  # fmt: skip


def _circles(r: Results, pictures: tuple[Picture, ...]) -> Section:
    return Section(
        "Circles",
        (
            "The publication says of its machine nothing but its readings. Two machines stand in "
            "for it: one by a catalogue, with usual masses and stiffnesses, chosen so that it "
            "gives the cross-talk that was simulated, and one whose carriages have "
            f"{_listed(carriage_factors().values())} of that stiffness (X, Y, Z), chosen so that "
            "it gives the one that was measured. The second is what is measured below, and nothing "
            "of it is known to the identification.",
        ),
        pictures=pictures,
    )


def _evaluations(r: Results, pictures: tuple[Picture, ...]) -> Section:
    ways = r.measured.ways
    rows = []
    for i, first in enumerate("XYZ"):
        for j, second in enumerate("XYZ"):
            value, u = rounded(r.joint.matrix[i, j], r.joint.u[i, j])
            rows.append(
                (
                    f"E{first}{second}",
                    _value(r.true.matrix[i, j]),
                    value,
                    u,
                    _value(ways["actual"].at(MEASURED_M_S2)[i, j]),
                    _value(ways["nominal"].at(MEASURED_M_S2)[i, j]),
                )
            )
    far = np.array([r.measured.ratio[a] for a in LEVELS])
    joint, bare = (COVERAGE * element(e.u, "XZ") for e in (r.joint, r.joint_no_device))
    scatter = ways["actual"].dispersion(r.joint.matrix)
    fastest = circle("YZ", max(LEVELS)).omega / math.tau
    amplified = (fastest / float(r.true.hz[0])) ** 2
    return Section(
        "From circles to the matrix",
        (
            "All circles at once, with the offset of every run and the errors of the probes as "
            "unknowns, give the matrix with its covariance. Beside it stands the publication's "
            "way, circle by circle: a plane across, an even ellipse within after the tilt has "
            "been taken out; the mean of the circles "
            f"at {MEASURED_M_S2:g} m/s².",
            f"The device's U of {DEVICE_U_UM:g} µm (k = 2) is an input: an error of sensitivity or "
            "direction grows with the radius, as what acceleration does to one circle. A circle at "
            f"{MEASURED_M_S2:g} m/s² alone has therefore U = {number(single_circle_U(), 2)} {_E}, "
            f"whatever its noise; circles of several levels tell the two apart, and U of EXZ is "
            f"{number(joint, 2)} ({number(bare, 2)} if noise were all).",
            f"The closed loop travels {number(float(np.nanmin(far)))} to "
            f"{number(float(np.nanmax(far)))} of the set radius. Who normalises to the set circle, "
            "as eqs. (5) and (6) do, takes its acceleration for the nominal one, and scales the "
            "matrix by that ratio.",
            f"All circles at once are up to {percent(amplified)} above what is put in: their "
            f"{number(fastest)} Hz are not infinitely far below the first mode at "
            f"{number(float(r.true.hz[0]))} Hz, (f/f₁)². The identified machine knows of that.",
            "At low accelerations single circles are farther off, as the publication reports "
            f"(its section 2.4): {number(scatter[min(scatter)], 2)} {_E} at {min(scatter):g} m/s², "
            f"{number(scatter[max(scatter)], 2)} at {max(scatter):g} m/s².",
        ),
        tables=(
            Table(
                ("", "put in", "all circles", "u", "plane, ellipse", "the same, nominal"),
                rows,
                "lrrrrr",
                note=f"{_E}; put in is the quasi-static compliance of the machine. The last column "
                f"takes nominal accelerations; the last two are of {MEASURED_M_S2:g} m/s² alone.",
            ),
        ),
        pictures=pictures,
    )


def _identified(r: Results, pictures: tuple[Picture, ...]) -> Section:
    f = r.found
    rows = []
    for unknown, value, (low, high), told, z in zip(
        f.unknowns, f.values, f.interval(), f.told, true_z(), strict=True
    ):
        # A delay is a difference, which is zero to rounding where nothing was changed.
        put_in = round(float(unknown.value(z, f.declared)), 9) + 0.0
        rows.append(
            (
                unknown.name,
                unit(unknown.unit) or "× catalogue",
                number(put_in),
                number(value, 4),
                f"{number(low, 4)} … {number(high, 4)}",
                percent(told) if told >= 0.001 else DASH,
            )
        )
    names = ("XX", "XY", "XZ", "YX", "YY", "YZ", "ZX", "ZY", "ZZ")
    matrix = [
        (
            f"E{name}",
            _value(element(r.catalogue.matrix, name)),
            _value(element(r.catalogue_matrix_u, name), 2),
            _value(element(r.identified.matrix, name), 4),
            _value(COVERAGE * 1e6 * element(f.matrix_u, name), 2),
            _value(element(r.true.matrix, name), 4),
        )
        for name in names
    ]
    low, high = (float(x) for x in (r.catalogue.hz[0], r.true.hz[0]))
    return Section(
        "From circles to the machine",
        (
            "Twelve unknowns, each with what a catalogue leaves open: stiffness of carriages and "
            "drives and the foundation's by a factor, places of centres of gravity, damping, "
            "delay of the controllers. The amplitudes of scales and sphere on all circles are "
            f"fitted through the simulation ({f.readings} numbers, squared differences "
            f"{number(f.chi2)}).",
            f"First natural frequency: {number(low)} Hz by the catalogue, {number(high)} Hz of the "
            f"machine, {number(float(r.identified.hz[0]))} Hz identified.",
            *(("The circles cannot tell:",) if f.not_told() else ()),
        ),
        points=tuple(f.not_told()),
        tables=(
            Table(
                ("unknown", "unit", "put in", "found", "k = 2", "told"),
                rows,
                "llrrrr",
                note="Told: share of the catalogue's variance that the circles take away.",
            ),
            Table(
                ("", "catalogue", "its u", "identified", "U", "put in"),
                matrix,
                "lrrrrr",
                note=f"{_E}; u of the catalogue by drawing from what it leaves open.",
            ),
        ),
        pictures=pictures,
    )


def _moves(r: Results, pictures: tuple[Picture, ...]) -> Section:
    move = r.catalogue.move
    simulated, _ = exz_of_the_circle(r)
    rows = [
        (
            name,
            number(a.largest_um),
            number(a.before_um),
            number(a.after_um),
            percent(a.left),
            percent(r.by_machine[name].left),
        )
        for name, a in r.by_circles.items()
    ]
    shown = [c for c in r.by_circles.values() if c.before_um > _SEEN_UM]
    worst = max(shown, key=lambda c: c.left)
    return Section(
        "Larger movements",
        (
            f"The set acceleration peaks at {number(move.set_peak, 4)} m/s², limited by jerk "
            f"alone; the actual one at {number(move.peak)} m/s², where the tool point is "
            f"{number(abs(move.at_peak_um))} µm aside: {number(move.ratio)} {_E}, against "
            f"{number(simulated)} on the circle. The publication prints {MOVE_UM:g} µm and "
            f"{number(MOVE_RATIO)}; its drop of {percent(1.0 - MOVE_RATIO / SIMULATED)} from "
            "circle to positioning does not come out of this machine, nor of any that was tried: "
            "below its first mode a structure answers to acceleration alike, whatever the "
            "movement.",
            "Valid for arbitrary movements is checked here: the matrix from circles is taken off "
            f"other moves of the machine, and leaves {percent(worst.left)} at most where there was "
            f"more than {_SEEN_UM:g} µm. What is left is vibration that the jerk excites, which no "
            "matrix can hold.",
        ),
        tables=(
            Table(
                ("movement", "largest", "rms", "rms after", "left", "left, E of the machine"),
                rows,
                "lrrrrr",
                note="µm, tool point against the scales, while the axes are accelerated.",
            ),
        ),
        pictures=pictures,
    )


def _campaign(r: Results, pictures: tuple[Picture, ...]) -> Section:
    c = r.campaign
    rows = [
        (
            unknown.name,
            number(float(np.median(c.u[c.converged, i])), 2),
            number(float(c.pulls[:, i].mean()), 2),
            number(float(c.pulls[:, i].std()), 2),
            percent(float((np.abs(c.pulls[:, i]) < COVERAGE).mean())),
        )
        for i, unknown in enumerate(c.unknowns)
    ]
    return Section(
        "Many machines",
        (
            f"{len(c.status)} machines drawn from what the catalogue leaves open, each measured by "
            f"{2 * 3 * len(LEVELS)} circles and identified from the catalogue on. The controllers "
            f"hold {int(c.stable.sum())} of them; {int(c.converged.sum())} searches found a "
            f"minimum, after {np.median(c.steps):g} steps (median). Squared differences per "
            f"degree of freedom: {number(float((c.chi2[c.converged] / c.readings).mean()))}.",
            "Where errors over standard uncertainties scatter by more than one, the problem is "
            "curved within its uncertainty: the linearised (GUM) uncertainty is then too small by "
            "that factor, and Monte Carlo says so.",
        ),
        tables=(
            Table(
                ("unknown", "u", "mean error / u", "sd of error / u", "within U"),
                rows,
                "lrrrr",
                note="u: median, in standard deviations of the catalogue.",
            ),
        ),
        pictures=pictures,
    )


def _printed(rows: Sequence[Row]) -> Table:
    return Table(
        ("quantity", "printed", "vcal", "unit", ""),
        [(r.quantity, number(r.seed, 4), number(r.vcal, 4), unit(r.unit), r.note) for r in rows],
        "lrrll",
    )


def _settings(r: Results) -> Section:
    return Section(
        "Settings",
        points=(
            f"Printed: radius {1e3 * RADIUS_M:g} mm, three planes, both senses; "
            f"{MEASURED_M_S2:g} and {SIMULATED_M_S2:g} m/s²; R-test with U = {DEVICE_U_UM:g} µm "
            f"and a range of ±{RANGE_MM:g} mm; positioning over 20 mm with 30 m/min, 10 m/s² and "
            "250 m/s³; cascaded PPI control.",
            f"Assumed: circles at {', '.join(f'{a:g}' for a in LEVELS)} m/s², {SAMPLES} samples "
            f"per turn with {EXTERNAL_UM:g} µm (sphere) and {INTERNAL_UM:g} µm (scales) of white "
            "noise; U read as an error that grows with the distance from the middle, reached at "
            "the end of the range; masses, stiffnesses, gains and limits of the machine, in "
            "machine.toml of this reproduction.",
            "The tilt of a circle is read across its plane, which needs circles in three planes "
            "for six elements; the measured value is that of the circle in YZ as in Fig. 4.",
        ),
        note="Equations (1), (2) and (12) to (16) of the publication are taken in their standard "
        "form: M q'' + D q' + K q = B F.",
    )


def _value(value: float, digits: int = 3) -> str:
    return number(0.0 if abs(value) < _NONE else float(value), digits)


def _listed(values: Iterable[float]) -> str:
    *first, last = [number(float(v), 2) for v in values]
    return f"{', '.join(first)} and {last}"
