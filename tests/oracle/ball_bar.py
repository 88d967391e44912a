"""What a double ball bar reads on circles and arcs of linear axes (SI, exact geometry).

Effects of the motion are those of r_test.py; all others act on the joints (effects.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .effects import Effect, Run, checked, tool_point
from .kinematics import AXES, Array, Machine
from .r_test import Circle, moved

UM = 1e-6
ARCS = (("XY", 0.0, 360.0), ("YZ", -20.0, 200.0), ("ZX", -110.0, 110.0))
"""Planes with the ends of their arcs, degrees from the first axis: a table is in the way below."""
OF_MOTION = (
    "servo_lag",
    "reversal_spike",
    "stribeck_friction",
    "coulomb_friction",
    "acceleration_crosstalk",
)


@dataclass(frozen=True)
class BallBar:
    """One-sigma noise of a bar, of its calibrated lengths, and of where its ball stands."""

    sigma: float = 0.3 * UM
    length_u: float = 0.5 * UM
    scatter: float = 20 * UM
    """Of each coordinate of the ball about the commanded centre, at every place of it."""


@dataclass(frozen=True)
class BarPlan:
    """Runs of a ball bar; n rows."""

    run: Run
    number: NDArray[np.int64]
    """Number of the run (n,)."""
    length: Array
    """Nominal length (n,), m."""
    feed: Array
    """Along the path (n,), m/s."""
    ball: Array
    """Commanded place of the ball in the workpiece frame (n, 3), m."""
    motion: Circle
    """What the axes do."""


def bar_plan(
    machine: Machine,
    rng: np.random.Generator,
    lengths: Sequence[float] = (0.15, 0.1),
    feeds: Sequence[float] = (1000.0, 4000.0),
    step_deg: float = 5.0,
    arcs: Sequence[tuple[str, float, float]] = ARCS,
) -> BarPlan:
    """Return one place of the ball for every length: all arcs, each in both senses.

    Feeds are in mm/min, one for every length. An axis at rest was reached from below. Rows are in
    the order of travel; no row is at a reversal.
    """
    parts: list[tuple[Array, Array, Array, Array, Array]] = []
    columns: dict[str, list[Array]] = {n: [] for n in ("number", "length", "feed", "ball")}
    for length, feed in zip(lengths, feeds, strict=True):
        low, high = machine.travel.T
        centre = rng.uniform(low + 1.01 * length, high - 1.01 * length)
        speed = feed * 1e-3 / 60
        for plane, start, end in arcs:
            for sense in (1, -1):
                turn = np.deg2rad(np.arange(start + 0.5 * step_deg, end, step_deg))[::sense]
                i, j = (AXES.index(c) for c in plane)
                place = np.tile(centre, (turn.size, 1))
                v, a = np.zeros_like(place), np.zeros_like(place)
                way, since = np.ones_like(place), np.full(place.shape, 1e3)
                omega = sense * speed / length
                for axis, wave, slope in ((i, np.cos(turn), -np.sin(turn)),
                                          (j, np.sin(turn), np.cos(turn))):  # fmt: skip
                    place[:, axis] += length * wave
                    v[:, axis], a[:, axis] = length * omega * slope, -length * omega**2 * wave
                    way[:, axis] = np.sign(sense * slope)
                    # From the extremum that the axis has left: where its wave was -way.
                    since[:, axis] = length * (1 + way[:, axis] * wave)
                parts.append((place, v, a, way, since))
                n = turn.size
                row = (len(parts) - 1, length, speed, centre + machine.tool_offset)
                for name, value in zip(columns, row, strict=True):
                    columns[name].append(np.tile(value, (n, 1)) if name == "ball"
                                         else np.full(n, value))  # fmt: skip
    place, v, a, way, since = (np.concatenate(p) for p in zip(*parts, strict=True))
    number, length, feed, ball = (np.concatenate(c) for c in columns.values())
    n = len(number)
    t = np.arange(n, dtype=float)
    run = Run(place, way, t, np.full((n, 3), 20.0), np.full(n, 20.0))
    return BarPlan(run, number, length, feed, ball, Circle(place, v, a, way, since, t))


def measure_bar(
    machine: Machine,
    plan: BarPlan,
    bar: BallBar,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> tuple[Array, dict[str, Array]]:
    """Return the readings (n,), m: |tool - ball| - nominal length, and the true lengths and balls.

    True length = nominal + N(0, length_u), one for each nominal length; true ball = commanded +
    N(0, scatter) at each of its places.
    """
    effects = checked(effects, "double_ball_bar")
    tool = tool_point(machine, plan.run, effects)
    tool = tool + moved(plan.motion, [e for e in effects if e["effect"] in OF_MOTION])
    known, which = np.unique(plan.length, return_inverse=True)
    place = np.unique(plan.ball, axis=0, return_inverse=True)[1].ravel()
    off = bar.scatter * rng.standard_normal((place.max() + 1, 3))
    longer = bar.length_u * rng.standard_normal(known.size)
    far = np.linalg.norm(tool - plan.ball - off[place], axis=1)
    read = far - plan.length - longer[which]
    noise = noise_factor * bar.sigma * rng.standard_normal(read.size)
    return read + noise, {"ball": off, "length": longer}
