"""A small interpreter of NC programs, its driven paths, and a machine with play, in plain numpy.

Only complete programs of G0 to G3 are read, in program coordinates, mm. It shares nothing with
the package: every number is read by `float`, an arc is a function of its angle.
"""

from __future__ import annotations

import math
import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

LETTERS = "XYZ"
PLANE = {17: "XYZ", 18: "ZXY", 19: "YZX"}
CENTRE = dict(zip("XYZ", "IJK", strict=True))


@dataclass(frozen=True)
class Driven:
    """What the control drives for one block."""

    line: int
    motion: int
    start: np.ndarray
    end: np.ndarray
    minutes: float | None
    """Time of a block in inverse time."""
    feed: float | None
    plane: int = 17
    centre: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0

    @property
    def length(self) -> float:
        """Of the straight line or of the helix."""
        if not self.turn:
            return float(np.linalg.norm(self.end - self.start))
        u, v, w = (LETTERS.index(c) for c in PLANE[self.plane])
        r = math.hypot(self.start[u] - self.centre[0], self.start[v] - self.centre[1])
        return math.hypot(r * self.turn, self.end[w] - self.start[w])

    def at(self, f: np.ndarray) -> np.ndarray:
        """Points (n, 3) at shares f (n,) of the way."""
        f = np.asarray(f)[:, None]
        if not self.turn:
            return self.start + f * (self.end - self.start)
        u, v, w = (LETTERS.index(c) for c in PLANE[self.plane])
        c = np.array(self.centre)
        a, b = self.start[[u, v]] - c, self.end[[u, v]] - c
        radius = np.linalg.norm(a) + f * (np.linalg.norm(b) - np.linalg.norm(a))
        phi = math.atan2(a[1], a[0]) + f * self.turn
        points = np.empty((len(f), 3))
        points[:, [u]] = c[0] + radius * np.cos(phi)
        points[:, [v]] = c[1] + radius * np.sin(phi)
        points[:, [w]] = self.start[w] + f * (self.end[w] - self.start[w])
        return points


def driven(program: str, start: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Driven]:
    """The moves of a program."""
    at = np.array(start, float)
    scale, absolute, absolute_centre, plane, motion, inverse = 1.0, True, False, 17, None, False
    feed, moves = None, []
    for number, line in enumerate(re.split(r"\r\n|\n|\r", program), 1):
        code = re.sub(r"\(.*?\)|;.*", "", line).replace(" ", "").replace("\t", "").upper()
        if code.startswith("%"):
            continue
        words = re.findall(r"([A-Z])([-+]?[\d.]+)", code.lstrip("/"))
        here: dict[str, float] = {}
        for letter, text in words:
            if letter != "G":
                here[letter] = float(text)
                continue
            g = float(text)
            if g in (0, 1, 2, 3):
                motion = int(g)
            elif g in (17, 18, 19):
                plane = int(g)
            elif g in (20, 21):
                scale = 25.4 if g == 20 else 1.0
            elif g in (90, 91):
                absolute = g == 90
            elif g in (90.1, 91.1):
                absolute_centre = g == 90.1
            elif g in (93, 94):
                inverse = g == 93
            elif g not in (40, 49, 54, 64, 80):
                raise ValueError(f"line {number}: G{text} is not for this interpreter")
        feed = here.get("F", feed)
        if not any(c in here for c in "XYZIJK"):
            continue
        assert motion is not None, f"line {number}: no motion"
        end = at.copy()
        for i, c in enumerate(LETTERS):
            if c in here:
                end[i] = here[c] * scale + (0.0 if absolute else at[i])
        minutes = 1.0 / here["F"] if inverse and motion else None
        rate = None if inverse or feed is None else feed * scale
        extra = {}
        if motion > 1:
            extra = _arc(here, plane, motion, at, end, scale, absolute_centre)
        moves.append(Driven(number, motion, at, end, minutes, rate, **extra))
        at = end
    return moves


