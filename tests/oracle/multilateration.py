"""Ranges alone, from several stations one after the other: sequential multilateration (SI).

A tracking interferometer follows a reflector on the tool and reads changes of distance: what it
reads is the distance less a dead path that nobody knows.  The machine repeats its programme for
every station, with one reflector offset after the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .effects import Effect, Run, bend_readings, checked, tool_point
from .kinematics import Array, Machine
from .plans import tracker_plan

UM = 1e-6
PLACES = np.array([[-0.5, -0.6, -0.3], [1.5, -0.5, 0.1], [1.4, 1.6, 0.9], [-0.4, 1.5, 2.0]])
"""Of four stations, in units of the travel."""
OFFSETS = np.array([[0.0, 0.0, 0.0], [0.16, 0.04, 0.05], [-0.05, 0.15, -0.12]])
"""Of three reflectors from the tool point of the machine, m; not on one line with it."""


@dataclass(frozen=True)
class Stations:
    """Where an interferometer stood, and its noise."""

    places: Array
    """In the workpiece frame (stations, 3), m."""
    dead_paths: Array
    """Distance at which each reads zero (stations,), m."""
    declared: Array
    """Approximate places that are declared (stations, 3), m."""
    tools: Array
    """Tool offsets (tools, 3), m."""
    station: Array
    """Index of the station of every row (n,)."""
    tool: Array
    """Index of the tool of every row (n,)."""
    sigma: float = 0.2 * UM
    sigma_per_m: float = 0.3 * UM

    @property
    def names(self) -> list[str]:
        return [f"S{i + 1}" for i in range(len(self.places))]

    @property
    def tool_names(self) -> list[str]:
        return [f"T{i + 1}" for i in range(len(self.tools))]


def lateration_plan(
    machine: Machine,
    rng: np.random.Generator,
    shape: Sequence[int] = (5, 5, 4),
    stations: int = 4,
    tools: int = 3,
    step_s: float = 4.0,
    cycles: bool = False,
) -> tuple[Run, Array, Array]:
    """Return the run and the index of station and tool of every row: a grid for every station and
    tool, 100 points for each of three tools by default.
    """
    run = tracker_plan(machine, rng, shape, stations * tools, step_s=step_s, cycles=cycles)
    each = int(np.prod(shape))
    part = np.repeat(np.arange(stations * tools), each)
    return run, part // tools, part % tools


def draw_stations(
    machine: Machine,
    rng: np.random.Generator,
    station: Array,
    tool: Array,
    scatter: float = 0.05,
    **noise: float,
) -> Stations:
    """Return stations about PLACES, with declared places that are `scatter` (m) off."""
    count = int(station.max()) + 1
    low, high = machine.travel.T
    places = low + PLACES[:count] * (high - low) + 0.05 * rng.standard_normal((count, 3))
    declared = np.round(places + scatter * rng.standard_normal((count, 3)), 2)
    dead = rng.uniform(0.1, 0.5, count)
    tools = machine.tool_offset + OFFSETS[: int(tool.max()) + 1]
    return Stations(places, dead, declared, tools, station, tool, **noise)


def reflector(
    machine: Machine, run: Run, tools: Array, tool: Array, effects: Iterable[Effect] = ()
) -> Array:
    """Return the place of the reflector of every row (n, 3), m."""
    effects = list(effects)
    p = np.empty((len(tool), 3))
    for i, offset in enumerate(tools):
        own = tool_point(replace(machine, tool_offset=offset), run, effects)
        p[tool == i] = own[tool == i]
    return p


def range_noise(distance: Array, sigma: float, sigma_per_m: float) -> Array:
    """Return the standard deviation of distances, both parts in quadrature."""
    return np.hypot(sigma, sigma_per_m * distance)


def measure_ranges(
    machine: Machine,
    run: Run,
    at: Stations,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> Array:
    """Return the ranges that are read (n,), m, with noise_factor times the noise."""
    effects = checked(effects, "multilateration")
    p = reflector(machine, run, at.tools, at.tool, effects)
    distance = np.linalg.norm(p - at.places[at.station], axis=1)
    bent = bend_readings(np.stack([distance, 0 * distance, 0 * distance], axis=1), effects)[:, 0]
    noise = range_noise(distance, at.sigma, at.sigma_per_m) * rng.standard_normal(len(p))
    return bent - at.dead_paths[at.station] + noise_factor * noise
