"""Axes of a work space in three dimensions."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from .style import DOTS, INK

_ELEVATION, _AZIMUTH = 22, -57
_THINNEST = 0.25
"""Least height of the box of a work space, relative to its longest side."""


def work_space(
    drawn: Figure, columns: int, column: int, travel: Float[np.ndarray, "3 2"]
) -> Axes3D:
    """Axes in a column of a figure, with the edges of the travel of X, Y, Z (m); scales in mm."""
    ax = drawn.add_subplot(1, columns, column + 1, projection="3d", computed_zorder=False)
    assert isinstance(ax, Axes3D)
    ends = 1e3 * np.asarray(travel, float)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for sides in np.ndindex(2, 2):
            edge = np.empty((3, 2))
            edge[axis] = ends[axis]
            for other, side in zip(others, sides, strict=True):
                edge[other] = ends[other, side]
            ax.plot(*edge, color=DOTS, lw=0.6)
    span = np.ptp(ends, axis=1)
    ax.set_box_aspect((np.maximum(span, _THINNEST * span.max()) / span.max()).tolist())
    for letter, label in zip("XYZ", (ax.set_xlabel, ax.set_ylabel, ax.set_zlabel), strict=True):
        label(f"{letter}, mm", fontsize=8, color=INK, labelpad=-4)
    ax.tick_params(axis="both", labelsize=7, colors=INK, pad=-2)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    ax.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    return ax
