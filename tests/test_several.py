"""Several data sets of one machine in one study: joint estimates, the loop, the page, mistakes."""

import dataclasses
import json
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from joint import alone, at_temperatures, write_joint
from oracle import as_study, make_case, tool_point
from report_schema import validated
from vcal import CATALOGUE, Measurement, StudyError, close_loop, identify, load_study, predict
from vcal.demo import FOLDER
from vcal.effects.data_set import OfDataSet
from vcal.effects.geometric import GeometricErrors
from vcal.effects.probes import ProbeMatrix
from vcal.instruments.several import DataSet, one_clock, several
from vcal.loop.empirical.covariates import distinct_covariates
from vcal.loop.notes import _elsewhere, _few_check_points, _worse, data_set_consistency
from vcal.loop.notes import alone as alone_fit
from vcal.loop.outcome.closure import Errors
from vcal.loop.outcome.unexplained import from_structure
from vcal.loop.residuals.dependence import dependence
from vcal.loop.residuals.outliers import outlying_rows
from vcal.loop.screening.candidates import candidates
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.search.certainty import doubted
from vcal.loop.search.state import chi2_per_dof, fitted
from vcal.loop.weighing.cross_validation import (
    Rms,
    check_rms,
    folds_of,
    heldout_residuals,
    heldout_rms,
    rms_fall,
    weighted_squares,
)
from vcal.machine.plan import DATA_SET, of_set
from vcal.numerics.spatial import align_rigid
from vcal.report import write_report
from vcal.study.simulated import parse_with, write_simulated
from vcal.uncertainty import ParameterErrors, linearised
from vcal.uncertainty.campaign import virtual_pair

CHAIN = "w X b Y Z t"
FORM = re.compile(r"^\S+( \(override .*\))?, .+: found .+, expected .+; .+", re.DOTALL)
GRID = {"shape": (5, 4, 4)}
ROOM = 320
"""Slots of every solver here, so that they share compiled programs."""


def tracker_case(seed, effects=(), **options):
    return make_case("laser_tracker", CHAIN, seed, effects, **{"plan": GRID} | options)


def ball_case(seed, effects=(), **options):
    return make_case("ball_array", CHAIN, seed, effects, **{"plan": {"repeats": 1}} | options)


def both(seed, effects=(), **options):
    return {"tracker": tracker_case(seed, effects), "balls": ball_case(seed, effects, **options)}


def closed(study, **options):
    measurement = options.pop("measurement", study.measurement)
    return close_loop(study.model, measurement, check=study.check, draws=200, **options)


def geometry(fit):
    """Places in theta of what the data sets share."""
    found, k = [], 0
    for effect in fit.model.effects:
        count = len(effect.amplitudes)
        if isinstance(effect, GeometricErrors):
            found += range(k, k + count)
        k += count
    return np.array(found)


def precision_of(fit, kept):
    """Posterior precision of some parameters, the others eliminated, and its product with their
    estimate: numpy alone, from the normal equations.
    """
    h = fit.jacobian.T @ fit.jacobian + np.diag(fit.precision)
    others = np.setdiff1d(np.arange(len(h)), kept)
    across = h[np.ix_(kept, others)]
    precision = h[np.ix_(kept, kept)] - across @ np.linalg.solve(
        h[np.ix_(others, others)], across.T
    )
    return precision, precision @ fit.theta[kept]


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """A machine that has nothing undeclared, seen by a tracker and by a ball array."""
    folder = write_joint(tmp_path_factory.mktemp("several") / "clean", both(5))
    return folder, load_study(folder)


@pytest.fixture(scope="module")
def clean_fit(clean):
    return identify(clean[1].model, clean[1].measurement, room=ROOM)


@pytest.fixture(scope="module")
def framed(tmp_path_factory):
    """The same machine seen by a tracker and, in two readings a row, by beams along its edges."""
    case = tracker_case(5)
    folder = write_joint(tmp_path_factory.mktemp("several") / "framed", {"tracker": case})
    write_beams(folder, case)
    return folder, load_study(folder)


def write_beams(folder, case, sigma=0.5e-6):
    """A laser frame on the machine of a case: displacement of the tool point across each beam."""
    size = np.array([2.0, 1.0, 0.6])
    travel = {1: ((0, 0, 0), 1), 2: ((0, 1, 0), 0), 5: ((1, 1, 0), 2), 3: ((1, 1, 1), 1)}
    travel[4] = ((1, 0, 1), 0)
    rng, rows = np.random.default_rng(17), []
    for number, (corner, axis) in travel.items():
        q = np.tile(np.array(corner) * size, (21, 1))
        other = q[0, axis] == 0.0
        q[:, axis] = np.linspace(0, size[axis], 21) if other else np.linspace(size[axis], 0, 21)
        run = dataclasses.replace(
            case.run,
            q=q,
            direction=np.ones((21, 3)),
            t=np.arange(21.0),
            temperature=np.full((21, 3), 20.0),
            air=np.full(21, 20.0),
        )
        moved = tool_point(case.machine, run, []) - q - case.machine.tool_offset
        read = np.delete(moved, axis, 1) + sigma * rng.standard_normal((21, 2))
        rows += [[number, *(1e3 * p), *(1e6 * r)] for p, r in zip(q, read, strict=True)]
    header = "segment,x_mm,y_mm,z_mm,u_um,v_um"
    text = "\n".join(",".join(f"{v:.10g}" for v in row) for row in rows)
    (folder / "frame.csv").write_text(f"{header}\n{text}\n", encoding="utf-8")
    setup = folder / "setup.toml"
    more = '[[data]]\nname = "frame"\nfile = "frame.csv"\n[data.instrument]\n'
    more += f'kind = "laser_frame"\nsigma_um = {1e6 * sigma}\n\n[model.geometric]'
    text = setup.read_text(encoding="utf-8").replace("[model.geometric]", more, 1)
    setup.write_text(text, encoding="utf-8")


