"""What has no name: empirical descriptions of it, and when they give way to an effect that has."""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import null_space
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from known import Known
from oracle import make_case, write_study
from vcal import CATALOGUE, Effect, Measurement, Parameter, close_loop, identify, load_study
from vcal.effects.registry import load_effects
from vcal.loop.close_loop import _separation
from vcal.loop.empirical import EMPIRICAL, Harmonic, Interaction, Kink, LocalBump, Proportion, Since
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.screening.size_evidence import log_gain, log_mixture, over_scales
from vcal.loop.search.certainty import doubted
from vcal.loop.weighing.cross_validation import improvement, log_predictive_density
from vcal.loop.weighing.rivals import Rival, refit_all
from vcal.loop.weighing.weighing import Weighed, fits_better, in_doubt, outdoes
from vcal.report.loop.own_effect import own_effect


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("tracker"))


class Given(Effect):
    """Any error motion, by a formula of the test's own."""

    name = "given"
    formula: Callable
    port: str
    unit: str = "um"

    @property
    def parameters(self):
        return (Parameter("size", self.unit, sigma=10.0),)

    def response(self, plan, shape):
        return {(self.port, "size"): self.formula(plan)}


def measured(it: Known, *effects: Effect, seed: int = 5) -> Measurement:
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    return Measurement(it.plan, it.readings(*effects) + noise)


def unit(x) -> np.ndarray:
    x = np.asarray(x)
    return (2 * x - x.max() - x.min()) / np.ptp(x)


def kinked(plan):
    return np.maximum(np.asarray(plan.x("X")) - 0.8, 0.0)


def crossed(plan):
    return unit(plan.x("X")) ** 2 * unit(plan.x("Y")) ** 2


def growing_play(plan):
    return np.asarray(plan.covariate("dir_X")) * np.asarray(plan.x("X"))


def swinging_play(plan):
    return np.asarray(plan.covariate("dir_X")) * unit(plan.x("X"))


def no_longer_fed(plan):
    t, x = np.asarray(plan.covariate("t")), np.asarray(plan.x("X"))
    at = np.quantile(t, 0.4)
    return np.where(t > at, x * (0.6 + (t - at) / np.ptp(t)), 0.0)


CASES = {
    "kink": (kinked, "EAX", "urad", 120.0, Kink, {"X"}),
    "product": (crossed, "EZX", "um", 25.0, Interaction, {"X", "Y"}),
    "play": (growing_play, "EXX", "um", 9.0, Interaction, {"X", "dir_X"}),
    "since": (no_longer_fed, "EXX", "um", 20.0, Since, {"X", "t"}),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.thorough if c in ("kink", "since") else ()) for c in CASES],
)
@pytest.mark.thorough
def test_what_no_effect_has_is_described(tracker, tmp_path, case):
    """The description tells on what it depends; the file for an effect of one's own holds it."""
    formula, port, unit_, size, cls, on = CASES[case]
    true = Given(formula=formula, port=port, unit=unit_, given=(("size", size, 0.0),))
    closure = close_loop(tracker.model, measured(tracker, true), draws=200)
    assert closure.verdict == "unexplained"
    assert closure.effects == []
    what = closure.unexplained
    assert isinstance(what.empirical.effect, cls)
    assert set(what.depends_on[: len(on)]) == on
    assert what.joint == (len(on) == 2)
    assert what.words in closure.sentence
    assert what.reason.endswith("better than every effect that was tried")
    assert what.size_is.startswith("largest displacement") and "beyond the noise" in what.share_is
    (tmp_path / "own_effect.py").write_text(own_effect(closure))
    (own,) = load_effects(tmp_path / "own_effect.py")
    (effect,) = own.candidates(tracker.setup)
    described = what.empirical
    place = len(described.fit.model.effects) - 1
    expected = described.effect.response(tracker.plan, described.fit.shapes.get(place, {}))
    found = effect.response(tracker.plan, {})
    assert set(found) == set(expected)
    for key, value in expected.items():
        value = np.asarray(value)
        assert np.asarray(found[key]) == pytest.approx(value, abs=2e-3 * np.abs(value).max())
    with_it = identify(tracker.model.with_effects(effect), closure.before.measurement)
    assert with_it.chi2 / with_it.dof == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    "effect",
    ["cross_axis:X:other=Y,EZX_x_y_um=12", "thermal_tilt:X:k_ECX_urad_per_K=90"],
)
@pytest.mark.thorough
def test_a_physical_effect_that_fits_as_well_has_the_name(tracker, effect):
    """A product of two quantities would do, and with fewer parameters."""
    closure = close_loop(tracker.model, measured(tracker, tracker.effect(effect)), draws=200)
    (found,) = closure.effects
    name, place, _ = effect.split(":", 2)
    assert found.effect.name == name
    assert (
        place in found.placement
        or any(f"{name} {place}" in k for k in found.equivalent)
        or any((n, p) == (name, place) for n, p, _ in found.alternatives)
    )
    assert closure.unexplained is None


