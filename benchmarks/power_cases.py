"""The cases of power.py: a table of effects by instrument, and how a data set of each is made.

Every row states the instruments that can measure an effect, the unit of its size, and how it is
drawn: the description for the oracle of the tests, and the name in vcal.
"""

from __future__ import annotations

import math
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from oracle import (
    FRAME_SMOOTH,
    FRAME_TABLE,
    TABLE,
    draw_matrix,
    make_case,
    with_other_zero,
    with_strays,
)
from oracle.kinematics import SQUARENESS
from oracle.study import FRAME_SIZES, SIZES, Case

INSTRUMENTS = (
    "laser_tracker", "multilateration", "ball_array", "r_test", "laser_frame", "reflectors",
    "double_ball_bar", "touch_probe", "interferometer",
)  # fmt: skip
"""Of these, multilateration is a laser tracker that reads ranges alone."""
ON_MACHINE = ("laser_tracker", "ball_array", "laser_frame")
LATERATED = ("multilateration",)
CHAINS = ("w X b Y Z t", "w Y b X Z t", "w b X Y Z t")
ARM_POSES = 150
DURATION_S = {"laser_tracker": 5000.0, "multilateration": 4800.0, "ball_array": 10000.0,
              "laser_frame": 4800.0, "reflectors": 12.0 * ARM_POSES,
              "interferometer": 6500.0}  # fmt: skip
JOINTS = 6
STRAYS = 0.02
"""Share of outliers among the readings of a set with outliers."""
ZEROS = (5.0, 10.0, -8.0)
"""Errors of all temperatures of a set whose zero of temperature is not 20 degC, in turn, K."""
THERMAL = ("scale_growth", "thermal_offset", "thermal_tilt", "squareness_temperature")
"""Effects with a zero of temperature."""
OWN_NOISE = 20_018
"""First seed whose sets with an effect have independent noise. With a smaller seed all sets of an
instrument have the same noise, so that a pattern in it that resembles an effect is in all of them.
"""

Rng = np.random.Generator


@dataclass(frozen=True)
class World:
    """The quantities that are the same for all sizes of one set."""

    instrument: str
    seed: int
    chain: str
    travel: tuple[float, ...]
    """m."""

    @property
    def duration(self) -> float:
        """Approximate duration of the measurement, s."""
        return DURATION_S[self.instrument]

    def moment(self, rng: Rng) -> float:
        """A random time in the middle half of the measurement, s."""
        return float(self.duration * rng.uniform(0.25, 0.75))

    def carries(self, axis: str) -> bool:
        """Whether the axis is in the tool branch of the chain."""
        names = self.chain.split()
        return names.index(axis) > names.index("b")


@dataclass(frozen=True)
class Term:
    """One effect of one size: its description for the oracle, and its right name."""

    effects: tuple[Mapping[str, Any], ...]
    """For the oracle."""
    key: str = ""
    """Name and placement in vcal; empty for an error that no catalogue holds."""
    parameters: tuple[str, ...] = ()
    """Parameters of the component, where a placement has several components."""
    shape: Mapping[str, float] | None = None
    """True values of the parameters that enter non-linearly, SI."""
    covariates: tuple[str, ...] = ()
    """Covariates of which an *unexplained* should name one first."""
    declared: tuple[Mapping[str, Any], ...] = ()
    """Rows of [[model.effect]] that declare other effects of the set."""


Sized = Callable[[float], Term]


@dataclass(frozen=True)
class Kind:
    """A row of the table."""

    name: str
    unit: str
    large: float
    """A large size, in that unit. Where it is below the detection limit, the plan does not detect
    the effect, and no set is made.
    """
    draw: Callable[[Rng, World], Sized]
    """Draws everything but the size."""
    instruments: tuple[str, ...]
    recording: tuple[str, ...] = ()
    plan: Mapping[str, Any] | None = None
    cycles: bool = False
    """Whether the axes are exercised in turn, so that their temperatures differ from each other and
    from time. The kind is then also tried while the machine only warms up.
    """
    centred: bool = False
    """Whether positions count from the middle of the travel. An error in proportion to the position
    otherwise contains a translation, which other effects can explain.
    """


# --- draws ---------------------------------------------------------------------------------------


def _axis(rng: Rng, letters: str = "XYZ") -> str:
    return letters[rng.integers(len(letters))]


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _unit(rng: Rng, size: int = 3) -> np.ndarray:
    v = rng.standard_normal(size)
    return v / np.linalg.norm(v)


def _grows(
    effect: Mapping[str, Any],
    sizes: Mapping[str, Any],
    key: str = "",
    parameters: tuple[str, ...] = (),
    shape: Mapping[str, float] | None = None,
    covariates: tuple[str, ...] = (),
) -> Sized:
    """The term of every size. `sizes` are the keys of the effect that are in proportion to it, with
    their factors; the other arguments are those of `Term`.
    """

    def sized(size: float) -> Term:
        grown = {name: factor * size for name, factor in sizes.items()}
        return Term(({**effect, **grown},), key, parameters, shape, covariates)

    return sized