# --- one estimate of all -------------------------------------------------------------------------


@pytest.mark.campaign
def test_the_joint_estimate_is_that_of_both_informations(clean, clean_fit):
    """Information of the two fits added, the prior that they share counted once."""
    folder, _ = clean
    kept = geometry(clean_fit)
    precision, pull = -np.eye(len(kept)), np.zeros(len(kept))
    for name in ("tracker", "balls"):
        study = load_study(alone(folder, name))
        fit = identify(study.model, study.measurement, room=ROOM)
        assert (geometry(fit) == np.arange(len(kept))).all() and (fit.precision[kept] == 1.0).all()
        one, toward = precision_of(fit, np.arange(len(kept)))
        precision, pull = precision + one, pull + toward
    expected = np.linalg.solve(precision, pull)
    covariance = np.linalg.inv(precision)
    sigma = np.sqrt(np.diag(covariance))
    ours = clean_fit.covariance[np.ix_(kept, kept)]
    assert np.abs(ours - covariance).max() < 1e-4 * covariance.max()
    # Both are linear in parameters of 1e-5: what bends is far below an uncertainty.
    assert (np.abs(clean_fit.theta[kept] - expected) < 2e-3 * sigma).all()


@pytest.mark.campaign
def test_the_readings_of_a_clean_machine_scatter_as_declared(clean_fit):
    """chi2 against its degrees of freedom, each data set's too; these add up to all of them."""
    fit = clean_fit
    assert abs(fit.chi2 / fit.dof - 1.0) < 4.0 * np.sqrt(2.0 / fit.dof)
    parts = [fit.chi2_and_dof(rows) for rows in fit.measurement.plan.parts.values()]
    np.testing.assert_allclose(np.sum(parts, 0), [fit.chi2, fit.dof], rtol=1e-9)
    for chi2, dof in parts:
        assert abs(chi2 / dof - 1.0) < 4.0 * np.sqrt(2.0 / dof)


@pytest.mark.campaign
def test_check_points_gain_by_the_second_data_set(tmp_path):
    """On the average of several machines the two together are no worse than the better one."""
    errors = []
    for seed in range(11, 15):
        folder = write_joint(tmp_path / str(seed), both(seed))
        paths = (folder, alone(folder, "tracker"), alone(folder, "balls"))
        studies = [load_study(path) for path in paths]
        fits = [identify(s.model, s.measurement, room=ROOM) for s in studies]
        errors.append([check_rms(fit, studies[0].check)[0].value for fit in fits])
    together, tracker, balls = np.sqrt((np.array(errors) ** 2).mean(0))
    assert together < 1.02 * min(tracker, balls)


@pytest.mark.campaign
def test_one_data_set_is_what_it_is_by_itself(tmp_path):
    """A study with a single [[data]] row gives the numbers of one with [instrument]."""
    folder = write_joint(tmp_path / "one", {"balls": ball_case(5)})
    wrapped, plain = load_study(folder), load_study(alone(folder, "balls"))
    ours, theirs = (identify(s.model, s.measurement, room=ROOM) for s in (wrapped, plain))
    np.testing.assert_allclose(ours.theta, theirs.theta, atol=1e-6)
    assert ours.chi2 == pytest.approx(theirs.chi2, rel=1e-9)
    assert ours.dof == pytest.approx(theirs.dof, rel=1e-9)
    assert ours.log_evidence() == pytest.approx(theirs.log_evidence(), abs=1e-6)
    assert heldout_rms(ours).value == pytest.approx(heldout_rms(theirs).value, rel=1e-7)
    assert [key for key, _ in ours.entries[-33:]] == ["ball_calibration balls"] * 33


# --- what only the widest instrument has ---------------------------------------------------------


@pytest.fixture(scope="module")
def framed_fit(framed):
    return identify(framed[1].model, framed[1].measurement, room=ROOM)


@pytest.mark.campaign
def test_padding_counts_nowhere(framed, framed_fit):
    """A row of a beam has two readings: its third adds nothing to any number."""
    study, fit = framed[1], framed_fit
    beams = study.plan.in_set("frame")
    n, m = fit.residual.shape
    assert m == 3 and beams.sum() == 105
    assert (study.instrument.present(study.plan).sum(1) == np.where(beams, 2, 3)).all()
    assert not fit.residual[beams, 2].any()
    assert not fit.jacobian.reshape(n, m, -1)[beams, 2].any()
    assert fit.counted.sum() == 3 * (n - 105) + 2 * 105
    hat = np.linalg.solve(
        fit.jacobian.T @ fit.jacobian + np.diag(fit.precision), fit.jacobian.T @ fit.jacobian
    )
    assert fit.dof == pytest.approx(3 * (n - 105) + 2 * 105 - np.trace(hat), abs=1e-6)
    assert abs(fit.chi2 / fit.dof - 1.0) < 4.0 * np.sqrt(2.0 / fit.dof)
    state = ScoreTest(fit, 50, 0)
    assert not state.null[beams, 2].any()
    expected = (state.null**2).sum((0, 1)).mean() / fit.dof  # drawn under the same prior, noise
    assert abs(expected - 1.0) < 5.0 * np.sqrt(2.0 / fit.dof / 50)
    held = heldout_residuals(fit)
    assert np.isfinite(held).all() and not held[beams, 2].any()
    # Two readings make a point of a beam: the rms is that of their length.
    rms = np.sqrt((held[beams, :2] ** 2).sum(1).mean()) * 1e6
    assert heldout_rms(fit, beams).value == pytest.approx(rms, rel=1e-9)


