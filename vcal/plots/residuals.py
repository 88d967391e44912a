"""Residuals against their covariates: before and after, unexplained, and their distribution."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.linalg import solve_triangular
from scipy.special import ndtri

from ..identification.fit import Fit
from ..instruments.conditions import in_file
from ..loop.empirical.covariates import correlation, distinct_covariates
from ..loop.outcome.unexplained import Unexplained, way
from ..loop.residuals.dependence import bins, displacements
from ..words import three_digits
from .changing import changing
from .labels import column_label
from .style import (
    AFTER,
    BEFORE,
    DOTS,
    FIELD,
    INK,
    MARK,
    TONE,
    figure,
    grid,
    limit,
    titled,
)
from .views import View, column_of, described, values_of

_MOST_DOTS = 4000
_NEAR = 0.7
"""Groups that begin closer than this share of the mean group width are merged."""


def before_after(view: View, name: str) -> Figure:
    """Residual of the model without and with an effect of this name, against its covariate.

    Dots are readings, coloured points group means with two standard errors; the line is the visible
    part of the effect, that is, the part that other parameters do not absorb.
    """
    width, height = 9.6, 4.45
    drawn = figure(width, height)
    left, right = _panels(drawn, 2, sharey=True, top=0.7, bottom=0.9)
    drawn.text(0.75 / width, 1.0 - 0.3 / height, name, fontsize=10, color=INK, weight="bold")
    bound = 1.1 * limit([view.without, view.with_])
    for ax, y, colour, word in (
        (left, view.without, BEFORE, "before"),
        (right, view.with_, AFTER, "after"),
    ):
        _dots(ax, view.x, y, colour, sides=view.kind == "sides", tone=view.tone)
        if ax is left:
            _visible(ax, view)
        if view.event is not None:
            ax.axvline(view.event, color=INK, linewidth=1.2, linestyle="--")
        if view.kind != "sides":
            # Tick labels of six characters have room beside each other.
            ax.locator_params(axis="x", nbins=7)
        rms = np.sqrt((y**2).mean())
        titled(ax, f"{word} (rms {three_digits(rms)} µm)", view.x_label)
        ax.set_ylim(-bound, bound)
    along = f" {view.along}" if len(view.along) < 24 else " of the tool point"
    left.set_ylabel(f"residual{along}, µm", fontsize=9.5, color=INK)
    # Below the panels, where it covers no dots.
    drawn.legend(
        *left.get_legend_handles_labels(), fontsize=8.5, loc="lower left", ncols=2, frameon=False,
        bbox_to_anchor=(0.75 / width, 0.08 / height), borderpad=0.0, borderaxespad=0.0,
    )  # fmt: skip
    return drawn


def _visible(ax: Axes, view: View) -> None:
    """The visible part of an effect, as a line through the group means."""
    x, y = view.x, view.visible
    label = "visible part of the effect"
    levels = np.unique(x)
    if len(levels) <= 12:
        width = 0.3 * (np.diff(levels).min() if len(levels) > 1 else 1.0)
        means = [y[x == level].mean() for level in levels]
        ax.hlines(means, levels - width, levels + width, color=INK, lw=1.5, label=label, zorder=2)
    elif view.kind == "visible":
        ends = np.array([x.min(), x.max()])
        ax.plot(ends, ends, color=INK, linewidth=1.4, label=label)
        if view.tone is not None:
            ax.plot([], [], ".", color=TONE, markersize=6, label=view.tone_label)
    else:
        ax.plot(*_means(x, y, 30), color=INK, linewidth=1.4, label=label)


def _legend(ax: Axes) -> None:
    box = ax.legend(
        fontsize=8.5, loc="upper left", framealpha=0.85, edgecolor="none", borderpad=0.2
    )
    box.set_zorder(4)


def _means(x: np.ndarray, y: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Means of `x` and `y` over groups of equal size in the order of `x`; equal or nearly equal `x`
    are in the same group, so that they have one mean.
    """
    _, level, counts = np.unique(x, return_inverse=True, return_counts=True)
    middle = np.cumsum(counts) - 0.5 * counts
    index = (middle * groups / len(x)).astype(int)[level]
    begins: list[float] = []
    group = np.zeros(len(x), int)
    for k in np.unique(index):
        first = float(x[index == k].min())
        if not begins or first - begins[-1] >= _NEAR * np.ptp(x) / groups:
            begins.append(first)
        group[index == k] = len(begins)
    pairs = [(x[group == k].mean(), y[group == k].mean()) for k in np.unique(group)]
    return tuple(np.array(pairs).T)  # type: ignore[return-value]


