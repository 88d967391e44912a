"""Screening: its statistic against refits, its p-values against chance, and what it finds."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import binom, chi2

from known import Known
from vcal import CATALOGUE, Effect, Measurement, Parameter, identify
from vcal.identification.robust import identify_robust
from vcal.loop.empirical import EMPIRICAL, LocalBump
from vcal.loop.residuals.outliers import outlying_rows
from vcal.loop.screening.candidates import candidates
from vcal.loop.screening.score_test import Peak, ScoreTest, largest
from vcal.loop.screening.screening import screen
from vcal.loop.screening.significance import corrected, effective_trials, minus_log_chi2_tail
from vcal.loop.weighing.rivals import refit, refit_all
from vcal.loop.weighing.weighing import classes_of, weigh

FEW = ("backlash", "lateral_reversal", "thermal_offset", "thermal_tilt", "drift", "cross_axis")


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Known]:
    folder = tmp_path_factory.mktemp("known")
    return {kind: Known(kind, folder) for kind in ("laser_tracker", "ball_array")}


def noisy(it: Known, seed: int, *effects: Effect, theta=None, factor=1.0) -> Measurement:
    """What the true machine with further effects gives, with `factor` times the declared noise."""
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = factor * sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    return Measurement(it.plan, it.readings(*effects, theta=theta) + noise)


def screened(it: Known, measurement: Measurement, draws: int = 200, seed: int = 0) -> ScoreTest:
    return ScoreTest(identify(it.model, measurement, room=it.room), draws, seed)


# --- the statistic -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("laser_tracker", "backlash:Y"),
        ("laser_tracker", "backlash:X"),
        ("laser_tracker", "lateral_reversal:X:component=EZX"),
        ("laser_tracker", "angular_reversal:X:component=EBX"),
        ("laser_tracker", "scale_growth:X"),
        ("laser_tracker", "encoder_eccentricity:azimuth"),
        ("laser_tracker", "station_drift"),
        ("laser_tracker", "cross_axis:Y:component=EZY,other=X"),
        pytest.param("ball_array", "backlash:X", marks=pytest.mark.thorough),
        pytest.param("ball_array", "thermal_tilt:Y:component=EAY", marks=pytest.mark.thorough),
        ("ball_array", "ball_error:ball 4"),
        ("ball_array", "artefact_expansion"),
    ],
)
def test_statistic_is_the_drop_of_the_cost_of_a_refit(kind, text, known):
    """s'G^-1 s, with a flat prior on the candidate's amplitudes, which G^-1 s estimates."""
    it = known[kind]
    measurement = noisy(it, 1, it.effect("backlash:Y:size_um=4"))
    state = screened(it, measurement, draws=5)
    effect = it.effect(text)
    tested = state.tests([effect])[0]
    assert tested.drops.rank[0] == len(effect.amplitudes)
    flat = tuple((p.name, 0.0, math.inf) for p in effect.amplitudes)
    model = it.model.with_effects(dataclasses.replace(effect, given=flat))
    fit = identify(model, measurement, room=it.room)
    before, after = (f.chi2 + f.theta**2 @ f.precision for f in (state.fit, fit))
    assert tested.drops.stat[0] == pytest.approx(before - after, rel=2e-3, abs=1e-3)
    first = len(it.model.entries)
    scale = [p.scale / p.sigma for p in effect.amplitudes]
    expected = fit.theta[first:] * scale
    sigma = np.sqrt(np.diag(fit.covariance))[first:] * scale
    np.testing.assert_allclose(
        tested.drops.amplitudes[0], expected, rtol=0, atol=0.01 * sigma.min()
    )
    np.testing.assert_allclose(
        np.diag(np.linalg.inv(state.information(state.columns(effect, {})))), sigma**2, rtol=1e-3
    )


def test_what_the_model_spans_is_unseen(known):
    it = known["laser_tracker"]

    class Twin(Effect):
        """A constant along X: the station takes it up."""

        name = "twin"

        @property
        def parameters(self):
            return (Parameter("size", "um", sigma=10.0),)

        def response(self, plan, shape):
            return {("EXX", "size"): jnp.ones(plan.rows)}

    state = screened(it, noisy(it, 2), draws=5)
    tool, twin, seen = it.effect("tool_offset"), Twin(), it.effect("backlash:X")
    assert state.tests([twin])[0] is None
    result = screen(state, [tool, twin, seen])
    assert result.unseen == [tool, twin]
    assert [kind.kind for kind in result.kinds] == ["backlash"]
    nothing = screen(state, [twin])
    assert (nothing.p_value, nothing.kinds) == (1.0, [])


@pytest.mark.parametrize("kind", ["laser_tracker", "ball_array"])
def test_what_the_data_determine_is_tested(kind, known):
    """Nothing is unseen of which the data tell more than the prior does."""
    it = known[kind]
    state = screened(it, noisy(it, 2), draws=5)
    tried, _ = candidates(it.model, it.measurement, CATALOGUE.values())
    missed = set()
    for effect in (e for e in tried if not e.shapes):
        information = state.information(state.columns(effect, {}))  # in prior sigmas
        if np.linalg.eigvalsh(information)[-1] > 4.0 and state.tests([effect])[0] is None:
            missed.add(effect.key)
    assert missed == set()


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 30])
def test_tail_of_chi_square(dof):
    x = np.concatenate([np.linspace(0, 100, 201), np.geomspace(100, 1200, 30)])
    expected = -chi2.logsf(x, dof)
    np.testing.assert_allclose(minus_log_chi2_tail(x, dof), expected, rtol=1e-9, atol=1e-12)
    # Far out scipy's own logarithm is lost; the tail of two degrees is exp(-x/2) for ever.
    assert minus_log_chi2_tail(1e5, 2) == pytest.approx(5e4, rel=1e-12)
    far = minus_log_chi2_tail(np.array([1380.0, 1400.0, 3000.0]), dof)
    slope = np.diff(far) / [20.0, 1600.0]
    np.testing.assert_allclose(slope, 0.5, atol=0.5 * dof / 1380)
    joint = minus_log_chi2_tail(np.linspace(1300, 1400, 101), dof)
    assert np.ptp(np.diff(joint)) < 1e-3  # no step where the one form takes over from the other


# --- chance --------------------------------------------------------------------------------------


def test_null_draws_have_the_covariance_of_residuals(known):
    """Cov r = I - J H^-1 J' (S = I): noise, and parameters from their prior."""
    it = known["ball_array"]
    state = screened(it, noisy(it, 3), draws=800)
    fit, null = state.fit, state.null.reshape(-1, 800).astype(float)
    hat = fit.jacobian @ np.linalg.solve(
        fit.jacobian.T @ fit.jacobian + np.diag(fit.precision), fit.jacobian.T
    )
    rng = np.random.default_rng(0)
    for way in rng.standard_normal((20, len(null))):
        expected = way @ way - way @ hat @ way
        assert np.mean((way @ null) ** 2) == pytest.approx(expected, rel=4.5 * np.sqrt(2 / 800))
    # The squares of readings and prior together: those of all that has no flat prior.
    assert state.null_cost.mean() == pytest.approx(state.count, rel=0.03)
    again = ScoreTest(fit, 800, 0)
    np.testing.assert_array_equal(again.null, state.null)
    assert np.abs(ScoreTest(fit, 800, 1).null - state.null).max() > 0.1