@pytest.mark.thorough
def test_no_number_of_the_padding_is_read(framed, framed_fit):
    """Whatever stands there, in the readings and in W, every result is the same."""
    study, fit = framed[1], framed_fit
    beams = study.plan.in_set("frame")
    readings, whitener = study.measurement.readings.copy(), fit.whitener.copy()
    readings[beams, 2], whitener[beams, 2, 2] = 1e3, 7.0
    measurement = Measurement(study.plan, readings)
    other = identify(study.model, measurement, whitener=whitener, room=ROOM)
    np.testing.assert_array_equal(other.theta, fit.theta)
    assert (other.chi2, other.dof) == (fit.chi2, fit.dof)
    assert other.log_evidence(1.3) == pytest.approx(fit.log_evidence(1.3), abs=1e-9)
    np.testing.assert_array_equal(heldout_residuals(other), heldout_residuals(fit))
    np.testing.assert_array_equal(ScoreTest(other, 20, 0).null, ScoreTest(fit, 20, 0).null)


def test_a_stray_reading_is_found_in_its_own_data_set(framed, framed_fit):
    """A row of two readings is judged by two degrees of freedom, at the scale of its own set."""
    study, fit = framed[1], framed_fit
    weights = np.ones(study.plan.rows)
    assert outlying_rows(fit, lambda: (fit, weights)) == []
    row = int(np.flatnonzero(study.plan.in_set("frame"))[40])
    readings = study.measurement.readings.copy()
    readings[row, 0] += 10.0 * study.instrument.noise(study.plan, readings)[row, 0]
    spoilt = identify(study.model, Measurement(study.plan, readings), room=ROOM)
    (stray,) = outlying_rows(spoilt, lambda: (spoilt, weights))
    assert stray.row == row and study.plan.place(row) == ("frame", 40)


def test_rows_that_are_never_fitted_weigh_as_the_others_do(small_arm_study):
    """The last fifth of an arm's poses is foretold only: its rows have no whitener of their own."""
    study = load_study(small_arm_study)
    _, apart = folds_of(study.model, study.measurement)
    fit = identify(study.model, study.measurement, keep=~apart)
    residuals = heldout_residuals(fit)
    told = np.isfinite(residuals).all(1)
    squares = weighted_squares(fit, residuals)
    assert apart.any() and (squares[apart[told]] > 0.0).all()
    typical = np.median(fit.whitener[fit.used], axis=0)
    expected = ((residuals[apart & told] @ typical.T) ** 2).sum(1)
    np.testing.assert_allclose(squares[apart[told]], expected)
    assert rms_fall(fit, fit, squares=weighted_squares) == 0.0


