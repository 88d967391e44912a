"""Hold-outs: what they are, and what the fitted rows predict."""

import math

import numpy as np
import pytest

from arms import COLUMN, poses, write_arm
from vcal.errors import StudyError
from vcal.identification.predictable import unpredictable, unpredictable_by, unpredictable_of
from vcal.loop.close_loop import close_loop
from vcal.loop.weighing.cross_validation import folds_of, held_apart, heldout_rms
from vcal.study.study import load_study

ARM = COLUMN[1:]


def turned(count, upright):
    """Poses of the arm, the first `upright` of which keep the axis of the last joint vertical."""
    q = poses(ARM, count, seed=4)
    q[:upright, 3] = 0.0
    q[:upright, 4] = math.pi / 2.0 - q[:upright, 1] - q[:upright, 2]
    q[upright:, 3] = 0.0
    q[upright:, 4] = math.pi / 2.0 - q[upright:, 1] - q[upright:, 2] + 1.5
    # Upright to a tenth of a degree, so that a fit exists.
    q[:upright, 3:5] += 2e-3 * np.random.default_rng(6).standard_normal((upright, 2))
    return q


@pytest.fixture(scope="module")
def last_differ(tmp_path_factory):
    """An arm of 100 poses whose tool keeps its direction in the first 85: there, the height of the
    station and that of the reflector are one parameter.
    """
    q = turned(100, 85)
    return write_arm(
        tmp_path_factory.mktemp("last") / "s",
        ARM,
        q,
        extra={
            "t_s": np.arange(100.0),
            "run": np.arange(100) // 20,
            "room_degC": 20.0 + (np.arange(100) % 4),
        },
        reflector=np.array([0.0, 0.0, 0.12]),
    )  # fmt: skip


@pytest.mark.slow
def test_a_default_that_cannot_be_predicted_is_replaced(last_differ):
    study = load_study(last_differ)
    chosen = study.measurement.holdout
    assert chosen is not None and chosen.words == "a random 20 %"
    assert chosen.apart.sum() == 20 and not (chosen.apart[-20:]).all()
    assert "rows" in chosen.caution and "86 to 100" in chosen.caution
    assert "station Z and tool_points 1.Z" in chosen.caution
    result = close_loop(
        study.model, study.measurement, effects=["backlash"], draws=25, max_effects=0
    )
    assert chosen.caution in result.notes
    assert result.errors["after"].heldout.value < 60.0


def test_a_hold_out_of_the_user_is_followed_and_its_fault_is_said(last_differ):
    study = load_study(last_differ, {"holdout.kind": "last"})
    chosen = study.measurement.holdout
    np.testing.assert_array_equal(np.flatnonzero(chosen.apart), np.arange(80, 100))
    np.testing.assert_array_equal(np.flatnonzero(chosen.unpredicted), np.arange(85, 100))
    result = close_loop(
        study.model, study.measurement, effects=["backlash"], draws=25, max_effects=0
    )
    (said,) = (note for note in result.notes if "held-out rows" in note)
    assert said.startswith("15 of the 20 held-out rows (86 to 100) cannot be predicted")
    assert "station Z and tool_points 1.Z" in said and "leaves them out" in said
    # The other five are predicted, and alone count.
    assert result.errors["after"].heldout.value < 80.0
    assert held_apart(study.model, study.measurement)[1].sum() == 20
    assert folds_of(study.model, study.measurement)[1].sum() == 5


@pytest.mark.thorough
def test_the_choice_of_the_instrument_stays_where_it_is_predicted(tmp_path):
    study = load_study(write_arm(tmp_path / "s", ARM, turned(80, 0)))
    assert study.measurement.holdout is None
    _, apart = held_apart(study.model, study.measurement)
    np.testing.assert_array_equal(np.flatnonzero(apart), np.arange(64, 80))


