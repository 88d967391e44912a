"""The description of this reproduction: printed numbers, record and page."""

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ...dynamics.ellipse_evaluation import even_ellipse
from ...plots.panels import Panel, bars, mark, panels
from ...plots.style import AFTER, BEFORE, DOTS, INK, MARK, NOMINAL
from ...report import Table, Tile
from ...report.html.text import COVERAGE, number, percent, rounded, unit
from ..document import Row, picked, table
from ..registry import Reproduction
from .measured import Joint
from .results import (
    CAMPAIGN,
    LEAST,
    Results,
    RTestOf,
    element,
    single_circle_U,
    true_z,
)
from .setting import (
    ACTUAL_PEAK,
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
    SET_PEAK,
    SIMULATED,
    SIMULATED_M_S2,
    carriage_factors,
    circle,
    move,
)

_E, _UNIT = "µm s²/m", "um s2/m"
"""Unit of all elements of the matrix, on the page and in the record."""
_NAMES = [f"{a}{b}" for a in "XYZ" for b in "XYZ"]
_MAGNIFICATION = 60.0
_SEEN_UM = 1.0
"""Root mean square of an error that is worth taking off."""
_FASTEST_HZ = circle("YZ", max(LEVELS)).omega / math.tau


def rows(r: Results) -> list[Row]:
    """All printed numbers, and those that belong beside them."""
    simulated, measured = r.exz_of_the_circle
    joint, identified = element(r.joint.matrix, "XZ"), element(r.identified.matrix, "XZ")
    here, there, true = r.catalogue.move, r.identified.move, r.true.move
    return [
        Row("frequency of a circle of 2 mm at 5 m/s²", 8.0, circle("ZX", 5.0).omega / math.tau,
            "Hz"),
        Row("EXZ, measured, circle in YZ", MEASURED, measured, _UNIT,
            f"at {MEASURED_M_S2:g} m/s²; U = {single_circle_U():.2f} by the device; the machine "
            "that is measured here was chosen to have the printed value"),
        Row("EXZ, measured, all circles at once", MEASURED, joint, _UNIT,
            f"U = {2.0 * element(r.joint.u, 'XZ'):.3f}, with U = {DEVICE_U_UM:g} µm of the R-test"),
        Row("EXZ, simulated, circle in YZ", SIMULATED, simulated, _UNIT,
            f"at {SIMULATED_M_S2:g} m/s²; the catalogue's machine was chosen to have the printed "
            "value"),
        Row("EXZ, identified from the catalogue on", MEASURED, identified, _UNIT,
            f"U = {2e6 * element(r.found.matrix_u, 'XZ'):.3f}; put in "
            f"{number(element(r.true.matrix, 'XZ'), 5)}"),
        Row("measured over simulated", MEASURED / SIMULATED, joint / simulated, "1",
            "“about the factor of 2 to 3”"),
        Row("measured over identified", None, joint / identified, "1"),
        Row("angular velocity at 4.7 m/s²", None, circle("YZ", SIMULATED_M_S2).omega, "rad/s"),
        Row("positioning, peak of the set velocity", None, move().peak_velocity, "m/s",
            "30 m/min is not reached"),
        Row("positioning, peak of the set acceleration", SET_PEAK, here.set_peak, "m/s2",
            "not printed, read from the figure; (S J²/2)^(1/3), limited by jerk alone"),
        Row("positioning, peak of the actual acceleration", ACTUAL_PEAK, here.peak, "m/s2"),
        Row("positioning, cross-talk at that peak", MOVE_UM, abs(here.at_peak_um), "um",
            "catalogue's machine"),
        Row("positioning, cross-talk over acceleration at the peak", MOVE_RATIO, here.ratio, _UNIT,
            f"printed 3.7 µm over 7.9 m/s² is {number(-MOVE_UM / ACTUAL_PEAK)}; the drop from "
            f"{number(SIMULATED)} on the circle is not reproduced"),
        Row("the same over that of the circle", MOVE_RATIO / SIMULATED, here.ratio / simulated,
            "1"),
        Row("positioning, least squares over the whole move", None, here.fitted, _UNIT),
        Row("positioning, cross-talk at the peak, machine that is measured", None,
            abs(true.at_peak_um), "um"),
        Row("the same as the identified machine foretells it", None, abs(there.at_peak_um), "um",
            "from circles alone"),
        Row("radius of the circles", 2.0, 1e3 * RADIUS_M, "mm"),
    ]  # fmt: skip


