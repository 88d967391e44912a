"""The loop where sizes, plans or families are far from what is usual."""

import tempfile
from dataclasses import replace

import numpy as np
import pytest

from oracle import make_case, write_study
from oracle.kinematics import Smooth
from vcal import close_loop, identify, load_study
from vcal.geometry.compensated import compensated_points
from vcal.identification.robust import identify_robust
from vcal.loop.close_loop import Closure
from vcal.loop.residuals.outliers import outlying_rows
from vcal.loop.weighing.cross_validation import check_rms, predicted_rms
from vcal.machine.error_functions import Matern
from vcal.model.declared_noise import declared_whitener
from vcal.numerics.spatial import align_rigid


def study_of(case):
    with tempfile.TemporaryDirectory() as folder:
        write_study(folder, case)
        return load_study(folder)


def closed(case) -> Closure:
    study = study_of(case)
    return close_loop(study.model, study.measurement, check=study.check, draws=100)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "key", "size"),
    [
        (
            {"effect": "lateral_reversal", "axis": "Y", "component": "X", "size_um": -200},
            "lateral_reversal Y",
            -200.0,
        ),
        ({"effect": "frame_expansion", "axis": "Z", "um_per_K": 20.0}, "frame_expansion Z", 20.0),
    ],
)
def test_a_large_effect_has_its_name(effect, key, size):
    """Forty times what is expected of it: while it is missing the noise looks a hundred times as
    large, and what is expected then outweighs the readings.
    """
    found = closed(make_case("laser_frame", "w X b Y Z t", 12, [effect]))
    assert found.verdict == "named"
    (one,) = found.effects
    assert one.effect.key == key
    assert one.parameters[0][1] == pytest.approx(size, rel=0.02)
    assert found.errors["after"].chi2_per_dof < 1.3


@pytest.mark.campaign
def test_two_effects_that_are_the_same_are_told_whatever_sizes_are_expected():
    """An angle that acts through one lever is an offset: 60 urad are six times what is expected,
    the 9 um that they make only twice.
    """
    effect = {"effect": "angular_reversal", "axis": "Z", "component": "B", "size_urad": 60}
    found = closed(make_case("laser_tracker", "w X b Y Z t", 3, [effect]))
    (one,) = found.effects
    assert "angular_reversal Z" in [one.effect.key, *one.equivalent]


@pytest.mark.campaign
def test_three_balls_have_no_distance_across_their_plane():
    """The pose takes up all of it: 0 / 0 is no stray reading, and no singular matrix."""
    case = make_case("ball_array", seed=26, plan={"n_balls": 3, "repeats": 2})
    study = study_of(case)
    fit = identify(study.model, study.measurement)
    assert outlying_rows(fit, lambda: identify_robust(study.model, study.measurement)) == []
    close_loop(study.model, study.measurement, draws=50)


@pytest.mark.parametrize("smoothness", [0.3, 0.5, 1.0])
def test_a_smooth_family_follows_its_errors_to_a_few_parts_in_a_thousand(smoothness):
    family, x = Matern([0.0, 1.0], 1.0, smoothness), np.linspace(0, 1, 101)
    columns = np.asarray(family.functions(x))
    kernel = Smooth(1.0, 1.0, 1.0, smoothness).kernel(2 * x - 1, 2 * x - 1)
    assert np.diag(kernel - columns @ columns.T).mean() < 1.5e-5


# --- what looks the same, or shows too little -----------------------------------------------------


@pytest.mark.thorough
def test_a_frame_that_is_held_at_its_end():
    """It grows by all of k at the far end and by nothing at the near one, or the other way."""
    for held, sign in ((0.0, 0.5), (1.0, -0.5)):
        grown = {"effect": "frame_expansion", "axis": "X", "um_per_K": 1.3, "held": held}
        found = closed(make_case("laser_frame", "w X b Y Z t", 12, [grown]))
        (one,) = found.effects
        assert (found.verdict, one.effect.key) == ("named", "frame_expansion X")
        (_, k, _, u), (_, shift, _, u_shift) = one.parameters
        assert abs(k - 1.3) <= 3.0 * u and abs(shift - sign * 1.3) <= 3.0 * u_shift
        assert found.errors["after"].chi2_per_dof < 1.3


