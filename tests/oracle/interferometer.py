"""What a laser interferometer reads along lines of one axis, in plain numpy (SI, exact geometry).

A reflector fixed to the tool, `offset` from the tool point, moves along a line; the interferometer
stands on the table.  With the displacement u = s e + d of the reflector from the middle of the line
(e: direction of the axis, s: commanded distance, d: deviation):

- positioning: b . u - s, b the unit vector of a beam that is a little off the axis (cosine error),
  minus alpha (T_material - 20) s where the instrument compensates, plus k L (T_air - T_air at the
  first row), the dead path L;
- straightness: the components of W' u across the line, W the rotation of the optics; lines of one
  alignment share W, but for the error of the optical square;
- angles: the rotation vector of the tool.

Every reading has a zero of its own in every line.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from .effects import Effect, Run, checked, in_si, tool_vector, twists
from .kinematics import Array, Machine, compose, nominal_machine, rotation_matrix
from .plans import temperatures

UM = 1e-6
REFERENCE_TEMPERATURE = 20.0
POSITION = "meas_position_um"
STRAIGHT = tuple(f"meas_straight_{c}_um" for c in "xyz")
ANGLES = tuple(f"meas_angle_{c}_urad" for c in "abc")
COLUMNS = (POSITION, *STRAIGHT, *ANGLES)
STILL = (0.5, 0.4, 0.6)


@dataclass(frozen=True)
class Line:
    """One set-up as it is planned."""

    axis: int
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the reflector from the tool point, m."""
    at: tuple[float, float, float] = STILL
    """Where the other axes stand, as shares of their travel."""
    dead_path: float = 0.0
    """m."""
    alignment: str = "table"
    reads: tuple[str, ...] = COLUMNS
    """Columns; that of the straightness along the line is left out."""

    def columns(self) -> list[str]:
        """The columns it has."""
        return [c for c in self.reads if c != STRAIGHT[self.axis]]


LINES = (
    Line(0, (0.0, 0.08, 0.05), (0, 0.3, 0.4), 0.25),
    Line(1, (0.0, 0.0, 0.0), (0.35, 0, 0.4), 0.2),
    Line(2, (0.06, 0.0, 0.0), (0.35, 0.3, 0)),
    Line(0, (0.0, -0.05, 0.0), (0, 0.8, 0.75), 0.3),
    Line(1, (0.05, 0.0, 0.04), (0.75, 0, 0.7)),
    Line(2, (0.0, 0.04, 0.0), (0.8, 0.7, 0), 0.1),
)


@dataclass(frozen=True)
class Laser:
    """What is declared of an interferometer, and what is true of its set-ups (SI)."""

    position_sigma: float = 0.2 * UM
    position_sigma_per_m: float = 0.1 * UM
    straightness_sigma: float = 0.4 * UM
    angle_sigma: float = 0.4 * UM
    slope_sigma: float = 0.5 * UM
    laser_u: float = 0.2 * UM
    square_u: float = 1.0 * UM
    expansion: float | None = 11.5 * UM
    expansion_u: float = 0.3 * UM
    material_u: float = 0.05
    dead_path_u: float = 0.9 * UM
    lines: tuple[Line, ...] = LINES
    drawn: dict[str, Array] = field(default_factory=dict)
    """The true errors of the set-ups."""

    def with_errors(self, rng: np.random.Generator) -> Laser:
        """Draw zeros, misalignments and the errors of laser, square and compensation."""
        n = len(self.lines)
        labels = [line.alignment for line in self.lines]
        own = {label: 2e-4 * rng.standard_normal(3) for label in dict.fromkeys(labels)}
        square = self.square_u * rng.standard_normal((n, 3))
        shared = np.array([[labels.count(label) > 1] for label in labels])
        drawn = {
            "zero": 2e-5 * rng.standard_normal((n, 7)),
            # A slope of -g^2/2 by the angle g of the beam, whose rms is about slope_sigma.
            "beam": np.sqrt(self.slope_sigma) * rng.standard_normal((n, 2)) / np.sqrt(2.0),
            "rotation": np.array([own[label] for label in labels]) + shared * square,
            "scale": self.laser_u * rng.standard_normal(1),
            "expansion": self.expansion_u * rng.standard_normal(1),
            "material": self.material_u * rng.standard_normal(1),
            "dead_path": self.dead_path_u * rng.standard_normal(1),
        }
        return Laser(**{**self.__dict__, "drawn": drawn})