def test_a_large_plan_is_taken_in_blocks(known, monkeypatch):
    """Null residuals that are drawn in parts, and projections on ports that are not kept."""
    it = known["ball_array"]
    measurement = noisy(it, 3)
    tried, _ = candidates(it.model, measurement, [CATALOGUE["backlash"]])
    kept = screened(it, measurement)
    before = kept.tests(tried)
    monkeypatch.setattr("vcal.loop.screening.sums._ROOM", 0)
    monkeypatch.setattr("vcal.loop.screening.sums._BLOCK_ROWS", (7, 7))
    monkeypatch.setattr("vcal.loop.screening.score_test._DRAWN", 50_000)
    again = screened(it, measurement)
    np.testing.assert_allclose(again.null, kept.null, atol=1e-5)
    np.testing.assert_allclose(again.null_cost, kept.null_cost, rtol=1e-12)
    for one, other in zip(before, again.tests(tried), strict=True):
        np.testing.assert_allclose(one.drops.stat, other.drops.stat, rtol=1e-9, atol=1e-9)
        for rank, drops in one.drops.null.items():
            np.testing.assert_allclose(drops, other.drops.null[rank], rtol=1e-4, atol=1e-4)
    assert len(kept.rows.blocks()) == 1 < len(again.rows.blocks())
    # What is asked for after a screening needs no null residuals; a small plan keeps them.
    kept.release_draws()
    again.release_draws()
    assert kept.null.size > 0 == again.null.size == again.rows.draws
    for one, other in zip(before, again.tests(tried), strict=True):
        np.testing.assert_allclose(one.drops.stat, other.drops.stat, rtol=1e-9, atol=1e-9)
        peak = other.peaks(1)[0]
        assert again.refine(peak).statistic == pytest.approx(kept.refine(peak).statistic)


