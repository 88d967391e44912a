"""The chain of an arm from a URDF file (Unified Robot Description Format)."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from ..machine.chain import Chain, Joint, Up, chain_of_joints
from ..registry import nearest
from .messages import listed, refusal

_LARGEST = 10_000_000
"""Largest file, bytes."""
_DEEPEST = 50
"""Deepest nesting of elements."""
_MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


@dataclass
class _Element:
    tag: str
    attributes: dict[str, str]
    line: int
    below: list["_Element"] = field(default_factory=list)

    def first(self, tag: str) -> "_Element | None":
        return next((one for one in self.below if one.tag == tag), None)


@dataclass(frozen=True)
class _UrdfJoint:
    """One joint of the file."""

    name: str
    kind: str
    parent: str
    child: str
    origin: np.ndarray
    """Frame of the joint in that of its parent link (4, 4)."""
    axis: np.ndarray
    """Unit vector in the frame of the joint."""
    low: float
    high: float
    mimics: str


class _Reader:
    """The elements of an XML file; a document type, and with it every entity, is refused."""

    def __init__(self, name: str):
        self.name = name
        self.root: _Element | None = None
        self.open: list[_Element] = []
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._refused

    def read(self, data: bytes) -> _Element:
        try:
            self.parser.Parse(data, True)
        except expat.ExpatError as error:
            raise refusal(
                self.name,
                f"line {error.lineno}",
                f"what is not XML ({expat.ErrorString(error.code)})",
                "a URDF file",
                "correct the file, or convert it from xacro first",
            ) from error
        if self.root is None or self.root.tag != "robot":
            raise refusal(self.name, "line 1", "no <robot>", "a URDF file", "name another file")
        return self.root

    def _refused(self, *_: Any) -> None:
        raise refusal(
            self.name,
            f"line {self.parser.CurrentLineNumber}",
            "a document type declaration, which may define entities",
            "elements only",
            "remove the <!DOCTYPE>",
        )

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        one = _Element(tag, attributes, self.parser.CurrentLineNumber)
        if self.open:
            self.open[-1].below.append(one)
        elif self.root is None:
            self.root = one
        if len(self.open) >= _DEEPEST:
            raise refusal(
                self.name,
                f"line {one.line}",
                f"elements nested {len(self.open) + 1} deep",
                f"at most {_DEEPEST}",
                "correct the file",
            )
        self.open.append(one)

    def _end(self, tag: str) -> None:
        del tag
        self.open.pop()


def chain_from_urdf(
    path: Path,
    name: str,
    file: str,
    *,
    base_link: str | None = None,
    tip_link: str | None = None,
    tool_offset_m: Any = (0.0, 0.0, 0.0),
    up: Up = "+Z",
    coupling: Any = None,
) -> Chain:
    """The joints between two links of a URDF file, base to tip, as J1, J2, ...

    Every joint has the frame of the file, turned so that its z is the axis of the joint; the error
    twist acts in that frame, after the motion. Fixed joints belong to the link in front of them.
    `name` is the name of the file in messages, `file` that of the study file. The base is by
    default the link that is nobody's child, the tip the only link without a joint on it; a tool
    point at `tool_offset_m` is in the frame of the tip.

    Raises `StudyError` for a file that is no URDF, for links that do not exist or do not follow
    each other, and for joints that move in other ways; `ValueError` as `chain_of_joints` does.
    """
    if path.stat().st_size > _LARGEST:
        raise refusal(
            name, "file", "more than 10 MB", "a URDF file without meshes", "name another file"
        )
    root = _Reader(name).read(path.read_bytes())
    joints = [_joint(one, name) for one in root.below if one.tag == "joint"]
    links = [one.attributes.get("name", "") for one in root.below if one.tag == "link"]
    parents = {joint.child: joint for joint in joints}
    base = _link(base_link, [k for k in links if k not in parents], links, "base_link", name, file)
    carrying = {joint.parent for joint in joints}
    ends = [k for k in links if k not in carrying]
    tip = _link(tip_link, ends, links, "tip_link", name, file)
    way: list[_UrdfJoint] = []
    link = tip
    while link != base:
        joint = parents.get(link)
        if joint is None or joint in way:
            raise refusal(
                file,
                "key machine.tip_link",
                f"{tip!r}, which no joints connect with {base!r}",
                "a link that the base carries",
                "name another base_link or tip_link",
            )
        way.insert(0, joint)
        link = joint.parent
    moving = [joint for joint in way if joint.kind != "fixed"]
    if not moving:
        raise refusal(
            file,
            "key machine.urdf",
            f"no joint that moves between {base!r} and {tip!r}",
            "at least one",
            "name another base_link or tip_link",
        )
    for joint in moving:
        if joint.kind not in _MOVING or joint.mimics:
            raise refusal(
                name,
                f"joint {joint.name}",
                f"a joint that follows {joint.mimics!r}"
                if joint.mimics
                else f"type {joint.kind!r}",
                f"one of {listed([*_MOVING, 'fixed'])}"
                + (" with a command of its own" if joint.mimics else ""),
                "describe the arm by [[machine.joint]] rows, or end the chain before it",
            )
    return chain_of_joints(
        _chained(way),
        tool_offset_m,
        f"{path.name} ({', '.join(joint.name for joint in moving)})",
        up,
        coupling,
    )


def _chained(way: list[_UrdfJoint]) -> list[Joint]:
    """The moving joints, with the fixed transformations between them."""
    found: list[Joint] = []
    before, fixed = np.eye(4), np.eye(4)
    for joint in way:
        fixed = fixed @ joint.origin
        if joint.kind == "fixed":
            continue
        turn = np.eye(4)
        turn[:3, :3] = _to_axis(joint.axis)
        before, fixed = fixed @ turn, turn.T
        found.append(
            Joint(
                name=f"J{len(found) + 1}",
                kind="prismatic" if joint.kind == "prismatic" else "revolute",
                side="tool",
                direction=np.array([0.0, 0.0, 1.0]),
                before=before,
                after=np.eye(4),
                travel=np.array([joint.low, joint.high]),
            )
        )
    last = found[-1]
    found[-1] = Joint(
        name=last.name,
        kind=last.kind,
        side=last.side,
        direction=last.direction,
        before=last.before,
        after=fixed,
        travel=last.travel,
    )
    return found


def _to_axis(axis: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns z into `axis`; about x for the opposite direction."""
    x, y, z = axis
    if z < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + k + k @ k / (1.0 + z)


