"""The forward model: derivatives, compilation, and instruments against the oracle."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal.model as forward
from known import KINDS, Known, know_all
from oracle import Tracker, tool_point, tracker_readings, write_study
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
    np.testing.assert_allclose(value, observe_all(*args, ports), rtol=0, atol=1e-14)
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
    """With its station where it is declared, and where it is."""
    it = known["laser_tracker"]
    np.testing.assert_allclose(it.readings(), it.case.readings, rtol=1e-12, atol=0)
    nominal = np.where([e.key == "station" for e in it.model.entries], 0.0, it.theta)
    told = Tracker(1e-3 * np.array(it.case.station_mm), np.deg2rad(it.case.euler_xyz_deg))
    expected = tracker_readings(told, tool_point(it.case.machine, it.case.run))
    got = it.readings(theta=nominal)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=0)
    assert np.abs(got - it.case.readings).max() > 1e-4


def test_azimuth_is_compared_across_the_seam(known):
    it = known["laser_tracker"]
    turns = 2 * np.pi * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    off = np.array([[1e-6, 2e-6, -3e-6]])
    got = it.instrument.difference(it.case.readings[:2] + turns + off, it.case.readings[:2])
    np.testing.assert_allclose(got, np.repeat(off, 2, axis=0), rtol=0, atol=1e-14)


def test_ball_residual_vanishes_where_the_oracle_found_the_balls(known):
    it = known["ball_array"]
    assert np.abs(it.readings()).max() < 1e-11
    poses = np.array([e.key == "artefact_pose" for e in it.model.entries])
    assert np.abs(it.readings(theta=np.where(poses, 0.0, it.theta))).max() > 1e-6
    assert np.abs(it.readings(theta=np.where(poses, it.theta, 0.0))).max() > 1e-5


def test_reflectors_are_the_oracles(known):
    """At the base reflectors' mean, which without noise or drift is where they are."""
    it = known["reflectors"]
    expected = it.case.readings.reshape(it.plan.rows, -1)
    np.testing.assert_allclose(it.readings(), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(it.measurement.readings, expected, rtol=0, atol=1e-9)
    assert np.abs(it.readings(theta=0 * it.theta) - expected).max() > 1e-4


# --- compilations, precision -------------------------------------------------------------------


def test_adding_effects_compiles_nothing(known, monkeypatch):
    it = known["laser_tracker"]
    traced = []
    for module, name in ((engine, "_solve_with"), (forward, "observe_row")):
        whole = getattr(module, name)

        def counting(*args, whole=whole, name=name):
            traced.append(name)
            return whole(*args)

        monkeypatch.setattr(module, name, counting)
    room = it.room
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
    # With another number of rows it must: the counter counts.
    predict(it.model, it.plan.take(np.arange(7)), it.theta)
    assert traced == ["observe_row"]


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