def _on_axis(
    name: str, key: str, components: str, named: str = "", **fixed: Callable[[Rng, World], float]
) -> Callable[[Rng, World], Sized]:
    """An effect on an axis. `components` is "=" for the direction of the axis, "x" for those across
    it, or the letters to choose from; `named` is the prefix of the parameter in vcal.
    """

    def draw(rng: Rng, world: World) -> Sized:
        axis, sign = _axis(rng), _sign(rng)
        letters = {"=": axis, "x": "XYZ".replace(axis, "")}.get(components, components)
        if axis == "Z":  # the tool lies on the axis: a roll displaces nothing
            letters = letters.replace("C", "")
        component = _axis(rng, letters)
        more = {k: f(rng, world) for k, f in fixed.items()}
        shape = {k.removesuffix("_s"): v for k, v in more.items() if k == "tau_s"}
        parameters = (f"{named}_E{component}{axis}",) if named else ()
        effect = {"effect": name, "axis": axis, "component": component, **more}
        return _grows(effect, {key: sign}, f"{name} {axis}", parameters, shape or None)

    return draw


def _tau(rng: Rng, world: World) -> float:
    return float(world.duration * rng.uniform(0.1, 0.3))


def _jump(rng: Rng, world: World) -> Sized:
    axis, component, at, sign = _axis(rng), _axis(rng), world.moment(rng), _sign(rng)
    effect = {"effect": "jump", "axis": axis, "component": component, "t0_s": at}
    return _grows(effect, {"size_um": sign}, "jump tool", shape={"at": at})


def _turn(rng: Rng, world: World) -> np.ndarray:
    """A rotation of the instrument's frame, in urad per 1 um of translation. Over the travel it
    displaces about three times as much as the translation, which alone would equal one of the tool.
    """
    return _unit(rng) * 3 / (0.5 * np.mean(world.travel))


def _frame_jump(rng: Rng, world: World) -> Sized:
    at, v, w = world.moment(rng), _unit(rng), _turn(rng, world)
    sizes = {"translation_um": v, "rotation_urad": w}
    # A station that is displaced without rotation has another parameter.
    return _grows({"effect": "station_jump", "t0_s": at}, sizes, "jump frame", ("A",), {"at": at})


def _station_drift(rng: Rng, world: World) -> Sized:
    v, w = _unit(rng), _turn(rng, world)
    sizes = {"translation_um_per_h": v, "rotation_urad_per_h": w}
    return _grows({"effect": "station_drift"}, sizes, "station_drift")


def _screw(rng: Rng, world: World) -> Sized:
    axis, phase = _axis(rng), rng.uniform(0, 2 * np.pi)
    leads = (5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0)
    # Half of the screws have a nominal lead, half any pitch (racks, couplings, special makes).
    pitch = float(rng.choice(leads) if rng.uniform() < 0.5 else np.exp(rng.uniform(1.6, 3.9)))
    effect = {"effect": "screw_cyclic", "axis": axis, "phase": phase, "pitch_mm": pitch}
    key, shape = f"screw_cyclic {axis}", {"pitch": 1e-3 * pitch}
    return _grows(effect, {"amplitude_um": 1.0}, key, shape=shape)


def _crossed(rng: Rng, world: World) -> Sized:
    axis, component, sign = _axis(rng), _axis(rng), _sign(rng)
    other = _axis(rng, "XYZ".replace(axis, ""))
    powers = ((1, 1), (2, 1), (1, 2))[rng.integers(3)]
    motion = f"E{component}{axis}_{axis.lower()}_{other.lower()}"
    effect = {"effect": "cross_axis", "axis": axis, "other": other, "powers": powers,
              "component": component}  # fmt: skip
    return _grows(effect, {"size_um": sign}, f"cross_axis {axis}", (motion,))


def unresolved_degree(row: Sequence[float]) -> int:
    """The lowest Legendre degree of which more than a tenth remains after a fit of the family with
    this row of the table, a constant and a slope.
    """
    x = np.linspace(-1, 1, 201)
    _, _, n1, b1, c1, n2, b2, c2 = row
    columns = [np.ones(201), x]
    for n, b, c in ((n1, b1, c1), (n2, b2, c2)):
        columns += [np.sin(n * np.pi * x)] * bool(b) + [np.cos(n * np.pi * x)] * bool(c)
    q, _ = np.linalg.qr(np.stack(columns, axis=1))
    for degree in range(2, 13):
        p = np.polynomial.legendre.legval(x, np.eye(13)[degree])
        if np.linalg.norm(p - q @ (q.T @ p)) > 0.1 * np.linalg.norm(p):
            return degree
    raise ValueError("the family follows every degree up to 12")


def _order(rng: Rng, world: World) -> Sized:
    motion = [name for name in TABLE if name not in SQUARENESS and name[1] in "XYZ"]
    name = motion[rng.integers(len(motion))]
    degree, sign = unresolved_degree(TABLE[name]), _sign(rng)
    effect = {"effect": "geometric_order", "axis": name[2], "component": name[1], "degree": degree}
    return _grows(effect, {"size_um": sign}, f"geometric_order {name}", (f"P{degree}",))


def _sag(rng: Rng, world: World) -> Sized:
    axis = _axis(rng, "".join(a for a in "XY" if world.carries(a)))
    effect = {"effect": "payload_sag", "axis": axis}
    return _grows(effect, {"um_per_kg": 1.0}, f"payload_sag {axis}", ("sag_low",))