@pytest.mark.thorough
def test_p_values_are_even_where_nothing_is_missing(known):
    """40 clean machines drawn from their family, half of them noisier than declared."""
    it, rng = known["laser_tracker"], np.random.default_rng(11)
    informed = np.array([float(e.parameter.informed) for e in it.model.entries])
    found = []
    for k in range(40):
        theta = informed * rng.standard_normal(len(informed))
        measurement = noisy(it, 100 + k, theta=theta, factor=1.0 if k % 2 else 1.2)
        tried, _ = candidates(it.model, measurement, [CATALOGUE[name] for name in FEW])
        found.append(screen(screened(it, measurement, seed=k), tried).p_value)
    found = np.array(found)
    assert (found < 0.1).sum() <= binom.ppf(0.999, 40, 0.1)
    assert (found < 0.01).sum() <= 3
    assert found.mean() == pytest.approx(0.5, abs=4 * np.sqrt(1 / 12 / 40))


def levels(parts: list[np.ndarray]) -> list[float]:
    """How often p, corrected by the trials that each part of null draws tells, is below 0.05 and
    0.01 in the other parts.
    """
    found = []
    for i, own in enumerate(parts):
        others = np.concatenate(parts[:i] + parts[i + 1 :])
        p = corrected(others, effective_trials(own))
        found.append([(p < 0.05).mean(), (p < 0.01).mean()])
    return np.mean(found, axis=0).tolist()


def test_steps_of_a_scan_count_as_many_trials_as_they_are_where_something_is_rare():
    """Steps that are alike, such as moments of a jump, are less so the rarer what they show."""
    rng, rows = np.random.default_rng(5), np.arange(1, 200)
    walk = rng.standard_normal((20_000, 200), dtype=np.float32).cumsum(1)
    bridge = walk[:, :-1] - walk[:, -1:] * (rows / 200)
    null = minus_log_chi2_tail((bridge**2 / (rows * (200 - rows) / 200)).max(1), 1.0)
    often, seldom = levels(np.split(null, 40))
    assert 0.045 < often < 0.06  # by all draws alike it would be 0.075
    assert 0.008 < seldom < 0.016  # and 0.020


@pytest.mark.thorough
def test_corrected_p_of_a_scan_is_uniform_at_its_small_end(known):
    """Of draws other than those that the trials were told by: a scan of pitches in two axes."""
    it, parts = known["laser_tracker"], []
    fit = identify(it.model, noisy(it, 8), room=it.room)
    for seed in range(16):
        state = ScoreTest(fit, 500, seed)
        drops = [t.drops.null for t in state.tests([it.effect(f"screw_cyclic:{a}") for a in "XY"])]
        parts.append(state.rarest(largest(drops), state.null_cost))
    often, seldom = levels(parts)
    assert 0.043 < often < 0.064
    assert 0.007 < seldom < 0.017


