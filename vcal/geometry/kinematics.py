"""Corrected kinematics of an arm: Denavit-Hartenberg rows, base and tool, with their uncertainties.

Conventions:

- A chain is B T_1 T_2 ... T_n H: the base B (frame of the arm's base), the joints, and the tool H.
- The row of a joint is T = Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta) (standard DH with the
  additional angle of Hayati), with q added to d for a prismatic joint. In the modified convention
  (Craig) the link comes first: T = Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d), with a, alpha and
  beta of the link before the joint.
- A link connects two lines, the axes of its joints, which takes four numbers. Where the axes are
  not parallel, these are theta, d, a and alpha, and beta is zero. Where they are nearly parallel,
  the common normal is not defined: d keeps its declared value, and beta is free.
- The six constant errors of a link have two numbers more, a rotation about the next axis and a
  translation along it. They commute with the motion of the next joint, and are part of its theta
  and d. Those of the last link, and its other four, are part of the tool. theta and d of the first
  joint keep their declared values, as a rotation about the first axis and a translation along it
  are part of the base.

The conversion is exact: rows, base and tool have the same tool points as the link errors.

Sources: J. Denavit, R. Hartenberg, J. Appl. Mech. 22 (1955) 215; S. Hayati, M. Mirmirani,
J. Robotic Systems 2 (1985) 397; J. Craig, Introduction to Robotics, 3.4.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..identification.fit import Fit
from ..identification.linearised import linearised_terms
from ..machine.chain import Chain
from ..model.forward import port_values, tool_points

_PARALLEL = math.sin(math.radians(3.0))
"""Sine of the angle between two axes below which they count as parallel."""
NAMES = ("theta", "d", "a", "alpha", "beta")
"""Numbers of a row: rad and m."""
_ANGLES = np.array([True, False, False, True, True])
_STEP = 1e-6
"""Step of the numerical derivatives, m or rad."""


@dataclass(frozen=True)
class Kinematics:
    """Rows of an arm with its base and tool; see the conventions of this module."""

    rows: Float[np.ndarray, "joints 5"]
    """theta, d, a, alpha, beta of every joint, standard convention, rad and m."""
    slides: tuple[bool, ...]
    """Whether each joint is prismatic."""
    base: Float[np.ndarray, "4 4"]
    """From the frame of the first joint to that of the arm's base."""
    tool: Float[np.ndarray, "4 4"]
    """From the flange to the tool point, with the axes of the tool."""

    def tool_frames(self, q: Float[np.ndarray, "n joints"]) -> Float[np.ndarray, "n 4 4"]:
        """Frames of the tool in the frame of the arm's base at joint positions, m or rad."""
        found = np.broadcast_to(self.base, (len(q), 4, 4))
        for j, (row, slides) in enumerate(zip(self.rows, self.slides, strict=True)):
            moved = np.zeros((len(q), 5)) + row
            moved[:, 1 if slides else 0] += q[:, j]
            found = found @ link(moved)
        return found @ self.tool

    start: tuple[float, float] = (0.0, 0.0)
    """a and alpha (m, rad) before the first joint, which only the modified convention has; they are
    part of `base`."""

    def modified(self) -> "Kinematics":
        """The same arm in the modified convention: alpha, a and beta are those of the link before
        the joint, the base is the one before the first of these, and the tool includes the last.
        """
        rows = self.rows.copy()
        rows[1:, 2:] = self.rows[:-1, 2:]
        rows[0, 2:] = *self.start, 0.0
        before, last = (np.concatenate([[0.0, 0.0], r[2:]])[None] for r in (rows[0], self.rows[-1]))
        return replace(
            self,
            rows=rows,
            base=self.base @ np.linalg.inv(link(before)[0]),
            tool=link(last)[0] @ self.tool,
        )


def link(rows: Float[np.ndarray, "n 5"]) -> Float[np.ndarray, "n 4 4"]:
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
    theta, d, a, alpha, beta = np.asarray(rows).T
    found = np.zeros((len(theta), 4, 4))
    found[:, :3, :3] = Rotation.from_euler("ZXY", np.column_stack([theta, alpha, beta])).as_matrix()
    found[:, 0, 3], found[:, 1, 3] = a * np.cos(theta), a * np.sin(theta)
    found[:, 2, 3], found[:, 3, 3] = d, 1.0
    return found


