"""Random NC programs in many ways of writing, and displacements of machines with known errors."""

import math

import numpy as np

from oracle.kinematics import TABLE, compose, draw_machine, error_motions, nominal_machine

TRAVEL = (0.4, 0.3, 0.2)
TOOL = (0.0, 0.0, -0.15)


def machine_displacement(seed: int, size: float = 1.0):
    """Of a machine with error motions drawn from the table of the oracle, relative to its nominal
    kinematics; exact, with rotations.
    """
    nominal = nominal_machine("w X b Y Z t", TRAVEL, TOOL)
    real = draw_machine(nominal, np.random.default_rng(seed), TABLE, size)
    none = np.zeros((3, 3))

    def displacement(positions, directions):
        flat = np.broadcast_to(none, (len(positions), 3, 3))
        wanted = compose(nominal, positions, flat, flat)
        return compose(real, positions, *error_motions(real, positions)) - wanted

    return displacement


def zero(positions, directions):
    return np.zeros_like(positions)


def short_arcs(seed: int) -> bytes:
    """1500 arcs of 0.02 to 0.2 mm, as curves are written by programs for machining."""
    rng = np.random.default_rng(seed)
    at = 100.0 + 100.0j
    lines = ["G21 G90", "G0 X100. Y100. Z50.", "F100"]
    for _ in range(1500):
        r, chord = rng.choice([5, 10, 20, 50]), rng.uniform(0.02, 0.2)
        out = np.exp(1j * rng.uniform(0, 2 * math.pi))
        turn = 2 * math.asin(chord / 2 / r)
        g = rng.choice([2, 3])
        end = at - r * out + r * out * np.exp(1j * (turn if g == 3 else -turn))
        ends = round(end.real, 4), round(end.imag, 4)
        i, j = -(r * out).real, -(r * out).imag
        lines.append(f"G{g} X{ends[0]:.4f} Y{ends[1]:.4f} I{i:.4f} J{j:.4f}")
        at = complex(*ends)
    return ("\n".join(lines) + "\n").encode()


