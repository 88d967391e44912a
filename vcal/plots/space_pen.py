"""Drawing of places in space on a parallel projection, with labels that keep apart."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from .style import width_of

EDGE_ON = 0.34
"""Sine of the angle between a circle and the line of sight below which it is seen as a line."""
_FONT = 9.0


class View(NamedTuple):
    """A parallel projection onto the page."""

    key: str
    title: str
    right: Float[np.ndarray, "3"]
    upward: Float[np.ndarray, "3"]
    labels: tuple[str, str] | None
    """Labels of the scales; None for a pictorial view without scales."""

    @property
    def toward(self) -> Float[np.ndarray, "3"]:
        """Direction to the viewer."""
        return np.cross(self.right, self.upward)

    def at(self, points: np.ndarray) -> np.ndarray:
        """Places on the page (..., 2), mm, of places in space (..., 3), m."""
        return 1e3 * np.asarray(points, float) @ np.array([self.right, self.upward]).T


def on_page(view: View, direction: np.ndarray) -> str:
    """A direction as an arrow on the page."""
    along = np.array([view.right @ direction, view.upward @ direction])
    if np.linalg.norm(along) < 0.3:
        return "⊙ (to the viewer)" if view.toward @ direction > 0.0 else "⊗ (away)"
    turn = int(np.round(np.arctan2(along[1], along[0]) / (np.pi / 4.0))) % 8
    return "→↗↑↖←↙↓↘"[turn]


class Pen:
    """Drawing of places in space on one view; labels are written last, apart from each other."""

    def __init__(self, ax: Axes, view: View, scale: float):
        self.ax, self.view, self.scale = ax, view, scale
        self.labels: list[tuple[np.ndarray, str, str, np.ndarray]] = []
        self.taken: list[np.ndarray] = []
        self.ends: list[np.ndarray] = []

    def line(
        self, points, color: str, width: float = 1.2, style: Any = "-", order=2.0, alpha=1.0
    ) -> None:
        """A polygonal line."""
        x, y = self.view.at(points).T
        self.ax.plot(x, y, color=color, lw=width, ls=style, zorder=order, alpha=alpha,
                     solid_capstyle="round", solid_joinstyle="round")  # fmt: skip

    def dots(self, points, mark: str, color: str, size: float, order=3.0, fill=True) -> None:
        """Marks at places."""
        x, y = self.view.at(np.atleast_2d(points)).T
        self.ax.plot(x, y, mark, color=color, ms=size, mfc=color if fill else "white", mew=1.0,
                     zorder=order, ls="none")  # fmt: skip

    def taken_by(self, points, step: int = 1) -> None:
        """Keep labels away from these places."""
        self.taken += [*self.view.at(np.atleast_2d(points))[::step] / self.scale]

    def label(self, place, text: str, color: str, way=(0.0, 0.0)) -> None:
        """Words near a place, if possible on the side `way` of it (page)."""
        self.labels.append((self.view.at(place), text, color, np.asarray(way, float)))

    def arrow(
        self, start, end, color: str, width=1.6, order=5.0, text: str = "", beside: float = 0.0
    ) -> None:
        """An arrow; towards the viewer a circle with a dot, away a circle with a cross. It is drawn
        `beside` (inches) its place.
        """
        a, b = self.view.at(start), self.view.at(end)
        length = 1e3 * float(np.linalg.norm(np.subtract(end, start)))
        way = (b - a) / max(length, 1e-12)
        aside = beside * self.scale * np.array([-way[1], way[0]])
        a, b = a + aside, b + aside
        if np.linalg.norm(way) < 0.25:
            away = self.view.toward @ np.subtract(end, start) < 0.0
            # Beside the place, which has a mark of its own; several ones side by side.
            b = a + np.array([-0.13, -0.13]) * self.scale
            while any(np.linalg.norm(b - other) < 0.1 * self.scale for other in self.ends):
                b = b + np.array([-0.17, 0.0]) * self.scale
            self.ends.append(b)
            self.ax.plot(*b, "o", ms=8, mfc="white", mec=color, mew=1.2, zorder=order)
            self.ax.plot(*b, "x" if away else ".", ms=4.5, color=color, mew=1.2, zorder=order + 0.1)
            self.taken.append(b / self.scale)
            way = np.array([-1.0, -1.0])
        else:
            self._head(a, b, color, width, order)
            self.taken += [*(a + (b - a) * np.linspace(0.1, 1.0, 5)[:, None]) / self.scale]
        if text:
            self.labels.append((b, text, color, way))

    def _head(self, start, end, color: str, width: float, order: float) -> None:
        """An arrow between two places on the page."""
        look = {"arrowstyle": "-|>,head_width=0.2,head_length=0.42", "shrinkA": 0, "shrinkB": 0}
        self.ax.annotate(
            "", (float(end[0]), float(end[1])), (float(start[0]), float(start[1])),
            arrowprops={**look, "color": color, "lw": width}, zorder=order, annotation_clip=False,
        )  # fmt: skip

    def turn(self, place, axis, radius: float, color: str, text: str) -> None:
        """The sense of a rotation about `axis` by the right-hand rule, as an arc with an arrow.

        The near side of the circle is drawn thick. An axis in the plane of the page is tilted
        towards the viewer to show it.
        """
        toward = self.view.toward
        depth = float(np.dot(axis, toward))
        flat = np.asarray(axis, float) - depth * toward
        if abs(depth) < EDGE_ON:
            depth = -EDGE_ON if depth < -1e-9 else EDGE_ON
            flat = flat / np.linalg.norm(flat) * np.sqrt(1.0 - depth**2)
        shown = flat + depth * toward
        # The point of the circle that is nearest to the viewer, and the direction of motion there.
        near = toward - (toward @ shown) * shown
        size = np.linalg.norm(near)
        near = near / size if size > 0.05 else -self.view.upward
        ahead = np.cross(shown, near)
        t = np.deg2rad(np.linspace(-150.0, 95.0, 60))[:, None]
        circle = place + radius * (np.cos(t) * near + np.sin(t) * ahead)
        hidden = int(len(t) * (60.0 / 245.0)) if abs(depth) < 0.9 else 0
        self.line(circle[: hidden + 1], color, 0.8, order=4.0)
        self.line(circle[hidden:-3], color, 1.6, order=4.5)
        self._head(self.view.at(circle[-4]), self.view.at(circle[-1]), color, 1.6, 5.0)
        self.taken_by(circle, 6)
        self.labels.append((self.view.at(circle[-1]), text, color, np.zeros(2)))

    def write(self) -> None:
        """Write the labels, each where it covers least."""
        (x0, x1), (y0, y1) = self.ax.get_xlim(), self.ax.get_ylim()
        low, high = np.array([x0, y0]) / self.scale, np.array([x1, y1]) / self.scale
        boxes: list[np.ndarray] = []
        taken = np.array(self.taken).reshape(-1, 2)
        angles = np.deg2rad(np.arange(0.0, 360.0, 30.0))
        offsets = [
            radius * np.array([np.cos(a), np.sin(a)]) for radius in (0.1, 0.2, 0.34) for a in angles
        ]
        for place, text, color, way in self.labels:
            half = 0.5 * np.array([width_of(text) * _FONT / 9.0 + 0.02, 0.14])
            best, least = None, np.inf
            for offset in offsets:
                unit = offset / np.linalg.norm(offset)
                # The box touches the circle of the offset with the side that faces the place.
                centre = place / self.scale + offset + unit * half
                box = np.array([centre - half, centre + half])
                cost = 2.0 * float(np.linalg.norm(offset)) - 0.25 * float(unit @ way)
                cost += 40.0 * float(np.maximum(low - box[0], 0.0).sum())
                cost += 40.0 * float(np.maximum(box[1] - high, 0.0).sum())
                inside = ((taken > box[0]) & (taken < box[1])).all(1)
                cost += 0.35 * float(inside.sum())
                for other in boxes:
                    overlap = np.minimum(box[1], other[1]) - np.maximum(box[0], other[0])
                    cost += 3.0 * bool((overlap > 0.0).all())
                if cost < least - 1e-9:
                    best, least = box, cost
            assert best is not None
            boxes.append(best)
            x, y = best.mean(0) * self.scale
            written = self.ax.text(x, y, text, ha="center", va="center", fontsize=_FONT,
                                   color=color, zorder=9.0)  # fmt: skip
            written.set_path_effects([withStroke(linewidth=2.2, foreground="white")])
