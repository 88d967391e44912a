"""Common style of all figures: type size, palette, units and column names as labels."""

import copy
import functools
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, Tick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath

BEFORE = "#D55E00"
AFTER = "#0072B2"
NOMINAL = "#6b6b6b"
MARK = "#E69F00"
"""Palette of Okabe and Ito, distinguishable with colour vision deficiency."""
DOTS = "#9aa5b1"
INK = "#1f2933"
FIELD = "viridis"
TONE = "#21918c"
"""Colour map of fields, and its middle."""

DPI = 110
_BETWEEN = 0.08
"""Least gap between two tick labels, inches."""
_LABEL = 9.0
"""Font size of labels, points."""


def figure(width: float, height: float) -> Figure:
    """An empty figure of this size in inches, without global state."""
    drawn = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(drawn)
    return drawn


def grid(
    drawn: Figure,
    rows: int,
    columns: int,
    margins: Mapping[str, float],
    *,
    sharey: bool = False,
) -> np.ndarray:
    """Styled axes (rows, columns) with margins that are independent of the size of the figure.

    `margins` are in inches: ``left``, ``right``, ``top``, ``bottom``, and the gaps ``wspace`` and
    ``hspace`` between columns and rows.
    """
    shares = _shares(drawn, rows, columns, margins)
    table = drawn.subplots(rows, columns, squeeze=False, sharey=sharey, gridspec_kw=shares)
    for ax in table.flat:
        plain(ax)
    return table


def spread(drawn: Figure, table: np.ndarray, margins: Mapping[str, float]) -> None:
    """Change the margins of a `grid`, once its labels are known."""
    rows, columns = table.shape
    shares = _shares(drawn, rows, columns, margins)
    table[0, 0].get_gridspec().update(**shares)
    for ax in table.flat:
        ax.set_position(ax.get_subplotspec().get_position(drawn))


def _shares(
    drawn: Figure, rows: int, columns: int, margins: Mapping[str, float]
) -> dict[str, float]:
    """Margins in the units of matplotlib: shares of the figure and of the axes."""
    width, height = drawn.get_size_inches()
    wspace, hspace = margins.get("wspace", 0.0), margins.get("hspace", 0.0)
    inner_w = (width - margins["left"] - margins["right"] - wspace * (columns - 1)) / columns
    inner_h = (height - margins["top"] - margins["bottom"] - hspace * (rows - 1)) / rows
    return {
        "left": margins["left"] / width,
        "right": 1.0 - margins["right"] / width,
        "top": 1.0 - margins["top"] / height,
        "bottom": margins["bottom"] / height,
        "wspace": wspace / inner_w,
        "hspace": hspace / inner_h,
    }


def plain(ax: Axes) -> None:
    """Thin frame on two sides, light grid, readable ticks."""
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color("#9aa5b1")
    ax.tick_params(labelsize=9, colors=INK, length=3, width=0.8)
    ax.grid(True, color="#e4e7eb", linewidth=0.7)
    ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        for which in ("major", "minor"):
            name = f"get_{which}_ticks"
            setattr(axis, name, functools.partial(_copied, axis, getattr(axis, name), which))


def _copied(
    axis: Axis, usual: Callable[[int], list[Tick]], which: str, numticks: int | None = None
) -> list[Tick]:
    """The ticks of an axis, each a copy of the first one.

    What `Axis.get_major_ticks` and `Axis.get_minor_ticks` return: they make every tick from the
    style sheet and then copy the properties of the first one, which takes a quarter of the time of
    a picture.
    """
    if numticks is None:
        numticks = len(axis.get_majorticklocs() if which == "major" else axis.get_minorticklocs())
    ticks = usual(min(numticks, 1))
    known = axis.majorTicks if which == "major" else axis.minorTicks
    while ticks and len(known) < numticks:
        one = copy.copy(ticks[0])
        for name in ("tick1line", "tick2line", "gridline", "label1", "label2"):
            setattr(one, name, copy.copy(getattr(one, name)))
        known.append(one)
    return known[:numticks]


