"""The declared machine in three views to scale, and as a pictorial view.

Every picture is drawn from `vcal.geometry.declared_machine.DeclaredMachine`, so that a wrong chain,
a rotary axis with the other sense or a station on the wrong side is seen.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ..geometry.declared_machine import DeclaredMachine, Seen, ShownAxis
from ..instruments.marks import Mark
from .space_pen import EDGE_ON, Pen, View, on_page
from .style import AFTER, BEFORE, DOTS, INK, NOMINAL, figure, plain, ticks_apart, titled

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
_FAR = 2.2
"""Distance from the middle, in sizes, from which a mark is drawn in its direction only."""
_MOST = 300
"""Largest number of points of a data set that are drawn."""
SHOWN = 0.004
"""Least distance of a measured point from the nominal one that is drawn, in sizes."""


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
                places = mark.places
                if not scene.near(mark):
                    places = scene.toward(places)[0][None]
                    more.append(places + 0.2 * (places - middle))
                more.append(places)
                if mark.frame is not None:
                    more.append(places + _ARROW * size * np.asarray(mark.frame).T)
            if one.measured is not None:
                away = np.linalg.norm(one.measured - middle, axis=1)
                more.append(one.measured[away < _FAR * size])
        return scene._replace(points=np.concatenate([core, *more]))

    def near(self, mark: Mark) -> bool:
        """Whether all places of a mark are near enough to be drawn to scale."""
        return bool((np.linalg.norm(mark.places - self.middle, axis=1) < _FAR * self.size).all())

    def toward(self, places: np.ndarray) -> tuple[np.ndarray, float]:
        """A place in the direction of far ones, as far from the middle as the machine is large, and
        their distance from the middle, m.
        """
        way = np.asarray(places, float).mean(0) - self.middle
        away = float(np.linalg.norm(way))
        return self.middle + self.size * way / away, away

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
        f"gravity {on_page(view, -scene.machine.up)}",
        (1.0, 1.0), (0.0, 6.0), "axes fraction", textcoords="offset points",
        ha="right", va="bottom", fontsize=9, color=INK,
    )  # fmt: skip
    pen = Pen(ax, view, scale)
    _machine(pen, scene)
    for one in scene.machine.seen:
        _seen(pen, scene, one)
    pen.write()
    return drawn


def _machine(pen: Pen, scene: _Scene) -> None:
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


def _rotary(pen: Pen, scene: _Scene, axis: ShownAxis) -> None:
    colour = TOOL if axis.moves == "tool" else WORKPIECE
    reach = 2.0 * scene.small if scene.machine.arm else 2.6 * _TURN * scene.size
    ends = axis.place + reach * np.outer([-1.0, 1.0], axis.direction)
    pen.line(ends, colour, 0.9, (0, (9, 3, 2, 3)), 3.0)
    pen.taken_by(np.linspace(ends[0], ends[1], 5))
    if scene.machine.arm:
        pen.dots(axis.place, "o", colour, 3.5, 4.0)
        radius, place = scene.small, axis.place
    else:  # at the end that is farther from the tool
        away = np.linalg.norm(ends - scene.machine.tool_point, axis=1)
        far = ends[int(away[1] > away[0] - 1e-9)] - axis.place
        radius, place = _TURN * scene.size, axis.place + 0.85 * far
    pen.turn(place, axis.direction, radius, colour, axis_label(axis))


def _box(pen: Pen, ends: Float[np.ndarray, "2 3"]) -> None:
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


def _seen(pen: Pen, scene: _Scene, one: Seen) -> None:
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


def _mark(pen: Pen, scene: _Scene, mark: Mark, one: Seen, said: set[str]) -> None:
    machine = scene.machine
    places = np.asarray(mark.places, float)
    if mark.on == "tool":
        places = machine.tool_point + places @ machine.tool_rotation.T
    fitted = mark is one.station
    name = f"{one.name}: {mark.name}" if one.name else mark.name
    if fitted:
        name += " by the readings"
    if not scene.near(mark._replace(places=places)):
        spot, away = scene.toward(places)
        name += f", {away:.1f} m away"
        outwards = (spot - scene.middle) / scene.size
        if np.linalg.norm(pen.view.at(outwards)) > 0.25e3:
            pen.arrow(spot, spot + 0.2 * scene.size * outwards, INSTRUMENT, 0.8, 4.0)
        places = spot[None]
        mark = mark._replace(places=places)
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


def _frame(pen: Pen, scene: _Scene, mark: Mark, fitted: bool) -> None:
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
    if mark.azimuth and abs(pen.view.toward @ turn[:, 2]) > EDGE_ON:
        t = np.deg2rad(np.linspace(0.0, 70.0, 20))[:, None]
        arc = place + 0.7 * size * (np.cos(t) * turn[:, 0] + np.sin(t) * turn[:, 1])
        pen.line(arc, INSTRUMENT, 1.0, order=4.4)
        pen.arrow(arc[-3], arc[-1], INSTRUMENT, 1.0)
