"""Rows as they were taken, however the file is sorted."""

import jax
import numpy as np
import pytest

import vcal
from vcal import Measurement, close_loop
from vcal.demo import FOLDER
from vcal.machine.plan import Plan, joined
from vcal.model.simulate import simulate


@pytest.fixture(scope="module")
def study():
    return vcal.load_study(FOLDER / "setup.toml")


def test_data_set_by_data_set():
    """Each by its own clock, where it has one."""
    one = Plan(("X",), np.zeros((3, 1)), {"t": np.array([5.0, 1.0, 3.0])})
    two = Plan(("X",), np.ones((2, 1)), {})
    both = joined({"one": one, "two": two}, {"one": ("t",)})
    assert one.in_time(np.arange(3)).tolist() == [1, 2, 0]
    assert one.in_time(np.array([0, 2])).tolist() == [2, 0]
    assert both.in_time(np.arange(5)).tolist() == [1, 2, 0, 3, 4]


@pytest.mark.thorough
def test_the_last_readings_are_the_last_in_time(study):
    """Three that stay displaced to the end are a jump, and not stray, wherever they stand."""
    given = study.measurement.plan
    readings = np.array(simulate(study.model, given, jax.random.key(3)).measurement.readings)
    readings[np.argsort(given.values("t"))[-3:], 0] += 60e-6
    verdicts = []
    for rows in (np.arange(given.rows), np.random.default_rng(0).permutation(given.rows)):
        measurement = Measurement(given.take(rows), readings[rows])
        closure = close_loop(study.model, measurement, effects=["jump", "backlash"], draws=100)
        assert not closure.suspected
        verdicts.append((closure.verdict, [e.effect.key for e in closure.effects]))
    assert verdicts[0] == verdicts[1]
    assert verdicts[0][1] == ["jump tool"] or verdicts[0][0] == "unexplained"
