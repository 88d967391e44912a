"""A laser frame: beams along edges of the work space, and a diode at the tool that follows them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from .effects import REFERENCE_TEMPERATURE, Effect, Run, checked, frame_drift, in_si, tool_point
from .kinematics import AXES, Array, Machine, rotation_matrix
from .plans import temperatures

# Number of a segment and its ends in the order of the beam, at the lower (-) or upper (+) end of
# the travel of X, Y, Z: low along Y at x-, low along X at y+, up at (x+, y+), high along Y at x+,
# high along X at y-.  The first has seven points, the others eleven.
PATH: tuple[tuple[int, str, str], ...] = (
    (1, "---", "-+-"),
    (2, "-+-", "++-"),
    (5, "++-", "+++"),
    (3, "+++", "+-+"),
    (4, "+-+", "--+"),
)
CONDITIONS = ("T_head_degC", "T_gradient_z_K_per_m", "path_mm")


@dataclass(frozen=True)
class Frame:
    """Where the frame stands since the reference run, and the noise of a change."""

    shift: Array
    """(3,) in m."""
    turned: Array
    """Rotation vector (3,) in rad, about the middle of the beams."""
    sigma: float = 0.45e-6


def corners(machine: Machine) -> list[tuple[int, Array, Array]]:
    """Return number, start and end (axis positions, m) of the segments in the order of the beam."""

    def place(signs: str) -> Array:
        return np.array([machine.travel[i, int(c == "+")] for i, c in enumerate(signs)])

    return [(number, place(a), place(b)) for number, a, b in PATH]


def frame_plan(
    machine: Machine,
    rng: np.random.Generator,
    runs: int = 6,
    step_s: float = 5.0,
    change_s: float = 600.0,
    diode: bool = False,
    cycles: bool = False,
) -> Run:
    """Return runs along the beam, forth and back in turn, 51 points each.

    The head's temperature follows 20 degC + 3 K sin and a random walk of its own; the gradient of
    the air swings by some tenths of a kelvin per metre.  With `diode` the places where the beam
    meets it are recorded, up to 4 mm off its middle: they run across it along every segment, and
    wander from run to run.
    """
    q, segment, path, share, total = [], [], [], [], 0.0
    for number, start, end in corners(machine):
        s = np.linspace(0, 1, 7 if number == 1 else 11)
        length = np.abs(end - start).max()
        q.append(start + s[:, None] * (end - start))
        segment.append(np.full(s.size, number))
        path.append(total + s * length)
        share.append(s)
        total += length
    one = [np.concatenate(part) for part in (q, segment, path, share)]
    order = [np.arange(len(one[0])) if k % 2 == 0 else np.arange(len(one[0]))[::-1]
             for k in range(runs)]  # fmt: skip
    rows = np.concatenate(order)
    places, number, beam, along = (part[rows] for part in one)
    run = np.repeat(np.arange(runs), len(one[0]))
    wait = step_s * rng.uniform(0.8, 1.2, len(rows))
    wait[:: len(one[0])] = change_s
    t = np.cumsum(wait)
    scales, air = temperatures(t, rng, cycles)
    period, phase = rng.uniform(4000, 7000), rng.uniform(0, 2 * np.pi)
    head = REFERENCE_TEMPERATURE + 3 * np.sin(2 * np.pi * t / period + phase)
    head = head + np.cumsum(rng.normal(0, 0.02, t.size))
    swing, rate = rng.uniform(0.2, 0.5), rng.uniform(2000, 5000)
    gradient = rng.uniform(0.1, 0.4) + swing * np.sin(2 * np.pi * t / rate)
    gradient = gradient + rng.normal(0, 0.02, t.size)
    extra = {
        "run": run.astype(float),
        "segment": number.astype(float),
        "path_mm": 1e3 * beam,
        "T_head_degC": head,
        "T_gradient_z_K_per_m": gradient,
    }
    if diode:
        for name in ("psd_u_mm", "psd_v_mm"):
            reach = dict(zip((n for n, *_ in PATH), rng.uniform(-2.5, 2.5, len(PATH)), strict=True))
            wander = rng.uniform(-1.5, 1.5, runs)
            crossed = np.array([reach[n] for n in number])
            extra[name] = crossed * (2 * along - 1) + wander[run]
    moves = np.sign(np.diff(places, axis=0, prepend=places[:1] - 1))
    for k in range(1, len(moves)):
        moves[k] = np.where(moves[k] == 0, moves[k - 1], moves[k])
    return Run(places, moves, t, scales, air, extra=extra)


def frame_readings(
    machine: Machine, run: Run, frame: Frame, effects: Iterable[Effect] = ()
) -> Array:
    """Return u, v (n, 2) m: how far the diode is from the beam, in the two of x, y, z that the beam
    does not run along, against the reference run in which machine and frame were as nominal.

    The frame has moved by its shift (and what effects add) and turned about the middle of the
    beams; a point p of the workpiece frame is R' (p - middle - shift) + middle to it.
    """
    effects = [in_si(e) for e in effects]
    ends = np.array([p for _, a, b in corners(machine) for p in (a, b)])
    middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0)) + machine.tool_offset
    drifted, turning = frame_drift(effects, run.t)
    shift = frame.shift + drifted
    for effect in effects:
        match effect["effect"]:
            case "frame_expansion":
                i = AXES.index(effect["axis"])
                low, high = run.q[:, i].min(), run.q[:, i].max()
                share = (run.q[:, i] - low) / (high - low) - effect.get("held", 0.5)
                warm = run.extra["T_head_degC"] - REFERENCE_TEMPERATURE
                shift[:, i] += effect["coefficient"] * warm * share
            case "refraction":
                s = 1e-3 * run.extra["path_mm"]
                slope = run.extra["T_gradient_z_K_per_m"]
                shift[:, 2] -= 0.5 * effect["coefficient"] * slope * s**2
    r = rotation_matrix(frame.turned) @ turning
    p = tool_point(machine, run, effects, sensor=True)
    off = np.einsum("nji,nj->ni", r, p - middle - shift) + middle - (run.q + machine.tool_offset)
    beam = {n: int(np.argmax(np.abs(b - a))) for n, a, b in corners(machine)}
    across = np.array([[i for i in range(3) if i != beam[int(n)]] for n in run.extra["segment"]])
    seen = np.take_along_axis(off, across, axis=1)
    for effect in effects:
        if effect["effect"] == "psd_linearity":
            x = 1e-3 * run.extra[f"psd_{effect['reading']}_mm"]
            column = "uv".index(effect["reading"])
            seen[:, column] += effect.get("a", 0.0) * x + effect.get("b", 0.0) * x**3
    return seen


def measure_frame(
    machine: Machine,
    run: Run,
    frame: Frame,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> Array:
    """Return u, v (n, 2) m with noise_factor times the frame's noise."""
    ideal = frame_readings(machine, run, frame, checked(effects, "laser_frame"))
    return ideal + noise_factor * frame.sigma * rng.standard_normal(ideal.shape)
