"""What must not fool the loop: noise that is not as declared, stray readings, too few readings."""

import dataclasses
import importlib
import re

import jax
import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.stats import f as fisher

from known import Known
from oracle import make_case, write_study
from vcal import CATALOGUE, Measurement, close_loop, load_study
from vcal.demo import FOLDER
from vcal.identification.identify import identify
from vcal.identification.robust import identify_robust
from vcal.loop.empirical import Kink
from vcal.loop.residuals.autocorrelation import _PHI, _SHARE, _Sequence, serial
from vcal.loop.residuals.confounded import confounded, unrecorded_time
from vcal.loop.residuals.outliers import (
    at_an_end,
    displaced,
    outliers_apart,
    outlying_rows,
    scattered,
)
from vcal.loop.residuals.variance_components import components
from vcal.loop.screening.candidates import candidates
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.screening.screening import screen
from vcal.loop.screening.significance import minus_log_beta_tail
from vcal.loop.search.state import fitted
from vcal.loop.weighing.cross_validation import heldout_residuals, log_predictive_density
from vcal.model.declared_noise import declared_covariances
from vcal.model.simulate import simulate
from vcal.numerics.least_squares import Status

FACTORS = np.array([1.0, 0.7, 2.5])


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("tracker"))


def with_noise(it: Known, noise: np.ndarray, *effects) -> Measurement:
    """What the true machine gives, with noise in parts of what is declared."""
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    return Measurement(it.plan, it.readings(*effects) + noise * sigma)


def white(it: Known, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(it.measurement.readings.shape)


def persisting(it: Known, seed: int, phi: float) -> np.ndarray:
    """Noise of variance one that fades by phi from reading to reading."""
    noise = white(it, seed)
    for i in range(1, len(noise)):
        noise[i] = phi * noise[i - 1] + np.sqrt(1.0 - phi**2) * noise[i]
    return noise


def closed(it: Known, measurement: Measurement, **options):
    return close_loop(it.model, measurement, **({"draws": 200} | options))


def dense(fit, covariance: np.ndarray, columns=slice(None)) -> float:
    """ln p of all readings at once with the covariance (n m, n m), parameters integrated out, but
    for what is the same for all covariances.
    """
    lower = np.linalg.cholesky(covariance)
    n, m = fit.residual.shape
    back = np.linalg.inv(fit.whitener)
    J = np.einsum("nij,njk->nik", back, fit.jacobian.reshape(n, m, -1)).reshape(n * m, -1)
    y = fit.residual.ravel() + J @ fit.theta
    J, y = (solve_triangular(lower, x, lower=True) for x in (J[:, columns], y))
    H = J.T @ J + np.diag(fit.precision[columns])
    cost = y @ y - (J.T @ y) @ np.linalg.solve(H, J.T @ y)
    return -np.log(np.diag(lower)).sum() - 0.5 * np.linalg.slogdet(H)[1] - 0.5 * cost


# --- variance components ---------------------------------------------------------------------


def test_components_maximise_the_likelihood_of_all_readings(tracker):
    """Against scipy on the dense covariance of all readings together."""
    fit = identify(tracker.model, with_noise(tracker, FACTORS * white(tracker, 1)))
    found = components(fit)
    parts = np.array([v for _, v in declared_covariances(fit.model, fit.measurement)])
    variances = np.einsum("cnii->cni", parts).reshape(3, -1)

    def cost(log_factors):
        return -dense(fit, np.diag(np.exp(2.0 * log_factors) @ variances))

    best = minimize(cost, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6})
    assert best.success
    np.testing.assert_allclose([p.factor for p in found.parts], np.exp(best.x), rtol=2e-3)


