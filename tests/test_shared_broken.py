"""Studies that were once taken for good, or ended in a traceback, beside the checkout."""

import re
from pathlib import Path

import pytest

import vcal
from vcal.errors import StudyError
from vcal.loop.residuals.times import backwards
from vcal.study import load_study

BROKEN = Path(__file__).resolve().parents[2] / "shared" / "data" / "broken"
REFUSED = {
    "arm_q1_sign": "joint",
    "deep_key": "a key of more than 16 levels",
    "effects_file_runs": "--trust",
    "fourier_n1_1e9": "column n1",
    "frame_dead_u_channel": "a channel that never changes",
    "hex_integer": "a whole number of",
    "rotary_axis_reversed": "c_deg",
}
pytestmark = [
    pytest.mark.practice,
    pytest.mark.skipif(not BROKEN.is_dir(), reason="no shared/ beside the checkout"),
]


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    with pytest.raises(StudyError) as caught:
        load_study(BROKEN / name)
    assert REFUSED[name] in str(caught.value) and len(str(caught.value)) <= 1500


def test_an_arm_with_a_link_in_metres():
    with pytest.raises(StudyError, match="joint.1|data.csv"):
        load_study(BROKEN / "arm_link_in_metres", ["machine.joint.1.a_mm=0.27"])


def test_times_that_run_backwards_are_said():
    (said,) = backwards(load_study(BROKEN / "time_backwards").plan)
    assert "t_s runs backwards" in said


def test_control_characters_are_escaped():
    study = load_study(BROKEN / "terminal_escape")
    names = [study.name, *study.plan.covariates, *study.sets[0].table.header]
    assert all(name.isprintable() for name in names)


def closed(name):
    study = load_study(BROKEN / name)
    options = study.options
    return vcal.close_loop(
        study.model, study.measurement, check=study.check, effects=study.tried,
        draws=options.draws, seed=options.seed, alpha=options.alpha,
    )  # fmt: skip


@pytest.mark.thorough
def test_ranges_of_another_unit_are_said_to_be_impossible():
    closure = closed("range_scaled_1.01")
    assert "not for certain" in closure.sentence
    (note,) = (note for note in closure.notes if note.startswith("range_scale"))
    assert "times the expected size" in note and "compare the units" in note


@pytest.mark.thorough
def test_temperatures_with_another_zero_leave_no_wrong_name_for_certain():
    closure = closed("temperature_zero")
    assert closure.verdict != "named"
    (one,) = closure.alternatives
    keys = {e.key for fit in (one.found, *(f for _, f in one.others)) for e in fit.model.effects}
    assert "thermal_tilt Y" in keys  # the right one is among them


@pytest.mark.thorough
def test_a_pitch_that_the_plan_aliases_is_a_class_of_pitches():
    closure = closed("aliased_pitch")
    (note,) = (note for note in closure.notes if "gives the same readings" in note)
    pitches = [float(p) for p in re.findall(r"[\d.]+(?=,| mm)", note.split("a pitch of")[1])]
    assert 10.0 in pitches and 67.16 in pitches
    before, after = closure.errors["before"].check, closure.errors["after"].check
    assert after.value < before.value + after.u