def titled(ax: Axes, title: str, x: str = "", y: str = "") -> None:
    """Title and axis labels in the common style."""
    _set_title(ax, title, 6.0)
    if x:
        ax.set_xlabel(x, fontsize=9.5, color=INK)
    if y:
        ax.set_ylabel(y, fontsize=9.5, color=INK)


def _set_title(ax: Axes, title: str, pad: float) -> None:
    # At a fixed height: matplotlib would measure all labels of the axes to find one.
    ax.set_title(title, fontsize=10, color=INK, loc="left", pad=pad, y=1.0)


def raise_titles(drawn: Figure) -> list[Axes]:
    """Move titles above the power of ten or the offset that a y axis shows where they begin;
    returns the axes that have any. What an axis shows may depend on where drawing puts it: where
    these are others after the figure has been drawn, it is to be drawn again.
    """
    found = []
    for ax in drawn.axes:
        title, axis = ax.get_title(loc="left"), ax.yaxis
        shown, formatter = axis.get_offset_text(), axis.get_major_formatter()
        if not title or ax.name == "3d" or not shown.get_visible():
            continue
        formatter.format_ticks(list(axis.get_majorticklocs()))
        if formatter.get_offset():
            _set_title(ax, title, 6.0 + 1.5 * float(shown.get_fontsize()))
            found.append(ax)
    return found


@functools.lru_cache(4096)  # numbers at ticks, which are the same in many pictures
def width_of(text: str) -> float:
    """Width of a label, inches."""
    if not text:
        return 0.0
    drawn = TextPath((0.0, 0.0), text, size=_LABEL)
    # Outlines have points where they are widest, so that no curve has to be evaluated.
    x = drawn.vertices[drawn.codes != TextPath.CLOSEPOLY, 0]
    return float(np.ptp(x)) / 72.0 if len(x) else 0.0


def labels_width(axis: Axis) -> float:
    """Largest width of the tick labels of an axis, inches."""
    low, high = sorted(axis.get_view_interval())
    ticks = [x for x in axis.get_majorticklocs() if low <= x <= high]
    labels = axis.get_major_formatter().format_ticks(ticks)
    return max((width_of(label) for label in labels), default=0.0)


def ticks_apart(ax: Axes, most: int) -> None:
    """At most `most` steps between the ticks of x, fewer where their labels would touch."""
    whole = ax.get_figure(root=True)
    assert whole is not None
    low, high = sorted(ax.get_xlim())
    per_inch = (high - low) / (ax.get_position().width * whole.get_size_inches()[0])
    for steps in range(most, 0, -1):
        ax.locator_params(axis="x", nbins=steps)
        ticks = np.array([x for x in ax.get_xticks() if low <= x <= high])
        labels = ax.xaxis.get_major_formatter().format_ticks(list(ticks))
        half = np.array([0.5 * width_of(label) for label in labels])
        if (np.diff(ticks) / per_inch >= half[1:] + half[:-1] + _BETWEEN).all():
            return


def png(drawn: Figure) -> bytes:
    """The figure as a PNG file."""
    return _saved(drawn, format="png", dpi=DPI)


def svg(drawn: Figure) -> bytes:
    """The figure as an SVG file, the same bytes every time; text is drawn as outlines."""
    with matplotlib.rc_context({"svg.hashsalt": "vcal", "svg.fonttype": "path"}):
        return _saved(drawn, format="svg", metadata={"Date": None})


def _saved(drawn: Figure, **how: Any) -> bytes:
    buffer, raised = io.BytesIO(), raise_titles(drawn)
    drawn.savefig(buffer, **how)
    if raise_titles(drawn) != raised:
        buffer = io.BytesIO()
        drawn.savefig(buffer, **how)
    return buffer.getvalue()


def limit(values: Sequence[np.ndarray], share: float = 0.995) -> float:
    """A bound above all but a few of the largest magnitudes."""
    sizes = np.abs(np.concatenate([np.ravel(v) for v in values]))
    sizes = sizes[np.isfinite(sizes)]
    return float(np.quantile(sizes, share)) * 1.15 if len(sizes) and sizes.any() else 1.0