def _spindle(rng: Rng, world: World) -> Sized:
    tau = _tau(rng, world)
    effect = {"effect": "spindle_growth", "tau_s": tau}
    return _grows(effect, {"size_um": 1.0}, "spindle_growth", shape={"tau": tau})


def _scaled(name: str, key: str, vcal_key: str = "", **drawn: Callable[[Rng], Any]):
    """An effect without placement; further keys are drawn."""

    def draw(rng: Rng, world: World) -> Sized:
        sign, more = _sign(rng), {k: f(rng) for k, f in drawn.items()}
        return _grows({"effect": name, **more}, {key: sign}, vcal_key or name)

    return draw


def _phase(rng: Rng) -> float:
    return float(rng.uniform(0, 2 * np.pi))


def _axes_of_tracker(rng: Rng, world: World) -> Sized:
    tilt, collimation = _unit(rng, 2)
    sizes = {"tilt_urad": tilt, "collimation_urad": collimation}
    return _grows({"effect": "tracker_axes"}, sizes, "tracker_axes")


def _ball(rng: Rng, world: World) -> Sized:
    ball, v = int(rng.integers(11)), _unit(rng)
    effect = {"effect": "ball_error", "ball": ball}
    return _grows(effect, {"vector_um": v}, f"ball_error ball {ball}")


def _bending(rng: Rng, world: World) -> Sized:
    return _grows(
        {"effect": "artefact_bending"}, {"size_um": 1.0}, "artefact_bending", ("sag_down",)
    )


def _frame_grows(rng: Rng, world: World) -> Sized:
    axis = _axis(rng)
    effect = {"effect": "frame_expansion", "axis": axis}
    return _grows(effect, {"um_per_K": 1.0}, f"frame_expansion {axis}")


def _diode(rng: Rng, world: World) -> Sized:
    reading, sign = "uv"[rng.integers(2)], _sign(rng)
    effect = {"effect": "psd_linearity", "reading": reading}
    return _grows(effect, {"b": 1e3 * sign}, f"psd_linearity {reading}")


def _on_circles(
    name: str, key: str, *, one: bool, **drawn: Callable[[Rng], Any]
) -> Callable[[Rng, World], Sized]:
    """An effect of an R-test on one axis or on all; keys with a unit are shapes as well."""

    def draw(rng: Rng, world: World) -> Sized:
        axis, more = _axis(rng), {k: f(rng) for k, f in drawn.items()}
        place = {"axis": axis} if one else {}
        parameters: tuple[str, ...] = ()
        if name == "lateral_reversal":
            place["component"] = _axis(rng, "XYZ".replace(axis, ""))
            parameters = (f"size_E{place['component']}{axis}",)
        units = {
            "decay_mm": ("decay", 1e-3),
            "period_um": ("period", 1e-6),
            "speed_mm_per_s": ("speed", 1e-3),
        }
        shape = {units[k][0]: v * units[k][1] for k, v in more.items() if k in units}
        found = f"{name} {axis}" if one else name
        return _grows(
            {"effect": name, **place, **more}, {key: 1.0}, found, parameters, shape or None
        )

    return draw


def _crosstalk(rng: Rng, world: World) -> Sized:
    matrix = rng.standard_normal((3, 3))
    name = "acceleration_crosstalk"
    return _grows({"effect": name}, {"matrix_um_s2_per_m": matrix}, name)


# --- errors that no catalogue holds --------------------------------------------------------------


def _dent(rng: Rng, world: World) -> Sized:
    axis = _axis(rng)
    # Along the axis an instrument detects a dent as well as across it.
    component, travel = _axis(rng), world.travel["XYZ".index(axis)]
    at, sigma = travel * rng.uniform(0.25, 0.75), travel * rng.uniform(0.03, 0.06)
    effect = {"effect": "dent", "axis": axis, "component": component, "at": at, "sigma": sigma}
    return _grows(effect, {"depth_um": 1.0}, covariates=(axis,))


def _kink(rng: Rng, world: World) -> Sized:
    axis, sign = _axis(rng, "XY"), _sign(rng)  # a roll of Z displaces nothing
    roll = "ABC"["XYZ".index(axis)]
    at = world.travel["XYZ".index(axis)] * rng.uniform(0.3, 0.7)
    effect = {"effect": "kink", "axis": axis, "component": roll, "at": at}
    return _grows(effect, {"urad_per_m": sign}, covariates=(axis,))


def _quartic(rng: Rng, world: World) -> Sized:
    """u^2 v^2 along v, of two axes of which v is nearer to the tool. Across v the catalogue holds
    it: a rotation u^2 v of the first axis has the lever v.
    """
    order = [c for c in world.chain.split() if c in "XYZ"]
    first, second = sorted(rng.choice(3, 2, replace=False))
    axis, other, sign = order[second], order[first], _sign(rng)
    effect = {"effect": "cross_axis", "axis": axis, "other": other, "powers": (2, 2),
              "component": axis}  # fmt: skip
    return _grows(effect, {"size_um": sign}, covariates=(axis, other))