def test_components_are_told_with_their_uncertainty(tracker):
    even = uneven = 0
    pulls = []
    for seed in range(12):
        noise = white(tracker, 100 + seed)
        found = components(identify(tracker.model, with_noise(tracker, FACTORS * noise)))
        pulls += [(p.factor - f) / p.u for p, f in zip(found.parts, FACTORS, strict=True)]
        uneven += found.uneven
        even += not components(identify(tracker.model, with_noise(tracker, 1.5 * noise))).uneven
    assert (uneven, even) == (12, 12)
    assert 0.6 < np.std(pulls) < 1.4 and abs(np.mean(pulls)) < 0.5


def test_one_kind_of_reading_noisier_than_declared(tracker):
    """Nothing is named, the kind is told, and the estimate gains from knowing it."""
    measurement = with_noise(tracker, np.array([1.0, 1.0, 5.0]) * white(tracker, 7))
    closure = closed(tracker, measurement, check=tracker.study.check)
    assert (closure.verdict, closure.effects) == ("nothing_missing", [])
    factors = {part.name: part.factor for part in closure.noise_components}
    assert factors["elevation"] == pytest.approx(5.0, rel=0.2)
    assert factors["range"] == pytest.approx(1.0, rel=0.2)
    assert any("elevation" in note for note in closure.notes)
    assert closure.errors["after"].check.value < closure.errors["before"].check.value


# --- readings that follow each other -----------------------------------------------------------


@pytest.mark.parametrize("lengths", [(300,), (30, 30, 1, 17), (5,) * 20])
def test_likelihood_of_correlated_noise_in_pieces(lengths):
    """Against the dense density of every piece, the first rows of which have no past."""
    rng, n = np.random.default_rng(len(lengths)), sum(lengths)
    ends = np.cumsum([0, *lengths])
    pieces = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    residual = rng.standard_normal((n, 3))
    counted = np.ones((n, 3), bool)
    counted[:, 2] = False  # a reading that this data set does not have
    residual[:, 2] = 0.0
    known = np.zeros((n, 3, 1)), np.zeros(1), np.ones(1), np.ones(1, bool)
    data = _Sequence(pieces, residual, *known, counted)

    def exact(phi: float, share: float) -> float:
        square = log_determinant = 0.0
        for piece in pieces:
            steps = np.arange(piece.stop - piece.start)
            steps = np.abs(steps[:, None] - steps)
            rows = share * phi**steps + (1.0 - share) * np.eye(len(steps))
            inner = np.linalg.solve(rows, residual[piece])
            square += float((residual[piece] * inner).sum())
            log_determinant += 2.0 * float(np.linalg.slogdet(rows)[1])
        return -0.5 * (2 * n * (1.0 + np.log(square / (2 * n))) + log_determinant)

    every = np.ones(1, bool)
    assert data.likelihood() == pytest.approx(exact(0.0, 0.0), abs=1e-6)
    for phi in _PHI:
        for share in _SHARE:
            assert data.likelihood(every, phi, share) == pytest.approx(exact(phi, share), abs=1e-6)


@pytest.mark.parametrize("phi", [0.6, 0.95])
def test_correlated_noise_is_measured(tracker, phi):
    """Against the dense likelihood: no point beside the one found is clearly better."""
    noise = (white(tracker, 3) + persisting(tracker, 4, phi)) / np.sqrt(2.0)
    fit = identify(tracker.model, with_noise(tracker, noise))
    found = serial(fit)
    assert found is not None and found.p_value < 1e-6
    assert found.share > 0.2
    n, m = fit.residual.shape
    sigma = 1.0 / np.einsum("nii->ni", fit.whitener).ravel()
    steps = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))

    def likelihood(phi, share):
        rows = share * phi**steps + (1.0 - share) * np.eye(n)
        unit = np.kron(rows, np.eye(m)) * np.outer(sigma, sigma)
        return max(dense(fit, s * unit) for s in np.geomspace(0.5, 20.0, 40))

    here, whiteness = likelihood(found.phi, found.share), likelihood(0.5, 0.0)
    assert here - whiteness == pytest.approx(
        found.log_bayes + np.log(len(_PHI) * len(_SHARE)), abs=1.0
    )
    assert here > likelihood(0.99, 0.2) and here > likelihood(0.3, 0.9)


