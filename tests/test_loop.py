"""Closing the loop on small studies: what it names, and what it does not."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from known import LATERAL, PLANS, Known
from oracle import make_case, tool_point, tracker_readings, write_study
from vcal import CATALOGUE, Effect, Measurement, Parameter, close_loop, identify, load_study
from vcal.loop.empirical import EMPIRICAL, Proportion
from vcal.loop.outcome.unexplained import Refused, _from_dependence, from_structure
from vcal.loop.residuals.dependence import dependence
from vcal.loop.settings import checked, classes_of, null_draws
from vcal.report.loop.own_effect import own_effect

STAGES = ("screening", "refitting", "adding", "describing")


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("tracker"))


@pytest.fixture(scope="module")
def backlash(tmp_path_factory) -> Known:
    """All of it the oracle's: machine, backlash, noise, check points."""
    folder = tmp_path_factory.mktemp("backlash")
    true = {"effect": "backlash", "axis": "Y", "size_um": 12}
    return Known("laser_tracker", folder, seed=7, effects=[true], noise_factor=1.0)


def noisy(it: Known, seed: int, *effects, factor: float = 1.0) -> Measurement:
    """What the true machine with further effects gives, with `factor` times the declared noise."""
    sigma = it.instrument.noise(it.plan, it.measurement.readings)
    noise = factor * sigma * np.random.default_rng(seed).standard_normal(sigma.shape)
    return Measurement(it.plan, it.readings(*effects) + noise)


def closed(it: Known, measurement: Measurement | None = None, **options):
    options = {"draws": 200, "check": it.study.check} | options
    return close_loop(it.model, measurement or it.measurement, **options)


def plain(closure):
    """What a report would tell, without arrays."""
    return (
        closure.verdict,
        [(e.effect.key, e.status, e.parameters, e.p_value, e.log_evidence, e.alternatives)
         for e in closure.effects],
        closure.errors,
        closure.rejected,
        closure.noise_scale,
        [(s.p_value, s.trials) for s in closure.screenings],
    )  # fmt: skip


class Joint(Effect):
    """Z that depends on the product of two covariates, which none of the catalogue does."""

    name = "joint"

    @property
    def parameters(self):
        return (Parameter("size", "um", sigma=10.0),)

    def response(self, plan, shape):
        u, v = ((x - x.mean()) / x.std() for x in (plan.x("Y"), plan.covariate("dir_X")))
        return {("tool.Z", "size"): u * v}


@pytest.mark.parametrize("size", [0.0, 6.0])
def test_what_remains_may_depend_on_a_product(tracker, size):
    """Neither of the two shows it alone; of noise nothing is told."""
    joint = Joint(given=(("size", size, 0.0),))
    measurement = noisy(tracker, 5, *([joint] if size else []))
    fit = identify(tracker.model, measurement, room=tracker.room)
    told = dependence(fit, 200, 0)
    what = from_structure(fit, fit.chi2 / fit.dof, 0.01, 200, 0)
    if size == 0.0:
        assert told.p_value > 0.01 and what is None
        return
    assert told.p_value < 0.01 and told.joint
    assert set(told.products[0][:2]) == {"Y", "dir_X"} and told.products[0][2] > 0.2
    assert set(what.depends_on[:2]) == {"Y", "dir_X"} and what.joint
    assert "in a way that none of the effects tried describes" in what.reason
    assert (
        what.share_of_variance == told.products[0][2]
        and "the best column or product" in what.share_is
    )
    far = from_structure(fit, 50.0, 0.01, 200, 0)
    assert far.share_of_variance == 0.98 and "beyond the declared noise" in far.share_is
    closure = closed(tracker, measurement, effects=[CATALOGUE["backlash"]])
    assert closure.verdict == "unexplained"
    assert "(y_mm times dir_x)" in closure.sentence


def test_what_was_refused_is_told_where_nothing_else_shows(tracker):
    """No product of columns, and its own p-value."""
    fit = identify(tracker.model, noisy(tracker, 5), room=tracker.room)
    told = dependence(fit, 200, 0)._replace(p_value=0.5)
    told = told._replace(products=[("Y", "dir_X", 0.004)], joint=True)
    effect = tracker.effect("scale_growth:Y")
    refused = Refused(effect, 0.004, "held-out readings are not predicted better")
    what = _from_dependence(fit, told, 1.0, 0.01, refused=refused)
    assert what is not None and not what.joint and what.p_value == 0.004
    assert what.depends_on[: len(effect.indicators)] == list(effect.indicators)
    assert what.reason == (
        "scale_growth Y is significant, but held-out readings are not predicted better"
    )
    assert what.words == "what looks like scale_growth Y, which is not certain"
    assert _from_dependence(fit, told, 1.0, 0.01) is None
    loud = _from_dependence(fit, told._replace(p_value=1e-6), 1.0, 0.01, refused=refused)
    assert loud is not None and loud.joint and loud.p_value == 1e-6


