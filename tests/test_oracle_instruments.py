"""The oracle's laser frame, R-test and what is in no catalogue, against closed forms and vcal."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from oracle import (
    FRAME_SMOOTH,
    FRAME_TABLE,
    Frame,
    Run,
    draw_matrix,
    draw_smooth,
    error_motions,
    frame_plan,
    frame_readings,
    make_case,
    measure_circles,
    moved,
    nominal_machine,
    tool_point,
    with_errors,
    with_strays,
)
from oracle.effects import recorded, spindle_growth
from oracle.kinematics import normalised
from oracle.r_test import RADIUS, circle
from vcal import identify, load_study
from vcal.loop.close_loop import close_loop

TRAVEL, TOOL = (0.5, 0.4, 0.35), (0.0, 0.0, -0.1)
STILL = Frame(np.zeros(3), np.zeros(3))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def machine_of(chain: str = "w b X Y Z t"):
    return nominal_machine(chain, TRAVEL, TOOL)


def at(q, **extra) -> Run:
    """Return a run at positions q (n, 3), at 20 degC and in the positive direction."""
    q = np.atleast_2d(np.asarray(q, dtype=float))
    warm = np.full(q.shape, 20.0)
    return Run(q, np.ones(q.shape), 10.0 * np.arange(len(q)), warm, warm[:, 0], extra=extra)


def shift(effect: dict, run: Run) -> np.ndarray:
    return tool_point(machine_of(), run, [effect]) - run.q - TOOL


# --- families and effects ------------------------------------------------------------------------


def test_smooth_family_has_the_declared_covariance():
    """Over 1500 machines, between the nodes as well: k(d) = s^2 (1 + r + r^2/3) exp(-r)."""
    q = np.array([[0.02, 0.1, 0.3], [0.1, 0.11, 0.05], [0.41, 0.35, 0.2]])
    drawn = np.array([
        np.concatenate(error_motions(draw_smooth(machine_of(), rng, FRAME_SMOOTH), q), axis=2)
        for rng in map(np.random.default_rng, range(1500))
    ])  # fmt: skip
    found = np.einsum("dniv,dmiv->nmiv", drawn, drawn) / len(drawn)
    apart = np.abs(q[:, None] - q)[..., None] / np.array(TRAVEL)[:, None] / FRAME_SMOOTH.smoothness
    r = np.sqrt(5) * apart
    sizes = np.repeat([FRAME_SMOOTH.translation, FRAME_SMOOTH.rotation], 3)
    expected = (1 + r + r**2 / 3) * np.exp(-r) * sizes**2
    np.testing.assert_allclose(found / sizes**2, expected / sizes**2, atol=0.13)


def test_a_slope_that_changes():
    kink = {"effect": "kink", "axis": "X", "component": "Z", "coefficient": 1e-4, "at_mm": 200}
    got = shift(kink, at([[0.1, 0, 0], [0.2, 0, 0], [0.35, 0, 0]]))
    np.testing.assert_allclose(got[:, 2], [0, 0, 1.5e-5], atol=1e-15)


def test_a_legendre_degree():
    order = {"effect": "geometric_order", "axis": "Y", "degree": 4, "size_um": 8}
    run = at([[0, 0, 0], [0, 0.3, 0], [0, 0.4, 0]])
    u = np.array([-1, 0.5, 1])
    expected = 1e-6 * (35 * u**4 - 30 * u**2 + 3)
    np.testing.assert_allclose(shift(order, run)[:, 1], expected, atol=1e-15)


@pytest.mark.parametrize(("axis", "along"), [("X", 0), ("Y", 1)])
def test_a_ram_that_sags(axis, along):
    """The slope of the tip is that of the cantilever, whose fall it is the derivative of."""
    sag = {"effect": "payload_sag", "axis": axis, "um_per_kg": 0.2}
    q = np.zeros((3, 3))
    q[:, along] = np.array([0, 0.5, 1]) * TRAVEL[along]
    got = shift(sag, at(q, payload_kg=np.full(3, 50.0)))
    np.testing.assert_allclose(got[:, 2], -1e-5 * np.array([0, 0.125, 1]), atol=1e-9)
    # A tool 0.1 m below the tip is carried inwards as it turns downwards: 1.5 c m s^2 / L.
    turned = 1.5e-5 / TRAVEL[along] * np.array([0, 0.25, 1])
    np.testing.assert_allclose(got[:, along], -0.1 * turned, atol=1e-9)


def test_a_spindle_grows_as_its_equation_says():
    speed = np.repeat([3000.0, -12000.0, 0.0], 40)
    run = dataclasses.replace(at(np.zeros((120, 3))), extra={"speed_rpm": speed})
    got = spindle_growth({"size": 2e-5, "tau": 300.0}, run)

    def rate(t, g):
        return (2e-5 * abs(speed[min(int(t // 10), 119)]) / 12000 - g) / 300.0

    exact = solve_ivp(rate, (0, run.t[-1]), [0.0], t_eval=run.t, max_step=1.0, rtol=1e-8).y[0]
    np.testing.assert_allclose(got, exact, atol=1e-8)


def test_a_sensor_that_sticks_changes_the_record_only():
    effects = [
        {"effect": "scale_growth", "axis": "Y", "um_per_m_K": 11},
        {"effect": "stuck_sensor", "axis": "Y", "t0_s": 1500},
    ]
    true, stuck = (make_case("laser_tracker", seed=2, effects=effects[:k]) for k in (1, 2))
    for name in true.data:
        if name != "T_y_degC":
            np.testing.assert_array_equal(true.data[name], stuck.data[name])
    late = stuck.run.t >= 1500
    np.testing.assert_array_equal(true.data["T_y_degC"][~late], stuck.data["T_y_degC"][~late])
    assert np.ptp(stuck.data["T_y_degC"][late]) == 0 and np.ptp(true.data["T_y_degC"][late]) > 0.1
    assert recorded(true.run, effects[:1]).temperature is not true.run.temperature


# --- laser frame ---------------------------------------------------------------------------------


def test_a_frame_sees_nothing_where_nothing_moved(rng):
    run = frame_plan(machine_of(), rng, runs=2)
    np.testing.assert_allclose(frame_readings(machine_of(), run, STILL), 0, atol=1e-18)
    assert len(run.t) == 102 and (run.extra["path_mm"][:51] == run.extra["path_mm"][:50:-1]).all()


def beams(run: Run, number: int) -> np.ndarray:
    return run.extra["segment"] == number


def test_a_frame_reads_across_its_beams(rng):
    """u, v are the two of x, y, z that the beam does not run along; segments 1 and 3 run along Y,
    2 and 4 along X, 5 along Z.
    """
    run = frame_plan(machine_of(), rng, runs=1)
    moving = with_errors(machine_of(), {"EXX": [1e-6], "EYX": [2e-6], "EZX": [4e-6]})
    got = 1e6 * frame_readings(moving, run, STILL)
    for number, expected in ((1, (1, 4)), (3, (1, 4)), (2, (2, 4)), (4, (2, 4)), (5, (1, 2))):
        np.testing.assert_allclose(got[beams(run, number)], np.tile(expected, (11, 1))[
            : beams(run, number).sum()], atol=1e-9)  # fmt: skip


def test_a_frame_that_moves(rng):
    """It turns about the middle of its beams; what it does, the machine seems to do the other way
    round.
    """
    run = frame_plan(machine_of(), rng, runs=1)
    turned = Frame(np.array([1e-6, 0, 0]), np.array([0, 0, 1e-5]))
    got = frame_readings(machine_of(), run, turned)
    middle = np.array(TRAVEL) / 2
    along_y = beams(run, 1) | beams(run, 3)
    expected = -1e-6 + 1e-5 * (run.q[:, 1] - middle[1])
    np.testing.assert_allclose(got[along_y, 0], expected[along_y], atol=1e-10)


def test_effects_of_a_frame(rng):
    run = frame_plan(machine_of(), rng, runs=2, diode=True)
    head, gradient = run.extra["T_head_degC"] - 20, run.extra["T_gradient_z_K_per_m"]
    level = ~beams(run, 5)  # z is read second
    s = 1e-3 * run.extra["path_mm"]
    half = run.q[:, 2] / TRAVEL[2] - 0.5
    for effect, expected in [
        ({"effect": "head_expansion", "um_per_K": 0.5}, -0.5e-6 * head),
        ({"effect": "frame_expansion", "axis": "Z", "um_per_K": 0.5}, -0.5e-6 * head * half),
        ({"effect": "refraction", "coefficient": 1e-6}, 0.5e-6 * gradient * s**2),
        ({"effect": "psd_linearity", "reading": "v", "a": 1e-3},
         1e-6 * run.extra["psd_v_mm"]),
        ({"effect": "station_drift", "translation_um_per_s": [0, 0, 0.001]}, -1e-9 * run.t),
        ({"effect": "station_jump", "translation_um": [0, 0, 2], "t0": run.t[60]},
         -2e-6 * (run.t >= run.t[60])),
    ]:  # fmt: skip
        got = frame_readings(machine_of(), run, STILL, [effect])
        np.testing.assert_allclose(got[level, 1], expected[level], atol=1e-12)


# --- R-test --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sense", [1, -1])
def test_a_circle_is_its_own_derivative(sense):
    omega, turn = np.sqrt(2.0 / RADIUS), np.linspace(0.1, 6.2, 4001)
    c = circle("ZX", sense, 2.0, turn)
    t = turn / omega
    inner = slice(2, -2)
    v, a = np.gradient(c.position, t, axis=0), np.gradient(c.velocity, t, axis=0)
    np.testing.assert_allclose(c.velocity[inner], v[inner], atol=2e-6)
    np.testing.assert_allclose(c.acceleration[inner], a[inner], atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(c.acceleration, axis=1), 2.0, rtol=1e-12)
    np.testing.assert_array_equal(c.way, np.sign(np.round(c.velocity, 12)))
    # The way since the last reversal grows at the speed, and starts anew where the sense changes.
    step = np.diff(c.since[:, [0, 2]], axis=0)
    same = c.way[1:, [0, 2]] == c.way[:-1, [0, 2]]
    far = np.abs(np.diff(c.position[:, [0, 2]], axis=0))
    np.testing.assert_allclose(step[same], far[same], atol=1e-12)
    assert np.abs(c.since[1:, [0, 2]][~same]).max() < 1e-8


def test_effects_on_a_circle(rng):
    c = circle("XY", 1, 4.5, np.linspace(0, 6, 50))
    e = draw_matrix(rng)
    for effect, expected in [
        ({"effect": "acceleration_crosstalk", "matrix": e}, c.acceleration @ e.T),
        ({"effect": "servo_lag", "T_ms": 0.02}, -2e-5 * c.velocity),
        ({"effect": "servo_lag", "axis": "Y", "T_ms": 0.02}, -2e-5 * c.velocity * [0, 1, 0]),
        ({"effect": "backlash", "axis": "X", "size_um": 3}, 1.5e-6 * c.way * [1, 0, 0]),
        ({"effect": "lateral_reversal", "axis": "X", "component": "Z", "size_um": 3},
         1.5e-6 * c.way[:, :1] * [0, 0, 1]),
        ({"effect": "scale_interpolation", "axis": "Y", "amplitude_um": 0.2, "period_um": 40},
         2e-7 * np.sin(2 * np.pi * c.position / 4e-5) * [0, 1, 0]),
        ({"effect": "reversal_spike", "size_um": 2, "decay_mm": 0.1},
         -2e-6 * c.way * np.exp(-c.since / 1e-4)),
        ({"effect": "stribeck_friction", "axis": "X", "size_um": 2, "speed_mm_per_s": 20},
         -2e-6 * c.way * np.exp(-np.abs(c.velocity) / 0.02) * [1, 0, 0]),
        ({"effect": "coulomb_friction", "axis": "Y", "size_um": 2, "speed_mm_per_s": 20},
         -2e-6 * np.tanh(c.velocity / 0.02) * [0, 1, 0]),
        ({"effect": "drift", "component": "Z", "um_per_s": 3},
         3e-6 * c.time[:, None] * [0, 0, 1]),
    ]:  # fmt: skip
        np.testing.assert_allclose(moved(c, [effect]), expected, atol=1e-15)
    with pytest.raises(ValueError, match="no such effect on a circle"):
        moved(c, [{"effect": "jump"}])


# --- stray readings ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", ["laser_tracker", "ball_array", "laser_frame", "r_test", "reflectors"]
)
def test_readings_that_go_astray(kind):
    case = make_case(kind, seed=4)
    bad = with_strays(case, 0.02, seed=4)
    rows = bad.truth["strays"]
    n = len(next(iter(case.data.values())))
    assert len(rows) == round(0.02 * n) == len(set(rows))
    off = np.stack([(bad.data[c] - case.data[c]) / s for c, s in case.noise.items()], axis=1)
    assert ((off != 0).sum(1) == np.isin(np.arange(n), rows)).all()
    assert np.abs(off[rows]).max(1).min() > 14.9 and np.abs(off).max() < 60.1
    assert all((bad.data[c] == case.data[c]).all() for c in case.data if c not in case.noise)


# --- in vcal -------------------------------------------------------------------------------------

CLEAN = [
    ("laser_frame", {"family": FRAME_SMOOTH, "chain": "w X b Y Z t"}),
    pytest.param(
        "laser_frame", {"table": FRAME_TABLE, "chain": "w b X Y Z t"}, marks=pytest.mark.thorough
    ),
    ("r_test", {"plan": {"samples": 40, "levels": (1.0, 4.5)}}),
]


@pytest.mark.parametrize(("kind", "options"), CLEAN)
@pytest.mark.thorough
def test_a_clean_case_is_noise_to_vcal(kind, options, tmp_path):
    """With noise chi2 is that of noise, without it next to nothing is left."""
    for noise, low, high in ((1.0, 0.85, 1.15), (0.0, 0.0, 0.02)):
        folder = tmp_path / f"{noise:g}"
        make_case(kind, seed=1, noise_factor=noise, folder=folder, **options)
        study = load_study(folder)
        fit = identify(study.model, study.measurement, room=len(study.model.entries) + 16)
        assert fit.converged and low <= fit.chi2 / fit.dof < high


@pytest.mark.campaign
@pytest.mark.parametrize(("kind", "options"), CLEAN)
def test_nothing_is_missing_from_a_clean_case(kind, options, tmp_path):
    make_case(kind, seed=1, folder=tmp_path, **options)
    study = load_study(tmp_path)
    found = close_loop(study.model, study.measurement, check=study.check, draws=200)
    assert found.verdict == "nothing_missing"
    if study.check is not None:
        assert found.errors["after"].check.value < 0.6 * found.errors["uncompensated"].check.value


def test_a_matrix_may_be_declared(tmp_path, rng):
    """What is declared is taken off: nothing remains of it."""
    effects = [{"effect": "acceleration_crosstalk", "matrix": draw_matrix(rng)}]
    told = [{"name": "acceleration_crosstalk",
             "matrix_um_s2_per_m": (1e6 * effects[0]["matrix"]).tolist()}]  # fmt: skip
    plan = {"samples": 40, "levels": (1.0, 4.5)}
    chi2 = []
    for declared in (told, []):
        folder = tmp_path / f"{len(declared)}"
        make_case("r_test", seed=3, effects=effects, declared=declared, plan=plan, folder=folder)
        study = load_study(folder)
        fit = identify(study.model, study.measurement, room=len(study.model.entries) + 16)
        chi2.append(fit.chi2 / fit.dof)
    assert 0.85 < chi2[0] < 1.15 and chi2[1] > 10


def test_circles_are_the_same_for_the_same_seed():
    one, two = (measure_circles([], np.random.default_rng(8), samples=20) for _ in range(2))
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])


def test_shares_of_the_travel():
    np.testing.assert_allclose(
        normalised(machine_of(), np.array([[0.125, 0.4, 0]])), [[-0.5, 1, -1]]
    )