def test_white_noise_is_not_correlated(tracker):
    measured = [with_noise(tracker, white(tracker, 50 + seed)) for seed in range(10)]
    assert sum(serial(identify(tracker.model, m)) is not None for m in measured) <= 1


def reordered(it: Known, measurement: Measurement, order, without=()) -> Measurement:
    """The readings with their rows in another order, without some covariates."""
    plan = dataclasses.replace(
        measurement.plan,
        position=np.asarray(measurement.plan.position)[order],
        **{
            kind: {
                k: np.asarray(v)[order]
                for k, v in getattr(measurement.plan, kind).items()
                if k not in without
            }
            for kind in ("covariates", "groups")
        },
    )
    return Measurement(plan, measurement.readings[order])


def correlation(it: Known, measurement: Measurement):
    """phi, share and log evidence of the correlated noise that was found."""
    found = serial(identify(it.model, measurement))
    assert found is not None
    return found.phi, found.share, found.log_bayes


def test_readings_follow_each_other_in_time(tracker):
    """However the rows of a file are sorted."""
    measurement = with_noise(tracker, persisting(tracker, 4, 0.9))
    order = np.random.default_rng(1).permutation(tracker.plan.rows)
    other = reordered(tracker, measurement, order)
    expected = correlation(tracker, measurement)
    assert correlation(tracker, other) == pytest.approx(expected, rel=1e-6)


def test_poses_may_stand_among_each_other_where_no_time_is_recorded(tracker):
    """Nothing persists from one to the next; readings follow each other as in the file."""
    rows = tracker.plan.rows
    pose = np.arange(rows) * 3 // rows
    plan = dataclasses.replace(tracker.plan, groups={**tracker.plan.groups, "pose": pose})
    measurement = with_noise(tracker, persisting(tracker, 4, 0.9))
    measurement = Measurement(plan, measurement.readings)
    in_order = reordered(tracker, measurement, np.arange(rows), without=("t",))
    among = np.argsort(np.random.default_rng(1).permutation(pose), kind="stable")
    among = np.argsort(among, kind="stable")  # the rows of every pose keep their order
    other = reordered(tracker, measurement, among, without=("t",))
    expected = correlation(tracker, in_order)
    assert correlation(tracker, other) == pytest.approx(expected, rel=1e-6)


@pytest.mark.campaign
def test_correlated_noise_gets_no_name(tracker):
    """Half of the noise drifts: nothing is named; what is there is found beside it."""
    noise = white(tracker, 8) + 1.5 * persisting(tracker, 9, 0.9)
    closure = closed(tracker, with_noise(tracker, noise))
    assert (closure.verdict, closure.effects) == ("unexplained", [])
    assert "successive readings are correlated" in closure.unexplained.reason
    beside = closed(tracker, with_noise(tracker, noise, tracker.effect("backlash:Y:size_um=25")))
    assert [e.effect.key for e in beside.effects] == ["backlash Y"]
    assert "successive readings are correlated" in beside.unexplained.reason


@pytest.mark.parametrize(
    ("seed", "phi"),
    [
        pytest.param(3, 0.9, marks=pytest.mark.thorough),
        pytest.param(5, 0.98, marks=pytest.mark.campaign),
    ],
)
def test_noise_that_only_persists_is_told_as_such(tracker, seed, phi):
    """Whatever changes slowly describes some of it: no jump, no temperature, no product of them."""
    closure = closed(tracker, with_noise(tracker, persisting(tracker, seed, phi)))
    assert (closure.verdict, closure.effects) == ("unexplained", [])
    assert closure.unexplained.empirical is None
    assert "as with noise that is correlated in time" in closure.unexplained.reason
    # No covariate is told alone where the noise says far more.
    persists = int(re.search(r"(\d+) % of the scatter", closure.unexplained.reason)[1]) / 100.0
    assert ("noise that is correlated in time" in closure.sentence) == (
        persists > 2.0 * max(closure.unexplained.shares)
    )