@pytest.mark.thorough
def test_a_name_is_not_certain_beside_more_that_is_unexplained(tracker):
    """A play, and far more that depends on the direction, too, but is none on average."""
    swinging = Given(formula=swinging_play, port="EXX", unit="um", given=(("size", 12.0, 0.0),))
    play = tracker.effect("backlash:X:size_um=3")
    alone, both = measured(tracker, play), measured(tracker, swinging, play)
    (named,) = close_loop(tracker.model, alone, draws=200).effects
    rest = close_loop(tracker.model, both, draws=200).unexplained
    assert named.status == "named" and "dir_X" in rest.depends_on
    model = tracker.model.with_effects(named.effect)
    less = doubted(named, identify(model, both), rest, [])
    assert less.status == "ambiguous"
    assert "larger than what the effect explains and depends on" in less.separation
    # Not where it explains more than is left, and not where that depends on something else.
    assert doubted(named, identify(model, alone), rest, []) is named
    elsewhere = dataclasses.replace(rest, depends_on=["T_Y"], shares=[1.0])
    assert doubted(named, identify(model, both), elsewhere, []) is named


@pytest.mark.parametrize("unit_", ["deg", "rad"])
@pytest.mark.thorough
def test_what_comes_round_with_an_angle_that_was_recorded(tracker, unit_):
    """The orientation of a spindle that does not turn true: no proportion, and of order one."""
    rng = np.random.default_rng(4)
    angle = rng.uniform(-np.pi, np.pi, tracker.plan.rows)
    column = f"spindle_{unit_}"
    values = np.degrees(angle) if unit_ == "deg" else angle
    plan = dataclasses.replace(tracker.plan, covariates={**tracker.plan.covariates, column: values})
    off = Given(formula=lambda plan: np.cos(angle - 0.7), port="tool.Y", given=(("size", 8.0, 0),))
    measurement = Measurement(plan, measured(tracker, off).readings)
    closure = close_loop(tracker.model, measurement, draws=200)
    assert closure.verdict == "unexplained" and not closure.effects
    assert f"1 period per turn of an angle along Y ({column})" in closure.sentence
    best = closure.unexplained.empirical
    assert isinstance(best.effect, Harmonic)
    place = len(best.fit.model.effects) - 1
    found = {p.name: (v, u) for _, p, v, u in best.fit.values_of(place)}
    for name, true in (("cosine", 8.0 * np.cos(0.7)), ("sine", 8.0 * np.sin(0.7))):
        assert abs(found[name][0] - true) < 3.5 * found[name][1] < 3.0
    setup = tracker.model.setup(plan)
    products = [e.products for cls in (Interaction, Proportion) for e in cls.candidates(setup)]
    assert not any(f.name == column for these in products for one in these for f in one)


def test_an_angle_may_be_another_one_in_every_run(tracker):
    """Orders go by the places per turn of all runs, and not of one."""
    run = np.arange(tracker.plan.rows) % 12
    recorded = {**tracker.plan.covariates, "spindle_deg": 30.0 * run}
    plan = dataclasses.replace(tracker.plan, covariates=recorded, groups={"run": run})
    found = list(Harmonic.candidates(tracker.model.setup(plan)))
    assert found and {effect.highest for effect in found} == {6}


