"""What the probe of a machine finds on the faces of a step gauge (SI, exact geometry)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .effects import Effect, Run, checked, tool_point
from .kinematics import Array, Machine

UM = 1e-6
DIRECTIONS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1))
PITCH = 0.02
"""From one step of the gauge to the next, m; a step is half as long."""


@dataclass(frozen=True)
class GaugeProbe:
    """A probe and a step gauge: the stylus, and one-sigma errors."""

    sigma: float = 0.4 * UM
    """Of a contact."""
    face_u: float = 0.3 * UM
    """Of the calibrated position of each face."""
    stylus: float = 3e-3
    """Effective radius, m."""
    stylus_u: float = 0.5 * UM
    scatter: float = 1e-3
    """Of the alignment of the gauge, rad."""


@dataclass(frozen=True)
class GaugePlan:
    """Contacts with a step gauge; n rows."""

    run: Run
    """At the nominal contacts; an axis at rest was reached from below."""
    setup: NDArray[np.int64]
    face: NDArray[np.int64]
    """Even faces look against the sense of rising positions, odd ones along it."""
    way: Array
    """Sense of the approach along the gauge (n,), 1 or -1."""
    direction: Array
    """Nominal direction of the gauge (n, 3)."""
    origin: Array
    """Nominal place of its zero in the workpiece frame (n, 3), m."""
    turn: NDArray[np.int64]
    """Which of the passes along the gauge (n,)."""


def positions_of(face: NDArray[np.int64]) -> Array:
    """Nominal positions of faces along the gauge, m."""
    return 0.5 * PITCH * face


def gauge_plan(
    machine: Machine,
    rng: np.random.Generator,
    directions: Sequence[tuple[int, int, int]] = DIRECTIONS,
    steps: int = 13,
    repeats: int = 2,
    stylus: float = GaugeProbe.stylus,
) -> GaugePlan:
    """Return one set-up per direction: all faces forth or, with `repeats`, also back and so on."""
    low, high = machine.travel.T
    faces = np.arange(2 * steps)
    along = np.concatenate([faces[:: 1 - 2 * (k % 2)] for k in range(repeats)])
    passes = np.repeat(np.arange(repeats), faces.size)
    columns: list[list[Array]] = [[] for _ in range(6)]
    for k, d in enumerate(np.array(directions, float)):
        d = d / np.linalg.norm(d)
        reach = positions_of(faces[-1:])[0] * d
        start = rng.uniform(low + 0.01, high - 0.01 - np.maximum(reach, 0.0))
        way = np.where(along % 2 == 0, 1.0, -1.0)
        q = start + (positions_of(along) - way * stylus)[:, None] * d
        turn = np.where(np.abs(d) > 1e-9, way[:, None] * np.sign(d), 1.0)
        parts = (q, turn, np.full(along.size, k), along, way, np.tile(start, (along.size, 1)))
        for column, part in zip(columns, parts, strict=True):
            column.append(part)
    q, turn, setup, face, way, start = (np.concatenate(c) for c in columns)
    n = len(q)
    t = 4.0 * np.arange(n)
    run = Run(q, turn, t, np.full((n, 3), 20.0), np.full(n, 20.0))
    d = np.array(directions, float)[setup]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    passes = np.tile(passes, len(directions))
    return GaugePlan(run, setup, face, way, d, start + machine.tool_offset, passes)


def measure_gauge(
    machine: Machine,
    plan: GaugePlan,
    probe: GaugeProbe,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> tuple[Array, Array]:
    """Return positions at the contacts (n, 3) and calibrated positions of the faces (f,), m.

    The tip of true radius r = stylus + N(0, stylus_u) touches where the tool point is at
    s - way r along the true gauge, whose direction is N(0, scatter) beside the nominal one; the
    certificate is off the faces by N(0, face_u), the contact by N(0, sigma) along the approach.
    """
    effects = checked(effects, "touch_probe")
    faces = np.arange(plan.face.max() + 1)
    tilt = probe.scatter * rng.standard_normal((plan.setup.max() + 1, 3))[plan.setup]
    d = plan.direction + np.cross(tilt, plan.direction)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    r = probe.stylus + probe.stylus_u * rng.standard_normal()
    goal = positions_of(plan.face) - plan.way * r
    q = plan.run.q.copy()
    for _ in range(30):
        off = goal - np.einsum(
            "ni,ni->n", tool_point(machine, plan.run.at(q), effects) - plan.origin, d
        )
        q = q + off[:, None] * plan.direction
        if np.abs(off).max() < 1e-13:
            break
    else:
        raise RuntimeError(f"the tip is still {np.abs(off).max():.1e} m off its face")
    certificate = positions_of(faces) + noise_factor * probe.face_u * rng.standard_normal(
        len(faces)
    )
    off = noise_factor * probe.sigma * rng.standard_normal(len(q))
    return q + off[:, None] * plan.direction, certificate
