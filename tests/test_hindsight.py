"""What an effect may be instead, weighed again beside what was found after it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from known import Known
from vcal import Measurement, identify
from vcal.loop.screening.score_test import ScoreTest
from vcal.loop.search.forward_selection import Added
from vcal.loop.search.search import Search, reweigh_rivals
from vcal.loop.search.state import State, fitted
from vcal.loop.weighing.rivals import Rival, refit_all
from vcal.loop.weighing.weighing import classes_of, weigh

INSTANCES = {"backlash": 3, "lateral_reversal": 6, "screw_other": 3}
"""How many places of each kind a round would have tried."""


@pytest.fixture(scope="module")
def tracker(tmp_path_factory) -> Known:
    return Known("laser_tracker", tmp_path_factory.mktemp("hindsight"))


@pytest.fixture(scope="module")
def measurement(tracker) -> Measurement:
    """With a backlash and a reversal error across another axis."""
    true = [
        tracker.effect("backlash:X:size_um=0.5"),
        tracker.effect("lateral_reversal:Y:size_EZY_um=30"),
    ]
    sigma = tracker.instrument.noise(tracker.plan, tracker.measurement.readings)
    noise = sigma * np.random.default_rng(5).standard_normal(sigma.shape)
    return Measurement(tracker.plan, tracker.readings(*true) + noise)


def bare(tracker: Known, text: str):
    return dataclasses.replace(tracker.effect(text), given=())


@pytest.fixture(scope="module")
def few(tracker):
    """Backlash, what it may be instead, and what is found after it."""
    texts = (
        "backlash:X:size_um=1",
        "backlash:Z:size_um=1",
        "lateral_reversal:Y:size_EZY_um=1",
    )
    return tuple(bare(tracker, text) for text in texts)


def rivals(tracker: Known, base, effects) -> list[Rival]:
    screen = ScoreTest(base, 20, 0)
    peaks = [test.peaks(1)[0] for effect in effects for test in screen.tests([effect])]
    return refit_all(base, peaks, INSTANCES, base.used, tracker.room)


def found(tracker: Known, base, effects, added) -> Added:
    """An effect as a round beside a fit would add it."""
    mine = rivals(tracker, base, effects)
    best = next(r for r in mine if r.effect is added)
    return Added(added, weigh(classes_of(base, mine), best), 1e-6, 0.1, 10.0)


def state_with(tracker: Known, measurement, *effects) -> State:
    return fitted(tracker.model.with_effects(*effects), measurement, None, tracker.room)


def told(weighed) -> dict[str, float]:
    return {f"{name} {place}": p for name, place, p in weighed.alternatives}


def test_rivals_are_weighed_as_if_what_was_found_later_had_been_declared(tracker, measurement, few):
    backlash, other, later = few
    bare_fit = identify(tracker.model, measurement, room=tracker.room)
    item = found(tracker, bare_fit, (backlash, other), backlash)
    state = state_with(tracker, measurement, backlash, later)
    again = reweigh_rivals(item, state, tracker.room)
    beside = identify(tracker.model.with_effects(later), measurement, room=tracker.room)
    declared = found(tracker, beside, (backlash, other), backlash).weighed
    assert again.probability == pytest.approx(declared.probability, abs=1e-3)
    assert told(again) == pytest.approx(told(declared), abs=1e-3)
    # And that is not what it was: the noise that was missing hid what tells the two apart.
    assert abs(again.probability - item.weighed.probability) > 0.02
    assert [e.key for e in again.best.fit.model.effects[-2:]] == [later.key, backlash.key]


def test_what_was_added_later_is_no_rival(tracker, measurement, few):
    backlash, _, later = few
    bare_fit = identify(tracker.model, measurement, room=tracker.room)
    item = found(tracker, bare_fit, (backlash, later), backlash)
    assert told(item.weighed)  # it was one in its round
    state = state_with(tracker, measurement, backlash, later)
    again = reweigh_rivals(item, state, tracker.room)
    assert (again.probability, again.alternatives, again.instead) == (1.0, [], ())


def test_nothing_is_weighed_again_where_nothing_came_later(tracker, measurement, few):
    backlash, other, later = few
    beside = identify(tracker.model.with_effects(later), measurement, room=tracker.room)
    item = found(tracker, beside, (backlash, other), backlash)
    state = state_with(tracker, measurement, later, backlash)
    assert reweigh_rivals(item, state, tracker.room) is item.weighed


def test_of_many_effects_those_are_looked_for_anew_that_their_rivals_outweigh(monkeypatch):
    run = Search(None, (), 0.01, 20, 0, 0, lambda text: None)
    items = [
        SimpleNamespace(k=k, weighed=SimpleNamespace(outweighed=k in (1, 4))) for k in range(7)
    ]
    looked: list[int] = []

    def step(state):
        run.refused = "something"  # type: ignore[assignment]

    def anew(state, item):
        looked.append(item.k)
        return state

    monkeypatch.setattr(run, "step", step)
    monkeypatch.setattr(run, "added", lambda state: items)
    monkeypatch.setattr(run, "weigh_again", lambda state: looked.append(-1))
    monkeypatch.setattr(run, "search_again", anew)
    reached: list[str] = []
    assert run.rounds("as it is", 16, reached.append) == "as it is"  # type: ignore[arg-type]
    assert looked == [-1, 1, 4]
