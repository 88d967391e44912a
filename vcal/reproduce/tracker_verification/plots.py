"""Pictures of the tests: histograms, GUM against Monte Carlo, maps of uncertainty."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...plots.style import AFTER, BEFORE, DOTS, FIELD, INK, MARK, NOMINAL, figure, grid, titled
from .compared import Rung
from .probing import Probing
from .rank import Rank
from .setting import AREA_MM
from .trials import PARTS, Pooled, Trials

_MARGINS = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6, "wspace": 0.65, "hspace": 0.85}
_TITLES = {"initial": "initial error", "residual": "residual", "left": "error left"}
_COLOURS = (AFTER, BEFORE, MARK)


def histograms(kind: str, series: Mapping[str, Trials], printed: float | None) -> Figure:
    """One kind of error over all points and tests: X, Y, Z and distance, as the publication has it.

    The first of the `series` is filled, the others are lines; `printed` marks a mean distance.
    """
    drawn = figure(9.0, 6.0)
    axes = grid(drawn, 2, 2, _MARGINS)
    for ax, name in zip(axes.flat, PARTS, strict=True):
        for i, (label, trials) in enumerate(series.items()):
            _histogram(ax, trials.pooled[kind, name], label, i)
        titled(ax, f"{_TITLES[kind]}, {name}", "error, µm", "density per µm")
        ax.set_ylim(bottom=0.0)
    if printed is not None:
        axes.flat[3].axvline(printed, color=INK, lw=1.0, ls="--", label="printed mean")
    axes.flat[3].set_xlim(left=0.0)
    axes.flat[3].legend(fontsize=8.5, frameon=False)
    return drawn


def _histogram(ax: Axes, pooled: Pooled, label: str, place: int) -> None:
    density = pooled.share / np.diff(pooled.edges)
    if place == 0:
        ax.stairs(density, pooled.edges, fill=True, color=DOTS, alpha=0.6, label=label)
    else:
        ax.stairs(density, pooled.edges, color=_COLOURS[(place - 1) % 3], lw=1.4, label=label)


def singular_values(rank: Rank) -> Figure:
    """What the points can see: singular values in falling order."""
    drawn = figure(9.0, 3.2)
    ax = grid(drawn, 1, 1, _MARGINS)[0, 0]
    place = np.arange(1, rank.parameters + 1)
    seen = place <= rank.rank
    floor = rank.singular[: rank.rank].min() / 30.0
    ax.semilogy(place[seen], rank.singular[seen], "o", color=AFTER, ms=5, label="seen")
    ax.semilogy(
        place[~seen], np.full((~seen).sum(), floor), "v", color=BEFORE, ms=5, label="unseen (zero)"
    )
    ax.axhline(1.0, color=NOMINAL, lw=1.0, ls="--")
    titled(ax, "Rank at Z = 0", "direction", "machine's spread over noise")
    ax.legend(fontsize=8.5, frameon=False)
    return drawn


def agreement(rungs: Mapping[str, Rung]) -> Figure:
    """Standard uncertainty of the Monte Carlo over that of the GUM, output by output."""
    drawn = figure(9.0, 1.6 + 1.35 * len(rungs))
    axes = grid(drawn, len(rungs), 1, {**_MARGINS, "hspace": 0.45, "top": 0.4}, sharey=False)
    for i, (ax, (label, one)) in enumerate(zip(axes[:, 0], rungs.items(), strict=True)):
        tests = one.trials.ensemble.draws
        start = 0
        for colour, what, c in zip((AFTER, BEFORE), ("motions", "points"), one.both, strict=True):
            ratio = c.u[:, 1] / c.u[:, 0]
            ax.plot(np.arange(start, start + len(ratio)), ratio, ".", ms=4, color=colour)
            if i == 0:
                ax.plot([], [], "o", ms=5, color=colour, label=what)
            start += len(ratio)
        band = 2.0 / (2.0 * tests) ** 0.5
        ax.axhspan(1.0 - band, 1.0 + band, color=DOTS, alpha=0.35, lw=0)
        ax.axhline(1.0, color=INK, lw=0.8)
        titled(ax, label, "output" if i == len(rungs) - 1 else "", "u ratio")
    axes[0, 0].legend(fontsize=8.5, framealpha=0.9, ncols=2, loc="upper right")
    return drawn


def lengths(one: Rung, labels: Sequence[str]) -> Figure:
    """|d| at some points: Monte Carlo, and the length of a vector as the GUM describes it."""
    drawn = figure(9.0, 3.3)
    axes = grid(drawn, 1, len(labels), _MARGINS)[0]
    rng = np.random.default_rng(0)
    known = [found.label for found in one.lengths]
    for ax, label in zip(axes, labels, strict=True):
        ensemble = one.trials.ensemble
        values = ensemble.values[:, ensemble.index(label)]
        values = values[np.isfinite(values)]
        edges = np.linspace(0.0, 1.05 * values.max(), 50)
        ax.hist(values, edges, density=True, color=DOTS, alpha=0.6, label="Monte Carlo")
        k = 3 * known.index(label)
        block = one.covariance[k : k + 3, k : k + 3]
        normal = rng.multivariate_normal(np.zeros(3), block, 200_000)
        density, _ = np.histogram(np.linalg.norm(normal, axis=1), edges, density=True)
        ax.stairs(density, edges, color=AFTER, lw=1.5, label="|normal vector|, GUM")
        titled(ax, label.replace(" [um]", ""), "error left, µm", "density per µm")
    axes[-1].legend(fontsize=8.5, frameon=False)
    return drawn


def bars(rows: Sequence[tuple[str, float, float]]) -> Figure:
    """Mean error left per influence, as it is and after the best rigid alignment."""
    drawn = figure(9.0, 1.2 + 0.55 * len(rows))
    ax = grid(drawn, 1, 1, {**_MARGINS, "left": 3.0})[0, 0]
    at = np.arange(len(rows))[::-1]
    ax.barh(at + 0.19, [r[1] for r in rows], 0.36, color=BEFORE, label="as it is")
    ax.barh(at - 0.19, [r[2] for r in rows], 0.36, color=AFTER, label="after rigid alignment")
    ax.set_yticks(at, [r[0] for r in rows])
    titled(ax, "Mean error left at the points", "µm")
    # Above the frame, where no bar is.
    ax.legend(fontsize=8.5, frameon=False, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return drawn


def maps(probing: Probing) -> Figure:
    """Expanded uncertainty of every probed coordinate over the area."""
    drawn = figure(9.6, 3.3)
    margins = {**_MARGINS, "wspace": 0.75, "right": 1.0}
    axes = grid(drawn, 1, 3, margins)[0]
    U = 2.0 * probing.u
    low, high = U.min(), U.max()
    half = AREA_MM / (U.shape[0] - 1) / 2.0
    frame = (-half, AREA_MM + half, -half, AREA_MM + half)
    for i, ax in enumerate(axes):
        shown = ax.imshow(
            U[:, :, i].T, origin="lower", extent=frame, cmap=FIELD, vmin=low, vmax=high
        )
        ax.grid(False)
        titled(ax, f"U of {'XYZ'[i]} (k = 2)", "X, mm", "Y, mm")
    place = axes[-1].get_position()
    bar = drawn.add_axes((place.x1 + 0.015, place.y0, 0.015, place.height))
    drawn.colorbar(shown, cax=bar).set_label("µm", fontsize=9)
    bar.tick_params(labelsize=9)
    return drawn
