"""The oracle against closed forms and scipy."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import root

from oracle import (
    TABLE,
    Machine,
    Run,
    Tracker,
    align,
    arm_frames,
    arm_points,
    check_plan,
    draw_machine,
    euler_xyz,
    example_arm,
    in_si,
    make_case,
    nominal_machine,
    parse_chain,
    rotation_matrix,
    solve_positions,
    tool_point,
    tracker_plan,
    tracker_points,
    tracker_readings,
    with_errors,
)
from oracle.effects import ON_AXIS, sag_shape
from oracle.kinematics import turn, unturn

CHAINS = ["w X b Y Z t", "w b X Y Z t", "w Y b X Z t", "w X Y b Z t", "w Z X Y b t"]
TRAVEL, TOOL = (2.0, 1.0, 0.6), (0.01, -0.02, -0.15)
UM = 1e-6


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


def machine_of(chain: str) -> Machine:
    return nominal_machine(chain, TRAVEL, TOOL)


def still(machine: Machine, q, direction: float = 1.0, temperature: float = 20.0) -> Run:
    """Return a run at positions q (n, 3) with everything else constant."""
    q = np.atleast_2d(np.asarray(q, dtype=float))
    n = len(q)
    warm = np.full((n, 3), temperature)
    return Run(q, np.full((n, 3), direction), np.arange(n) * 10.0, warm, warm[:, 0])


def constant(**values: float) -> dict:
    return {name: [value] for name, value in values.items()}


# --- rotations and chains ------------------------------------------------------------------------


def test_rotation_matrix_is_the_exponential(rng):
    v = rng.standard_normal((20, 3)) * np.logspace(-9, 0, 20)[:, None]
    s = np.stack([np.cross(v, e) for e in np.eye(3)], axis=-1)
    np.testing.assert_allclose(rotation_matrix(v), [expm(m) for m in s], atol=2e-14, rtol=0)
    p = rng.standard_normal((20, 3))
    np.testing.assert_allclose(
        turn(v, p), np.einsum("nij,nj->ni", rotation_matrix(v), p), atol=1e-14
    )
    for small in (False, True):
        np.testing.assert_allclose(unturn(v, turn(v, p, small), small), p, atol=1e-13)


def test_euler_order():
    a, b, c = 0.1, -0.2, 0.3
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rz = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    np.testing.assert_allclose(euler_xyz([a, b, c]), rx @ ry @ rz, atol=1e-15)


def test_parse_chain():
    assert parse_chain("w Y X b Z t") == ((0, 1), (2,))
    assert parse_chain("w b X Y Z t") == ((), (0, 1, 2))
    for bad in ("X b Y Z", "w X b Y t", "w X b X Z t", "w X Y Z t", ""):
        with pytest.raises(ValueError, match="chain must"):
            parse_chain(bad)


@pytest.mark.parametrize("small_angle", [False, True])
@pytest.mark.parametrize("chain", CHAINS)
def test_zero_errors_give_nominal(chain, small_angle, rng):
    machine = machine_of(chain)
    run = check_plan(machine, rng, 50)
    p = tool_point(machine, run, small_angle=small_angle)
    np.testing.assert_allclose(p, run.q + TOOL, atol=1e-15)


@pytest.mark.parametrize("chain", CHAINS)
def test_against_homogeneous_matrices(chain, rng):
    """T of every joint multiplied out, T_workpiece inverted: the definition, point by point."""
    machine = draw_machine(machine_of(chain), rng)
    run = check_plan(machine, rng, 5)
    got = tool_point(machine, run)
    c0y, b0z, a0z = machine.squareness
    along = np.array([[1, 0, 0], [-c0y, 1, 0], [b0z, -a0z, 1]])
    names = chain.split()
    bed = names.index("b")
    for q, p in zip(run.q, got, strict=True):

        def joint(axis: str, sign: float, q=q):
            i = "XYZ".index(axis)
            low, high = machine.travel[i]
            x = (2 * q[i] - low - high) / (high - low)
            error = []
            for a0, a1, n1, b1, c1, n2, b2, c2 in machine.motion[i]:
                e = a0 + a1 * x + b1 * np.sin(n1 * np.pi * x) + c1 * np.cos(n1 * np.pi * x)
                error.append(e + b2 * np.sin(n2 * np.pi * x) + c2 * np.cos(n2 * np.pi * x))
            t = np.eye(4)
            t[:3, :3] = rotation_matrix(error[3:])
            t[:3, 3] = sign * q[i] * along[i] + error[:3]
            return t

        workpiece = tool = np.eye(4)
        for axis in reversed(names[1:bed]):
            workpiece = workpiece @ joint(axis, -1.0)
        for axis in names[bed + 1 : -1]:
            tool = tool @ joint(axis, 1.0)
        expected = np.linalg.inv(workpiece) @ tool @ np.append(machine.tool_offset, 1)
        np.testing.assert_allclose(p, expected[:3], atol=2e-15)


def test_small_angle_form_is_close(rng):
    """Second order only: 50 urad squared times 3 m is 7.5 nm."""
    machine = draw_machine(nominal_machine("w X b Y Z t", (3.0, 1.5, 1.3), (0, 0, -0.2)), rng)
    run = check_plan(machine, rng)
    off = tool_point(machine, run) - tool_point(machine, run, small_angle=True)
    assert 0 < np.abs(off).max() < 0.1 * UM


# --- signs ---------------------------------------------------------------------------------------


def test_roll_moves_the_tool_by_its_lever():
    """EAX of a tool-side X turns about X's own frame: levers are y + ty and z + tz."""
    a = 3e-4
    machine = with_errors(machine_of("w b X Y Z t"), constant(EAX=a))
    q = np.array([0.3, 0.4, 0.5])
    y, z = 0.4 + TOOL[1], 0.5 + TOOL[2]
    expected = [y * (np.cos(a) - 1) - z * np.sin(a), z * (np.cos(a) - 1) + y * np.sin(a)]
    got = tool_point(machine, still(machine, q))[0] - (q + TOOL)
    np.testing.assert_allclose(got, [0, *expected], atol=1e-15)