@dataclass(frozen=True)
class _Split:
    """A transformation between two joint frames as Rz(psi) Tz(c) Tx(a) Rx(alpha) Ry(beta) Rz(theta)
    Tz(d).
    """

    psi: float
    c: float
    a: float
    alpha: float
    beta: float
    theta: float
    d: float


def _split(between: np.ndarray, parallel: bool, c: float, near: float) -> _Split:
    """The parts of a transformation. Of nearly parallel axes, `c` is given and beta is free; of
    others, c is free and beta is zero. Of two solutions, psi is the one closest to `near`.
    """
    p, z = between[:3, 3], between[:3, 2]
    if parallel:
        d = (p[2] - c) / z[2]
        x, y = (p - d * z)[:2]
        a, psi = math.hypot(x, y), math.atan2(y, x) if x or y else near
        if _away(psi, near) > 0.5 * math.pi:
            a, psi = -a, psi + math.pi
    else:
        sine, psi = math.hypot(z[0], z[1]), math.atan2(z[0], -z[1])
        if _away(psi, near) > 0.5 * math.pi:
            sine, psi = -sine, psi + math.pi
        along = np.array([math.cos(psi), math.sin(psi), 0.0])
        across = np.array([-math.sin(psi), math.cos(psi), 0.0])
        a, d = float(p @ along), -float(p @ across) / sine
        c = float(p[2] - d * z[2])
    psi = near + (psi - near + math.pi) % (2.0 * math.pi) - math.pi
    x, y, z = _about_z(-psi) @ between[:3, 2]
    beta = math.asin(min(max(x, -1.0), 1.0)) if parallel else 0.0
    alpha = math.atan2(-y, z)
    rest = Rotation.from_euler("XY", [alpha, beta]).as_matrix().T @ _about_z(-psi) @ between[:3, :3]
    return _Split(psi, c, a, alpha, beta, math.atan2(rest[1, 0], rest[0, 0]), d)


def _away(angle: float, near: float) -> float:
    return abs((angle - near + math.pi) % (2.0 * math.pi) - math.pi)


def _about_z(angle: float) -> np.ndarray:
    return Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()


def _screw(theta: float, d: float) -> np.ndarray:
    """Rz(theta) Tz(d)."""
    return link(np.array([[theta, d, 0.0, 0.0, 0.0]]))[0]