@pytest.mark.campaign
def test_clustered_readings_keep_their_own_covariance(small_arm_study, tmp_path):
    """Two runs of an arm, with three reflectors and with two: each has its own covariance."""
    folder = tmp_path / "arms"
    shutil.copytree(small_arm_study, folder)
    text = (folder / "setup.toml").read_text(encoding="utf-8")
    start, end = text.index("[instrument]"), text.index("[model.geometric]")
    rows = ""
    for name, count in (("three", 3), ("two", 2)):
        # The same table twice would be refused; spaces at its end make it another.
        lines = (folder / "data.csv").read_text(encoding="utf-8")
        (folder / f"{name}.csv").write_text(lines + " " * count, encoding="utf-8")
        own = text[start:end].replace("[instrument]", "[data.instrument]")
        own = own.replace("tool_reflectors = 3", f"tool_reflectors = {count}")
        rows += f'[[data]]\nname = "{name}"\nfile = "{name}.csv"\n{own}'
    (folder / "setup.toml").write_text(text[:start] + rows + text[end:], encoding="utf-8")
    study = load_study(folder)
    state = fitted(study.model, study.measurement, None, ROOM)
    fit, plan = state.scored, study.plan
    two = plan.in_set("two")
    assert sorted(set(fit.clusters)) == [0, 1]
    # The last fifth of each run was never fitted.
    assert (~fit.used).sum() == 2 * (16 // 5) and not fit.used[two][-3:].any()
    assert fit.counted.sum() == 13 * 9 + 13 * 6
    pad = fit.whitener[two][:, 6:]
    assert not pad[:, :, :6].any() and (pad[0][:, 6:] == np.eye(3)).all()
    first, second = (fit.whitener[rows][0, :6, :6] for rows in (~two, two))
    assert np.abs(first - second).max() > 0.01 * np.abs(first).max()
    assert np.isfinite(fit.covariance).all() and np.isfinite(heldout_rms(fit).value)


# --- the loop -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def backlash(tmp_path_factory):
    """12 um of backlash of Y, which both data sets show, and the report of the loop."""
    true = [{"effect": "backlash", "axis": "Y", "size_um": 12}]
    folder = write_joint(tmp_path_factory.mktemp("several") / "backlash", both(7, true))
    study = load_study(folder)
    closure = closed(study)
    page = write_report(closure, study, folder / "report")
    return study, closure, page


@pytest.mark.campaign
def test_an_effect_of_the_machine_is_named_once(backlash):
    study, closure, _ = backlash
    assert closure.verdict == "named"
    (found,) = closure.effects
    assert found.effect.key == "backlash Y" and found.status == "named"
    ((name, value, unit, u),) = found.parameters
    assert (name, unit) == ("size", "um") and abs(value - 12.0) < 4.0 * u and u < 0.5
    before, after = closure.errors["before"], closure.errors["after"]
    assert after.check.value < 0.5 * before.check.value
    for name in study.plan.sets:
        assert after.sets[name].heldout.value < before.sets[name].heldout.value
        assert after.sets[name].chi2_per_dof < 1.2 < before.sets[name].chi2_per_dof


@pytest.mark.thorough
def test_the_page_tells_the_data_sets_apart(backlash):
    study, closure, page = backlash
    text = page.read_text(encoding="utf-8")
    for one in study.sets:
        assert f"<td>{one.name}</td>" in text and one.file in text
    assert "tracker: laser tracker; balls: ball array" in text
    assert "property object" not in text
    record = validated(json.loads((page.parent / "report.json").read_text(encoding="utf-8")))
    assert [one["name"] for one in record["data_sets"]] == ["tracker", "balls"]
    told = record["data_sets"][1]["errors"]["after"]
    assert told["heldout_rms_um"] == closure.errors["after"].sets["balls"].heldout.value
    # Both tables count their time from zero: it is none of the machine's.
    reasons = {(u["effect"], u["placement"]): u["reason"] for u in record["untestable"]}
    assert reasons["drift", "X"] == "the data have no t_s shared by the data sets"


@pytest.mark.campaign
def test_an_effect_of_an_instrument_is_named_for_its_data_set(tmp_path):
    true = [{"effect": "encoder_eccentricity", "amplitude_urad": 20, "phase_deg": 40}]
    cases = {"tracker": tracker_case(8, true), "balls": ball_case(8)}
    study = load_study(write_joint(tmp_path / "one", cases))
    closure = closed(study)
    (found,) = closure.effects
    assert closure.verdict == "named"
    assert found.effect.key == "encoder_eccentricity tracker azimuth"
    expected = 20.0 * np.array([np.cos(np.deg2rad(40)), np.sin(np.deg2rad(40))])
    for (_, value, unit, u), true_value in zip(found.parameters, expected, strict=True):
        assert unit == "urad" and abs(value - true_value) < 3.0 * u
    # The picture shows the rows of one set, and the gain is that of one.
    page = write_report(closure, study, tmp_path / "report").read_text(encoding="utf-8")
    assert " when it was added (in the data set tracker)." in page


@pytest.mark.thorough
def test_what_the_machine_may_do_as_well_and_was_not_tested_leaves_a_name_open(tmp_path):
    """Its drift cannot be tested where the clocks overlap, and looks like one of the station."""
    true = [{"effect": "drift", "axis": "X", "component": "Y", "um_per_h": 30}]
    cases = {
        "tracker": tracker_case(8, true, plan={**GRID, "cycles": True}),
        "balls": ball_case(8, true),
    }
    study = load_study(write_joint(tmp_path / "one", cases))
    assert "t" not in study.plan.covariates
    closure = closed(study)
    (found, *_) = closure.effects
    assert found.effect.name in ("station_drift", "station_settling")
    named = dataclasses.replace(found, status="named")
    open_ = doubted(named, closure.after, None, closure.untestable)
    assert found.status == open_.status == "ambiguous"
    assert "drift" in open_.separation and "of the machine may look the same" in open_.separation
    assert "say when each began by its start_s" in open_.separation
    assert doubted(named, closure.after, None, []) is named


@pytest.mark.campaign
def test_before_and_after_warming_up(tmp_path):
    """X grows by 3 um/(m K). At one temperature that is a slope of EXX; at two it is not."""
    true = [{"effect": "scale_growth", "axis": "X", "um_per_m_K": 3}]
    base = tracker_case(9)
    cases = {
        "cold": at_temperatures(base, (20.0, 20.0, 20.0), true, 1),
        "warm": at_temperatures(base, (24.0, 20.0, 20.0), true, 2),
    }
    folder = write_joint(tmp_path / "both", cases)
    closure = closed(load_study(folder))
    assert closure.verdict == "named"
    (found,) = closure.effects
    assert found.effect.key == "scale_growth X"
    ((_, value, _, u),) = found.parameters
    assert abs(value - 3.0) < 4.0 * u and u < 0.3
    for name in cases:
        study = load_study(alone(folder, name))
        assert closed(study).effects == []


@pytest.mark.thorough
def test_noise_that_one_data_set_declares_too_small_names_nothing(clean):
    """Readings of the balls scatter 1.5 times as declared: that is said, and nothing is blamed."""
    study = clean[1]
    case = ball_case(5, noise_factor=1.5)
    order = np.flatnonzero(study.plan.in_set("balls"))
    position = np.array(study.plan.position)
    position[order] = case.run.q
    plan = study.plan.with_position(position)
    closure = closed(study, measurement=Measurement(plan, study.measurement.readings))
    assert closure.verdict == "nothing_missing"
    assert closure.noise_scales["tracker"] == 1.0
    assert closure.noise_scales["balls"] == pytest.approx(1.4, abs=0.15)
    factors = {part.name: part.factor for part in closure.noise_components}
    assert factors["tracker range"] == pytest.approx(1.0, abs=0.2)
    assert any("balls X" in note for note in closure.notes)


@pytest.fixture(scope="module")
def two_machines(tmp_path_factory):
    """What two machines of one family gave, said to be of one."""
    cases = {"first": tracker_case(5), "second": tracker_case(6)}
    return load_study(write_joint(tmp_path_factory.mktemp("several") / "machines", cases))


@pytest.mark.thorough
def test_two_machines_are_not_one(two_machines):
    study = two_machines
    fit = identify(study.model, study.measurement, room=ROOM)
    said = data_set_consistency(fit, fit, ROOM)
    joint = chi2_per_dof(fit)
    assert f"do not fit one machine: chi² per degree of freedom is {joint:.3g} where" in said
    for name, rows in study.plan.parts.items():
        one = alone_fit(fit, rows, ROOM)
        assert (one.used == rows).all() and len(one.theta) == len(fit.theta) - 6  # a station
        assert chi2_per_dof(one) < 1.3 < 0.5 * joint
        assert f"{name} {chi2_per_dof(one):.3g}" in said
    # With their difference in the model they are one.
    assert data_set_consistency(fit, one, ROOM) == ""


@pytest.mark.thorough
def test_data_sets_of_one_machine_do_not_contradict_each_other(clean, clean_fit):
    assert data_set_consistency(clean_fit, clean_fit, ROOM) == ""
    (rows,) = (clean[1].plan.in_set("balls"),)
    single = dataclasses.replace(
        clean_fit, measurement=Measurement(clean[1].plan.part("balls"), clean_fit.residual[rows])
    )
    assert data_set_consistency(single, single, ROOM) == ""


@pytest.mark.campaign
def test_the_loop_says_that_two_machines_are_not_one(two_machines):
    closure = closed(two_machines, effects=[CATALOGUE["range_scale"]])
    assert "do not fit one machine" in closure.notes[0]


def test_an_effect_of_one_data_set_gains_there(clean, clean_fit):
    """The other data set is foretold better; that speaks for no effect of this one's instrument."""
    rows = clean[1].plan.in_set("tracker")
    worse = dataclasses.replace(clean_fit, residual=clean_fit.residual.copy())
    worse.residual[~rows] *= 2.0
    worse = dataclasses.replace(
        worse, whitened=np.einsum("nij,nj->ni", worse.whitener, worse.residual).reshape(-1)
    )
    assert rms_fall(worse, clean_fit) == rms_fall(worse, clean_fit, ~rows) > 0.3
    assert rms_fall(worse, clean_fit, rows) < 0.1


def test_readings_and_check_points_that_speak_against_what_was_found_are_told():
    def errors(heldout: Rms, check: Rms | None = None) -> Errors:
        return Errors(check, check, heldout, heldout, 1.0)

    def said_of(before: Errors, after: Errors, found: bool) -> list[str]:
        return _worse(SimpleNamespace(errors={"before": before, "after": after}, found=found))

    before = errors(Rms(25.6, 0.5))
    (said,) = said_of(before, errors(Rms(27.2, 0.8)), True)
    assert said.startswith("held-out") and "the readings that were fitted" in said
    assert "(27.2 ± 0.8 µm) than before (25.6 ± 0.5 µm): the effects found" in said
    (said,) = said_of(before, errors(Rms(27.2, 0.8)), False)
    assert "the estimated noise" in said
    for after in (Rms(26.4, 0.8), Rms(20.0, 0.5), Rms(np.nan, np.nan)):
        assert said_of(before, errors(after), True) == []
    before = errors(Rms(25.6, 0.5), Rms(3.9, 1.6))
    (said,) = said_of(before, errors(Rms(25.0, 0.5), Rms(50.8, 11.8)), True)
    assert said.startswith("the error at the check points is larger")
    assert "(50.8 ± 10 µm) than before (3.9 ± 2 µm)" in said
    assert said_of(before, errors(Rms(25.0, 0.5), Rms(5.0, 1.6)), True) == []


# --- covariates ----------------------------------------------------------------------------------


def test_a_covariate_that_one_data_set_lacks_is_missed_by_its_name(clean, tmp_path):
    folder = tmp_path / "lacking"
    shutil.copytree(clean[0], folder)
    path = folder / "balls.csv"
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    place = rows[0].index("T_y_degC")
    text = "\n".join(",".join(c for i, c in enumerate(r) if i != place) for r in rows)
    path.write_text(text + "\n", encoding="utf-8")
    study = load_study(folder)
    found, missing = candidates(study.model, study.measurement, study.tried)
    reasons = {(m.effect, m.placement): m.reason for m in missing}
    assert reasons["thermal_tilt", "Y"] == "balls has no T_Y"
    assert "thermal_tilt X" in {effect.key for effect in found}
    assert "thermal_tilt Y" not in {effect.key for effect in found}
    # Its own time serves an effect of an instrument all the same.
    assert {"station_drift tracker", "jump tracker frame"} <= {effect.key for effect in found}


def test_time_is_shared_where_the_data_sets_follow_each_other(clean):
    folder, study = clean
    assert "t" not in study.plan.covariates and study.plan.has("tracker:t", "balls:t")
    later = load_study(folder, {"data.1.start_s": 90000.0})
    assert "t" in later.plan.covariates and not later.plan.lacking("t")
    t = later.plan.values("t")
    assert (t[later.plan.in_set("balls")] > t[later.plan.in_set("tracker")].max()).all()
    assert later.plan.has("balls:t")
    plans = {one.name: one.plan for one in later.sets}
    assert one_clock(plans) and not one_clock({one.name: one.plan for one in study.sets})


def test_what_is_left_may_depend_on_the_data_set(clean):
    """A machine that bends otherwise in the second run: the description names that data set."""
    study = clean[1]
    plan = study.plan
    assert np.isnan(distinct_covariates(study.plan)["tracker:X"][
        plan.in_set("balls")
    ]).all()  # fmt: skip
    balls = plan.in_set("balls")
    readings = study.measurement.readings.copy()
    u = (plan.values("X") - 1.0) / 1.0
    readings[:, 2] += np.where(balls, 20e-6 * np.sin(9.0 * u), 0.0)
    fit = identify(study.model, Measurement(plan, readings), room=ROOM)
    told = dependence(fit, 200, 0)
    assert told.p_value < 0.01 and "balls:X" in [name for name, _ in told.single[:4]]
    what = from_structure(fit, fit.chi2 / fit.dof, 0.01, 200, 0)
    assert any(DATA_SET in name or name.startswith("balls:") for name in what.depends_on[:3])


def test_a_tool_of_its_own(tmp_path):
    """The balls are probed with a stylus far from where the reflector was."""
    longer = (0.3, -0.4, -0.6)
    cases = {"tracker": tracker_case(5), "balls": ball_case(5, tool_offset=longer)}
    folder = write_joint(tmp_path / "tools", cases)
    study = load_study(folder, {"data.1.tool_offset_mm": [300, -400, -600]})
    fit = identify(study.model, study.measurement, room=ROOM)
    assert abs(fit.chi2 / fit.dof - 1.0) < 4.0 * np.sqrt(2.0 / fit.dof)
    wrong = load_study(folder)
    assert identify(wrong.model, wrong.measurement, room=ROOM).chi2 > 1.2 * fit.chi2


def test_effects_can_be_declared_for_one_data_set(clean):
    folder, _ = clean
    more = [
        {"name": "range_scale", "offset_um": 2.0, "offset_um_sigma": 1.0, "scale_um_per_m": 1.0}
    ]
    study = load_study(folder, {"model.effect": more})
    effect = study.model.effects[-1]
    assert effect.key == "range_scale tracker"
    assert [(p.mean, p.sigma) for p in effect.amplitudes] == [(2.0, 1.0), (1.0, 0.0)]
    rows = np.flatnonzero(study.plan.in_set("balls"))
    for (port, _), column in effect.response(study.plan, {}).items():
        assert port == "tracker:read.range" and not np.asarray(column)[rows].any()
    with pytest.raises(
        StudyError, match=r"model\.effect\.0\.data_set.*'balls'|without a possible placement"
    ):
        load_study(folder, {"model.effect": [{"name": "range_scale", "data_set": "balls"}]})
    with pytest.raises(StudyError, match="belongs to the machine"):
        more = [{"name": "backlash", "placement": "Y", "data_set": "tracker"}]
        load_study(folder, {"model.effect": more})
    with pytest.raises(StudyError, match="did you mean 'tracker'"):
        load_study(folder, {"model.effect": [{"name": "range_scale", "data_set": "traker"}]})


@pytest.mark.thorough
def test_a_probe_of_one_data_set_moves_the_tool_there_only(clean, tmp_path):
    """Lobes of the probe that touched the balls answer at the tool, which both data sets have."""
    folder, _ = clean
    shutil.copytree(folder, tmp_path / "lobes")
    header, *rows = (folder / "balls.csv").read_text(encoding="utf-8").splitlines()
    phi = np.linspace(-3.0, 3.0, len(rows))
    lines = [f"{header},approach_rad", *(f"{r},{a}" for r, a in zip(rows, phi, strict=True))]
    (tmp_path / "lobes" / "balls.csv").write_text("\n".join(lines), encoding="utf-8")
    study = load_study(tmp_path / "lobes")
    found, untestable = candidates(study.model, study.measurement, [CATALOGUE["probe_lobing"]])
    (effect,), balls = found, study.plan.in_set("balls")
    assert not untestable
    assert effect.key == "probe_lobing balls"
    column = effect.response(study.plan, {})["tool.X", "radius"]
    np.testing.assert_allclose(np.asarray(column)[balls], np.cos(phi))
    wide = dataclasses.replace(effect, given=(("radius", 10.0, 0.0),))
    zero = np.zeros(len(study.model.entries))
    before = predict(study.model, study.plan, zero)
    after = predict(study.model.with_effects(wide), study.plan, np.r_[zero, np.zeros(3)])
    off = np.asarray(after - before)
    assert not off[~balls].any()
    np.testing.assert_allclose(off[balls, :2], 1e-5 * np.c_[np.cos(phi), np.sin(phi)], atol=1e-9)


def test_from_python(clean):
    """The same without a study file, from the data sets themselves."""
    study = clean[1]
    members = {one.name: DataSet(one.instrument, one.plan) for one in study.sets}
    instrument, plan = several(members)
    readings = instrument.padded([one.readings for one in study.sets])
    np.testing.assert_array_equal(readings, study.measurement.readings)
    assert instrument.ports == study.instrument.ports and plan.sets == ("tracker", "balls")
    part = plan.part("balls")
    assert part.rows == study.sets[1].plan.rows and part.sets == ()
    assert set(part.groups) == {"pose", "ball"}
    np.testing.assert_array_equal(part.covariate("tilt"), study.sets[1].plan.covariate("tilt"))
    assert of_set("balls", "tilt") in plan.covariates
    with pytest.raises(ValueError, match="at least one"):
        several({})


def test_rows_of_others_are_in_no_group():
    """Where the middle of a circle is does not depend on what other instruments measured where."""
    own = load_study(FOLDER / "start" / "r_test")
    plan = own.plan.take(np.arange(0, own.plan.rows, 4))
    away = plan.with_position(np.asarray(plan.position) + [0.3, -0.2, 0.1])
    sets = {name: DataSet(own.instrument, p) for name, p in (("here", plan), ("away", away))}
    _, joint = several(sets)
    matrix = ProbeMatrix(sigma=1e-4)
    for name, one in sets.items():
        found = OfDataSet.of(matrix, name).response(joint, {})
        for (port, amplitude), column in matrix.response(one.plan, {}).items():
            got = np.asarray(found[of_set(name, port), amplitude])
            np.testing.assert_allclose(got[joint.in_set(name)], column, rtol=0, atol=1e-15)
            np.testing.assert_array_equal(got[~joint.in_set(name)], 0.0)
            assert np.abs(column).max() < 2.1e-3  # within the radius of the circles


# --- mistakes ------------------------------------------------------------------------------------


def swap(old, new):
    return lambda folder: (folder / "setup.toml").write_text(
        (folder / "setup.toml").read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8"
    )


def without_column(folder):
    path = folder / "balls.csv"
    path.write_text(path.read_text(encoding="utf-8").replace("y_mm", "why_mm", 1), encoding="utf-8")


def without_readings(folder):
    path = folder / "tracker.csv"
    rows = [line.split(",")[:-3] for line in path.read_text(encoding="utf-8").splitlines()]
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")


def unknown_ball(folder):
    path = folder / "balls.csv"
    head, first, *rest = path.read_text(encoding="utf-8").splitlines()
    cells = first.split(",")
    cells[head.split(",").index("ball")] = "99"
    path.write_text("\n".join([head, ",".join(cells), *rest]) + "\n", encoding="utf-8")


def again(file, copied=False):
    """The data set of the tracker once more, from `file`."""

    def spoil(folder):
        setup = folder / "setup.toml"
        head, row, rest = setup.read_text(encoding="utf-8").split("[[data]]\n")
        more = row.replace('"tracker"', '"more"').replace('"tracker.csv"', f'"{file}"')
        setup.write_text("[[data]]\n".join([head, row, more, rest]), encoding="utf-8")
        if copied:
            shutil.copy(folder / "tracker.csv", folder / file)

    return spoil


TWICE = "setup.toml, key data.1.file: found "
MISTAKES = {
    "a table twice": (again("tracker.csv"), f"{TWICE}'tracker.csv' a second time"),
    "a table by two names": (
        again("./tracker.csv"),
        f"{TWICE}'./tracker.csv', the same as 'tracker.csv'",
    ),
    "a copy": (again("more.csv", True), f"{TWICE}'more.csv', the same as 'tracker.csv'"),
    "two of one name": (swap('name = "balls"', 'name = "tracker"'), "setup.toml, key data.1.name"),
    "name of an axis": (swap('name = "balls"', 'name = "Y"'), "setup.toml, key data.1.name"),
    "name with a colon": (swap('name = "balls"', 'name = "b:1"'), "setup.toml, key data.1.name"),
    "no name": (swap('name = "balls"\n', ""), "setup.toml, key data.1.name: found nothing"),
    "no file": (swap('file = "balls.csv"\n', ""), "setup.toml, key data.1.file: found nothing"),
    "missing file": (lambda f: (f / "balls.csv").unlink(), "balls.csv, file: found no such file"),
    "both": (
        swap("[model.geometric]", '[instrument]\nkind = "r_test"\n[model.geometric]'),
        "setup.toml, key instrument: found an [instrument] together with [[data]]",
    ),
    "axis missing": (without_column, "balls.csv, column y_mm: found no such column"),
    "unknown key": (
        swap("probe_sigma_um", "probe_sigma_mm"),
        "setup.toml, key data.1.instrument.probe_sigma_mm: found the unknown key 'probe_sigma_mm' "
        "(did you mean 'probe_sigma_um'?)",
    ),
    "unknown key of a row": (
        swap('file = "balls.csv"', 'file = "balls.csv"\nfiel = 1'),
        "setup.toml, key data.1.fiel: found the unknown key 'fiel' (did you mean 'file'?)",
    ),
    "unknown instrument": (
        swap('kind = "ball_array"', 'kind = "ball_aray"'),
        "setup.toml, key data.1.instrument.kind: found the unknown instrument",
    ),
    "no instrument": (
        swap("[data.instrument]", "[data.instrumnt]"),
        "setup.toml, key data.0.instrumnt: found the unknown key",
    ),
    "a plan among data": (without_readings, "tracker.csv, header: found no column of readings"),
    "an unknown ball": (unknown_ball, "balls.csv, row 1 (line 2), column ball: found 99"),
}


@pytest.mark.parametrize("spoil, message", MISTAKES.values(), ids=MISTAKES.keys())
def test_every_mistake_is_told_by_file_and_key(clean, tmp_path, spoil, message):
    folder = tmp_path / "study"
    shutil.copytree(clean[0], folder)
    spoil(folder)
    with pytest.raises(StudyError) as error:
        load_study(folder)
    assert message in str(error.value)
    assert all(FORM.match(line) for line in str(error.value).splitlines())


def test_an_empty_list_is_no_study(clean, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(clean[0], folder)
    text = (folder / "setup.toml").read_text(encoding="utf-8")
    start, end = text.index("[[data]]"), text.index("[model.geometric]")
    (folder / "setup.toml").write_text("data = []\n" + text[:start] + text[end:], encoding="utf-8")
    with pytest.raises(StudyError, match=r"setup\.toml, key data: found no row"):
        load_study(folder)


def test_what_takes_one_data_set_only_says_so(clean):
    with pytest.raises(StudyError, match=r"setup\.toml, key data: found 2 \[\[data\]\] rows"):
        clean[1].single  # noqa: B018


# --- before measuring ----------------------------------------------------------------------------


@pytest.mark.campaign
def test_every_table_is_filled(clean, tmp_path):
    """Both instruments measure the same machine, and a clock keeps its start: what is written is
    read as what was simulated, and a fit that knows the truth leaves the noise of either.
    """
    folder = tmp_path / "study"
    shutil.copytree(clean[0], folder)
    setup = folder / "setup.toml"
    text = setup.read_text(encoding="utf-8")
    later = 'file = "balls.csv"\nstart_s = 20000.0'
    setup.write_text(text.replace('file = "balls.csv"', later), encoding="utf-8")
    study = load_study(folder)
    place = study.model.setup(study.plan)
    texts = (
        "drift:Y:component=EYY,rate_EYY_um_per_h=30",
        "encoder_eccentricity:azimuth:data_set=tracker",
    )
    effects = [parse_with(one, study.catalogue, place, study.files) for one in texts]
    made = write_simulated(study, tmp_path / "made", effects=effects, seed=2)
    again = load_study(tmp_path / "made")
    np.testing.assert_allclose(again.measurement.readings, made.measurement.readings, atol=1e-10)
    np.testing.assert_allclose(again.plan.position, made.measurement.plan.position, atol=1e-10)
    for name in ("t", "T_Y", "dir_X"):
        np.testing.assert_allclose(again.plan.covariates[name], study.plan.covariates[name])
    assert again.plan.covariates["t"][again.plan.in_set("balls")].min() > 20000.0
    told = json.loads((tmp_path / "made" / "truth.json").read_text(encoding="utf-8"))
    assert [e["effect"] for e in told["undeclared"]] == ["drift", "encoder_eccentricity"]
    assert "tracker" in told["undeclared"][1]["placement"]
    assert {"t", "T_Y"} <= set(again.check.plan.covariates)
    np.testing.assert_allclose(
        again.check.tool_point, made.tool_points(again.check.plan), atol=1e-10
    )
    fit = identify(made.model, again.measurement, room=ROOM)
    for rows in study.plan.parts.values():
        chi2, dof = fit.chi2_and_dof(rows)
        assert chi2 / dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / dof))


