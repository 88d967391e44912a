"""Pictures: beams, budget along the beam, tables as bars, the second device, better layouts."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...plots.style import AFTER, BEFORE, DOTS, INK, MARK, NOMINAL, figure, grid, titled
from ...plots.work_space import work_space
from .setting import THIRTEEN, TRAVEL, Layout
from .verification import BAND_UM, Agreement

_MARGINS = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6, "wspace": 0.65, "hspace": 0.85}
_COLOURS = (NOMINAL, AFTER, BEFORE, MARK)
_REPEATS = 3
_SPACE = np.array([TRAVEL[c] for c in "XYZ"])


def beams(layouts: Mapping[str, Layout]) -> Figure:
    """Beam paths in the work space, with their points; the light starts at the square."""
    drawn = figure(3.2 * len(layouts), 3.9)
    for i, (name, layout) in enumerate(layouts.items()):
        ax = work_space(drawn, len(layouts), i, _SPACE)
        for one in layout.segments:
            ends = 1e3 * np.array([one.start, one.end])
            ax.plot(*ends.T, color=BEFORE, lw=1.2)
            middle = ends.mean(0)
            x, y, z = middle
            ax.text(x, y, z, str(one.number), fontsize=9, color=INK)
        ax.plot(*(1e3 * layout.position).T, ".", color=AFTER, ms=4.5)
        ax.plot(*(1e3 * np.array([layout.segments[0].start])).T, "s", color=BEFORE, ms=6)
        ax.set_title(name, fontsize=10, color=INK, y=1.06)
    drawn.subplots_adjust(left=0.01, right=0.96, bottom=0.06, top=0.88, wspace=0.08)
    return drawn


def along_the_beam(path_m: np.ndarray, parts: Mapping[str, np.ndarray], cuts: Sequence[float]):
    """Variance of a reading along the beam, influence on influence."""
    drawn = figure(9.0, 3.8)
    ax = grid(drawn, 1, 1, {**_MARGINS, "right": 2.6})[0, 0]
    shades = [NOMINAL, DOTS, MARK, "#009E73", "#CC79A7", AFTER, BEFORE]
    squares = [np.asarray(v) ** 2 for v in parts.values()]
    ax.stackplot(path_m, squares, labels=list(parts), colors=shades[: len(parts)], lw=0)
    for cut in cuts:
        ax.axvline(cut, color=INK, lw=0.7, ls=":")
    ax.set_xlim(path_m.min(), path_m.max())
    titled(ax, "Variance of a reading", "way of the light, m", "u², µm²")
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(
        handles[::-1], labels[::-1], fontsize=8.5, frameon=False, loc="center left",
        bbox_to_anchor=(1.0, 0.5),
    )  # fmt: skip
    return drawn


def bars(
    series: Mapping[str, Mapping[str, float]],
    title: str,
    *,
    value: str = "U (k = 2), µm",
    log: bool = False,
) -> Figure:
    """The thirteen, one group of bars each, in um."""
    drawn = figure(9.0, 3.4)
    ax = grid(drawn, 1, 1, _MARGINS)[0, 0]
    width = 0.8 / len(series)
    at = np.arange(len(THIRTEEN))
    for i, (label, values) in enumerate(series.items()):
        ax.bar(
            at + (i - 0.5 * (len(series) - 1)) * width,
            [values[n] for n in THIRTEEN],
            width,
            color=_COLOURS[i],
            label=label,
        )
    ax.set_xticks(at, THIRTEEN)
    ax.grid(False, axis="x")
    if log:
        ax.set_yscale("log")
    titled(ax, title, "", value)
    if len(series) > 1:
        ax.legend(fontsize=8.5, frameon=False, loc="upper left")
    return drawn


def second_device(agreements: Sequence[Agreement]) -> Figure:
    """Difference of the two devices, repeat by repeat, segment by segment."""
    drawn = figure(9.6, 8.8)
    rows = len(agreements) // 2
    margins = {**_MARGINS, "hspace": 0.6, "wspace": 0.45, "bottom": 0.55}
    axes = grid(drawn, rows, 2, margins)
    for ax, one in zip(axes.flat, agreements, strict=True):
        _agreement(ax, one)
    for ax in axes[-1]:
        ax.set_xlabel("place on the beam, mm", fontsize=9.5, color=INK)
    return drawn


def _agreement(ax: Axes, one: Agreement) -> None:
    ax.axhspan(-BAND_UM, BAND_UM, color=DOTS, alpha=0.25, lw=0)
    for r, difference in enumerate(one.difference[:_REPEATS]):
        ax.plot(one.place_mm, difference, ".-", color=_COLOURS[1 + r], lw=0.9, ms=5)
    rmse = ", ".join(f"{v:.1f}" for v in one.rmse[:_REPEATS])
    titled(ax, f"segment {one.segment}, {one.component}: RMSE {rmse} µm", "", "µm")
    ax.set_ylim(-1.7 * BAND_UM, 1.7 * BAND_UM)
