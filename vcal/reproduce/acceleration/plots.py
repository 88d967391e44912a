"""Pictures: circles across and along their plane, positioning, what was identified."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ...dynamics.ellipse_evaluation import even_ellipse
from ...dynamics.identify import Identified
from ...dynamics.monte_carlo import Campaign
from ...plots.style import AFTER, BEFORE, DOTS, INK, MARK, NOMINAL, figure, grid, titled
from .moves import Compensated, Positioning
from .results import RTestOf

_MARGINS = {"left": 0.8, "right": 0.25, "top": 0.45, "bottom": 0.6, "wspace": 0.9, "hspace": 0.9}
_WAYS = {"actual": AFTER, "nominal": BEFORE}


def across(test: RTestOf, acceleration: float, colour: str) -> Figure:
    """The circle in YZ seen along Y: X against Z, with the line that was fitted."""
    run = test.place("YZ", acceleration)
    mine, circle, _ = _run(test, run)
    z, x = 1e3 * mine[0][:, 2], 1e6 * mine[1][:, 0]
    drawn = figure(6.6, 3.6)
    ax = grid(drawn, 1, 1, {**_MARGINS, "right": 2.0})[0, 0]
    middle = x.mean()
    ax.axhline(0.0, color=NOMINAL, lw=1.2, label="set points")
    ax.plot(z, x - middle, ".", ms=3, color=DOTS, label="external")
    a = test.ways["actual"].runs[run, 0, 2] * -(circle.omega**2)
    ends = np.array([z.min(), z.max()])
    ax.plot(ends, 1e-3 * a * ends, color=colour, lw=1.8, label="plane, by\nleast squares")
    value = f"{test.ways['actual'].runs[run, 0, 2]:.2f}".replace("-", "−")
    titled(ax, f"EXZ = {value} µm s²/m at {acceleration:g} m/s²", "Z, mm", "X, µm")
    ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn


def within(tests: Mapping[str, RTestOf], levels: Sequence[float], magnification: float) -> Figure:
    """Circles in ZX with their deviations from the set circle enlarged, and fitted ellipses."""
    drawn = figure(4.4 * len(tests) + 1.2, 4.7)
    table = grid(drawn, 1, len(tests), {**_MARGINS, "right": 1.6})[0]
    for ax, (name, test), level in zip(table, tests.items(), levels, strict=True):
        mine, _, _ = _run(test, test.place("ZX", level))
        internal, external = (1e3 * part[:, [2, 0]] for part in mine)
        angle = np.linspace(0.0, 2.0 * np.pi, 361)
        r = float(np.linalg.norm(internal - internal.mean(0), axis=1).mean())
        ring = r * np.cos(angle), r * np.sin(angle)
        ax.plot(*ring, color=NOMINAL, lw=1.0, label="mean circle")
        for points, colour, label in (
            (internal, AFTER, "internal"),
            (external, BEFORE, "external"),
        ):
            centred = points - points.mean(0)
            ax.plot(*_larger(centred, r, magnification).T, ".", ms=2.5, color=colour, label=label)
        tilted = _tilted(external - external.mean(0))
        ax.plot(*_larger(tilted, r, magnification).T, color=INK, lw=0.9, label="ellipse,\ntilted")
        even = even_ellipse(external - external.mean(0))
        wave = np.column_stack([even[0] * np.cos(angle), even[1] * np.sin(angle)])
        ax.plot(*_larger(wave, r, magnification).T, "--", color=MARK, lw=1.1, label="even\nellipse")
        ax.set_aspect("equal")
        titled(ax, f"{name}, {level:g} m/s²", "Z, mm", "X, mm")
    table[-1].legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn


def _run(test: RTestOf, run: int):
    """Internal and external positions (n, 3) of one run, its circle, and the set radius."""
    plan = test.run.measurement.plan
    mine = np.asarray(plan.groups["run"]) == run
    circle = test.run.instrument.circles(plan)[run]
    places = np.asarray(plan.position)[mine], np.asarray(test.run.measurement.readings)[mine]
    return places, circle, test.run.instrument.radius


def _larger(points: Float[np.ndarray, "n 2"], r: float, factor: float) -> Float[np.ndarray, "n 2"]:
    far = np.linalg.norm(points, axis=1, keepdims=True)
    return points * (r + factor * (far - r)) / far


def _tilted(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The first harmonic along the turn: a circle under any linear map is an ellipse."""
    angle = 2.0 * np.pi * (np.arange(len(points)) + 0.5) / len(points)
    columns = np.column_stack([np.cos(angle), np.sin(angle)])
    return columns @ np.linalg.lstsq(columns, points, rcond=None)[0]


def positioning(move: Positioning, matrix: float) -> Figure:
    """Position, acceleration and cross-talk of the move along Z."""
    drawn = figure(7.2, 7.4)
    top, middle, bottom = grid(drawn, 3, 1, {**_MARGINS, "hspace": 0.75})[:, 0]
    t = 1e3 * move.t
    for ax, part, actual, scale in (
        (top, 0, move.position, 1e3),
        (middle, 2, move.acceleration, 1.0),
    ):
        ax.plot(t, scale * move.asked[:, part], color=NOMINAL, lw=1.2, label="set")
        ax.plot(t, scale * actual, color=AFTER, lw=1.5, label="actual")
        ax.legend(fontsize=8.5, frameon=False)
    titled(top, "Position of Z", "", "mm")
    titled(middle, "Acceleration of Z", "", "m/s²")
    bottom.plot(t, 1e6 * move.across, color=BEFORE, lw=1.5, label="tool point")
    bottom.plot(t, matrix * move.acceleration, "--", color=INK, lw=1.0, label="EXZ × acceleration")
    bottom.legend(fontsize=8.5, frameon=False)
    titled(bottom, "Cross-talk along X", "t, ms", "µm")
    return drawn


