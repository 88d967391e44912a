"""The loop where sizes, plans or families are far from what is usual."""

import tempfile

import numpy as np
import pytest

from oracle import make_case, write_study
from oracle.kinematics import Smooth
from vcal import close_loop, identify, load_study
from vcal.basis import Matern
from vcal.loop.close_loop import Closure
from vcal.loop.stray import stray_rows
from vcal.robust import identify_robust


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
    assert stray_rows(fit, lambda: identify_robust(study.model, study.measurement)) == []
    close_loop(study.model, study.measurement, draws=50)


@pytest.mark.parametrize("smoothness", [0.3, 0.5, 1.0])
def test_a_smooth_family_follows_its_errors_to_a_few_parts_in_a_thousand(smoothness):
    family, x = Matern([0.0, 1.0], 1.0, smoothness), np.linspace(0, 1, 101)
    columns = np.asarray(family.functions(x))
    kernel = Smooth(1.0, 1.0, 1.0, smoothness).kernel(2 * x - 1, 2 * x - 1)
    assert np.diag(kernel - columns @ columns.T).mean() < 1.5e-5
