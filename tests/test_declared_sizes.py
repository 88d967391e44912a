"""Declared sizes against their posterior, wrong signs and units, hints, compensation in vain."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from known import Known
from vcal import Measurement, close_loop, identify, load_study
from vcal.effects.geometric import GeometricErrors
from vcal.errors import StudyError
from vcal.identification.declared_sizes import declared_sizes
from vcal.identification.family_sizes import declared_kind, learned_sizes, with_sizes
from vcal.identification.model_averaging import Alternatives, model_average
from vcal.instruments import reflectors
from vcal.loop.outcome.closure import Errors
from vcal.loop.outcome.gain import no_gain
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.search import search as searching
from vcal.loop.weighing import rivals
from vcal.loop.weighing.cross_validation import Rms
from vcal.loop.weighing.rivals import refit_all, widened
from vcal.report.formats.compensation_csv import CompensationCsv
from vcal.study import discrete_changes as changes


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("sizes"))


def noisy(it: Known, seed: int, *effects) -> Measurement:
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    return Measurement(it.plan, it.readings(*effects) + noise)


def sized(it: Known, factor: float):
    """The model of a study with the sizes of its family multiplied by a factor."""
    family = next(e for e in it.model.effects if isinstance(e, GeometricErrors))
    names = [*(m.name for m in family.motions), *(e.name for e in family.locations)]
    return with_sizes(it.model, dict.fromkeys(names, factor))


def systematic(model) -> list[int]:
    return [i for i, effect in enumerate(model.effects) if effect.kind == "systematic"]


# --- the test of declared sizes ------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.0 / 3.0, 1.0, 3.0])
def test_sizes_that_are_declared_three_times_too_small_do_not_fit(factor, tracker):
    model = sized(tracker, factor)
    fit = identify(model, noisy(tracker, 1), room=tracker.room)
    found = declared_sizes(fit, systematic(model))
    assert found.directions > 20
    assert found.misfit == (factor < 1.0)
    assert not found.gross
    assert 0.6 / factor < found.ratio < 1.6 / factor
    # Estimated together for all errors of one kind, they return to what they are.
    learned = learned_sizes(fit, declared_kind)
    by_kind = {declared_kind(name): f for name, f in learned.items()}
    assert len(set(learned.values())) == len(by_kind)
    assert 0.6 / factor < by_kind["translation"] < 1.6 / factor


@pytest.mark.thorough
def test_the_statistic_has_the_chi_square_distribution(tracker):
    """Over machines drawn from the priors: mean n and variance 2 n of the linearised problem."""
    fit = identify(tracker.model, noisy(tracker, 2), room=tracker.room)
    rng = np.random.default_rng(0)
    hessian = fit.jacobian.T @ fit.jacobian + np.diag(fit.precision)
    found = []
    for _ in range(300):
        truth = rng.standard_normal(len(fit.theta)) * (fit.precision > 0.0)
        noise = rng.standard_normal(len(fit.jacobian))
        theta = np.linalg.solve(hessian, fit.jacobian.T @ (fit.jacobian @ truth + noise))
        drawn = dataclasses.replace(fit, theta=theta)
        found.append(declared_sizes(drawn, systematic(fit.model)))
    n, statistic = found[0].directions, np.array([one.statistic for one in found])
    assert abs(statistic.mean() / n - 1.0) < 4.0 * math.sqrt(2.0 / n / 300)
    assert 0.7 < statistic.var() / (2.0 * n) < 1.4
    assert 0.3 < np.mean([one.p_value < 0.5 for one in found]) < 0.7


def test_an_error_far_outside_its_size_is_gross(tracker):
    fit = identify(tracker.model, noisy(tracker, 1), room=tracker.room)
    theta = fit.theta.copy()
    k = next(k for k, (_, p) in enumerate(fit.entries) if p.name.startswith("EXX."))
    theta[k] = -30.0
    found = declared_sizes(dataclasses.replace(fit, theta=theta), systematic(fit.model))
    assert found.gross and found.misfit
    (key, p, times, value), *_ = found.largest
    assert (key, times) == ("geometric", -30.0) and p.name == fit.entries[k][1].name
    assert value == pytest.approx(-30.0 * p.sigma)


@pytest.mark.slow
def test_the_loop_reports_sizes_that_do_not_fit_and_names_nothing(tracker):
    found = close_loop(
        sized(tracker, 1.0 / 3.0), noisy(tracker, 1), effects=["backlash", "cross_axis"], draws=100
    )
    assert found.effects == [] and found.verdict == "nothing_missing"
    assert found.sizes is not None and found.sizes.used
    assert 2.0 < found.sizes.factors["translation"] < 4.5
    assert found.sentence.startswith("No effect was found, but the declared sizes do not fit: ")
    assert "the search and the result use the sizes that fit" in found.notes[0]


@pytest.mark.thorough
def test_a_missing_effect_is_no_wrong_declaration(tracker):
    measurement = noisy(tracker, 1, tracker.effect("backlash:Y:size_um=60"))
    found = close_loop(tracker.model, measurement, effects=["backlash", "cross_axis"], draws=100)
    assert [e.effect.key for e in found.found] == ["backlash Y"]
    assert found.sizes is None and found.verdict == "named"


# --- signs, units and order ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return Known("reflectors", tmp_path_factory.mktemp("arm"), noise_factor=1.0).study


def test_every_sign_unit_and_order_is_tried(arm):
    tried = [change.words for change in changes.discrete_changes(arm)]
    joints = len(arm.chain.joints)
    assert sum(words.startswith("the other sign in q") for words in tried) == joints
    assert "q1_cmd_deg and q2_cmd_deg exchanged" in tried
    assert any(words.startswith("rad turned into deg in q1_cmd_deg") for words in tried)
    lengths = [(i, j.a_mm) for i, j in enumerate(arm.settings.machine.joint) if j.a_mm]
    for i, a in lengths:
        assert f"machine.joint.{i}.a_mm = {1e3 * a:.6g} instead of {a:.6g}" in tried
        assert f"machine.joint.{i}.a_mm = {-a:.6g} instead of {a:.6g}" in tried


@pytest.mark.thorough
def test_only_the_change_that_is_wrong_makes_the_readings_follow(arm, monkeypatch):
    """A link declared in metres: of some changes, the one that undoes it, and no other."""
    machine = arm.settings.machine
    place = next(i for i, joint in enumerate(machine.joint) if abs(joint.a_mm) > 100.0)
    key, right = f"machine.joint.{place}.a_mm", machine.joint[place].a_mm
    # The rigid best fit of the nominal arm refuses it first.
    with monkeypatch.context() as patch:
        patch.setattr(reflectors, "check_arm_follows", lambda *args: None)
        study = load_study(arm.path, {key: 1e-3 * right})
    some = [
        change
        for change in changes.discrete_changes(study)
        if change.words.startswith((key, "the other sign in q2", "q1_cmd_deg and q2_cmd_deg"))
    ]
    assert len(some) > 5
    monkeypatch.setattr(changes, "discrete_changes", lambda study: some)
    fit = identify(study.model, study.measurement, room=len(study.model.entries) + 16)
    found = declared_sizes(fit, systematic(fit.model), math.sqrt(max(1.0, fit.chi2 / fit.dof)))
    assert found.gross
    (change,) = changes.following(study, found)
    assert change.words == f"{key} = {right:.6g} instead of {1e-3 * right:.6g}"
    with pytest.raises(StudyError, match="they follow with machine.joint") as error:
        changes.check_declared(study, fit)
    assert "compare it with the machine" in str(error.value)


def test_a_machine_as_declared_is_not_refused(arm):
    fit = identify(arm.model, arm.measurement, room=len(arm.model.entries) + 16)
    changes.check_declared(arm, fit)


# --- candidates without a solution ---------------------------------------------------------------


def test_a_candidate_that_no_reading_shows_is_unseen(tracker):
    """Columns that are rounding noise, or that a thousand prior deviations would not show."""
    state = ScoreTest(identify(tracker.model, noisy(tracker, 1), room=tracker.room), 20, 0)
    effect = tracker.effect("backlash:Y")
    seen, unseen = state.tests([effect, widened(effect, 1e-9)])
    assert seen is not None and unseen is None


def test_numbers_that_are_not_finite_are_not_determined(tracker):
    fit = identify(tracker.model, noisy(tracker, 1), room=tracker.room)
    broken = dataclasses.replace(fit, jacobian=np.full_like(fit.jacobian, np.nan))
    assert fit.converged and fit.determined
    assert not broken.converged and not broken.determined
    with pytest.raises(np.linalg.LinAlgError, match="numbers that are not finite"):
        _ = broken.factor


def test_a_candidate_without_a_solution_is_left_out(tracker, monkeypatch):
    measurement = noisy(tracker, 1, tracker.effect("backlash:Y:size_um=30"))
    base = identify(tracker.model, measurement, room=tracker.room)
    state = ScoreTest(base, 20, 0)
    effects = [tracker.effect("backlash:Y"), tracker.effect("backlash:X")]
    peaks = [tested.peaks(1)[0] for tested in state.tests(effects)]
    refit = rivals.refit

    def singular(base, peak, *more):
        if peak.effect.key == "backlash X":
            raise np.linalg.LinAlgError("singular")
        return refit(base, peak, *more)

    monkeypatch.setattr(rivals, "refit", singular)
    found = refit_all(base, peaks, {"backlash": 2}, base.used, tracker.room)
    assert [rival.effect.key for rival in found] == ["backlash Y"]


def test_a_revision_without_a_solution_leaves_the_state_as_it_was():
    search = searching.Search(None, [], 0.01, 20, 0, 16, lambda text: None)

    def revision():
        search.rejected.append("a trace")
        raise np.linalg.LinAlgError("singular")

    assert search._tried(revision, "as before") == "as before"
    assert search.rejected == []


# --- compensation in vain, and the model average -------------------------------------------------


def errors(check: float | None, heldout: float, u: float = 0.1) -> Errors:
    at = None if check is None else Rms(check, u)
    return Errors(at, at, Rms(heldout, u), Rms(heldout, u), 1.0)


def stages(*values: tuple[float | None, float]) -> dict:
    names = ("uncompensated", "before", "after")
    return dict(zip(names, (errors(*pair) for pair in values), strict=True))


@pytest.mark.parametrize(
    ("stage", "fall", "said"),
    [
        (stages((4.08, 5.0), (4.9, 4.0), (4.84, 4.0)), Rms(0.3, 0.01), "larger than 4.08"),
        (stages((9.0, 5.0), (2.0, 4.0), (3.0, 4.0)), Rms(0.3, 0.01), "larger than 2 ± 0.1 µm with"),
        (stages((9.0, 5.0), (3.0, 4.0), (2.0, 4.0)), Rms(0.3, 0.01), ""),
        (stages((9.0, 5.0), (3.0, 4.0), (2.0, 4.0)), Rms(0.0, 0.01), ""),
        (stages((9.0, 5.0), (3.0, 6.0), (2.0, 6.0)), Rms(-0.4, 0.01), "held-out readings"),
        (stages((None, 5.0), (None, 4.99), (None, 4.99)), Rms(0.004, 0.01), "not significantly"),
        (stages((None, 5.0), (None, 4.0), (None, 4.0)), Rms(0.3, 0.01), ""),
        (stages((None, 5.0), (None, 3.0), (None, 4.0)), Rms(0.3, 0.01), "declared model alone"),
        (stages((None, 5.0), (None, 3.0), (None, 4.0)), None, ""),
    ],
)
def test_compensation_that_does_not_reduce_the_error_is_said(stage, fall, said):
    sentence = no_gain(stage, fall)
    assert bool(sentence) == bool(said)
    assert said in sentence


def test_the_table_is_then_written_only_if_asked_for():
    def text(no_gain: str, anyway: bool) -> str | None:
        results = SimpleNamespace(
            closure=SimpleNamespace(no_gain=no_gain), motions=[], anyway=anyway
        )
        return CompensationCsv().text(results)  # type: ignore[arg-type]

    assert text("", False) and text("It does not.", True)
    assert text("It does not.", False) is None


def test_a_prediction_is_the_average_of_the_models_where_that_is_asked_for():
    values = {"named": 1.0, "other": 3.0, "third": 0.0}
    others = ((0.3, "other"), (0.2, "third"))
    expected = 0.5 * 1.0 + 0.3 * 3.0 + 0.2 * 0.0
    variance = 0.5 * (1.0 - expected) ** 2 + 0.3 * (3.0 - expected) ** 2 + 0.2 * expected**2
    for averaged in (False, True):
        one = Alternatives("named", others, averaged)  # type: ignore[arg-type]
        moved, spread = model_average([one], lambda name: np.array([values[name]]), np.zeros(1))  # type: ignore[index]
        about = 0.0 if averaged else (expected - 1.0) ** 2
        assert moved[0] == pytest.approx(expected - 1.0 if averaged else 0.0)
        assert spread[0] == pytest.approx(variance + about)
