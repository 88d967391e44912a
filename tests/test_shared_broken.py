"""Studies that were once taken for good, or ended in a traceback, beside the checkout."""

from pathlib import Path

import pytest

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
