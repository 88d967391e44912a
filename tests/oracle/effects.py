"""Effects that a case contains and does not declare, as dictionaries.

    {"effect": "backlash", "axis": "X", "size_um": 9}
    {"effect": "thermal_tilt", "axis": "Y", "component": "B", "urad_per_K": 40}

A key may end in a unit (or be one); `in_si` turns it into SI and drops the unit, a key without a
unit is SI as it stands.  On an axis, x is the axis's command, T its scale's temperature, dir its
last direction of travel, t the time, and the effect adds to the error twist of the joint, in the
joint's own frame, with the same sign on either side of the bed.  `component` is a direction X, Y,
Z (translation) or A, B, C (rotation); along the axis itself when it is left out.

| effect | adds | keys (SI) |
|---|---|---|
| backlash | size/2 dir along the axis | axis, size |
| lateral_reversal, angular_reversal | size/2 dir across it | axis, component, size |
| jump | size for t >= t0 | axis, component, size, t0 |
| scale_growth | coefficient (T - 20) x along the axis | axis, coefficient (1/K) |
| thermal_offset, thermal_tilt | coefficient (T - 20) | axis, component, coefficient (per K) |
| squareness_temperature | coefficient (T - 20) x across | axis, component, coefficient (rad/K) |
| warm_up | size (1 - exp(-t/tau)) | axis, component, size, tau |
| drift | coefficient t | axis, component, coefficient (per s) |
| screw_cyclic, scale_interpolation | amplitude sin(2 pi x/pitch + phase) | axis and these |
| cross_axis | size u^p v^r, u, v in [-1, 1] of axis, other | axis, other, component, size, powers |
| dent | -depth exp(-(x - at)^2 / 2 sigma^2) | axis, component, depth, at, sigma |
| kink | coefficient max(x - at, 0): a slope that changes | axis, component, coefficient, at |
| growing_play | coefficient/2 x dir along the axis | axis, coefficient |
| follows | size c/scale, c a further column of the data | axis, component, column, scale, size |
| geometric_order | size P_n(u), u in [-1, 1], n Legendre's degree | axis, component, size, degree |
| payload_sag | a cantilever, clamped at the low end of axis X or Y | axis, coefficient (m/kg) |
| spindle_growth | size along the tool, first order in the speed | size, tau |
| stuck_sensor | nothing: the temperature recorded of an axis stops at t0 | axis, t0 |
| tool_offset | a constant at the tool | vector |
| station_drift | frame twist x time | translation (m/s), rotation (rad/s) |
| station_jump | frame twist for t >= t0 | translation (m), rotation (rad), t0 |
| range_scale | offset + coefficient r | offset, coefficient |
| encoder_eccentricity | amplitude sin(az + phase) on the azimuth | amplitude, phase |
| tracker_axes | tilt tan(el) + collimation / cos(el) on the azimuth | tilt, collimation |
| ball_error | a ball lies off its certificate | ball, vector |
| artefact_bending | -Z sag shape(s) cos(tilt) | size |
| artefact_expansion | coefficient (T_air - 20) ball centre | coefficient (1/K) |
| probe_lobing | tool off along the approach by radius + amplitude cos(3 phi + phase) | and these |
| head_expansion | tool against Z by coefficient (T_head - 20) | coefficient (m/K) |
| frame_expansion | frame along axis by coefficient (T_head - 20) (share - held) | axis, these |
| refraction | a beam falls by coefficient/2 dT/dz s^2, s its length | coefficient (1/K) |
| psd_linearity | a x + b x^3 on reading u or v, x its place on the diode | reading, a, b (1/m^2) |

Arms: `joint` counts from 0; backlash (rad), gear_harmonic (amplitude, order, phase),
gear_ripple (amplitude, pitch, phase), joint_coupling (other, coefficient), joint_compliance and
bearing_compliance (coefficient rad/(N m), mass, centre), gear_wind_up (size, knee, masses,
departure), jump (size, t0), readback_lag (share), station_drift.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .kinematics import (
    AXES,
    COMPONENTS,
    Arm,
    Array,
    Machine,
    arm_frames,
    compose,
    error_motions,
    normalised,
    rotation_matrix,
)

Effect = Mapping[str, Any]
REFERENCE_TEMPERATURE = 20.0

UNITS = {
    "um_s2_per_m": 1e-6,
    "um_per_m_K": 1e-6,
    "urad_per_m": 1e-6,
    "um_per_kg": 1e-6,
    "urad_per_K": 1e-6,
    "urad_per_h": 1e-6 / 3600,
    "urad_per_s": 1e-6,
    "um_per_m": 1e-6,
    "um_per_K": 1e-6,
    "um_per_h": 1e-6 / 3600,
    "um_per_s": 1e-6,
    "mm_per_s": 1e-3,
    "ppm_per_K": 1e-6,
    "ppm": 1e-6,
    "urad": 1e-6,
    "deg": np.pi / 180,
    "rad": 1.0,
    "um": 1e-6,
    "mm": 1e-3,
    "kg": 1.0,
    "ms": 1e-3,
    "s": 1.0,
    "h": 3600.0,
}


@dataclass(frozen=True)
class Run:
    """What was commanded and under which conditions; n observations, axes X, Y, Z."""

    q: Array
    """Axis positions (n, 3) in m."""
    direction: Array
    """Last direction of travel (n, 3), +1 or -1."""
    t: Array
    """Time (n,) in s."""
    temperature: Array
    """Of the axes' scales (n, 3) in degC."""
    air: Array
    """Of the air (n,) in degC."""
    pose: NDArray[np.int64] | None = None
    """Index of the artefact's pose (n,)."""
    ball: NDArray[np.int64] | None = None
    """Index of the ball (n,)."""
    extra: Mapping[str, Array] = field(default_factory=dict)
    """Further columns of the data by their name in the file, in the unit of that name."""

    def at(self, q: Array) -> Run:
        """Return the same run at other axis positions."""
        return replace(self, q=q)