def test_nothing_is_missing_from_a_clean_machine(tracker):
    closure = closed(tracker, noisy(tracker, 2))
    assert closure.verdict == "nothing_missing"
    assert (closure.effects, closure.rejected, closure.suspected) == ([], [], [])
    assert closure.unexplained is None
    assert closure.noise_scale == 1.0
    errors = closure.errors
    assert errors["before"] == errors["after"]
    assert errors["after"].check.value < errors["uncompensated"].check.value / 3
    assert errors["after"].heldout.value < errors["uncompensated"].heldout.value / 3
    assert errors["uncompensated"].chi2_per_dof > 10 > 1.3 > errors["after"].chi2_per_dof > 0.7
    assert closure.screenings[0].p_value > 0.01
    assert closure.unseen == ["tool_offset"]
    assert {"artefact_bending", "joint_compliance"}.isdisjoint(u.effect for u in closure.untestable)
    assert "nothing was found that it lacks" in closure.sentence


def test_backlash_is_named(backlash):
    said = []
    closure = closed(backlash, progress=said.append)
    assert closure.verdict == "named"
    (found,) = closure.effects
    assert (found.effect.key, found.status, found.placement) == ("backlash Y", "named", "Y")
    ((name, value, unit, u),) = found.parameters
    assert (name, unit) == ("size", "um")
    assert value == pytest.approx(12, abs=3 * u)
    assert 0.1 < u < 2.0
    assert found.p_value < 1e-6
    assert found.log_evidence > 10
    assert found.delta_bic < -20
    assert found.equivalent == []
    assert sum(p for *_, p in found.alternatives) < 0.05
    before, after = closure.errors["before"], closure.errors["after"]
    assert after.check.value < 0.8 * before.check.value
    assert after.heldout.value < before.heldout.value
    assert found.heldout_gain == pytest.approx(
        1 - after.heldout.value / before.heldout.value, rel=0.01
    )
    assert after.chi2_per_dof == pytest.approx(1.0, abs=0.25)
    assert closure.after.model.effects[-1] == found.effect
    assert [any(stage in text for text in said) for stage in STAGES] == [True] * 4


class Windup(Effect):
    """The same as a backlash of Y, under another name."""

    name = "windup"

    @property
    def parameters(self):
        return (Parameter("turn", "um", sigma=10.0),)

    def response(self, plan, shape):
        return {("EYY", "turn"): 0.5 * np.sign(plan.covariate("dir_Y"))}

    @classmethod
    def candidates(cls, setup):
        yield cls(placement="Y")


def test_what_the_data_cannot_tell_apart_is_said_in_one_sentence(backlash):
    closure = closed(backlash, effects=[CATALOGUE["backlash"], Windup])
    (found,) = closure.effects
    names = {found.effect.key, *found.equivalent}
    assert names == {"backlash Y", "windup Y"}
    (other,) = names - {found.effect.key}
    assert closure.sentence == (
        f"The declared model lacked {found.effect.key} "
        f"(indistinguishable from {other} with these data)."
    )


@pytest.mark.thorough
def test_same_seed_same_result(backlash):
    one, two, other = (closed(backlash, seed=seed) for seed in (5, 5, 6))
    assert plain(one) == plain(two)
    assert plain(one) != plain(other)
    assert other.verdict == one.verdict
    assert one.settings["seed"] == 5


@pytest.mark.parametrize(
    ("stage", "effects"), [*zip(STAGES, (0, 0, 0, 1), strict=True), ("round 2: screening", 1)]
)
@pytest.mark.thorough
def test_interruption_keeps_what_is_known(stage, effects, backlash):
    def progress(text):
        if stage in text:
            raise KeyboardInterrupt

    closure = closed(backlash, progress=progress)
    assert closure.interrupted
    assert [e.effect.key for e in closure.effects] == ["backlash Y"] * effects
    assert closure.verdict == (None, "named")[effects]
    for found in closure.effects:
        assert found.effect in closure.after.model.effects
        assert found.parameters[0][1] == pytest.approx(12, abs=4)
    assert closure.after.converged
    assert np.isfinite(closure.errors["after"].check.value)
    assert closure.sentence.startswith("Interrupted")


@pytest.mark.thorough
def test_interruption_after_the_search_loses_nothing(backlash):
    def progress(text):
        if "comparing" in text:
            raise KeyboardInterrupt

    closure = closed(backlash, progress=progress)
    assert not closure.interrupted  # the search was finished
    assert plain(closure) == plain(closed(backlash))


