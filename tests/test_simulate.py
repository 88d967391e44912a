"""Simulation: its exact limits, its statistics, the positions a ball array finds."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcal import StudyError, identify, load_study, predict
from vcal.design.judged import grid_points
from vcal.effects.base import Setup
from vcal.model.forward import Model
from vcal.model.simulate import (
    Truth,
    conditions_at,
    draw,
    draw_truth,
    prepare,
    scattered,
    simulate,
    true_tool_points,
)
from vcal.study.simulated import parse_with, write_simulated

KEY = jax.random.key(3)


def effect(study, text):
    model = study.model
    setup = Setup(study.chain, model.layout, study.plan, model.effects, study.instrument.artefact)
    return parse_with(text, study.catalogue, setup)


def nothing(model):
    return Truth(np.zeros(len(model.entries)), {})


@pytest.fixture
def tracker(small_tracker_study):
    return load_study(small_tracker_study)


@pytest.fixture
def balls(small_ball_study):
    return load_study(small_ball_study)


# --- a tracker that stands elsewhere -------------------------------------------------------------

READ = ("range", "azimuth", "elevation")
ELSEWHERE = {"instrument.station_mm": [0, 0, 0]}
"""Where the tracker was declared to be, 1.2 m from where it is."""


@pytest.mark.thorough
def test_encoders_turn_by_what_they_read(small_tracker_study, tmp_path):
    """An eccentric encoder has the same size, wherever the station was declared to be."""
    declared = {"name": "encoder_eccentricity", "placement": "azimuth"}
    with_it = {"model.effect": [declared]}
    study = load_study(small_tracker_study)
    made = tmp_path / "made"
    encoder = effect(study, "encoder_eccentricity:azimuth:sine_urad=40,cosine_urad=10")
    write_simulated(study, made, effects=[encoder], seed=2)
    here, there = (load_study(made, with_it | more) for more in ({}, ELSEWHERE))
    for name, column in zip(READ, here.measurement.readings.T, strict=True):
        np.testing.assert_array_equal(here.plan.covariate(name), column)
        np.testing.assert_array_equal(there.plan.covariate(name), column)
    one, other = (identify(s.model, s.measurement) for s in (here, there))
    assert other.chi2 == pytest.approx(one.chi2, rel=1e-4)
    np.testing.assert_allclose(other.theta[-2:], one.theta[-2:], atol=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("joint", [False, True])
def test_a_tracker_is_simulated_where_it_is_declared(small_tracker_study, tmp_path, joint):
    """Angles in the plan are those of the readings that were made, not of those before."""
    if joint:
        setup = small_tracker_study / "setup.toml"
        head, rest = setup.read_text(encoding="utf-8").split("[instrument]")
        own, model = rest.split("[model.geometric]")
        rows = [f'[[data]]\nname = "{n}"\nfile = "{n}.csv"\n[data.instrument]{own}' for n in "ab"]
        setup.write_text(f"{head}{''.join(rows)}[model.geometric]{model}", encoding="utf-8")
        header, *lines = (small_tracker_study / "data.csv").read_text("utf-8").splitlines()
        for name, part in (("a", lines[:24]), ("b", lines[24:])):
            table = "\n".join([header, *part])
            (small_tracker_study / f"{name}.csv").write_text(table, encoding="utf-8")
    sets = ("a:", "b:") if joint else ("",)
    key = "data.{}.instrument.station_mm" if joint else "instrument.station_mm"
    more = {key.format(i): [0, 0, 0] for i in range(len(sets))}
    study = load_study(small_tracker_study, more)
    made = write_simulated(study, tmp_path / "made", noise_factor=0.0, overrides=more)
    again = load_study(tmp_path / "made")
    for name in sets:
        for column in READ:
            values = made.measurement.plan.values(name + column)
            there = np.isfinite(values)
            np.testing.assert_allclose(
                values[there], again.plan.values(name + column)[there], rtol=0, atol=1e-8
            )
            old = study.plan.values(name + column)[there]
            assert np.abs(values[there] - old).max() > 0.05


# --- exact limits --------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_perfect_machine_reads_nominal(tracker):
    model, plan = tracker.model, tracker.plan
    found = simulate(model, plan, KEY, truth=nothing(model), noise_factor=0.0)
    v = np.asarray(plan.position) + [0, 0, -0.15] - [-0.9, 0.3, 0.7]
    np.testing.assert_allclose(
        found.measurement.readings[:, 0], np.linalg.norm(v, axis=1), atol=1e-14
    )
    np.testing.assert_array_equal(found.noise, 0.0)
    for name, values in plan.covariates.items():
        if name not in ("range", "azimuth", "elevation"):
            np.testing.assert_array_equal(found.measurement.plan.covariate(name), values)
    np.testing.assert_array_equal(found.measurement.plan.position, plan.position)
    points = found.tool_points(plan)
    np.testing.assert_allclose(points, np.asarray(plan.position) + [0, 0, -0.15], atol=1e-15)


@pytest.mark.thorough
def test_readings_are_those_of_the_forward_model(tracker):
    model, plan = tracker.model, tracker.plan
    found = simulate(model, plan, KEY)
    expected = predict(model, plan, jnp.asarray(found.theta))
    np.testing.assert_allclose(found.ideal, expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found.measurement.readings, found.ideal + found.noise)


def test_only_effects_of_the_machine_move_the_tool(tracker):
    model, plan = tracker.model, tracker.plan
    model = model.with_effects(
        effect(tracker, "backlash:Y:size_um=12"), effect(tracker, "range_scale:offset_um=50")
    )
    points = true_tool_points(model, plan, nothing(model))
    moved = points - np.asarray(plan.position) - [0, 0, -0.15]
    expected = np.zeros_like(moved)
    expected[:, 1] = 6e-6 * np.asarray(plan.covariate("dir_Y"))
    np.testing.assert_allclose(moved, expected, atol=1e-15)


# --- draws ---------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_the_key_alone_decides(tracker):
    model, plan = tracker.model, tracker.plan
    first, again = simulate(model, plan, KEY), simulate(model, plan, KEY)
    np.testing.assert_array_equal(first.measurement.readings, again.measurement.readings)
    other = simulate(model, plan, jax.random.key(4))
    assert np.abs(other.theta - first.theta).max() > 0.1
    # A further effect leaves the machine and the noise as they were.
    more = simulate(model, plan, KEY, effects=[effect(tracker, "backlash:Y")])
    np.testing.assert_array_equal(more.theta[:-1], first.theta)
    np.testing.assert_array_equal(more.noise, first.noise)
    quiet = simulate(model, plan, KEY, noise_factor=0.5)
    np.testing.assert_allclose(quiet.noise, 0.5 * first.noise, rtol=1e-15)


@pytest.mark.thorough
def test_compiled_and_mapped_draws_are_the_single_ones(tracker):
    simulator = prepare(tracker.model, tracker.plan)
    keys = jax.random.split(KEY, 4)
    traces = []

    @eqx.filter_jit
    def mapped(simulator, keys):
        traces.append(1)
        return jax.vmap(lambda key: draw(simulator, key))(keys)

    theta, readings, _ = mapped(simulator, keys)
    mapped(simulator, jax.random.split(jax.random.key(9), 4))
    assert len(traces) == 1
    for i, key in enumerate(keys):
        one = draw(simulator, key)
        # Compiled, products and sums may be fused: the last bit is not the same.
        np.testing.assert_allclose(theta[i], one[0], rtol=1e-14)
        np.testing.assert_allclose(readings[i], one[1], rtol=0, atol=2e-15)
        found = simulate(tracker.model, tracker.plan, key)
        np.testing.assert_allclose(theta[i], found.theta, rtol=1e-14)
        np.testing.assert_allclose(readings[i], found.measurement.readings, rtol=0, atol=2e-15)


@pytest.mark.thorough
def test_draws_have_the_declared_spread(tracker):
    simulator = prepare(tracker.model, tracker.plan)
    keys = jax.random.split(KEY, 200)
    theta, readings, _ = eqx.filter_jit(jax.vmap(draw, (None, 0)))(simulator, keys)
    informed = np.array([e.parameter.informed for e in tracker.model.entries])
    assert (np.asarray(theta)[:, ~informed] == 0).all()  # a flat prior stays nominal
    drawn = np.asarray(theta)[:, informed]
    assert np.abs(drawn.mean(0)).max() < 4.5 / np.sqrt(200)
    assert np.abs(drawn.std(0) - 1).max() < 4.5 / np.sqrt(400)
    # The machine drops out of the difference between two draws that differ in their noise only.
    louder = eqx.tree_at(lambda s: s.sigma, simulator, 2.0 * simulator.sigma)
    _, more, _ = eqx.filter_jit(jax.vmap(draw, (None, 0)))(louder, keys)
    noise = np.asarray(more - readings) / np.asarray(simulator.sigma)
    assert abs(noise.std() - 1) < 4.5 / np.sqrt(2 * noise.size)
    r = np.linalg.norm(np.asarray(tracker.plan.position) + [0.9, -0.3, -0.85], axis=1)
    np.testing.assert_allclose(simulator.sigma[:, 0], 1.3e-6 + 0.27e-6 * r, rtol=1e-12)


@pytest.mark.thorough
def test_random_effects_are_fresh_in_every_row(tracker):
    model = tracker.model.with_effects(effect(tracker, "repeatability:X:size_um=3"))
    perfect = nothing(model)
    found = simulate(model, tracker.plan, KEY, truth=perfect, noise_factor=0.0)
    nominal = simulate(tracker.model, tracker.plan, KEY, truth=perfect, noise_factor=0.0)
    along = np.asarray(tracker.plan.position) + [0.9, -0.3, -0.85]
    direction = along[:, 0] / np.linalg.norm(along, axis=1)
    displaced = (found.ideal - nominal.ideal)[:, 0] / direction
    assert 2.2e-6 < displaced.std() < 3.9e-6
    assert abs(np.corrcoef(displaced[1:], displaced[:-1])[0, 1]) < 0.45


def test_shape_parameters(tracker):
    free = effect(tracker, "screw_cyclic:X:sine_um=6")
    fixed = effect(tracker, "screw_cyclic:X:pitch_mm=20,sine_um=6")
    model = Model(tracker.chain, tracker.instrument, (free, fixed))
    pitches = []
    for seed in range(30):
        truth = draw_truth(model, tracker.plan, jax.random.key(seed))
        assert truth.shapes[1]["pitch"] == pytest.approx(0.02)
        pitches.append(truth.shapes[0]["pitch"])
    # Uniform in 1/pitch from a quarter of the travel covered to the finest pitch.
    waves = 1.0 / np.array(pitches)
    assert 4 / 1.8 <= waves.min() and waves.max() <= 250.0
    assert 80 < waves.mean() < 170
    found = simulate(model, tracker.plan, KEY)
    values = {p.label: value for p, value in found.values(fixed)}
    assert values["pitch_mm"] == pytest.approx(20)
    assert values["sine_um"] == pytest.approx(6)
    assert values["cosine_um"] == pytest.approx(3 * found.theta[3])


def test_values_of_an_effect_that_is_not_there(tracker):
    found = simulate(tracker.model, tracker.plan, KEY)
    with pytest.raises(ValueError, match="'backlash Y' is not in the model, which has geometric"):
        found.values(effect(tracker, "backlash:Y"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise_factor": -1.0}, "noise_factor: found -1.0, expected"),
        ({"truth": Truth(np.zeros(3), {})}, r"truth: found theta of shape \(3,\), expected"),
    ],
)
def test_what_cannot_be_simulated(tracker, options, message):
    with pytest.raises(ValueError, match=message):
        simulate(tracker.model, tracker.plan, KEY, **options)


# --- ball arrays ---------------------------------------------------------------------------------


@pytest.mark.campaign
def test_the_tool_sits_in_the_ball_at_the_positions_found(balls):
    model = balls.model.with_effects(
        effect(balls, "screw_cyclic:X:pitch_mm=9,sine_um=8"),
        effect(balls, "scale_growth:Y:alpha_um_per_m_K=40"),
    )
    found = simulate(model, balls.plan, KEY, noise_factor=0.0)
    plan = found.measurement.plan
    assert np.abs(found.ideal).max() < 1e-11
    np.testing.assert_array_equal(found.measurement.readings, 0.0)
    # The same from its parts: true tool point, ball centre as calibrated and its true error.
    centres, rotation, origin = balls.instrument.rows(plan)
    start = len(model.effects[0].amplitudes) + len(model.effects[1].amplitudes)
    errors = found.theta[start : start + 18].reshape(6, 3) * 0.8e-6
    centres = centres + errors[np.asarray(plan.groups["ball"])]
    ball = origin + np.einsum("nij,nj->ni", rotation, centres)
    assert np.abs(found.tool_points(plan) - ball).max() < 1e-11
    # Machine and artefact are wrong by micrometres, and so are the positions.
    moved = np.asarray(plan.position - balls.plan.position)
    assert 1e-6 < np.abs(moved).max() < 1e-3


@pytest.mark.thorough
def test_probing_noise_is_in_the_positions(balls):
    exact = simulate(balls.model, balls.plan, KEY, noise_factor=0.0).measurement.plan.position
    found = simulate(balls.model, balls.plan, KEY)
    noise = np.asarray(found.measurement.plan.position - exact)
    np.testing.assert_allclose(noise, found.noise, atol=1e-15)
    assert abs(noise.std() / 0.7e-6 - 1) < 4.5 / np.sqrt(2 * noise.size)


def test_calibrated_balls_are_wrong_as_declared(balls):
    place = [e.name for e in balls.model.effects].index("ball_calibration")
    start = sum(len(e.amplitudes) for e in balls.model.effects[:place])
    drawn = np.array(
        [
            draw_truth(balls.model, balls.plan, jax.random.key(seed)).theta[start : start + 18]
            for seed in range(40)
        ]
    )
    assert balls.model.effects[place].amplitudes[0].sigma == pytest.approx(0.8)
    assert abs(drawn.std() - 1) < 4.5 / np.sqrt(2 * drawn.size)


@pytest.mark.thorough
def test_a_tool_that_does_not_follow_its_axes(balls):
    backwards = dataclasses.replace(effect(balls, "scale_growth:X"), given=(("alpha", -4e6, 0.0),))
    with pytest.raises(
        StudyError, match="no axis positions at the ball centres: found .* expected"
    ):
        simulate(balls.model, balls.plan, KEY, effects=[backwards], noise_factor=0.0)


# --- the other end -------------------------------------------------------------------------------


def test_a_fit_finds_the_truth_again(tracker):
    found = simulate(tracker.model, tracker.plan, KEY)
    fit = identify(tracker.model, found.measurement)
    assert 0.7 < fit.chi2 / fit.dof < 1.4
    z = (fit.theta - found.theta) / np.sqrt(np.diag(fit.covariance))
    assert abs(np.sqrt(np.mean(z**2)) - 1) < 0.3


@pytest.mark.thorough
def test_tables_hold_what_is_in_the_files_and_no_more(tracker, balls):
    for study in (tracker, balls):
        found = simulate(study.model, study.plan, KEY).measurement
        table = study.instrument.to_table(found.plan, found.readings)
        own = set((study.folder / "data.csv").read_text().splitlines()[0].split(","))
        assert set(table) == own


@pytest.mark.thorough
def test_scattered_conditions(tracker):
    plan = scattered(tracker.chain, tracker.plan, KEY, 300)
    position = np.asarray(plan.position)
    assert (position >= 0).all() and (position <= [2.0, 1.0, 0.6]).all()
    assert (position.max(0) - position.min(0) > [1.9, 0.95, 0.57]).all()
    assert set(np.unique(plan.covariate("dir_Z"))) == {-1.0, 1.0}
    # Conditions of one row belong together.
    pairs = set(zip(tracker.plan.covariate("t"), tracker.plan.covariate("T_X"), strict=True))
    assert set(zip(plan.covariate("t"), plan.covariate("T_X"), strict=True)) <= pairs


@pytest.mark.campaign
@pytest.mark.parametrize("joints", ["read", "commanded"])
def test_angles_commanded_and_read_go_with_the_position(joints, small_arm_study):
    """Elsewhere an arm reads back what it would there, not what it did at the pose measured."""
    arm = load_study(small_arm_study, [f"instrument.joints={joints}"])
    rows, kinds = np.full(5, arm.plan.rows // 2), ("commanded", "read")
    turned = np.asarray(arm.plan.position)[:5] + np.deg2rad([40.0, -50.0, 60.0])
    for found, expected in [
        (scattered(arm.chain, arm.plan, KEY, 30), None),
        (grid_points(arm.chain, arm.plan, (3, 3, 3)), None),
        (conditions_at(arm.plan, turned), rows),
    ]:
        own, there = (
            np.stack([np.asarray(p.covariate(f"{k}_{a}")) - p.x(a) for k in kinds for a in p.axes])
            for p in (arm.plan, found)
        )
        # By the row from which the conditions are; of those picked at random any will do.
        nearest = np.abs(there[:, :, None] - own[:, None]).max(0).argmin(1)
        if expected is not None:
            np.testing.assert_array_equal(nearest, expected)
        np.testing.assert_allclose(there, own[:, nearest], rtol=0, atol=1e-14)
    if joints == "commanded":  # what is read does not count, and may lag
        with pytest.raises(StudyError, match="readback_lag.*no place here"):
            effect(arm, "readback_lag:share=1")
        return
    # What was commanded is some thousandths of a degree off, at an arm's length of about 1 m.
    lag = effect(arm, "readback_lag:share=1")
    for plan in (scattered(arm.chain, arm.plan, KEY, 30), conditions_at(arm.plan, turned)):
        off = [
            true_tool_points(model, plan, nothing(model))
            for model in (arm.model, arm.model.with_effects(lag))
        ]
        assert np.abs(off[1] - off[0]).max() < 3e-4