# --- stray readings ------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 25])
def test_two_percent_of_stray_readings(tracker, size):
    rng = np.random.default_rng(size)
    noise = white(tracker, 11)
    n, m = noise.shape
    rows = np.sort(rng.choice(n, max(4, round(0.02 * n)), replace=False))
    noise[rows, rng.integers(m, size=len(rows))] += rng.choice([-1, 1], len(rows)) * rng.uniform(
        10, 40, len(rows)
    )
    effects = [tracker.effect(f"backlash:Y:size_um={size}")] if size else []
    closure = closed(tracker, with_noise(tracker, noise, *effects))
    assert [e.effect.key for e in closure.effects] == (["backlash Y"] if size else [])
    assert closure.verdict == ("named" if size else "nothing_missing")
    assert set(rows) <= {stray.row for stray in closure.suspected}
    assert len(closure.suspected) <= len(rows) + 1


def test_a_local_error_is_no_stray_reading(tracker):
    """Rows that stand out and are neighbours along an axis stay in."""
    x, y = tracker.plan.x("X"), tracker.plan.x("Y")
    near = np.flatnonzero((x > np.quantile(x, 0.7)) & (y > np.quantile(y, 0.7)))
    assert 4 < len(near) < 12
    noise = white(tracker, 12)
    noise[near, 2] += 25.0
    fit = identify(tracker.model, with_noise(tracker, noise))
    assert set(near) & {s.row for s in outlying_rows(fit, lambda: (fit, np.ones(len(x))))} == set()
    assert not scattered(fit, list(near)) and scattered(fit, [3, 40, 71])


def test_what_stays_displaced_is_no_stray_reading(tracker):
    """The last readings, all displaced alike: something moved. In between, or displaced one here
    and one there, they may be stray; so may one alone, or two that are only roughly alike.
    """
    n = tracker.plan.rows
    last, between = [n - 3, n - 2, n - 1], [n - 12, n - 11, n - 10]
    shift = np.zeros((n, 3))
    shift[last + between] = [0.0, 60.0, 0.0]
    port = tracker.model.layout.index("tool.Y")
    at = identify(tracker.model, with_noise(tracker, white(tracker, 13)))
    noise = white(tracker, 13)
    noise += (
        np.einsum("nij,nj->ni", at.whitener, at.port_jacobian[:, :, port]) * shift[:, 1:2] * 1e-6
    )
    keep = np.ones(n, bool)
    keep[last + between] = False
    fit = identify(tracker.model, with_noise(tracker, noise), keep=keep)
    # A good reading before them that is suspected with them is none either.
    assert displaced(fit, [*between, n - 4, *last]) == {n - 4, *last}
    assert displaced(fit, [*between, *last[1:]]) == set(last[1:])
    assert displaced(fit, [*between, n - 1]) == displaced(fit, between) == set()
    assert at_an_end(fit, [*between, n - 1]) == {n - 1: "the last of its data set"}
    for factors in ([1.0, -1.0, 1.0], [1.0, 0.6, 1.0]):
        unlike = noise.copy()
        unlike[last] *= np.array(factors)[:, None]
        fit = identify(tracker.model, with_noise(tracker, unlike), keep=keep)
        assert displaced(fit, [*between, *last[1:]]) == set()


def test_a_displacement_of_the_last_two_readings_is_named(tracker):
    n = tracker.plan.rows
    t = np.asarray(tracker.plan.covariate("t"))
    jump = tracker.effect(f"jump:tool:Y_um=60,at_s={0.5 * (t[n - 3] + t[n - 2])}")
    closure = closed(tracker, with_noise(tracker, white(tracker, 14), jump))
    assert closure.effects[0].effect.name == "jump"
    assert closure.suspected == []