def in_si(effect: Effect) -> dict[str, Any]:
    """Return an effect with its units taken off the keys: size_um -> size in m.

    A key that is nothing but a unit becomes `coefficient`.
    """
    out: dict[str, Any] = {}
    for key, value in effect.items():
        for unit, factor in UNITS.items():
            if key == unit or key.endswith("_" + unit):
                stem = "coefficient" if key == unit else key[: -len(unit) - 1]
                out[stem] = np.asarray(value, dtype=float) * factor
                break
        else:
            out[key] = value
    return out


# --- effects on an axis: what they add along their component, (n,) -------------------------------


def _along(effect: dict[str, Any], machine: Machine, run: Run, i: int) -> Array:
    name, x = effect["effect"], run.q[:, i]
    warm = run.temperature[:, i] - REFERENCE_TEMPERATURE
    match name:
        case "backlash" | "lateral_reversal" | "angular_reversal":
            return 0.5 * effect["size"] * run.direction[:, i]
        case "jump":
            return effect["size"] * (run.t >= effect["t0"])
        case "scale_growth" | "squareness_temperature":
            return effect["coefficient"] * warm * x
        case "thermal_offset" | "thermal_tilt":
            return effect["coefficient"] * warm
        case "warm_up":
            return effect["size"] * -np.expm1(-run.t / effect["tau"])
        case "drift":
            return effect["coefficient"] * run.t
        case "screw_cyclic" | "scale_interpolation":
            phase = 2 * np.pi * x / effect["pitch"] + effect.get("phase", 0.0)
            return effect["amplitude"] * np.sin(phase)
        case "cross_axis":
            u, v = normalised(machine, run.q)[:, [i, AXES.index(effect["other"])]].T
            p, r = effect.get("powers", (1, 1))
            return effect["size"] * u**p * v**r
        case "dent":
            return -effect["depth"] * np.exp(-0.5 * ((x - effect["at"]) / effect["sigma"]) ** 2)
        case "kink":
            return effect["coefficient"] * np.clip(x - effect["at"], 0, None)
        case "growing_play":
            return 0.5 * effect["coefficient"] * x * run.direction[:, i]
        case "follows":
            return effect["size"] * run.extra[effect["column"]] / effect["scale"]
        case "geometric_order":
            one = np.eye(effect["degree"] + 1)[effect["degree"]]
            return effect["size"] * np.polynomial.legendre.legval(
                normalised(machine, run.q)[:, i], one
            )
    raise ValueError(f"no such effect on an axis: {name!r}")