def test_an_angle_that_does_not_go_round_has_no_orders(tracker):
    angle = np.random.default_rng(4).uniform(-60.0, 60.0, tracker.plan.rows)
    plan = dataclasses.replace(
        tracker.plan, covariates={**tracker.plan.covariates, "head_deg": angle}
    )
    assert not list(Harmonic.candidates(tracker.model.setup(plan)))


def test_every_description_is_told_from_the_catalogue():
    names = [cls.name for cls in EMPIRICAL]
    assert len(set(names)) == len(names)
    assert set(names).isdisjoint(CATALOGUE)
    assert LocalBump in EMPIRICAL


# --- the weights ----------------------------------------------------------------------------------


def test_evidence_over_orders_of_magnitude():
    """Against quadrature over one amplitude, and additive over independent ones."""
    rng = np.random.default_rng(3)
    column, data = rng.standard_normal(9), rng.standard_normal(9)

    def likelihood(a: float) -> float:
        return float(np.exp(norm.logpdf(data, a * column).sum() - norm.logpdf(data).sum()))

    scales = 4.0 ** np.arange(-10.0, 17.0)
    odds = np.where(scales > 1.0, 0.1 / np.sqrt(scales), 1.0)
    # Beyond eight standard deviations of the prior or of the likelihood there is nothing.
    far = abs(column @ data) / (column @ column) + 8.0 / np.sqrt(column @ column)
    numeric = [
        quad(lambda a, s=s: likelihood(a) * norm.pdf(a, scale=s), -reach, reach)[0]
        for s in np.sqrt(scales)
        for reach in [min(8.0 * s, far)]
    ]
    information, score = np.array([column @ column]), np.array([column @ data])
    np.testing.assert_allclose(np.exp(log_gain(information, score, scales)), numeric, rtol=1e-7)
    assert np.exp(log_mixture(information, score)) == pytest.approx(
        np.average(numeric, weights=odds), rel=1e-7
    )
    two = log_gain(np.repeat(information, 2), np.repeat(score, 2), scales)
    np.testing.assert_allclose(two, 2 * log_gain(information, score, scales))


def test_the_mixture_of_a_fit_is_that_of_fits_with_other_priors(tracker):
    """An effect of 1 um on a prior of 10 um: what changing the prior does to the whole evidence."""
    measurement = measured(tracker, tracker.effect("backlash:Y:size_um=1"))
    effect = next(iter(CATALOGUE["backlash"].candidates(tracker.setup)))
    sigma = effect.amplitudes[0].sigma
    evidence = []
    scales = 2.0 ** np.arange(-10, 17)
    for scale in scales:
        given = ((effect.amplitudes[0].name, 0.0, float(sigma * scale)),)
        narrow = dataclasses.replace(effect, given=given)
        fit = identify(tracker.model.with_effects(narrow), measurement)
        evidence.append(fit.log_evidence())
    whole = identify(tracker.model.with_effects(effect), measurement)
    first = len(tracker.model.entries)
    odds = np.where(scales > 1.0, 0.1 / scales, 1.0)
    gains = np.exp(np.array(evidence) - evidence[int(np.argmax(scales == 1.0))])
    expected = np.log(np.average(gains, weights=odds))
    assert over_scales(whole, slice(first, first + 1)) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("size", [8.0, 25.0])