def record(r: Results) -> dict[str, Any]:
    """All numbers behind the page, by section."""
    f, c = r.found, r.campaign
    peaks = ("set_peak", "peak", "at_peak_um", "ratio", "fitted")
    return {
        "setting": {
            "radius_mm": 1e3 * RADIUS_M, "levels_m_s2": LEVELS, "samples": SAMPLES,
            "external_sigma_um": EXTERNAL_UM, "internal_sigma_um": INTERNAL_UM,
            "device_U_um": DEVICE_U_UM, "range_mm": RANGE_MM,
        },
        "carriages_over_catalogue": carriage_factors(),
        "machines": {
            name: {**picked(one, "matrix", "natural_frequencies_hz=hz"),
                   "move": picked(one.move, *peaks)}
            for name, one in picked(r, "catalogue", "true", "identified").items()
        },
        "joint": picked(r.joint, "matrix", "u", "chi2_per_dof"),
        "joint_noise_only": picked(r.joint_no_device, "matrix", "u"),
        "evaluated": {
            "simulated": _evaluated(r.simulated, r.catalogue.matrix),
            "measured": _evaluated(r.measured, r.joint.matrix),
        },
        "identified": [
            {**picked(unknown, "name", "unit"),
             "value": value, "interval": interval, "z": z, "u_z": u, "told": share}
            for unknown, value, interval, z, u, share in zip(
                f.unknowns, f.values, f.interval(), f.z, np.sqrt(np.diag(f.covariance)), f.told,
                strict=True)
        ],
        "not_told": f.not_told(),
        **picked(f, "chi2", "readings"),
        "compensated": {
            "by circles": {name: asdict(one) for name, one in r.by_circles.items()},
            "by machine": {name: asdict(one) for name, one in r.by_machine.items()},
        },
        "campaign": {
            "machines": len(c.status),
            "stable": int(c.stable.sum()),
            "converged": int(c.converged.sum()),
            "steps_median": float(np.median(c.steps)),
            "chi2_per_reading": float(np.mean(c.chi2[c.converged]) / c.readings),
            "unknowns": [
                dict(zip(("name", "u_median", "pull_mean", "pull_sd", "within_U"), one,
                         strict=True)) for one in _pulls(r)
            ],
        },
    }  # fmt: skip


def _evaluated(one: RTestOf, matrix: np.ndarray) -> dict[str, Any]:
    def by_level(values: Any) -> dict[str, Any]:
        return {f"{a:g}": value for a, value in values.items()}

    return {"amplitude_ratio": by_level(one.ratio)} | {
        way: {"mean": found.mean, "dispersion": by_level(found.dispersion(matrix))}
        for way, found in one.ways.items()
    }


def _pulls(r: Results) -> list[tuple[str, float, float, float, float]]:
    """Per unknown: its median u, mean and spread of error over u, and the share within U."""
    c = r.campaign
    return [
        (unknown.name, float(np.median(c.u[c.converged, i])), float(c.pulls[:, i].mean()),
         float(c.pulls[:, i].std()), float((np.abs(c.pulls[:, i]) < COVERAGE).mean()))
        for i, unknown in enumerate(c.unknowns)
    ]  # fmt: skip


