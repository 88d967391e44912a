"""The declared machine in three views to scale, and as a pictorial view.

Every picture is drawn from `vcal.geometry.declared_machine.DeclaredMachine`, so that a wrong chain,
a rotary axis with the other sense or a station on the wrong side is seen.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from ..geometry.declared_machine import DeclaredMachine, Seen, ShownAxis
from ..instruments.marks import Mark
from .style import AFTER, BEFORE, DOTS, INK, NOMINAL, figure, plain, ticks_apart, titled, width_of

TOOL, WORKPIECE, INSTRUMENT, MEASURED = AFTER, BEFORE, "#00664b", "#aa3377"
"""Colours of axes that move the tool, of axes that move the workpiece, of the instrument, and of
measured points."""
_POSES = ("#5b7083", "#8a9a5b", "#b08d57")
"""Colours of the measured poses of an arm."""
_WIDTH, _BOX, _TALLEST, _FLATTEST = 4.7, 3.72, 4.2, 1.5
"""Width of a picture, width of its axes, and the largest and least height of these, inches."""
_ROOM = 0.38
"""Width around the places for symbols and labels, inches."""
_SMALL = 1.5
"""Ratio of the common scale to that of a view from which the view has its own."""
_LEFT, _TOP, _BOTTOM = 0.74, 0.3, 0.5
_ARROW, _TURN = 0.15, 0.055
"""Length of the arrow of a linear axis and radius of that of a rotary axis, shares of the size."""
_FAR = 1.5
"""Distance from the middle, in sizes, from which a mark is only pointed at."""
_MOST = 300
"""Largest number of points of a data set that are drawn."""
SHOWN = 0.004
"""Least distance of a measured point from the nominal one that is drawn, in sizes."""
_TILT = 0.34
"""Least sine at which the circle of a rotation is drawn: seen from the side it would be a line."""
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


_X, _Y, _Z = np.eye(3)
_ORTHOGONAL = (
    View("xz", "XZ, seen from −Y", _X, _Z, ("X, mm", "Z, mm")),
    View("yz", "YZ, seen from +X", _Y, _Z, ("Y, mm", "Z, mm")),
    View("xy", "XY, seen from +Z", _X, _Y, ("X, mm", "Y, mm")),
)


def machine_views(machine: DeclaredMachine) -> Mapping[str, Figure]:
    """Pictures of the declared machine by name: ``"xz"``, ``"yz"`` and ``"xy"`` to scale, and
    ``"space"``, a pictorial view with the direction against gravity upwards, of an arm at its zero
    pose alone.
    """
    scene = _Scene.of(machine)
    own = {view.key: scene.scale(view) for view in _ORTHOGONAL}
    common = max(own.values())
    # One scale for all views, except where it would make a view small.
    found = {
        view.key: _drawn(scene, view, common if common < _SMALL * own[view.key] else own[view.key])
        for view in _ORTHOGONAL
    }
    space = _pictorial(machine.up)
    if machine.arm:  # alone, so that the senses of all joints are seen
        scene = _Scene.of(dataclasses.replace(machine, poses=machine.poses[:1], seen=()))
        space = space._replace(title=f"{space.title}, zero pose")
    return found | {space.key: _drawn(scene, space, scene.scale(space))}


def _pictorial(up: Float[np.ndarray, "3"]) -> View:
    """A view from above and from the side; for +Z upwards X runs to the right."""
    first = _X if abs(up @ _X) < 0.9 else _Y
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    azimuth, elevation = np.deg2rad(-62.0), np.deg2rad(24.0)
    level = np.cos(azimuth) * first + np.sin(azimuth) * second
    toward = np.cos(elevation) * level + np.sin(elevation) * up
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    return View("space", "Pictorial view", right, np.cross(toward, right), None)


class _Scene(NamedTuple):
    """The machine with the sizes of what is drawn."""

    machine: DeclaredMachine
    size: float
    """Size of the machine and of the points, m."""
    middle: Float[np.ndarray, "3"]
    points: Float[np.ndarray, "n 3"]
    """Places that the pictures must hold, m."""

    @classmethod
    def of(cls, machine: DeclaredMachine) -> "_Scene":
        core = machine.places
        low, high = core.min(0), core.max(0)
        size, middle = float(np.linalg.norm(high - low)) or 1.0, 0.5 * (low + high)
        scene = cls(machine, size, middle, core)
        more = [points for base, tip in scene.arrows.values() for points in (base[None], tip[None])]
        for axis in machine.axes:
            if axis.turns:
                more.append(axis.place + 1.3 * _TURN * size * np.vstack([np.eye(3), -np.eye(3)]))
        for one in machine.seen:
            for mark in _of_instrument(one):
                if scene.near(mark):
                    more.append(mark.places)
                    if mark.frame is not None:
                        more.append(mark.places + _ARROW * size * np.asarray(mark.frame).T)
            if one.measured is not None:
                away = np.linalg.norm(one.measured - middle, axis=1)
                more.append(one.measured[away < _FAR * size])
        return scene._replace(points=np.concatenate([core, *more]))

    def near(self, mark: Mark) -> bool:
        """Whether all places of a mark are near enough to be drawn to scale."""
        return bool((np.linalg.norm(mark.places - self.middle, axis=1) < _FAR * self.size).all())

    def on(self, view: View) -> Float[np.ndarray, "2 2"]:
        """Least and largest coordinates of the places on the page, mm."""
        flat = view.at(self.points)
        return np.array([flat.min(0), flat.max(0)])

    def scale(self, view: View) -> float:
        """Scale at which the places fill the page, mm per inch."""
        room = np.array([_BOX, _TALLEST]) - 2.0 * _ROOM
        return float(max(np.ptp(self.on(view), axis=0) / room)) or 1.0

    @property
    def small(self) -> float:
        """Radius of the rotations of an arm, m, for the size of its zero pose."""
        links = self.machine.poses[0].links
        own = 0.07 * float(np.linalg.norm(np.ptp(links, axis=0)))
        return float(np.clip(own, 0.025 * self.size, 0.045 * self.size))

    @property
    def arrows(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Start and tip of the arrow of every linear axis; parallel ones follow each other."""
        machine, found = self.machine, {}
        ends: list[tuple[str, np.ndarray, np.ndarray]] = []
        for axis in machine.axes:
            if axis.turns:
                continue
            start = np.zeros(3)
            if machine.arm:
                start = axis.place
            elif axis.moves == "tool":
                start = machine.tool_point
                back = machine.tool_origin - start
                if back @ axis.direction > 0.9 * np.linalg.norm(back) > 0.0:
                    start = machine.tool_origin  # not along the tool
            for moves, direction, tip in ends:
                if moves == axis.moves and direction @ axis.direction > 0.99 and not machine.arm:
                    start = tip
            tip = start + _ARROW * self.size * axis.direction
            ends.append((axis.moves, axis.direction, tip))
            found[axis.name] = start, tip
        return found