def test_p_value_pays_for_the_search(known):
    """The corrected p grows with what was tried, and is small for what is there."""
    it = known["laser_tracker"]
    measurement = noisy(it, 4, it.effect("backlash:Y:size_um=12"))
    state = screened(it, measurement)
    alone = screen(state, [it.effect("backlash:X")])
    tried, _ = candidates(it.model, measurement, CATALOGUE.values())
    result = screen(state, [e for e in tried if e.key != "backlash Y"])
    (mine,) = (kind for kind in result.kinds if kind.kind == "backlash")
    (own,) = alone.kinds
    assert own.trials == pytest.approx(1.0, rel=0.2)
    assert mine.instances == 2
    assert result.trials > 3
    full = screen(state, tried)
    assert full.p_value < 1e-8
    assert full.kinds[0].kind == "backlash"
    assert full.peaks[0].effect.key == "backlash Y"
    assert full.corrected(full.kinds[0]) == pytest.approx(full.p_value, rel=1e-9)
    assert full.noise_scale == pytest.approx(1.0, abs=0.15)


# --- what it finds -------------------------------------------------------------------------------


@pytest.mark.parametrize("pitch_mm", [17.3, 9.31])
def test_pitch_between_the_steps_of_the_scan_is_found(pitch_mm, tmp_path):
    """At scattered points: a regular grid has aliases."""
    scattered = {"shape": (4, 4, 3), "margin": 0.12, "jitter": 0.1}
    it = Known("laser_tracker", tmp_path, seed=6, plan=scattered)
    true = it.effect(f"screw_cyclic:X:sine_um=5,cosine_um=4,pitch_mm={pitch_mm}")
    state = screened(it, noisy(it, 5, true))
    tested = state.tests([it.effect("screw_cyclic:X")])[0]
    best = tested.peaks(5)[0]
    covered = np.ptp(it.plan.x("X"))
    off = abs(1 / best.shape["pitch"] - 1e3 / pitch_mm) * covered
    assert off < 0.5  # in periods over the travel; the scan's step is a quarter
    refined = state.refine(best)
    assert abs(1 / refined.shape["pitch"] - 1e3 / pitch_mm) * covered < 0.1
    assert refined.statistic >= best.statistic
    np.testing.assert_allclose(refined.amplitudes * 3.0, [5, 4], atol=1.5)
    # Other peaks are other pitches.
    others = [1 / p.shape["pitch"] for p in tested.peaks(5)]
    assert np.min(np.diff(np.sort(others))) * covered > 0.5


@pytest.mark.parametrize("size_um", [6, 600])
def test_a_step_on_the_slope_of_a_peak_counts_for_that_peak(size_um, known):
    """However steep it is: other moments would have the evidence of the right one beside theirs."""
    it = known["laser_tracker"]
    true = it.effect(f"jump:frame:X_um={size_um},Y_um={size_um / 2},at_s=600")
    state = screened(it, noisy(it, 3, true), draws=5)
    peaks = state.tests([it.effect("jump:frame")])[0].peaks(5)
    assert len(peaks) > 2
    assert all(peak.log_share <= 1e-9 for peak in peaks)
    assert max(peaks, key=lambda p: p.log_bayes) is peaks[0]