@pytest.mark.thorough
def test_evidence_of_a_time_constant_at_the_end_of_its_scan(tracker, size):
    """A drift, taken for a warming-up: against the mean over all time constants, each as known."""
    true = tracker.effect(f"drift:Y:rate_EZY_um_per_h={size * 10}")
    effect = tracker.effect("warm_up:Y:component=EZY")
    fit = identify(tracker.model.with_effects(effect), measured(tracker, true))
    grid = effect.scan(tracker.plan)["tau"]
    (place,) = fit.shapes
    assert fit.shapes[place]["tau"] > 0.8 * grid[-1]
    evidence = []
    for tau in grid:
        given = (("tau", float(tau) / 3600.0, 0.0),)
        with_known = tracker.model.with_effects(dataclasses.replace(effect, given=given))
        evidence.append(identify(with_known, fit.measurement).log_evidence())
    exact = logsumexp(evidence) - np.log(len(grid))
    assert fit.log_evidence() == pytest.approx(exact, abs=1.0)
    # As a rival, which knows the whole scan.
    base = identify(tracker.model, fit.measurement)
    peaks = ScoreTest(base, 5, 0).tests([effect])[0].peaks(10)
    best = refit_all(base, peaks, {"warm_up": 1}, base.used)[0]
    amplitude = slice(len(tracker.model.entries), len(tracker.model.entries) + 1)
    noise = max(1.0, best.fit.chi2 / best.fit.dof) ** 0.5
    found = best.log_bayes - over_scales(best.fit, amplitude, noise)
    scale = [f.log_evidence(noise) - f.log_evidence() for f in (base, best.fit)]
    assert found + base.log_evidence() + scale[0] - scale[1] == pytest.approx(exact, abs=0.4)


def test_the_order_of_peaks_has_no_say(tracker):
    """All run to the same time constant, and its share of the scan is that of the highest."""
    effect = tracker.effect("warm_up:Y:component=EZY")
    true = tracker.effect("drift:Y:rate_EZY_um_per_h=80")
    base = identify(tracker.model, measured(tracker, true))
    (highest,) = ScoreTest(base, 5, 0).tests([effect])[0].peaks(10)
    taus = effect.scan(base.measurement.plan)["tau"]
    slopes = [
        dataclasses.replace(highest, shape={"tau": float(tau)}, statistic=0.9 * highest.statistic,
                            log_share=highest.log_share - 1.0)
        for tau in taus[[5, 9]]
    ]  # fmt: skip
    peaks = [highest, *slopes]
    shares = []
    for order in (peaks, peaks[::-1]):
        (only,) = refit_all(base, order, {"warm_up": 1}, base.used)
        shares.append(only.log_shape)
    assert shares[0] == pytest.approx(shares[1], abs=0.01)
    assert shares[0] < 0.0


def rival(chi2: float, weight: float, parameters: int, size_surplus: float = 0.0):
    """As much of a rival as the preference looks at, with odds of one beforehand."""
    fit = SimpleNamespace(chi2=chi2, dof=100.0)
    peak = SimpleNamespace(effect=SimpleNamespace(parameters=(None,) * parameters))
    return Rival(peak, fit, weight, 0.0, 0.0, size_surplus=size_surplus)


@pytest.mark.parametrize(
    ("other", "preferred"),
    [
        (rival(111.0, 20.0, 1), True),  # fits clearly worse, whatever its evidence
        (rival(109.0, 18.0, 3), False),
        (rival(103.0, 14.0, 3), True),  # far less likely, with as many parameters
        (rival(103.0, 14.0, 4), False),  # for its parameters
        (rival(103.0, 14.0, 3, size_surplus=1.5), False),  # for its size
        (rival(103.0, 8.0, 3, size_surplus=1.5), True),  # for more than its size
        (rival(103.0, 8.0, 3, size_surplus=9.5), False),
        (rival(99.0, 14.0, 3), False),  # fits better
    ],
)
def test_when_a_description_is_preferred_to_a_name(other, preferred):
    first = (other, other.log_weight)
    assert fits_better(rival(100.0, 18.0, 3), [first]) == preferred
    assert not fits_better(rival(100.0, 18.0, 3), [first, (rival(100.0, 18.0, 1), 18.0)])
    # The shapes of a name together are likelier than each.
    assert not fits_better(rival(100.0, 18.0, 3), [(rival(103.0, 14.0, 3), 15.5)])