@dataclass(frozen=True)
class LinePlan:
    """Rows of the lines: what was commanded, and which line and run each belongs to."""

    run: Run
    line: Array
    number: Array
    """Of the run in its line."""


def line_plan(
    machine: Machine,
    rng: np.random.Generator,
    lines: Sequence[Line] = LINES,
    targets: Sequence[int] = (17, 13, 11),
    runs: int = 2,
    step_s: float = 8.0,
    change_s: float = 600.0,
    cycles: bool = False,
) -> LinePlan:
    """Return the lines one after the other, `runs` of each forth and back over targets at irregular
    distances: within 30 % of a step about equal ones, from 2 to 98 % of the travel.
    """
    low, high = machine.travel.T
    q, direction, line, number, t, clock = [], [], [], [], [], 0.0
    for k, one in enumerate(lines):
        count = targets[one.axis]
        share = 0.02 + 0.96 * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / (count - 1)
        share = np.clip(share, 0.02, 0.98)
        for r in range(runs):
            for sign, places in ((1.0, share), (-1.0, share[::-1])):
                rows = np.tile(np.array(one.at, float), (count, 1))
                rows[:, one.axis] = places
                q.append(low + rows * (high - low))
                ways = np.ones((count, 3))
                ways[:, one.axis] = sign
                direction.append(ways)
                line += [k] * count
                number += [r] * count
                t.append(clock + step_s * np.arange(count))
                clock += step_s * count + 15.0
        clock += change_s
    time = np.concatenate(t)
    scales, air = temperatures(time, rng, cycles)
    drift = 0.5 * np.sin(2 * np.pi * time / 7000.0)
    extra = {"T_material_degC": 20.6 + drift}
    run = Run(np.concatenate(q), np.concatenate(direction), time, scales, air, extra=extra)
    return LinePlan(run, np.array(line, float), np.array(number, float))


def line_readings(
    machine: Machine, plan: LinePlan, laser: Laser, effects: Iterable[Effect] = ()
) -> Array:
    """Return the noise-free readings (n, 7) in the order of COLUMNS, m and rad; nan where a line
    has none.
    """
    effects, run = [in_si(e) for e in effects], plan.run
    shift, turn = twists(machine, run, effects)
    tool = tool_vector(machine, run, effects, sensor=True)
    still = np.zeros_like(shift)
    line = plan.line.astype(int)
    offsets = np.array([one.offset for one in laser.lines])[line]

    def at(point: Array) -> Array:
        return compose(machine, run.q, shift, turn, point)

    seen = at(tool + offsets)
    nominal = compose(
        without_errors(machine), run.q, still, still, np.tile(machine.tool_offset, (len(line), 1))
        + offsets,
    )  # fmt: skip
    origin = at(tool)
    rotation = np.stack([at(tool + unit) - origin for unit in np.eye(3)], axis=2)
    drawn, out = laser.drawn, np.full((len(line), 7), np.nan)
    for k, one in enumerate(laser.lines):
        mine = line == k
        x = run.q[mine, one.axis]
        s = x - 0.5 * (x.min() + x.max())
        e = np.eye(3)[one.axis]
        d = seen[mine] - nominal[mine]
        u = s[:, None] * e + d
        across = [i for i in range(3) if i != one.axis]
        beam = e.copy()
        beam[across] = drawn["beam"][k]
        beam /= np.linalg.norm(beam)
        position = u @ beam - s + drawn["scale"] * s
        if laser.expansion is not None:
            warm = run.extra["T_material_degC"][mine] - REFERENCE_TEMPERATURE
            # The thermometer reads `material` too much, the coefficient is `expansion` too large.
            alpha = laser.expansion + drawn["expansion"]
            position = position - (alpha * warm + laser.expansion * drawn["material"]) * s
        air = run.air[mine]
        position = position + drawn["dead_path"] * one.dead_path * (air - air[0])
        straight = u @ rotation_matrix(drawn["rotation"][k])
        w = rotation_vector(rotation[mine])
        found = np.column_stack([position, straight, w]) + drawn["zero"][k]
        has = np.isin(COLUMNS, one.columns())
        out[mine] = np.where(has, found, np.nan)
    return out


