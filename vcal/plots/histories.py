"""Pictures of the history of a machine: results over the dates of their measurement."""

import datetime
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from ..history import Outcome
from .labels import pretty_unit
from .style import AFTER, BEFORE, DOTS, INK, MARK, figure, grid, titled

_ACROSS = 3
_WIDE, _HIGH = 2.35, 2.1
"""Size of a panel, inches."""
_MARGINS = {"left": 0.8, "right": 0.25, "top": 0.4, "bottom": 0.5, "wspace": 0.75, "hspace": 0.8}
_COVERAGE = 2.0


def histories(found: Sequence[Outcome], dates: Sequence[datetime.date]) -> Figure:
    """One panel for every quantity of some series: values with U (k = 2) over the dates, the means
    before and after every significant step, the drift, and bands in which a step lies.

    An effect that is not named is a triangle at the smallest size that would have been named.
    """
    shown = [(one, k) for one in found for k in range(len(one.series.parts))]
    columns = min(len(shown), _ACROSS)
    rows = -(-len(shown) // columns)
    width = columns * (_WIDE + _MARGINS["wspace"]) - _MARGINS["wspace"]
    width += _MARGINS["left"] + _MARGINS["right"]
    height = rows * (_HIGH + _MARGINS["hspace"]) - _MARGINS["hspace"]
    height += _MARGINS["top"] + _MARGINS["bottom"]
    drawn = figure(width, height)
    table = grid(drawn, rows, columns, _MARGINS)
    for ax, (one, k) in zip(table.flat, shown, strict=False):
        _panel(ax, one, k, dates)
    for ax in table.flat[len(shown) :]:
        ax.remove()
    return drawn


def _panel(ax: Axes, found: Outcome, k: int, dates: Sequence[datetime.date]) -> None:
    series, days = found.series, date2num(dates)
    for i, entry in enumerate(series.entries):
        if entry.size is not None and entry.state != "not stated":
            tone = AFTER if entry.tested else DOTS
            ax.errorbar(
                days[i], entry.size.value[k], _COVERAGE * entry.size.u[k],
                fmt="o", ms=4, color=tone, capsize=3, lw=1.2,
            )  # fmt: skip
        elif (smallest := entry.smallest[k] if entry.smallest else None) is not None:
            ax.plot(days[i], smallest, "v", ms=5, color=DOTS, mfc="white")
    _steps(ax, found, k, days)
    name = series.parts[k].name
    unit = pretty_unit(series.parts[k].unit)
    titled(ax, f"{series.name}{f', {name}' if name else ''}", "date of measurement", unit)
    locator = AutoDateLocator(minticks=2, maxticks=5)
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    spare = 0.06 * max(days[-1] - days[0], 1.0)
    ax.set_xlim(days[0] - spare, days[-1] + spare)


def _steps(ax: Axes, found: Outcome, k: int, days: np.ndarray) -> None:
    """Fitted constants or the fitted line, and the bands of the steps."""
    for change in found.changes:
        if change.kind == "step":
            ax.axvspan(*date2num([change.first, change.last]), color=MARK, alpha=0.25, lw=0)
    for segment in found.segments:
        times = days[[segment.first, segment.last]]
        values = [segment.start[k], segment.end[k]]
        style = "-" if found.changes else ":"
        ax.plot(times, values, style, color=BEFORE if found.changes else INK, lw=1.4)
