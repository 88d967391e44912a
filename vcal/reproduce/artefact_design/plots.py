"""Pictures: the family, the sweeps, artefacts and poses, gains, error against time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ...design import ArrayPoses
from ...plots.style import AFTER, BEFORE, DOTS, INK, MARK, NOMINAL, figure, grid, titled
from ...plots.work_space import work_space
from .setting import TOOL, TRAVEL, Known

_MARGINS = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6, "wspace": 0.7, "hspace": 0.9}
_GREEN = "#009E73"
OF: Mapping[Known, str] = {"S": AFTER, "P": BEFORE, "B": _GREEN}
"""Colour of each way to know the artefact."""
_BINS = 50
_SPACE = np.array([TRAVEL[c] for c in "XYZ"]) + np.array(TOOL)[:, None]
"""Of the tool point, which is a tool away from the axes."""


def functions(x_mm: np.ndarray, exx_um: np.ndarray, errors_um: np.ndarray) -> Figure:
    """EXX of some machines, and the distribution of the error of all at single points."""
    drawn = figure(9.6, 3.3)
    left, right = grid(drawn, 1, 2, _MARGINS)[0]
    for i, values in enumerate(exx_um):
        left.plot(x_mm, values, lw=1.1, color=[AFTER, BEFORE, MARK, _GREEN][i % 4])
    titled(left, "EXX of drawn machines", "X, mm", "µm")
    edges = np.linspace(0.0, float(np.quantile(errors_um, 0.999)), _BINS)
    right.hist(errors_um, edges, density=True, color=NOMINAL)
    titled(right, "Volumetric error, not compensated", "|error| at a point, µm", "density, 1/µm")
    return drawn


Line = Mapping[Known, tuple[Sequence[float], Sequence[float]]]


def sweep(
    title: str,
    x_label: str,
    values: Sequence[float],
    bayes: Mapping[Known, Sequence[float]],
    machines: Line,
    plain: Sequence[float],
) -> Figure:
    """Expected error against one number of the design: lines theory, dots drawn machines."""
    drawn = figure(6.4, 3.6)
    ax = grid(drawn, 1, 1, {**_MARGINS, "right": 1.9})[0, 0]
    ax.plot(values, plain, "s--", color=NOMINAL, ms=4, lw=1.0, label="least squares")
    for known, line in bayes.items():
        ax.plot(values, line, "-", color=OF[known], lw=1.6, label=known)
        ax.plot(*machines[known], "o", color=OF[known], ms=5, mfc="white")
    ax.plot([], [], "o", color=INK, ms=5, mfc="white", label="drawn machines")
    ax.set_yscale("log")
    ax.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    ax.minorticks_off()
    titled(ax, title, x_label, "rms on the grid, µm")
    ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn


def distributions(before: np.ndarray, after: Mapping[str, np.ndarray]) -> Figure:
    """Distribution of the error at single points of single machines."""
    drawn = figure(8.2, 3.4)
    left, right = grid(drawn, 1, 2, _MARGINS)[0]
    edges = np.linspace(0.0, float(np.quantile(before, 0.999)), _BINS)
    left.hist(before, edges, density=True, color=NOMINAL)
    titled(left, "before compensation", "|error| at a point, µm", "density, 1/µm")
    most = max(float(np.quantile(v, 0.998)) for v in after.values())
    edges = np.linspace(0.0, most, _BINS)
    for colour, (label, values) in zip((MARK, AFTER, _GREEN), after.items(), strict=True):
        right.hist(values, edges, density=True, histtype="step", lw=1.6, color=colour, label=label)
    right.legend(fontsize=8.5, frameon=False)
    titled(right, "after compensation", "|error| at a point, µm", "density, 1/µm")
    return drawn


def bars(
    series: Mapping[str, Mapping[str, float]],
    title: str,
    *,
    dots: Mapping[str, Mapping[str, float]] | None = None,
    value: str = "rms on the grid, µm",
    width: float = 9.0,
    legend: float = 1.7,
) -> Figure:
    """Groups of bars by label, one bar of each series in it; dots over the bars."""
    drawn = figure(width, 3.4)
    ax = grid(drawn, 1, 1, {**_MARGINS, "right": legend})[0, 0]
    labels = list(next(iter(series.values())))
    step = 0.8 / len(series)
    at = np.arange(len(labels))
    colours = (NOMINAL, AFTER, BEFORE, _GREEN, MARK)
    for i, (name, values) in enumerate(series.items()):
        place = at + (i - 0.5 * (len(series) - 1)) * step
        ax.bar(place, [values[n] for n in labels], step, color=colours[i], label=name)
        if dots and name in dots:
            ax.plot(place, [dots[name].get(n, np.nan) for n in labels], "o", color=INK, ms=4,
                    mfc="white")  # fmt: skip
    if dots:
        ax.plot([], [], "o", color=INK, ms=4, mfc="white", label="drawn machines")
    ax.set_xticks(at, labels)
    ax.grid(False, axis="x")
    titled(ax, title, "", value)
    ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn


def artefacts(shapes: Mapping[str, np.ndarray]) -> Figure:
    """Artefacts from the side and from above, balls in m."""
    drawn = figure(9.6, 1.75 * len(shapes) + 0.5)
    axes = grid(drawn, len(shapes), 2, {**_MARGINS, "hspace": 0.75, "top": 0.4})
    most = 1.15e3 * max(float(np.abs(b[:, 1:]).max()) for b in shapes.values())
    for (left, right), (name, balls) in zip(axes, shapes.items(), strict=True):
        x, y, z = 1e3 * np.asarray(balls).T
        for ax, across, letter in ((left, y, "y"), (right, z, "z")):
            ax.plot(x, across, "-", color=DOTS, lw=0.8)
            ax.plot(x, across, "o", color=AFTER, ms=6)
            ax.set_ylim(-most, most)
            titled(ax, name if letter == "y" else "", "", f"{letter}, mm")
    for ax in axes[-1]:
        ax.set_xlabel("x, mm", fontsize=9.5, color=INK)
    return drawn


def poses(designs: Mapping[str, ArrayPoses]) -> Figure:
    """Artefacts in their poses, in the work space of the tool point."""
    drawn = figure(4.6 * len(designs), 4.3)
    for i, (name, design) in enumerate(designs.items()):
        ax = work_space(drawn, len(designs), i, _SPACE)
        for k, balls in enumerate(1e3 * np.asarray(design.centres)):
            ax.plot(*balls.T, "o-", color=(AFTER, BEFORE, MARK, _GREEN)[k % 4], ms=2.6, lw=0.8)
        ax.set_title(name, fontsize=10, color=INK, y=1.02)
    drawn.subplots_adjust(left=0.02, right=0.95, bottom=0.07, top=0.9, wspace=0.1)
    return drawn


def front(
    points: Mapping[Known, Sequence[tuple[float, float, str]]],
    nominal: Mapping[Known, tuple[float, float]],
) -> Figure:
    """Error against measuring time, (h, um, label); the nominal design as a cross."""
    drawn = figure(8.2, 4.2)
    ax = grid(drawn, 1, 1, {**_MARGINS, "right": 1.6})[0, 0]
    for known, line in points.items():
        x, y = [p[0] for p in line], [p[1] for p in line]
        ax.plot(x, y, "o-", color=OF[known], ms=4.5, lw=1.2, label=known)
        for time, error, label in line if known == "P" else ():
            ax.annotate(label, (time, error), fontsize=7, color=INK, xytext=(3, 4),
                        textcoords="offset points")  # fmt: skip
        ax.plot(*nominal[known], "x", color=OF[known], ms=9, mew=2)
    ax.plot([], [], "x", color=INK, ms=8, mew=2, ls="", label="nominal 12 x 11")
    ax.set_ylim(bottom=0.0)
    titled(ax, "Error against measuring time", "measuring time, h", "expected rms, µm")
    ax.legend(fontsize=8.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return drawn
