"""Pictures of a virtual calibration."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..uncertainty.virtual import WHEN, Contribution, VirtualCalibration
from .mid_planes import PLANES, PlaneRow, mid_planes
from .style import AFTER, BEFORE, DOTS, INK, figure, grid, titled, width_of

_BINS = 60
_MOST = 12
_TONES = {"noise": DOTS, "fitted": AFTER, "not fitted": BEFORE}
_NAMES = {
    "noise": "noise",
    "fitted": "identified: remainder of its prior",
    "not fitted": "not identified: its whole contribution",
}


def volumetric_histograms(result: VirtualCalibration) -> Figure:
    """Rms volumetric error of the machines drawn, before and after calibration."""
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


def volumetric_bounds(result: VirtualCalibration) -> Figure:
    """Upper coverage bound of the volumetric error before and after calibration, on the grid of its
    points.
    """
    rows = []
    for when in WHEN:
        cube = result.bounds(when).reshape([len(line) for line in result.nodes])
        sizes = []
        for plane in PLANES:
            (other,) = (i for i, axis in enumerate("XYZ") if axis not in plane)
            sizes.append(np.take(cube, cube.shape[other] // 2, axis=other))
        rows.append(PlaneRow(f"{when} calibration", sizes))
    return mid_planes(dict(zip("XYZ", result.nodes, strict=True)), rows, "nearest")


def sources(contributions: Sequence[Contribution]) -> Figure:
    """Contributions of the largest sources to the volumetric error after calibration."""
    shown = contributions[:_MOST][::-1]
    drawn = figure(9.6, 1.2 + 0.3 * len(shown))
    left = min(max(2.4, 0.3 + max(width_of(c.source) for c in shown)), 5.0)
    ax = grid(drawn, 1, 1, {"left": left, "right": 0.9, "top": 0.5, "bottom": 0.55})[0, 0]
    for origin, tone in _TONES.items():
        mine = [k for k, c in enumerate(shown) if c.origin == origin]
        if mine:
            ax.barh(mine, [shown[k].rms for k in mine], color=tone, label=_NAMES[origin])
    for k, c in enumerate(shown):
        ax.annotate(
            f"{100.0 * c.share:.{0 if c.share >= 0.1 else 1}f} %",
            (c.rms, k),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8.5,
            color=INK,
        )
    ax.set_yticks(np.arange(len(shown)), [c.source for c in shown])
    ax.legend(fontsize=8.5, ncols=3, loc="lower left", bbox_to_anchor=(-0.01, 1.0), frameon=False)
    titled(ax, "", "rms volumetric error from this source, µm")
    return drawn