def test_a_description_is_not_preferred_for_the_size_of_an_effect():
    description, effect = rival(100.0, 18.0, 3), rival(111.0, 17.0, 1)
    assert outdoes(description, [])
    assert outdoes(description, [(effect, effect.log_weight)])
    # Places and shapes of one name together are likelier than each.
    assert not outdoes(description, [(effect, 18.5)])
    large = rival(111.0, 15.5, 1, size_surplus=2.5)
    assert not outdoes(description, [(large, large.log_weight)])
    beyond = rival(
        111.0, 5.0, 1, size_surplus=13.0
    )  # of which all but ln 20 is made up for already
    assert not outdoes(description, [(beyond, beyond.log_weight)])
    worse = rival(111.0, 3.0, 1, size_surplus=13.0)
    assert outdoes(description, [(worse, worse.log_weight)])


@pytest.mark.parametrize(
    ("description", "doubt"),
    [
        (rival(98.0, 16.0, 2), True),
        (rival(98.0, 14.0, 2), False),  # the effect is clearly likelier
        (rival(99.5, 17.0, 2), False),  # fits no better
        (rival(103.0, 19.0, 2), False),
    ],
)
def test_when_a_description_puts_a_name_in_doubt(description, doubt):
    assert in_doubt(description, rival(100.0, 18.0, 2), 18.0) == doubt
    # What the effect loses by its size does not speak for a description.
    large = rival(100.0, 8.0, 2, size_surplus=10.0)
    assert in_doubt(description, large, large.log_weight) == doubt
    small = rival(100.0, 8.0, 2, size_surplus=1.0)
    assert in_doubt(rival(98.0, 14.0, 2), small, small.log_weight)
    # Its shapes together are clearly likelier than the description.
    assert not in_doubt(rival(98.0, 14.0, 2), small, 17.5)


@pytest.mark.parametrize(
    ("own", "rival", "theirs", "expected"),
    [
        (
            ("X",), "local_bump", ("X",),
            "measure at further values of x_mm, between and beyond those measured",
        ),
        (("T_X",), "drift", ("t",), "vary T_x_degC independently of t_s"),
        (("T_X", "X"), "tilt", ("X",), "vary T_x_degC independently of x_mm"),
        (("X",), "backlash", ("dir_X", "X"), "vary dir_x independently of x_mm"),
        (
            ("T_X",), "tilt", ("T_X",),
            "it depends on T_x_degC, and so does tilt X: measure at further positions, where their "
            "errors differ",
        ),
        (
            ("t",), "jump", ("t",),
            "it depends on t_s, and so does jump X: measure at further moments and positions, "
            "where their errors differ",
        ),
    ],
)  # fmt: skip
def test_what_would_tell_an_effect_from_what_it_may_be(own, rival, theirs, expected):
    """Nothing can be varied independently of itself."""
    other = SimpleNamespace(effect=SimpleNamespace(name=rival, placement="X", indicators=theirs))
    best = SimpleNamespace(effect=SimpleNamespace(indicators=own))
    weighed = Weighed(best, 0.3, [], [(rival, "X", 0.7)], 9.0, instead=((0.7, other),))
    assert _separation(weighed, ("X", "Y", "Z")) == expected


# --- held-out readings ----------------------------------------------------------------------------


def test_what_a_fit_foretells_of_a_fold(tracker):
    """All blocks of a fold together: the density of its readings with the parameters from the rest,
    by the covariance of them all.
    """
    fit = identify(tracker.model, measured(tracker))
    n, m = fit.residual.shape
    found = log_predictive_density(fit)
    folds, _ = fit.model.instrument.folds(fit.measurement.plan)
    flat = fit.precision == 0
    prior = fit.precision + 1e-8 * flat * np.diag(fit.jacobian.T @ fit.jacobian)
    for fold in np.unique(folds)[:2]:
        mine = np.repeat(folds == fold, m)
        rest, held = fit.jacobian[~mine], fit.jacobian[mine]
        h = rest.T @ rest + np.diag(prior)
        # What is left is r - J x with x beside theta: least over the rest and the prior.
        step = np.linalg.solve(h, rest.T @ fit.whitened[~mine] - fit.precision * fit.theta)
        mean = fit.whitened[mine] - held @ step
        covariance = np.eye(mine.sum()) + held @ np.linalg.solve(h, held.T)
        exact = -2 * multivariate_normal.logpdf(mean, np.zeros(len(mean)), covariance)
        exact -= mine.sum() * np.log(2 * np.pi)
        assert found.deviance[found.folds == fold].sum() == pytest.approx(exact, abs=0.05)
        distance = mean @ np.linalg.solve(covariance, mean)
        assert found.squares[found.folds == fold].sum() == pytest.approx(distance, abs=0.05)


