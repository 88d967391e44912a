"""The parts of the loop where something once went wrong: what is tried, judged, kept and told."""

import dataclasses
import importlib
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import vcal.loop.search.search
from known import Known
from vcal import CATALOGUE, Effect, Measurement, Parameter, Prior, close_loop, identify, predict
from vcal.distributions import Normal
from vcal.effects.reference import with_free_reference
from vcal.loop.close_loop import still_rejected
from vcal.loop.empirical import EMPIRICAL
from vcal.loop.outcome.closure import FoundEffect, Rejected
from vcal.loop.outcome.unexplained import from_structure
from vcal.loop.residuals.dependence import dependence
from vcal.loop.screening import score_test as screening
from vcal.loop.screening.candidates import candidates
from vcal.loop.screening.responses import Responses
from vcal.loop.screening.score_test import Peak, ScoreTest
from vcal.loop.screening.screening import screen
from vcal.loop.search.certainty import chance, doubted, hinted, odds_of_kinds
from vcal.loop.search.forward_selection import Added
from vcal.loop.search.round import shortlist, unlikely
from vcal.loop.search.search import Search
from vcal.loop.search.state import fitted
from vcal.loop.weighing.cross_validation import heldout_rms, improvement
from vcal.loop.weighing.rivals import refit_all
from vcal.loop.weighing.weighing import Names, preferred, weigh


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("search"))


def noisy(it: Known, seed: int, *effects: Effect) -> Measurement:
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    return Measurement(it.plan, it.readings(*effects) + noise)


def bare(it: Known, text: str) -> Effect:
    return dataclasses.replace(it.effect(text), given=())


def searching(it: Known) -> Search:
    return Search(None, [], 0.01, 50, 0, it.room, lambda text: None)


class Bump(Effect):
    """A bump in time, narrow enough to lie within one fold."""

    name = "bump"

    @property
    def parameters(self):
        return (Parameter("a", "um", sigma=20.0), Parameter("at", "s", shape=True))

    def response(self, plan, shape):
        t = plan.covariate("t")
        return {("tool.Z", "a"): jnp.exp(-0.5 * ((t - shape["at"]) / 10.0) ** 2)}

    def scan(self, plan):
        t = np.asarray(plan.covariate("t"))
        return {"at": np.linspace(t.min(), t.max(), 61)}


class Blind(Bump):
    """Sees nothing on this plan."""

    name = "blind"

    def response(self, plan, shape):
        return {}


# --- what is tried --------------------------------------------------------------------------------


def test_the_best_candidate_is_refitted_however_many_are_close():
    def peak(name: str, log_bayes: float) -> Peak:
        effect = SimpleNamespace(name=name, odds=1.0)
        return Peak(effect, {}, np.zeros(1), 20.0, log_bayes, 1)  # type: ignore[arg-type]

    others = [peak(f"kind {k}", 2.5 + 0.1 * k) for k in range(14)]
    peaks = sorted([peak("best", 10.0), *others], key=lambda p: -p.log_bayes)
    state = SimpleNamespace(refine=lambda p: p, rarity_of=lambda p: 0.5 * p.statistic)
    once = {p.effect.name: 1 for p in peaks}
    chosen = shortlist(state, peaks[:1], peaks, once)  # type: ignore[arg-type]
    assert [p.effect.name for p in chosen] == ["best", *(f"kind {k}" for k in range(13, 2, -1))]


def test_what_made_a_kind_significant_is_refitted_whatever_is_likelier():
    """Six parameters may be significant that three of the same kind and others are likelier than;
    nothing else would tell of it.
    """

    def peak(name: str, statistic: float, log_bayes: float) -> Peak:
        effect = SimpleNamespace(name=name, odds=1.0)
        return Peak(effect, {}, np.zeros(1), statistic, log_bayes, 1)  # type: ignore[arg-type]

    rare, likely, far = (peak("jump", s, b) for s, b in ((30.0, -7.0), (20.0, 2.0), (29.0, -40.0)))
    others = [peak(f"kind {k}", 10.0, 2.5 + 0.1 * k) for k in range(14)]
    state = SimpleNamespace(refine=lambda p: p, rarity_of=lambda p: 0.5 * p.statistic)
    peaks = sorted([rare, likely, *others], key=lambda p: -p.log_bayes)
    once = {p.effect.name: 1 for p in peaks}
    chosen = shortlist(state, [rare, likely], peaks, once)  # type: ignore[arg-type]
    assert any(p is rare for p in chosen)
    # Beside what is likelier by that much it has no say.
    chosen = shortlist(state, [likely, far], [*peaks, far], once)  # type: ignore[arg-type]
    assert not any(p is far for p in chosen)


def test_a_candidate_that_sees_nothing_is_unseen(tracker):
    state = ScoreTest(identify(tracker.model, noisy(tracker, 1), room=tracker.room), 20, 0)
    found = screen(state, [Blind(), bare(tracker, "backlash:Y:size_um=1")])
    assert [effect.name for effect in found.unseen] == ["blind"]
    assert [kind.kind for kind in found.kinds] == ["backlash"]


def test_evidence_does_not_depend_on_chunks(tracker, monkeypatch):
    true = tracker.effect("screw_cyclic:X:sine_um=8,cosine_um=4,pitch_mm=10")
    state = ScoreTest(identify(tracker.model, noisy(tracker, 9, true), room=tracker.room), 20, 0)
    effect = dataclasses.replace(true, given=())
    whole = state.tests([effect])[0]
    monkeypatch.setattr(screening, "_CHUNK", 7)
    parts = state.tests([effect])[0]
    assert whole is not None and parts is not None
    np.testing.assert_allclose(parts.bayes, whole.bayes, rtol=0, atol=1e-9)
    assert parts.drops.null.keys() == whole.drops.null.keys()
    for rank, drop in whole.drops.null.items():
        np.testing.assert_allclose(parts.drops.null[rank], drop, rtol=1e-5)