@pytest.mark.thorough
def test_a_frame_of_one_material():
    """It grows alike in all directions from one corner: one effect, not three."""
    case = make_case("laser_frame", "w X b Y Z t", 12)
    axes = study_of(case).model.chain
    grown = [
        {
            "effect": "frame_expansion", "axis": joint.name, "held": 0.0,
            "um_per_K": 2.0 * float(np.ptp(joint.travel)),
        }
        for joint in axes.joints
    ]  # fmt: skip
    found = closed(make_case("laser_frame", "w X b Y Z t", 12, grown))
    (one,) = found.effects
    assert (found.verdict, one.effect.key) == ("named", "frame_growth")
    _, alpha, _, u = one.parameters[0]
    assert abs(alpha - 2.0) <= 3.0 * u
    assert found.errors["after"].chi2_per_dof < 1.3


@pytest.mark.thorough
def test_a_station_that_is_displaced_at_once_is_not_taken_for_the_tool():
    """Where nothing turns the two are the same to all readings, though not at the check points:
    predicted is the average of both, which errs by no more than the worse of them.
    """
    moved = {"effect": "station_jump", "translation_um": [0, 12, 0], "t0": 1500.0}
    found = closed(make_case("laser_tracker", "w X b Y Z t", 3, [moved]))
    (one,) = found.effects
    assert one.effect.name == "jump" and one.placement == "frame|tool"
    before, after = (found.errors[name].check for name in ("before", "after"))
    assert after.value - before.value < 2.0 * after.u
    (both,) = [alternatives for alternatives in found.alternatives if alternatives.others]
    assert both.averaged
    check = study_of(make_case("laser_tracker", "w X b Y Z t", 3, [moved])).check
    chosen = check_rms(found.after, check)[0].value
    share = sum(probability for probability, _ in both.others)
    alone = replace(both, others=tuple((p / share, fit) for p, fit in both.others))
    other = check_rms(found.after, check, [alone])[0].value
    assert after.value <= max(chosen, other) * (1.0 + 1e-9)


def test_what_the_readings_do_not_show_is_told_at_the_check_points():
    """A range that is wrong in proportion passes for the scales of the three axes."""
    said = "predicted from the declared and identified errors"
    for effects in ([], [{"effect": "range_scale", "um_per_m": 12.0}]):
        case = make_case("laser_tracker", "w X b Y Z t", 3, effects)
        study = study_of(case)
        found = close_loop(
            study.model, study.measurement, check=study.check, draws=50, effects=["backlash"]
        )
        assert any(said in note for note in found.notes) == bool(effects)
        foretold = predicted_rms(found.after, study.check)
        aligned = found.errors["after"].check
        assert (aligned.value < 1.5 * foretold) == (not effects)
    # What is expected of errors that are drawn from the posterior.
    points, jacobian = compensated_points(found.after, study.check.plan)
    root = np.linalg.cholesky(found.after.covariance)
    drawn = root @ np.random.default_rng(0).standard_normal((len(root), 1000))
    left = align_rigid(points, jacobian @ drawn)
    expected = np.sqrt((left**2).sum((0, 1)).mean() / len(points)) * 1e6
    assert foretold == pytest.approx(expected, rel=0.03)


@pytest.mark.thorough
def test_a_description_takes_no_more_than_it_does():
    """Of chi-square beyond the declared noise, however large the noise that it leaves: of two dents
    it describes one.
    """
    dent = {"effect": "dent", "component": "Z", "sigma_mm": 60.0}
    both = [
        dent | {"axis": "X", "at_mm": 600.0, "depth_um": 18.0},
        dent | {"axis": "Y", "at_mm": 300.0, "depth_um": 15.0},
    ]
    found = closed(make_case("laser_tracker", "w X b Y Z t", 6, both))
    what = found.unexplained
    assert what is not None and what.empirical is not None
    with_it, without = what.empirical.fit, found.after
    whitener = declared_whitener(without.model, without.measurement)

    def chi2(fit):
        return (np.einsum("nij,nj->ni", whitener, fit.residual)[fit.used] ** 2).sum()

    share = (chi2(without) - chi2(with_it)) / (chi2(without) - without.dof)
    assert 0.3 < share < 0.9
    assert what.share_of_variance == pytest.approx(share, abs=0.05)
    assert sum(found.variance.values()) == pytest.approx(1.0)
