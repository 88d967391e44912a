"""Identified error motions with their uncertainty."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..geometry.error_motions import ErrorMotionTable
from .labels import pretty_unit
from .style import AFTER, DOTS, INK, figure, grid, ticks_apart, titled


def error_motions(tables: Sequence[ErrorMotionTable]) -> Figure:
    """Small multiples, a column per axis: value, U (k = 2) as a dark band, prior as a light one.

    Constant errors (the links of an arm) are drawn as one point each; location errors only where
    there are no error motions.
    """
    moving = [t for t in tables if len(t.position)] or list(tables)
    if all(t.constant for t in moving):
        return _constants(moving)
    axes = list(dict.fromkeys(t.axis for t in moving))
    drawn = figure(9.6, 0.9 + 1.55 * 6)
    table = grid(
        drawn,
        6,
        len(axes),
        {"left": 0.8, "right": 0.2, "top": 0.35, "bottom": 0.5, "wspace": 0.7, "hspace": 0.42},
    )
    for column, axis in enumerate(axes):
        mine = [t for t in moving if t.axis == axis]
        for row, t in enumerate(mine[:6]):
            ax = table[row, column]
            ax.fill_between(t.position, -2 * t.prior, 2 * t.prior, color="#e4e7eb", lw=0)
            ax.fill_between(
                t.position, t.value - 2 * t.u, t.value + 2 * t.u, color=AFTER, alpha=0.3, lw=0
            )
            ax.plot(t.position, t.value, color=AFTER, linewidth=1.5)
            ax.axhline(0.0, color=INK, linewidth=0.6)
            x = f"{axis}, {pretty_unit(t.position_unit)}" if row == len(mine) - 1 else ""
            titled(ax, t.name, x, pretty_unit(t.unit))
            bound = 1.15 * max(np.abs(t.value).max() + 2 * t.u.max(), 1e-9)
            ax.set_ylim(-bound, bound)
            ax.margins(x=0)
            ax.locator_params(axis="y", nbins=4)
            ticks_apart(ax, 5)
            if row < len(mine) - 1:
                ax.tick_params(labelbottom=False)
        for ax in table[len(mine) :, column]:
            ax.set_visible(False)
    return drawn


def _constants(tables: Sequence[ErrorMotionTable]) -> Figure:
    units = list(dict.fromkeys(t.unit for t in tables))
    tallest = max(sum(t.unit == unit for t in tables) for unit in units)
    drawn = figure(9.6, 1.1 + 0.21 * tallest)
    row = grid(
        drawn, 1, len(units), {"left": 0.7, "right": 0.2, "top": 0.45, "bottom": 0.6, "wspace": 0.8}
    )[0]
    for ax, unit in zip(row, units, strict=True):
        mine = [t for t in tables if t.unit == unit]
        place = np.arange(len(mine))[::-1]
        value = np.array([t.value[0] for t in mine])
        u = np.array([t.u[0] for t in mine])
        prior = np.array([t.prior[0] for t in mine])
        ax.errorbar(np.zeros(len(mine)), place, xerr=2 * prior, fmt="none", ecolor=DOTS, lw=5)
        ax.errorbar(value, place, xerr=2 * u, fmt="o", color=AFTER, markersize=4, capsize=2, lw=1.4)
        ax.axvline(0.0, color=INK, linewidth=0.6)
        ax.set_yticks(place, [t.name for t in mine])
        ax.set_ylim(-0.8, len(mine) - 0.2)
        kind = "translations" if unit == "um" else "rotations"
        titled(ax, f"error {kind}", f"identified, {pretty_unit(unit)}")
    return drawn