def test_candidates_of_a_model_are_found_once(tracker, monkeypatch):
    """The list that is checked before the first fit is that of the first screening."""
    module, models = importlib.import_module("vcal.loop.search.forward_selection"), []

    def counted(model, *rest):
        models.append(model)
        return candidates(model, *rest)

    monkeypatch.setattr(module, "candidates", counted)
    run = Search(None, [CATALOGUE["backlash"]], 0.01, 50, 0, tracker.room, lambda text: None)
    state = fitted(tracker.model, noisy(tracker, 3), None, tracker.room)
    checked = run.candidates(tracker.model, tracker.measurement)
    with monkeypatch.context() as patch:
        patch.setattr(run, "_describing", False)
        _, screening = run._screened(state)
    # One call for the effects, one for the descriptions, of which there are none.
    assert len(models) == 2 and {kind.kind for kind in screening.kinds} == {"backlash"}
    assert screening.kinds[0].instances == len(checked[0])
    other = tracker.model.with_effects(checked[0][0])
    assert len(run.candidates(other, tracker.measurement)[0]) == len(checked[0]) - 1
    assert len(models) == 3 and models[-1] is other


def test_candidates_are_tested_together_as_alone(tracker):
    """Twice, the second time with what was kept of the first, and with room for a part of it."""
    true = tracker.effect("screw_cyclic:X:sine_um=8,cosine_um=4,pitch_mm=10")
    fit = identify(tracker.model, noisy(tracker, 9, true), room=tracker.room)
    some = [c for c in CATALOGUE.values() if c.name in ("backlash", "cross_axis", "drift")]
    tried, _ = candidates(fit.model, fit.measurement, [type(true), *some])
    assert len({len(effect.amplitudes) for effect in tried}) > 1
    responses = Responses(fit.measurement.plan, 4_000_000)
    once, again = (ScoreTest(fit, 20, 0, responses).tests(tried) for _ in range(2))
    for effect, first, second in zip(tried, once, again, strict=True):
        alone = ScoreTest(fit, 20, 0).tests([effect])[0]
        assert alone is not None and first is not None and second is not None
        np.testing.assert_allclose(first.drops.stat, alone.drops.stat, rtol=1e-9)
        np.testing.assert_allclose(first.bayes, alone.bayes, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(second.drops.stat, first.drops.stat)
        assert first.drops.null.keys() == alone.drops.null.keys()
        for rank, drop in alone.drops.null.items():  # these in single precision
            np.testing.assert_allclose(first.drops.null[rank], drop, rtol=1e-4, atol=1e-6)
    assert 0 < len(responses._kept) < len(tried)  # not all of them had room


def test_a_handful_of_numbers_depends_on_nothing(tracker):
    """Numbers that are a product of two covariates by chance: dozens of them are looked at."""
    fit = identify(tracker.model, noisy(tracker, 1), room=tracker.room)
    x, y = (np.asarray(tracker.plan.x(axis)) for axis in "XY")
    product = ((x - x.mean()) / x.std() * (y - y.mean()) / y.std())[:, None]
    tilted = dataclasses.replace(fit, residual=fit.residual + 20e-6 * product)
    tilted = dataclasses.replace(
        tilted, whitened=np.einsum("nij,nj->ni", fit.whitener, tilted.residual).reshape(-1)
    )
    assert dependence(tilted, 50, 0).p_value < 0.05
    few = dataclasses.replace(tilted)
    few.__dict__["dof"] = 9.0  # as if so much less were left
    assert dependence(few, 50, 0) == ([], [], False, 1.0)
    assert from_structure(few, 1.4, 0.01, 50, 0) is None


def test_no_covariate_that_varies_is_no_dependence(tracker, monkeypatch):
    fit = identify(tracker.model, noisy(tracker, 1), room=tracker.room)
    monkeypatch.setattr("vcal.loop.residuals.dependence.distinct_covariates", lambda plan: {})
    found = dependence(fit, 20, 0)
    assert found == ([], [], False, 1.0)


@pytest.mark.campaign
def test_a_large_size_counts_against_a_rival_up_to_a_point(tracker):
    """1 mm of a backlash that is expected to be 20 um: unlikely as such, but not excluded."""
    measurement = noisy(tracker, 4, tracker.effect("backlash:Y:size_um=1000"))
    base = identify(tracker.model, measurement, room=tracker.room)
    effect = bare(tracker, "backlash:Y:size_um=1")
    state = ScoreTest(base, 20, 0)
    (peak,) = state.tests([effect])[0].peaks(1)
    (rival,) = refit_all(base, [peak], {"backlash": 2}, base.used, tracker.room)
    place = len(rival.fit.model.effects) - 1
    size = rival.fit.values_of(place)[0][2] / effect.amplitudes[0].sigma
    assert abs(size * effect.amplitudes[0].sigma - 1000) < 2  # not pulled towards what is expected
    # The readings determine the size: the density of a factor s at it is that of a normal number.
    scales = 2.0 ** np.arange(-10, 17)
    prior = np.where(scales > 1.0, 0.1 / scales, 1.0)
    odds = np.exp(-0.5 * (size / scales) ** 2) / scales * prior
    size_surplus = odds @ -np.log(prior) / odds.sum()
    assert size_surplus > np.log(20.0)
    assert rival.size_surplus == pytest.approx(size_surplus, rel=0.01)
    assert rival.size_allowance == pytest.approx(rival.size_surplus - np.log(20.0))
    expected = rival.log_bayes + np.log(0.5) + rival.size_allowance
    assert rival.log_weight == pytest.approx(expected)
    small = identify(tracker.model, noisy(tracker, 4, tracker.effect("backlash:Y:size_um=12")))
    (peak,) = ScoreTest(small, 20, 0).tests([effect])[0].peaks(1)
    (rival,) = refit_all(small, [peak], {"backlash": 2}, small.used, tracker.room)
    assert rival.size_allowance == 0.0


def test_names_are_ranked_by_all_their_places_however_unlikely():
    def rival(key: str, log_weight: float, effect=None):
        return SimpleNamespace(effect=effect or SimpleNamespace(key=key), log_weight=log_weight)

    one, twin, other, hopeless = (
        rival("a X", 9.5), rival("a Z", 9.5), rival("b", 10.0), rival("c", -2000.0)
    )  # fmt: skip
    component, shape = rival("a X", 8.0), rival("a X", 7.5, one.effect)
    classes = [[other], [one, twin], [component], [shape], [hopeless]]
    ranked = Names.of(classes).ranked()  # type: ignore[arg-type]
    assert [r for r, _ in ranked] == [one, twin, component, shape, other, hopeless]
    of_the_name = 9.5 + np.log(2.0 + np.exp(-1.5) + np.exp(-2.0))
    assert ranked[0][1] == ranked[1][1] == pytest.approx(of_the_name)
    assert ranked[2][1] == pytest.approx(of_the_name - 1.5)  # another component,
    assert ranked[3][1] == pytest.approx(of_the_name - 2.0)  # another shape, less likely themselves
    assert ranked[4][1] == pytest.approx(10.0)
    assert ranked[5][1] < -600.0


def test_the_shapes_of_an_effect_add_up_and_its_variants_do_not(tracker):
    """One class: three pitches of a screw, and two variants of a tilt, of which one has its
    reference value free.
    """
    screw = bare(tracker, "screw_cyclic:X:sine_um=1,pitch_mm=10")
    tilt = bare(tracker, "thermal_tilt:Y:k_EAY_urad_per_K=1")
    alike = [
        (screw, 10.0),
        (screw, 10.0),
        (screw, 9.0),
        (with_free_reference(tilt), 8.0),
        (tilt, 9.0),
    ]
    members = [SimpleNamespace(effect=effect, log_weight=weight) for effect, weight in alike]
    names = Names.of([members])  # type: ignore[arg-type]
    together = 2 * np.exp(10.0) + 2 * np.exp(9.0)
    assert names.log_odds(screw.key) == pytest.approx(np.log(together))
    assert [odds for _, odds in names.ranked()][:2] == pytest.approx([np.log(together)] * 2)


@pytest.mark.parametrize("order", [1, -1])
def test_what_is_the_same_as_a_namesake_is_not_the_same(order):
    """Tilts about A and B have one key: drift that is as good as that about B has its own odds."""

    def rival(key: str, log_weight: float):
        name, _, placement = key.partition(" ")
        fit = SimpleNamespace(
            chi2=100.0, dof=100.0, model=SimpleNamespace(effects=[0]), shapes={0: {}}
        )
        effect = SimpleNamespace(key=key, name=name, placement=placement)
        return SimpleNamespace(
            effect=effect, fit=fit, log_weight=log_weight, log_weight_at_its_size=log_weight
        )

    about_a, about_b, drift = rival("tilt Y", 10.0), rival("tilt Y", 9.5), rival("drift Y", 9.5)
    same = [about_b, drift][::order]
    told = weigh([[about_a], same], about_a)  # type: ignore[arg-type]
    odds = np.exp([0.0, -0.5, -0.5])
    assert told.probability == pytest.approx(odds[0] / odds.sum())
    assert told.equivalent == []
    ((*name, p),) = told.alternatives
    assert name == ["drift", "Y"] and p == pytest.approx((odds[1] + odds[2]) / odds.sum())
    alone = weigh([[about_a], [about_b], [drift]], about_a)  # type: ignore[arg-type]
    assert alone.probability == pytest.approx((odds[0] + odds[1]) / odds.sum())
    assert weigh([[about_a], same], same[0]).equivalent == [same[1].effect.key]  # type: ignore[arg-type]


@pytest.mark.parametrize("apart", [False, True])
def test_other_shapes_share_the_probability_of_the_name(apart):
    """Two pitches that fit alike, told apart by the data or not, have half of it each."""
    effect = SimpleNamespace(key="screw X", name="screw", placement="X")

    def rival(pitch: float, log_weight: float, effect=effect):
        model = SimpleNamespace(effects=[effect])
        fit = SimpleNamespace(chi2=9.0, dof=9.0, model=model, shapes={0: {"pitch": pitch}})
        return SimpleNamespace(
            effect=effect, fit=fit, log_weight=log_weight, log_weight_at_its_size=log_weight
        )

    best, other = rival(0.02, 9.0), rival(0.01, 9.0)
    drift = rival(0.0, 7.0, SimpleNamespace(key="drift", name="drift", placement=""))
    classes = [[best], [other], [drift]] if apart else [[best, other], [drift]]
    told = weigh(classes, best)  # type: ignore[arg-type]
    ((shape, share),) = told.other_shapes
    assert shape == {"pitch": 0.01}
    assert share == pytest.approx(0.5 * told.probability)


def test_of_names_that_may_be_one_of_an_expected_size_goes_first():
    """The size of another needed an allowance; what excludes all others goes first whatever."""
    odds = {}

    def rival(log_odds: float, size_allowance: float, key: str = ""):
        made = SimpleNamespace(
            size_allowance=size_allowance, effect=SimpleNamespace(key=key or f"{log_odds}")
        )
        odds[id(made)] = log_odds
        return made

    large, expected, excluded = rival(12.0, 9.0), rival(11.5, 0.0), rival(8.0, 0.0)
    ranked = [large, expected, excluded]
    assert preferred(ranked, odds) == [expected, large, excluded]  # type: ignore[arg-type]
    certain = rival(20.0, 15.0)
    assert preferred([certain, *ranked], odds) == [certain, *ranked]  # type: ignore[arg-type]
    assert preferred([], odds) == []
    # Of one name, what says most with a size as expected, and not what says nothing.
    huge, usual, poor = rival(12.0, 300.0, "a"), rival(6.0, 2.0, "a"), rival(-290.0, 0.0, "a")
    told = preferred([large, huge, usual, poor], odds)  # type: ignore[arg-type]
    assert told == [usual, large, huge, poor]


def test_a_size_that_is_forgiven_needs_more_evidence():
    """Of 20 kinds, ln 20 = 3.0; what places and the allowance add to the odds is no evidence."""
    expected = SimpleNamespace(size_allowance=0.0, log_prior=-2.0)
    large = SimpleNamespace(size_allowance=4.0, log_prior=0.0)

    def why(rival, evidence: float) -> str | None:
        return unlikely(rival, evidence + rival.size_allowance + rival.log_prior, 20)

    assert why(expected, 0.1) is None and why(large, 3.1) is None
    assert all("no more probable" in why(it, -0.1) for it in (expected, large))
    assert "larger than expected" in why(large, 2.9)


# --- what judges it -------------------------------------------------------------------------------


def test_a_shape_that_one_fold_sees_stays_in_its_scan(tracker):
    """Without that fold nothing tells the moment: it may be any, but none outside of the scan."""
    place, t = len(tracker.model.effects), np.asarray(tracker.plan.covariate("t"))
    at = float(t[len(t) // 5 - 4])
    true = dataclasses.replace(Bump(), given=(("a", 60.0, 0.0), ("at", at, 0.0)))
    measurement = noisy(tracker, 8, true)
    before = identify(tracker.model, measurement, room=tracker.room)
    start = {"theta": np.pad(before.theta, (0, 1)), "shapes": {place: {"at": at}}}
    after = identify(tracker.model.with_effects(Bump()), measurement, room=tracker.room, **start)
    assert after.converged and after.determined and after.chi2 < before.chi2
    # The moment is linearised: not exact, but of the size of the effect.
    assert heldout_rms(after).value < 2.0 * heldout_rms(before).value
    fall, error = improvement(before, after)  # blocks of both fits are the same
    assert np.isfinite([fall, error]).all()


def test_a_pitch_counts_where_it_lies_in_a_falling_scan(tracker):
    effect = bare(tracker, "screw_cyclic:X:sine_um=1,cosine_um=1,pitch_mm=10")
    pitches = effect.scan(tracker.plan)["pitch"]
    assert pitches[0] > pitches[-1]
    place, true = (
        len(tracker.model.effects),
        dataclasses.replace(
            effect, given=(("sine", 8.0, 0.0), ("cosine", 4.0, 0.0), ("pitch", 10.0, 0.0))
        ),
    )
    fit = identify(
        tracker.model.with_effects(effect),
        noisy(tracker, 2, true),
        shapes={place: {"pitch": 0.01}},
        room=tracker.room,
    )
    # In the middle of its scan, and well known: nothing of it lies outside.
    expected = 0.5 * np.log(2.0 * np.pi) - np.log(len(pitches))
    assert fit.log_scan(place, fit.hessian()) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("told", [1.0, 1e-2, 1e-3, 1e-5, 0.0])
def test_a_shape_counts_by_the_share_of_its_scan_that_explains_the_readings(tracker, told):
    """However little they tell of it: against the integral over its prior, and without it where it
    is known.
    """
    effect = bare(tracker, "screw_cyclic:X:sine_um=1,cosine_um=1,pitch_mm=10")
    true = (("sine", 8.0, 0.0), ("cosine", 4.0, 0.0), ("pitch", 10.0, 0.0))
    place, plan = len(tracker.model.effects), tracker.plan
    fit = identify(
        tracker.model.with_effects(effect),
        noisy(tracker, 2, dataclasses.replace(effect, given=true)),
        shapes={place: {"pitch": 0.01}},
        room=tracker.room,
    )
    jacobian = np.array(fit.jacobian)
    jacobian[:, -1] *= told
    less = dataclasses.replace(fit, jacobian=jacobian)
    known = dataclasses.replace(
        fit,
        model=tracker.model.with_effects(dataclasses.replace(effect, given=(true[-1],))),
        jacobian=jacobian[:, :-1],
        theta=fit.theta[:-1],
        precision=fit.precision[:-1],
    )
    column, others = jacobian[:, -1], jacobian[:, :-1]
    h = others.T @ others + np.diag(fit.precision[:-1])
    own = column @ column - column @ others @ np.linalg.solve(h, others.T @ column)
    pitches = effect.scan(plan)["pitch"]
    steps = len(pitches)
    at = np.interp(fit.shapes[place]["pitch"], pitches[::-1], np.arange(steps)[::-1])
    x = np.linspace(-0.5, steps - 0.5, 2_000_001) - at
    share = np.trapezoid(np.exp(-0.5 * own * x**2), x) / steps
    assert less.log_evidence() - known.log_evidence() == pytest.approx(np.log(share), abs=1e-4)
    assert less.determined
    u = np.sqrt(less.planned_covariance[-1, -1])
    assert u == pytest.approx(1.0 / np.sqrt(own + 12.0 / steps**2), rel=1e-6)


# --- what is kept ---------------------------------------------------------------------------------


def test_an_interruption_leaves_what_is_in_the_model(tracker, monkeypatch):
    x, y = (bare(tracker, f"backlash:{axis}:size_um=1") for axis in "XY")
    measurement = noisy(tracker, 3, tracker.effect("backlash:Y:size_um=12"))
    state = fitted(tracker.model.with_effects(x, y), measurement, None, tracker.room)
    best = SimpleNamespace(best=SimpleNamespace(log_shape=0.0))
    run = searching(tracker)
    run.history = [Added(e, best, 0.001, 0.1, 1.0) for e in (x, y)]  # type: ignore[arg-type]

    def interrupted(*args):
        raise KeyboardInterrupt

    reached = []
    with monkeypatch.context() as patch:
        patch.setattr(vcal.loop.search.search, "fitted", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run.prune(state, reached.append)
    assert run.rejected == [] and reached == []
    after = run.prune(state, reached.append)
    assert reached == [after] and [item.effect.key for item in run.added(after)] == ["backlash Y"]
    assert [(r.effect, r.placement) for r in run.rejected] == [("backlash", "X")]


def test_an_attempt_that_came_to_nothing_leaves_no_trace():
    run = Search(None, (), 0.01, 20, 0, 0, lambda text: None)
    run.rejected = [Rejected("backlash", "X", 0.001, "does not hold")]
    before = {name: v[:] if isinstance(v, list) else v for name, v in vars(run).items()}
    kept = run._kept()
    for name in ("history", "rejected", "screenings", "_outdone"):
        getattr(run, name).append("on the way")
    run.refused = run.unexplained = run._description = "so"  # type: ignore[assignment]
    run._description_trials = 7.0
    run._restore(kept)
    assert vars(run) == before


def test_what_a_later_round_adds_is_not_rejected_too(tracker):
    later, never = (Rejected("backlash", axis, 0.001, "does not hold") for axis in "XY")
    found = [SimpleNamespace(effect=bare(tracker, "backlash:X:size_um=1"))]
    assert still_rejected([later, never], found) == [never]  # type: ignore[arg-type]


def test_a_wider_prior_replaces_a_declared_one(tracker):
    true = tracker.effect("backlash:Y:size_um=120")
    narrow = dataclasses.replace(true, given=(), priors=(Prior("size", Normal(0.0, 10.0)),))
    model = tracker.model.with_effects(narrow)
    measurement = noisy(tracker, 4, true)
    start = identify(model, measurement)
    assert abs(start.theta[start.places_of(len(tracker.model.effects))[0]]) > 1.0
    grown = searching(tracker)._fitted(model, measurement, start)
    ((_, _, size, u),) = grown.fit.values_of(len(tracker.model.effects))
    assert size == pytest.approx(120.0, abs=4.0 * u)


# --- what is told ---------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_declared_pitch_that_is_not_told_is_looked_for(tracker):
    """The solver alone ends in the valley in which it starts, of which a pitch has many."""
    pitch, size = 13.0, 8.0
    true = tracker.effect(f"screw_cyclic:X:pitch_mm={pitch},sine_um={size}")
    measurement = noisy(tracker, 5, true)
    law = (Prior("pitch", Normal(12.9, 0.2)),)
    for declared in (bare(tracker, "screw_cyclic:X"), bare(tracker, "screw_cyclic:Z")):
        model = tracker.model.with_effects(bare(tracker, "screw_cyclic:X"), declared)
        fit = fitted(model, measurement, None, tracker.room).fit
        place = len(tracker.model.effects)
        values = {p.name: (value, u) for _, p, value, u in fit.values_of(place)}
        assert fit.converged
        if declared.placement == "Z":
            assert abs(values["pitch"][0] - pitch) < 3.0 * values["pitch"][1]
            assert abs(values["sine"][0] - size) < 3.0 * values["sine"][1]
    model = tracker.model.with_effects(
        dataclasses.replace(bare(tracker, "screw_cyclic:X"), priors=law)
    )
    fit = fitted(model, measurement, None, tracker.room).fit
    assert fit.shapes[len(tracker.model.effects)]["pitch"] == pytest.approx(pitch * 1e-3, rel=1e-2)


def test_two_effects_of_one_key_have_values_of_their_own(tracker):
    """Warming up of X along itself and across: one key, and a time constant each."""
    along, across = (bare(tracker, f"warm_up:X:component={c},tau_h=0.1") for c in ("EXX", "EYX"))
    assert along.key == across.key
    places = len(tracker.model.effects), len(tracker.model.effects) + 1
    shapes = {places[0]: {"tau": 100.0}, places[1]: {"tau": 300.0}}
    model = tracker.model.with_effects(along, across)
    fit = identify(model, noisy(tracker, 5), shapes=shapes, room=tracker.room)
    for place, effect in zip(places, (along, across), strict=True):
        values = fit.values_of(place)
        assert [p.name for _, p, _, _ in values] == [p.name for p in effect.parameters]
        assert values[1][2] * 3600.0 == pytest.approx(fit.shapes[place]["tau"])


@pytest.mark.thorough
def test_what_the_readings_do_not_determine_is_told_by_name(tracker):
    """The pose of a station, from points on one line."""
    position = np.array(tracker.plan.position)
    position[:, 1:] = position[0, 1:]
    plan = tracker.plan.with_position(position)
    theta = np.zeros(len(tracker.model.entries))
    readings = np.asarray(predict(tracker.model, plan, theta))
    with pytest.raises(np.linalg.LinAlgError, match=r"station \w and station"):
        close_loop(tracker.model, Measurement(plan, readings), draws=50)
    # With errors the points are off the line, by as little as the errors: a turn about it runs
    # away, and what stops it is not the readings.
    informed = [e.parameter.informed for e in tracker.model.entries]
    theta = np.where(informed, np.random.default_rng(1).standard_normal(len(theta)), 0.0)
    readings = np.asarray(predict(tracker.model, plan, theta))
    with pytest.raises(np.linalg.LinAlgError, match=r"station \w and station"):
        close_loop(tracker.model, Measurement(plan, readings), draws=50)


def test_an_effect_of_which_the_readings_say_nothing_is_not_named(tracker):
    along = tracker.effect("backlash:Y")
    fit = identify(tracker.model.with_effects(along), noisy(tracker, 5), room=tracker.room)
    found = FoundEffect(along, "named", "Y", [], 1e-6, 20.0, 30.0, 0.1, [], [], "")
    assert doubted(found, fit, None, []) is found
    blind = dataclasses.replace(fit, jacobian=fit.jacobian.copy())
    blind.jacobian[:, fit.places_of(len(fit.model.effects) - 1)[0]] *= 1e-6
    less = doubted(found, blind, None, [])
    assert less.status == "ambiguous" and "poorly determine its size" in less.separation
    # Three names that are four times as probable together as that nothing is missing.
    assert chance(np.log(12.0), 3.0) == pytest.approx(0.2) and chance(800.0, 56.0) == 0.0
    lucky = doubted(dataclasses.replace(found, chance=0.2, probability=0.99), fit, None, [])
    assert lucky.status == "ambiguous" and "probability of 20 % it is chance" in lucky.separation
    sure = dataclasses.replace(found, chance=0.02, probability=0.98)
    assert doubted(sure, fit, None, []) is sure
    assert not lucky.perhaps_chance and not hinted(lucky, fit, None).hint
    chancy = hinted(dataclasses.replace(lucky, chance=0.6), fit, None)
    assert chancy.perhaps_chance
    assert chancy.hint == "with a probability of 60 % nothing more is missing"


def test_the_prior_odds_of_all_kinds(tracker):
    """Empirical descriptions have none beside effects."""
    fit = identify(tracker.model, noisy(tracker, 5), room=tracker.room)
    kinds = [CATALOGUE[name] for name in ("backlash", "warm_up")]
    tried, _ = candidates(tracker.model, fit.measurement, kinds)
    bumps, _ = candidates(tracker.model, fit.measurement, EMPIRICAL[:1], tried, fit)
    screening = screen(ScoreTest(fit, 20, 1), [*tried, *bumps[:2]])
    assert {kind.kind for kind in screening.kinds} == {"backlash", "warm_up", bumps[0].name}
    assert odds_of_kinds(screening) == 1.0 + CATALOGUE["warm_up"].odds == 1.2


@pytest.mark.thorough
def test_no_more_effects_are_added_than_may_be(tracker):
    """What is left is then not said to have no name."""
    two = [tracker.effect(f"backlash:{axis}:size_um=30") for axis in "XY"]
    closure = close_loop(tracker.model, noisy(tracker, 6, *two), draws=100, max_effects=1)
    assert len(closure.effects) == 1 and closure.verdict == "unexplained"
    assert "max_effects" in closure.sentence
    left = {"backlash X", "backlash Y"} - {closure.effects[0].effect.key}
    assert closure.unexplained.reason == (
        f"{left.pop()} is significant, but no more effects may be added (max_effects)"
    )


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.thorough
def test_what_check_points_ask_beyond_what_was_measured(tracker, told):
    """A drift that was measured for some minutes, and two hours of check points."""
    check, t = tracker.study.check, np.asarray(tracker.plan.covariate("t"))
    asked = np.asarray(check.plan.covariate("t"))
    within = {**check.plan.covariates, "t": np.interp(asked, [0.0, asked.max()], [t[0], t[-1]])}
    if not told:
        check = dataclasses.replace(check, plan=dataclasses.replace(check.plan, covariates=within))
    measurement = noisy(tracker, 7, tracker.effect("drift:Y:rate_EYY_um_per_h=300"))
    closure = close_loop(
        tracker.model, measurement, check=check, effects=[CATALOGUE["drift"]], draws=100
    )
    (name,) = (e.effect.key for e in closure.effects)
    beyond = [note for note in closure.notes if "beyond the measured range" in note]
    assert len(beyond) == told
    assert not told or (name in beyond[0] and f"t_s {t.min():.4g} to {t.max():.4g}" in beyond[0])


def test_the_error_at_check_points_lacks_what_they_do_not_record(tracker):
    check = tracker.study.check
    plan = check.plan
    fewer = {k: v for k, v in plan.covariates.items() if k != "dir_Y"}
    bare_check = dataclasses.replace(check, plan=dataclasses.replace(plan, covariates=fewer))
    measurement = noisy(tracker, 7, tracker.effect("backlash:Y:size_um=30"))
    for points, told in ((check, False), (bare_check, True)):
        closure = close_loop(
            tracker.model, measurement, check=points, effects=[CATALOGUE["backlash"]], draws=100
        )
        assert [e.effect.key for e in closure.effects] == ["backlash Y"]
        assert any("dir_y" in note and "check" in note for note in closure.notes) == told


@pytest.mark.thorough
def test_a_run_of_circles_alone_can_name(tmp_path):
    """One run is held out in parts: there is no other to foretell it."""
    from test_r_test import circles, write
    from vcal import load_study

    table = circles(samples=120, levels=(0.5,), spike=(2.0, 0.1), seed=1)
    one = {name: np.asarray(column)[np.asarray(table["run"]) == table["run"][0]]
           for name, column in table.items()}  # fmt: skip
    study = load_study(write(tmp_path / "one", one) / "setup.toml")
    folds, _ = study.instrument.folds(study.plan)
    assert set(folds) == set(range(5)) and (np.diff(folds) >= 0).all()
    closure = close_loop(study.model, study.measurement, draws=100)
    assert any(e.effect.name == "reversal_spike" for e in closure.effects)


@pytest.mark.parametrize(("left", "kept"), [(300.0, True), (100.0, False)])
def test_a_search_anew_does_not_end_with_less(monkeypatch, left, kept):
    """Where a description ends the search anew that leaves more than what was there, that stays."""
    module = importlib.import_module("vcal.loop.search.search")
    monkeypatch.setattr(module, "without", lambda *args: SimpleNamespace(
        converged=True, model=None, measurement=None))  # fmt: skip
    bare = SimpleNamespace(fit="bare")
    monkeypatch.setattr(module, "fitted", lambda *args: bare)
    monkeypatch.setattr(module, "_place", lambda *args: 0)
    chi2 = {"bare": 900.0, "good": 200.0, "described": left}
    monkeypatch.setattr(module, "declared_chi2", chi2.get)
    search = Search(None, (), 0.01, 20, 0, 0, lambda text: None)
    search.rejected = ["before"]

    def step(state):
        search.rejected.append("on the way")
        search.screenings.append(SimpleNamespace(p_value=0.001))
        search._description = SimpleNamespace(fit="described")
        search.unexplained = "something"

    monkeypatch.setattr(search, "step", step)
    effect = SimpleNamespace(key="backlash X", name="backlash", placement="X")
    item = SimpleNamespace(effect=effect, p_value=0.001)
    state = SimpleNamespace(fit="good")
    found = search.search_again(state, item)
    assert (found is state, search.unexplained is None) == (kept, kept)
    assert (search.rejected == ["before"]) == kept


@pytest.mark.parametrize(("left", "taken"), [(150.0, True), (199.5, False), (250.0, False)])
def test_a_search_anew_takes_the_same_effect_at_a_better_moment(monkeypatch, left, taken):
    """It may have begun at a wrong one, beside what was not yet known; of the readings, those count
    that both fits use.
    """
    module = importlib.import_module("vcal.loop.search.search")
    monkeypatch.setattr(module, "without", lambda *args: SimpleNamespace(
        converged=True, model=None, measurement=None))  # fmt: skip
    monkeypatch.setattr(module, "fitted", lambda *args: None)
    monkeypatch.setattr(module, "_place", lambda *args: 0)
    used = np.array([True, True, False]), np.array([False, True, True])
    fits = [SimpleNamespace(chi2=c, used=u) for c, u in zip((200.0, left), used, strict=True)]
    asked = []

    def declared_chi2(fit, rows):
        asked.append(list(rows))
        return fit.chi2

    monkeypatch.setattr(module, "declared_chi2", declared_chi2)
    state, better = (SimpleNamespace(fit=fit) for fit in fits)
    search = Search(None, (), 0.01, 20, 0, 0, lambda text: None)

    def item(moment):
        effect = named("jump")
        return Added(effect, f"weighed {moment}", 0.001, float(moment), 1.0)  # type: ignore

    old, other = item(1), item(3)
    search.history, search.rejected = [old, other], ["before"]

    def step(state):
        search.rejected.append("on the way")
        search.screenings.append(SimpleNamespace(p_value=0.001))
        search.history.append(item(2))
        return better

    monkeypatch.setattr(search, "step", step)
    assert search.search_again(state, old) is (better if taken else state)
    first, last = search.history
    assert (first.weighed, first.gain) == ("weighed 2", 2.0 if taken else 1.0)
    assert last is other and search.rejected == ["before"]
    assert asked == 2 * [[False, True, False]]


def named(key: str) -> SimpleNamespace:
    """An effect that is but its name."""
    return SimpleNamespace(key=key, name=key, placement="", alike=lambda other: other.key == key)


def of_names(monkeypatch, state, item) -> Search:
    """A search whose states are but the names in them."""
    module = importlib.import_module("vcal.loop.search.search")

    def without(state, place, room):
        left = (*state.names[:place], *state.names[place + 1 :])
        return SimpleNamespace(converged=True, model=left, measurement=None)

    monkeypatch.setattr(module, "without", without)
    monkeypatch.setattr(module, "fitted", lambda model, *rest: state(*model))
    monkeypatch.setattr(module, "_place", lambda state, item: state.names.index(item.effect.key))
    search = Search(None, (), 0.01, 20, 0, 0, lambda text: None)
    monkeypatch.setattr(search, "added", lambda state: [item(name) for name in state.names])
    return search


@pytest.mark.parametrize("ends", ["explained", "unexplained", "as before"])
def test_one_of_several_gives_way_to_what_leaves_nothing_unexplained(monkeypatch, ends):
    """It stays where something is left without it too, or where it is found again."""

    def state(*names, chi2=2000.0):
        return SimpleNamespace(names=names, fit=SimpleNamespace(chi2=chi2))

    def item(name):
        effect = SimpleNamespace(key=name, name=name, placement="")
        return SimpleNamespace(effect=effect, p_value=1e-9)

    search = of_names(monkeypatch, state, item)
    tried = []

    def step(now):
        tried.append(now.names)
        if len(now.names) < 2:
            new = "jump" if ends == "as before" else "backlash"
            return state(*now.names, new, chi2=900.0 if ends == "as before" else 300.0)
        search.screenings.append(SimpleNamespace(p_value=0.5 if ends == "explained" else 0.001))
        search.unexplained = None if ends == "explained" else "something else"
        return None

    monkeypatch.setattr(search, "step", step)
    search.unexplained, search.rejected, search._bars = "something", ["before"], 0
    search._description = SimpleNamespace()  # type: ignore[assignment]
    search.screenings = [SimpleNamespace(p_value=0.001)]
    found = search.exchanged(state("jump", "sag", chi2=900.0), 6)
    if ends == "explained":
        assert found.names == ("sag", "backlash")
        assert search.unexplained is None
        assert [r if r == "before" else r.effect for r in search.rejected] == ["before", "jump"]
    else:
        assert found is None
        assert (search.unexplained, search.rejected) == ("something", ["before"])
        assert len(search.screenings) == 1
    # What was there before leads nowhere new.
    assert len(tried) == {"explained": 2, "unexplained": 4, "as before": 2}[ends]
    # With no room for another one nothing is tried.
    assert search.exchanged(state("jump", "sag"), 2) is None


@pytest.mark.parametrize("likelier", [True, False])
def test_what_is_barred_lets_others_be_found(monkeypatch, likelier):
    """Beside `trend`, `jump` at a wrong moment is the best, and beside that `trend` is. Where it is
    barred, a play is found, and what is searched anew beside that is a jump at another moment.
    """

    def state(*names):
        fit = SimpleNamespace(chi2=2000.0 - 300.0 * len(names))
        return SimpleNamespace(names=names, fit=fit, scored=names)

    def item(name):
        effect = named(name)
        return SimpleNamespace(
            effect=effect, p_value=1e-9, weighed=SimpleNamespace(equivalent=[name + "'"])
        )

    search = of_names(monkeypatch, state, item)
    barred = []

    def step(now):
        barred.append(search._barred)
        left = {"trend", "jump", "play", "slip"} - {*now.names} - search._barred
        wanted = {"jump": "trend", "trend": "jump"} | {n: "play" for n in ("slip", "play")}
        new = "play" if "trend" in search._barred else wanted[now.names[0]]
        if len(now.names) < 2 and new in left:
            return state(*now.names, new)
        done = {*now.names} == {"play", "slip"}
        search.screenings.append(SimpleNamespace(p_value=0.5 if done else 0.001))
        search.refused = None if done else "something"
        return None

    def anew(now, one):
        names = ["slip" if n == "jump" and "play" in now.names else n for n in now.names]
        return state(*names)

    compared = []

    def compare(one, mine, other, others, description):
        assert tuple(i.effect.key for i in mine) == one
        compared.append((one, tuple(i.effect.key for i in others), description))
        return likelier

    monkeypatch.setattr(search, "step", step)
    monkeypatch.setattr(search, "search_again", anew)
    monkeypatch.setattr(search, "_likelier", compare)
    search.refused, search.rejected = "something", ["before"]
    search.screenings = [SimpleNamespace(p_value=0.001)]
    found = search.exchanged(state("trend", "jump"), 6)
    assert compared[0] == (("slip", "play"), ("trend", "jump"), None)
    assert search._barred == frozenset() and frozenset({"trend", "trend'"}) in barred
    if likelier:
        assert found.names == ("slip", "play") and search.refused is None
        assert [r if r == "before" else r.effect for r in search.rejected] == ["before", "trend"]
    else:
        assert found is None
        assert (search.refused, search.rejected) == ("something", ["before"])
        before = len(barred)  # once only
        assert search.exchanged(state("trend", "jump"), 6) is None
        assert not any(barred[before:])
    # Where nothing is left there is nothing to search for.
    search.refused = search.unexplained = None
    assert search.exchanged(state("trend", "jump"), 6) is None


def test_a_rejected_effect_bars_no_other(tracker, monkeypatch):
    """One of an expected size goes first, although another is seven times as likely. Where the more
    probable one fails on held-out readings, or makes too small a difference, the next is tried.
    """
    module = importlib.import_module("vcal.loop.search.forward_selection")
    run = searching(tracker)
    state = fitted(tracker.model, noisy(tracker, 3), None, tracker.room)
    large, expected = (
        SimpleNamespace(effect=bare(tracker, f"backlash:{a}:size_um=1"), size_allowance=x)
        for a, x in (("X", 9.0), ("Y", 0.0))
    )
    holds, small = {id(large): "", id(expected): ""}, {id(large): "", id(expected): ""}

    def found():
        ranked = [(large, 12.0), (expected, 10.0)]
        return SimpleNamespace(
            hidden_by_each_other=lambda: None, outdone=lambda: False, ranked=ranked,
            odds={id(r): odds for r, odds in ranked}, significant=[r for r, _ in ranked],
            unlikely=lambda r: "", fails=lambda r: holds[id(r)], description=None,
            p_value=lambda r: 1e-9, too_little=lambda r: small[id(r)],
        )  # fmt: skip

    screening = SimpleNamespace(unseen=[], p_value=1e-9)
    monkeypatch.setattr(module, "screen", lambda *rest: screening)
    monkeypatch.setattr(module.Round, "of", lambda *rest: found())
    monkeypatch.setattr(run, "_unfitted", lambda found: None)
    monkeypatch.setattr(run, "_add", lambda found, rival, described: rival)
    assert run.step(state) is expected
    holds[id(expected)] = "does not"
    assert run.step(state) is large
    # The more probable one was tried, and fails.
    holds.update({id(expected): "", id(large): "does not"})
    large.size_allowance, run.rejected = 0.0, []
    assert run.step(state) is expected
    assert [r.reason for r in run.rejected] == ["does not"]
    holds[id(large)], small[id(large)] = "", "by 1 % only"
    run.rejected = []
    assert run.step(state) is expected
    assert [r.reason for r in run.rejected] == ["by 1 % only"]


@pytest.mark.thorough
def test_what_can_be_done_without_makes_room(tracker, monkeypatch):
    """Two effects at most: with one of them gone the search goes on."""
    put_in = [tracker.effect("backlash:X:size_um=9"), tracker.effect("backlash:Y:size_um=12")]
    measurement = noisy(tracker, 3, *put_in)
    prune, dropped = Search.prune, []

    def once(self, state, reached):
        if dropped:
            return prune(self, state, reached)
        dropped.append(self.added(state)[0])
        less = vcal.loop.search.search.without(
            state, vcal.loop.search.search._place(state, dropped[0]), self.room
        )
        return self._drop(dropped[0], less, "for trial")

    monkeypatch.setattr(Search, "prune", once)
    closure = close_loop(tracker.model, measurement, effects=["backlash"], draws=50, max_effects=2)
    assert len(dropped) == 1
    assert sorted(e.effect.key for e in closure.effects) == ["backlash X", "backlash Y"]
    assert closure.verdict == "named"
