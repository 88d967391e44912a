"""A figure as pieces that can stand below one another, so that a narrow page need not shrink it.

A figure of several panels is drawn once and cut where nothing is drawn: between its rows, and
between the panels of a row. Side by side the pieces are the figure; below one another each of them
is readable alone. What panels share is repeated or kept together: tick labels that only the first
panel of a row has are a strip that goes before the others, panels that share the tick labels of x
stay in one piece, and so does a colour bar with the panel on its left.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from .style import DPI, raise_titles

_TICK = 5
"""Pixels left of the axes that belong to the marks of the ticks."""
_LEVEL = 4
"""Level of the compression of PNG: half the time of the default for three percent more bytes."""


@dataclass(frozen=True)
class Piece:
    """A part of a figure."""

    data: bytes
    """PNG."""
    width: int
    """Pixels."""
    strip: bytes = b""
    """Labels that the panel shares with the first one of its row, as PNG; empty: it has its own."""
    strip_width: int = 0
    """Pixels."""


@dataclass(frozen=True)
class Pieces:
    """A figure and its pieces."""

    whole: bytes
    """PNG of the whole figure."""
    rows: tuple[tuple[Piece, ...], ...]
    """Pieces from left to right, row by row; the rows are as wide as the figure."""
    text_px: float
    """Size of the smallest text, pixels."""
    colours: bool
    """Whether colours stand for numbers: the figure has a colour bar."""


def cut(drawn: Figure) -> Pieces:
    """Draw a figure and cut it into its pieces."""
    canvas = drawn.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    raised = raise_titles(drawn)
    canvas.draw()
    if raise_titles(drawn) != raised:
        canvas.draw()
    pixels = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
    ink = (pixels != 255).any(-1)
    axes = [ax for ax in drawn.axes if ax.get_visible()]
    boxes = np.array([_box(ax, len(pixels)) for ax in axes]).reshape(-1, 4)
    bars = _colour_bars(axes)
    rows = []
    for top, bottom in _bands(ink, axes, boxes):
        inside = [i for i, (*_, y0, y1) in enumerate(boxes) if y0 < bottom and y1 > top]
        rows.append(_row(pixels[top:bottom], ink[top:bottom], axes, boxes, inside, bars))
    whole = _png(pixels)
    if len(rows) == 1 and len(rows[0]) == 1:
        rows = [(Piece(whole, pixels.shape[1]),)]
    return Pieces(whole, tuple(rows), smallest_text(drawn), bool(bars))


def smallest_text(drawn: Figure, dpi: float = DPI) -> float:
    """Size of the smallest text that is drawn, pixels of which `dpi` make an inch (96 in an SVG
    file); zero without any.
    """
    texts = [t for t in drawn.findobj(Text) if isinstance(t, Text) and t.get_visible()]
    sizes = (t.get_fontsize() for t in texts if t.get_text())
    return float(min(sizes, default=0.0)) * dpi / 72.0


def _box(ax: Axes, height: int) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of axes, pixels from the upper left corner of the figure."""
    box = ax.get_window_extent()
    return box.x0, box.x1, height - box.y1, height - box.y0


def _colour_bars(axes: Sequence[Axes]) -> set[int]:
    """Indices of the axes that are colour bars."""
    drawn = [one for ax in axes for one in (*ax.images, *ax.collections)]
    bars = [one.colorbar.ax for one in drawn if one.colorbar is not None]
    return {i for i, ax in enumerate(axes) if any(ax is bar for bar in bars)}


def _bands(ink: Bool[np.ndarray, "h w"], axes: Sequence[Axes], boxes: np.ndarray):
    """First and last row of pixels of every row of panels that can stand alone."""
    at = [0]
    for gap in _gaps(boxes[:, 2:]):
        above = np.isclose(boxes[:, 3], gap[0])
        labelled = all(_labels(ax, "x") for ax, last in zip(axes, above, strict=True) if last)
        if labelled and (middle := _blank(ink.any(1), gap)) is not None:
            at.append(middle)
    return zip(at, [*at[1:], len(ink)], strict=True)


def _row(
    pixels: UInt8[np.ndarray, "h w 3"],
    ink: Bool[np.ndarray, "h w"],
    axes: Sequence[Axes],
    boxes: np.ndarray,
    inside: Sequence[int],
    bars: set[int],
) -> tuple[Piece, ...]:
    """The pieces of one row of panels, whose axes are those `inside`."""
    at = [0]
    for gap in _gaps(boxes[list(inside), :2]):
        right = [i for i in inside if np.isclose(boxes[i, 0], gap[1])]
        if bars.intersection(right):
            continue
        if (middle := _blank(ink.any(0), gap)) is not None:
            at.append(middle)
    strip = _strip(pixels, boxes, inside)
    found = []
    for left, right in zip(at, [*at[1:], pixels.shape[1]], strict=True):
        mine = [i for i in inside if left < boxes[i, 0] < right and i not in bars]
        shares = left > 0 and any(not _labels(axes[i], "y") for i in mine)
        more = (_png(strip), strip.shape[1]) if shares else (b"", 0)
        found.append(Piece(_png(pixels[:, left:right]), right - left, *more))
    return tuple(found)


def _strip(pixels: np.ndarray, boxes: np.ndarray, inside: Sequence[int]) -> np.ndarray:
    """The part of a row left of its first axes, with the labels of their y axis."""
    first = min((boxes[i, 0] for i in inside), default=0.0)
    return pixels[:, : max(int(first) - _TICK, 1)]


def _labels(ax: Axes, which: str) -> bool:
    """Whether an axis has tick labels; axes in three dimensions always have."""
    if ax.name == "3d" or not ax.axison:
        return True
    side = {"x": "labelbottom", "y": "labelleft"}[which]
    axis = ax.xaxis if which == "x" else ax.yaxis
    return bool(axis.get_tick_params()[side])


def _gaps(intervals: np.ndarray) -> list[tuple[float, float]]:
    """What lies between intervals (n, 2) and is in none of them."""
    gaps, end = [], None
    for low, high in sorted(map(tuple, intervals)):
        if end is not None and low > end + 1.0:
            gaps.append((end, low))
        end = high if end is None else max(end, high)
    return gaps


def _blank(inked: np.ndarray | np.bool, gap: tuple[float, float]) -> int | None:
    """The middle of the longest run of lines (n,) without ink inside a gap; None without any."""
    low, high = int(np.ceil(gap[0])), int(np.floor(gap[1]))
    blank = ~np.asarray(inked)[low:high]
    steps = np.diff(np.concatenate([[0], blank.astype(int), [0]]))
    begins, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    if not len(begins):
        return None
    longest = int(np.argmax(ends - begins))
    return low + int(begins[longest] + ends[longest]) // 2


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=_LEVEL, dpi=(DPI, DPI))
    return buffer.getvalue()