def _head(r: Results) -> tuple[str, list[Tile]]:
    c, (simulated, measured) = r.campaign, r.exz_of_the_circle
    there, U = element(r.identified.matrix, "XZ"), COVERAGE * 1e6 * element(r.found.matrix_u, "XZ")
    peaks = [abs(one.move.at_peak_um) for one in (r.catalogue, r.identified, r.true)]
    text = f"""\
The publication measures EXZ = {number(MEASURED)} {_E} and simulates {number(SIMULATED)}, without an
identification. Here stiffness, damping, centres of gravity and controller delay are identified from
the circles of the R-test through the differentiable simulation: {number(there, 4)} {_E} with
U = {number(U, 2)}. For the 20 mm positioning, which was not used, the identified machine predicts
{number(peaks[1])} µm of cross-talk and the catalogue {number(peaks[0])} µm; the machine has
{number(peaks[2])} µm.
"""
    within = float((np.abs(c.pulls) < COVERAGE).mean())
    off = [percent(abs(peak / peaks[2] - 1.0)) for peak in peaks[:2]]
    tiles = [
        Tile("EXZ, measured, all circles", f"{number(element(r.joint.matrix, 'XZ'), 4)} {_E}",
             f"one circle {number(measured)}; printed {number(MEASURED)}"),
        Tile("EXZ, catalogue", f"{number(simulated)} {_E}", f"printed {number(SIMULATED)}"),
        Tile("EXZ, identified", f"{number(there, 4)} {_E}", f"U = {number(U, 2)}, k = 2"),
        Tile("20 mm positioning", off[1], f"off; catalogue {off[0]}"),
        Tile("within U", percent(within), f"of {c.pulls.size} values of {len(c.pulls)} machines"),
    ]  # fmt: skip
    return text, tiles


def _value(matrix: np.ndarray, name: str, digits: int = 3) -> str:
    """An element; zero where it is zero but for rounding."""
    value = element(matrix, name)
    return number(0.0 if abs(value) < 1e-9 else value, digits)


def _exz_U(joint: Joint) -> str:
    return number(COVERAGE * element(joint.u, "XZ"), 2)


def _of_radius(r: Results, least: Callable[[Any], Any]) -> str:
    return number(float(least(list(r.measured.ratio.values()))))


def _scatter(r: Results, level: float) -> str:
    """How far the elements from single circles are from those of all of them."""
    return number(r.measured.ways["actual"].dispersion(r.joint.matrix)[level], 2)


def _unclear(r: Results) -> str:
    found = r.found.not_told()
    return "\n- ".join(["The circles leave open:", *found]) if found else ""


def _left(r: Results) -> float:
    return max(one.left for one in r.by_circles.values() if one.before_um > _SEEN_UM)


def _dispersion(r: Results) -> Figure:
    scatter = {way: one.dispersion(r.joint.matrix) for way, one in r.measured.ways.items()}
    levels, ratio = sorted(r.measured.ratio), r.measured.ratio
    level = "set acceleration, m/s²"
    return panels(
        [Panel("Single circles against all of them", level, f"rms, {_E}",
               [mark("plot", list(found), list(found.values()), "o-", color=colour, ms=4,
                     label=way) for (way, found), colour in
                zip(scatter.items(), (AFTER, BEFORE), strict=True)],
               "inside", {"ylim": (0.0, None)}),
         Panel("Radius that was travelled", level, "over the set one",
               [*(mark("plot", levels, [ratio[a][i] for a in levels], "o-", ms=4, label=axis,
                       color=(AFTER, BEFORE, MARK)[i]) for i, axis in enumerate("XYZ")),
                mark("axhline", 1.0, color=NOMINAL, lw=0.8)], "inside")],
        width=9.4, height=3.5,
    )  # fmt: skip


def _identified(r: Results) -> Figure:
    f, names = r.found, [one.name for one in r.found.unknowns]
    y, u = np.arange(len(names))[::-1], np.sqrt(np.diag(f.covariance))
    return panels(
        [Panel("", "standard deviations of the catalogue", "",
               [mark("hlines", y, -2.0, 2.0, color="#d5dae0", lw=7, label="catalogue, k = 2"),
                mark("hlines", y, f.z - 2.0 * u, f.z + 2.0 * u, color=AFTER, lw=3,
                     label="circles, k = 2"),
                mark("plot", true_z(), y, "|", color=BEFORE, ms=12, mew=2, label="put in"),
                mark("set_yticks", y, names)], "right")],
        width=8.4, height=0.36 * len(names) + 1.3,
    )  # fmt: skip


