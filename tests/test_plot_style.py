"""What figures have in common: the shortcuts draw what matplotlib draws."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.textpath import TextPath

from vcal.plots import style
from vcal.plots.panels import Panel, mark, panels


def drawn(**settings) -> Figure:
    """Two panels, one with a logarithmic scale, so that there are minor ticks."""
    x = np.linspace(1.0, 30.0, 40)
    marks = [mark("plot", x, 1e-3 * x**2, "o-")]
    return panels(
        [Panel("linear", "x", "y", marks, settings=settings),
         Panel("logarithmic", "x", "y", marks, settings={"xscale": "log", "yscale": "log"})],
        width=8.0, height=3.0,
    )  # fmt: skip


def pixels(figure: Figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())  # pyright: ignore[reportAttributeAccessIssue]


def test_copied_ticks_are_those_of_matplotlib(monkeypatch):
    copied = pixels(drawn())
    monkeypatch.setattr(style, "_copied", lambda axis, usual, which, numticks=None: usual(numticks))
    np.testing.assert_array_equal(copied, pixels(drawn()))


def test_titles_at_a_fixed_height_are_where_matplotlib_puts_them(monkeypatch):
    fixed = pixels(drawn())
    monkeypatch.setattr(
        style,
        "_set_title",
        lambda ax, title, pad: ax.set_title(
            title, fontsize=10, color=style.INK, loc="left", pad=pad
        ),
    )
    np.testing.assert_array_equal(fixed, pixels(drawn()))


@pytest.mark.parametrize("limits", [(0.0, 3e-7), (5e4, 5e4 + 1e-3)])
def test_a_title_does_not_cover_the_power_of_ten(limits):
    figure = drawn(ylim=limits)
    style.png(figure)
    ax = figure.axes[0]
    renderer = figure.canvas.get_renderer()  # pyright: ignore[reportAttributeAccessIssue]
    power = ax.yaxis.get_offset_text()
    assert power.get_text()
    (title,) = (t for t in ax.get_children() if getattr(t, "get_text", str)() == "linear")
    boxes = [one.get_window_extent(renderer) for one in (power, title)]
    assert boxes[1].y0 >= boxes[0].y1 - 0.5


@pytest.mark.parametrize("text", ["−0.25", "screw_cyclic", "X, mm", "−log₁₀ p", "µm", "azimuth 0°"])
def test_widths_of_labels(text):
    """By the points of the outlines, as by the extents of the curves."""
    extents = TextPath((0.0, 0.0), text, size=9.0).get_extents()
    assert style.width_of(text) == pytest.approx(extents.width / 72.0, rel=1e-9)