def _frame(twist: np.ndarray) -> np.ndarray:
    """Translation by the first three numbers (m), then rotation by the others (rad)."""
    found = np.eye(4)
    found[:3, 3] = twist[:3]
    found[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix()
    return found


def _to_z(direction: np.ndarray) -> np.ndarray:
    """A rotation (4, 4) that turns z into a direction."""
    found, z = np.eye(4), np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, direction)
    size = float(np.linalg.norm(axis))
    if size < 1e-12 and direction[2] > 0.0:
        return found
    axis = axis / size if size >= 1e-12 else np.array([1.0, 0.0, 0.0])
    angle = math.atan2(size, float(direction[2]))
    found[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
    return found


class _Converter:
    """The conversion of link errors for one arm: what is parallel, and which values are kept."""

    def __init__(self, chain: Chain):
        if not chain.arm or chain.workpiece_side:
            raise ValueError(f"found {chain.text!r}, expected an arm of joint rows")
        self.chain = chain
        joints = [chain.joints[i] for i in chain.tool_side]
        self.slides = tuple(not joint.turns for joint in joints)
        self.to_z = [_to_z(np.asarray(j.direction) * j.sign) for j in joints]
        first, links = self._links(np.zeros((len(joints), 6)), np.zeros(6))
        self.after = [float((t.T @ np.asarray(j.after))[2, 3])
                      for t, j in zip(self.to_z, joints, strict=True)]  # fmt: skip
        self.parallel = [math.hypot(*between[:2, 2]) < _PARALLEL for between in links[:-1]]
        self.nominal = [
            _split(between, flat, c, 0.0)
            for between, flat, c in zip(links[:-1], self.parallel, self.after, strict=False)
        ]
        self.declared = self._nominal(first, links)

    def _links(self, twists: np.ndarray, tool: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Frame of the first joint, and what follows the motion of every joint up to the next."""
        joints = [self.chain.joints[i] for i in self.chain.tool_side]
        offset = np.asarray(self.chain.tool_offset) + tool[:3]
        end = _frame(np.concatenate([offset, tool[3:]]))
        starts = [np.asarray(j.before) @ t for j, t in zip(joints, self.to_z, strict=True)]
        links = []
        for k, (joint, turn) in enumerate(zip(joints, self.to_z, strict=True)):
            own = turn.T @ _frame(twists[k]) @ np.asarray(joint.after)
            links.append(own @ (starts[k + 1] if k + 1 < len(joints) else end))
        return starts[0], links

    def _nominal(self, first: np.ndarray, links: Sequence[np.ndarray]) -> Kinematics:
        theta, d = math.atan2(-first[0, 1], first[0, 0]), 0.0
        base, rows = first @ _screw(-theta, 0.0), []
        for one in self.nominal:
            rows.append([theta + one.psi, d + one.c, one.a, one.alpha, one.beta])
            theta, d = one.theta, one.d
        last = self.to_z[-1].T @ np.asarray(self.chain.joints[self.chain.tool_side[-1]].after)
        row = [theta, d + last[2, 3], last[0, 3], math.atan2(last[2, 1], last[1, 1]), 0.0]
        tool = np.linalg.inv(link(np.array([[0.0, *row[1:]]]))[0]) @ _screw(0.0, d) @ links[-1]
        start = float(base[0, 3]), math.atan2(base[2, 1], base[1, 1])
        if not np.allclose(base, link(np.array([[0.0, 0.0, *start, 0.0]]))[0], atol=1e-12):
            start = 0.0, 0.0
        return Kinematics(_wrapped(np.array([*rows, row])), self.slides, base, tool, start)

    def __call__(self, twists: np.ndarray, tool: np.ndarray) -> Kinematics:
        """The kinematics with constant errors (joints, 6) of the links and (6,) of the tool."""
        first, links = self._links(twists, tool)
        kept = self.declared.rows
        rows, theta, d, base = kept.copy(), 0.0, 0.0, self.declared.base
        for k, (between, flat, nominal) in enumerate(
            zip(links[:-1], self.parallel, self.nominal, strict=True)
        ):
            c = self.after[0] if k == 0 else kept[k, 1] - d
            one = _split(between, flat, c, nominal.psi)
            rows[k, 2:] = one.a, one.alpha, one.beta
            if k == 0:
                # theta and d keep their values: the difference is part of the base.
                base = first @ _screw(one.psi - kept[0, 0], one.c - kept[0, 1])
            else:
                rows[k, :2] = theta + one.psi, d + one.c
            theta, d = one.theta, one.d
        if len(rows) == 1:
            base = first @ _screw(-kept[0, 0], 0.0)
            theta = kept[0, 0]
        own = link(np.array([[0.0, 0.0, *kept[-1, 2:]]]))[0]
        rest = _screw(theta - kept[-1, 0], d - kept[-1, 1]) @ links[-1]
        rows[:, _ANGLES] = kept[:, _ANGLES] + _turn(rows[:, _ANGLES] - kept[:, _ANGLES])
        return Kinematics(rows, self.slides, base, np.linalg.inv(own) @ rest, self.declared.start)


def _turn(angle: np.ndarray) -> np.ndarray:
    """Angles from -pi to pi."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def _wrapped(rows: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows[:, _ANGLES] = -_turn(-rows[:, _ANGLES])
    rows[np.abs(rows) < 1e-15] = 0.0
    return rows


def kinematics(
    chain: Chain,
    twists: Float[np.ndarray, "joints 6"] | None = None,
    tool: Float[np.ndarray, "6"] | None = None,
) -> Kinematics:
    """Rows, base and tool of an arm with constant errors `twists` (m, rad) after the motion of its
    joints, and an error `tool` of the tool point: exactly, in the conventions of this module.

    Raises `ValueError` for a machine that is no arm.
    """
    convert = _Converter(chain)
    if twists is None and tool is None:
        return convert.declared
    still = np.zeros((len(chain.joints), 6))
    return convert(
        still if twists is None else np.asarray(twists, float),
        np.zeros(6) if tool is None else np.asarray(tool, float),
    )


@dataclass(frozen=True)
class Number:
    """One number of a table of kinematics, in m or rad."""

    place: str
    """Joint, ``"base"``, or the name of a tool point."""
    name: str
    declared: float
    """Not a number where nothing is declared."""
    value: float
    u: float
    """Standard uncertainty; zero where a convention fixes the value."""
    unit: str
    """``"m"`` or ``"rad"``."""


@dataclass(frozen=True)
class CorrectedKinematics:
    """Declared and corrected kinematics of an identified arm, in the standard convention."""

    declared: Kinematics
    corrected: Kinematics
    numbers: tuple[Number, ...]
    """Rows (theta, d, a, alpha, beta), base in the frame of the instrument, and tool points in the
    frame of the flange, with their uncertainties."""
    modified: tuple[Number, ...]
    """The same in the modified convention."""
    lost_rms: float
    """Rms and maximum over the plan, m, of the displacement of the tool point by beta, with all
    other numbers of the rows, base and tool at their best values: what a table of four numbers per
    joint cannot hold."""
    lost_max: float
    varying_rms: float
    """Rms and maximum over the plan, m, of the displacement of the tool point by what varies of the
    errors: what no table of kinematics holds."""
    varying_max: float


def corrected_kinematics(fit: Fit) -> CorrectedKinematics:
    """The kinematics of an identified arm, from the constant part of all errors of its model: their
    mean over the measured positions.

    Uncertainties follow from the covariance of the fit by the first derivatives of the conversion.
    Raises `ValueError` for a machine that is no arm.
    """
    chain, plan = fit.model.chain, fit.measurement.plan
    convert = _Converter(chain)
    joints, layout = len(chain.joints), fit.model.layout
    terms = linearised_terms(fit.model, plan, fit.shapes, fit.theta)
    size = len(layout)
    constant, by_theta = np.asarray(terms.offset).mean(0), np.zeros((size, len(fit.theta)))
    # The mean of an error that varies, such as the deflection of a joint under gravity, is a
    # constant that a table can hold.
    means = np.asarray(terms.values).mean(0)
    for port, parameter, mean in zip(
        np.asarray(terms.port), np.asarray(terms.parameter), means, strict=True
    ):
        by_theta[port, parameter] += mean
    constant += by_theta @ fit.theta
    groups = {*layout.groups}
    places = fit.model.instrument.tool_places
    frame = fit.model.instrument.frame_pose

    def numbers(
        errors: np.ndarray, modified: bool
    ) -> tuple[list[tuple[str, str, str]], np.ndarray]:
        twists = errors[: 6 * joints].reshape(joints, 6)
        found = convert(twists, errors[6 * joints : 6 * joints + 6])
        found = found.modified() if modified else found
        names = [(chain.axes[i], n) for i in chain.tool_side for n in NAMES]
        listed = [(p, n, "rad" if a else "m") for (p, n), a in
                  zip(names, np.tile(_ANGLES, joints), strict=True)]  # fmt: skip
        result = [found.rows.ravel()]
        if frame is not None:
            orientation, station = frame
            twist = errors[layout.slice("frame")]
            turn = orientation @ Rotation.from_rotvec(twist[3:]).as_matrix()
            seen = np.eye(4)
            seen[:3, :3], seen[:3, 3] = turn.T, -turn.T @ (station + twist[:3])
            listed += _named("base")
            result.append(_numbers(seen @ found.base))
        for name, place in (places or {"tool": np.zeros(3)}).items():
            own = errors[layout.slice(name)] if name in groups and name != "tool" else np.zeros(3)
            result.append(found.tool[:3, 3] + found.tool[:3, :3] @ (place + own[:3]))
            listed += [(name, c, "m") for c in "xyz"]
        return listed, np.concatenate(result)

    start = constant.copy()
    tables = []
    for modified in (False, True):
        listed, value = numbers(start, modified)
        slopes = np.zeros((len(value), size))
        for k in np.flatnonzero(np.abs(by_theta).max(1) > 0.0):
            step = _STEP * np.eye(size)[k]
            ends = [numbers(start + way * step, modified)[1] for way in (1.0, -1.0)]
            change = ends[0] - ends[1]
            angle = np.array([unit == "rad" for *_, unit in listed])
            change[angle] = _turn(change[angle])
            slopes[:, k] = change / (2.0 * _STEP)
        by = slopes @ by_theta
        u = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", by, fit.covariance, by), 0.0))
        _, nominal = numbers(np.zeros(size), modified)
        known = np.array([place in chain.axes for place, *_ in listed])
        if not places:
            known |= np.array([place == "tool" for place, *_ in listed])
        tables.append(
            tuple(
                Number(place, name, float(n) if there else math.nan, float(v), float(e), unit)
                for (place, name, unit), n, v, e, there in zip(
                    listed, nominal, value, u, known, strict=True
                )
            )
        )
    twists = constant[: 6 * joints].reshape(joints, 6)
    corrected = convert(twists, constant[6 * joints : 6 * joints + 6])
    q = np.asarray(plan.position, float)
    own = corrected.tool_frames(q[:, list(chain.tool_side)])[:, :3, 3]
    everything = np.asarray(port_values(terms, np.asarray(fit.theta), size))
    off = np.linalg.norm(np.asarray(tool_points(chain, q, everything)) - own, axis=1)
    lost = np.linalg.norm(_without_beta(corrected, q[:, list(chain.tool_side)]), axis=1)
    return CorrectedKinematics(
        declared=convert.declared,
        corrected=corrected,
        numbers=tables[0],
        modified=tables[1],
        lost_rms=_rms(lost),
        lost_max=float(lost.max(initial=0.0)),
        varying_rms=_rms(off),
        varying_max=float(off.max(initial=0.0)),
    )


def _named(place: str) -> list[tuple[str, str, str]]:
    return [(place, c, "m") for c in "xyz"] + [(place, f"r{c}", "rad") for c in "xyz"]


def _numbers(pose: np.ndarray) -> np.ndarray:
    """Translation and Euler angles of R = Rx Ry Rz."""
    return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_euler("XYZ")])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _without_beta(arm: Kinematics, q: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Displacement of the tool point by beta that the other numbers cannot reproduce, by least
    squares in first order.
    """
    if not arm.rows[:, 4].any():
        return np.zeros((len(q), 3))
    # theta of the first row is part of the base, all of the last row part of the tool.
    plain = replace(arm, rows=arm.rows * [1.0, 1.0, 1.0, 1.0, 0.0])
    off = (arm.tool_frames(q) - plain.tool_frames(q))[:, :3, 3].ravel()
    columns = []
    for j in range(len(arm.rows)):
        for k in range(4):
            changed = plain.rows.copy()
            changed[j, k] += _STEP
            more = replace(plain, rows=changed).tool_frames(q)
            columns.append((more - plain.tool_frames(q))[:, :3, 3].ravel() / _STEP)
    for k in range(6):
        moved = _frame(_STEP * np.eye(6)[k])
        more = replace(plain, base=moved @ plain.base).tool_frames(q)
        columns.append((more - plain.tool_frames(q))[:, :3, 3].ravel() / _STEP)
    for k in range(3):
        moved = _frame(_STEP * np.eye(6)[k])
        more = replace(plain, tool=plain.tool @ moved).tool_frames(q)
        columns.append((more - plain.tool_frames(q))[:, :3, 3].ravel() / _STEP)
    table = np.column_stack(columns)
    left = off - table @ np.linalg.lstsq(table, off, rcond=1e-9)[0]
    return left.reshape(-1, 3)