def _positioning(r: Results) -> Figure:
    here, exz = r.catalogue.move, element(r.catalogue.matrix, "XZ")
    t = 1e3 * here.t
    set_, actual = {"color": NOMINAL, "lw": 1.2, "label": "set"}, {"color": AFTER, "lw": 1.5}
    return panels(
        [Panel("Position of Z", "", "mm",
               [mark("plot", t, 1e3 * here.asked[:, 0], **set_),
                mark("plot", t, 1e3 * here.position, label="actual", **actual)], "inside")],
        [Panel("Acceleration of Z", "", "m/s²",
               [mark("plot", t, here.asked[:, 2], **set_),
                mark("plot", t, here.acceleration, label="actual", **actual)], "inside")],
        [Panel("Cross-talk along X", "t, ms", "µm",
               [mark("plot", t, 1e6 * here.across, color=BEFORE, lw=1.5, label="tool point"),
                mark("plot", t, exz * here.acceleration, "--", color=INK, lw=1.0,
                     label="EXZ × acceleration")], "inside")],
        width=7.2, height=7.4,
    )  # fmt: skip


def _foretold(r: Results) -> Figure:
    machines = {
        "catalogue": (r.catalogue.move, "-", BEFORE, 1.4),
        "machine that is measured": (r.true.move, "-", INK, 2.4),
        "identified from circles": (r.identified.move, "--", MARK, 1.6),
    }
    return panels(
        [Panel("Cross-talk along X of a move that was not used", "t, ms", "µm",
               [mark("plot", 1e3 * one.t, 1e6 * one.across, dash, color=colour, lw=lw,
                     label=name) for name, (one, dash, colour, lw) in machines.items()],
               "inside")],
        width=7.2, height=3.4,
    )  # fmt: skip


def _pulls_picture(r: Results) -> Figure:
    names = [one.name for one in r.campaign.unknowns]
    low, mid, high = np.quantile(r.campaign.pulls, (0.0228, 0.5, 0.9772), axis=0)
    y = np.arange(len(names))[::-1]
    return panels(
        [Panel("", "error over standard uncertainty: median, and where 95 % lie", "",
               [mark("axvspan", -2.0, 2.0, color="#eef1f4"),
                mark("hlines", y, low, high, color=AFTER, lw=2),
                mark("plot", mid, y, "o", color=AFTER, ms=4), mark("set_yticks", y, names)])],
        width=8.4, height=0.36 * len(names) + 1.3,
    )  # fmt: skip


def _run(test: RTestOf, plane: str, level: float):
    """Internal and external positions (n, 3) of one run, less their mean, m; its circle."""
    run, plan = test.place(plane, level), test.run.measurement.plan
    mine = np.asarray(plan.groups["run"]) == run
    read = (np.asarray(a)[mine] for a in (plan.position, test.run.measurement.readings))
    return run, *(part - part.mean(0) for part in read), test.run.instrument.circles(plan)[run]


def _across(test: RTestOf, level: float, colour: str) -> Figure:
    """The circle in YZ seen along Y, with the line that was fitted."""
    run, internal, external, turn = _run(test, "YZ", level)
    z, exz = 1e3 * internal[:, 2], test.ways["actual"].runs[run, 0, 2]
    ends = np.array([z.min(), z.max()])
    line = -1e-3 * exz * turn.omega**2 * ends
    panel = Panel(
        f"EXZ = {number(exz)} µm s²/m at {level:g} m/s²", "Z, mm", "X, µm",
        [mark("axhline", 0.0, color=NOMINAL, lw=1.2, label="set points"),
         mark("plot", z, 1e6 * external[:, 0], ".", ms=3, color=DOTS, label="external"),
         mark("plot", ends, line, color=colour, lw=1.8, label="plane, by\nleast squares")],
        "right",
    )  # fmt: skip
    return panels([panel], width=6.6, height=3.6)


