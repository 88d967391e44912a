"""The machine, its family, the artefact and its poses; what the publication leaves open is assumed.

Printed: chain and work space, Table 1, N = 11 balls on 1500 mm with the offsets a = b = 30 mm,
2 um standard deviation of reference distances, twelve diagonal poses, a grid of 60 x 20 x 20.
Not printed: the tool, the noise of a touch, which way the offsets go, where the poses are, what is
observed and whether the 2 um are the same in all poses. Table 1 names two squarenesses B; the third
is taken to be that of X and Y.
"""

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...design import ArrayPoses
from ...effects.geometric import ErrorMotion, GeometricErrors, LocationError
from ...machine.chain import Chain, chain_from_string
from ...machine.error_functions import Fourier, unit_uniform
from ...machine.plan import Plan

CHAIN = "w b X Y Z t"
TRAVEL: Mapping[str, tuple[float, float]] = {"X": (0.0, 3.0), "Y": (0.0, 1.5), "Z": (0.0, 1.3)}
TOOL = (0.0, 0.0, 0.2)
PROBE_UM = 0.5
"""Standard deviation of a touch in every direction."""
PAIR_UM = 2.0
"""Of the distance of two balls."""
LENGTH = 1.5
GRID = (60, 20, 20)
BALLS = (5, 7, 9, 11, 13, 15, 17)
OFFSETS = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06)
NOMINAL = (11, 0.03, 0.03)
"""N, a and b (m)."""

WAVES: Mapping[str, tuple[float, float]] = {"X": (0.5, 3.0), "Y": (0.5, 1.0), "Z": (0.5, 1.0)}
TABLE_ONE: Mapping[str, tuple[float, float, float, float, float, float]] = {
    "EXX": (0, 40, 20, 20, 10, 10),
    "EYX": (0, 0, 30, 0, 3, 3),
    "EZX": (0, 0, 15, 0, 3, 3),
    "EAX": (10, 20, 10, 10, 5, 5),
    "EBX": (10, 20, 10, 10, 5, 5),
    "ECX": (10, 20, 10, 10, 5, 5),
    "EXY": (0, 0, 15, 0, 5, 5),
    "EYY": (0, 20, 5, 5, 3, 3),
    "EZY": (0, 0, 15, 0, 5, 5),
    "EAY": (10, 15, 10, 10, 5, 5),
    "EBY": (10, 15, 10, 10, 5, 5),
    "ECY": (10, 15, 10, 10, 5, 5),
    "EXZ": (0, 0, 15, 0, 5, 5),
    "EYZ": (0, 0, 15, 0, 5, 5),
    "EZZ": (0, 20, 15, 15, 3, 3),
    "EAZ": (10, 15, 6, 6, 2, 2),
    "EBZ": (10, 15, 6, 6, 2, 2),
    "ECZ": (10, 15, 6, 6, 2, 2),
}
"""a0, a1, b1, c1, b2, c2 of every error motion, um or urad; waves n1 and n2 by axis."""
SQUARENESSES = ("EA0Z", "EB0Z", "EC0Y")
SQUARENESS_URAD = 40.0

Known = Literal["S", "P", "B"]
"""How the 2 um are meant: **S** distances of pairs, of one artefact that is the same in all poses;
**P** distances of pairs, fresh in every pose (heat, handling); **B** ball centres, 2 um / sqrt(2)
per coordinate, the same in all poses.
"""
KNOWN: tuple[Known, ...] = ("S", "P", "B")


class Pose(NamedTuple):
    """Where the middle of an artefact is to be (m), and along what direction it lies."""

    centre: tuple[float, float, float]
    direction: tuple[float, float, float]


class Family(NamedTuple):
    """What errors a machine may have; the publication's unless said otherwise."""

    amplitudes: Mapping[str, tuple[float, ...]] = TABLE_ONE
    """As in `TABLE_ONE`, of the same error motions."""
    waves: Mapping[str, tuple[float, float]] = WAVES
    squareness_urad: float = SQUARENESS_URAD


def machine(family: Family | None = None) -> tuple[Chain, GeometricErrors]:
    """The travelling column and the family of its errors."""
    family = Family() if family is None else family
    chain = chain_from_string(CHAIN, TRAVEL, TOOL)
    motions = []
    for name, (a0, a1, b1, c1, b2, c2) in family.amplitudes.items():
        axis = name[2]
        first, second = family.waves[axis]
        rows = [(first, b1 * 1e-6, c1 * 1e-6), (second, b2 * 1e-6, c2 * 1e-6)]
        basis = Fourier(TRAVEL[axis], a0 * 1e-6, a1 * 1e-6, rows)
        motions.append(ErrorMotion(name, axis, basis))
    sigma = family.squareness_urad * 1e-6 / 3.0**0.5
    locations = tuple(LocationError.of(chain, n, sigma, unit_uniform()) for n in SQUARENESSES)
    return chain, GeometricErrors(motions=tuple(motions), locations=locations)


