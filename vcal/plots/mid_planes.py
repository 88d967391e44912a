"""Heat maps over three mid-planes of a travel."""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .style import FIELD, INK, figure, grid, labels_width, spread, ticks_apart, titled

PLANES = (("X", "Y"), ("X", "Z"), ("Y", "Z"))
_MARGINS = {"left": 0.75, "right": 1.1, "top": 0.4, "bottom": 0.55, "wspace": 0.75, "hspace": 0.85}


class PlaneRow(NamedTuple):
    """A row of heat maps with one colour scale."""

    title: str
    sizes: Sequence[Float[np.ndarray, "n m"]]
    """One array for each of `PLANES`, um; the first axis is along the plane's first letter."""
    vectors: Sequence[Float[np.ndarray, "n m 3"]] | None = None
    """Drawn over them as arrows, um."""


def mid_planes(
    nodes: Mapping[str, Float[np.ndarray, " n"]],
    rows: Sequence[PlaneRow],
    shading: Literal["gouraud", "nearest"] = "gouraud",
) -> Figure:
    """Rows of three heat maps with a colour bar each, on a grid along X, Y and Z in m."""
    drawn = figure(9.6, 0.75 + 2.45 * len(rows))
    table = grid(drawn, len(rows), len(PLANES), _MARGINS)
    meshes = []
    for line, row in zip(table, rows, strict=True):
        top = float(max(np.max(size) for size in row.sizes)) or 1.0
        for i, (ax, plane) in enumerate(zip(line, PLANES, strict=True)):
            x, y = (nodes[axis] * 1e3 for axis in plane)
            scale = {"cmap": FIELD, "vmin": 0.0, "vmax": top, "shading": shading}
            mesh = ax.pcolormesh(x, y, row.sizes[i].T, rasterized=True, **scale)
            if row.vectors is not None:
                _arrows(ax, x, y, plane, row.vectors[i], top)
            titled(ax, row.title if i == 0 else "", f"{plane[0]}, mm", f"{plane[1]}, mm")
            ax.grid(False)
        meshes.append(mesh)
    beside = 0.45 + max(labels_width(ax.yaxis) for ax in table.flat)
    room = {name: max(_MARGINS[name], beside) for name in ("left", "wspace")}
    spread(drawn, table, _MARGINS | room)
    for ax in table.flat:
        ticks_apart(ax, 5)
    for line, mesh in zip(table, meshes, strict=True):
        colour_bar(drawn, mesh, line[-1:], "µm")
    return drawn


def _arrows(ax: Axes, x, y, plane: tuple[str, str], vectors: np.ndarray, top: float) -> None:
    step = slice(1, None, 2)
    u, v = (vectors[step, step, "XYZ".index(axis)].T for axis in plane)
    ax.quiver(
        x[step],
        y[step],
        u,
        v,
        color="white",
        scale=6.0 * top,
        width=0.007,
        headwidth=3.5,
        headlength=4.0,
        headaxislength=3.5,
        minlength=0.4,
        pivot="mid",
    )


def colour_bar(drawn: Figure, mesh, axes: np.ndarray, label: str) -> Axes:
    """A colour bar right of axes, as high as the first to the last of them."""
    top, bottom = axes[0].get_position(), axes[-1].get_position()
    width = drawn.get_size_inches()[0]
    place = drawn.add_axes((bottom.x1 + 0.15 / width, bottom.y0, 0.14 / width, top.y1 - bottom.y0))
    bar = drawn.colorbar(mesh, cax=place)
    bar.set_label(label, fontsize=9.5, color=INK)
    place.tick_params(labelsize=9, colors=INK, length=3)
    bar.outline.set_visible(False)  # type: ignore[operator]
    return place