class Author:
    """Writes a program of random moves within the travels, in one style."""

    def __init__(self, seed: int, arcs: bool = True, diagonal: bool = False):
        self.rng = np.random.default_rng(seed)
        self.arcs, self.diagonal = arcs, diagonal
        self.blank = str(self.rng.choice(["", " ", "  "]))
        self.lower, self.numbered = self.rng.random(2) < 0.3
        self.eol = str(self.rng.choice(["\n", "\r\n"]))
        self.inch = bool(self.rng.random() < 0.25)
        self.absolute, self.absolute_centre, self.plane = True, False, 17
        self.motion = -1
        self.inverse = False
        self.lines: list[str] = []
        self.at = np.array([200.0, 150.0, 100.0])

    def program(self, moves: int) -> bytes:
        self.lines.append("%")
        self.lines.append("(random program; \xfcber Y)")
        self.write("G20" if self.inch else "G21", "G17", "G90", "G94", "F300")
        self.write("G0", *self.words(self.at))
        self.write("S1200", "M3")
        for _ in range(moves):
            self.modal()
            self.line() if not self.arcs or self.rng.random() < 0.6 else self.arc()
        self.write("M30")
        self.lines.append("%")
        return (self.eol.join(self.lines) + self.eol).encode("latin-1")

    def write(self, *words: str) -> None:
        text = self.blank.join(w for w in words if w)
        if self.numbered:
            text = f"N{10 * len(self.lines):04d}{self.blank}{text}"
        text = text.lower() if self.lower else text
        self.lines.append(text + str(self.rng.choice(["", "", " (cut)", " ; next", " "])))

    def number(self, mm: float) -> tuple[str, float]:
        """A number as text, and what it says in mm."""
        scale = 25.4 if self.inch else 1.0
        digits = int(self.rng.choice([4, 5] if self.inch else [3, 4]))
        text = f"{mm / scale:.{digits}f}"
        if self.rng.random() < 0.5:
            text = text.rstrip("0")
        if self.rng.random() < 0.2:
            text = text.replace("0.", "00.", 1) if text.startswith("0.") else text
        return text, float(text) * scale

    def words(self, to: np.ndarray, needed=range(3)) -> list[str]:
        """Axis words to a position, which becomes what they say."""
        found = []
        for i, letter in enumerate("XYZ"):
            if i not in needed and abs(to[i] - self.at[i]) < 1e-9:
                continue
            text, value = self.number(to[i] if self.absolute else to[i] - self.at[i])
            self.at[i] = value if self.absolute else self.at[i] + value
            found.append(letter + text)
        return found

    def modal(self) -> None:
        """Now and then another mode."""
        r = self.rng.random()
        if r < 0.08:
            self.absolute = not self.absolute
            self.write("G90" if self.absolute else "G91")
        elif r < 0.12:
            self.plane = int(self.rng.choice([17, 18, 19]))
            self.write(f"G{self.plane}")
        elif r < 0.16:
            self.absolute_centre = not self.absolute_centre
            self.write("G90.1" if self.absolute_centre else "G91.1")
        elif r < 0.20:
            self.inverse = not self.inverse
            self.write("G93" if self.inverse else "G94", "" if self.inverse else "F250.")
        elif r < 0.23:
            self.write("M8", "(coolant)")
        elif r < 0.25:
            self.lines.append("")

    def code(self, motion: int) -> str:
        if motion == self.motion and self.rng.random() < 0.7:
            return ""
        self.motion = motion
        return f"G{motion}" if self.rng.random() < 0.6 else f"G0{motion}"

    def feed(self, motion: int) -> str:
        return f"F{self.rng.uniform(0.5, 40):.3f}" if self.inverse and motion else ""

    def line(self) -> None:
        size = self.rng.choice([0.5, 5.0, 40.0])
        step = size * self.rng.choice([-1, 1], 3) * self.rng.uniform(0.3, 1.5, 3)
        if not self.diagonal:
            step *= self.rng.random(3) < 0.6
        low, high = np.full(3, 5.0), 1e3 * np.array(TRAVEL) - 5.0
        to = self.at + step
        to = np.where((to < low) | (to > high), self.at - step, to)
        needed = set(np.flatnonzero(np.abs(to - self.at) > 1e-4))
        if not needed:
            return
        motion = 1 if self.diagonal or self.rng.random() < 0.85 else 0
        self.write(self.code(motion), *self.words(to, needed), self.feed(motion))

    def arc(self) -> None:
        u, v, w = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}[self.plane]
        room = 1e3 * np.array(TRAVEL)
        centre = np.array(self.at)
        radius = float(self.rng.choice([1.0, 4.0, 16.0])) * self.rng.uniform(0.5, 2.0)
        begin = self.rng.uniform(0, 2 * math.pi)
        centre[u] -= radius * math.cos(begin)
        centre[v] -= radius * math.sin(begin)
        if any(not radius + 5 < centre[i] < room[i] - radius - 5 for i in (u, v)):
            return
        ccw = self.rng.random() < 0.5
        full = self.rng.random() < 0.15
        turn = (1 if ccw else -1) * (2 * math.pi if full else self.rng.uniform(0.3, 5.9))
        to = np.array(self.at)
        if not full:
            to[u] = centre[u] + radius * math.cos(begin + turn)
            to[v] = centre[v] + radius * math.sin(begin + turn)
        if self.rng.random() < 0.4:
            to[w] = np.clip(to[w] + self.rng.normal(0, 5.0), 5.0, room[w] - 5.0)
        start, motion = np.array(self.at), 3 if ccw else 2
        code = self.code(motion)
        by_radius = not full and 0.5 < abs(turn) % (2 * math.pi) < 5.5 and self.rng.random() < 0.3
        by_radius &= abs(abs(turn) - math.pi) > 0.3
        words = self.words(to, () if full else {u, v, *({w} if to[w] != start[w] else ())})
        if by_radius:
            path = ["R" + self.number(radius if abs(turn) < math.pi else -radius)[0]]
        else:
            path = [
                "IJK"[i] + self.number(centre[i] - (0 if self.absolute_centre else start[i]))[0]
                for i in (u, v)
            ]
        self.write(code, *words, *path, self.feed(motion))
