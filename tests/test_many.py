"""Closing the loop on large effects, and on many at once."""

import numpy as np
import pytest

from oracle import make_case, write_study
from vcal import CATALOGUE, close_loop, load_study
from vcal.loop.residuals.variance_components import components


def closed(folder, seed: int, *effects: dict, instrument: str = "laser_tracker", **options):
    plan = None if instrument == "laser_frame" else {"cycles": True}
    case = make_case(instrument, seed=seed, plan=plan, effects=effects)
    study = load_study(write_study(folder / "study", case))
    return close_loop(study.model, study.measurement, check=study.check, seed=seed, **options)


def play(axis: str) -> dict:
    return {"effect": "backlash", "axis": axis, "size_um": 12}


def tilt(axis: str, component: str) -> dict:
    return {"effect": "thermal_tilt", "axis": axis, "component": component, "urad_per_K": 40}


def cyclic(axis: str, amplitude: float) -> dict:
    return {"effect": "screw_cyclic", "axis": axis, "amplitude_um": amplitude, "pitch": 0.02}


@pytest.mark.thorough
@pytest.mark.parametrize(("seed", "amplitude"), [(1, 50.0), (2, 200.0)])
def test_a_large_cyclic_error_has_its_own_pitch(seed, amplitude, tmp_path):
    """Not an alias, of which less of the size has to be forgiven."""
    closure = closed(tmp_path, seed, cyclic("Y", amplitude))
    (found,) = closure.effects
    assert closure.verdict == "named"
    values = {name: value for name, value, *_ in found.parameters}
    assert found.effect.key == "screw_cyclic Y"
    assert values["pitch"] == pytest.approx(20.0, abs=0.01)
    assert values["sine"] == pytest.approx(amplitude, abs=1.0)
    before, after = closure.errors["uncompensated"].check, closure.errors["after"].check
    assert after.value < 0.05 * before.value


class Short(CATALOGUE["screw_cyclic"]):
    """A screw whose pitch is looked for beside the true one only."""

    name = "short"

    def scan(self, plan):
        travel = np.ptp(plan.x(self.placement))
        return {"pitch": 1.0 / (1.0 / 0.02 + np.array([0.15, 0.4, 0.65]) / travel)}


@pytest.mark.thorough
def test_a_pitch_at_the_end_of_what_is_looked_for_is_not_certain(tmp_path):
    closure = closed(tmp_path, 1, cyclic("Y", 8.0), effects=[Short], draws=200)
    (found, *_) = closure.effects
    assert (found.effect.key, found.status) == ("short Y", "ambiguous")
    assert "its pitch would have to lie within the searched range" in found.separation


@pytest.mark.campaign
def test_seven_effects_of_one_machine_are_all_named(tmp_path):
    """Each of them is little beside the six others, in lengths where its readings are the best."""
    reversal = {"effect": "angular_reversal", "axis": "X", "component": "C", "size_urad": 30}
    effects = (
        *map(play, "XYZ"), reversal, tilt("X", "B"), tilt("Y", "A"), cyclic("Z", 8.0)
    )  # fmt: skip
    closure = closed(tmp_path, 2, *effects, max_effects=8, draws=200)
    assert closure.verdict == "named"
    assert {found.effect.key for found in closure.effects} == {
        f"{effect['effect']} {effect['axis']}" for effect in effects
    }
    # What each of them may be instead is told beside all others, of which some came later.
    assert all(sum(p for *_, p in found.alternatives) < 0.05 for found in closure.effects)
    before, after = closure.errors["uncompensated"].check, closure.errors["after"].check
    assert after.value < 0.05 * before.value


@pytest.mark.thorough
def test_two_effects_that_hide_each_other_are_both_named(tmp_path):
    """Alone a warming-up of the machine describes more of them than either does."""
    head = {"effect": "head_expansion", "um_per_K": 1.4}
    closure = closed(tmp_path, 16, head, play("Z"), instrument="laser_frame", draws=200)
    assert closure.verdict == "named"
    found = {e.effect.key: {n: v for n, v, *_ in e.parameters} for e in closure.effects}
    assert set(found) == {"head_expansion", "backlash Z"}
    assert found["head_expansion"]["k"] == pytest.approx(1.4, abs=0.05)
    assert found["backlash Z"]["size"] == pytest.approx(12.0, abs=0.5)


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.campaign)])
@pytest.mark.thorough
def test_three_effects_that_hide_each_other_are_all_found(seed, tmp_path):
    """No two of them leave little enough to be told from noise."""
    head = {"effect": "head_expansion", "um_per_K": 1.4}
    lean = {"effect": "thermal_tilt", "axis": "Z", "component": "B", "urad_per_K": 25}
    closure = closed(tmp_path, seed, head, play("Z"), lean, instrument="laser_frame", draws=200)
    assert closure.verdict in ("named", "ambiguous")
    found = {e.effect.key: e for e in closure.effects}
    assert len(found) == 3
    assert found["head_expansion"].parameters[0][1] == pytest.approx(1.4, abs=0.06)
    assert found["backlash Z"].parameters[0][1] == pytest.approx(12.0, abs=0.5)
    (third,) = (e for key, e in found.items() if key not in ("head_expansion", "backlash Z"))
    assert "thermal_tilt Z" in (third.effect.key, *third.equivalent)


@pytest.mark.campaign
def test_four_large_effects_are_all_named(tmp_path):
    """Found one after the other, the first two of them while far more than noise is left."""
    effects = (
        {"effect": "cross_axis", "axis": "Y", "component": "Z", "other": "X", "size_um": 110},
        {"effect": "backlash", "axis": "Z", "size_um": 40},
        {"effect": "jump", "axis": "Z", "component": "X", "size_um": 37, "t0_s": 1254.0},
        tilt("X", "B"),
    )
    closure = closed(tmp_path, 2, *effects, draws=200)
    assert closure.verdict == "named"
    found = {name for e in closure.effects for name in (e.effect.key, *e.equivalent)}
    assert len(closure.effects) == 4
    assert {"cross_axis Y", "backlash Z", "jump tool", "thermal_tilt X"} <= found
    before, after = closure.errors["uncompensated"].check, closure.errors["after"].check
    assert after.value < 0.05 * before.value


@pytest.mark.campaign
@pytest.mark.parametrize("size", [30.0, 1000.0])
def test_a_ball_that_is_far_off_is_named(size, tmp_path):
    """It stretches what is declared of the machine far beyond its prior; that is no noise, and the
    p-value is none the worse for it.
    """
    ball = {"effect": "ball_error", "ball": 4, "vector_um": [size, -size / 2, size / 5]}
    closure = closed(tmp_path, 1, ball, instrument="ball_array", draws=200)
    assert closure.verdict == "named"
    (found,) = closure.effects
    assert found.effect.key == "ball_error ball 4"
    assert found.parameters[0][1] == pytest.approx(size, abs=4.0)
    assert closure.screenings[0].p_value < 1e-100
    assert components(closure.before).factor == pytest.approx(1.0, abs=0.1)
    assert closure.before.chi2 > (1e4 if size > 100.0 else 600.0)