def unexplained_views(fit: Fit, what: Unexplained) -> list[str]:
    """The one or two covariates with the largest shares that are not copies of each other."""
    table = distinct_covariates(fit.measurement.plan)
    chosen: list[str] = []
    for name in what.depends_on:
        x = table.get(name)
        if x is None or any(_alike(x, table[other]) for other in chosen):
            continue
        chosen.append(name)
    return chosen[:2]


def unexplained(fit: Fit, what: Unexplained) -> Figure:
    """The unexplained residual against the covariates it depends on most.

    Where it is local, against its place (shaded), beside the remainder after the empirical
    description. For an effect that changes: its size.
    """
    if what.empirical is not None and (shown := changing(fit, what.empirical)) is not None:
        return shown
    names = unexplained_views(fit, what)
    used = fit.used
    moved = displacements(fit)[used] * 1e6
    drawn = figure(9.6, 3.9)
    if not names:
        ax = _panels(drawn, 1)[0]
        ax.hist(np.linalg.norm(moved, axis=1), bins=40, color=BEFORE)
        titled(ax, "size of the residual", "residual of the tool point, µm", "readings")
        return drawn
    if what.empirical is not None:
        if what.where and what.where[0].covariate in distinct_covariates(fit.measurement.plan):
            names = [what.where[0].covariate]
        row = _panels(drawn, 2, sharey=True)
        left = displacements(what.empirical.fit)[used] * 1e6
        i = _component(fit, names[0], moved, what.direction)
        for ax, y, colour in zip(row, (moved, left), (BEFORE, AFTER), strict=True):
            _panel(ax, fit, names[0], y[:, i], colour, i)
            for interval in what.where:
                low, high = (in_file(names[0], v, fit.measurement.plan, fit.model.instrument)
                             for v in (interval.low, interval.high))  # fmt: skip
                ax.axvspan(low, high, color=MARK, alpha=0.22, lw=0, zorder=0)
        row[1].set_title("with the empirical description", fontsize=10, color=INK, loc="left")
        row[1].set_ylabel("")
        return drawn
    for ax, name in zip(_panels(drawn, len(names)), names, strict=True):
        i = _component(fit, name, moved, what.direction)
        _panel(ax, fit, name, moved[:, i], BEFORE, i)
    return drawn


def _panels(
    drawn: Figure, count: int, sharey: bool = False, top: float = 0.45, bottom: float = 0.6
) -> np.ndarray:
    """Axes side by side, with the margins of all figures in this file."""
    gap = 0.35 if sharey else 0.8
    margins = {"left": 0.75, "right": 0.2, "top": top, "bottom": bottom, "wspace": gap}
    return grid(drawn, 1, count, margins, sharey=sharey)[0]


def _component(fit: Fit, name: str, moved: np.ndarray, direction: str) -> int:
    """The component to show: the main one, or that with the largest variance by the covariate."""
    if direction in fit.ways:
        return fit.ways.index(direction)
    x = values_of(name, fit.measurement.plan)[fit.used]
    there = np.isfinite(x)
    x, moved = x[there], moved[there]
    return int(np.argmax([described(x, moved[:, k]) * moved[:, k].var() for k in range(3)]))


def _panel(ax: Axes, fit: Fit, name: str, y: np.ndarray, colour: str, i: int) -> None:
    plan = fit.measurement.plan
    column = column_of(name, plan)[0]
    frame = " of the tool" if fit.model.chain.arm else ""
    x = np.asarray(in_file(name, values_of(name, plan), plan, fit.model.instrument))[fit.used]
    there = np.isfinite(x)  # rows of the data sets that have the covariate
    _dots(ax, x[there], y[there], colour, many=True)
    bound = limit([y])
    ax.set_ylim(-bound, bound)
    along = f"residual {way(fit.ways[i])}{frame}"
    titled(ax, f"{along} against {column}", column_label(column), f"{along}, µm")


def studentised(fit: Fit, rows: np.ndarray | bool = True) -> np.ndarray:
    """Residuals of `rows` (n,) over their own standard deviations under the declared noise,
    sorted.
    """
    factor, lower = fit.factor
    half = solve_triangular(factor, fit.jacobian.T, trans=0 if lower else 1, lower=lower)
    leverage = np.einsum("kn,kn->n", half, half)
    used = (fit.counted & np.broadcast_to(rows, fit.used.shape)[:, None]).reshape(-1)
    return np.sort(fit.whitened[used] / np.sqrt(np.clip(1.0 - leverage[used], 0.02, 1.0)))