def _within(name: str, test: RTestOf, level: float, legend: Any) -> Panel:
    """The circle in ZX with its deviations enlarged, and the ellipses that were fitted."""
    _, *both, _ = _run(test, "ZX", level)
    internal, external = (1e3 * part[:, [2, 0]] for part in both)
    r = float(np.linalg.norm(internal, axis=1).mean())

    def turn(angle: np.ndarray) -> np.ndarray:
        return np.column_stack([np.cos(angle), np.sin(angle)])

    def larger(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 n"]:
        far = np.linalg.norm(points, axis=1, keepdims=True)
        return (points * (r + _MAGNIFICATION * (far - r)) / far).T

    # The first harmonic along the turn: a circle under any linear map is an ellipse.
    waves = turn(2.0 * np.pi * (np.arange(len(external)) + 0.5) / len(external))
    tilted = waves @ np.linalg.lstsq(waves, external, rcond=None)[0]
    ring = turn(np.linspace(0.0, 2.0 * np.pi, 361))
    even = ring * np.asarray(even_ellipse(external)[:2])
    return Panel(
        f"{name}, {level:g} m/s²", "Z, mm", "X, mm",
        [mark("plot", *(r * ring).T, color=NOMINAL, lw=1.0, label="mean circle"),
         mark("plot", *larger(internal), ".", ms=2.5, color=AFTER, label="internal"),
         mark("plot", *larger(external), ".", ms=2.5, color=BEFORE, label="external"),
         mark("plot", *larger(tilted), color=INK, lw=0.9, label="ellipse,\ntilted"),
         mark("plot", *larger(even), "--", color=MARK, lw=1.1, label="even\nellipse")],
        legend, {"aspect": "equal"},
    )  # fmt: skip


TEXTS: dict[str, Callable[[Results], str]] = {
    "Circles": lambda r: f"""\
The publication gives the readings of its machine only. Two machines stand in for it: one from a
catalogue, with usual masses and stiffnesses, chosen so that it gives the simulated cross-talk, and
one whose carriages have {", ".join(number(x, 2) for x in carriage_factors().values())} of that
stiffness (X, Y, Z), chosen so that it gives the measured one. The second is measured below, and
nothing of it is known to the identification.
:crosstalk_measured Circle in YZ seen along Y, measured (the publication's Fig. 4): the tool point
leaves the plane in proportion to the acceleration of Z.
:crosstalk_simulated The same by the catalogue's machine (its Fig. 7).
:intalk Circles in ZX, deviations from the mean internal circle × {_MAGNIFICATION:g} (its Figs. 5
and 8). In-talk makes an ellipse of the external circle, cross-talk tilts it; an even ellipse alone
does not follow.
""",
    "From circles to the matrix": lambda r: f"""\
All circles at once, with the offset of every run and the errors of the probes as unknowns, give the
matrix with its covariance. Beside it stands the publication's way, circle by circle: a plane
across, an even ellipse within after the tilt has been taken out; the mean of the circles at
{MEASURED_M_S2:g} m/s².

The device's U of {DEVICE_U_UM:g} µm (k = 2) is an input: an error of sensitivity or direction grows
with the radius, as the effect of acceleration on one circle does. A circle at {MEASURED_M_S2:g}
m/s² alone therefore has U = {number(single_circle_U(), 2)} {_E}, whatever its noise; circles of
several levels tell the two apart, and U of EXZ is {_exz_U(r.joint)} ({_exz_U(r.joint_no_device)}
with noise alone).

The closed loop travels {_of_radius(r, np.nanmin)} to {_of_radius(r, np.nanmax)} of the set radius.
Equations (5) and (6) normalise to the set circle: they take its acceleration for the nominal one
and scale the matrix by that ratio.

All circles at once are up to {percent((_FASTEST_HZ / float(r.true.hz[0])) ** 2)} above the true
values: their {number(_FASTEST_HZ)} Hz are not infinitely far below the first mode at
{number(float(r.true.hz[0]))} Hz, (f/f₁)². The identified machine accounts for that. At low
accelerations single circles are farther off, as the publication reports (its section 2.4):
{_scatter(r, min(LEVELS))} {_E} at {min(LEVELS):g} m/s², {_scatter(r, max(LEVELS))} at
{max(LEVELS):g} m/s².
:evaluations {_E}; put in is the quasi-static compliance of the machine. The last column takes
nominal accelerations; the last two are of {MEASURED_M_S2:g} m/s² alone.
:dispersion Left: how far the elements from single circles are from those of all circles at once.
Right: the radius that the axes travel, by which an evaluation with nominal accelerations scales the
matrix.
""",
    "From circles to the machine": lambda r: f"""\
Twelve unknowns, each with what a catalogue leaves open: stiffness of carriages and drives and the
foundation's by a factor, places of centres of gravity, damping, delay of the controllers. The
amplitudes of scales and sphere on all circles are fitted through the simulation ({r.found.readings}
numbers, squared differences {number(r.found.chi2)}).

First natural frequency: {number(float(r.catalogue.hz[0]))} Hz by the catalogue,
{number(float(r.true.hz[0]))} Hz of the machine, {number(float(r.identified.hz[0]))} Hz identified.

{_unclear(r)}
:unknowns Resolved: share of the catalogue's variance that the circles remove.
:elements {_E}; u of the catalogue by drawing from what it leaves open.
:identified What the catalogue leaves open and what the circles determine, each with k = 2.
""",
    "Larger movements": lambda r: f"""\
The set acceleration peaks at {number(r.catalogue.move.set_peak, 4)} m/s², limited by jerk alone;
the actual one at {number(r.catalogue.move.peak)} m/s², where the tool point is
{number(abs(r.catalogue.move.at_peak_um))} µm aside: {number(r.catalogue.move.ratio)} {_E}, against
{number(r.exz_of_the_circle[0])} on the circle. The publication prints {MOVE_UM:g} µm and
{number(MOVE_RATIO)}; its drop of {percent(1.0 - MOVE_RATIO / SIMULATED)} from circle to positioning
is not found with this machine, nor with any that was tried: below its first mode a structure
answers to acceleration alike, whatever the movement.

The matrix from circles is said to hold for arbitrary movements. Taken off other moves of the
machine it leaves {percent(_left(r))} at most where there was more than {_SEEN_UM:g} µm. The rest is
vibration that the jerk excites, which no matrix can hold.
:moves µm, tool point against the scales, while the axes are accelerated.
:positioning 20 mm along Z by the catalogue's machine (its Fig. 9).
:foretold The same move by three machines. The identification used circles alone.
:left_over Share that compensation with the matrix leaves of movements unlike any circle.
""",
    "Many machines": lambda r: f"""\
{len(r.campaign.status)} machines drawn from what the catalogue leaves open, each measured by
{2 * 3 * len(LEVELS)} circles and identified from the catalogue on. The controllers hold
{int(r.campaign.stable.sum())} of them; {int(r.campaign.converged.sum())} searches found a minimum,
after {np.median(r.campaign.steps):g} steps (median). Squared differences per degree of freedom:
{number(float((r.campaign.chi2[r.campaign.converged] / r.campaign.readings).mean()))}.

Where errors over standard uncertainties scatter by more than one, the problem is curved within its
uncertainty: the linearised (GUM) uncertainty is then too small by that factor.
:campaign u: median, in standard deviations of the catalogue.
:pulls Errors of {int(np.sum(r.campaign.converged))} identified machines over their standard
uncertainties. Within the band lie 95 % of a normal distribution.
""",
    "Printed and found": lambda r: """\
:numbers
""",
    "Settings": lambda r: f"""\
- Printed: radius {1e3 * RADIUS_M:g} mm, three planes, both senses; {MEASURED_M_S2:g} and
{SIMULATED_M_S2:g} m/s²; R-test with U = {DEVICE_U_UM:g} µm and a range of ±{RANGE_MM:g} mm;
positioning over 20 mm with 30 m/min, 10 m/s² and 250 m/s³; cascaded PPI control.
- Assumed: circles at {", ".join(f"{a:g}" for a in LEVELS)} m/s², {SAMPLES} samples per turn with
{EXTERNAL_UM:g} µm (sphere) and {INTERNAL_UM:g} µm (scales) of white noise; U read as an error that
grows with the distance from the middle, reached at the end of the range; masses, stiffnesses, gains
and limits of the machine, in machine.toml of this reproduction.
- The tilt of a circle is read across its plane, which needs circles in three planes for six
elements; the measured value is that of the circle in YZ as in Fig. 4.
~ Equations (1), (2) and (12) to (16) of the publication are taken in their standard form: M q'' + D
q' + K q = B F.
""",
}  # fmt: skip

SHOWN: dict[str, Callable[[Results], Table | Figure]] = {
    "evaluations": lambda r: table(
        " | put in | all circles | u | plane, ellipse | the same, nominal",
        [(f"E{n}", _value(r.true.matrix, n),
          *rounded(element(r.joint.matrix, n), element(r.joint.u, n)),
          *(_value(way.at(MEASURED_M_S2), n) for way in r.measured.ways.values()))
         for n in _NAMES],
    ),
    # A delay is a difference, which is zero to rounding where nothing was changed.
    "unknowns": lambda r: table(
        "unknown | unit | put in | found | k = 2 | resolved",
        [(one.name, unit(one.unit) or "× catalogue",
          number(round(float(one.value(z, r.found.declared)), 9) + 0.0), number(value, 4),
          f"{number(low, 4)} … {number(high, 4)}", percent(told) if told >= 0.001 else None)
         for one, value, (low, high), told, z in
         zip(r.found.unknowns, r.found.values, r.found.interval(), r.found.told, true_z(),
             strict=True)],
    ),
    "elements": lambda r: table(
        " | catalogue | its u | identified | U | put in",
        [(f"E{n}", _value(r.catalogue.matrix, n), _value(r.catalogue_matrix_u, n, 2),
          _value(r.identified.matrix, n, 4), _value(COVERAGE * 1e6 * r.found.matrix_u, n, 2),
          _value(r.true.matrix, n, 4)) for n in _NAMES],
    ),
    "moves": lambda r: table(
        "movement | largest | rms | rms after | left | left, E of the machine",
        [(name, one.largest_um, one.before_um, one.after_um, percent(one.left),
          percent(r.by_machine[name].left)) for name, one in r.by_circles.items()],
    ),
    "campaign": lambda r: table(
        "unknown | u | mean error / u | sd of error / u | within U",
        [(name, *(number(v, 2) for v in values), percent(within))
         for name, *values, within in _pulls(r)],
    ),
    "crosstalk_measured": lambda r: _across(r.measured, MEASURED_M_S2, BEFORE),
    "crosstalk_simulated": lambda r: _across(r.simulated, SIMULATED_M_S2, AFTER),
    "intalk": lambda r: panels(
        [_within("measured", r.measured, MEASURED_M_S2, ""),
         _within("simulated", r.simulated, SIMULATED_M_S2, "right")],
        width=10.0, height=4.7,
    ),
    "dispersion": _dispersion,
    "identified": _identified,
    "positioning": _positioning,
    "foretold": _foretold,
    "left_over": lambda r: panels(
        [Panel("", "left of the structure's error, %", "",
               bars({label: {n: 100.0 * one.left for n, one in found.items()} for label, found in
                     (("E from circles", r.by_circles), ("E of the\nmachine", r.by_machine))},
                    horizontal=True, colours=(AFTER, MARK)), "right")],
        width=8.4, height=4.3,
    ),
    "pulls": _pulls_picture,
}  # fmt: skip

ACCELERATION = Reproduction(
    name="acceleration",
    summary="What acceleration does to a machine, and which machine does that: Nguyen et al. 2013",
    title="Acceleration-correlated errors",
    publication="Nguyen, Weikert, Wegener: measurement and simulation of acceleration correlated "
    "position errors in machine tools, IWF, ETH Zürich",
    compute=Results,
    rows=rows,
    record=record,
    head=_head,
    texts=TEXTS,
    shown=SHOWN,
    counted="machines",
    draws=CAMPAIGN,
    least=LEAST,
)
