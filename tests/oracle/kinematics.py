"""Exact kinematics of a serial three-axis machine and of an arm, in plain numpy.

Everything is SI (m, rad) and vectorised over n observations.  A joint moves what it carries by

    p  ->  s x d + E + R(e) p

with x the axis's command, s = +1 between bed and tool and -1 between bed and workpiece, d the
nominal direction tilted by the squareness, E the error translation and e the error rotation
(a rotation vector; it turns about the joint's own moving frame).  The tool point in the workpiece
frame is inv(T_workpiece_side) T_tool_side tool_offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
AXES = "XYZ"
COMPONENTS = "XYZABC"
SQUARENESS = ("EC0Y", "EB0Z", "EA0Z")

# Half widths of the uniform coefficients, um and urad; x runs from -1 to 1 over the travel:
# E(x) = a0 + a1 x + b1 sin(n1 pi x) + c1 cos(n1 pi x) + b2 sin(n2 pi x) + c2 cos(n2 pi x)
TABLE_COLUMNS = ("a0", "a1", "n1", "b1", "c1", "n2", "b2", "c2")
NODES = 61
ErrorTable = dict[str, tuple[float, ...]]
TABLE: ErrorTable = {
    "EXX": (0, 40, 0.5, 20, 20, 3, 1.5, 1.5),
    "EYX": (0, 0, 0.5, 30, 0, 3, 0.45, 0.45),
    "EZX": (0, 0, 0.5, 15, 0, 3, 0.45, 0.45),
    "EAX": (10, 20, 0.5, 10, 10, 3, 0.75, 0.75),
    "EBX": (10, 20, 0.5, 10, 10, 3, 0.75, 0.75),
    "ECX": (10, 20, 0.5, 10, 10, 3, 0.75, 0.75),
    "EXY": (0, 0, 0.5, 15, 0, 1, 5, 5),
    "EYY": (0, 20, 0.5, 5, 5, 1, 3, 3),
    "EZY": (0, 0, 0.5, 15, 0, 1, 5, 5),
    "EAY": (10, 15, 0.5, 10, 10, 1, 5, 5),
    "EBY": (10, 15, 0.5, 10, 10, 1, 5, 5),
    "ECY": (10, 15, 0.5, 10, 10, 1, 5, 5),
    "EXZ": (0, 0, 0.5, 15, 0, 1, 5, 5),
    "EYZ": (0, 0, 0.5, 15, 0, 1, 5, 5),
    "EZZ": (0, 20, 0.5, 15, 15, 1, 3, 3),
    "EAZ": (10, 15, 0.5, 6, 6, 1, 2, 2),
    "EBZ": (10, 15, 0.5, 6, 6, 1, 2, 2),
    "ECZ": (10, 15, 0.5, 6, 6, 1, 2, 2),
    "EC0Y": (40, 0, 0, 0, 0, 0, 0, 0),
    "EB0Z": (40, 0, 0, 0, 0, 0, 0, 0),
    "EA0Z": (40, 0, 0, 0, 0, 0, 0, 0),
}


def rotation_matrix(vector: ArrayLike) -> Array:
    """Return exp(skew(v)), shape (..., 3, 3), of rotation vectors v (..., 3) in rad (Rodrigues).

    R = I + sin(a)/a S + (1 - cos(a))/a^2 S^2 with a = |v| and S = skew(v).
    """
    v = np.asarray(vector, dtype=float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    half = np.sinc(angle / (2 * np.pi))  # sin(a/2) / (a/2)
    s = skew(v)
    return np.eye(3) + np.sinc(angle / np.pi) * s + 0.5 * half**2 * (s @ s)


def skew(vector: ArrayLike) -> Array:
    """Return the matrices S (..., 3, 3) with S p = v x p."""
    v = np.asarray(vector, dtype=float)
    s = np.zeros((*v.shape, 3))
    s[..., 2, 1] = v[..., 0]
    s[..., 0, 2] = v[..., 1]
    s[..., 1, 0] = v[..., 2]
    return s - np.swapaxes(s, -1, -2)


def euler_xyz(angles: ArrayLike) -> Array:
    """Return R = Rx(a) Ry(b) Rz(c) for angles (a, b, c) in rad."""
    a, b, c = np.asarray(angles, dtype=float)
    ex, ey, ez = np.eye(3)
    return rotation_matrix(a * ex) @ rotation_matrix(b * ey) @ rotation_matrix(c * ez)


def turn(vector: Array, p: Array, small_angle: bool = False) -> Array:
    """Rotate points p (..., 3) by rotation vectors (..., 3); small_angle uses p + v x p."""
    vxp = np.cross(vector, p)
    if small_angle:
        return p + vxp
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    half = np.sinc(angle / (2 * np.pi))
    return p + np.sinc(angle / np.pi) * vxp + 0.5 * half**2 * np.cross(vector, vxp)


def unturn(vector: Array, p: Array, small_angle: bool = False) -> Array:
    """Undo turn exactly; (I + S)^-1 = (I + v v' - S) / (1 + |v|^2) in the small-angle form."""
    if not small_angle:
        return turn(-vector, p)
    dot = np.sum(vector * p, axis=-1, keepdims=True)
    norm2 = np.sum(vector**2, axis=-1, keepdims=True)
    return (p + vector * dot - np.cross(vector, p)) / (1 + norm2)


def parse_chain(chain: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Split an ISO 10791-6 string into axis indices, each side listed from the bed outwards.

    "w Y X b Z t" gives ((X, Y), (Z,)): next to `b` is nearest the bed on either side.
    """
    names = chain.split()
    if not names or names[0] != "w" or names[-1] != "t" or names.count("b") != 1:
        raise ValueError(f"chain must read 'w ... b ... t', got {chain!r}")
    bed = names.index("b")
    moving = names[1:bed] + names[bed + 1 : -1]
    if sorted(moving) != list(AXES):
        raise ValueError(f"chain must name X, Y and Z once each, got {chain!r}")
    workpiece = tuple(AXES.index(a) for a in reversed(names[1:bed]))
    return workpiece, tuple(AXES.index(a) for a in names[bed + 1 : -1])


@dataclass(frozen=True)
class Smooth:
    """Error motions drawn from a Gaussian process with a Matern-5/2 kernel on each travel."""

    translation: float
    """One-sigma size of an error translation, m."""
    rotation: float
    """Of an error rotation, rad."""
    squareness: float
    """Of a squareness, rad."""
    smoothness: float = 0.5
    """Correlation length over travel."""
    weights: Array = field(default_factory=lambda: np.zeros((3, 6, NODES)))
    """Of the kernel about every node, (axis, component X Y Z A B C, node), m and rad."""

    def kernel(self, a: Array, b: Array) -> Array:
        """Return k (..., n, m) = (1 + r + r^2/3) exp(-r) of shares of the travel, -1 to 1."""
        r = np.sqrt(5) * np.abs(a[..., :, None] - b) / (2 * self.smoothness)
        return (1 + r + r**2 / 3) * np.exp(-r)

    def drawn(self, rng: np.random.Generator) -> Smooth:
        """Draw values at the nodes; between them stands what a Gaussian process expects there."""
        x = np.linspace(-1, 1, NODES)
        root = np.linalg.cholesky(self.kernel(x, x) + 1e-10 * np.eye(NODES))
        sizes = np.repeat([self.translation, self.rotation], 3)[None, :, None]
        weights = rng.standard_normal((3, 6, NODES)) @ np.linalg.inv(root) * sizes
        return replace(self, weights=weights)

    def values(self, u: Array) -> Array:
        """Return the error motions (n, axis, 6) at shares u (n, 3) of the travel."""
        x = np.linspace(-1, 1, NODES)
        return np.einsum("nik,ijk->nij", self.kernel(u, x), self.weights)


@dataclass(frozen=True)
class Machine:
    """A three-axis machine with known error motions; axes always in the order X, Y, Z."""

    chain: str
    travel: Array
    """Lower and upper end of each axis, (3, 2) in m."""
    tool_offset: Array
    """From the last axis's frame to the tool point, (3,) in m."""
    motion: Array = field(default_factory=lambda: np.zeros((3, 6, 8)))
    """Coefficients (axis, component X Y Z A B C, TABLE_COLUMNS) in m and rad."""
    squareness: Array = field(default_factory=lambda: np.zeros(3))
    """EC0Y, EB0Z, EA0Z in rad."""
    table: ErrorTable = field(default_factory=lambda: TABLE)
    """What is declared: half widths in um and urad."""
    smooth: Smooth | None = None
    """Where the smooth family is declared instead: its sizes, and what was drawn from it."""

    def coefficients(self) -> dict[str, list[float]]:
        """Return the true coefficients by component name, in um and urad (n1, n2 as they are)."""
        scale = np.where(np.isin(TABLE_COLUMNS, ["n1", "n2"]), 1.0, 1e6)
        out = {
            f"E{c}{a}": (self.motion[i, j] * scale).tolist()
            for i, a in enumerate(AXES)
            for j, c in enumerate(COMPONENTS)
        }
        for name, value in zip(SQUARENESS, self.squareness, strict=True):
            out[name] = [float(value) * 1e6, *[0.0] * 7]
        return out


def nominal_machine(chain: str, travel: ArrayLike, tool_offset: ArrayLike) -> Machine:
    """Return an error-free machine; travel is (3, 2) or (3,) upper ends in m."""
    span = np.asarray(travel, dtype=float)
    if span.ndim == 1:
        span = np.stack([np.zeros(3), span], axis=1)
    parse_chain(chain)
    return Machine(chain, span, np.asarray(tool_offset, dtype=float))


def with_errors(machine: Machine, coefficients: Mapping[str, ArrayLike]) -> Machine:
    """Set error motions by name: {"EXX": 8 numbers in the order of TABLE_COLUMNS, m and rad}.

    A squareness takes a single number (or a table row whose a0 counts).
    """
    motion, squareness = machine.motion.copy(), machine.squareness.copy()
    for name, value in coefficients.items():
        row = np.atleast_1d(np.asarray(value, dtype=float))
        if name in SQUARENESS:
            squareness[SQUARENESS.index(name)] = row[0]
        elif len(name) == 3 and name[1] in COMPONENTS and name[2] in AXES:
            motion[AXES.index(name[2]), COMPONENTS.index(name[1]), : row.size] = row
        else:
            raise ValueError(f"unknown error motion {name!r}; expected e.g. EXX, EAY or EC0Y")
    return replace(machine, motion=motion, squareness=squareness)


def draw_machine(
    machine: Machine, rng: np.random.Generator, table: ErrorTable = TABLE, size: float = 1.0
) -> Machine:
    """Draw every coefficient uniformly within +/- its table entry times size."""
    drawn: dict[str, ArrayLike] = {}
    for name, row in table.items():
        wide = np.array(row, dtype=float)
        keep = np.isin(TABLE_COLUMNS, ["n1", "n2"])
        drawn[name] = np.where(keep, wide, 1e-6 * size * wide * rng.uniform(-1, 1, wide.size))
    return replace(with_errors(machine, drawn), table=table)


def draw_smooth(machine: Machine, rng: np.random.Generator, family: Smooth) -> Machine:
    """Draw error motions and squareness from a smooth family."""
    square = family.squareness * rng.standard_normal(3)
    return replace(machine, smooth=family.drawn(rng), squareness=square)


def normalised(machine: Machine, q: Array) -> Array:
    """Return positions (n, 3) as shares of the travel, -1 to 1."""
    low, high = machine.travel.T
    return (2 * q - low - high) / (high - low)


def error_motions(machine: Machine, q: Array) -> tuple[Array, Array]:
    """Return error translations and rotations, each (n, axis, 3), at commands q (n, 3)."""
    x = np.pi * normalised(machine, q)[:, :, None]
    a0, a1, n1, b1, c1, n2, b2, c2 = np.moveaxis(machine.motion, -1, 0)
    e = a0 + a1 * x / np.pi + b1 * np.sin(n1 * x) + c1 * np.cos(n1 * x)
    e = e + b2 * np.sin(n2 * x) + c2 * np.cos(n2 * x)
    if machine.smooth is not None:
        e = e + machine.smooth.values(normalised(machine, q))
    return e[..., :3], e[..., 3:]


def directions(machine: Machine) -> Array:
    """Return the axes' directions as rows: X, Y (-EC0Y, 1, 0), Z (EB0Z, -EA0Z, 1)."""
    c0y, b0z, a0z = machine.squareness
    return np.array([[1.0, 0.0, 0.0], [-c0y, 1.0, 0.0], [b0z, -a0z, 1.0]])


def compose(
    machine: Machine,
    q: Array,
    translation: Array,
    rotation: Array,
    tool: Array | None = None,
    small_angle: bool = False,
) -> Array:
    """Return the tool point in the workpiece frame, (n, 3) m.

    translation and rotation (n, axis, 3) are the joints' error twists, tool (3,) or (n, 3) the
    tool vector (the machine's own if None).
    """
    workpiece, carrying = parse_chain(machine.chain)
    d = directions(machine)
    p = np.broadcast_to(machine.tool_offset if tool is None else tool, q.shape)
    for i in reversed(carrying):
        p = q[:, i, None] * d[i] + translation[:, i] + turn(rotation[:, i], p, small_angle)
    for i in workpiece:
        p = unturn(rotation[:, i], p + q[:, i, None] * d[i] - translation[:, i], small_angle)
    return p


@dataclass(frozen=True)
class Arm:
    """A serial arm in standard Denavit-Hartenberg parameters, one entry per joint (m, rad)."""

    a: Array
    alpha: Array
    d: Array
    theta: Array
    prismatic: NDArray[np.bool_] | None = None
    translation: Array | None = None
    """Constant error translation after each joint's rotation, (joint, 3) m."""
    rotation: Array | None = None
    """Constant error rotation vector after that, (joint, 3) rad."""

    @property
    def joints(self) -> int:
        return len(self.a)


def arm_frames(
    arm: Arm,
    q: Array,
    translation: Array | None = None,
    rotation: Array | None = None,
) -> tuple[Array, Array]:
    """Return the frames after every joint in the base frame: R (n, j + 1, 3, 3), o (n, j + 1, 3).

    T_j = Rz(theta_j + q_j) Trans(t_j) Rot(r_j) Tz(d_j) Tx(a_j) Rx(alpha_j); entry 0 is the base.
    For a prismatic joint q_j adds to d_j.  translation and rotation, (j, 3) or (n, j, 3),
    are added to the arm's own constant twists.
    """
    n, k = q.shape
    ex, _, ez = np.eye(3)
    zero = np.zeros((k, 3))
    t = (zero if arm.translation is None else arm.translation) + (
        zero if translation is None else translation
    )
    r = (zero if arm.rotation is None else arm.rotation) + (zero if rotation is None else rotation)
    t, r = np.broadcast_to(t, (n, k, 3)), np.broadcast_to(r, (n, k, 3))
    slides = np.zeros(k, dtype=bool) if arm.prismatic is None else arm.prismatic
    turned = arm.theta + np.where(slides, 0.0, q)
    offset = arm.d + np.where(slides, q, 0.0)
    frame, origin = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    frames, origins = [frame], [origin]
    for j in range(k):
        frame = frame @ rotation_matrix(turned[:, j, None] * ez)
        origin = origin + np.einsum("nij,nj->ni", frame, t[:, j])
        frame = frame @ rotation_matrix(r[:, j])
        step = offset[:, j, None] * ez + arm.a[j] * ex
        origin = origin + np.einsum("nij,nj->ni", frame, step)
        frame = frame @ rotation_matrix(arm.alpha[j] * ex)
        frames.append(frame)
        origins.append(origin)
    return np.stack(frames, axis=1), np.stack(origins, axis=1)