def _of_instrument(one: Seen) -> Iterator[Mark]:
    yield from (mark for mark in one.marks if mark.on == "workpiece")
    if one.station is not None:
        yield one.station


def _drawn(scene: _Scene, view: View, scale: float) -> Figure:
    """One picture at `scale`, mm of the machine per inch of the page."""
    low, high = scene.on(view)
    height = float(np.clip((high - low)[1] / scale + 2.0 * _ROOM, _FLATTEST, _TALLEST))
    bottom = _BOTTOM if view.labels else 0.12
    drawn = figure(_WIDTH, _TOP + height + bottom)
    whole = _TOP + height + bottom
    place = (_LEFT / _WIDTH, bottom / whole, _BOX / _WIDTH, height / whole)
    if view.labels is None:
        place = (0.1 / _WIDTH, bottom / whole, (_WIDTH - 0.2) / _WIDTH, height / whole)
    ax = drawn.add_axes(place)
    half = 0.5 * scale * np.array([place[2] * _WIDTH, height])
    middle = 0.5 * (low + high)
    ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
    ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
    if view.labels:
        plain(ax)
        titled(ax, view.title, *view.labels)
        ticks_apart(ax, 6)
        ax.locator_params(axis="y", nbins=max(2, int(2 * height)))
        ax.yaxis.labelpad = 1.0
    else:
        ax.axis("off")
        titled(ax, view.title)
    ax.annotate(
        f"gravity {_way(view, -scene.machine.up)}",
        (1.0, 1.0), (0.0, 6.0), "axes fraction", textcoords="offset points",
        ha="right", va="bottom", fontsize=9, color=INK,
    )  # fmt: skip
    pen = _Pen(ax, view, scale)
    _machine(pen, scene)
    for one in scene.machine.seen:
        _seen(pen, scene, one)
    pen.write()
    return drawn


