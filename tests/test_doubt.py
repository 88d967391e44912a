"""What a name that is not certain adds to the uncertainty of what is foretold."""

import dataclasses
import math

import numpy as np
import pytest

from known import Known
from oracle import make_case, write_study
from vcal import CheckPoints, Effect, Measurement, Model, close_loop, identify, load_study
from vcal.geometry.error_field import error_field
from vcal.geometry.error_motions import error_motion_tables
from vcal.identification.fit import Fit
from vcal.identification.model_averaging import Alternatives
from vcal.loop.empirical import Factor, Interaction
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.weighing.cross_validation import check_rms
from vcal.loop.weighing.rivals import Rival, refit_all
from vcal.loop.weighing.weighing import CERTAIN, classes_of, weigh


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    case = make_case("laser_tracker", seed=31)
    return load_study(write_study(tmp_path_factory.mktemp("doubt") / "study", case))


@pytest.fixture(scope="module")
def fit(study):
    return identify(study.model, study.measurement, room=len(study.model.entries) + 16)


def moved(fit, seed: int):
    """The fit with other amplitudes: another explanation of the same readings."""
    by = np.random.default_rng(seed).standard_normal(len(fit.theta))
    return dataclasses.replace(fit, theta=fit.theta + by)


def alternatives(fit):
    """Two effects that may be others: the second may be two."""
    named, a, b, c = (moved(fit, seed) for seed in range(4))
    return [Alternatives(named, ((0.3, a),)), Alternatives(a, ((0.1, b), (0.2, c)))]


def test_the_error_at_check_points_is_that_of_the_other_name_so_often(study, fit):
    """u^2 has the sum of p (rms by the other name - rms)^2 more; the rms stays."""
    other = moved(fit, 1)
    alone = check_rms(fit, study.check)
    doubted = check_rms(fit, study.check, [Alternatives(fit, ((0.3, other),))])
    for one, more, its in zip(alone, doubted, check_rms(other, study.check), strict=True):
        assert more.value == one.value
        assert more.u**2 - one.u**2 == pytest.approx(0.3 * (its.value - one.value) ** 2, rel=1e-6)
        assert more.u > 1.1 * one.u
    # What a later round found is there by either name.
    later = moved(fit, 2)
    after = dataclasses.replace(fit, theta=fit.theta + later.theta - fit.theta)
    base = dataclasses.replace(fit, theta=other.theta + later.theta - fit.theta)
    (expected, _), (value, _) = check_rms(base, study.check), check_rms(after, study.check)
    (found, _) = check_rms(after, study.check, [Alternatives(fit, ((0.3, other),))])
    more = 0.3 * (expected.value - value.value) ** 2
    assert found.u**2 - value.u**2 == pytest.approx(more, rel=0.02)


def test_error_motions_are_those_of_the_other_name_so_often(fit):
    """u^2 of every node has the sum of p (difference)^2 of every doubt more."""
    plain = error_motion_tables(fit)
    coarse = {t.name: len(t.value) for t in error_motion_tables(fit, nodes=5)}
    assert set(coarse) == {t.name for t in plain} and set(coarse.values()) <= {1, 5}
    found = error_motion_tables(fit, alternatives=alternatives(fit))
    by = [{t.name: t.value for t in error_motion_tables(moved(fit, seed))} for seed in range(4)]
    for before, after in zip(plain, found, strict=True):
        named, a, b, c = (values[before.name] for values in by)
        more = 0.3 * (a - named) ** 2 + 0.1 * (b - a) ** 2 + 0.2 * (c - a) ** 2
        np.testing.assert_allclose(after.value, before.value)
        np.testing.assert_allclose(after.information, before.information)
        np.testing.assert_allclose(after.u**2 - before.u**2, more, rtol=1e-6, atol=1e-9)
        assert more.max() > 0.0


def test_error_field_is_that_of_the_other_name_so_often(fit):
    plain, found = error_field(fit, fit), error_field(fit, fit, alternatives=alternatives(fit))
    a, b, c = (error_field(moved(fit, i), moved(fit, j)) for i, j in ((0, 1), (1, 2), (1, 3)))
    more = sum(p * (f.change**2).sum(-1) for p, f in ((0.3, a), (0.1, b), (0.2, c)))
    np.testing.assert_allclose(found.u**2 - plain.u**2, more, rtol=1e-6)
    np.testing.assert_array_equal(found.error, plain.error)


def rivals_on(it: Known, *given: Effect) -> tuple[Fit, list[Rival]]:
    """A backlash of every axis, refitted to readings of a machine with the given effects."""
    fit = identify(it.model, Measurement(it.plan, it.readings(*given)), room=it.room)
    effects = [dataclasses.replace(it.effect(f"backlash:{axis}"), given=()) for axis in "XYZ"]
    state = ScoreTest(fit, 20, 0)
    peaks = [peak for effect in effects for peak in state.tests([effect])[0].peaks(1)]
    return fit, refit_all(fit, peaks, {"backlash": 3}, fit.used, it.room)


