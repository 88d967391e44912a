"""Measurement plans, temperature histories and drawn artefacts of synthetic cases (SI)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .effects import Run
from .kinematics import Arm, Array, Machine

CHECK_DURATION = 7200.0  # s
# Directions of the beam: the six face diagonals, two of them once more low down, and the four
# body diagonals.  The bool asks for a place low in the volume.
BEAMS: tuple[tuple[tuple[int, int, int], bool], ...] = (
    ((1, 1, 0), False),
    ((1, -1, 0), False),
    ((1, 0, 1), False),
    ((1, 0, -1), False),
    ((0, 1, 1), False),
    ((0, 1, -1), False),
    ((1, 1, 0), True),
    ((1, -1, 0), True),
    ((1, 1, 1), False),
    ((1, 1, -1), False),
    ((1, -1, 1), False),
    ((-1, 1, 1), False),
)


def temperatures(t: Array, rng: np.random.Generator, cycles: bool = False) -> tuple[Array, Array]:
    """Return the temperatures of the three scales (n, 3) and of the air (n,) at times t, degC.

    A scale warms up exponentially by about 2, 1.2 or 0.8 K and wanders by some 0.04 K; the air
    swings by 0.3 K about 20.3 degC with a period of 90 minutes.  All three then look much alike,
    and like time itself: a plan that has to tell them apart exercises the axes in turn.  With
    `cycles` every scale swings by about 1 K, in three periods of its own between 20 minutes and two
    hours.
    """
    if cycles:
        period = np.exp(rng.uniform(np.log(1200), np.log(7200), (3, 3)))
        phase = rng.uniform(0, 2 * np.pi, (3, 3))
        waves = np.sin(2 * np.pi * t[:, None, None] / period + phase)
        air = 20.3 + 0.3 * np.sin(2 * np.pi * t / 5400)
        return 20 + 0.8 * waves.sum(axis=2), air
    rise = np.array([2.0, 1.2, 0.8]) * rng.uniform(0.9, 1.1, 3)
    tau = rng.uniform(3000, 4500, 3)
    swing, period = 0.045 * rng.uniform(0.7, 1.3, 3), rng.uniform(700, 1100, 3)
    phase = rng.uniform(0, 2 * np.pi, 3)
    start = 20 + 0.05 * rng.standard_normal(3)
    time = t[:, None]
    scales = start - rise * np.expm1(-time / tau)
    scales = scales + swing * np.sin(2 * np.pi * time / period + phase)
    return scales, 20.3 + 0.3 * np.sin(2 * np.pi * t / 5400)


def travel_directions(nodes: Array) -> Array:
    """Return the sign of every axis's last move along nodes (n, 3); +1 before the first one."""
    moves = np.sign(np.diff(nodes, axis=0, prepend=nodes[:1] - 1))
    for k in range(1, len(moves)):
        moves[k] = np.where(moves[k] == 0, moves[k - 1], moves[k])
    return moves


def tracker_plan(
    machine: Machine,
    rng: np.random.Generator,
    shape: Sequence[int] = (9, 7, 5),
    passes: int = 2,
    margin: float = 0.01,
    jitter: float = 0.0075,
    step_s: float = 8.0,
    cycles: bool = False,
) -> Run:
    """Return a serpentine grid, forth and back in turn: 9 x 7 x 5 twice are 630 points.

    X runs fastest, then Y, then Z.  Nodes lie from margin to 1 - margin of the travel, points
    within +/- jitter of the travel about them; step_s +/- 20 % from point to point.
    """
    nx, ny, nz = shape
    grid: list[tuple[int, int, int]] = []
    x, y = list(range(nx)), list(range(ny))
    for k in range(nz):
        for j in y:
            grid += [(i, j, k) for i in x]
            x = x[::-1]
        y = y[::-1]
    path = np.array([p for n in range(passes) for p in (grid if n % 2 == 0 else grid[::-1])])
    low, high = machine.travel.T
    share = margin + (1 - 2 * margin) * path / np.maximum(np.array(shape) - 1, 1)
    share = share + jitter * rng.uniform(-1, 1, share.shape)
    t = np.cumsum(step_s * rng.uniform(0.8, 1.2, len(path)))
    scales, air = temperatures(t, rng, cycles)
    direction = travel_directions(path.astype(float))
    return Run(low + share * (high - low), direction, t, scales, air)


