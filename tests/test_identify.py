"""Identification: estimates, covariance, evidence and held-out errors against independent ones."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares

from known import PLANS, Known
from oracle import TABLE, as_study, lmmse, make_case, write_study
from vcal import Measurement, Model, identify, load_study, predict
from vcal.identification.fit import null_directions
from vcal.instruments.ball_array import ArtefactPoses
from vcal.loop.weighing import cross_validation
from vcal.loop.weighing.cross_validation import _by_leverage, check_rms, heldout_residuals, rms
from vcal.model.declared_noise import declared_whitener
from vcal.model.simulate import simulate


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("tracker"))


@pytest.fixture(scope="module")
def balls(tmp_path_factory) -> Known:
    return Known("ball_array", tmp_path_factory.mktemp("balls"))


def noisy(it: Known, seed: int, readings=None, factor: float = 1.0) -> Measurement:
    """Readings of the true machine with the declared noise, times a factor."""
    readings = it.measurement.readings if readings is None else readings
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = factor * sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    return Measurement(it.plan, readings + noise)


# --- estimates -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tracker", "balls"])
@pytest.mark.thorough
def test_noise_free_data_give_the_truth_but_for_the_prior(kind, request):
    """theta - true = -H^-1 L true: what the prior pulls; nothing where it is weak."""
    it = request.getfixturevalue(kind)
    fit = identify(it.model, it.measurement, room=it.room)
    assert fit.converged
    pulled = np.linalg.solve(
        fit.jacobian.T @ fit.jacobian + np.diag(fit.precision), fit.precision * it.theta
    )
    np.testing.assert_allclose(fit.theta, it.theta - pulled, rtol=0, atol=2e-4)
    assert np.abs(pulled).max() > 0.1
    sharp = declared_whitener(it.model, it.measurement) * 1e3
    fit = identify(it.model, it.measurement, whitener=sharp, room=it.room)
    seen = fit.information > 0.999
    assert seen.mean() > 0.3
    np.testing.assert_allclose(fit.theta[seen], it.theta[seen], rtol=0, atol=0.05)


def test_condition_and_rank_against_numpy(tracker):
    fit = identify(tracker.model, tracker.measurement, room=tracker.room)
    whole = np.concatenate([fit.jacobian, np.diag(np.sqrt(fit.precision))])
    unit = whole / np.linalg.norm(whole, axis=0)
    assert fit.condition == pytest.approx(np.linalg.cond(unit), rel=1e-6)
    assert fit.rank == np.linalg.matrix_rank(unit) == len(fit.theta)


def test_estimate_against_scipy(tracker):
    """The same whitened residual, minimised by other means."""
    it, measurement = tracker, noisy(tracker, 1)
    fit = identify(it.model, measurement, room=it.room)
    sigma = it.instrument.noise(it.plan, measurement.readings)
    root = np.sqrt(fit.precision)
    model = jax.jit(lambda theta: predict(it.model, it.plan, theta))
    slope = jax.jit(jax.jacfwd(lambda theta: predict(it.model, it.plan, theta)))

    def residual(theta):
        data = (measurement.readings - np.asarray(model(theta))) / sigma
        return np.concatenate([data.ravel(), root * theta])

    def jacobian(theta):
        data = -np.asarray(slope(theta)) / sigma[:, :, None]
        return np.concatenate([data.reshape(-1, len(theta)), np.diag(root)])

    start = np.zeros(len(fit.theta))
    found = least_squares(residual, start, jacobian, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert fit.chi2 + fit.theta**2 @ fit.precision == pytest.approx(2 * found.cost, rel=1e-8)
    np.testing.assert_allclose(fit.theta, found.x, rtol=0, atol=1e-3)
    np.testing.assert_allclose(fit.whitened, residual(fit.theta)[: fit.whitened.size], atol=1e-7)
    np.testing.assert_allclose(-fit.jacobian, jacobian(fit.theta)[: fit.whitened.size], atol=1e-6)


@pytest.mark.parametrize("kind", ["laser_tracker", "ball_array"])
@pytest.mark.parametrize("seed", [21, 22])
@pytest.mark.thorough
def test_check_error_is_at_the_bound(kind, seed, tmp_path):
    """The LMMSE of the oracle, on data as they come from files."""
    case = make_case(kind, seed=seed, plan=PLANS[kind])
    bound = lmmse(as_study(case))
    study = load_study(write_study(tmp_path / "study", case))
    fit = identify(study.model, study.measurement, room=len(study.model.entries) + 16)
    after, raw = check_rms(fit, study.check)
    assert after.value == pytest.approx(1e6 * bound.check_rms, rel=0.01)
    assert after.value < 0.6e6 * bound.check_rms_before
    assert raw.value > after.value
    assert fit.chi2 / fit.dof == pytest.approx(bound.chi2_dof, rel=0.02)


@pytest.mark.thorough
def test_uncertainties_cover_the_truth(tracker):
    """Machines from their prior, measured with noise: (estimate - truth) has the covariance."""
    it, rng = tracker, np.random.default_rng(5)
    first = identify(it.model, it.measurement, room=it.room)
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    z, chi2, squares = [], [], []
    for _ in range(60):
        truth = first.precision * rng.standard_normal(len(first.theta))
        readings = it.readings(theta=truth) + sigma * rng.standard_normal(sigma.shape)
        fit = identify(it.model, Measurement(it.plan, readings), room=it.room)
        off = fit.theta - truth
        z.append(off / np.sqrt(np.diag(fit.covariance)))
        squares.append(off @ np.linalg.solve(fit.covariance, off))
        chi2.append(fit.chi2 / fit.dof)
    z, k = np.array(z), len(first.theta)
    assert np.mean(squares) == pytest.approx(k, abs=4 * np.sqrt(2 * k / 60))
    assert np.abs(z.mean(0)).max() < 4.5 / np.sqrt(60)
    np.testing.assert_allclose(z.std(0), 1.0, atol=4.5 / np.sqrt(120))
    assert np.mean(chi2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / first.dof / 60))


@pytest.mark.thorough
def test_arm_uncertainties_allow_for_what_rows_share(tmp_path):
    """What moves all reflectors of a pose together, and is not declared."""
    it = Known("reflectors", tmp_path, noise_factor=1.0)
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    count = sigma.shape[1] // 3
    shared = np.random.default_rng(1).standard_normal((it.plan.rows, 3))
    moved = it.measurement.readings + sigma * np.tile(shared, count)
    fit = identify(it.model, Measurement(it.plan, moved), room=it.room)
    assert fit.chi2 / fit.dof > 1.5
    # In the directions that the data determine, not the prior.
    normal = fit.jacobian.T @ fit.jacobian
    sizes, directions = np.linalg.eigh(normal)
    seen = directions[:, sizes > 100.0]
    off = seen.T @ (fit.theta - it.theta)
    given = np.diag(seen.T @ fit.covariance @ seen)
    declared = np.diag(seen.T @ np.linalg.inv(normal + np.diag(fit.precision)) @ seen)
    assert 0.5 < np.mean(off**2 / given) < 1.7
    assert np.mean(off**2 / declared) > 1.7
    assert np.median(given / declared) > 1.3


# --- priors, information, what cannot be seen ----------------------------------------------------


def test_priors_are_those_of_the_declared_family(tracker):
    found = {e.parameter.name: e.parameter for e in tracker.model.entries}
    for motion, row in TABLE.items():
        a0, a1, _, b1, c1, _, b2, c2 = row
        labels = {"a0": a0, "a1": a1, "b1": b1, "c1": c1, "b2": b2, "c2": c2}
        if "0" in motion:
            labels = {"": a0}
        for label, width in labels.items():
            name = f"{motion}.{label}".strip(".")
            assert (name in found) == (width > 0)
            if width:
                assert found[name].sigma == pytest.approx(width / 3**0.5, rel=1e-12)
                assert found[name].unit == ("um" if motion[1] in "XYZ" else "urad")
    assert not any(found[c].informed for c in "XYZABC")  # the station
    fit = identify(tracker.model, tracker.measurement, room=tracker.room)
    np.testing.assert_array_equal(
        fit.precision, [float(e.parameter.informed) for e in tracker.model.entries]
    )


def test_smooth_family_prior_is_its_kernel(tmp_path):
    case = make_case("laser_tracker", seed=1, plan=PLANS["laser_tracker"])
    folder = write_study(tmp_path / "smooth", case)
    text = (folder / "setup.toml").read_text()
    told = 'family = "smooth"\ntranslation_um = 12\nrotation_urad = 20\nsquareness_urad = 30\n'
    text = text.split("[model.geometric]")[0] + f"[model.geometric]\n{told}smoothness = 0.4\n"
    (folder / "setup.toml").write_text(text)
    study = load_study(folder)
    terms = study.model.terms(study.plan)
    x = np.asarray(study.plan.x("Y"))
    r = np.sqrt(5) * np.abs(x[:, None] - x) / (0.4 * 1.0)
    kernel = (1 + r + r**2 / 3) * np.exp(-r)
    for port, size in (("EYY", 12e-6), ("ECY", 20e-6)):
        own = terms.values[:, terms.port == study.model.layout.index(port)]
        np.testing.assert_allclose(own @ own.T / size**2, kernel, atol=1e-3)
    sigmas = {e.parameter.name: e.parameter.sigma for e in study.model.entries}
    assert [sigmas[name] for name in ("EC0Y", "EB0Z", "EA0Z")] == [30, 30, 30]


def test_a_plan_in_one_plane_says_nothing_of_the_third_axis(tmp_path):
    it = Known("laser_tracker", tmp_path, seed=4, plan={"shape": (6, 8, 1), "jitter": 0.0})
    fit = identify(it.model, it.measurement, room=it.room)
    share = {p.name: s for (_, p), s in zip(fit.entries, fit.information, strict=True)}
    unseen = {name for name in share if name[2:].startswith("Z") or name in ("EB0Z", "EA0Z")}
    assert len(unseen) == 31
    assert max(share[name] for name in unseen) < 0.01
    assert min(share[name] for name in ("EXX.a1", "EXX.c1", "ECX.c1")) > 0.9
    told = null_directions(fit)
    assert len(told) == 7
    assert told[-1].startswith("and ")
    for words in told[:-1]:
        names = [word for word in words.split() if word.startswith("E")]
        assert names
        assert {name for name in names if share[name] > 0.5} == set()
    assert sum("Z." in words for words in told) >= 5


# --- held-out errors -----------------------------------------------------------------------------


def test_held_out_residuals_against_a_refit_tracker(tracker):
    it, measurement = tracker, noisy(tracker, 2)
    fit = identify(it.model, measurement, room=it.room)
    got = heldout_residuals(fit)
    folds, _ = it.instrument.folds(it.plan)
    assert np.isfinite(got).all()
    for fold in np.unique(folds):
        rows = folds == fold
        again = identify(it.model, measurement, keep=~rows, room=it.room)
        off = (got - again.residual)[rows] * fit.whitener[rows][:, [0, 1, 2], [0, 1, 2]]
        size = again.residual[rows] * fit.whitener[rows][:, [0, 1, 2], [0, 1, 2]]
        assert np.linalg.norm(off) < 0.01 * np.linalg.norm(size)
        assert np.linalg.norm(size) > 1.05 * np.linalg.norm(fit.whitened.reshape(-1, 3)[rows])


def test_an_rms_is_as_certain_as_what_its_rows_share():
    """Twenty poses with eight rows each that share most of their error: u of the rms is how much it
    scatters from one sample to the next.
    """
    rng = np.random.default_rng(8)
    poses = np.repeat(np.arange(20), 8)
    found, alone = [], []
    for _ in range(400):
        error = rng.standard_normal(20)[poses] + 0.3 * rng.standard_normal(160)
        found.append(rms(1e-12 * error**2, poses))
        alone.append(rms(1e-12 * error**2).u)
    scatter = np.std([one.value for one in found])
    assert np.mean([one.u for one in found]) == pytest.approx(scatter, rel=0.12)
    assert np.mean(alone) < 0.5 * scatter


def test_held_out_residuals_against_a_refit_balls(balls):
    """The six unknowns of a pose left out come from its own balls, the rest from the others."""
    it, measurement = balls, noisy(balls, 3)
    fit = identify(it.model, measurement, room=it.room)
    got = heldout_residuals(fit)
    folds, _ = it.instrument.folds(it.plan)
    target = it.model.layout.slice("target")
    for fold in (0, 7, 11):
        rows = folds == fold
        poses = tuple(p for p in range(12) if p != fold)
        effects = [
            dataclasses.replace(e, poses=poses) if isinstance(e, ArtefactPoses) else e
            for e in it.model.effects
        ]
        model = Model(it.chain, it.instrument, effects)
        again = identify(model, measurement, keep=~rows, room=it.room)
        own = again.port_jacobian[rows][:, :, target].reshape(-1, 6)
        seen = again.residual[rows].ravel()
        expected = seen - own @ np.linalg.lstsq(own, seen, rcond=None)[0]
        assert np.linalg.norm(got[rows].ravel() - expected) < 0.01 * np.linalg.norm(expected)
        assert np.linalg.norm(expected) > 1.1 * np.linalg.norm(fit.residual[rows])


@pytest.mark.parametrize("seed", [2, 3])
def test_held_out_residuals_by_leverage_are_those_by_a_downdate(balls, seed, monkeypatch):
    """Folds of fewer readings than there are parameters, each with a pose of its own."""
    fit = identify(balls.model, noisy(balls, seed), room=balls.room)
    taken = []

    def by_leverage(roots, r):
        taken.append(_by_leverage(roots, r) is not None)
        return _by_leverage(roots, r)

    monkeypatch.setattr(cross_validation, "_by_leverage", by_leverage)
    fast = heldout_residuals(fit)
    assert taken and all(taken)
    monkeypatch.setattr(cross_validation, "_by_leverage", lambda *_: None)
    exact = heldout_residuals(fit)
    scale = np.sqrt(np.nanmean(exact**2, axis=0))
    np.testing.assert_allclose(fast / scale, exact / scale, atol=1e-9)


# --- evidence ------------------------------------------------------------------------------------


def marginal(target: np.ndarray, jacobian: np.ndarray, precision: np.ndarray, noise: float):
    """ln p(target) of target = J theta + e, flat directions as one unit of their scale each."""
    flat = jacobian[:, precision == 0]
    known = jacobian[:, precision > 0]
    covariance = noise**2 * np.eye(len(target)) + known @ known.T
    inverse = np.linalg.inv(covariance)
    seen = flat.T @ inverse @ flat
    left = inverse - inverse @ flat @ np.linalg.solve(seen, flat.T @ inverse)
    logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(seen)[1]
    return -0.5 * (target @ left @ target + logs)


@pytest.mark.parametrize("noise", [1.0, 1.3])
def test_evidence_against_the_exact_marginal_likelihood(noise, tracker):
    it = tracker
    true = it.effect("backlash:Y:size_um=3")
    measurement = noisy(it, 4, it.readings(true))
    plain = identify(it.model, measurement, room=it.room)
    exact, found = [], []
    for text in ("backlash:Y", "lateral_reversal:X:component=EYX", "backlash:X"):
        fit = identify(it.model.with_effects(it.effect(text)), measurement, room=it.room)
        target = fit.whitened + fit.jacobian @ fit.theta
        size = len(plain.theta)
        without = marginal(target, fit.jacobian[:, :size], fit.precision[:size], noise)
        exact.append(marginal(target, fit.jacobian, fit.precision, noise) - without)
        found.append(fit.log_evidence(noise) - plain.log_evidence(noise))
    # With another noise than the one fitted with, the estimate is not quite the mode.
    np.testing.assert_allclose(found, exact, atol=1e-3 if noise == 1.0 else 0.02)
    assert exact[0] > 1 > 0 > exact[2]


@pytest.mark.parametrize("times", [3.0, 10.0])
def test_evidence_at_a_noise_is_that_of_a_fit_at_this_noise(tracker, times):
    """Where the noise is larger than declared the prior holds more, and the minimum is elsewhere:
    the formula at the old one would be wrong by up to a hundred.
    """
    measurement = noisy(tracker, 1, factor=times)
    declared = declared_whitener(tracker.model, measurement)
    quiet = identify(tracker.model, measurement)
    loud = identify(tracker.model, measurement, whitener=declared / times)
    assert quiet.log_evidence(times) == pytest.approx(loud.log_evidence(), abs=0.05)
    moved = quiet.theta + quiet.step_at(times)
    u = np.sqrt(np.diag(loud.covariance))
    np.testing.assert_allclose(moved / u, loud.theta / u, atol=0.01)


@pytest.mark.campaign
def test_what_is_held_out_of_three_rows_is_predicted(tracker):
    """Without one of them the station is open in combinations of its parameters, not in one."""
    rows = np.array([0, tracker.plan.rows // 2, tracker.plan.rows - 1])
    few = noisy(tracker, 2)
    few = Measurement(few.plan.take(rows), np.asarray(few.readings)[rows])
    fit = identify(tracker.model, few)
    folds, _ = tracker.model.instrument.folds(few.plan)
    found = heldout_residuals(fit)
    assert np.isfinite(found[folds >= 0]).all()


@pytest.mark.campaign
def test_what_the_fit_took_of_shared_errors_is_given_back(small_arm_study):
    """Where nothing is shared, the covariance by clusters is on average that of the declared noise;
    the residuals as they are would give a tenth less.
    """
    study = load_study(small_arm_study)
    ratios = []
    for seed in range(15):
        fit = identify(
            study.model, simulate(study.model, study.plan, jax.random.key(seed)).measurement
        )
        plain = np.diag(np.linalg.inv(fit.jacobian.T @ fit.jacobian + np.diag(fit.precision)))
        told = fit.information > 0.9
        ratios.append((np.diag(fit.covariance) / plain)[told].mean())
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)