def grid_points(chain: Chain, counts: tuple[int, int, int] = GRID) -> Plan:
    """The publication's grid over the work space."""
    sides = [np.linspace(*TRAVEL[c], n) for c, n in zip("XYZ", counts, strict=True)]
    at = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    return Plan(chain.axes, at[:, ["XYZ".index(c) for c in chain.axes]], {})


def ball_line(count: int, a: float, b: float) -> Float[np.ndarray, "N 3"]:
    """Balls on a line of `LENGTH`, offset by a to either side in turn, and by b up and down in
    pairs, m.
    """
    i = np.arange(count)
    x = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, count)
    return np.column_stack([x, np.where(i % 2, a, -a), np.where(i // 2 % 2, b, -b)])


def outer_faces() -> list[Pose]:
    """Both diagonals of the six faces; on either of two opposite faces in the other half."""

    def half(start: np.ndarray, way: np.ndarray, far: int) -> np.ndarray:
        whole = float(np.linalg.norm(way))
        return start + way / whole * (whole - 0.5 * LENGTH if far else 0.5 * LENGTH)

    return _on_faces(half)


def face_centres() -> list[Pose]:
    """Both diagonals of the six faces, in the middle of each."""
    return _on_faces(lambda start, way, far: start + 0.5 * way)


def _on_faces(middle: Callable[[np.ndarray, np.ndarray, int], np.ndarray]) -> list[Pose]:
    """Both diagonals of the six faces: `middle` (start of the diagonal, the diagonal, far face or
    not) is where the artefact's middle is to be.
    """
    sides = np.array([TRAVEL[c][1] for c in "XYZ"])
    found = []
    for axis in range(3):
        i, j = (k for k in range(3) if k != axis)
        for far in (0, 1):
            for rising in (1.0, -1.0):
                way, start = np.zeros(3), np.zeros(3)
                way[i], way[j] = sides[i], rising * sides[j]
                start[axis], start[j] = far * sides[axis], 0.0 if rising > 0 else sides[j]
                found.append(_pose(middle(start, way, far), way))
    return found


def body_diagonals() -> list[Pose]:
    """The four directions of the body diagonals, at a quarter, the middle and three quarters of
    X.
    """
    sides = np.array([TRAVEL[c][1] for c in "XYZ"])
    found = []
    for share in (0.25, 0.5, 0.75):
        for sy in (1.0, -1.0):
            for sz in (1.0, -1.0):
                way = np.array([0.5 * sides[0], sy * sides[1], sz * sides[2]])
                found.append(_pose(np.array([share, 0.5, 0.5]) * sides, way))
    return found


POSES: Mapping[str, Callable[[], list[Pose]]] = {
    "outer faces": outer_faces,
    "face centres": face_centres,
    "body diagonals": body_diagonals,
}
"""Sets of twelve diagonal poses, by name; the first is the strongest."""


def placed(poses: list[Pose], balls: Float[np.ndarray, "N 3"]) -> ArrayPoses:
    """An artefact in poses, moved into the travel where it stands out, upright about its line."""
    rotations, origins = [], []
    high = np.array([TRAVEL[c][1] for c in "XYZ"])
    for pose in poses:
        along = np.asarray(pose.direction) / np.linalg.norm(pose.direction)
        up = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        side = np.cross(up, along)
        side /= np.linalg.norm(side)
        R = np.stack([along, side, np.cross(along, side)], 1)
        reached = np.asarray(pose.centre) + balls @ R.T
        move = np.maximum(-reached.min(0), 0.0) - np.maximum(reached.max(0) - high, 0.0)
        rotations.append(R)
        # Centres are given as axis positions; the tool point is a tool away.
        origins.append(np.asarray(pose.centre) + move + TOOL)
    return ArrayPoses(
        jnp.asarray(balls), jnp.asarray(np.stack(rotations)), jnp.asarray(np.stack(origins))
    )


def _pose(centre: np.ndarray, direction: np.ndarray) -> Pose:
    (x, y, z), (u, v, w) = centre.tolist(), direction.tolist()
    return Pose((x, y, z), (u, v, w))
