"""The declared machine as numbers for a picture: axes, senses, travels, tool and instruments.

Everything is in the frame of the workpiece (of an arm: of its base), in m and rad, and follows from
the chain by its nominal forward kinematics. An axis that carries the workpiece moves it against its
own command (ISO 841): with the positive command, the tool moves in the positive direction relative
to the workpiece.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..instruments.base import Instrument
from ..instruments.marks import Mark
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..numerics.spatial import best_rigid

_POSES = 3
"""Largest number of measured poses of an arm that are shown."""
_APART = 0.02
"""Distance of the station as declared from that by the readings, as a share of its distance from
the points, from which they are two places; and the angle of their frames, rad."""
_FOLLOWS = 0.01
"""Largest rms distance of measured points from the nominal ones of the right machine, as a share of
the rms distance of the points from their middle."""
_FLAT = 1e-3
"""Ratio of the second to the first singular value of points that lie on one line."""
_SAME_M = 1e-9


class NominalFrames(NamedTuple):
    """Nominal frames of all joints at one position of the axes."""

    rotation: Float[np.ndarray, "axes 3 3"]
    """Frame of every joint before its motion."""
    origin: Float[np.ndarray, "axes 3"]
    moved: Float[np.ndarray, "axes 3"]
    """Origin of every joint after its motion, before its link."""
    link: Float[np.ndarray, "axes 3"]
    """Translation of its link."""
    tool_rotation: Float[np.ndarray, "3 3"]
    """Frame of the tool."""
    tool_origin: Float[np.ndarray, "3"]
    """Origin of the last joint's frame, to which the tool offset refers."""


def nominal_frames(chain: Chain, q: Float[np.ndarray, " axes"]) -> NominalFrames:
    """Frames of the joints at the positions `q` (m or rad) in the frame of the workpiece."""
    count = len(chain.joints)
    rotation, origin = np.zeros((count, 3, 3)), np.zeros((count, 3))
    moved, link = np.zeros((count, 3)), np.zeros((count, 3))
    ends = []
    for side in (chain.workpiece_side, chain.tool_side):
        r, t = np.eye(3), np.zeros(3)
        for i in side:
            joint = chain.joints[i]
            before, after = np.asarray(joint.before), np.asarray(joint.after)
            t, r = t + r @ before[:3, 3], r @ before[:3, :3]
            rotation[i], origin[i] = r, t
            motion = float(q[i]) * joint.sign * np.asarray(joint.direction)
            if joint.turns:
                r = r @ _turned(motion)
            else:
                t = t + r @ motion
            moved[i], link[i] = t, r @ after[:3, 3]
            t, r = t + link[i], r @ after[:3, :3]
        ends.append((r, t))
    (rw, tw), (rt, tt) = ends
    return NominalFrames(
        rw.T @ rotation,
        (origin - tw) @ rw,
        (moved - tw) @ rw,
        link @ rw,
        rw.T @ rt,
        rw.T @ (tt - tw),
    )