@pytest.mark.parametrize(
    ("keys", "folds", "apart"),
    [
        ({"kind": "random", "share": 0.3, "seed": 3}, 1, 30),
        ({"kind": "blocks", "blocks": 10}, 10, 0),
        ({"kind": "none"}, 5, 0),
        ({"kind": "run"}, 5, 0),
        ({"kind": "column", "column": "room_degC"}, 4, 0),
        ({"kind": "last", "share": 0.1}, 1, 10),
    ],
)
def test_kinds(last_differ, keys, folds, apart):
    study = load_study(last_differ, {f"holdout.{k}": v for k, v in keys.items()})
    chosen = study.measurement.holdout
    assert len(np.unique(chosen.folds[chosen.folds >= 0])) == folds
    assert chosen.apart.sum() == apart
    if keys["kind"] == "run":
        np.testing.assert_array_equal(chosen.folds, np.arange(100) // 20)
    if keys["kind"] == "random":
        other = load_study(last_differ, {"holdout.kind": "random", "holdout.share": 0.3})
        assert (other.measurement.holdout.apart != chosen.apart).any()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"kind": "sometimes"}, ("holdout.kind", "random")),
        ({"kind": "column"}, ("without column", "q1_cmd_mm")),
        ({"kind": "column", "column": "room"}, ("holdout.column", "'room'", "room_degC")),
        ({"kind": "column", "column": "t_s"}, ("100 values in 100 rows",)),
        ({"kind": "last", "seed": 3}, ('seed with kind = "last"',)),
        ({"kind": "last", "share": 0.9}, ("holdout.share", "0.5")),
    ],
)
def test_wrong_hold_outs(last_differ, keys, words):
    with pytest.raises(StudyError) as refused:
        load_study(last_differ, {f"holdout.{k}": v for k, v in keys.items()})
    assert all(word in str(refused.value) for word in words), str(refused.value)


@pytest.mark.thorough
def test_rows_that_are_fitted_must_determine_what_has_no_prior(tmp_path):
    """All poses but the held-out ones are one pose."""
    q = turned(30, 0)
    q[:24] = q[0]
    folder = write_arm(tmp_path / "s", ARM, q, more='[holdout]\nkind = "last"')
    with pytest.raises(StudyError, match="24 rows that are fitted, without 6 held-out ones") as no:
        load_study(folder)
    assert "choose another kind in [holdout]" in str(no.value)


def test_an_instrument_without_rows_apart_rotates(small_tracker_study):
    study = load_study(small_tracker_study, {"holdout.kind": "random"})
    chosen = study.measurement.holdout
    assert not chosen.apart.any() and len(np.unique(chosen.folds)) == 5
    assert load_study(small_tracker_study).measurement.holdout is None


def test_a_pose_of_an_artefact_is_not_divided(small_ball_study):
    study = load_study(small_ball_study, {"holdout.kind": "random", "holdout.share": 0.25})
    pose, folds = np.asarray(study.plan.groups["pose"]), study.measurement.holdout.folds
    assert all(len(np.unique(folds[pose == k])) == 1 for k in np.unique(pose))


def test_predictive_variance_against_numpy():
    """J H^-1 J' by a direct inverse, of folds and of rows that are never fitted."""
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((40, 2, 3))
    jacobian[:, :, 2] = jacobian[:, :, 1]  # one direction that all but the last rows leave open
    jacobian[35:, :, 2] *= -1.0
    precision = np.array([1.0, 1e-4, 1e-4])
    apart = np.arange(40) >= 35
    folds = np.full(40, -1)
    found = unpredictable(jacobian, precision, ["a", "b", "c"], folds, apart, np.ones(40, bool))
    rest = jacobian[:35].reshape(-1, 3)
    inverse = np.linalg.inv(rest.T @ rest + np.diag(precision))
    size = np.einsum("nik,kl,nil->n", jacobian[35:], inverse, jacobian[35:]) / 2.0
    assert found.held == 5 and {*found.rows} == {*range(35, 40)}
    assert found.parameters == ("b", "c")
    assert found.ratio == pytest.approx(math.sqrt(size.mean()), rel=1e-6)
    # With one such row among the fitted ones, the direction is known.
    apart[39] = False
    assert (
        unpredictable(jacobian, precision, ["a", "b", "c"], folds, apart, np.ones(40, bool)) is None
    )
    # A fold that rotates is predicted from all others.
    folds = np.where(np.arange(40) >= 35, 0, 1)
    none = np.zeros(40, bool)
    assert unpredictable(
        jacobian, precision, ["a", "b", "c"], folds, none, np.ones(40, bool)
    ).rows.size


def test_before_and_after_a_fit_agree(last_differ):
    study = load_study(last_differ, {"holdout.kind": "last"})
    folds, apart = held_apart(study.model, study.measurement)
    result = close_loop(
        study.model, study.measurement, effects=["backlash"], draws=25, max_effects=0
    )
    one = unpredictable_by(study.model, study.measurement, folds, apart)
    other = unpredictable_of(result.before, folds, apart)
    assert {*one.rows} == {*other.rows} and one.parameters == other.parameters
    assert other.ratio == pytest.approx(one.ratio, rel=0.5)
    assert math.isfinite(heldout_rms(result.before).value)