ON_AXIS = {
    # name: (components allowed, the default; "=" the axis itself, "x" any translation across it)
    "backlash": ("=", "="),
    "lateral_reversal": ("x", None),
    "angular_reversal": ("ABC", None),
    "jump": ("XYZABC", "="),
    "scale_growth": ("=", "="),
    "squareness_temperature": ("x", None),
    "thermal_offset": ("XYZ", "="),
    "thermal_tilt": ("ABC", None),
    "warm_up": ("XYZABC", "="),
    "drift": ("XYZABC", "="),
    "screw_cyclic": ("=", "="),
    "scale_interpolation": ("=", "="),
    "cross_axis": ("XYZABC", "="),
    "dent": ("XYZABC", None),
    "kink": ("XYZABC", None),
    "growing_play": ("=", "="),
    "follows": ("XYZABC", None),
    "geometric_order": ("XYZABC", "="),
}
ON_MACHINE = (*ON_AXIS, "payload_sag", "spindle_growth", "stuck_sensor", "tool_offset")
ON_FRAME = ("station_drift", "station_jump")
ON_TRACKER = (*ON_FRAME, "range_scale", "encoder_eccentricity", "tracker_axes")
ON_BALLS = ("ball_error", "artefact_bending", "artefact_expansion", "probe_lobing")
ON_LASER = (*ON_FRAME, "head_expansion", "frame_expansion", "refraction", "psd_linearity")
ON_CIRCLES = (
    "acceleration_crosstalk",
    "resonance",
    "harmonic",
    "drift",
    "reversal_spike",
    "servo_lag",
    "stribeck_friction",
    "coulomb_friction",
    "scale_interpolation",
    "backlash",
    "lateral_reversal",
)
ON_ARM = (
    "backlash",
    "gear_harmonic",
    "gear_ripple",
    "joint_coupling",
    "joint_compliance",
    "bearing_compliance",
    "gear_wind_up",
    "jump",
    "readback_lag",
    "station_drift",
)
ON_BAR = (
    *ON_MACHINE,
    "servo_lag",
    "reversal_spike",
    "stribeck_friction",
    "coulomb_friction",
    "acceleration_crosstalk",
)
ALLOWED = {
    "laser_tracker": (*ON_MACHINE, *ON_TRACKER),
    "multilateration": (*ON_MACHINE, "range_scale"),
    "ball_array": (*ON_MACHINE, *ON_BALLS),
    "laser_frame": (*ON_MACHINE, *ON_LASER),
    "interferometer": ON_MACHINE,
    "r_test": ON_CIRCLES,
    "double_ball_bar": ON_BAR,
    "touch_probe": ON_MACHINE,
    "reflectors": ON_ARM,
}


def checked(effects: Iterable[Effect], instrument: str) -> list[dict[str, Any]]:
    """Return the effects in SI, or raise ValueError for one the instrument does not have."""
    if instrument not in ALLOWED:
        raise ValueError(f"unknown instrument {instrument!r}; expected one of {', '.join(ALLOWED)}")
    out = [in_si(e) for e in effects]
    for effect in out:
        if effect["effect"] not in ALLOWED[instrument]:
            raise ValueError(
                f"effect {effect['effect']!r} does not exist for {instrument!r}; "
                f"expected one of {', '.join(ALLOWED[instrument])}"
            )
    return out


def component(effect: dict[str, Any]) -> int:
    """Return the index in X Y Z A B C into which an effect on an axis adds."""
    allowed, default = ON_AXIS[effect["effect"]]
    axis = effect["axis"]
    where = {"=": axis, "x": AXES.replace(axis, "")}.get(allowed, allowed)
    wanted = effect.get("component", axis if default == "=" else None)
    if wanted is None or wanted not in where:
        raise ValueError(
            f"{effect['effect']} on {axis} needs a component out of {where!r}, got {wanted!r}"
        )
    return COMPONENTS.index(wanted)


def twists(machine: Machine, run: Run, effects: Iterable[Effect]) -> tuple[Array, Array]:
    """Return the joints' error translations and rotations (n, axis, 3), effects included."""
    t, r = error_motions(machine, run.q)
    for raw in effects:
        effect = in_si(raw)
        if effect["effect"] == "payload_sag":
            add_sag(effect, machine, run, t, r)
        if effect["effect"] not in ON_AXIS:
            continue
        i, j = AXES.index(effect["axis"]), component(effect)
        target = t if j < 3 else r
        target[:, i, j % 3] += _along(effect, machine, run, i)
    return t, r