def without_errors(machine: Machine) -> Machine:
    """Return the machine without squareness and error motions."""
    return nominal_machine(machine.chain, machine.travel, machine.tool_offset)


def rotation_vector(r: Array) -> Array:
    """Return the rotation vectors (n, 3) of rotations (n, 3, 3) below 90 degrees."""
    v = 0.5 * np.stack(
        [r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    return v * np.where(sine > 0, np.arcsin(sine) / np.maximum(sine, 1e-300), 1.0)


def laser_noise(laser: Laser, plan: LinePlan) -> Array:
    """Return the standard deviation of every reading (n, 7)."""
    line, sigma = plan.line.astype(int), np.empty((len(plan.line), 7))
    sigma[:, 1:4], sigma[:, 4:] = laser.straightness_sigma, laser.angle_sigma
    for k, one in enumerate(laser.lines):
        mine = line == k
        x = plan.run.q[mine, one.axis]
        air = one.dead_path + np.abs(x - x[0])
        sigma[mine, 0] = laser.position_sigma + laser.position_sigma_per_m * air
    return sigma


def measure_lines(
    machine: Machine,
    plan: LinePlan,
    laser: Laser,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
    noise_factor: float = 1.0,
) -> Array:
    """Return the readings (n, 7) with noise_factor times the noise of the laser."""
    ideal = line_readings(machine, plan, laser, checked(effects, "interferometer"))
    return ideal + noise_factor * laser_noise(laser, plan) * rng.standard_normal(ideal.shape)


def reading_columns(readings: Array) -> dict[str, Array]:
    """Return the columns of readings that any line has, um and urad."""
    return {
        name: 1e6 * readings[:, i]
        for i, name in enumerate(COLUMNS)
        if np.isfinite(readings[:, i]).any()
    }


def instrument_lines(laser: Laser) -> list[str]:
    """Return the lines of [instrument] and its set-ups."""

    def number(value: float) -> str:
        return f"{value:.10g}"

    keys = {
        "position_sigma_um": laser.position_sigma / UM,
        "position_sigma_um_per_m": laser.position_sigma_per_m / UM,
        "straightness_sigma_um": laser.straightness_sigma / UM,
        "angle_sigma_urad": laser.angle_sigma / UM,
        "slope_sigma_um_per_m": laser.slope_sigma / UM,
        "laser_u_um_per_m": laser.laser_u / UM,
        "square_u_urad": laser.square_u / UM,
        "dead_path_u_um_per_m_K": laser.dead_path_u / UM,
    }
    if laser.expansion is not None:
        keys |= {
            "expansion_um_per_m_K": laser.expansion / UM,
            "expansion_u_um_per_m_K": laser.expansion_u / UM,
            "material_u_K": laser.material_u,
        }
    out = [f"{key} = {number(value)}" for key, value in keys.items()]
    for k, one in enumerate(laser.lines):
        offset = ", ".join(number(1e3 * v) for v in one.offset)
        out += [
            "[[instrument.line]]",
            f"line = {k}",
            f"offset_mm = [{offset}]",
            f"dead_path_mm = {number(1e3 * one.dead_path)}",
            f'alignment = "{one.alignment}"',
        ]
    return out