def _growing_play(rng: Rng, world: World) -> Sized:
    axis, sign = _axis(rng), _sign(rng)
    effect = {"effect": "growing_play", "axis": axis}
    return _grows(effect, {"um_per_m": sign}, covariates=(axis, f"dir_{axis}"))


def _stuck(rng: Rng, world: World) -> Sized:
    """A scale whose growth is compensated with a temperature that no longer changes."""
    axis = _axis(rng)
    at = float(world.duration * rng.uniform(0.2, 0.4))
    return lambda size: Term(
        (
            {"effect": "scale_growth", "axis": axis, "um_per_m_K": size},
            {"effect": "stuck_sensor", "axis": axis, "t0_s": at},
        ),
        covariates=(axis, "t", f"T_{axis}", "order", "pose", "run"),
        declared=({"name": "scale_growth", "placement": axis, "alpha_um_per_m_K": size},),
    )


def _on_joint(
    name: str,
    key: str,
    parameters: tuple[str, ...] = (),
    among: Sequence[int] = range(JOINTS),
    **fixed: Callable[[Rng, World], Any],
) -> Callable[[Rng, World], Sized]:
    """An effect on a joint of an arm; further keys are drawn."""

    def draw(rng: Rng, world: World) -> Sized:
        joint, sign = int(rng.choice(list(among))), _sign(rng)
        more = {k: f(rng, world) for k, f in fixed.items()}
        shape = {"at": more["t0_s"]} if "t0_s" in more else None
        effect = {"effect": name, "joint": joint, **more}
        return _grows(effect, {key: sign}, f"{name} J{joint + 1}", parameters, shape)

    return draw


def _gear(rng: Rng, world: World) -> Sized:
    """A low harmonic of a joint's angle."""
    joint, order = int(rng.integers(JOINTS)), int(rng.integers(1, 5))
    effect = {"effect": "gear_harmonic", "joint": joint, "order": order, "phase": _phase(rng)}
    key = f"gear_harmonic J{joint + 1}", (f"sine{order}", f"cosine{order}")
    return _grows(effect, {"amplitude_urad": 1.0}, *key)


def _ripple(rng: Rng, world: World) -> Sized:
    """A high harmonic: of a strain wave gear of a usual ratio, or of any order."""
    joint = int(rng.integers(JOINTS))
    usual = 2.0 * float(rng.choice((50, 80, 100, 120, 160)))
    order = usual if rng.uniform() < 0.5 else float(np.exp(rng.uniform(np.log(6), np.log(330))))
    pitch = 360.0 / order
    effect = {"effect": "gear_ripple", "joint": joint, "pitch_deg": pitch, "phase": _phase(rng)}
    shape = {"pitch": math.radians(pitch)}
    key = f"gear_ripple J{joint + 1}"
    return _grows(effect, {"amplitude_urad": 1.0}, key, shape=shape)


def _wound(rng: Rng, world: World) -> Sized:
    """A gear that yields more than in proportion to small loads: the departure from its linear
    compliance, which is another effect.
    """
    joint = int(rng.choice((1, 2, 4)))
    # Behind the wrist only the flange has a lever, which vcal models as that of equal masses:
    # 36 mm, where the other joints have 0.3 to 0.7 m.
    masses = "arm" if joint == 4 else ("arm", "tool")[rng.integers(2)]
    knee = float(np.exp(rng.uniform(np.log(3.0), np.log(20.0 if joint == 4 else 100.0))))
    effect = {"effect": "gear_wind_up", "joint": joint, "knee_mm": knee, "masses": masses,
              "departure": True}  # fmt: skip
    key = f"gear_wind_up J{joint + 1}", (f"size_{masses}",), {"knee": 1e-3 * knee}
    return _grows(effect, {"size_urad": 1.0}, *key)


def _loaded(name: str, among: Sequence[int]):
    """A compliance under a mass whose centre is off the flange in any direction."""

    def draw(rng: Rng, world: World) -> Sized:
        joint, sign = int(rng.choice(list(among))), _sign(rng)
        centre = np.append(rng.uniform(-0.08, 0.08, 2), rng.uniform(0.0, 0.1))
        effect = {"effect": name, "joint": joint, "centre": centre.tolist()}
        key = f"{name} J{joint + 1}"
        return _grows(effect, {"coefficient_urad": sign}, key)

    return draw


def _coupled(rng: Rng, world: World) -> Sized:
    """A joint whose angle has a part in proportion to the angle of another joint."""
    joint, other = (int(i) for i in rng.choice(JOINTS, 2, replace=False))
    effect = {"effect": "joint_coupling", "joint": joint, "other": other}
    sign, own = _sign(rng), (f"k_J{other + 1}",)
    return _grows(effect, {"ppm": sign}, f"joint_coupling J{joint + 1}", own)


def _follows(column: str, scale: float, components: str, unit: str):
    """An error in proportion to a column that no effect uses."""

    def draw(rng: Rng, world: World) -> Sized:
        effect = {"effect": "follows", "axis": _axis(rng), "column": column, "scale": scale,
                  "component": components[rng.integers(3)]}  # fmt: skip
        sign = _sign(rng)
        return _grows(effect, {f"size_{unit}": sign}, covariates=(column,))

    return draw


