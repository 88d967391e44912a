"""The forward model: derivatives, compilation, and instruments against the oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vcal.identification.identify as engine
import vcal.model.forward as forward
from known import KINDS, Known, know_all
from oracle import Tracker, tool_point, tracker_readings, write_study
from vcal import Measurement, Plan, close_loop, identify, load_study, predict
from vcal.model.forward import observe_all, observe_row, observe_with_jacobian
from vcal.model.simulate import prepare, simulate


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Known]:
    return know_all(tmp_path_factory.mktemp("known"))


# --- derivatives, compiled and mapped ------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
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
@pytest.mark.thorough
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


# --- what does not fit ---------------------------------------------------------------------------


def test_a_plan_with_other_axes_is_refused(known):
    it = known["laser_tracker"]
    turned = Plan(it.plan.axes[::-1], it.plan.position[:, ::-1], it.plan.covariates, it.plan.groups)
    with pytest.raises(ValueError, match="plan: found the axes .*, expected .* in this order"):
        predict(it.model, turned, it.theta)
    with pytest.raises(ValueError, match="plan: found the axes"):
        identify(it.model, Measurement(turned, it.readings()))


@pytest.mark.parametrize("by", (-1, 1))
def test_theta_has_one_value_per_amplitude(by, known):
    it = known["laser_tracker"]
    wrong = np.resize(it.theta, len(it.theta) + by)
    with pytest.raises(ValueError, match=rf"theta: found shape \({len(wrong)},\), expected"):
        predict(it.model, it.plan, wrong)
    with pytest.raises(ValueError, match="theta: found shape"):
        jax.jit(jax.vmap(lambda theta: predict(it.model, it.plan, theta)))(wrong[None])
    with pytest.raises(ValueError, match="theta: found shape"):
        identify(it.model, it.measurement, theta=wrong)


@pytest.mark.parametrize("kind", KINDS)
def test_places_are_those_of_the_entries(kind, known):
    model = known[kind].model
    entries = np.array([entry.effect for entry in model.entries])
    assert len(model.places) == len(model.effects)
    for i, place in enumerate(model.places):
        mine = np.arange(len(entries))[place]
        np.testing.assert_array_equal(mine, np.flatnonzero(entries == i))


def test_theta_of_a_fit_with_shape_parameters_fits(known):
    it = known["laser_tracker"]
    model = it.model.with_effects(it.effect("screw_cyclic:X"))
    shapes = {len(model.effects) - 1: {"pitch": 0.01}}
    theta = 0.1 * np.arange(len(model.entries))
    np.testing.assert_array_equal(
        predict(model, it.plan, np.append(theta, 0.0), shapes),
        predict(model, it.plan, theta, shapes),
    )


def test_readings_are_those_of_the_instrument(known):
    it = known["laser_tracker"]
    one = Measurement(it.plan, it.measurement.readings[:, :1])
    with pytest.raises(ValueError, match="measurement: found 1 readings per row, expected 3"):
        identify(it.model, one)


_PLACES = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((np.zeros((3, 3)),), r"positions of shape \(3, 3\), expected \(rows, 2\)"),
        ((np.zeros(3),), r"positions of shape \(3,\), expected \(rows, 2\)"),
        ((np.where(_PLACES == 0.4, np.nan, _PLACES),), "position nan of Y in row 1"),
        ((_PLACES, {"t": np.arange(2.0)}), r"the covariate 't' of shape \(2,\), expected \(3,\)"),
        ((_PLACES, {}, {"run": np.arange(4)}), r"the group 'run' of shape \(4,\), expected \(3,\)"),
    ],
)
def test_a_plan_whose_parts_do_not_fit_is_refused(given, expected):
    with pytest.raises(ValueError, match=f"plan: found the .*{expected}|plan: found {expected}"):
        Plan(("X", "Y"), *given)


def test_lists_are_arrays():
    plan = Plan(("X", "Y"), _PLACES.tolist(), {"t": [0.0, 1.0, 2.0]}, {"run": [0, 0, 1]})
    np.testing.assert_array_equal(plan.x("Y"), _PLACES[:, 1])
    assert plan.rows == Measurement(plan, [[1.0], [2.0], [3.0]]).readings.shape[0]
    with pytest.raises(ValueError, match=r"readings of shape \(3,\) do not fit"):
        Measurement(plan, [1.0, 2.0, 3.0])


def test_a_plan_is_made_of_what_is_traced():
    def furthest(position):
        return jnp.sum(Plan(("X", "Y"), position, {"t": position[:, 0]}).x("X"))

    many = jax.jit(jax.vmap(jax.grad(furthest)))(np.stack([_PLACES, _PLACES]))
    np.testing.assert_array_equal(many[..., 0], 1.0)
    jax.eval_shape(lambda p: p.x("X"), Plan(("X", "Y"), jax.ShapeDtypeStruct((3, 2), float)))