def test_one_gross_reading_is_left_out_whatever_is_missing(tracker):
    """Beside a local error, which is none: it stays in."""
    x, y = tracker.plan.x("X"), tracker.plan.x("Y")
    near = (x > np.quantile(x, 0.7)) & (y > np.quantile(y, 0.7))
    row, noise = int(np.flatnonzero(~near)[10]), white(tracker, 12)
    noise[near, 2] += 25.0
    for size in (200.0, 1e5):
        noise[row, 1] = size
        fit = identify(tracker.model, with_noise(tracker, noise))
        found = outlying_rows(fit, lambda f=fit: identify_robust(f.model, f.measurement))
        assert [stray.row for stray in found] == [row]


def test_one_gross_reading_does_not_take_its_neighbours_along(tmp_path):
    """It pulls the pose of its artefact away from the others of it, which then stand out too."""
    balls = Known("ball_array", tmp_path)
    noise, row = white(balls, 16), 20
    noise[row, 0] += 40.0
    fit = identify(balls.model, with_noise(balls, noise))
    robust = identify_robust(fit.model, fit.measurement)
    assert [stray.row for stray in outlying_rows(fit, lambda: robust)] == [row]


@pytest.mark.campaign
def test_one_gross_reading_among_those_that_are_only_foretold(tmp_path):
    arm = Known("reflectors", tmp_path)
    folds, apart = arm.instrument.folds(arm.plan)
    rows = np.flatnonzero(folds >= 0)
    row, noise = rows[3], white(arm, 17)
    assert apart
    clean = identify(arm.model, with_noise(arm, noise), keep=folds < 0, room=arm.room)
    noise[row] += 1e4
    state = fitted(arm.model, with_noise(arm, noise), None, arm.room)
    assert [stray.row for stray in state.outliers] == [row]
    np.testing.assert_allclose(state.fit.theta, clean.theta, atol=1e-6)
    residuals, without = heldout_residuals(clean), heldout_residuals(state.fit)
    assert np.isnan(without[row]).all()
    residuals[row] = np.nan
    np.testing.assert_allclose(without, residuals, atol=1e-12)
    blocks = set(log_predictive_density(clean).folds) - set(log_predictive_density(state.fit).folds)
    assert blocks == {-1 - row}
    # What is missing from a model shows in all of them, and makes none of them gross.
    sigma = arm.instrument.noise(arm.plan, arm.measurement.readings)
    missing = clean.residual + 50.0 * sigma * white(arm, 18)
    worse = dataclasses.replace(clean, residual=missing)
    assert outliers_apart(worse, folds >= 0) == []
    missing[row] += 1e4 * sigma[row]
    assert [stray.row for stray in outliers_apart(worse, folds >= 0)] == [row]


# --- noise that is smaller than declared ---------------------------------------------------------


@pytest.mark.thorough
def test_noise_declared_too_large_makes_no_error_of_the_machine(tracker):
    """Priors that count for too much hold the fit away from what is true, by many times the noise
    that there is.
    """
    noise = 0.05 * white(tracker, 18)
    closure = closed(tracker, with_noise(tracker, noise))
    assert closure.verdict == "nothing_missing"
    assert closure.noise_scale == pytest.approx(0.05, rel=0.1)
    assert any("scatter 0.05 times" in note for note in closure.notes)
    size = 2.0
    closure = closed(tracker, with_noise(tracker, noise, tracker.effect("backlash:Y:size_um=2")))
    (found,) = closure.effects
    assert found.effect.key == "backlash Y" and found.status == "named"
    _, value, _, u = found.parameters[0]
    assert abs(value - size) < 2.0 * u