def _bumps(rng: Rng, world: World) -> Sized:
    """A harmonic on the circle; any covariate of the place on it is right."""
    order = int(rng.integers(3, 6))
    motion = ("", "a_", "v_", "since_", "dir_")
    place = (f"{kind}{axis}" for kind in motion for axis in "XYZ")
    covariates = (*place, "t_run", "circle_angle")
    return _grows({"effect": "harmonic", "order": order}, {"size_um": 1.0}, covariates=covariates)


def _drifting(rng: Rng, world: World) -> Sized:
    """A sphere that drifts in every run."""
    effect, sign = {"effect": "drift", "component": "XYZ"[rng.integers(3)]}, _sign(rng)
    return _grows(effect, {"um_per_s": sign}, covariates=("t_run",))


TRACKER, BALLS, FRAME, CIRCLES = ("laser_tracker",), ("ball_array",), ("laser_frame",), ("r_test",)
ARMS, LASERS = ("reflectors",), ("interferometer",)
BARS, PROBES = ("double_ball_bar",), ("touch_probe",)
BOTH = TRACKER + BALLS
ON_LINES = ON_MACHINE + LASERS
STATIONS = TRACKER + FRAME
_DECAY: dict[str, Callable[[Rng], Any]] = {"decay_mm": lambda rng: float(rng.uniform(0.03, 0.3))}
_SPEED: dict[str, Callable[[Rng], Any]] = {
    "speed_mm_per_s": lambda rng: float(rng.uniform(3.0, 20.0))
}
_SMOOTH: dict[str, Callable[[Rng], Any]] = {
    "speed_mm_per_s": lambda rng: float(rng.uniform(10.0, 30.0))
}
"""The circles have 21 to 95 mm/s. Below, friction changes between two rows, as backlash does."""
_WAY: dict[str, Callable[[Rng], Any]] = {"decay_mm": lambda rng: float(rng.uniform(1.0, 6.0))}
"""The rows of a ball bar are 9 to 13 mm apart, and near a reversal an axis moves far less."""
_PERIOD: dict[str, Callable[[Rng], Any]] = {
    "period_um": lambda rng: float(rng.choice([10.0, 20.0, 40.0, 100.0, 200.0])),
    "phase": _phase,
}

