"""Residuals against what betrays them: before and after, what stays unexplained, their spread."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import ndtri

from ..identify import Fit
from ..loop.unexplained import Unexplained, bins, covariates, displacements
from .style import AFTER, BEFORE, DOTS, INK, MARK, column_label, figure, grid, limit, titled
from .views import View, column_of, contribution, described, values_of

_MOST_DOTS = 4000


def before_after(view: View, name: str) -> Figure:
    """Residual of the model without and with an effect, against what betrays it.

    Dots are readings, the coloured points means of groups with two standard errors; the line is
    what the effect predicts.
    """
    drawn = figure(9.6, 3.9)
    left, right = grid(
        drawn, 1, 2, left=0.75, right=0.2, top=0.45, bottom=0.6, wspace=0.35, sharey=True
    )[0]
    bound = limit([view.without, view.with_])
    for ax, y, colour, word in (
        (left, view.without, BEFORE, "before: without"),
        (right, view.with_, AFTER, "after: with"),
    ):
        _dots(ax, view.x, y, colour, sides=view.kind == "sides")
        if view.curve is not None and ax is left:
            ax.plot(*view.curve, color=INK, linewidth=1.4, label=f"what {name} predicts")
            ax.legend(fontsize=8.5, loc="upper left", frameon=False)
        if view.event is not None:
            ax.axvline(view.event, color=INK, linewidth=1.2, linestyle="--")
        rms = np.sqrt((y**2).mean())
        titled(ax, f"{word} {name}   (rms {_figures(rms)} µm)", view.x_label)
        ax.set_ylim(-bound, bound)
    left.set_ylabel("residual of the tool point, µm", fontsize=9.5, color=INK)
    return drawn


def unexplained_views(fit: Fit, what: Unexplained, most: int = 2) -> list[str]:
    """The covariates worth a panel: the most telling ones that are not copies of each other."""
    table = covariates(fit)
    chosen: list[str] = []
    for name in what.depends_on:
        x = table.get(name)
        if x is None or any(_alike(x, table[other]) for other in chosen):
            continue
        chosen.append(name)
    return chosen[:most]


def unexplained(fit: Fit, what: Unexplained) -> Figure:
    """What stays unexplained, against the covariates it depends on most; the interval is shaded."""
    names = unexplained_views(fit, what)
    drawn = figure(9.6, 3.9)
    if not names:
        ax = grid(drawn, 1, 1, left=0.75, right=0.2, top=0.45, bottom=0.6)[0, 0]
        length = np.linalg.norm(displacements(fit)[fit.used], axis=1) * 1e6
        ax.hist(length, bins=40, color=BEFORE)
        titled(ax, "size of the residual", "residual of the tool point, µm", "readings")
        return drawn
    row = grid(drawn, 1, len(names), left=0.75, right=0.2, top=0.45, bottom=0.6, wspace=0.75)[0]
    plan, used = fit.measurement.plan, fit.used
    moved = displacements(fit)[used] * 1e6
    frame = "" if set(plan.axes) <= set("XYZ") else " of the tool"
    for ax, name in zip(row, names, strict=True):
        column, factor = column_of(name, plan)
        x = values_of(name, plan)[used]
        i = "XYZ".find(what.direction)
        if i < 0:
            i = int(np.argmax([described(x, moved[:, k]) * moved[:, k].var() for k in range(3)]))
        for interval in what.where:
            if interval.covariate == name:
                ax.axvspan(
                    interval.low * factor, interval.high * factor, color=MARK, alpha=0.25, lw=0
                )
        _dots(ax, x * factor, moved[:, i], BEFORE, many=what.bump is not None)
        if what.bump is not None and name == what.bump.effect.placement:
            bump = what.bump.fit
            local = contribution(bump, len(bump.model.effects) - 1)[used, i] * 1e6
            order = np.argsort(x)
            ax.plot(x[order] * factor, local[order], color=INK, linewidth=1.3)
        bound = limit([moved[:, i]])
        ax.set_ylim(-bound, bound)
        share = described(x, moved[:, i])
        titled(
            ax,
            f"{'XYZ'[i]} against {column}   ({100 * share:.0f} % of its variance)",
            column_label(column),
            f"residual along {'XYZ'[i]}{frame}, µm",
        )
    return drawn


def studentised(fit: Fit) -> np.ndarray:
    """Residuals over their own standard deviations under the declared noise, sorted."""
    half = np.linalg.solve(np.linalg.cholesky(fit.jacobian.T @ fit.jacobian + np.diag(
        fit.precision)), fit.jacobian.T)
    leverage = (half**2).sum(0)
    used = np.repeat(fit.used, fit.residual.shape[1])
    return np.sort(fit.whitened[used] / np.sqrt(np.clip(1.0 - leverage[used], 0.02, 1.0)))


def normal_plot(before: Fit, after: Fit) -> Figure:
    """Normal probability plot of the studentised residuals: on the line is as declared."""
    drawn = figure(5.2, 3.9)
    ax = grid(drawn, 1, 1, left=0.75, right=0.25, top=0.45, bottom=0.6)[0, 0]
    for fit, colour, name in ((before, BEFORE, "before"), (after, AFTER, "after")):
        values = studentised(fit)
        expected = ndtri((np.arange(len(values)) + 0.5) / len(values))
        ax.plot(expected, values, ".", markersize=3, color=colour, label=name)
    bound = max(abs(ax.get_xlim()[0]), abs(ax.get_xlim()[1]))
    ax.plot([-bound, bound], [-bound, bound], color=INK, linewidth=1.0, label="as declared")
    ax.legend(fontsize=8.5, loc="upper left", frameon=False)
    titled(
        ax,
        "residuals against the declared noise",
        "expected of normal noise, standard deviations",
        "residual, declared standard deviations",
    )
    return drawn


def _dots(
    ax: Axes, x: np.ndarray, y: np.ndarray, colour: str, *, sides: bool = False, many: bool = False
) -> None:
    """Readings as dots, and the mean of every group of `x` with two standard errors."""
    levels = np.unique(x)
    few = len(levels) <= 12
    shown = x
    if few and len(levels) > 1:
        # Readings at the same place are spread out, so that their number can be seen.
        spread = 0.3 * np.diff(levels).min() * np.random.default_rng(0).uniform(-1, 1, len(x))
        shown = x + spread
    step = max(1, len(x) // _MOST_DOTS)
    ax.plot(shown[::step], y[::step], ".", color=DOTS, markersize=3, alpha=0.7, zorder=1)
    if few:
        index = np.searchsorted(levels, x)
    elif many:
        index = np.searchsorted(np.linspace(x.min(), x.max(), 31)[1:-1], x)
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
        centres, means, errors, fmt="o", color=colour, markersize=5, capsize=3, lw=1.4, zorder=3
    )
    ax.axhline(0.0, color=INK, linewidth=0.8)
    if sides:
        ax.set_xticks(levels, [{-1.0: "−1", 0.0: "0", 1.0: "+1"}[v] for v in levels])
        ax.set_xlim(levels.min() - 0.8, levels.max() + 0.8)


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    return abs(np.corrcoef(a, b)[0, 1]) > 0.999


def _figures(value: float) -> str:
    return f"{value:.3g}"