def test_pitch_of_the_last_axis_sees_the_tool_offset_only():
    machine = with_errors(machine_of("w X b Y Z t"), constant(EBZ=1e-5))
    got = tool_point(machine, still(machine, [[1.0, 0.5, 0.3]]))[0] - [1.01, 0.48, 0.15]
    np.testing.assert_allclose(got, [-0.15e-5, 0, -0.01e-5], atol=2e-11)


def test_roll_of_a_table_turns_the_workpiece():
    """The tool point, seen from a table turned by +a, turns by -a about the table's frame."""
    a = 1e-5
    machine = with_errors(machine_of("w X b Y Z t"), constant(EAX=a))
    got = tool_point(machine, still(machine, [[1.0, 0.5, 0.3]]))[0] - [1.01, 0.48, 0.15]
    np.testing.assert_allclose(got, [0, 0.15 * a, -0.48 * a], atol=2e-10)


@pytest.mark.parametrize(("chain", "sign"), [("w b X Y Z t", 1.0), ("w X b Y Z t", -1.0)])
def test_sign_of_a_table_side_translation(chain, sign):
    machine = with_errors(machine_of(chain), constant(EXX=1e-5))
    run = still(machine, [[1.0, 0.5, 0.3]])
    off = tool_point(machine, run) - run.q - TOOL
    np.testing.assert_allclose(off, [[sign * 1e-5, 0, 0]], atol=1e-15)
    lead = {"effect": "backlash", "axis": "X", "size_um": 8}
    moved = tool_point(machine, run, [lead]) - tool_point(machine, run)
    np.testing.assert_allclose(moved, [[sign * 4e-6, 0, 0]], atol=1e-15)


@pytest.mark.parametrize("chain", ["w X b Y Z t", "w Y Z b X t"])
def test_squareness(chain):
    """It tilts the direction of motion, so it shows alike on either side of the bed."""
    machine = with_errors(machine_of(chain), {"EC0Y": 2e-5, "EB0Z": 3e-5, "EA0Z": 5e-5})
    q = np.array([0.7, 0.4, 0.5])
    _, y, z = q
    got = tool_point(machine, still(machine, q))[0] - q - TOOL
    np.testing.assert_allclose(got, [-2e-5 * y + 3e-5 * z, -5e-5 * z, 0], atol=1e-15)


