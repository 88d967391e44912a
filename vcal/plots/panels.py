"""Figures from a description: rows of panels, each a title, axis labels and marks.

A mark is a call of one method of the axes, so that everything matplotlib draws can be described:
``mark("plot", x, y, "o", color=AFTER, label="identified")``. Margins follow from the labels.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import methodcaller
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .style import (
    AFTER,
    BEFORE,
    INK,
    MARK,
    NOMINAL,
    figure,
    grid,
    labels_width,
    spread,
    titled,
    width_of,
)
from .work_space import work_space

GREEN = "#009E73"
PALETTE = (NOMINAL, AFTER, BEFORE, GREEN, MARK)
"""Colours of series, one after the other."""
Mark = Callable[[Axes], object]
_MARGINS = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6, "wspace": 0.7, "hspace": 0.85}
_AXIS_LABEL, _LEGEND_KEY = 0.45, 0.55
"""Space beside the labels of the ticks and of a legend, in inches."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes and what is drawn into it."""

    title: str = ""
    x: str = ""
    y: str = ""
    marks: Sequence[Mark] = ()
    legend: Literal["", "inside", "right"] = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """As in `Axes.set`: ``{"yscale": "log", "ylim": (0, 3)}``."""


def mark(method: str, *values: Any, **style: Any) -> Mark:
    """A call of a method of the axes."""
    return methodcaller(method, *values, **style)


def panels(
    *rows: Sequence[Panel], width: float, height: float, colours: str = "", **margins: float
) -> Figure:
    """Panels in rows of equal length; sizes and `margins` in inches, those of `grid`.

    `colours` labels a colour bar for the images of the panels, which have to share their limits.
    """
    drawn = figure(width, height)
    table = grid(drawn, len(rows), len(rows[0]), _MARGINS)
    right = 1.0 if colours else _MARGINS["right"]
    for ax, panel in zip(table.flat, [p for row in rows for p in row], strict=True):
        for one in panel.marks:
            one(ax)
        ax.set(**panel.settings)
        titled(ax, panel.title, panel.x, panel.y)
        if panel.legend == "inside":
            ax.legend(fontsize=8.5, frameon=False)
        elif panel.legend:
            ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
            texts = [line for t in ax.get_legend().get_texts() for line in t.get_text().split("\n")]
            right = max(right, _LEGEND_KEY + max(map(width_of, texts)))
    wide = _AXIS_LABEL + np.max([[labels_width(ax.yaxis) for ax in row] for row in table], axis=0)
    found = {"left": max(_MARGINS["left"], wide[0]), "right": right}
    if len(wide) > 1:
        found["wspace"] = max(_MARGINS["wspace"], 0.15 + wide[1:].max())
    spread(drawn, table, {**_MARGINS, **found, **margins})
    if colours:
        place = table[-1, -1].get_position()
        bar = drawn.add_axes((place.x1 + 0.015, place.y0, 0.015, place.height))
        drawn.colorbar(table[-1, -1].images[-1], cax=bar).set_label(colours, fontsize=9)
        bar.tick_params(labelsize=9)
    return drawn


def bars(
    series: Mapping[str, Mapping[str, float]],
    *,
    dots: Mapping[str, Mapping[str, float]] | None = None,
    dots_label: str = "",
    horizontal: bool = False,
    colours: Sequence[str] = PALETTE,
) -> tuple[Mark, ...]:
    """Groups of bars, one group per key of the series, and dots over those of the same name."""
    names = list(next(iter(series.values())))
    step = 0.8 / len(series)
    at = np.arange(len(names))[:: -1 if horizontal else 1]
    method, across = ("barh", "y") if horizontal else ("bar", "x")
    found: list[Mark] = []
    for i, (label, values) in enumerate(series.items()):
        shift = (i - 0.5 * (len(series) - 1)) * step
        place = at - shift if horizontal else at + shift
        sizes = [values[n] for n in names]
        found.append(mark(method, place, sizes, step, color=colours[i], label=label))
        if dots and label in dots:
            there = [dots[label].get(n, np.nan) for n in names]
            xy = (there, place) if horizontal else (place, there)
            found.append(mark("plot", *xy, "o", color=INK, ms=4, mfc="white"))
    if dots:
        found.append(mark("plot", [], [], "o", color=INK, ms=4, mfc="white", label=dots_label))
    return (*found, mark(f"set_{across}ticks", at, names), mark("grid", False, axis=across))


def spaces(
    views: Mapping[str, Sequence[Mark]], travel: Float[np.ndarray, "3 2"], width: float = 3.8
) -> Figure:
    """Marks in the work space with the travel of X, Y, Z (m), one view beside the other; the marks
    are in mm, `width` in inches per view.
    """
    drawn = figure(width * len(views), 4.1)
    for i, (name, marks) in enumerate(views.items()):
        ax = work_space(drawn, len(views), i, travel)
        for one in marks:
            one(ax)
        ax.set_title(name, fontsize=10, color=INK, y=1.04)
    drawn.subplots_adjust(left=0.02, right=0.95, bottom=0.07, top=0.89, wspace=0.1)
    return drawn