def _way(view: View, direction: np.ndarray) -> str:
    """A direction as an arrow on the page."""
    along = np.array([view.right @ direction, view.upward @ direction])
    if np.linalg.norm(along) < 0.3:
        return "⊙ (to the viewer)" if view.toward @ direction > 0.0 else "⊗ (away)"
    turn = int(np.round(np.arctan2(along[1], along[0]) / (np.pi / 4.0))) % 8
    return "→↗↑↖←↙↓↘"[turn]


class _Pen:
    """Drawing of places in space on one view; labels are written last, apart from each other."""

    def __init__(self, ax: Axes, view: View, scale: float):
        self.ax, self.view, self.scale = ax, view, scale
        self.labels: list[tuple[np.ndarray, str, str, np.ndarray]] = []
        self.taken: list[np.ndarray] = []
        self.ends: list[np.ndarray] = []

    def line(self, points, color: str, width: float = 1.2, style="-", order=2.0, alpha=1.0) -> None:
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
            look = {"arrowstyle": "-|>,head_width=0.2,head_length=0.45", "shrinkA": 0, "shrinkB": 0}
            self.ax.annotate("", b, a, arrowprops={**look, "color": color, "lw": width},
                             zorder=order, annotation_clip=False)  # fmt: skip
            self.taken += [*(a + (b - a) * np.linspace(0.1, 1.0, 5)[:, None]) / self.scale]
        if text:
            self.labels.append((b, text, color, way))

    def turn(self, place, axis, radius: float, color: str, text: str) -> None:
        """The sense of a rotation about `axis` by the right-hand rule, as an arc with an arrow.

        The near side of the circle is drawn thick. An axis in the plane of the page is tilted
        towards the viewer to show it.
        """
        toward = self.view.toward
        depth = float(np.dot(axis, toward))
        flat = np.asarray(axis, float) - depth * toward
        if abs(depth) < _TILT:
            depth = -_TILT if depth < -1e-9 else _TILT
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
        a, b = self.view.at(circle[-4]), self.view.at(circle[-1])
        look = {"arrowstyle": "-|>,head_width=0.2,head_length=0.4", "shrinkA": 0, "shrinkB": 0}
        self.ax.annotate("", b, a, arrowprops={**look, "color": color, "lw": 1.6}, zorder=5.0,
                         annotation_clip=False)  # fmt: skip
        self.taken_by(circle, 6)
        self.labels.append((self.view.at(circle[-1]), text, color, np.zeros(2)))

    def edge(self, place, color: str, text: str) -> None:
        """An arrow at the edge of the picture towards a place outside."""
        (x0, x1), (y0, y1) = self.ax.get_xlim(), self.ax.get_ylim()
        middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        half = 0.94 * np.array([0.5 * (x1 - x0), 0.5 * (y1 - y0)])
        way = self.view.at(place) - middle
        tip = middle + way / max(np.max(np.abs(way) / half), 1.0)
        unit = way / max(float(np.linalg.norm(way)), 1e-12)
        tail = tip - unit * 0.35 * self.scale
        self.ax.annotate("", tip, tail, arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.8},
                         zorder=6.0, annotation_clip=False)  # fmt: skip
        self.labels.append((tail, text, color, -unit))
        self.taken += [*(np.linspace(tail, tip, 4) / self.scale)]

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