def normal_plot(before: Fit, after: Fit, noise_scales: Mapping[str, float]) -> Figure:
    """Normal probability plot of the studentised residuals; the line is the declared noise.

    One panel for every data set. `noise_scales` are the factors, by data set, by which the fit
    after closing the loop enlarges the declared noise.
    """
    parts = before.measurement.plan.parts
    if len(parts) == 1:
        drawn = figure(5.6, 3.9)
        ((name, inside),) = parts.items()
        title = f"{name}: " if name else ""
        _normal(_panels(drawn, 1)[0], before, after, noise_scales[name], inside, title)
        return drawn
    rows = -(-len(parts) // 2)
    drawn = figure(9.6, 3.9 * rows)
    margins = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6, "wspace": 0.8, "hspace": 1.1}
    table = grid(drawn, rows, 2, margins).reshape(-1)
    for ax, (name, inside) in zip(table, parts.items(), strict=False):
        _normal(ax, before, after, noise_scales[name], inside, f"{name}: ")
    for ax in table[len(parts) :]:
        ax.set_axis_off()
    return drawn


def _normal(
    ax: Axes, before: Fit, after: Fit, noise_scale: float, rows: np.ndarray | bool, name: str
) -> None:
    shown = []
    for fit, scale, colour, label in (
        (before, 1.0, BEFORE, "before"),
        (after, noise_scale, AFTER, "after"),
    ):
        values = studentised(fit, rows) * scale
        shown.append(values)
        expected = ndtri((np.arange(len(values)) + 0.5) / len(values))
        ax.plot(expected, values, ".", markersize=3, color=colour, label=label)
    bound = max(abs(ax.get_xlim()[0]), abs(ax.get_xlim()[1]))
    ax.plot([-bound, bound], [-bound, bound], color=INK, linewidth=1.0, label="as declared")
    top = max(1.1 * np.abs(shown[1]).max(), 1.3 * limit(shown[:1], 0.98), bound)
    ax.set_ylim(-top, top)
    _legend(ax)
    titled(
        ax,
        f"{name}residuals against the declared noise",
        "quantile of the normal distribution, standard deviations",
        "residual, declared standard deviations",
    )


def _dots(
    ax: Axes,
    x: np.ndarray,
    y: np.ndarray,
    colour: str,
    *,
    sides: bool = False,
    many: bool = False,
    tone: np.ndarray | None = None,
) -> None:
    """Readings as dots, and the mean of every group of `x` with two standard errors."""
    levels = np.unique(x)
    few = len(levels) <= 12
    shown = x
    if few and len(levels) > 1:
        # Readings at the same abscissa are spread, so that their number is visible.
        spread = 0.18 * np.diff(levels).min() * np.random.default_rng(0).uniform(-1, 1, len(x))
        shown = x + spread
    step = max(1, len(x) // _MOST_DOTS)
    if tone is None:
        ax.plot(shown[::step], y[::step], ".", color=DOTS, markersize=3, alpha=0.7, zorder=1)
    else:
        ax.scatter(
            shown[::step], y[::step], c=tone[::step], cmap=FIELD, s=9, edgecolor="none", zorder=1
        )
    if few:
        index = np.searchsorted(levels, x)
    elif many:
        index = np.searchsorted(np.quantile(x, np.linspace(0, 1, 21)[1:-1]), x)
    else:
        index = bins(x)
    centres, means, errors = [], [], []
    for k in np.unique(index):
        inside = index == k
        if inside.sum() >= 3:
            centres.append(x[inside].mean())
            means.append(y[inside].mean())
            errors.append(2.0 * y[inside].std(ddof=1) / np.sqrt(inside.sum()))
    ax.errorbar(
        centres,
        means,
        errors,
        fmt="o",
        color=colour,
        markersize=5.5,
        markeredgecolor="white",
        markeredgewidth=0.6,
        capsize=3,
        lw=1.4,
        zorder=3,
    )
    ax.axhline(0.0, color=INK, linewidth=0.8)
    if sides:
        ax.set_xticks(levels, [{-1.0: "−1", 0.0: "0", 1.0: "+1"}[v] for v in levels])
        ax.set_xlim(levels.min() - 0.8, levels.max() + 0.8)


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    there = np.isfinite(a) & np.isfinite(b)
    return bool(there.any()) and correlation(a[there], b[there]) > 0.999
