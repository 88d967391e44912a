"""Pictures of a designed measurement: its artefact, its positions, its uncertainties."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from .labels import pretty_unit
from .style import AFTER, BEFORE, DOTS, INK, NOMINAL, figure, grid, plain, titled
from .work_space import work_space


class Places(NamedTuple):
    """Positions of a plan, m, with the groups they belong to."""

    name: str
    position: Float[np.ndarray, "n 3"]
    """X, Y, Z."""
    group: np.ndarray
    """A number per row; rows with the same number are joined."""
    station: Float[np.ndarray, "3"] | None = None
    """Position of the instrument, if it has one."""
    colour: str = AFTER


class Angles(NamedTuple):
    """Angles of the rotary axes of a plan, deg, by their names."""

    name: str
    angle: Mapping[str, Float[np.ndarray, " n"]]
    travel: Mapping[str, Float[np.ndarray, "2"]]
    colour: str = AFTER


class Uncertain(NamedTuple):
    """The largest expanded uncertainty of one error."""

    name: str
    unit: str
    prior: float
    before: float
    after: float


def artefact_views(nominal: Mapping[str, np.ndarray], made: Mapping[str, np.ndarray]) -> Figure:
    """Present and designed balls from two sides; columns as in the artefact's table."""
    sizes = {c: np.ptp(np.r_[nominal[f"{c}_mm"], made[f"{c}_mm"]]) for c in "xyz"}
    first, second, third = sorted("xyz", key=lambda c: -sizes[c])
    drawn = figure(9.6, 4.4)
    margins = {"left": 0.75, "right": 0.2, "top": 0.4, "bottom": 0.55, "hspace": 0.45}
    column = grid(drawn, 2, 1, margins)[:, 0]
    for ax, across in zip(column, (second, third), strict=True):
        for table, colour, mark, word in (
            (nominal, BEFORE, "o", "present"),
            (made, AFTER, "o", "designed"),
        ):
            x, y = table[f"{first}_mm"], table[f"{across}_mm"]
            order = np.argsort(x)
            faint = {"color": colour, "linewidth": 0.8, "alpha": 0.5}
            ax.plot(x[order], y[order], **faint)
            face = "white" if word == "present" else colour
            ax.plot(x, y, mark, color=colour, markerfacecolor=face, markersize=6, label=word)
        for ball, x, y in zip(made["ball"], made[f"{first}_mm"], made[f"{across}_mm"], strict=True):
            ax.annotate(
                f"{int(ball)}", (x, y), xytext=(0, 5), textcoords="offset points", fontsize=7.5,
                ha="center", color=INK,
            )  # fmt: skip
        ax.margins(y=0.25)
        below = f"{first}, mm" if ax is column[-1] else ""
        titled(ax, f"{first} and {across} of the artefact", below, f"{across}, mm")
    column[0].legend(
        fontsize=8.5, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False
    )
    return drawn


def places_views(travel: Float[np.ndarray, "3 2"], views: Sequence[Places]) -> Figure:
    """Plans in the work space, side by side in three dimensions; travel of X, Y, Z in m."""
    drawn = figure(9.6, 3.9)
    for i, view in enumerate(views):
        ax = work_space(drawn, len(views), i, travel)
        at = view.position.T * 1e3
        groups = np.unique(view.group)
        if len(groups) < len(view.group):
            for group in groups:
                ax.plot(
                    *at[:, view.group == group], "-", color=view.colour, linewidth=0.9, alpha=0.6
                )
        x, y, z = at
        ax.plot(x, y, z, ".", color=view.colour, markersize=4)
        if view.station is not None:
            place = view.station * 1e3
            ax.plot(*place[:, None], "^", color=INK, markersize=7)
            east, north, up = place.tolist()
            ax.text(east, north, up, " instrument", fontsize=8, color=INK)
        ax.text2D(0.04, 0.94, view.name, fontsize=10, color=INK, transform=ax.transAxes)
    drawn.subplots_adjust(left=0.0, right=0.95, top=0.99, bottom=0.05, wspace=0.02)
    return drawn


