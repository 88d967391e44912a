"""Identification in batches, virtual calibration, and the GUM through the identification."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from clusters import LEAKS, client_of
from known import know_all
from vcal import Measurement, StudyError, identify
from vcal.identification.batch import identify_alone, identify_one, prepare_batch
from vcal.model.forward import Model
from vcal.model.simulate import draw, draw_truth, prepare
from vcal.numerics.compiled import jit_outermost
from vcal.uncertainty import (
    ErrorMotionErrors,
    ParameterErrors,
    VolumetricErrors,
    compare,
    linearised,
    monte_carlo,
    virtual_pair,
)
from vcal.uncertainty.campaign import _Evaluate
from vcal.uncertainty.cluster import _Work


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return know_all(tmp_path_factory.mktemp("known"))


def distance(batch, a, b):
    """Between two solutions, in posterior standard deviations."""
    d = np.asarray(a) - np.asarray(b)
    return float(np.sqrt(d @ np.linalg.solve(np.asarray(batch.inverse), d)))


# --- batches ---


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("laser_tracker", marks=pytest.mark.campaign),
        pytest.param("ball_array", marks=pytest.mark.campaign),
    ],
)
def test_a_draw_is_identified_as_alone(kind, known):
    it = known[kind]
    batch, simulator = prepare_batch(it.model, it.plan), prepare(it.model, it.plan)
    measure = jit_outermost(lambda key: draw(simulator, key))
    solve = jit_outermost(lambda y: identify_one(batch, y))
    for seed in range(2):
        made = measure(jax.random.key(seed))
        found = solve(made.readings)
        # With the same whitener: the noise that is declared depends a little on the readings.
        fit = identify(
            it.model,
            Measurement(it.plan, np.asarray(made.readings)),
            whitener=np.asarray(batch.whitener),
            room=it.room,
        )
        assert bool(found.converged)
        assert distance(batch, found.theta, fit.theta) < 1e-3
        linear, _ = batch.linear(made.readings)
        assert distance(batch, linear, fit.theta) > distance(batch, found.theta, fit.theta)


@pytest.mark.campaign
def test_an_arm_is_identified_with_a_curvature_of_its_own(known):
    it = known["reflectors"]
    batch, simulator = prepare_batch(it.model, it.plan), prepare(it.model, it.plan)
    assert not batch.shared
    assert batch.contraction > 1.0
    made = jax.jit(lambda key: draw(simulator, key))(jax.random.key(1))
    found = jax.jit(lambda y: identify_alone(batch, y))(made.readings)
    assert bool(found.converged)
    fit = identify(
        it.model,
        Measurement(it.plan, np.asarray(made.readings)),
        whitener=np.asarray(batch.whitener),
        room=it.room,
    )
    root = np.linalg.cholesky(np.linalg.inv(fit.jacobian.T @ fit.jacobian + np.diag(fit.precision)))
    away = np.linalg.norm(np.linalg.solve(root, np.asarray(found.theta) - fit.theta))
    assert away < 1e-3


@pytest.mark.parametrize("values", [np.zeros(1), np.float64(0.5), np.zeros((1, 1))])
def test_one_value_does_not_count_for_all(known, values):
    """Nor do as many as there would be with shape parameters, which are given in SI."""
    it = known["laser_tracker"]
    expected = re.escape(f"theta: found shape {np.shape(values)}, expected ({len(it.theta)},), one")
    with pytest.raises(ValueError, match=expected):
        prepare_batch(it.model, it.plan, theta=values)
    expected = re.escape(f"keep: found shape {np.shape(values)}, expected ({it.plan.rows},), True")
    readings = np.zeros((it.plan.rows, 3))
    with pytest.raises(ValueError, match=expected):
        identify(it.model, Measurement(it.plan, readings), keep=values.astype(bool))


@pytest.mark.campaign
def test_shape_parameters_move_in_a_batch(known):
    it = known["laser_tracker"]
    model = it.model.with_effects(it.effect("screw_cyclic:X"))
    place = len(model.effects) - 1
    pitch = 0.02
    nominal = {place: {"pitch": pitch}}
    with pytest.raises(ValueError, match="screw_cyclic X pitch.*nominal amplitudes"):
        prepare_batch(model, it.plan, shapes=nominal)
    near = np.append(np.zeros(len(it.theta)), [0.9, 0.6])
    batch = prepare_batch(model, it.plan, shapes=nominal, theta=near)
    theta = np.append(it.theta, [1.0, 0.5, 0.0])
    theta[-1] = 0.3  # steps of the scan from the nominal pitch
    readings = jit_outermost(lambda theta: batch.predict(theta))(jnp.asarray(theta))
    solve = jit_outermost(lambda y: identify_one(batch, y, tolerance=1e-6, steps=60))
    found = solve(readings)
    fit = identify(
        model,
        Measurement(it.plan, np.asarray(readings)),
        shapes=nominal,
        whitener=np.asarray(batch.whitener),
    )
    value = float(batch.shape_values(found.theta)[place]["pitch"])
    assert value == pytest.approx(float(fit.shapes[place]["pitch"]), abs=2e-7)
    np.testing.assert_allclose(found.theta[:-1], fit.theta[:-1], atol=5e-3)


@pytest.mark.slow
def test_undeclared_shapes_are_drawn(known):
    it = known["laser_tracker"]
    model = it.model.with_effects(it.effect("screw_cyclic:X"))
    place = len(model.effects) - 1
    simulator = prepare(model, it.plan, draw_shapes=True)
    grid = model.effects[place].scan(it.plan)["pitch"]
    keys = jax.random.split(jax.random.key(0), 50)
    pitches = np.array([float(draw(simulator, k).shapes[place]["pitch"]) for k in keys[:5]])
    assert ((pitches >= grid.min()) & (pitches <= grid.max())).all()
    assert len(set(pitches)) == 5
    machine, _, _ = jax.random.split(keys[0], 3)
    told = draw_truth(model, it.plan, machine)
    assert told.shapes[place]["pitch"] == pytest.approx(pitches[0], rel=1e-12)


# --- campaigns ---

QUANTITIES = ParameterErrors(), ErrorMotionErrors(nodes=3)


@pytest.mark.campaign
def test_monte_carlo_and_gum_agree_where_all_is_linear(known):
    it = known["laser_tracker"]
    points = it.plan.take(np.arange(0, it.plan.rows, 6))
    quantities = [*QUANTITIES, VolumetricErrors(points)]
    done = monte_carlo(it.model, it.model, it.plan, draws=3000, quantities=quantities, seed=2)
    table, draws = done.to_pandas(), done.to_xarray()
    name = done.quantities[0]
    assert table.loc[name, "standard_uncertainty"] == pytest.approx(float(draws[name].std(ddof=1)))
    assert draws[name].dims == ("chain", "draw") and draws.sizes == {"chain": 1, "draw": 3000}
    assert name in repr(done) and len(repr(done).splitlines()) < 12
    assert done.retried == 0 and done.failed == 0
    measures = [q.measure(done.pair) for q in quantities]
    told = linearised(done.pair, measures)
    assert len(told.budget.labels) == len(done.quantities) - 6
    assert len([u for u in told.undefined if u.startswith(("mean", "rms", "largest"))]) == 6
    at = [done.ensemble.index(label) for label in told.budget.labels]
    ratio = done.ensemble.u[at] / told.budget.u
    assert np.abs(ratio - 1).max() < 5 / np.sqrt(2 * 3000)
    mean = done.ensemble.mean[at] / told.budget.u
    assert np.abs(mean).max() < 5 / np.sqrt(3000)
    name = "error components after [um]"
    u = done.ensemble.fields[name].u / told.fields[name][1]
    assert np.abs(u - 1).max() < 5 / np.sqrt(2 * 3000)
    np.testing.assert_allclose(told.budget.share.sum(1), 1.0, rtol=1e-9)
    comparison = compare(told.budget, done.ensemble, digits=1)
    assert "failed" not in comparison.verdicts
    # The posterior covariance is the same thing where the prior is the population.
    fit = np.sqrt(np.diag(done.pair.batch.inverse))
    scale = np.array([e.parameter.step / e.parameter.si for e in it.model.entries])
    np.testing.assert_allclose(told.budget.u[: len(fit)], fit * scale, rtol=1e-6)


@pytest.mark.campaign
def test_what_is_not_identified_moves_what_is(known):
    it = known["laser_tracker"]
    unknown = it.effect("backlash:Y:size_um=0")
    unknown = dataclasses.replace(unknown, given=(("size", 0.0, 30.0),))
    truth = it.model.with_effects(unknown)
    pair = virtual_pair(truth, it.model, it.plan)
    measures = [q.measure(pair) for q in QUANTITIES]
    told = linearised(pair, measures).budget
    without = linearised(virtual_pair(it.model, it.model, it.plan), measures_of(it)).budget
    column = told.source.labels.index("backlash Y")
    assert (told.u >= without.u * (1 - 1e-9)).all()
    assert told.share[:, column].max() > 0.05
    done = monte_carlo(truth, it.model, it.plan, draws=2000, quantities=QUANTITIES)
    at = [done.ensemble.index(label) for label in told.labels]
    assert np.abs(done.ensemble.u[at] / told.u - 1).max() < 5 / np.sqrt(2 * 2000)
    # By one standard deviation: the parameters that a fit of a machine with it really gives.
    theta = np.append(np.zeros(len(it.model.entries)), 1.0)
    readings = prepare_batch(truth, it.plan).predict(jnp.asarray(theta))
    fit = identify_one(pair.batch, readings, tolerance=1e-8).theta
    scale = np.array([e.parameter.step / e.parameter.si for e in it.model.entries])
    moved = np.abs(np.asarray(fit) * scale)
    expected = told.contribution[: len(moved), column]
    np.testing.assert_allclose(moved, expected, rtol=2e-2, atol=2e-3 * expected.max())


def measures_of(it):
    pair = virtual_pair(it.model, it.model, it.plan)
    return [q.measure(pair) for q in QUANTITIES]


@pytest.mark.campaign
def test_the_seed_alone_decides(known, tmp_path):
    it = known["ball_array"]

    def run(**options):
        options = {"draws": 2500, "quantities": [ParameterErrors()], "seed": 7} | options
        return monte_carlo(it.model, it.model, it.plan, **options).ensemble

    whole = run(chunk=1)
    np.testing.assert_array_equal(whole.values, run(chunk=3).values)
    assert np.abs(whole.values - run(seed=8).values).max() > 0
    run(draws=1000, folder=tmp_path / "draws")
    np.testing.assert_array_equal(whole.values, run(folder=tmp_path / "draws").values)
    with pytest.raises(StudyError, match="seed"):
        run(seed=8, folder=tmp_path / "draws")
    with pytest.raises(StudyError):
        run(folder=tmp_path / "draws", noise_factor=2.0)


@pytest.mark.campaign
def test_strong_curvature_is_retried_and_told(known):
    """Errors three hundred times too large: most machines are far from the nominal problem."""
    it = known["laser_tracker"]
    geometric = next(e for e in it.model.effects if e.name == "geometric")
    large = tuple((p.name, 0.0, 300.0 * p.sigma) for p in geometric.parameters)
    far = dataclasses.replace(geometric, given=large)
    rest = [e for e in it.model.effects if e is not geometric]
    model = Model(it.chain, it.instrument, (far, *rest))
    pair = virtual_pair(model, model, it.plan)
    assert not pair.batch.shared
    # As if it could be shared after all: every way to identify has to take over from the last.
    pair = pair._replace(batch=dataclasses.replace(pair.batch, contraction=jnp.asarray(0.0)))
    evaluate = _Evaluate(pair, [ParameterErrors().measure(pair)], 0, 1e-3)
    called = [0, 0, 0]
    for i, (function, size) in enumerate(evaluate.ways):

        def counted(index, i=i, function=function):
            called[i] += len(index)
            return function(index)

        evaluate.ways[i] = counted, size
    found = evaluate(0, 24)
    assert called[0] >= 24 >= called[1] > called[2] > 0
    retried = found["identification: retried"] == 1.0
    assert retried.sum() == called[1]
    solved = np.isfinite(found["parameter"]).all(1)
    assert solved.sum() >= 20
    # Solved ones explain their readings: no worse than the truth does.
    batch = pair.batch
    measure = jax.jit(lambda i: draw(pair.simulator, jax.random.fold_in(jax.random.key(0), i)))
    for i in np.flatnonzero(solved & retried)[:2]:
        made = measure(i)
        again = found["parameter"][i] / [e.parameter.step / e.parameter.si for e in model.entries]
        theta = np.asarray(made.theta) + again
        cost = [float(jnp.sum(batch.residual(t, made.readings) ** 2)) for t in (theta, made.theta)]
        assert cost[0] < cost[1]


@pytest.mark.campaign
def test_a_draw_that_is_not_finite_is_counted(known):
    it = known["laser_tracker"]

    class Broken(ParameterErrors):
        def measure(self, pair):
            return _Broken()

    done = monte_carlo(it.model, it.model, it.plan, draws=1000, quantities=[Broken()])
    share = done.ensemble.failed["broken"] / 1000
    assert done.failed == done.ensemble.failed["broken"]
    assert 0.3 < share < 0.7
    assert done.ensemble.mean[done.ensemble.index("broken")] == 1.0


class _Broken(eqx.Module):
    @property
    def outputs(self):
        from vcal.uncertainty import Output

        return (Output("broken"),)

    def __call__(self, state):
        return {"broken": jnp.where(state.true[0] > 0, 1.0, jnp.nan)}


def test_models_must_belong_together(known):
    tracker, balls = known["laser_tracker"], known["ball_array"]
    with pytest.raises(ValueError, match="expected the same machine and instrument"):
        virtual_pair(tracker.model, balls.model, tracker.plan)
    fit = tracker.model
    longer = eqx.tree_at(lambda m: m.chain.tool_offset, fit, fit.chain.tool_offset + 0.01)
    travel = tuple(dataclasses.replace(j, travel=2.0 * j.travel) for j in fit.chain.joints)
    farther = eqx.tree_at(lambda m: m.chain.joints, fit, travel)
    quieter = dataclasses.replace(fit.instrument, angle_sigma=1e-9)
    quieter = eqx.tree_at(lambda m: m.instrument, fit, quieter)
    for truth, expected in (
        (longer, "machine.tool_offset, expected"),
        (farther, "machine.joints, expected"),
        (quieter, "instrument.angle_sigma, expected"),
    ):
        with pytest.raises(ValueError, match=f"truth and fit: found differences in {expected}"):
            virtual_pair(truth, fit, tracker.plan)
    with pytest.raises(ValueError, match="draws"):
        monte_carlo(tracker.model, tracker.model, tracker.plan, draws=1)
    with pytest.raises(TypeError, match=r"quantities: found <class .*such as ParameterErrors\(\)"):
        monte_carlo(fit, fit, tracker.plan, quantities=[ParameterErrors])  # pyright: ignore


# --- on a cluster ---


@LEAKS
@pytest.mark.thorough
def test_a_cluster_gives_the_same_draws_also_where_a_worker_ends(known, tmp_path):
    """Bit for bit those of one process; one of two workers is killed after the first block."""
    it = known["laser_tracker"]
    given = {"draws": 6500, "seed": 3, "quantities": [ParameterErrors(), VolumetricErrors(it.plan)]}
    alone = monte_carlo(it.model, it.model, it.plan, **given)
    with client_of(2) as client:
        pids = client.run(os.getpid)

        def kill(done, total):
            if pids:
                os.kill(pids.popitem()[1], signal.SIGKILL)
                pids.clear()

        found = monte_carlo(
            it.model, it.model, it.plan, **given, client=client, chunk=1, progress=kill
        )
        assert not pids
        # What is no longer needed is released a little later.
        for _ in range(100):
            held = client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks))
            if held <= 2:
                break
            time.sleep(0.1)
        assert held <= 2
    for name in ("mean", "covariance", "minimum", "maximum", "values"):
        np.testing.assert_array_equal(getattr(found.ensemble, name), getattr(alone.ensemble, name))


def test_a_cluster_without_workers_is_refused(known):
    class Empty:
        def nthreads(self):
            return {}

    it = known["laser_tracker"]
    with pytest.raises(ValueError, match="client: found no worker"):
        monte_carlo(it.model, it.model, it.plan, draws=100, client=Empty())


def test_a_block_in_a_worker_uses_one_thread():
    class Made:
        workers = 8

        def __call__(self, first, count):
            return {}

    assert _Work(Made, (), "one").evaluate().workers == 1


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux restricts a process")
def test_threads_of_a_restricted_process():
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
        "from vcal.numerics.processes import cores; print(cores())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "1"