@pytest.mark.parametrize(
    ("text", "several"),
    [("jump:tool", True), ("warm_up:Y:component=EZY", False), ("screw_cyclic:X", True)],
)
def test_the_peaks_share_the_evidence_of_the_whole_scan(text, several, known):
    it = known["laser_tracker"]
    state = screened(it, noisy(it, 3, it.effect("jump:tool:X_um=6,at_s=600")), draws=5)
    tested = state.tests([it.effect(text)])[0]
    peaks = tested.peaks(10)
    assert (len(peaks) > 1) is several
    # Each is higher than its neighbours.
    grid = np.indices(tested.scan.lengths).reshape(len(tested.scan.names), -1).T
    for peak in peaks:
        here = [peak.shape[name] for name in tested.scan.names]
        (place,) = np.flatnonzero((tested.scan.mesh == here).all(1))
        beside = (np.abs(grid - grid[place]) <= 1).all(1) & (tested.drops.rank > 0)
        assert tested.drops.stat[beside].max() == peak.statistic
    together = logsumexp([p.log_bayes for p in peaks])
    assert together == pytest.approx(logsumexp(tested.bayes) - math.log(len(tested.bayes)))
    for peak in peaks:
        assert state.refine(peak).log_bayes >= peak.log_bayes


def test_what_would_leave_its_scan_is_not_explained_by_another(known):
    """A drift, taken for a warming-up whose time constant would become still longer."""
    it = known["laser_tracker"]
    measurement = noisy(it, 3, it.effect("drift:Y:rate_EZY_um_per_h=3000"))
    effect = it.effect("warm_up:Y:component=EZY")
    effect = dataclasses.replace(effect, given=(("size_EZY", 0.0, 1e5),))
    fit = identify(it.model.with_effects(effect), measurement, room=it.room)
    (shape,) = fit.shapes.values()
    assert shape["tau"] == pytest.approx(effect.scan(it.plan)["tau"].max())
    h = fit.jacobian.T @ fit.jacobian + np.diag(fit.precision)
    uphill = fit.jacobian.T @ fit.whitened - fit.precision * fit.theta
    further = np.linalg.solve(h, uphill)
    assert uphill @ further > 0.1
    left = ScoreTest(fit, 5, 0).residual.reshape(-1)
    downhill = fit.jacobian.T @ left - fit.precision * (fit.theta + further)
    np.testing.assert_allclose(downhill, 0.0, atol=1e-6 * np.abs(uphill).max())


def test_no_size_gains_more_than_the_drop_says(known):
    """Whatever size is allowed: half the drop is the most that any prior of it could gain."""
    it = known["laser_tracker"]
    large = it.effect("geometric_order:EZY:P2_um=3000")
    state = screened(it, noisy(it, 6, large))
    tried, _ = candidates(it.model, it.measurement, EMPIRICAL)
    far_larger = 0
    for tested in filter(None, state.tests(tried)):
        most = 0.5 * tested.drops.stat.max()
        for peak in (*tested.peaks(5), *map(state.refine, tested.peaks(2))):
            assert peak.log_bayes_at_its_size <= max(most, 0.5 * peak.statistic) + 1e-6, peak
            far_larger += peak.size_allowance > 0.5
    assert far_larger


def test_a_rival_that_the_data_do_not_see_is_left_out(known):
    """A narrow bump between two places of X: no reading tells where it is."""
    it = known["laser_tracker"]
    state = screened(it, noisy(it, 6))
    bump = LocalBump(port="EYX", unit="um", placement="X")
    x = np.unique(np.round(np.asarray(it.plan.x("X")), 4))
    gap = int(np.argmax(np.diff(x)))
    between = {"centre": 0.5 * (x[gap] + x[gap + 1]), "width": np.ptp(x) / 80.0}
    assert x[gap + 1] - x[gap] > 20.0 * between["width"]
    peak = Peak(bump, between, np.array([0.1]), 0.0, 0.0, 1)
    fit = refit(state.fit, peak, state.fit.used, it.room)
    assert fit.converged and not fit.determined and state.fit.determined
    assert refit_all(state.fit, [peak], {"local_bump": 1}, state.fit.used, it.room) == []