def angles_views(views: Sequence[Angles]) -> Figure:
    """Angles of plans, side by side: each rotary axis over the one with the largest travel, a
    single one over the rows.
    """
    travel = views[0].travel
    first, *others = sorted(travel, key=lambda axis: -float(np.ptp(travel[axis])))
    drawn = figure(9.6, 0.9 + 2.3 * max(len(others), 1))
    margins = {"left": 0.75, "right": 0.2, "top": 0.35, "bottom": 0.55, "wspace": 0.8}
    table = grid(drawn, max(len(others), 1), len(views), margins | {"hspace": 0.6})
    for column, view in zip(table.T, views, strict=True):
        for ax, axis in zip(column, others or [first], strict=True):
            across = np.arange(1, len(view.angle[axis]) + 1) if axis == first else view.angle[first]
            ax.plot(across, view.angle[axis], ".", color=view.colour, markersize=4)
            for end in travel[axis]:
                ax.axhline(end, color=DOTS, lw=0.6)
            for end in travel[first] if others else ():
                ax.axvline(end, color=DOTS, lw=0.6)
            below = "row" if axis == first else f"{first}, deg"
            titled(ax, view.name if ax is column[0] else "", below, f"{axis}, deg")
    return drawn


def _round(low: float, high: float) -> list[float]:
    """At most seven round numbers from `low` to `high`."""
    decades = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    for steps in ((1, 1.5, 2, 3, 4, 5, 6, 8), (1, 2, 3, 5), (1, 3), (1,)):
        found = [
            s * 10.0**d for d in decades for s in steps if low / 1.2 <= s * 10.0**d <= high * 1.2
        ]
        if len(found) <= 7:
            return found
    return found[:: len(found) // 7 + 1]


def uncertainties(rows: Sequence[Uncertain], words: tuple[str, str]) -> Figure:
    """Largest U of every error, logarithmic: before any measurement, and with two plans."""
    # A slope of um/m and an angle of urad are the same number.
    panels: dict[str, list[Uncertain]] = {}
    for row in rows:
        panels.setdefault("urad" if row.unit == "um/m" else row.unit, []).append(row)
    tallest = max(map(len, panels.values()))
    drawn = figure(9.6, 1.25 + 0.235 * tallest)
    margins = {"left": 0.75, "right": 0.2, "top": 0.55, "bottom": 0.6, "wspace": 0.8}
    for ax, mine in zip(grid(drawn, 1, len(panels), margins)[0], panels.values(), strict=True):
        mine = mine[::-1]
        units = " or ".join(sorted({pretty_unit(row.unit) for row in mine}, reverse=True))
        place = np.arange(len(mine))
        before, after = (np.array([getattr(r, k) for r in mine]) for k in ("before", "after"))
        prior = np.array([r.prior for r in mine])
        if np.isfinite(prior).all():
            ax.plot(prior, place, "|", color=NOMINAL, markersize=9, label="before any measurement")
        ax.hlines(place, np.minimum(before, after), np.maximum(before, after), color=DOTS, lw=2)
        ax.plot(before, place, "o", color=BEFORE, markersize=5, label=words[0])
        ax.plot(after, place, "o", color=AFTER, markersize=5, label=words[1])
        ax.set_xscale("log")
        shown = np.r_[before, after, prior[np.isfinite(prior)]]
        ticks = _round(float(shown.min()), float(shown.max()))
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
        ax.set_xticks([], minor=True)
        ax.set_yticks(place, [row.name for row in mine])
        ax.set_ylim(-0.7, len(mine) - 0.3)
        plain(ax)
        titled(ax, "", f"largest U (k = 2) along the axis, {units}")
    drawn.axes[0].legend(
        fontsize=8.5, ncols=3, loc="lower left", bbox_to_anchor=(-0.02, 1.0), frameon=False
    )
    return drawn


def worth(groups: Sequence[int], shares: Float[np.ndarray, " g"], group: str) -> Figure:
    """Increase of the criterion without each group, as a share."""
    drawn = figure(9.6, 2.6)
    ax = grid(drawn, 1, 1, {"left": 0.75, "right": 0.2, "top": 0.3, "bottom": 0.6})[0, 0]
    ax.bar(np.arange(len(groups)), 100.0 * shares, color=AFTER, width=0.75)
    step = max(1, len(groups) // 24)
    ax.set_xticks(np.arange(len(groups))[::step], [str(g) for g in groups][::step])
    ax.margins(x=0.01)
    titled(ax, "", f"{group} left out", "increase of the criterion, %")
    return drawn