@pytest.mark.filterwarnings("error")
def test_readings_without_any_noise(tracker):
    theta = np.zeros(len(tracker.model.entries))
    exact = Measurement(tracker.plan, tracker.readings(theta=theta))
    closure = closed(tracker, exact, draws=50)
    assert closure.verdict == "nothing_missing" and closure.screenings[0].p_value == 1.0
    assert any("scatter at most 0.01 times" in note for note in closure.notes)


@pytest.mark.thorough
@pytest.mark.parametrize("size", [0.0, 20.0])
@pytest.mark.parametrize("instrument", ["ball_array", "laser_tracker"])
def test_readings_of_another_simulation_without_any_noise(instrument, size, tmp_path):
    """Nothing is told by how it rounds, and by what the prior holds back."""
    true = [{"effect": "backlash", "axis": "Y", "size_um": size}] if size else []
    case = make_case(instrument, seed=2, effects=true, noise_factor=0.0)
    study = load_study(write_study(tmp_path, case) / "setup.toml")
    closure = close_loop(study.model, study.measurement, draws=100)
    assert closure.verdict == ("named" if size else "nothing_missing")
    assert closure.suspected == [] and closure.screenings[-1].p_value > 0.01
    assert [e.effect.key for e in closure.effects] == (["backlash Y"] if size else [])
    for effect in closure.effects:
        assert effect.parameters[0][1] == pytest.approx(size, rel=5e-3)


@pytest.mark.thorough
def test_stray_readings_among_those_that_are_quieter_than_declared(tmp_path):
    """They are told by the noise that there is."""
    case = make_case("ball_array", seed=2, noise_factor=0.05)
    study = load_study(write_study(tmp_path, case) / "setup.toml")
    readings = np.array(study.measurement.readings)
    rows = np.random.default_rng(5).choice(len(readings), 4, replace=False)
    declared = study.model.instrument.noise(study.measurement.plan, readings)
    readings[rows, 1] += 40.0 * 0.05 * declared[rows, 1]
    closure = close_loop(study.model, Measurement(study.measurement.plan, readings), draws=100)
    assert closure.verdict == "nothing_missing"
    assert {stray.row for stray in closure.suspected} == set(rows)


# --- few readings, and confounded covariates -----------------------------------------------------


def test_a_share_of_few_squares_against_f():
    """Share s of a space of r among n dimensions: s / r over (1 - s) / (n - r) is F."""
    for n, r, s in ((7.0, 2, 0.9), (20, 3, 0.5), (1800, 6, 0.33), (1800, 1, 0.3)):
        expected = -fisher.logsf(s / r / ((1 - s) / (n - r)), r, n - r)
        assert float(minus_log_beta_tail(s, n, r)) == pytest.approx(expected, rel=1e-10)
    # Across the point where the probability underflows.
    steps = np.diff(minus_log_beta_tail(np.linspace(0.5, 0.55, 40), 1800, 2))
    assert steps.min() > 0.0 and np.ptp(steps) < 0.2 * steps.mean()
    assert float(minus_log_beta_tail(0.9, 2.0, 3)) == 0.0


@pytest.mark.parametrize("shape", [(2, 2, 1), pytest.param((2, 2, 2), marks=pytest.mark.campaign)])
def test_too_few_readings(shape, tmp_path):
    true = {"effect": "backlash", "axis": "Y", "size_um": 20}
    plan = {"shape": shape, "passes": 1}
    folder = write_study(tmp_path, make_case("laser_tracker", seed=2, effects=[true], plan=plan))
    study = load_study(folder / "setup.toml")
    closure = close_loop(study.model, study.measurement, draws=200)
    assert closure.effects == []
    assert any("degrees of freedom" in note for note in closure.notes)