@pytest.mark.thorough
def test_what_both_will_tell_is_known_before(clean):
    """The GUM through the joint identification is the posterior of all whitened readings, and every
    data set has noise of its own among its sources.
    """
    model, plan = clean[1].model, clean[1].plan
    pair = virtual_pair(model, model, plan)
    found = linearised(pair, [ParameterErrors().measure(pair)]).budget
    theta = np.zeros(len(model.entries))
    fit = identify(model, Measurement(plan, np.asarray(predict(model, plan, theta))), room=ROOM)
    normal = fit.jacobian.T @ fit.jacobian + np.diag(fit.precision)
    step = np.array([e.parameter.step / e.parameter.si for e in model.entries])
    np.testing.assert_allclose(found.u, step * np.sqrt(np.diag(np.linalg.inv(normal))), rtol=1e-5)
    assert [name for name in found.source.labels if name.startswith("noise")] == [
        f"noise: {name}"
        for name in ("tracker range", "tracker azimuth", "tracker elevation",
                     "balls X", "balls Y", "balls Z")
    ]  # fmt: skip


def test_the_oracle_writes_one_machine(clean):
    """Both tables are of one machine: else nothing here would mean anything."""
    first, second = (as_study(case) for case in both(5).values())
    assert first.setup["machine"] == second.setup["machine"]
    one, other = both(5).values()
    assert one.machine.coefficients() == other.machine.coefficients()