@pytest.mark.thorough
def test_a_rival_whose_size_is_told_and_whose_shape_is_not_is_kept(tmp_path):
    """A gear that has wound up at loads below those of any pose: by how much, but not when."""
    it = Known("reflectors", tmp_path)
    state = screened(it, noisy(it, 6))
    tried, _ = candidates(it.model, it.measurement, [CATALOGUE["gear_wind_up"]])
    effect = next(e for e in tried if e.placement == "J5")
    knees = effect.scan(it.plan)["knee"]
    peak = Peak(effect, {"knee": float(knees.min())}, np.array([0.1]), 0.0, 0.0, 1)
    (rival,) = refit_all(state.fit, [peak], {"gear_wind_up": 1}, state.fit.used, it.room)
    place = len(it.model.effects)
    (size,), (knee,) = rival.fit.places_of(place)
    information = (rival.fit.jacobian**2).sum(0)
    assert information[knee] < 1e-8 < 1.0 < information[size]
    assert rival.fit.determined and np.isfinite(rival.log_weight)
    # It may be anywhere in its scan.
    u = np.sqrt(rival.fit.planned_covariance[knee, knee])
    assert u == pytest.approx(len(knees) / np.sqrt(12.0))


def test_parameters_that_are_the_same_and_have_no_prior_are_not_determined(known):
    it = known["ball_array"]
    fit = screened(it, noisy(it, 6)).fit
    one, other = np.flatnonzero(fit.precision == 0.0)[[0, -1]]
    alike = np.array(fit.jacobian)
    alike[:, other] = 3.0 * alike[:, one]
    assert fit.determined
    assert not dataclasses.replace(fit, jacobian=alike).determined
    # A prior of either tells them apart.
    known_one = np.array(fit.precision)
    known_one[other] = 1.0
    assert dataclasses.replace(fit, jacobian=alike, precision=known_one).determined


def test_placements_that_move_the_same_are_one_class(known):
    """A drift along X of any axis moves the tool alike; a drift of its yaw does not."""
    it = known["laser_tracker"]
    true = it.effect("drift:Y:rate_EXY_um_per_h=120")
    state = screened(it, noisy(it, 6, true))
    tried = [it.effect(f"drift:{a}:component=EX{a}") for a in "XYZ"]
    tried += [it.effect(f"drift:{a}:component=EC{a}") for a in "XY"]
    peaks = screen(state, tried).peaks
    rivals = refit_all(state.fit, peaks, {"drift": len(tried)}, state.fit.used, it.room)
    assert rivals[0].effect in tried[:3]
    weighed = weigh(classes_of(state.fit, rivals), rivals[0])
    same = {rivals[0].effect.placement, *(name.split()[1] for name in weighed.equivalent)}
    assert same == {"X", "Y", "Z"}
    assert weighed.probability + sum(p for *_, p in weighed.alternatives) == pytest.approx(1.0)
    assert weighed.probability > 0.95
    place = len(state.fit.model.effects)
    values = {r.effect.placement: r.fit.values_of(place)[0][2] for r in rivals
              if r.effect in tried[:3]}  # fmt: skip
    # The table X moves against the others.
    assert values["X"] == pytest.approx(-values["Y"], rel=1e-2)
    assert values["Z"] == pytest.approx(values["Y"], rel=1e-2)
    assert values["Y"] == pytest.approx(120, abs=60)


# --- stray readings ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["laser_tracker", "ball_array"])
@pytest.mark.thorough
def test_stray_readings(kind, known):
    it = known[kind]

    def found(measurement):
        fit = identify(it.model, measurement, room=it.room)
        return outlying_rows(fit, lambda: identify_robust(it.model, measurement, room=it.room))

    measurement = noisy(it, 7)
    assert found(measurement) == []
    readings = measurement.readings.copy()
    readings[33, 1] += 15 * it.instrument.noise(it.plan, readings)[33, 1]
    (stray,) = found(Measurement(it.plan, readings))
    assert stray.row == 33
    assert 7 < stray.distance < 16
    assert stray.p_value < 1e-6
    # Ten of them are something systematic, and left to the search.
    many = measurement.readings.copy()
    many[30:40, 1] += 20 * it.instrument.noise(it.plan, many)[30:40, 1]
    assert found(Measurement(it.plan, many)) == []