def _turned(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation by the vector `v`, rad (Rodrigues)."""
    angle = float(np.linalg.norm(v))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = v / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


@dataclass(frozen=True)
class ShownAxis:
    """One axis at the zero pose."""

    name: str
    turns: bool
    moves: str
    """``"tool"`` or ``"workpiece"``: what it moves."""
    place: Float[np.ndarray, "3"]
    """A point on a rotary axis or joint, m; for a linear axis, the origin of its frame."""
    direction: Float[np.ndarray, "3"]
    """Direction in which the positive command moves what it moves, or about which the positive
    command turns it by the right-hand rule."""
    travel: Float[np.ndarray, "2"]
    """Declared travel, m or rad; infinite where not declared."""
    covered: Float[np.ndarray, "2"]
    """Lowest and highest position of the measurement, m or rad; nan without one."""

    @property
    def relative(self) -> Float[np.ndarray, "3"]:
        """The same of the tool as seen from the workpiece."""
        return self.direction if self.moves == "tool" else -self.direction


@dataclass(frozen=True)
class ArmPose:
    """The links of an arm in one pose."""

    name: str
    links: Float[np.ndarray, "k 3"]
    """Corners of the links from the base to the frame of the flange, m."""
    joints: Float[np.ndarray, "axes 3"]
    """A point on every joint's axis, m."""
    tool: Float[np.ndarray, "3"]
    """Tool point, m."""


@dataclass(frozen=True)
class Seen:
    """What one data set adds to the picture."""

    name: str
    """Name of the data set; empty for a single one."""
    instrument: str
    """The instrument in words."""
    nominal: Float[np.ndarray, "n 3"]
    """Nominal places of the measured points at the positions of the plan, m."""
    measured: Float[np.ndarray, "n 3"] | None
    """The measured points after their best rigid fit to the nominal places; None where the readings
    are no points, or where the points lie on one line."""
    rows: Int[np.ndarray, " n"]
    """Row of the plan of every point."""
    marks: tuple[Mark, ...]
    """Marks in the frame of the workpiece or of the tool, as declared; free ones with their
    starting values."""
    station: Mark | None = None
    """The frame of the instrument according to `measured`, where it was not declared or is
    elsewhere than declared."""

    @property
    def rms(self) -> float | None:
        """Root of the mean squared distance of the measured points from the nominal ones, m."""
        if self.measured is None:
            return None
        return float(np.sqrt(((self.measured - self.nominal) ** 2).sum(1).mean()))

    @property
    def follows(self) -> bool:
        """Whether the measured points follow the declared machine, but for its errors: their rms
        distance is below 1 % of that from their middle.
        """
        if self.measured is None or self.rms is None:
            return True
        arms = self.nominal - self.nominal.mean(0)
        return bool(self.rms < _FOLLOWS * np.sqrt((arms**2).sum(1).mean()))

    @property
    def moved(self) -> float | None:
        """Distance of the station according to the readings from the declared one, m."""
        declared = [mark for mark in self.marks if mark.frame is not None and not mark.free]
        if self.station is None or not declared:
            return None
        return float(np.linalg.norm(self.station.places[0] - declared[0].places[0]))


@dataclass(frozen=True)
class DeclaredMachine:
    """The declared machine at the zero pose, with the data sets."""

    text: str
    """The declaration of the chain."""
    arm: bool
    workpiece_side: tuple[str, ...]
    """Axes from the workpiece to the bed."""
    tool_side: tuple[str, ...]
    """Axes from the bed (of an arm: from its base) to the tool."""
    axes: tuple[ShownAxis, ...]
    """In the order from the workpiece to the tool."""
    tool_origin: Float[np.ndarray, "3"]
    """Origin of the frame to which the tool offset refers, at the zero pose, m."""
    tool_point: Float[np.ndarray, "3"]
    """Tool point at the zero pose, m."""
    tool_rotation: Float[np.ndarray, "3 3"]
    """Frame of the tool at the zero pose."""
    up: Float[np.ndarray, "3"]
    """Direction against gravity at the zero pose."""
    travel: Float[np.ndarray, "2 3"] | None
    """Lowest and highest coordinates of the tool point over the travel of the linear axes, with
    rotary axes at zero, m; None for an arm, or without any declared travel."""
    poses: tuple[ArmPose, ...]
    """Of an arm: the zero pose, then some measured ones; empty for a machine tool."""
    seen: tuple[Seen, ...]
    coupled: bool = False
    """Whether the commands of the joints are not their positions."""

    @property
    def places(self) -> Float[np.ndarray, "n 3"]:
        """Places of the machine and of the nominal points, m: what a picture must hold."""
        found = [np.zeros((1, 3)), self.tool_origin[None], self.tool_point[None]]
        if self.travel is not None:
            found.append(np.array([*product(*self.travel.T)]))
        found += [axis.place[None] for axis in self.axes if axis.turns]
        found += [points for pose in self.poses for points in (pose.links, pose.tool[None])]
        return np.concatenate([*found, *(one.nominal for one in self.seen)])


class Measured(NamedTuple):
    """One data set as `declared_machine` takes it."""

    name: str
    words: str
    """The instrument in words."""
    chain: Chain
    """The machine with the tool of this data set."""
    declared: Instrument | None
    """The instrument as declared; None where it could not be built."""
    started: Instrument | None
    """The instrument with its starting values."""
    plan: Plan
    readings: Float[np.ndarray, "n m"] | None
    """Readings (n, m), SI, not reduced; None for a plan."""


def declared_machine(chain: Chain, sets: Sequence[Measured]) -> DeclaredMachine:
    """The machine of `chain` at its zero pose, with the data sets measured on it."""
    zero = nominal_frames(chain, np.zeros(len(chain.joints)))
    none = np.zeros((0, len(chain.joints)))
    position = np.concatenate([none, *(np.asarray(one.plan.position, float) for one in sets)])
    order = (*reversed(chain.workpiece_side), *chain.tool_side)
    # The workpiece and the bed coincide at the zero pose of a machine tool.
    up = np.asarray(chain.up, float)
    poses: tuple[ArmPose, ...] = ()
    glyphs = zero.origin
    if chain.arm:
        rows = [(one, i) for one in sets for i in range(one.plan.rows)]
        poses = _poses(chain, position, lambda row: _row_name(*rows[row]))
        glyphs = poses[0].joints
    axes = tuple(
        ShownAxis(
            name=joint.name,
            turns=joint.turns,
            moves=joint.side,
            place=glyphs[i],
            direction=joint.sign * zero.rotation[i] @ np.asarray(joint.direction),
            travel=np.asarray(joint.travel, float),
            covered=np.array([position[:, i].min(), position[:, i].max()])
            if len(position)
            else np.full(2, np.nan),
        )
        for i, joint in ((i, chain.joints[i]) for i in order)
    )
    names = lambda side: tuple(chain.joints[i].name for i in side)  # noqa: E731
    return DeclaredMachine(
        text=chain.text,
        arm=chain.arm,
        workpiece_side=names(reversed(chain.workpiece_side)),
        tool_side=names(chain.tool_side),
        axes=axes,
        tool_origin=zero.tool_origin,
        tool_point=zero.tool_origin + zero.tool_rotation @ np.asarray(chain.tool_offset),
        tool_rotation=zero.tool_rotation,
        up=up,
        travel=None if chain.arm else _travel(chain),
        poses=poses,
        seen=tuple(_seen(one) for one in sets),
        coupled=chain.coupling is not None,
    )


def _travel(chain: Chain) -> Float[np.ndarray, "2 3"] | None:
    """Corners of the box of all tool points over the declared travel, rotary axes at zero."""
    ends = [
        (0.0,) if joint.turns or not np.isfinite(joint.travel).all() else tuple(joint.travel)
        for joint in chain.joints
    ]
    if all(len(pair) == 1 for pair in ends):
        return None
    points = chain.tool_point(np.array([*product(*ends)], float))
    return np.array([points.min(0), points.max(0)])


def _row_name(one: Measured, row: int) -> str:
    return f"row {one.plan.row_name(row)}" + (f" of {one.name}" if one.name else "")


def _poses(
    chain: Chain, position: Float[np.ndarray, "n axes"], name: Callable[[int], str]
) -> tuple[ArmPose, ...]:
    """The zero pose and the measured poses whose tool points are farthest from each other."""
    found = [_pose(chain, np.zeros(len(chain.joints)), "zero pose")]
    points = chain.tool_point(position)
    if not len(points):
        return tuple(found)
    far = np.linalg.norm(points - found[0].tool, axis=1)
    for _ in range(_POSES):
        row = int(np.argmax(far))
        if far[row] < _SAME_M:
            break
        found.append(_pose(chain, position[row], name(row)))
        far = np.minimum(far, np.linalg.norm(points - points[row], axis=1))
    return tuple(found)


def _pose(chain: Chain, q: Float[np.ndarray, " axes"], name: str) -> ArmPose:
    frames = nominal_frames(chain, q)
    corners, glyphs = [np.zeros(3)], np.zeros((len(chain.joints), 3))
    for i, joint in enumerate(chain.joints):
        along = frames.rotation[i] @ np.asarray(joint.direction)
        # The link of a DH row: d along the axis of the joint, then a across it.
        elbow = frames.moved[i] + along * (along @ frames.link[i])
        corners += [frames.origin[i], frames.moved[i], elbow, frames.moved[i] + frames.link[i]]
        glyphs[i] = 0.5 * (frames.moved[i] + elbow)
    corners.append(frames.tool_origin)
    kept = [corners[0]]
    for corner in corners[1:]:
        if np.linalg.norm(corner - kept[-1]) > _SAME_M:
            kept.append(corner)
    tool = frames.tool_origin + frames.tool_rotation @ np.asarray(chain.tool_offset)
    return ArmPose(name, np.array(kept), glyphs, tool)


def _seen(one: Measured) -> Seen:
    """The points of a data set, and the frame of its instrument according to them."""
    position = np.asarray(one.plan.position, float)
    rotation, tool = one.chain.tool_frame(position)
    if one.started is None:
        return Seen(one.name, one.words, tool, None, np.arange(len(tool)), ())
    places = [np.asarray(place, float) for place in one.started.tool_places.values()]
    offsets = np.array(places or [np.zeros(3)])
    nominal = tool[:, None] + np.einsum("nij,kj->nki", rotation, offsets)
    points = None if one.readings is None else one.started.seen_points(one.readings)
    rows = np.repeat(np.arange(len(tool)), len(offsets))
    marks = _marks(one)
    flat = nominal.reshape(-1, 3)
    if points is None or np.shape(points) != nominal.shape:
        return Seen(one.name, one.words, flat, None, rows, marks)
    seen = np.asarray(points, float).reshape(-1, 3)
    good = np.isfinite(seen).all(1)
    flat, seen, rows = flat[good], seen[good], rows[good]
    if not (_spread(seen) and _spread(flat)):
        return Seen(one.name, one.words, flat, None, rows, marks)
    turn, origin = best_rigid(seen, flat)
    frames = [m for m in one.started.marks(one.chain, one.plan) if m.frame is not None]
    given = next((mark for mark in marks if mark.frame is not None), None)
    station = Mark("instrument", origin[None], frame=turn, free=True)
    if frames:
        station = station._replace(name=frames[0].name, azimuth=frames[0].azimuth)
    fitted = seen @ turn.T + origin
    found = Seen(one.name, one.words, flat, fitted, rows, marks, station)
    if given is not None and _same(given, station, flat) or not found.follows:
        return replace(found, station=None)
    return found


def _marks(one: Measured) -> tuple[Mark, ...]:
    """Declared marks as declared; free ones with their starting values, if there are any."""
    if one.declared is None or one.started is None:
        return ()
    declared = [m for m in one.declared.marks(one.chain, one.plan) if not m.free]
    if one.readings is None:
        return tuple(declared)
    started = [m for m in one.started.marks(one.chain, one.plan) if m.free]
    return (*declared, *(m for m in started if m.frame is None))


def _same(declared: Mark, found: Mark, points: np.ndarray) -> bool:
    """Whether the frame according to the points is where it was declared."""
    away = float(np.linalg.norm(declared.places[0] - found.places[0]))
    cosine = 0.5 * (np.trace(np.asarray(declared.frame).T @ np.asarray(found.frame)) - 1.0)
    far = float(np.linalg.norm(points.mean(0) - found.places[0]))
    return bool(away <= _APART * far and cosine >= np.cos(_APART))


def _spread(points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether points do not lie on one line, so that they determine a rotation."""
    if len(points) < 3:
        return False
    size = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(size[1] > _FLAT * size[0])
