"""Volumetric errors: at check points, over the travel, and of an arm over time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from ..geometry.compensated import compensated_points
from ..geometry.error_field import ErrorField
from ..identification.fit import Fit
from ..loop.weighing.cross_validation import heldout_residuals, squared_errors
from ..model.measurement import CheckPoints
from ..numerics.spatial import after_alignment
from ..words import three_digits
from .mid_planes import PLANES, PlaneRow, colour_bar, mid_planes
from .style import (
    AFTER,
    BEFORE,
    FIELD,
    INK,
    NOMINAL,
    figure,
    grid,
    labels_width,
    plain,
    spread,
    ticks_apart,
    titled,
)


def field(values: ErrorField) -> Figure:
    """Heat maps over three mid-planes: identified error, uncertainty, change by the loop."""
    error, u, change = (
        [values.plane(one, *plane) for plane in PLANES]
        for one in (values.error, values.u, values.change)
    )
    rows = [
        _row("identified error", error),
        PlaneRow("standard uncertainty", u),
        _row("changed by closing the loop", change),
    ]
    if np.linalg.norm(change, axis=-1).max() <= 1e-3:
        rows = rows[:2]
    return mid_planes(values.nodes, rows)


def _row(title: str, vectors: Sequence[np.ndarray]) -> PlaneRow:
    return PlaneRow(title, [np.linalg.norm(one, axis=-1) for one in vectors], vectors)


def check_errors(fits: Mapping[str, Fit], check: CheckPoints) -> dict[str, np.ndarray]:
    """Error vectors (n, 3), um, at the check points after rigid alignment, per fit."""
    return {
        name: after_alignment(compensated_points(fit, check.plan)[0], check.tool_point)[0] * 1e6
        for name, fit in fits.items()
    }


def check_points(errors: Mapping[str, np.ndarray], check: CheckPoints) -> Figure:
    """Size of the error at every check point from above and from the front, one colour scale."""
    points = check.tool_point * 1e3
    sizes = {name: np.linalg.norm(vectors, axis=1) for name, vectors in errors.items()}
    everything = np.concatenate(list(sizes.values()))
    low, high = np.quantile(everything, [0.02, 0.998])
    norm = LogNorm(max(low, high / 300.0), high)
    drawn = figure(9.6, 5.4)
    margins = {
        "left": 0.75, "right": 1.1, "top": 0.45, "bottom": 0.55, "wspace": 0.3, "hspace": 0.6,
    }  # fmt: skip
    table = grid(drawn, 2, len(errors), margins)
    dots = None
    for column, (name, size) in enumerate(sizes.items()):
        rms = np.sqrt((size**2).mean())
        for row, (a, b) in enumerate(((0, 1), (0, 2))):
            ax = table[row, column]
            order = np.argsort(size)
            dots = ax.scatter(
                points[order, a],
                points[order, b],
                c=size[order],
                s=15,
                cmap=FIELD,
                norm=norm,
                edgecolor="none",
            )
            titled(ax, f"{name}: rms {three_digits(rms)} µm" if row == 0 else "", f"{'XYZ'[a]}, mm")
            if column == 0:
                ax.set_ylabel(f"{'XYZ'[b]}, mm", fontsize=9.5, color=INK)
            else:
                ax.tick_params(labelleft=False)
    # The last tick label of a column and the first one of the next may touch.
    room = {
        "left": max(margins["left"], 0.45 + max(labels_width(ax.yaxis) for ax in table[:, 0])),
        "wspace": max(margins["wspace"], 0.1 + max(labels_width(ax.xaxis) for ax in table.flat)),
    }
    spread(drawn, table, margins | room)
    for ax in table.flat:
        ticks_apart(ax, 5)
    _plain_ticks(colour_bar(drawn, dots, table[:, -1], "error, µm"), norm)
    return drawn


def _plain_ticks(ax: Axes, norm: LogNorm) -> None:
    """Numbers such as 0.3, 1, 3 on a logarithmic colour bar."""
    ticks = [f * 10.0**k for k in range(-4, 5) for f in (1, 3)]
    ticks = [t for t in ticks if norm.vmin <= t <= norm.vmax]  # type: ignore[operator]
    ax.set_yticks(ticks, [f"{t:g}" for t in ticks])
    ax.set_yticks([], minor=True)


def error_over_time(fits: Mapping[str, Fit]) -> Figure:
    """3-D error of every observation over time: fitted ones faint, held-out ones full."""
    drawn = figure(9.6, 3.9)
    ax = grid(drawn, 1, 1, {"left": 0.8, "right": 0.2, "top": 0.45, "bottom": 0.6})[0, 0]
    plain(ax)
    colours = {"uncompensated": NOMINAL, "before": BEFORE, "after": AFTER}
    shown = []
    for name, fit in fits.items():
        plan = fit.measurement.plan
        column = "order" if "order" in plan.covariates else None
        x = np.asarray(plan.covariates[column]) if column else np.arange(plan.rows)
        held = heldout_residuals(fit)
        outside = np.isfinite(held).all(1)
        fitted = np.where((fit.used & ~outside)[:, None], fit.residual, np.nan)
        for values, faint in ((fitted, True), (held, False)):
            rows = np.isfinite(values).all(1)
            if not rows.any():
                continue
            size = np.sqrt(squared_errors(fit, values)) * 1e6
            shown.append(size)
            rms = np.sqrt((size**2).mean())
            ax.plot(
                x[rows],
                size,
                ".",
                color=colours[name],
                alpha=0.25 if faint else 0.9,
                markersize=4,
                label=f"{name}, {'fitted' if faint else 'held out'}: rms {three_digits(rms)} µm",
            )
    everything = np.concatenate(shown)
    ax.set_yscale("log")
    ax.set_ylim(0.8 * np.quantile(everything, 0.002), 1.2 * everything.max())
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))  # 20 and 60, no powers
    ax.legend(
        fontsize=8.5,
        ncols=2 * len(fits),
        loc="lower left",
        bbox_to_anchor=(-0.01, 1.0),
        frameon=False,
        markerscale=2,
        handletextpad=0.2,
    )
    titled(ax, "", "pose number, in the order of time", "3-D error, µm")
    return drawn