def test_larger_noise_is_told_but_not_named(tracker):
    closure = closed(tracker, noisy(tracker, 3, factor=1.4))
    assert closure.verdict == "nothing_missing"
    assert closure.effects == []
    assert closure.noise_scale == pytest.approx(1.4, abs=0.15)
    assert any("1.4" in note or "1.3" in note for note in closure.notes)
    sigma = [np.diag(fit.covariance) for fit in (closure.before, closure.after)]
    assert (sigma[1] >= sigma[0] * 0.999).all()
    assert sigma[1][-1] > 1.15 * sigma[0][-1]  # of the station, which has no prior


@pytest.mark.thorough
def test_search_can_be_restricted(backlash):
    only = [CATALOGUE["thermal_tilt"], CATALOGUE["range_scale"]]
    closure = closed(backlash, effects=only)
    assert "backlash" not in {e.effect.name for e in closure.effects}
    assert closure.settings["effects"] == ["thermal_tilt", "range_scale"]
    kinds = {kind.kind for screening in closure.screenings for kind in screening.kinds}
    # Nothing has been found that could change, and no angle goes round.
    describing = {cls.name for cls in EMPIRICAL} - {"changing", "harmonic"}
    assert kinds == {"thermal_tilt", "range_scale"} | describing
    none = closed(backlash, max_effects=0)
    # Nothing may be added, but it is said that something is missing.
    assert none.effects == [] and len(none.screenings) == 1
    assert none.verdict == "unexplained"
    assert none.unexplained.reason.startswith("backlash Y is significant, but no more effects")
    assert none.sentence.startswith("Unexplained, and no more effects may be added (max_effects)")
    assert none.passed_over[0].effect == "backlash"
    assert none.passed_over[0].reason == "no more effects may be added (max_effects)"


@pytest.mark.thorough
def test_an_effect_below_alpha_is_not_named(tracker):
    weak = noisy(tracker, 4, tracker.effect("backlash:Y:size_um=5"))
    p = closed(tracker, weak).screenings[0].p_value
    assert 0 < p < 0.01
    closure = closed(tracker, weak, alpha=p / 2)
    assert closure.effects == []
    assert closure.verdict in ("nothing_missing", "unexplained")


def test_stray_reading_is_listed_and_left_out(tracker):
    measurement = noisy(tracker, 5)
    readings = measurement.readings.copy()
    readings[17, 2] += 80e-6
    closure = closed(tracker, dataclasses.replace(measurement, readings=readings))
    assert closure.verdict == "nothing_missing"
    assert [stray.row for stray in closure.suspected] == [17]
    assert not closure.after.used[17]
    assert closure.after.used.sum() == tracker.plan.rows - 1
    clean = closed(tracker, measurement)
    assert closure.errors["after"].check.value == pytest.approx(
        clean.errors["after"].check.value, abs=0.3
    )


def test_two_effects_one_after_the_other(tracker):
    both = noisy(
        tracker, 6, tracker.effect("backlash:Y:size_um=14"),
        tracker.effect("lateral_reversal:X:size_EZX_um=12"),
    )  # fmt: skip
    closure = closed(tracker, both, check=None)
    assert closure.verdict == "named"
    found = {e.effect.key: e.parameters[0] for e in closure.effects}
    assert set(found) == {"backlash Y", "lateral_reversal X"}
    for key, true in (("backlash Y", 14), ("lateral_reversal X", 12)):
        assert found[key][1] == pytest.approx(true, abs=3.5 * found[key][3])
    assert len(closure.screenings) == 3
    assert closure.errors["after"].check is None
    assert closed(tracker, both, max_effects=1).effects[0].effect.key in found


OWN = '''\
import vcal


class CoolantLift(vcal.Effect):
    """The table floats on coolant: k p along Z of the X axis."""

    name = "coolant_lift"

    @property
    def parameters(self):
        return (vcal.Parameter("k", "um", sigma=5.0),)

    @property
    def needs(self):
        return ("coolant_bar",)

    def response(self, plan, shape):
        return {("EZX", "k"): plan.covariate("coolant_bar")}

    @classmethod
    def candidates(cls, setup):
        yield cls(placement="X")
'''