def check_plan(machine: Machine, rng: np.random.Generator, n: int = 400) -> Run:
    """Return n random points within 2-98 % of the travel, random directions, ordered in time."""
    low, high = machine.travel.T
    t = np.sort(rng.uniform(0, CHECK_DURATION, n))
    scales, air = temperatures(t, rng)
    q = low + rng.uniform(0.02, 0.98, (n, 3)) * (high - low)
    return Run(q, rng.choice([-1.0, 1.0], (n, 3)), t, scales, air)


CONDITIONS = ("payload_kg", "speed_rpm", "approach_rad", "coolant_bar", "humidity_percent")


def conditions(
    runs: Sequence[Run], rng: np.random.Generator, wanted: Sequence[str]
) -> list[dict[str, Array]]:
    """Return further columns for runs of one machine, the first of which is the measurement.

    payload_kg: 0, 50 or 100, the same for 15 minutes; speed_rpm: 0 to 12000, the same for a
    fifteenth of the measurement, and one programme for all runs; approach_rad: from one of eight
    sides; coolant_bar: 0 to 40, the same for 10 minutes; humidity_percent: it goes slowly up and
    down.
    """
    if unknown := set(wanted) - set(CONDITIONS):
        raise ValueError(f"unknown conditions {', '.join(sorted(unknown))}")
    end = float(runs[0].t.max())
    loads = rng.permutation(np.tile([0.0, 50.0, 100.0], 8))
    speeds = 1e3 * rng.integers(0, 13, 15)
    (own,) = rng.spawn(1)
    pressures, phases = own.uniform(0, 40, 100), own.uniform(0, 2 * np.pi, 2)
    found = []
    for run in runs:
        late = np.minimum(15 * run.t / end, 14).astype(int)
        every = {
            "payload_kg": loads[(run.t / 900).astype(int) % len(loads)],
            "speed_rpm": speeds[late].astype(float),
            "approach_rad": np.pi / 4 * rng.integers(0, 8, run.t.size),
            "coolant_bar": pressures[(run.t / 600).astype(int) % len(pressures)],
            "humidity_percent": 45.0
            + sum(
                size * np.sin(2 * np.pi * times * run.t / end + phase)
                for size, times, phase in zip((6.0, 3.0), (0.7, 1.9), phases, strict=True)
            ),
        }
        found.append({name: every[name] for name in wanted})
    return found


@dataclass(frozen=True)
class BallPlan:
    """Where a ball array stands and when its balls are probed."""

    balls: Array
    """True ball centres in the artefact's frame (b, 3), m."""
    rotation: Array
    """Of the artefact in the workpiece frame, (pose, 3, 3)."""
    origin: Array
    """Of the artefact's frame in the workpiece frame, (pose, 3) m."""
    run: Run
    """Nominal axis positions, pose after pose, ball after ball."""