def foretold(moves: Mapping[str, Positioning]) -> Figure:
    """Cross-talk of the move by several machines."""
    drawn = figure(7.2, 3.4)
    ax = grid(drawn, 1, 1, _MARGINS)[0, 0]
    styles = ((BEFORE, "-", 1.4), (INK, "-", 2.4), (MARK, "--", 1.6))
    for (name, move), (colour, dash, width) in zip(moves.items(), styles, strict=True):
        ax.plot(1e3 * move.t, 1e6 * move.across, dash, color=colour, lw=width, label=name)
    ax.legend(fontsize=8.5, frameon=False)
    titled(ax, "Cross-talk along X of a move that no circle saw", "t, ms", "µm")
    return drawn


def dispersion(test: RTestOf, matrix: Float[np.ndarray, "3 3"]) -> Figure:
    """Deviation of single circles from all together, and the amplitudes that cause the trap."""
    drawn = figure(9.4, 3.5)
    left, right = grid(drawn, 1, 2, _MARGINS)[0]
    for way, colour in _WAYS.items():
        found = test.ways[way].dispersion(matrix)
        left.plot(list(found), list(found.values()), "o-", color=colour, ms=4, label=way)
    titled(left, "Single circles against all of them", "set acceleration, m/s²", "rms, µm s²/m")
    left.set_ylim(bottom=0.0)
    left.legend(fontsize=8.5, frameon=False)
    levels = sorted(test.ratio)
    for i, (axis, colour) in enumerate(zip("XYZ", (AFTER, BEFORE, MARK), strict=True)):
        right.plot(levels, [test.ratio[a][i] for a in levels], "o-", ms=4, color=colour, label=axis)
    right.axhline(1.0, color=NOMINAL, lw=0.8)
    titled(right, "Radius that was travelled", "set acceleration, m/s²", "over the set one")
    right.legend(fontsize=8.5, frameon=False)
    return drawn


def intervals(found: Identified, true: Float[np.ndarray, " k"]) -> Figure:
    """Every unknown before and after, in standard deviations of the catalogue."""
    names = [u.name for u in found.unknowns]
    drawn = figure(8.4, 0.36 * len(names) + 1.3)
    ax = grid(drawn, 1, 1, {**_MARGINS, "left": 3.0, "right": 1.7})[0, 0]
    y = np.arange(len(names))[::-1]
    u = np.sqrt(np.diag(found.covariance))
    ax.hlines(y, -2.0, 2.0, color="#d5dae0", lw=7, label="catalogue, k = 2")
    ax.hlines(y, found.z - 2.0 * u, found.z + 2.0 * u, color=AFTER, lw=3, label="circles, k = 2")
    ax.plot(true, y, "|", color=BEFORE, ms=12, mew=2, label="put in")
    ax.set_yticks(y, names)
    ax.set_ylim(-0.7, len(names) - 0.3)
    titled(ax, "", "standard deviations of the catalogue")
    ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn


def left_over(series: Mapping[str, Mapping[str, Compensated]]) -> Figure:
    """Share of the structure's error that is left of other movements."""
    names = list(next(iter(series.values())))
    drawn = figure(8.4, 0.5 * len(names) + 1.3)
    ax = grid(drawn, 1, 1, {**_MARGINS, "left": 2.5, "right": 1.9})[0, 0]
    y = np.arange(len(names))[::-1]
    height = 0.8 / len(series)
    for i, ((label, found), colour) in enumerate(zip(series.items(), (AFTER, MARK), strict=True)):
        shares = [100.0 * found[name].left for name in names]
        place = y + 0.4 - height * (i + 0.5)
        ax.barh(place, shares, 0.9 * height, color=colour, label=label)
    ax.set_yticks(y, names)
    titled(ax, "", "left of the structure's error, %")
    ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn


def pulls(done: Campaign) -> Figure:
    """Errors of all machines over their standard uncertainties."""
    drawn = figure(8.4, 0.36 * len(done.unknowns) + 1.3)
    ax = grid(drawn, 1, 1, {**_MARGINS, "left": 3.0})[0, 0]
    y = np.arange(len(done.unknowns))[::-1]
    low, mid, high = np.quantile(done.pulls, (0.0228, 0.5, 0.9772), axis=0)
    ax.axvspan(-2.0, 2.0, color="#eef1f4")
    ax.hlines(y, low, high, color=AFTER, lw=2)
    ax.plot(mid, y, "o", color=AFTER, ms=4)
    ax.set_yticks(y, [u.name for u in done.unknowns])
    ax.set_ylim(-0.7, len(y) - 0.3)
    titled(ax, "", "error over standard uncertainty: median, and where 95 % lie")
    return drawn