def _arc(here, plane, motion, start, end, scale, absolute_centre):
    u, v, _ = (LETTERS.index(c) for c in PLANE[plane])
    a, b = start[u] + 1j * start[v], end[u] + 1j * end[v]
    sign = 1 if motion == 3 else -1
    if "R" in here:
        r = here["R"] * scale
        half = abs(b - a) / 2
        h = math.sqrt(max(r * r - half * half, 0.0))
        left = sign if r > 0 else -sign
        centre = (a + b) / 2 + left * 1j * (b - a) / abs(b - a) * h
    else:
        letters = [CENTRE[c] for c in PLANE[plane][:2]]
        i, j = (here.get(c, 0.0) * scale for c in letters)
        centre = i + 1j * j + (0 if absolute_centre else a)
    p, q = a - centre, b - centre
    assert abs(abs(p) - abs(q)) < 0.0127, f"radii {abs(p)} and {abs(q)}"
    turn = sign * (np.angle(q / p) * sign % (2 * math.pi))
    if abs(turn) < 1e-6:
        turn = sign * 2 * math.pi
    turn += sign * 2 * math.pi * (here.get("P", 1.0) - 1)
    return {"plane": plane, "centre": (centre.real, centre.imag), "turn": float(turn)}


def sampled(moves: list[Driven], spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3), index of the move (n,), and approach directions (n, 3) of all moves."""
    points, index = [], []
    for k, move in enumerate(moves):
        n = max(2, math.ceil(move.length / spacing), math.ceil(50 * abs(move.turn))) + 1
        points.append(move.at(np.linspace(0.0, 1.0, n)))
        index += [k] * n
    path, index = np.concatenate(points), np.array(index)
    direction, last = np.zeros_like(path), np.zeros(3)
    step = np.zeros_like(path)
    step[:-1] = np.diff(path, axis=0)
    step[np.flatnonzero(np.diff(index))] = 0.0  # the first point of a move repeats the last one
    for i in range(len(path)):
        ahead = step[i] if i + 1 < len(path) and index[i + 1] == index[i] else step[i - 1]
        last = np.where(np.abs(ahead) > 1e-12, np.sign(ahead), last)
        direction[i] = last
    return path, index, direction


def distance_to(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Distance (n,) of points to the polyline through a path (m, 3), near its nearest vertices."""
    from scipy.spatial import cKDTree

    _, near = cKDTree(path).query(points, k=min(24, len(path)))
    best = np.full(len(points), np.inf)
    for shift in (-1, 0):
        a = path[np.clip(near + shift, 0, len(path) - 2)]
        b = path[np.clip(near + shift, 0, len(path) - 2) + 1]
        d, p = b - a, points[:, None] - a
        f = np.clip(np.sum(d * p, -1) / np.maximum(np.sum(d * d, -1), 1e-300), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(p - f[..., None] * d, axis=-1).min(axis=1))
    return best


def play(command: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Tool positions (n, 3) behind a lost motion of +-half (3,): the play operator."""
    tool = np.empty_like(command)
    at = command[0].copy()
    for i, c in enumerate(command):
        at = np.clip(at, c - half, c + half)
        tool[i] = at
    return tool


def rs274(program: bytes, folder: Path) -> list[tuple[int, np.ndarray]]:
    """Motion and end (3,) of every move, mm, as LinuxCNC's stand-alone interpreter reads them.

    Raises `AssertionError` with its words where it refuses the program.
    """
    file = folder / "program.ngc"
    file.write_bytes(program)
    ran = subprocess.run(
        ["rs274", "-g", str(file)], cwd=folder, capture_output=True, encoding="latin-1", check=False
    )
    moves: list[tuple[int, np.ndarray]] = []
    scale, plane = 1.0, "XYZ"
    for line in ran.stdout.splitlines():
        found = re.search(r"(\w+)\((.*)\)", line)
        if not found:
            continue
        name, arguments = found[1], found[2].split(",")
        if name == "USE_LENGTH_UNITS":
            scale = 25.4 if "INCH" in arguments[0] else 1.0
        elif name == "SELECT_PLANE":
            plane = {"XY": "XYZ", "XZ": "ZXY", "YZ": "YZX"}[arguments[0].rpartition("_")[2]]
        elif name in ("STRAIGHT_TRAVERSE", "STRAIGHT_FEED"):
            end = scale * np.array([float(v) for v in arguments[:3]])
            moves.append((0 if name.endswith("TRAVERSE") else 1, end))
        elif name == "ARC_FEED":
            u, v, _, _, turns, w = (float(a) for a in arguments[:6])
            end = np.empty(3)
            end[["XYZ".index(c) for c in plane]] = u, v, w
            moves.append((3 if turns > 0 else 2, scale * end))
    assert "rror" not in ran.stderr and ran.returncode == 0, ran.stderr
    return moves