def _machine(pen: _Pen, scene: _Scene) -> None:
    """The machine at its zero pose."""
    machine, size = scene.machine, scene.size
    if machine.travel is not None:
        _box(pen, machine.travel)
    for pose, colour in zip(machine.poses[1:], _POSES, strict=False):
        pen.line(pose.links, colour, 1.6, order=2.4, alpha=0.75)
        pen.line([pose.links[-1], pose.tool], colour, 1.0, order=2.4, alpha=0.75)
        pen.dots(pose.tool, "v", colour, 5.0, 2.6)
        pen.taken_by(pose.tool)
        pen.label(pose.tool, pose.name, colour)
    if machine.poses:
        pen.line(machine.poses[0].links, INK, 3.2, order=2.8)
        pen.taken_by(machine.poses[0].links)
    pen.line([machine.tool_origin, machine.tool_point], INK, 2.4, order=4.0)
    pen.dots(machine.tool_point, "v", INK, 6.5, 5.5)
    pen.dots(np.zeros(3), "+", INK, 11.0, 5.4)
    pen.dots(np.zeros(3), "o", INK, 6.0, 5.3, fill=False)
    pen.taken_by([np.zeros(3), machine.tool_point])
    if pen.view.labels is None:
        for axis, name in zip(np.eye(3), "XYZ", strict=True):
            end = 0.5 * _ARROW * size * axis
            pen.arrow(np.zeros(3), end, NOMINAL, 0.8, 3.0, name.lower())
    pen.label(np.zeros(3), "base" if machine.arm else "zero", INK)
    pen.label(machine.tool_point, "tool", INK)
    for axis in machine.axes:
        if axis.turns:
            _rotary(pen, scene, axis)
        else:
            colour = TOOL if axis.moves == "tool" else WORKPIECE
            beside = 0.14 if machine.arm else 0.0  # not on the link
            pen.arrow(*scene.arrows[axis.name], colour, text=axis_label(axis), beside=beside)


def axis_label(axis: ShownAxis) -> str:
    """``"+X"``, or ``"+X′"`` for an axis that moves the workpiece (ISO 841)."""
    return f"+{axis.name}" + ("′" if axis.moves == "workpiece" else "")


def _rotary(pen: _Pen, scene: _Scene, axis: ShownAxis) -> None:
    colour = TOOL if axis.moves == "tool" else WORKPIECE
    reach = 2.0 * scene.small if scene.machine.arm else 2.6 * _TURN * scene.size
    ends = axis.place + reach * np.outer([-1.0, 1.0], axis.direction)
    pen.line(ends, colour, 0.9, (0, (9, 3, 2, 3)), 3.0)
    pen.taken_by(np.linspace(*ends, 5))
    if scene.machine.arm:
        pen.dots(axis.place, "o", colour, 3.5, 4.0)
        radius, place = scene.small, axis.place
    else:  # at the end that is farther from the tool
        away = np.linalg.norm(ends - scene.machine.tool_point, axis=1)
        far = ends[int(away[1] > away[0] - 1e-9)] - axis.place
        radius, place = _TURN * scene.size, axis.place + 0.85 * far
    pen.turn(place, axis.direction, radius, colour, axis_label(axis))