def _link(
    wanted: str | None, choice: list[str], links: list[str], key: str, name: str, file: str
) -> str:
    if wanted is None:
        if len(choice) == 1:
            return choice[0]
        raise refusal(
            file,
            f"key machine.{key}",
            f"nothing, and {len(choice)} links of {name} that it may be ({listed(choice)})",
            "the name of one",
            "add it",
        )
    if wanted not in links:
        raise refusal(
            file,
            f"key machine.{key}",
            f"the unknown link {wanted!r}{nearest(wanted, links)}",
            f"one of {listed(links)}",
            "correct the name",
        )
    return wanted


def _joint(one: _Element, name: str) -> _UrdfJoint:
    title = one.attributes.get("name", "")
    where = f"line {one.line}, joint {title}"
    ends = []
    for tag in ("parent", "child"):
        link = one.first(tag)
        if link is None or not link.attributes.get("link"):
            raise refusal(name, where, f"no <{tag} link=...>", "the name of a link", "add it")
        ends.append(link.attributes["link"])
    origin, limit = one.first("origin"), one.first("limit")
    xyz, rpy = (_triple(origin, key, (0.0, 0.0, 0.0), name, where) for key in ("xyz", "rpy"))
    axis = np.array(_triple(one.first("axis"), "xyz", (1.0, 0.0, 0.0), name, where))
    length = float(np.linalg.norm(axis))
    if not length > 0.0:
        raise refusal(name, where, "an axis of length zero", "a direction", "correct its xyz")
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = _roll_pitch_yaw(rpy), xyz
    low, high = (
        _number(limit, key, name, where) if limit is not None else 0.0 for key in ("lower", "upper")
    )
    if one.attributes.get("type") == "continuous" or not low < high:
        low, high = -math.inf, math.inf
    mimic = one.first("mimic")
    return _UrdfJoint(
        name=title,
        kind=one.attributes.get("type", ""),
        parent=ends[0],
        child=ends[1],
        origin=frame,
        axis=axis / length,
        low=low,
        high=high,
        mimics="" if mimic is None else mimic.attributes.get("joint", "another"),
    )


def _number(one: _Element, key: str, name: str, where: str) -> float:
    text = one.attributes.get(key, "0")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise refusal(
            name, f"{where}, {one.tag} {key}", repr(text), "a finite number", "correct the value"
        )
    return value


def _triple(
    one: _Element | None, key: str, usual: tuple[float, float, float], name: str, where: str
) -> tuple[float, ...]:
    if one is None or key not in one.attributes:
        return usual
    text = one.attributes[key]
    try:
        values = tuple(float(part) for part in text.split())
    except ValueError:
        values = ()
    if len(values) != 3 or not all(math.isfinite(v) and abs(v) < 1e6 for v in values):
        raise refusal(
            name,
            f"{where}, {one.tag} {key}",
            repr(text[:80]),
            "three numbers separated by spaces",
            "correct them",
        )
    return values


def _roll_pitch_yaw(angles: tuple[float, ...]) -> np.ndarray:
    """R = Rz(yaw) Ry(pitch) Rx(roll)."""
    (ca, sa), (cb, sb), (cc, sc) = ((math.cos(v), math.sin(v)) for v in angles)
    x = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    y = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    z = np.array([[cc, -sc, 0.0], [sc, cc, 0.0], [0.0, 0.0, 1.0]])
    return z @ y @ x