def add_sag(effect: dict[str, Any], machine: Machine, run: Run, t: Array, r: Array) -> None:
    """Add a horizontal ram's sag under a payload m: it falls by c m s^3 and turns downwards by
    1.5 c m s^2 / L (F l^3 / 3EI and F l^2 / 2EI of a cantilever), s = l / L its share outside.
    """
    i = AXES.index(effect["axis"])
    low, high = machine.travel[i]
    s, load = (run.q[:, i] - low) / (high - low), run.extra["payload_kg"]
    t[:, i, 2] -= effect["coefficient"] * load * s**3
    # The tip points along +x or +y; it goes down by turning about +Y or -X.
    turn, sign = {0: (1, 1.0), 1: (0, -1.0)}[i]
    r[:, i, turn] += sign * 1.5 * effect["coefficient"] * load * s**2 / (high - low)


def spindle_growth(effect: dict[str, Any], run: Run) -> Array:
    """Return g (n,) of tau dg/dt = size n / n_max - g, cold at first, the speed n (of either
    sense) kept from every row to the next: solved from row to row.
    """
    share = np.abs(run.extra["speed_rpm"])
    g = np.zeros(run.t.size)
    for k in range(1, run.t.size):
        target = effect["size"] * share[k - 1] / share.max()
        g[k] = target + (g[k - 1] - target) * np.exp(-(run.t[k] - run.t[k - 1]) / effect["tau"])
    return g


def tool_vector(machine: Machine, run: Run, effects: Iterable[Effect], sensor: bool) -> Array:
    """Return the tool point in the last axis's frame, (n, 3) m; `sensor` adds what only the
    measurement has, in the probe or in the measuring head.
    """
    tool = np.tile(machine.tool_offset, (run.t.size, 1))
    for effect in map(in_si, effects):
        match effect["effect"]:
            case "tool_offset":
                tool = tool + effect["vector"]
            case "spindle_growth":
                tool[:, 2] += spindle_growth(effect, run)
            case "head_expansion" if sensor:
                warm = run.extra["T_head_degC"] - REFERENCE_TEMPERATURE
                tool[:, 2] -= effect["coefficient"] * warm
            case "probe_lobing" if sensor:
                phi = run.extra["approach_rad"]
                lobes = effect["amplitude"] * np.cos(3 * phi + effect.get("phase", 0.0))
                off = effect.get("radius", 0.0) + lobes
                tool[:, :2] += off[:, None] * np.stack([np.cos(phi), np.sin(phi)], axis=1)
    return tool


def tool_point(
    machine: Machine,
    run: Run,
    effects: Iterable[Effect] = (),
    small_angle: bool = False,
    sensor: bool = False,
) -> Array:
    """Return the true tool point in the workpiece frame, (n, 3) m; with `sensor` the point that
    the measurement takes for it.
    """
    effects = [in_si(e) for e in effects]
    tool = tool_vector(machine, run, effects, sensor)
    return compose(machine, run.q, *twists(machine, run, effects), tool, small_angle)


def recorded(run: Run, effects: Iterable[Effect]) -> Run:
    """Return the run as its sensors recorded it: one that sticks keeps its last temperature."""
    warm = run.temperature.copy()
    for effect in map(in_si, effects):
        if effect["effect"] == "stuck_sensor":
            i, late = AXES.index(effect["axis"]), run.t >= effect["t0"]
            if late.any():
                warm[late, i] = warm[max(int(np.argmax(late)) - 1, 0), i]
    return replace(run, temperature=warm)


# --- effects on an instrument --------------------------------------------------------------------


def frame_drift(effects: Iterable[Effect], t: Array) -> tuple[Array, Array]:
    """Return what the instrument's frame has moved by time t: d (n, 3) m and R (n, 3, 3)."""
    d, w = np.zeros((t.size, 3)), np.zeros((t.size, 3))
    for effect in map(in_si, effects):
        if effect["effect"] == "station_drift":
            d += t[:, None] * np.asarray(effect.get("translation", np.zeros(3)))
            w += t[:, None] * np.asarray(effect.get("rotation", np.zeros(3)))
        if effect["effect"] == "station_jump":
            after = (t >= effect["t0"])[:, None]
            d += after * np.asarray(effect.get("translation", np.zeros(3)))
            w += after * np.asarray(effect.get("rotation", np.zeros(3)))
    return d, rotation_matrix(w)