KINDS: tuple[Kind, ...] = (
    Kind("backlash", "um", 10, _on_axis("backlash", "size_um", "="), ON_LINES + LATERATED),
    Kind("lateral_reversal", "um", 10, _on_axis("lateral_reversal", "size_um", "x", "size"),
         ON_LINES + LATERATED),
    Kind("angular_reversal", "urad", 20, _on_axis("angular_reversal", "size_urad", "ABC", "size"),
         ON_LINES + LATERATED),
    Kind("scale_growth", "um/(m K)", 10, _on_axis("scale_growth", "um_per_m_K", "="),
         ON_LINES + LATERATED, cycles=True),
    Kind("thermal_offset", "um/K", 10, _on_axis("thermal_offset", "um_per_K", "XYZ", "k"),
         ON_LINES + LATERATED, cycles=True),
    Kind("thermal_tilt", "urad/K", 30, _on_axis("thermal_tilt", "urad_per_K", "ABC", "k"),
         ON_LINES + LATERATED, cycles=True),
    Kind("squareness_temperature", "urad/K", 20,
         _on_axis("squareness_temperature", "urad_per_K", "x", "k"), BOTH,
         cycles=True),
    Kind("warm_up", "um", 20, _on_axis("warm_up", "size_um", "XYZ", "size", tau_s=_tau),
         ON_LINES, cycles=True),
    Kind("warm_up of an angle", "urad", 30,
         _on_axis("warm_up", "size_urad", "ABC", "size", tau_s=_tau), ON_LINES, cycles=True),
    Kind("drift", "um/h", 20, _on_axis("drift", "um_per_h", "XYZ", "rate"), ON_LINES,
         cycles=True),
    Kind("drift of an angle", "urad/h", 30, _on_axis("drift", "urad_per_h", "ABC", "rate"),
         ON_LINES, cycles=True),
    Kind("jump of the tool", "um", 10, _jump, ON_MACHINE + LATERATED),
    Kind("jump of the frame", "um and urad", 10, _frame_jump, STATIONS),
    Kind("station_drift", "um/h and urad/h", 20, _station_drift, STATIONS),
    Kind("screw_cyclic", "um", 8, _screw, BOTH + LASERS + LATERATED),
    Kind("cross_axis", "um", 10, _crossed, ON_MACHINE),
    Kind("geometric_order", "um", 10, _order, BOTH),
    Kind("payload_sag", "um/kg", 1, _sag, BOTH, recording=("payload_kg",)),
    Kind("spindle_growth", "um", 20, _spindle, BOTH, recording=("speed_rpm",)),
    Kind("range_scale", "um/m", 10, _scaled("range_scale", "ppm"), TRACKER + LATERATED),
    Kind("encoder_eccentricity", "urad", 20,
         _scaled("encoder_eccentricity", "amplitude_urad", "encoder_eccentricity azimuth",
                 phase=_phase), TRACKER),
    Kind("tracker_axes", "urad", 20, _axes_of_tracker, TRACKER),
    Kind("ball_error", "um", 10, _ball, BALLS),
    Kind("artefact_bending", "um", 10, _bending, BALLS),
    Kind("artefact_expansion", "um/(m K)", 10, _scaled("artefact_expansion", "ppm_per_K"), BALLS),
    Kind("probe_lobing", "um", 5, _scaled("probe_lobing", "amplitude_um", phase=_phase), BALLS,
         recording=("approach_rad",)),
    Kind("head_expansion", "um/K", 1, _scaled("head_expansion", "um_per_K"), FRAME),
    Kind("frame_expansion", "um/K", 1, _frame_grows, FRAME),
    Kind("refraction", "um/(m K)", 2, _scaled("refraction", "um_per_m_K"), FRAME),
    Kind("psd_linearity", "um/mm3", 0.5, _diode, FRAME, plan={"diode": True}),
    Kind("acceleration_crosstalk", "um s2/m", 0.2, _crosstalk, CIRCLES),
    Kind("reversal_spike", "um", 2, _on_circles("reversal_spike", "size_um", one=False, **_DECAY),
         CIRCLES),
    Kind("reversal_spike of one axis", "um", 2,
         _on_circles("reversal_spike", "size_um", one=True, **_DECAY), CIRCLES),
    Kind("stribeck_friction", "um", 2,
         _on_circles("stribeck_friction", "size_um", one=False, **_SPEED), CIRCLES),
    Kind("stribeck_friction of one axis", "um", 2,
         _on_circles("stribeck_friction", "size_um", one=True, **_SPEED), CIRCLES),
    Kind("coulomb_friction", "um", 2,
         _on_circles("coulomb_friction", "size_um", one=False, **_SMOOTH), CIRCLES),
    Kind("coulomb_friction of one axis", "um", 2,
         _on_circles("coulomb_friction", "size_um", one=True, **_SMOOTH), CIRCLES),
    Kind("servo_lag", "ms", 0.02, _on_circles("servo_lag", "T_ms", one=False), CIRCLES),
    Kind("servo_lag of one axis", "ms", 0.02, _on_circles("servo_lag", "T_ms", one=True), CIRCLES),
    Kind("scale_interpolation", "um", 0.3,
         _on_circles("scale_interpolation", "amplitude_um", one=True, **_PERIOD), CIRCLES),
    Kind("backlash on circles", "um", 1, _on_circles("backlash", "size_um", one=True), CIRCLES),
    Kind("lateral_reversal on circles", "um", 1,
         _on_circles("lateral_reversal", "size_um", one=True), CIRCLES),
    Kind("backlash on a step gauge", "um", 5, _on_circles("backlash", "size_um", one=True), PROBES),
    Kind("screw_cyclic on a step gauge", "um", 4, _screw, PROBES),
    Kind("lateral_reversal on a step gauge", "um", 5,
         _on_circles("lateral_reversal", "size_um", one=True), PROBES),
    Kind("backlash with a ball bar", "um", 5, _on_circles("backlash", "size_um", one=True), BARS),
    Kind("lateral_reversal with a ball bar", "um", 5,
         _on_circles("lateral_reversal", "size_um", one=True), BARS),
    Kind("screw_cyclic with a ball bar", "um", 4, _screw, BARS),
    Kind("servo mismatch", "ms", 0.1, _on_circles("servo_lag", "T_ms", one=True), BARS),
    Kind("reversal_spike with a ball bar", "um", 5,
         _on_circles("reversal_spike", "size_um", one=False, **_WAY), BARS),
    Kind("reversal_spike of one axis with a ball bar", "um", 5,
         _on_circles("reversal_spike", "size_um", one=True, **_WAY), BARS),
    Kind("backlash of a joint", "urad", 100, _on_joint("backlash", "size_urad"), ARMS),
    Kind("gear_harmonic", "urad", 200, _gear, ARMS),
    Kind("gear_ripple", "urad", 200, _ripple, ARMS),
    Kind("gear_wind_up", "urad", 200, _wound, ARMS),
    Kind("joint_coupling", "urad/rad", 200, _coupled, ARMS),
    Kind("joint_compliance", "1e-6 rad/(N m)", 50,
         _on_joint("joint_compliance", "coefficient_urad", among=(1, 2)), ARMS),
    Kind("joint_compliance off the flange", "1e-6 rad/(N m)", 100,
         _loaded("joint_compliance", range(1, JOINTS)), ARMS),
    Kind("bearing_compliance", "1e-6 rad/(N m)", 100,
         _loaded("bearing_compliance", range(JOINTS)), ARMS),
    Kind("jump of a joint", "urad", 100,
         _on_joint("jump", "size_urad", ("size",), t0_s=lambda r, world: world.moment(r)), ARMS),
)  # fmt: skip
OUTSIDE: tuple[Kind, ...] = (
    Kind("a local dent", "um", 20, _dent, ON_MACHINE),
    Kind("a kink in roll", "urad/m", 100, _kink, ON_MACHINE),
    Kind("a fourth-order cross term", "um", 20, _quartic, BOTH),
    Kind("a play that grows along the travel", "um/m", 20, _growing_play, ON_MACHINE),
    Kind("a sensor that sticks", "um/(m K)", 15, _stuck, BOTH),
    Kind("a sensor that sticks, scale held in the middle", "um/(m K)", 15, _stuck, BOTH,
         centred=True),
    Kind("an offset that follows the coolant", "um", 20, _follows("coolant_bar", 20.0, "XYZ", "um"),
         BOTH, recording=("coolant_bar",)),
    Kind("an angle that follows the humidity", "urad", 60,
         _follows("humidity_percent", 9.0, "ABC", "urad"), BOTH, recording=("humidity_percent",)),
    Kind("a circle with bumps", "um", 1, _bumps, CIRCLES),
    Kind("a drift in every run", "um/s", 2, _drifting, CIRCLES),
)  # fmt: skip
PAIRS: tuple[tuple[str, str, str], ...] = (
    ("laser_tracker", "backlash", "thermal_tilt"),
    ("laser_tracker", "scale_growth", "screw_cyclic"),
    ("laser_tracker", "jump of the tool", "cross_axis"),
    ("ball_array", "backlash", "thermal_tilt"),
    ("ball_array", "scale_growth", "ball_error"),
    ("ball_array", "lateral_reversal", "warm_up"),
    ("r_test", "reversal_spike", "servo_lag"),
    ("r_test", "scale_interpolation", "reversal_spike of one axis"),
    ("laser_frame", "head_expansion", "backlash"),
    ("laser_frame", "refraction", "thermal_tilt"),
    ("reflectors", "backlash of a joint", "joint_compliance"),
    ("double_ball_bar", "backlash with a ball bar", "servo mismatch"),
)
SEVERAL: tuple[tuple[str, ...], ...] = (
    ("laser_tracker", "backlash", "thermal_tilt", "screw_cyclic"),
    ("laser_tracker", "encoder_eccentricity", "jump of the frame", "scale_growth"),
    ("laser_tracker", "payload_sag", "backlash", "cross_axis", "jump of the tool"),
    ("ball_array", "backlash", "thermal_tilt", "ball_error"),
    ("ball_array", "payload_sag", "thermal_offset", "artefact_bending", "scale_growth"),
    ("laser_frame", "head_expansion", "backlash", "thermal_tilt"),
    ("laser_frame", "angular_reversal", "thermal_offset", "scale_growth"),
    ("r_test", "reversal_spike", "servo_lag", "scale_interpolation"),
)
WITH_STRAYS: tuple[tuple[str, str], ...] = (
    ("laser_tracker", "backlash"),
    ("laser_tracker", "thermal_tilt"),
    ("ball_array", "scale_growth"),
    ("r_test", "reversal_spike"),
    ("laser_frame", "head_expansion"),
    ("reflectors", "backlash of a joint"),
    ("double_ball_bar", "backlash with a ball bar"),
)