def draw_artefact(
    rng: np.random.Generator,
    length: float,
    n: int = 11,
    zigzag: tuple[float, float] = (0.015, 0.015),
    scatter: float = 5e-5,
) -> Array:
    """Return n balls along x, alternating by +/- zigzag: y from ball to ball, z in pairs."""
    k = np.arange(n)
    y = zigzag[0] * (2 * (k % 2) - 1)
    z = zigzag[1] * (2 * (k // 2 % 2) - 1)
    ideal = np.stack([np.linspace(0, length, n), y, z], axis=1)
    return ideal + scatter * rng.standard_normal((n, 3))


def beam_rotation(direction: Sequence[float]) -> Array:
    """Return the rotation that lays the artefact's x along a direction, its y kept horizontal."""
    x = np.asarray(direction, dtype=float)
    x = x / np.sqrt(x @ x)
    y = np.array([-x[1], x[0], 0.0]) / np.hypot(x[0], x[1])
    z = np.cross(x, y)
    return np.array([x, y, z], dtype=float).T


def ball_plan(
    machine: Machine,
    rng: np.random.Generator,
    length: float | None = None,
    n_balls: int = 11,
    zigzag: tuple[float, float] = (0.015, 0.015),
    poses: Sequence[tuple[Sequence[float], bool]] = BEAMS,
    repeats: int = 2,
    step_s: float = 21.0,
    change_s: float = 240.0,
    cycles: bool = False,
) -> BallPlan:
    """Return an artefact of length 0.75 x the shortest travel in 12 places, each taken twice.

    The places are drawn uniformly among those that keep every ball 5 % (at least 25 mm) within
    the travel; a low one stands at the lower end in Z.
    """
    low, high = machine.travel.T
    if length is None:
        length = 0.75 * float((high - low).min())
    balls = draw_artefact(rng, length, n_balls, zigzag)
    inset = np.maximum(0.05 * (high - low), 0.025)
    rotations, origins, nodes = [], [], []
    for direction, stands_low in poses:
        r = beam_rotation(direction)
        reach = balls @ r.T
        lowest, highest = low + inset - reach.min(axis=0), high - inset - reach.max(axis=0)
        if np.any(lowest > highest):
            raise ValueError(f"a beam of {length} m along {direction} does not fit into the travel")
        q0 = rng.uniform(lowest, highest)
        if stands_low:
            q0[2] = lowest[2]
        rotations.append(r)
        origins.append(q0 + machine.tool_offset)
        nodes.append(q0 + reach)
    m, b = len(poses) * repeats, n_balls
    q = np.tile(np.concatenate(nodes), (repeats, 1))
    wait = np.full(m * b, step_s)
    wait[::b] = change_s
    t = np.cumsum(wait + 3 * rng.uniform(-1, 1, m * b)) + step_s
    scales, air = temperatures(t, rng, cycles)
    pose, ball = np.repeat(np.arange(m), b), np.tile(np.arange(b), m)
    run = Run(q, travel_directions(q), t, scales, air, pose, ball)
    return BallPlan(
        balls, np.tile(np.array(rotations), (repeats, 1, 1)), np.tile(origins, (repeats, 1)), run
    )


@dataclass(frozen=True)
class ArmPlan:
    """Joint values that an arm is sent to, with the reflectors and the tracker's frame."""

    q: Array
    """Commanded joint values (n, j) in rad."""
    t: Array
    """Time (n,) in s."""
    tool: Array
    """Reflectors in the last frame (m, 3), m."""
    base: Array
    """Fixed reflectors in the base's frame (m, 3), m."""
    rotation: Array
    """Of the base in the tracker's frame, (3, 3)."""
    origin: Array
    """Of the base in the tracker's frame, (3,) m."""


def example_arm() -> Arm:
    """Return a small six-axis arm with a reach of 0.6 m, without errors."""
    quarter = np.pi / 2
    return Arm(
        a=np.array([0, 0.27, 0.07, 0, 0, 0]),
        alpha=np.array([-quarter, 0, -quarter, quarter, -quarter, 0]),
        d=np.array([0.29, 0, 0, 0.302, 0, 0.072]),
        theta=np.array([0, -quarter, 0, 0, 0, np.pi]),
    )


def arm_plan(
    arm: Arm,
    rng: np.random.Generator,
    n: int = 300,
    reflectors: int = 3,
    fixed: int = 3,
    span: float = 1.5,
    step_s: float = 12.0,
) -> ArmPlan:
    """Return n random poses (each joint uniform within +/- span rad) and drawn reflectors."""
    tool = rng.uniform(-1, 1, (reflectors, 3)) * 0.1 + np.array([0, 0, 0.05])
    angle = rng.uniform(-np.pi, np.pi) + 2 * np.pi * np.arange(fixed) / max(fixed, 1)
    base = np.stack([0.4 * np.cos(angle), 0.4 * np.sin(angle), np.zeros(fixed)], axis=1)
    azimuth = rng.uniform(-np.pi, np.pi)
    origin = np.array([2.5 * np.cos(azimuth), 2.5 * np.sin(azimuth), -0.5])
    c, s = np.cos(rng.uniform(-np.pi, np.pi) + np.array([0.0, -np.pi / 2]))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    t = np.cumsum(step_s * rng.uniform(0.8, 1.2, n))
    q = rng.uniform(-span, span, (n, arm.joints))
    return ArmPlan(q, t, tool, base, rotation, origin)
