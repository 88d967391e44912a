"""The pictures of a virtual calibration."""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from .. import plots
from ..plots import ErrorMotionTable
from ..plots.style import (
    AFTER,
    BEFORE,
    DOTS,
    FIELD,
    INK,
    figure,
    grid,
    png,
    titled,
)
from ..uncertainty.virtual import WHEN, Contribution, Motion, VirtualCalibration
from .picture import Picture
from .text import percent

_PLANES = (("X", "Y"), ("X", "Z"), ("Y", "Z"))
_BINS = 60
_TONES = {"noise": DOTS, "fitted": AFTER, "not fitted": BEFORE}
_NAMES = {
    "noise": "noise",
    "fitted": "fitted: what the data leave of its prior",
    "not fitted": "not fitted: all it does",
}


def virtual_pictures(result: VirtualCalibration) -> Iterator[Picture]:
    """All pictures of a virtual calibration, in the order of the page."""
    share = percent(result.coverage)
    if not result.faultless:
        caption = (
            "Root-mean-square volumetric error of every machine drawn, before and after "
            f"calibration. Bars below: {share} coverage intervals."
        )
        yield Picture("volumetric", "volumetric", caption, png(_histograms(result)))
    if result.nodes and not result.faultless:
        caption = (
            f"Volumetric error that {share} of the machines stay below, point by point in three "
            "mid-planes of the travel, after rigid alignment: before (top) and after calibration "
            "(bottom), each point under the conditions of a row of the plan picked at random. One "
            "colour scale per row."
        )
        yield Picture("field", "field", caption, png(_field(result)))
    if result.contributions:
        caption = (
            "What every source adds to the volumetric error after calibration, as a root mean "
            "square over points and machines (GUM). They add as squares."
        )
        yield Picture("sources", "sources", caption, png(_sources(result.contributions)))
    tables = [_table(motion) for motion in result.motions if motion.prior.any()]
    if tables:
        caption = (
            "What is left of every error motion after compensation (true less identified): mean "
            "and expanded uncertainty U (k = 2) by Monte Carlo in blue; grey: the motion before "
            "any measurement (± 2 standard deviations, cut off at the frame). Where blue is as "
            "wide as grey, the plan says nothing."
        )
        yield Picture("error_motions", "motions", caption, png(plots.error_motions(tables)))


def _table(motion: Motion) -> ErrorMotionTable:
    rotary = len(motion.position) and motion.axis not in ("X", "Y", "Z")
    prior = np.where(motion.prior > 0.0, motion.prior, np.inf)
    return ErrorMotionTable(
        name=motion.name,
        axis=motion.axis,
        unit=motion.unit,
        position=np.rad2deg(motion.position) if rotary else motion.position * 1e3,
        position_unit="deg" if rotary else "mm",
        value=motion.mean,
        u=motion.u,
        prior=motion.prior,
        information=np.clip(1.0 - (motion.u_gum / prior) ** 2, 0.0, 1.0),
    )


def _histograms(result: VirtualCalibration) -> Figure:
    drawn = figure(9.6, 3.2)
    margins = {"left": 0.75, "right": 0.25, "top": 0.4, "bottom": 0.6, "wspace": 0.75}
    for ax, when, tone in zip(grid(drawn, 1, 2, margins)[0], WHEN, (BEFORE, AFTER), strict=True):
        i = result.ensemble.index(f"rms volumetric error {when} [um]")
        values = result.ensemble.values[:, i]
        ax.hist(values[np.isfinite(values)], _BINS, color=tone, alpha=0.75, density=True)
        found = result.volumetric("rms", when)
        top = ax.get_ylim()[1]
        ax.plot([found.low, found.high], [-0.05 * top] * 2, color=INK, lw=3, clip_on=False)
        ax.set_ylim(-0.1 * top, top)
        ax.set_xlim(left=0.0)
        titled(ax, f"{when} calibration", "rms volumetric error, µm", "density, 1/µm")
    return drawn


def _field(result: VirtualCalibration) -> Figure:
    lines = dict(zip("XYZ", result.nodes, strict=True))
    shape = tuple(len(line) for line in result.nodes)
    drawn = figure(9.6, 0.75 + 2.45 * 2)
    table = grid(
        drawn,
        2,
        3,
        {"left": 0.75, "right": 1.1, "top": 0.4, "bottom": 0.55, "wspace": 0.75, "hspace": 0.85},
    )
    for row, when in enumerate(WHEN):
        cube = result.bounds(when).reshape(shape)
        meshes = []
        for ax, plane in zip(table[row], _PLANES, strict=True):
            (other,) = set(range(3)) - {"XYZ".index(axis) for axis in plane}
            values = np.take(cube, shape[other] // 2, axis=other)
            x, y = (lines[axis] * 1e3 for axis in plane)
            colours = {"cmap": FIELD, "vmin": 0.0, "vmax": cube.max(), "shading": "nearest"}
            meshes.append(ax.pcolormesh(x, y, values.T, **colours))
            title = f"{when} calibration" if ax is table[row][0] else ""
            titled(ax, title, f"{plane[0]}, mm", f"{plane[1]}, mm")
            ax.grid(False)
        at = table[row, -1].get_position()
        place = drawn.add_axes((at.x1 + 0.016, at.y0, 0.0146, at.height))
        bar = drawn.colorbar(meshes[-1], cax=place)
        bar.set_label("µm", fontsize=9.5, color=INK)
        place.tick_params(labelsize=9, colors=INK, length=3)
    return drawn


def _sources(contributions: tuple[Contribution, ...]) -> Figure:
    shown = contributions[:12][::-1]
    drawn = figure(9.6, 1.2 + 0.3 * len(shown))
    # Inches; names of data sets make them longer.
    left = min(max(2.4, 0.3 + 0.072 * max(len(c.source) for c in shown)), 5.0) if shown else 2.4
    ax = grid(drawn, 1, 1, {"left": left, "right": 0.9, "top": 0.5, "bottom": 0.55})[0, 0]
    place = np.arange(len(shown))
    for origin, tone in _TONES.items():
        mine = [k for k, c in enumerate(shown) if c.origin == origin]
        if mine:
            ax.barh(mine, [shown[k].rms for k in mine], color=tone, label=_NAMES[origin])
    for k, c in enumerate(shown):
        ax.annotate(
            percent(c.share),
            (c.rms, k),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
            color=INK,
        )
    ax.set_yticks(place, [c.source for c in shown])
    ax.legend(fontsize=8.5, ncols=3, loc="lower left", bbox_to_anchor=(-0.01, 1.0), frameon=False)
    titled(ax, "", "rms volumetric error from this source, µm")
    return drawn
