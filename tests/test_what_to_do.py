"""What an effect does at the tool point, and what the report says about it."""

import numpy as np
import pytest

from oracle import make_case, write_study
from vcal import CATALOGUE, identify, load_study
from vcal.effects.reversal import Backlash
from vcal.effects.tracker import RangeScale
from vcal.geometry.effect_displacements import effect_displacements, reach


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reach") / "study"
    effect = {"effect": "backlash", "axis": "Y", "size_um": 30.0}
    study = load_study(write_study(folder, make_case("laser_tracker", seed=4, effects=[effect])))
    setup = study.model.setup(study.measurement.plan)
    own = [e for e in Backlash.candidates(setup) if e.placement == "Y"]
    own += [e for e in RangeScale.candidates(setup)]
    return identify(study.model.with_effects(*own), study.measurement)


@pytest.mark.thorough
def test_a_reversal_error_moves_the_tool_by_half_of_it(fit):
    place = next(i for i, e in enumerate(fit.model.effects) if e.key == "backlash Y")
    (value,) = (value for _, _, value, _ in fit.values_of(place))
    assert value == pytest.approx(30.0, abs=2.0)
    moved = 1e6 * effect_displacements(fit, place)
    way = np.asarray(fit.measurement.plan.covariate("dir_Y"))
    # The axis moves along Y, up to a squareness; whether it carries tool or workpiece decides the
    # sign.
    assert np.abs(moved[:, [0, 2]]).max() < 0.01
    assert np.abs(np.abs(moved[:, 1]) - 0.5 * value * np.abs(way)).max() < 0.01
    distance = np.abs(0.5 * value * (way - way.mean()))
    found = reach(fit, place)
    assert 1e6 * found.largest == pytest.approx(distance.max(), abs=0.01)
    assert 1e6 * found.rms == pytest.approx(np.sqrt(np.mean(distance**2)), abs=0.01)


def test_an_effect_of_the_instrument_does_not_move_the_tool(fit):
    place = next(i for i, e in enumerate(fit.model.effects) if e.key == "range_scale")
    assert reach(fit, place) == (0.0, 0.0)


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_has_a_remedy(name):
    remedy = CATALOGUE[name].remedy
    assert remedy[:1].isupper() and remedy.endswith(".")
    assert CATALOGUE[name].where == "machine" or "machine" in remedy or "clamping" in remedy