def test_conditions_that_went_together(tracker):
    plan = tracker.plan
    t = np.asarray(plan.covariate("t"))
    drifting = dataclasses.replace(plan, covariates={**plan.covariates, "T_Y": 20.0 + 1e-3 * t})
    (said,) = confounded(drifting, ["T_Y", "t"])
    # Written as a sentence, it must not begin with the name of a column.
    assert said.startswith("the columns ")
    assert "T_y_degC" in said and "t_s" in said and "vary" in said
    swinging = {**plan.covariates, **{n: 20.0 + np.sin(t / t.max() * 20.0 + k)
                                      for k, n in enumerate(("T_X", "T_Y", "T_Z"))}}  # fmt: skip
    assert confounded(dataclasses.replace(plan, covariates=swinging), ["T_Y"]) == []
    assert confounded(plan, ["dir_Y"]) == []


def test_time_that_was_not_recorded(tracker):
    """What depends on the sequence may depend on time: the effects that wait for it are told."""
    plan, classes = tracker.plan, [CATALOGUE[n] for n in ("warm_up", "thermal_tilt", "jump")]
    timeless = dataclasses.replace(
        plan,
        covariates={n: x for n, x in plan.covariates.items() if n not in ("t", "T_X")},
        groups=dict(plan.groups) | {"run": np.arange(plan.rows) // 10},
    )
    for of, wanting in ((plan, 0), (timeless, 1)):
        measurement = Measurement(of, tracker.measurement.readings)
        _, untestable = candidates(tracker.model, measurement, classes)
        said = unrecorded_time(of, "run", untestable)
        assert len(said) == wanting and unrecorded_time(of, "X", untestable) == []
    assert "what depends on run" in said[0] and "(column t_s)" in said[0]
    assert "jump, warm_up could not be tested" in said[0]


# --- candidates that are less than the best of their kind ----------------------------------------


def test_what_is_named_is_significant_itself(tracker):
    """Of a kind that is found at one place, another place is worth its own p-value."""
    measurement = with_noise(tracker, white(tracker, 21), tracker.effect("backlash:Y:size_um=12"))
    fit = identify(tracker.model, measurement, room=tracker.room)
    state = ScoreTest(fit, 200, 0)
    tried, _ = candidates(tracker.model, measurement, [CATALOGUE["backlash"], CATALOGUE["jump"]])
    found = screen(state, tried)
    (kind,) = (k for k in found.kinds if k.kind == "backlash")
    own = {
        p.effect.placement: found.corrected_as(
            "backlash", float(state.minus_log_p(p.statistic, state.cost, p.rank))
        )
        for p in kind.peaks
    }
    assert own["Y"] == pytest.approx(found.corrected(kind), rel=1e-9) and own["Y"] < 1e-10
    assert max(own["X"], own["Z"]) > 0.01


@pytest.mark.thorough
def test_what_looking_everywhere_costs_is_paid_once(tracker):
    """An effect at the limit of what can be found is named where its p-value, which has paid for
    all that was tried, says so; its evidence does not have to pay for all kinds of effects again.
    """
    measurement = with_noise(tracker, white(tracker, 23), tracker.effect("backlash:Y:size_um=1.4"))
    # At the limit 200 draws tell p too roughly: 0.012 here, while 2000 tell 0.007.
    closure = closed(tracker, measurement, draws=500)
    (found,) = closure.effects
    assert found.effect.key == "backlash Y"
    assert 0.001 < found.p_value < 0.01
    # Three axes share the odds of a backlash, and the kinds those that anything is missing.
    assert 0.0 < found.log_evidence - np.log(3.0) < np.log(len(closure.screenings[0].kinds))


def test_what_does_not_hold_on_other_readings_is_no_name(tracker, monkeypatch):
    """A significant effect that held-out readings refuse leaves something unexplained."""
    measurement = with_noise(tracker, white(tracker, 22), tracker.effect("backlash:Y:size_um=12"))
    loop = importlib.import_module("vcal.loop.search.round")
    monkeypatch.setattr(loop, "improvement", lambda before, after, noise: (-1.0, 1.0))
    closure = closed(tracker, measurement, effects=[CATALOGUE["backlash"]])
    assert (closure.verdict, closure.effects) == ("unexplained", [])
    assert {r.placement for r in closure.rejected} >= {"Y"}
    assert closure.unexplained.depends_on


def test_what_cannot_be_fitted_leaves_something_unexplained(tracker, monkeypatch):
    measurement = with_noise(tracker, white(tracker, 22), tracker.effect("backlash:Y:size_um=12"))
    rivals = importlib.import_module("vcal.loop.weighing.rivals")

    def unfinished(*args):
        return dataclasses.replace(refit(*args), status=Status.STEP_LIMIT)

    refit = rivals.refit
    monkeypatch.setattr(rivals, "refit", unfinished)
    closure = closed(tracker, measurement, effects=[CATALOGUE["backlash"]])
    assert (closure.verdict, closure.effects) == ("unexplained", [])
    (told,) = closure.rejected
    assert (told.placement, told.reason) == ("Y", "its fit does not converge to a minimum")
    assert told.p_value < 1e-6


def test_a_description_that_cannot_be_fitted_leaves_something_unexplained(tracker, monkeypatch):
    kink = Kink(port="EZX", unit="um", placement="X",
                given=(("slope", 20.0, 0.0), ("at", 1000.0, 0.0)))  # fmt: skip
    measurement = with_noise(tracker, white(tracker, 22), kink)
    loop = importlib.import_module("vcal.loop.search.forward_selection")
    rivals = importlib.import_module("vcal.loop.weighing.rivals")

    def unfinished(*args):
        return dataclasses.replace(refit(*args), status=Status.STEP_LIMIT)

    refit = rivals.refit
    monkeypatch.setattr(rivals, "refit", unfinished)
    monkeypatch.setattr(loop, "EMPIRICAL", (Kink,))
    closure = closed(tracker, measurement, effects=[])
    assert (closure.verdict, closure.rejected) == ("unexplained", [])
    assert (
        closure.unexplained.reason
        == "a kink is significant, but its fit does not converge to a minimum"
    )
    assert closure.unexplained.depends_on[0] == "X"


@pytest.mark.thorough
def test_what_a_far_likelier_effect_contradicts_is_no_name(tracker, monkeypatch):
    """Held-out readings that refuse the likeliest effect, but not the next, tell of a third."""
    measurement = with_noise(tracker, white(tracker, 22), tracker.effect("backlash:Y:size_um=12"))
    loop = importlib.import_module("vcal.loop.search.round")
    hold = loop.improvement

    def refusing(before, after, noise):
        likeliest = after.model.effects[-1].key == "backlash Y"
        return (-1.0, 1.0) if likeliest else hold(before, after, noise)

    monkeypatch.setattr(loop, "improvement", refusing)
    tried = [CATALOGUE["backlash"], CATALOGUE["jump"], CATALOGUE["cross_axis"]]
    closure = closed(tracker, measurement, effects=tried)
    assert (closure.verdict, closure.effects) == ("unexplained", [])
    assert closure.rejected[0].effect == "backlash"


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, 2])
def test_noise_alone_depends_on_nothing_however_large_it_is(seed):
    """Five times the declared noise: the best of all columns describes one per cent, by chance. The
    declaration of the noise is wrong, which the first sentence says with the factor.
    """
    study = load_study(FOLDER / "setup.toml")
    made = simulate(study.model, study.plan, jax.random.key(seed), noise_factor=5.2)
    closure = close_loop(study.model, made.measurement, effects=["backlash"], draws=100)
    assert not closure.effects and closure.unexplained is None
    assert closure.verdict == "nothing_missing"
    factor = re.match(r"The declared noise is ([\d.]+) times too small: ", closure.sentence)
    assert factor and float(factor[1]) == pytest.approx(5.2, rel=0.1)
    assert closure.wrong_noise == pytest.approx(5.2, rel=0.1)