@dataclass(frozen=True)
class Entry:
    """A case of the campaign: an instrument and the effects in its data."""

    name: str
    instrument: str
    group: str
    """One of GROUPS."""
    kinds: tuple[Kind, ...] = ()
    noise: float = 1.0
    strays: float = 0.0
    warming: bool = False
    """Whether the machine only warms up, instead of exercising its axes in turn."""
    zero: bool = False
    """Whether all temperatures are off by one of ZEROS."""
    multiples: tuple[float, ...] = ()

    @property
    def clean(self) -> bool:
        """Whether nothing is missing from the declared model."""
        return not self.kinds and not self.strays


GROUPS = {
    "clean": "nothing is missing",
    "noisier": "nothing is missing, and the noise is 1.1 times the declared one",
    "catalogue": "one effect of the catalogue",
    "warming up": "the same where temperatures and time are nearly proportional",
    "outside": "an error that no catalogue holds",
    "pairs": "two effects",
    "several": "three effects or four",
    "strays": "some readings are outliers",
    "zero": "an effect of temperature that is zero at another one than declared",
}
MULTIPLES = (3.0, 1.0, 5.0, 2.0, 0.5)


def _entries() -> tuple[Entry, ...]:
    by_name = {kind.name: kind for kind in (*KINDS, *OUTSIDE)}
    found = []
    for at in INSTRUMENTS:
        found.append(Entry(f"{at}/clean", at, "clean", multiples=(0.0,)))
        found.append(Entry(f"{at}/clean, noise 1.1", at, "noisier", noise=1.1, multiples=(0.0,)))
        found.append(Entry(f"{at}/strays", at, "strays", strays=STRAYS, multiples=(0.0,)))
    for kind in KINDS:
        for at in kind.instruments:
            found.append(Entry(f"{at}/{kind.name}", at, "catalogue", (kind,), multiples=MULTIPLES))
            if kind.cycles:
                name = f"{at}/{kind.name}, warming up"
                found.append(
                    Entry(name, at, "warming up", (kind,), warming=True,
                          multiples=(3.0, 5.0))
                )  # fmt: skip
    for name in THERMAL:
        for at in by_name[name].instruments:
            found.append(
                Entry(f"{at}/{name}, another zero", at, "zero", (by_name[name],), zero=True,
                      multiples=(5.0,))
            )  # fmt: skip
    for kind in OUTSIDE:
        for at in kind.instruments:
            found.append(Entry(f"{at}/{kind.name}", at, "outside", (kind,), multiples=(3.0, 5.0)))
    for at, one, other in PAIRS:
        kinds = by_name[one], by_name[other]
        found.append(Entry(f"{at}/{one} and {other}", at, "pairs", kinds, multiples=(5.0,)))
    for at, *names in SEVERAL:
        name = f"{at}/{', '.join(names[:-1])} and {names[-1]}"
        kinds = tuple(by_name[n] for n in names)
        found.append(Entry(name, at, "several", kinds, multiples=(5.0, 10.0)))
    for at, name in WITH_STRAYS:
        found.append(
            Entry(f"{at}/{name}, strays", at, "strays", (by_name[name],), strays=STRAYS,
                  multiples=(5.0,))
        )  # fmt: skip
    return tuple(found)