def test_check_points_of_another_tool_are_told():
    def said(aligned, raw):
        of = None if raw is None else Rms(raw, 0.5)
        after = Errors(Rms(aligned, 0.5), of, Rms(5.0, 0.5), Rms(5.0, 0.5), 1.0)
        return _elsewhere(SimpleNamespace(errors={"after": after}))

    (told,) = said(3.0, 150_000.0)
    assert "common offset of 150 mm" in told and "after alignment" in told
    # A machine's own errors, an arm before its calibration, and no check points in its frame.
    assert said(3.0, 1_500.0) == said(9_000.0, 20_000.0) == said(3.0, None) == []


def test_an_alignment_of_few_points_is_told():
    """White errors of n points are sqrt(1 - 6 / 3n) as large after alignment as before."""

    def said(count):
        rows = SimpleNamespace(plan=SimpleNamespace(rows=count))
        return _few_check_points(SimpleNamespace(check=rows))

    (told,) = said(3)
    assert "only 3 check points" in told and "to their 9 coordinates" in told
    assert said(10) == _few_check_points(SimpleNamespace(check=None)) == []
    rng = np.random.default_rng(0)
    for count in (3, 4, 6):
        points = rng.uniform(-0.3, 0.3, (count, 3))
        errors = 1e-6 * rng.standard_normal((400, count, 3))
        left = [(align_rigid(points, e) ** 2).sum() / (e**2).sum() for e in errors]
        assert np.mean(left) == pytest.approx(1.0 - 6.0 / (3.0 * count), abs=0.03)