@pytest.mark.parametrize(
    ("sizes", "apart", "certain", "doubted"),
    [
        ((20, 30, 40), 0.5, False, True),  # told apart, and not certain
        ((20, 30, 40), 3.5, True, True),  # certain, and three in a hundred are another one
        ((20, 30, 40), 50.0, True, False),  # beyond doubt
        ((0, 0, 0), 0.5, True, True),  # one class: certain, and any of them
    ],
)
def test_what_a_name_may_be_instead(sizes, apart, certain, doubted, tmp_path):
    """Probabilities of the others against log odds that are `apart` from one to the next."""
    it = Known("laser_tracker", tmp_path)
    given = [it.effect(f"backlash:{a}:size_um={s}") for a, s in zip("XYZ", sizes, strict=True)]
    fit, rivals = rivals_on(it, *given)
    assert len(rivals) == 3
    ranked = [
        dataclasses.replace(r, log_bayes=-apart * i, size_surplus=0.0) for i, r in enumerate(rivals)
    ]
    weighed = weigh(classes_of(fit, ranked), ranked[0])
    assert (weighed.probability >= CERTAIN) == certain
    weights = np.exp(-apart * np.arange(3.0))
    shares = enumerate((weights / weights.sum())[1:], start=1)
    expected = {i: share for i, share in shares if share > 1e-4}  # less is no rival
    assert bool(expected) == doubted
    found = {i: p for p, it in weighed.instead for i, r in enumerate(ranked) if it is r}
    assert found == pytest.approx(expected)


def test_a_description_by_what_the_check_points_lack_foretells_nothing_there(study, fit):
    """Which two quantities a product is of goes by its shape, and so does what it needs."""
    plan = study.measurement.plan
    air = Factor("T_air", 20.0, 1.0)
    product = Interaction(
        port="EXX", unit="um", placement="X", products=((Factor("X", 0, 1), air),)
    )
    old = study.model
    model = Model(old.chain, old.instrument, (product, *old.effects, *old.random))
    more = identify(model, study.measurement, shapes={0: {"which": 0.0}})
    assert product.needs_at({"which": 0.0}) == ("X", "X", "T_air")
    without = {k: v for k, v in study.check.plan.covariates.items() if k != "T_air"}
    assert set(without) < set(plan.covariates)
    check = CheckPoints(
        dataclasses.replace(study.check.plan, covariates=without), study.check.tool_point
    )
    fewer = dataclasses.replace(more, theta=np.r_[0.0, more.theta[1:]])  # without what it found
    assert check_rms(fit, check, [Alternatives(fit, ((0.3, more),))])[0].value == (
        check_rms(fit, study.check)[0].value
    )
    assert check_rms(more, check)[0].value == check_rms(fewer, study.check)[0].value
    assert check_rms(more, study.check)[0].value != check_rms(fewer, study.check)[0].value


@pytest.mark.campaign
def test_an_ambiguous_effect_is_in_the_uncertainty_of_the_error_after(tmp_path):
    """A small drift, which temperatures that rise with time describe nearly as well."""
    drift = {"effect": "drift", "axis": "X", "um_per_h": 3.0}
    case = make_case("laser_tracker", seed=44, effects=[drift])
    study = load_study(write_study(tmp_path / "study", case))
    closure = close_loop(study.model, study.measurement, check=study.check, draws=100)
    assert closure.verdict == "ambiguous"
    for effect, doubt in zip(closure.effects, closure.alternatives, strict=True):
        assert effect.status == "ambiguous"
        # Other components of its own name are among them: what the name itself leaves open.
        others = sum(p for p, _ in doubt.others)
        assert sum(p for *_, p in effect.alternatives) < others < 1.0
    after, alone = closure.errors["after"].check, check_rms(closure.after, study.check)[0]
    assert after.value == alone.value
    assert after.u > 1.2 * alone.u


@pytest.mark.thorough
def test_what_is_unexplained_is_in_the_uncertainty_of_the_error_after(tmp_path):
    """The declared parameters have taken a part of a kink in roll: how far that leads off, a
    description of it tells.
    """
    kink = {"effect": "kink", "axis": "Y", "component": "B", "coefficient": 1e-3, "at_mm": 250}
    case = make_case("laser_frame", seed=12, effects=[kink])
    study = load_study(write_study(tmp_path / "study", case))
    closure = close_loop(study.model, study.measurement, check=study.check, draws=100)
    assert (closure.verdict, closure.effects) == ("unexplained", [])
    (doubt,) = closure.alternatives
    described = closure.unexplained.empirical.fit
    assert [p for p, _ in doubt.others] == [1.0] and doubt.others[0][1] is described
    after, alone = closure.errors["after"].check, check_rms(closure.after, study.check)[0]
    less = check_rms(described, study.check)[0]
    assert after.value == alone.value
    assert after.u > 1.5 * alone.u
    assert math.hypot(alone.u, after.value - less.value) == pytest.approx(after.u, rel=0.1)
    # The machine is known to the generator: that is where it is.
    assert less.value < after.value - alone.u
    assert any("which is most of its uncertainty" in note for note in closure.notes)