def moved_by_the_coolant(folder, **size):
    """A tracker's study whose table moves with the bar of a column that nobody knows."""
    case = make_case("laser_tracker", seed=8, plan=PLANS["laser_tracker"], tool_offset=LATERAL)
    pressure = np.random.default_rng(8).uniform(0, 4, len(case.run.t))
    run = dataclasses.replace(case.run, extra={"coolant_bar": pressure})
    up = {"effect": "follows", "axis": "X", "column": "coolant_bar", "scale": 1.0, **size}
    moved = tracker_readings(case.tracker, tool_point(case.machine, run, [up]))
    change = moved - tracker_readings(case.tracker, tool_point(case.machine, run))
    for i, name in enumerate(("range_mm", "azimuth_rad", "elevation_rad")):
        case.data[name] += change[:, i] * (1e3 if i == 0 else 1.0)
    case.data["coolant_bar"] = pressure
    return write_study(folder / "study", case)


@pytest.fixture(scope="module")
def lifted(tmp_path_factory):
    """The table rises by 6 um per bar."""
    folder = tmp_path_factory.mktemp("lifted")
    return moved_by_the_coolant(folder, component="Z", size_um=6.0)


def test_a_rotation_that_follows_a_column_is_told_as_one(tmp_path):
    study = load_study(moved_by_the_coolant(tmp_path, component="B", size_urad=15.0))
    closure = close_loop(study.model, study.measurement, draws=200)
    assert closure.verdict == "unexplained" and not closure.effects
    assert "a quantity by the rotation EBX (coolant_bar)" in closure.sentence


@pytest.mark.thorough
def test_what_follows_a_column_that_no_effect_knows(lifted):
    """It is no product of that column with another, and no effect of time or of a temperature."""
    study = load_study(lifted)
    closure = close_loop(study.model, study.measurement, draws=200)
    assert closure.verdict == "unexplained" and not closure.effects
    what = closure.unexplained
    assert isinstance(what.empirical.effect, Proportion) and not what.joint
    assert what.depends_on[0] == "coolant_bar" and what.direction == "Z"
    assert what.size_um == pytest.approx(12.0, rel=0.05)  # of its middle, as all descriptions
    assert "in proportion to a quantity along Z (coolant_bar)" in closure.sentence
    assert "coolant_bar" in own_effect(closure)


def test_an_effect_of_the_users_own(lifted, tmp_path):
    """A class in a file, and a column nobody else knows."""
    folder = Path(shutil.copytree(lifted, tmp_path / "study"))
    (folder / "own.py").write_text(OWN)
    setup = folder / "setup.toml"
    setup.write_text(setup.read_text() + '\n[model]\neffects_file = "own.py"\n')
    study = load_study(setup, trust=True)
    assert "coolant_lift" not in CATALOGUE
    closure = close_loop(
        study.model, study.measurement, effects=study.catalogue.values(), draws=200
    )
    assert closure.verdict == "named"
    (found,) = closure.effects
    assert found.effect.key == "coolant_lift X"
    ((name, value, unit, u),) = found.parameters
    assert (name, unit) == ("k", "um")
    assert value == pytest.approx(6.0, abs=3 * u)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"alpha": 0.0}, "alpha: found 0.0, expected a number greater than 0"),
        ({"alpha": 1.5}, "alpha: found 1.5, expected a number less than 1"),
        ({"draws": 0}, "draws: found 0, expected a number of at least 25"),
        ({"draws": 20.5}, "draws: found 20.5, expected a valid integer"),
        ({"seed": -1}, "seed: found -1, expected a number of at least 0"),
        ({"max_effects": -1}, "max_effects: found -1, expected a number of at least 0"),
        ({"effects": ["backlsh"]}, r"unknown effect 'backlsh' \(did you mean 'backlash'\?\)"),
        ({"effects": "backlsh"}, "unknown effect 'backlsh'"),
        (
            {"effects": [CATALOGUE["backlash"](port="EXX", unit="um")]},
            r"effects: found .*, expected classes of effects or",
        ),
        ({"effects": [int]}, "effects: found <class 'int'>, expected classes of effects or"),
    ],
)
def test_settings_out_of_their_bounds_are_refused(backlash, settings, expected):
    with pytest.raises(ValueError, match=expected):
        close_loop(backlash.model, backlash.measurement, **settings)


def test_effects_by_name():
    jump = CATALOGUE["jump"]
    assert classes_of(["backlash", jump]) == [CATALOGUE["backlash"], jump]
    assert classes_of("jump") == [jump]


def test_numbers_of_numpy_are_settings():
    found = checked(draws=np.int64(50), alpha=np.float64(0.05), learn=np.bool_(True))
    assert (found.draws, found.alpha, found.learn) == (50, 0.05, True)


def test_fewer_null_draws_for_many_readings_unless_they_are_given():
    assert [null_draws(None, n) for n in (30_000, 30_001)] == [500, 200]
    assert null_draws(40, 100_000) == 40
