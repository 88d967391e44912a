"""An R-test: the axes travel small circles, and probes see where a sphere at the tool really is.

The axes are read by their own scales (internal), the sphere by the probes (external); the
difference is the error of the structure in between.  Effects, in SI once `in_si` has been at them:

| effect | adds to what the probes see | keys |
|---|---|---|
| acceleration_crosstalk | E a | matrix (s^2) |
| resonance | E a / (1 - x^2 + 2 i zeta x), x = omega/omega_0 | matrix (s^2), frequency (Hz), zeta |
| harmonic | size cos(n phi) outwards, phi the angle in the plane of the circle | size, order |
| reversal_spike | -size sgn(v) exp(-s/decay), s the way since the reversal | axis or all, these |
| stribeck_friction | -size sgn(v) exp(-abs(v)/speed) | axis or all, these (m, m/s) |
| coulomb_friction | -size tanh(v/speed) | axis or all, these (m, m/s) |
| servo_lag | -T v | axis or all, T (s) |
| scale_interpolation | amplitude sin(2 pi x/period + phase) along the axis | axis and these |
| backlash, lateral_reversal | size/2 sgn(v) along or across the axis | axis, component, size |
| drift | coefficient t along it, t from the start of every run | component, coefficient (m/s) |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .effects import Effect, in_si
from .kinematics import AXES, Array

PLANES = ("XY", "YZ", "ZX")
LEVELS = (0.5, 1.0, 2.0, 3.0, 4.5)
RADIUS = 2e-3
EXTERNAL_SIGMA, INTERNAL_SIGMA = 2.5e-7, 2e-8
OFFSET = 2e-6  # of the sphere between the probes, m, in every run


@dataclass(frozen=True)
class Circle:
    """What the axes do in one run; n rows, X, Y, Z."""

    position: Array
    """(n, 3) m."""
    velocity: Array
    acceleration: Array
    way: Array
    """Sense of travel (n, 3), 0 for an axis at rest."""
    since: Array
    """Way travelled since the last reversal (n, 3), m."""
    time: Array
    """From the start of the run (n,), s."""


def circle(plane: str, sense: int, level: float, turn: Array, size: float = RADIUS) -> Circle:
    """Return one circle of acceleration `level` (m/s^2 at the nominal radius) at angles `turn`."""
    first, second = (AXES.index(c) for c in plane)
    omega = np.sqrt(level / RADIUS)
    place, v = np.zeros((turn.size, 3)), np.zeros((turn.size, 3))
    place[:, first], place[:, second] = np.cos(turn), sense * np.sin(turn)
    v[:, first], v[:, second] = -np.sin(turn), sense * np.cos(turn)
    way, since = np.zeros_like(place), np.full(place.shape, 1e3)
    for axis, wave in ((first, turn), (second, turn - np.pi / 2)):
        # Distance since the last extremum of cos(wave), and where it goes.
        since[:, axis] = size * (1 - np.cos(wave % np.pi))
        way[:, axis] = -np.sign(np.sin(wave)) * (sense if axis == second else 1)
    a = -(omega**2) * size * place
    return Circle(size * place, omega * size * v, a, way, since, turn / omega)


def moved(motion: Circle, effects: Iterable[Effect]) -> Array:
    """Return by how much the sphere is off what the scales read, (n, 3) m."""
    off = np.zeros_like(motion.position)
    for effect in map(in_si, effects):
        axis = effect.get("axis", "")
        axes = [AXES.index(axis)] if axis else list(range(3))
        match effect["effect"]:
            case "acceleration_crosstalk":
                off += motion.acceleration @ np.asarray(effect["matrix"], dtype=float).T
            case "resonance":
                off += resonance(motion, effect)
            case "harmonic":
                off += harmonic(motion, effect)
            case "reversal_spike":
                peak = effect["size"] * np.exp(-motion.since / effect["decay"])
                off[:, axes] -= (motion.way * peak)[:, axes]
            case "drift":
                off[:, AXES.index(effect["component"])] += effect["coefficient"] * motion.time
            case "stribeck_friction":
                held = effect["size"] * np.exp(-np.abs(motion.velocity) / effect["speed"])
                off[:, axes] -= (motion.way * held)[:, axes]
            case "coulomb_friction":
                off[:, axes] -= (effect["size"] * np.tanh(motion.velocity / effect["speed"]))[
                    :, axes
                ]
            case "servo_lag":
                off[:, axes] -= effect["T"] * motion.velocity[:, axes]
            case "scale_interpolation":
                x = motion.position[:, axes]
                phase = 2 * np.pi * x / effect["period"] + effect.get("phase", 0.0)
                off[:, axes] += effect["amplitude"] * np.sin(phase)
            case "backlash" | "lateral_reversal":
                along = AXES.index(effect.get("component", axis))
                off[:, along] += 0.5 * effect["size"] * motion.way[:, axes[0]]
            case name:
                raise ValueError(f"no such effect on a circle: {name!r}")
    return off


def resonance(motion: Circle, effect: Effect) -> Array:
    """What a structure with one mode makes of the acceleration, (n, 3) m: its complex gain times
    a, where i a is the acceleration a quarter of a turn later, -omega v.
    """
    omega = np.sqrt((motion.acceleration**2).sum() / (motion.velocity**2).sum())
    x = omega / (2 * np.pi * effect["frequency"])
    gain = 1 / (1 - x**2 + 2j * effect["zeta"] * x)
    bent = gain.real * motion.acceleration - gain.imag * omega * motion.velocity
    return bent @ np.asarray(effect["matrix"], dtype=float).T


def harmonic(motion: Circle, effect: Effect) -> Array:
    """A circle with bumps, (n, 3) m: outwards by the cosine of a multiple of the angle."""
    first, second = np.flatnonzero(np.ptp(motion.position, axis=0))
    phi = np.arctan2(motion.position[:, second], motion.position[:, first])
    out = motion.position / np.linalg.norm(motion.position, axis=1, keepdims=True)
    return effect["size"] * np.cos(effect["order"] * phi)[:, None] * out


def measure_circles(
    effects: Sequence[Effect],
    rng: np.random.Generator,
    *,
    planes: Sequence[str] = PLANES,
    levels: Sequence[float] = LEVELS,
    samples: int = 60,
    ratio: float | Callable[[float], float] = 1.0,
    turns: float = 1.0,
    noise_factor: float = 1.0,
    skew: ArrayLike | None = None,
) -> dict[str, Array]:
    """Return the columns of data.csv: every plane, both senses, all levels, one circle a run.

    `ratio` is the amplitude over the commanded one, by angular velocity; `skew` what the probes
    read of a displacement beside it.
    """
    found: dict[str, list[Any]] = {n: [] for n in ("run", "plane", "sense", "a_set_m_s2", "t_s")}
    internal, external = [], []
    number = 0
    for plane in planes:
        for sense in (1, -1):
            for level in levels:
                omega = np.sqrt(level / RADIUS)
                turn = 2 * np.pi * turns * (np.arange(samples) + 0.5) / samples
                size = RADIUS * (ratio(omega) if callable(ratio) else ratio)
                motion = circle(plane, sense, level, turn, size)
                read = motion.position
                seen = read + moved(motion, effects) + rng.uniform(-OFFSET, OFFSET, 3)
                if skew is not None:
                    seen = seen + read @ np.asarray(skew).T
                internal.append(read + noise_factor * rng.normal(0, INTERNAL_SIGMA, read.shape))
                external.append(seen + noise_factor * rng.normal(0, EXTERNAL_SIGMA, read.shape))
                columns = (number, plane, sense, level, turn / omega)
                for name, value in zip(found, columns, strict=True):
                    found[name] += list(np.broadcast_to(np.asarray(value), samples))
                number += 1
    table = {name: np.array(values) for name, values in found.items()}
    for kind, values in (("int", internal), ("ext", external)):
        joined = 1e3 * np.concatenate(values)
        table |= {f"{c}_{kind}_mm": joined[:, i] for i, c in enumerate("xyz")}
    return table


def draw_matrix(rng: np.random.Generator, size: float = 1e-6) -> Array:
    """Return a matrix E (3, 3) of in-talk and cross-talk, N(0, size) each, s^2."""
    return size * rng.standard_normal((3, 3))
