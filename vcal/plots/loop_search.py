"""Significance of every kind of effect in each round of the search."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..loop.screening.screening import KindResult, Screening
from .style import AFTER, BEFORE, DOTS, INK, figure, grid, titled, width_of

_LETTERS = 72
"""Most characters of the headings of all panels, side by side."""
_MANY = 8
"""Number of rounds from which the columns share one axis label."""
_MOST = 12
"""Number of rounds from which the tick label 0 is left out."""


def minus_log10_p(screening: Screening, kind: KindResult) -> float:
    """-log10 of the corrected p-value of a kind, also where the p-value underflows."""
    p = screening.corrected(kind)
    if p > 1e-290:
        return max(-math.log10(p), 0.0)
    trials = max(kind.trials, 1.0) * max(screening.trials, 1.0)
    return (kind.minus_log_p - math.log(trials)) / math.log(10.0)


def search(screenings: Sequence[Screening], alpha: float) -> Figure:
    """Significance of the best candidate of every kind, a column per round, on a logarithmic scale.

    Blue: added in that round; orange: significant and not added; grey: not significant.
    """
    kinds = sorted({kind.kind for screening in screenings for kind in screening.kinds})
    height = {
        kind: minus_log10_p(screenings[0], k) for k in screenings[0].kinds for kind in [k.kind]
    }
    kinds.sort(key=lambda kind: height.get(kind, 0.0))
    added = [s.added.name if s.added is not None else "" for s in screenings]
    longest = max(map(len, added))
    # Names of added effects, where they have room side by side.
    named = len(screenings) <= 3 and 0 < longest * len(screenings) <= _LETTERS
    top = 0.62 if named else 0.45
    # Drawn text is slightly wider, because its letters begin at whole pixels.
    left = max(1.75, 0.2 + 1.06 * max(map(width_of, kinds), default=0.0))
    drawn = figure(7.85 + left, 0.7 + top + 0.235 * len(kinds))
    row = grid(
        drawn,
        1,
        len(screenings),
        {"left": left, "right": 0.25, "top": top, "bottom": 0.65, "wspace": 0.25},
    )[0]
    largest = max(10.0, *(minus_log10_p(s, k) for s in screenings for k in s.kinds))
    least = -math.log10(alpha)
    many = len(screenings) >= _MANY
    for i, (ax, screening, chosen) in enumerate(zip(row, screenings, added, strict=True)):
        values = {k.kind: minus_log10_p(screening, k) for k in screening.kinds}
        heights = [values.get(kind, 0.0) for kind in kinds]
        colours = [
            AFTER if kind == chosen else BEFORE if value >= least else DOTS
            for kind, value in zip(kinds, heights, strict=True)
        ]
        ax.barh(kinds, heights, color=colours, height=0.7)
        ax.axvline(least, color=INK, linewidth=1.1, linestyle="--")
        ax.set_xscale("symlog", linthresh=2.0, linscale=0.8)
        ax.set_xlim(0, largest * 1.6)
        ticks = [t for t in (0, 1, 2, 5, 10, 30, 100, 300, 1000, 3000) if t <= 1.5 * largest]
        most = max(2, 4 - len(screenings) // _MANY, 12 // len(screenings))
        ticks = [ticks[k] for k in np.unique(np.linspace(0, len(ticks) - 1, most).astype(int))]
        labels = [f"{t}" for t in ticks]
        if len(screenings) >= _MOST:
            labels[0] = ""
        ax.set_xticks(ticks, labels)
        ax.set_xticks([], minor=True)
        ax.grid(axis="y", visible=False)
        if i:
            ax.tick_params(labelleft=False)
        quantity = "−log₁₀ of corrected p" if len(screenings) <= 3 else "−log₁₀ p"
        if many:
            quantity = quantity + ", by round" if i == len(screenings) // 2 else ""
        titled(
            ax,
            (f"{i + 1}" if many else f"round {i + 1}")
            + (f"\nadded {chosen}" if chosen and named else ""),
            quantity,
        )
    return drawn