def _box(pen: _Pen, ends: Float[np.ndarray, "2 3"]) -> None:
    """The edges of the travel."""
    low, high = ends
    for along in range(3):
        first, second = (i for i in range(3) if i != along)
        for sides in np.ndindex(2, 2):
            edge = np.array([low, low])
            edge[1, along] = high[along]
            for i, side in zip((first, second), sides, strict=True):
                edge[:, i] = ends[side, i]
            pen.line(edge, DOTS, 0.8, order=1.0)
    pen.label(high, "travel", NOMINAL)


def _seen(pen: _Pen, scene: _Scene, one: Seen) -> None:
    """Points and marks of a data set."""
    step = max(1, -(-len(one.nominal) // _MOST))
    shown = slice(None, None, step)
    nominal = one.nominal[shown]
    pen.dots(nominal, "o", NOMINAL, 2.4, 1.6)
    pen.taken_by(nominal, 3)
    if one.measured is not None:
        measured = one.measured[shown]
        near = np.linalg.norm(measured - scene.middle, axis=1) < _FAR * scene.size
        measured, nominal = measured[near], nominal[near]
        apart = np.linalg.norm(measured - nominal, axis=1) > SHOWN * scene.size
        for a, b in zip(nominal[apart], measured[apart], strict=True):
            pen.line([a, b], MEASURED, 0.6, order=1.4, alpha=0.6)
        pen.dots(measured[apart], "x", MEASURED, 4.0, 1.8)
    said: set[str] = set()
    for mark in one.marks:
        _mark(pen, scene, mark, one, said)
    if one.station is not None:
        _mark(pen, scene, one.station, one, said)


def _mark(pen: _Pen, scene: _Scene, mark: Mark, one: Seen, said: set[str]) -> None:
    machine = scene.machine
    places = np.asarray(mark.places, float)
    if mark.on == "tool":
        places = machine.tool_point + places @ machine.tool_rotation.T
    fitted = mark is one.station
    name = f"{one.name}: {mark.name}" if one.name else mark.name
    if fitted:
        name += " by the readings"
    if not scene.near(mark._replace(places=places)):
        away = float(np.linalg.norm(places - scene.middle, axis=1).max())
        if name not in said:
            pen.edge(places.mean(0), INSTRUMENT, f"{name}, {away:.1f} m away")
        said.add(name)
        return
    if mark.joined and len(places) > 1:
        pen.line(places, INSTRUMENT, 1.1, order=2.2)
    if mark.frame is not None:
        _frame(pen, scene, mark, fitted)
    else:
        pen.dots(places, "D" if mark.on == "tool" else "o", INSTRUMENT, 4.2, 3.2, fill=False)
    pen.taken_by(places)
    if name not in said:
        pen.label(places[0], name, INSTRUMENT)
    said.add(name)


def _frame(pen: _Pen, scene: _Scene, mark: Mark, fitted: bool) -> None:
    """A station with the zero and the sense of its azimuth, or a frame with its axes."""
    place, turn = np.asarray(mark.places[0], float), np.asarray(mark.frame, float)
    size = _ARROW * scene.size
    pen.dots(place, "s", INSTRUMENT, 7.5, 5.0, fill=not fitted)
    names = ("azimuth 0", "", "z") if mark.azimuth else ("x", "y", "z")
    for direction, name in zip(turn.T, names, strict=True):
        if name:
            long = size if name != "z" or not mark.azimuth else 0.6 * size
            width = 1.6 if direction is turn.T[0] or not mark.azimuth else 0.9
            pen.arrow(place, place + long * direction, INSTRUMENT, width, 4.6, name)
    if mark.azimuth and abs(pen.view.toward @ turn[:, 2]) > _TILT:
        t = np.deg2rad(np.linspace(0.0, 70.0, 20))[:, None]
        arc = place + 0.7 * size * (np.cos(t) * turn[:, 0] + np.sin(t) * turn[:, 1])
        pen.line(arc, INSTRUMENT, 1.0, order=4.4)
        pen.arrow(arc[-3], arc[-1], INSTRUMENT, 1.0)