def bend_readings(readings: Array, effects: Iterable[Effect]) -> Array:
    """Return range, azimuth, elevation (n, 3) with the tracker's own errors added."""
    distance, azimuth, elevation = readings.T
    out = readings.copy()
    for effect in map(in_si, effects):
        match effect["effect"]:
            case "range_scale":
                out[:, 0] += effect.get("offset", 0.0) + effect.get("coefficient", 0.0) * distance
            case "encoder_eccentricity":
                out[:, 1] += effect["amplitude"] * np.sin(azimuth + effect.get("phase", 0.0))
            case "tracker_axes":
                out[:, 1] += effect.get("tilt", 0.0) * np.tan(elevation)
                out[:, 1] += effect.get("collimation", 0.0) / np.cos(elevation)
    return out


def sag_shape(s: Array, supports: tuple[float, float]) -> Array:
    """Return the deflection of a uniform beam at shares s of its length, downwards positive.

    Simply supported at the shares a < b, E I w'''' = load; zero at the supports and scaled so that
    the largest deflection within [0, 1] has modulus one.
    """
    a, b = supports
    right = (0.5 - a) / (b - a)  # reaction at b as a share of the weight
    left = 1 - right

    def raw(x: Array) -> Array:
        past_a, past_b = np.clip(x - a, 0, None), np.clip(x - b, 0, None)
        return x**4 / 24 - left * past_a**3 / 6 - right * past_b**3 / 6

    ends = raw(np.array([a, b]))
    slope = (ends[1] - ends[0]) / (b - a)

    def deflection(x: Array) -> Array:
        return raw(x) - ends[0] - slope * (x - a)

    grid = deflection(np.linspace(0, 1, 2001))
    return deflection(np.asarray(s, dtype=float)) / np.abs(grid).max()


def ball_positions(
    balls: Array,
    run: Run,
    rotation: Array,
    origin: Array,
    effects: Iterable[Effect] = (),
    supports: tuple[float, float] = (0.22, 0.78),
) -> Array:
    """Return the true ball centre of every observation in the workpiece frame, (n, 3) m.

    balls (b, 3) in the artefact's frame (its beam along x), rotation (pose, 3, 3) and origin
    (pose, 3): R_pose (ball + expansion + error) + o_pose, less the sag along -Z.
    """
    if run.pose is None or run.ball is None:
        raise ValueError("a ball array's run needs pose and ball")
    effects = [in_si(e) for e in effects]
    own = balls.copy()
    for effect in effects:
        if effect["effect"] == "ball_error":
            own[effect["ball"]] += np.asarray(effect["vector"])
    p = own[run.ball]
    r = rotation[run.pose]
    fall = np.zeros(run.t.size)
    for effect in effects:
        if effect["effect"] == "artefact_expansion":
            warm = run.air - REFERENCE_TEMPERATURE
            p = p * (1 + effect["coefficient"] * warm[:, None])
        if effect["effect"] == "artefact_bending":
            along = balls[:, 0] - balls[0, 0]
            shape = sag_shape(along / along[-1], supports)[run.ball]
            fall += effect["size"] * shape * np.hypot(r[:, 0, 0], r[:, 1, 0])
    out = np.einsum("nij,nj->ni", r, p) + origin[run.pose]
    out[:, 2] -= fall
    return out


# --- effects on an arm ---------------------------------------------------------------------------


