"""The forward model: derivatives, compilation, and instruments against the oracle."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vcal.model as forward
from known import KINDS, Known, know_all
from oracle import Tracker, arm_points, tool_point, tracker_readings, write_study
from vcal import Measurement, close_loop, identify, load_study, predict
from vcal.model import observe_all, observe_row, observe_with_jacobian
from vcal.simulate import prepare, simulate

engine = importlib.import_module("vcal.identify")  # vcal.identify is the function in it


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Known]:
    return know_all(tmp_path_factory.mktemp("known"))


# --- derivatives, compiled and mapped ------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_port_jacobian_against_central_differences(kind, known):
    it = known[kind]
    rng = np.random.default_rng(1)
    size = len(it.model.layout)
    ports = 1e-3 * rng.standard_normal((it.plan.rows, size))
    args = it.chain, it.instrument, it.plan.position, it.instrument.rows(it.plan)
    value, jacobian = observe_with_jacobian(*args, ports)
    np.testing.assert_array_equal(value, observe_all(*args, ports))
    assert jacobian.shape == (*value.shape, size)
    step = 1e-4
    for k, unit in enumerate(step * np.eye(size)):
        slope = (observe_all(*args, ports + unit) - observe_all(*args, ports - unit)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, k], slope, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_predict_compiled_and_mapped_equals_the_plain_loop(kind, known):
    it = known[kind]
    rng = np.random.default_rng(2)
    thetas = it.theta + rng.standard_normal((3, len(it.theta)))
    one = [np.asarray(predict(it.model, it.plan, theta)) for theta in thetas]
    many = jax.jit(jax.vmap(lambda theta: predict(it.model, it.plan, theta)))(thetas)
    np.testing.assert_allclose(many, one, rtol=0, atol=1e-14)
    terms, rows = it.model.terms(it.plan), it.instrument.rows(it.plan)
    ports = np.asarray(forward.port_values(terms, thetas[0], len(it.model.layout)))
    with jax.disable_jit():
        for n in (0, it.plan.rows - 1):
            row = jax.tree.map(lambda leaf, n=n: jnp.asarray(leaf)[n], rows)
            q = jnp.asarray(it.plan.position)[n]
            alone = observe_row(it.chain, it.instrument, q, row, jnp.asarray(ports[n]))
            np.testing.assert_allclose(alone, one[0][n], rtol=0, atol=1e-14)


# --- instruments against the oracle --------------------------------------------------------------


def test_tracker_readings_are_the_oracles(known):
    it = known["laser_tracker"]
    case = it.case
    station = 1e-3 * np.array(case.station_mm)
    euler = np.deg2rad(case.euler_xyz_deg)
    p = tool_point(case.machine, case.run)
    expected = tracker_readings(Tracker(station, euler), p)
    np.testing.assert_allclose(it.readings(), expected, rtol=1e-12, atol=0)
    # Its station elsewhere: translations in the machine's frame, rotations about its own.
    moved, theta = np.array([2.0, -1.0, 0.5, 3.0, 2.0, -4.0]), it.theta.copy()
    theta[[e.key == "station" for e in it.model.entries]] = moved  # mm and mrad
    turned = Rotation.from_euler("XYZ", euler) * Rotation.from_rotvec(1e-3 * moved[3:])
    there = Tracker(station + 1e-3 * moved[:3], turned.as_euler("XYZ"))
    expected = tracker_readings(there, p)
    np.testing.assert_allclose(it.readings(theta=theta), expected, rtol=1e-12, atol=0)


def test_ball_residual_vanishes_where_the_oracle_found_the_balls(known):
    it = known["ball_array"]
    balls, instrument = it.case.balls, it.instrument
    twists = {}
    for k in range(len(balls.origin)):
        turned = Rotation.from_matrix(instrument.pose_rotation[k].T @ balls.rotation[k])
        twist = [*(balls.origin[k] - instrument.pose_origin[k]), *turned.as_rotvec()]
        twists |= {f"{k}.{c}": value for c, value in zip("XYZABC", twist, strict=True)}
    theta = it.theta.copy()
    for i, entry in enumerate(it.model.entries):
        if entry.key == "artefact_pose":
            theta[i] = twists[entry.parameter.name] / entry.parameter.step
    assert np.abs(it.readings(theta=theta)).max() < 1e-11
    assert np.abs(it.readings()).max() > 1e-6  # the poses at their start


def test_reflectors_are_the_oracles(known):
    it = known["reflectors"]
    own = arm_points(it.case.arm, it.case.arm_run.q, it.instrument.points)
    expected = (own - it.instrument.station) @ it.instrument.orientation
    got = it.readings().reshape(expected.shape)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)


# --- random effects, compilations, precision -----------------------------------------------------


def test_adding_effects_compiles_nothing(known, monkeypatch):
    it = known["laser_tracker"]
    traced = []
    for module, name in ((engine, "_solve_with"), (forward, "observe_row")):
        whole = getattr(module, name)

        def counting(*args, whole=whole, name=name):
            traced.append(name)
            return whole(*args)

        monkeypatch.setattr(module, name, counting)
    room = len(it.model.entries) + 16
    identify(it.model, it.measurement, room=room)
    traced.clear()
    for true, unknown, shape in (
        ("backlash:Y:size_um=12", "backlash:Y", {}),
        ("range_scale:offset_um=9,scale_um_per_m=5", "range_scale", {}),
        ("screw_cyclic:X:sine_um=6,cosine_um=2,pitch_mm=20", "screw_cyclic:X", {"pitch": 0.02005}),
    ):
        measurement = Measurement(it.plan, it.readings(it.effect(true)))
        model, shapes = it.model.with_effects(it.effect(unknown)), {2: shape}
        start = np.append(it.theta, np.ones(len(model.entries) - len(it.theta)))
        fit = identify(model, measurement, theta=start, shapes=shapes, room=room)
        assert fit.converged
        assert fit.chi2 < 0.05 * fit.dof
    assert traced == []
    # Beyond the room it must: the counter counts.
    identify(it.model, it.measurement, room=room + 32)
    assert "_solve_with" in traced


def test_float32_is_refused(known, tmp_path):
    it = known["laser_tracker"]
    folder = write_study(tmp_path / "study", it.case)
    theta = np.zeros(len(it.model.entries))
    with jax.enable_x64(False):
        for call in (
            lambda: predict(it.model, it.plan, theta),
            lambda: identify(it.model, it.measurement),
            lambda: close_loop(it.model, it.measurement),
            lambda: load_study(folder),
            lambda: simulate(it.model, it.plan, jax.random.key(0)),
            lambda: prepare(it.model, it.plan),
        ):
            with pytest.raises(RuntimeError, match="float64.*enable_float64"):
                call()
    assert np.isfinite(predict(it.model, it.plan, theta)).all()