def test_fourier_family_at_the_ends():
    row = [1, 2, 0.5, 4, 8, 1, 16, 32]
    machine = with_errors(machine_of("w b X Y Z t"), {"EYX": row})
    run = still(machine, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    got = (tool_point(machine, run) - run.q - TOOL)[:, 1]
    np.testing.assert_allclose(got, [1 - 2 - 4 - 32, 1 + 8 + 32, 1 + 2 + 4 - 32], atol=1e-13)


def test_drawn_machine_stays_within_its_table(rng):
    machine = draw_machine(machine_of("w X b Y Z t"), rng)
    true = machine.coefficients()
    assert set(true) == set(TABLE)
    for name, row in TABLE.items():
        assert np.all(np.abs(true[name]) <= np.abs(row)), name


# --- effects -------------------------------------------------------------------------------------


def shift(effect: dict, q, chain: str = "w b X Y Z t", **conditions) -> np.ndarray:
    machine = machine_of(chain)
    run = still(machine, q, **conditions)
    return tool_point(machine, run, [effect]) - run.q - TOOL


def test_units_come_off_the_keys():
    effect = {"effect": "screw_cyclic", "axis": "X", "amplitude_um": 6.0, "pitch_mm": 20.0}
    si = in_si(effect)
    assert si["amplitude"] == pytest.approx(6e-6)
    assert si["pitch"] == pytest.approx(0.02)
    assert in_si(si) == si
    assert in_si({"um_per_m_K": 11.0})["coefficient"] == pytest.approx(11e-6)
    assert in_si({"rotation_urad_per_h": 36})["rotation"] == pytest.approx(1e-8)


def test_effects_along_an_axis():
    q = [[0.105, 0.2, 0.3]]
    cyclic = {"effect": "screw_cyclic", "axis": "X", "amplitude_um": 6, "pitch_mm": 20}
    np.testing.assert_allclose(shift(cyclic, q), [[6e-6, 0, 0]], atol=1e-15)
    growth = {"effect": "scale_growth", "axis": "Y", "um_per_m_K": 11}
    np.testing.assert_allclose(shift(growth, q, temperature=22), [[0, 4.4e-6, 0]], atol=1e-15)
    dent = {"effect": "dent", "axis": "X", "component": "Z", "depth_um": 18, "at_mm": 105}
    np.testing.assert_allclose(shift(dent | {"sigma_mm": 60}, q), [[0, 0, -18e-6]], atol=1e-15)
    cross = {"effect": "cross_axis", "axis": "X", "other": "Y", "component": "Z", "size_um": 5}
    np.testing.assert_allclose(shift(cross, [[2, 0, 0]]), [[0, 0, -5e-6]], atol=1e-15)
    tool = {"effect": "tool_offset", "vector_um": [1, 2, 3]}
    np.testing.assert_allclose(shift(tool, q), [[1e-6, 2e-6, 3e-6]], atol=1e-15)


def test_effects_in_time():
    q = np.full((3, 3), 0.1)  # at 0, 10 and 20 s
    jump = {"effect": "jump", "axis": "Z", "size_um": 7, "t0_s": 10}
    np.testing.assert_allclose(shift(jump, q)[:, 2], [0, 7e-6, 7e-6], atol=1e-15)
    drift = {"effect": "drift", "axis": "Z", "component": "X", "um_per_s": 0.1}
    np.testing.assert_allclose(shift(drift, q)[:, 0], [0, 1e-6, 2e-6], atol=1e-15)
    warm_up = {"effect": "warm_up", "axis": "Z", "size_um": 10, "tau_s": 20}
    np.testing.assert_allclose(shift(warm_up, q)[2, 2], 10e-6 * (1 - np.exp(-1)), rtol=1e-9)


def test_thermal_tilt_turns_about_its_joint():
    tilt = {"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 40}
    got = shift(tilt, [[0.1, 0.2, 0.3]], chain="w X b Y Z t", temperature=20.5)[0]
    np.testing.assert_allclose(got, [0, -0.15 * 20e-6, -0.02 * 20e-6], atol=1e-10)


def test_wrong_effects_are_refused():
    for effect, match in [
        ({"effect": "lateral_reversal", "axis": "X", "component": "X", "size": 1e-6}, "component"),
        ({"effect": "thermal_tilt", "axis": "X", "coefficient": 1e-6}, "component"),
        ({"effect": "no such thing"}, "does not exist"),
        ({"effect": "ball_error", "ball": 3, "vector": np.zeros(3)}, "does not exist"),
    ]:
        with pytest.raises(ValueError, match=match):
            make_case("laser_tracker", effects=[effect])


@pytest.mark.parametrize("name", ON_AXIS)
def test_every_axis_effect_changes_the_data_and_nothing_else(name):
    keys = {
        "effect": name, "axis": "X", "other": "Y", "size": 9e-6, "coefficient": 1e-5, "t0": 900.0,
        "tau": 900.0, "amplitude": 6e-6, "pitch": 0.02, "depth": 2e-5, "at": 1.0, "sigma": 0.05,
        "degree": 4, "column": "coolant_bar", "scale": 20.0,
    }  # fmt: skip
    allowed, default = ON_AXIS[name]
    if name == "drift":
        keys["coefficient"] = 1e-9
    if default is None:
        keys["component"] = {"x": "Z"}.get(allowed, allowed[0])
    clean, bent = (
        make_case("laser_tracker", effects=effects, seed=3, recording=("coolant_bar",))
        for effects in ((), [keys])
    )
    np.testing.assert_array_equal(clean.run.q, bent.run.q)
    assert np.abs(clean.readings - bent.readings).max() > 0.5 * UM
    assert np.abs(clean.readings - bent.readings).max() < 1e-2
    assert np.abs(clean.check_tcp - bent.check_tcp).max() > 0.5 * UM


# --- instruments ---------------------------------------------------------------------------------


def test_tracker_readings_and_their_inverse(rng):
    tracker = Tracker(np.array([-0.9, 0.3, 0.7]), np.deg2rad([0.034, 0.034, 59.5]))
    p = rng.uniform(0, 2, (40, 3))
    np.testing.assert_allclose(tracker_points(tracker, tracker_readings(tracker, p)), p, atol=1e-14)
    plain = Tracker(np.zeros(3), np.zeros(3))
    got = tracker_readings(plain, np.array([[0, 2.0, 0], [1.0, 0, 1.0]]))
    np.testing.assert_allclose(got, [[2, np.pi / 2, 0], [2**0.5, 0, np.pi / 4]], atol=1e-15)


def test_tracker_effects():
    plain, p, t = Tracker(np.zeros(3), np.zeros(3)), np.array([[0, 2.0, 0]]), np.array([100.0])
    before = tracker_readings(plain, p)
    for effect, expected in [
        ({"effect": "range_scale", "offset_um": 3, "ppm": 5}, [13e-6, 0, 0]),
        ({"effect": "encoder_eccentricity", "amplitude_urad": 7}, [0, 7e-6, 0]),
        ({"effect": "tracker_axes", "collimation_urad": 4, "tilt_urad": 9}, [0, 4e-6, 0]),
        ({"effect": "station_drift", "translation": [0, 1e-8, 0]}, [-1e-6, 0, 0]),
        ({"effect": "station_drift", "rotation": [0, 0, 1e-8]}, [0, -1e-6, 0]),
    ]:
        got = tracker_readings(plain, p, t, [effect]) - before
        np.testing.assert_allclose(got, [expected], atol=1e-12)


def test_tracker_noise_has_the_declared_size():
    shape = {"shape": (20, 20, 5)}
    noisy = make_case("laser_tracker", seed=1, plan=shape, station_scatter=(0, 0))
    clean = make_case("laser_tracker", seed=1, plan=shape, noise_factor=0, station_scatter=(0, 0))
    r = noisy.readings - clean.readings
    sigma = 1.3e-6 + 0.27e-6 * clean.readings[:, 0]
    assert np.std(r[:, 0] / sigma) == pytest.approx(1, abs=0.04)
    assert np.std(r[:, 1:]) == pytest.approx(2.5e-6, rel=0.03)


EFFECTS = [
    {"effect": "backlash", "axis": "X", "size_um": 9},
    {"effect": "screw_cyclic", "axis": "Z", "amplitude_um": 6, "pitch_mm": 10},
    {"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 40},
    {"effect": "dent", "axis": "X", "component": "Z", "depth_um": 18, "at_mm": 900, "sigma_mm": 60},
]


@pytest.mark.parametrize("chain", CHAINS)
def test_ball_solve_against_scipy_root(chain):
    case = make_case("ball_array", chain, seed=5, effects=EFFECTS, noise_factor=0)
    run, target = case.run, tool_point(case.machine, case.run, EFFECTS)
    q = solve_positions(case.machine, run, target, EFFECTS)
    np.testing.assert_allclose(q, run.q, atol=2e-12)
    for k in range(0, len(q), 37):

        def miss(x, k=k):
            one = Run(
                np.atleast_2d(x), run.direction[k : k + 1], run.t[k : k + 1],
                run.temperature[k : k + 1], run.air[k : k + 1],
            )  # fmt: skip
            return (tool_point(case.machine, one, EFFECTS) - target[k])[0]

        solved = root(miss, target[k] - case.machine.tool_offset, method="hybr", tol=1e-14)
        np.testing.assert_allclose(q[k], solved.x, atol=2e-12)


@pytest.mark.parametrize("chain", CHAINS)
def test_balls_are_where_the_artefact_says(chain):
    """Without noise the tool point at the positions found makes the artefact's own shape."""
    case = make_case("ball_array", chain, seed=6, noise_factor=0)
    p = tool_point(case.machine, case.run)
    for k in range(24):
        seen = p[case.run.pose == k]
        np.testing.assert_allclose(align(case.balls.balls, seen), seen, atol=1e-11)
    low, high = case.machine.travel.T
    assert np.all((case.run.q > low) & (case.run.q < high))
    assert len(p) == 264


def test_ball_effects_show_in_the_artefact_only():
    bump = {"effect": "ball_error", "ball": 4, "vector_um": [0, 0, 30]}
    for effect in (
        bump,
        {"effect": "artefact_bending", "size_um": 10},
        {"effect": "artefact_expansion", "ppm_per_K": 8},
    ):
        clean = make_case("ball_array", seed=2)
        bent = make_case("ball_array", seed=2, effects=[effect])
        np.testing.assert_array_equal(clean.check_tcp, bent.check_tcp)
        off = bent.run.q - clean.run.q
        assert 0.5 * UM < np.abs(off).max() < 40 * UM
        if effect is bump:
            assert set(bent.run.ball[np.abs(off).max(axis=1) > 0.01 * UM]) == {4}
            np.testing.assert_allclose(np.linalg.norm(off[4::11], axis=1), 30e-6, rtol=1e-2)


def test_sag_of_a_beam_on_its_ends():
    """On its ends x (1 - 2 x^2 + x^3); a spacing of 0.554 lets ends and middle sag alike."""
    x = np.linspace(0, 1, 11)
    np.testing.assert_allclose(
        sag_shape(x, (0.0, 1.0)), 16 / 5 * x * (1 - 2 * x**2 + x**3), atol=1e-9
    )
    a = 0.22315  # supports 0.5537 L apart: ends and middle sag alike
    ends = sag_shape(np.array([0, 0.5, 1]), (a, 1 - a))
    np.testing.assert_allclose(ends, [1, 1, 1], atol=2e-3)
    np.testing.assert_allclose(sag_shape(np.array([0.22, 0.78]), (0.22, 0.78)), 0, atol=1e-12)


# --- plans -----------------------------------------------------------------------------------


def test_tracker_plan_is_a_serpentine(rng):
    run = tracker_plan(machine_of("w X b Y Z t"), rng, shape=(4, 3, 2), jitter=0.0)
    assert len(run.q) == 48
    moves = np.diff(run.q[:24], axis=0)
    assert np.all(np.count_nonzero(np.abs(moves) > 1e-9, axis=1) == 1)
    along = np.take_along_axis(moves, np.abs(moves).argmax(axis=1)[:, None], axis=1)[:, 0]
    told = np.take_along_axis(run.direction[1:24], np.abs(moves).argmax(axis=1)[:, None], axis=1)
    np.testing.assert_array_equal(np.sign(along), told[:, 0])
    np.testing.assert_allclose(run.q[24:], run.q[23::-1])
    assert len(tracker_plan(machine_of("w X b Y Z t"), rng).q) == 630


# --- the arm -------------------------------------------------------------------------------------


def test_arm_at_rest_and_its_twist():
    arm = example_arm()
    zero = np.zeros((1, 6))
    frames, origins = arm_frames(arm, zero)
    np.testing.assert_allclose(origins[0, -1], [0.374, 0, 0.63], atol=1e-12)
    np.testing.assert_allclose(frames[0, 0], np.eye(3))
    twist = np.zeros((6, 3))
    twist[0] = [1e-3, 0, 0]
    q = np.array([[np.pi / 2, 0, 0, 0, 0, 0]])
    moved = arm_frames(arm, q, translation=twist)[1][0, -1] - arm_frames(arm, q)[1][0, -1]
    np.testing.assert_allclose(moved, [0, 1e-3, 0], atol=1e-15)  # turned with joint 1
    twist[0] = [0, 0, 1e-3]  # a rotation about z is a joint offset
    offset = q + np.eye(6)[:1] * 1e-3
    np.testing.assert_allclose(
        arm_frames(arm, q, rotation=twist)[1][0, -1], arm_frames(arm, offset)[1][0, -1], atol=1e-15
    )


def test_arm_reflectors_are_rigid_and_effects_move_them():
    clean = make_case("reflectors", seed=4, noise_factor=0)
    distance = np.linalg.norm(clean.readings[:, 0] - clean.readings[:, 1], axis=1)
    np.testing.assert_allclose(distance, distance[0], atol=1e-12)
    own = arm_points(clean.arm, clean.arm_run.q, clean.arm_run.tool)
    p = own @ clean.arm_run.rotation.T + clean.arm_run.origin
    np.testing.assert_allclose(clean.readings, p, atol=1e-14)
    for effect in (
        {"effect": "backlash", "joint": 1, "size_urad": 300},
        {"effect": "gear_harmonic", "joint": 2, "order": 3, "amplitude_urad": 200},
        {"effect": "joint_coupling", "joint": 5, "other": 4, "coefficient": 1e-3},
        {"effect": "joint_compliance", "joint": 1, "coefficient": 2e-5, "mass_kg": 3},
        {"effect": "bearing_compliance", "joint": 1, "coefficient": 2e-5, "mass_kg": 3},
        {"effect": "gear_ripple", "joint": 2, "pitch_deg": 1.8, "amplitude_urad": 200},
        {"effect": "gear_wind_up", "joint": 1, "size_urad": 150, "knee_mm": 15},
        {"effect": "gear_wind_up", "joint": 4, "size_urad": 150, "knee_mm": 30, "masses": "tool"},
        {"effect": "jump", "joint": 0, "size_urad": 100, "t0_s": 1500},
        {"effect": "station_drift", "translation_um_per_h": [50, 0, 0]},
    ):
        bent = make_case("reflectors", seed=4, noise_factor=0, effects=[effect])
        assert 5 * UM < np.abs(bent.readings - clean.readings).max() < 5e-3, effect["effect"]
    lag = {"effect": "readback_lag", "share": 1e-3}
    lagging = make_case("reflectors", seed=4, noise_factor=0, effects=[lag])
    np.testing.assert_array_equal(lagging.readings, clean.readings)
    off = np.deg2rad(lagging.data["q2_cmd_deg"] - lagging.data["q2_read_deg"])[1:]
    np.testing.assert_allclose(off, 1e-3 * np.diff(clean.arm_run.q[:, 1]), atol=1e-12)