def test_what_only_a_fold_can_see_is_projected_out_of_it(tmp_path):
    """The poses of an artefact: the density of what is orthogonal to their columns, with the
    covariance of all readings of the fold.
    """
    it = Known("ball_array", tmp_path)
    fit = identify(it.model, measured(it))
    n, m = fit.residual.shape
    found = log_predictive_density(fit)
    folds, _ = fit.model.instrument.folds(fit.measurement.plan)
    flat = fit.precision == 0
    for fold in np.unique(folds)[:2]:
        used = np.repeat(fit.used, m) & fit.counted.reshape(-1)
        mine = np.repeat(folds == fold, m) & used
        rest, held = fit.jacobian[~mine & used], fit.jacobian[mine]
        own = flat & ~rest.any(0)
        assert own.sum() == 6
        rest, held, only = rest[:, ~own], held[:, ~own], held[:, own]
        h = rest.T @ rest + np.diag(fit.precision[~own])
        known = rest.T @ fit.whitened[~mine & used] - (fit.precision * fit.theta)[~own]
        away = null_space(only.T).T
        mean = away @ (fit.whitened[mine] - held @ np.linalg.solve(h, known))
        covariance = away @ (np.eye(mine.sum()) + held @ np.linalg.solve(h, held.T)) @ away.T
        exact = -2 * multivariate_normal.logpdf(mean, np.zeros(len(mean)), covariance)
        exact -= len(mean) * np.log(2 * np.pi)
        assert found.deviance[found.folds == fold].sum() == pytest.approx(exact, abs=1e-3)


def test_noise_is_not_foretold_better_and_an_effect_is(tracker):
    effect = tracker.effect("backlash:Y:size_um=6")
    candidate = next(
        e for e in CATALOGUE["backlash"].candidates(tracker.setup) if e.placement == "Y"
    )
    for true, holds in (((), False), ((effect,), True)):
        measurement = measured(tracker, *true)
        before = identify(tracker.model, measurement)
        after = identify(tracker.model.with_effects(candidate), measurement)
        fall, error = improvement(before, after)
        assert (fall > error) == holds


# --- several effects ------------------------------------------------------------------------------


@pytest.mark.campaign
def test_effects_that_stood_for_parts_of_another_give_way(tmp_path):
    """A jump beside a scale that grows: whatever is named on the way, at the end these are."""
    effects = [
        {"effect": "jump", "axis": "Z", "component": "Z", "t0_s": 2500.0, "size_um": 8.0},
        {"effect": "thermal_tilt", "axis": "Y", "component": "A", "urad_per_K": 9.0},
    ]
    case = make_case("laser_tracker", seed=12, effects=effects, plan={"cycles": True})
    study = load_study(write_study(tmp_path / "study", case))
    closure = close_loop(study.model, study.measurement, draws=200)
    names = {e.effect.name for e in closure.effects}
    equivalent = {k.split(" ")[0] for e in closure.effects for k in e.equivalent}
    assert {"jump", "thermal_tilt"} <= names | equivalent
    assert len(closure.effects) == 2


def test_an_effect_larger_than_expected_is_taken_for_all_of_it(tracker):
    """Six times what its prior expects: neither is it pulled to the prior, nor does the rest of it
    become something else.
    """
    closure = close_loop(
        tracker.model, measured(tracker, tracker.effect("backlash:Y:size_um=60")), draws=200
    )
    (found,) = closure.effects
    assert closure.verdict == "named" and found.effect.name == "backlash"
    ((_, value, _, u),) = found.parameters
    assert value == pytest.approx(60, abs=3 * u)
    assert found.effect.amplitudes[0].sigma > 60 / 2