# In a mixed order, so that a campaign that ends early has some sets of every group.
ENTRIES: dict[str, Entry] = {
    entry.name: entry for entry in sorted(_entries(), key=lambda e: zlib.crc32(e.name.encode()))
}


# --- sets ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    """A set: data of the oracle, and the effects in them."""

    case: Case
    terms: tuple[Term, ...]


def world_of(instrument: str, seed: int) -> World:
    """The machine of a seed: three chains in turn. For a tracker, a ball array and an
    interferometer every travel is 0.8 to 1.25 times the usual one of the chain.
    """
    chain = CHAINS[seed % 3]
    if instrument in BOTH + LASERS + LATERATED:
        rng = np.random.default_rng([seed, 1])
        usual = np.array(SIZES[chain][0])
        return World(instrument, seed, chain, tuple(usual * rng.uniform(0.8, 1.25, 3)))
    if instrument in ARMS:
        return World(instrument, seed, "", ())
    return World(instrument, seed, chain, FRAME_SIZES[chain][0])


def drawn(entry: Entry, world: World) -> list[Sized]:
    """The effects of a set without their sizes; the same for all entries of one kind."""
    sized = []
    for kind in entry.kinds:
        own = zlib.crc32(kind.name.encode())
        sized.append(kind.draw(np.random.default_rng([world.seed, own]), world))
    return sized


def noise_seed(entry: Entry, multiple: float, seed: int) -> int:
    """The seed of the noise of a set. A set with outliers, or with another zero of temperature, has
    that of the same set without, with which it is compared.
    """
    if seed < OWN_NOISE or not entry.kinds:
        return seed
    name = f"{entry.instrument}/{entry.kinds[0].name}" if entry.strays or entry.zero else entry.name
    return zlib.crc32(f"{name} {multiple:g} {seed}".encode())


def make(
    entry: Entry,
    world: World,
    sized: Sequence[Sized],
    sizes: Sequence[float],
    noise: float | None = None,
    noise_seed: int | None = None,
) -> Made:
    """Measure the set, with its effects at the given sizes. `noise` replaces the noise factor of
    the entry, and `noise_seed` the seed of the world.
    """
    terms = tuple(f(size) for f, size in zip(sized, sizes, strict=True))
    effects = [dict(e) for term in terms for e in term.effects]
    declared = [dict(row) for term in terms for row in term.declared]
    plan: dict[str, Any] = {}
    for kind in entry.kinds:
        plan |= dict(kind.plan or {})
        if kind.cycles and not entry.warming:
            plan["cycles"] = True
    options: dict[str, Any] = {
        "seed": world.seed,
        "noise_seed": noise_seed,
        "noise_factor": entry.noise if noise is None else noise,
        "plan": plan,
        "name": entry.name.replace("/", " "),
    }
    at = entry.instrument
    if at == "r_test":
        plan["samples"] = 40
        rng = np.random.default_rng([world.seed, 3])
        matrix = draw_matrix(rng)
        if all(term.key != "acceleration_crosstalk" for term in terms):
            # In every other set the machine has a declared cross-talk, in the others none.
            if world.seed % 2 == 0:
                bends = "acceleration_crosstalk"
                effects.append({"effect": bends, "matrix": matrix})
                found = np.round(1e6 * matrix, 12).tolist()
                declared.append({"name": bends, "matrix_um_s2_per_m": found})
    elif at == "reflectors":
        plan["n"] = ARM_POSES
        options["recording"] = ("t_s",)
    else:
        options["chain"] = world.chain
        span = np.array(world.travel)
        centred = any(kind.centred for kind in entry.kinds)
        options["travel"] = np.stack([-0.5 * span, 0.5 * span], axis=1) if centred else span
        options["recording"] = tuple(dict.fromkeys(r for k in entry.kinds for r in k.recording))
    if at in ("laser_frame", *BARS, *PROBES):
        options |= {"family": FRAME_SMOOTH} if world.seed // 3 % 2 else {"table": FRAME_TABLE}
    case = make_case(at, effects=effects, declared=declared, **options)
    if entry.zero:
        case = with_other_zero(case, ZEROS[world.seed // len(CHAINS) % len(ZEROS)])
    if entry.strays:
        case = with_strays(case, entry.strays, world.seed)
    return Made(case, terms)