def joint_angles(arm: Arm, q: Array, t: Array, effects: Iterable[Effect]) -> Array:
    """Return the joint values (n, j) that the arm takes for the commands q in time order."""
    true = q.copy()
    way = np.sign(np.diff(q, axis=0, prepend=np.zeros((1, q.shape[1]))))
    for k in range(1, len(way)):  # a joint that stands keeps the way it came
        way[k] = np.where(way[k] == 0, way[k - 1], way[k])
    for effect in map(in_si, effects):
        j = int(effect.get("joint", 0))
        match effect["effect"]:
            case "backlash":
                true[:, j] += 0.5 * effect["size"] * way[:, j]
            case "gear_harmonic":
                phase = effect["order"] * q[:, j] + effect.get("phase", 0.0)
                true[:, j] += effect["amplitude"] * np.sin(phase)
            case "gear_ripple":
                phase = 2.0 * np.pi * q[:, j] / effect["pitch"] + effect.get("phase", 0.0)
                true[:, j] += effect["amplitude"] * np.sin(phase)
            case "joint_coupling":
                true[:, j] += effect["coefficient"] * q[:, int(effect["other"])]
            case "jump":
                true[:, j] += effect["size"] * (t >= effect["t0"])
            case "joint_compliance":
                true[:, j] += effect["coefficient"] * gravity_torque(
                    arm, q, j, effect.get("mass", 1.0), effect.get("centre", np.zeros(3))
                )
            case "gear_wind_up":
                masses = effect.get("masses", "arm")
                lever, reach = gravity_lever(arm, q, j, masses), stretched_reach(arm, j, masses)
                wound = np.tanh(lever / effect["knee"])
                if effect.get("departure", False):
                    # From the straight line through both ends, which is the gear's compliance.
                    wound -= lever / reach * np.tanh(reach / effect["knee"])
                true[:, j] += effect["size"] * wound
    return true


def gravity_lever(arm: Arm, q: Array, joint: int, masses: str) -> Array:
    """Return the torque about a joint per unit of the total weight, (n,) m, of a nominal arm:
    of equal masses at the origins of all frames behind it ("arm"), the last one being the flange,
    or of one mass at the flange ("tool").
    """
    frames, origins = arm_frames(replace(arm, translation=None, rotation=None), q)
    behind = {"arm": origins[:, joint + 1 :], "tool": origins[:, -1:]}[masses]
    centre = behind.mean(axis=1) - origins[:, joint]
    return np.sum(frames[:, joint, :, 2] * np.cross(centre, [0.0, 0.0, -1.0]), axis=1)


def stretched_reach(arm: Arm, joint: int, masses: str) -> float:
    """Return the longest lever that the links behind a revolute joint could give: the mean, over
    the masses, of the length of all links up to each, the joint's own d being along its axis.
    """
    along = np.where(np.arange(arm.joints) > joint, arm.d, 0.0)
    lengths = np.cumsum(np.hypot(arm.a, along)[joint:])
    return float(lengths[-1] if masses == "tool" else lengths.mean())


def gravity_moment(arm: Arm, q: Array, joint: int, mass: float, centre: Array) -> Array:
    """Return (c - o_j) x g in N m for a mass at `centre` in the last frame, g along -Z: (n, 3)."""
    frames, origins = arm_frames(arm, q)
    c = origins[:, -1] + frames[:, -1] @ np.asarray(centre, dtype=float)
    return np.cross(c - origins[:, joint], np.array([0.0, 0.0, -9.81 * mass]))


def gravity_torque(arm: Arm, q: Array, joint: int, mass: float, centre: Array) -> Array:
    """Return z_j . ((c - o_j) x g) in N m."""
    frames, _ = arm_frames(arm, q)
    moment = gravity_moment(arm, q, joint, mass, centre)
    return np.sum(frames[:, joint, :, 2] * moment, axis=-1)


def joint_tilts(arm: Arm, q: Array, effects: Iterable[Effect]) -> Array:
    """Return the rotation (n, j, 3) of every joint across its axis, in its frame after the motion:
    along the part of the moment that is across z_j.
    """
    out = np.zeros((*q.shape, 3))
    frames, _ = arm_frames(arm, q)
    for effect in map(in_si, effects):
        if effect["effect"] == "bearing_compliance":
            j = int(effect["joint"])
            mass, centre = effect.get("mass", 1.0), effect.get("centre", np.zeros(3))
            moment = gravity_moment(arm, q, j, mass, centre)
            z = frames[:, j, :, 2]
            across = moment - np.sum(z * moment, axis=1)[:, None] * z
            turned = frames[:, j] @ rotation_matrix(
                (arm.theta[j] + q[:, j])[:, None] * np.eye(3)[2]
            )
            out[:, j] += effect["coefficient"] * np.einsum("nba,nb->na", turned, across)
    return out


def read_back(q: Array, true: Array, effects: Iterable[Effect]) -> Array:
    """Return the joint values the controller reads: `share` of the last move is still to come."""
    out = true.copy()
    for effect in map(in_si, effects):
        if effect["effect"] == "readback_lag":
            out -= effect["share"] * (q - np.vstack([q[:1], q[:-1]]))
    return out
