"""Rows that respond alike to a candidate, and are summed together in the screening of a plan."""

import dataclasses

import numpy as np
import pytest

import vcal
from joint import write_joint
from oracle import make_case, write_study
from vcal.effects import CATALOGUE
from vcal.loop.empirical.position import Kink, LocalBump
from vcal.loop.screening import score_test, sums
from vcal.loop.screening.candidates import candidates
from vcal.loop.screening.score_test import ScoreTest


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """Of points in equal steps of every axis, on a machine with backlash."""
    folder = tmp_path_factory.mktemp("grid")
    plan = {"shape": (15, 9, 9), "margin": 0.0, "jitter": 0.0}
    backlash = {"effect": "backlash", "axis": "X", "size_um": 6.0}
    write_study(folder, make_case("laser_tracker", seed=3, effects=[backlash], plan=plan))
    study = vcal.load_study(folder / "setup.toml")
    return vcal.identify(study.model, study.measurement)


@pytest.mark.parametrize("cls", [CATALOGUE["jump"], LocalBump, Kink], ids=lambda c: c.name)
def test_their_sums_are_those_of_all_rows(fit, monkeypatch, cls):
    tried, _ = candidates(fit.model, fit.measurement, [cls])
    assert tried
    found = []
    for least in (10**9, 1):
        monkeypatch.setattr(score_test, "_MANY_ROWS", least)
        state = ScoreTest(fit, 60, 0)
        alone = [state._rows_of(effect)[0] is state.rows for effect in tried]
        assert all(alone) if least > 1 else not any(alone)
        found.append(state.tests(tried))
    assert any(found[0])
    for one, other in zip(*found, strict=True):
        assert (one is None) == (other is None)
        if one is None:
            continue  # the model spans it
        np.testing.assert_array_equal(one.drops.rank, other.drops.rank)
        np.testing.assert_allclose(other.drops.stat, one.drops.stat, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.bayes, one.bayes, rtol=1e-9, atol=1e-9)
        for rank, largest in one.drops.null.items():
            np.testing.assert_allclose(other.drops.null[rank], largest, rtol=1e-3)


def test_rows_are_alike_where_all_columns_are_equal(fit):
    rows = ScoreTest(fit, 1, 0).rows
    n = len(rows.ports)
    first, second = np.arange(n) % 3, (np.arange(n) % 2) * 0.25
    members, groups = rows.alike([first, second])
    assert len(members) == 6 and groups.weights.sum() == n
    pairs = {(first[i], second[i]) for i in members}
    assert len(pairs) == 6
    assert rows.alike([np.arange(n)]) is None  # too many groups to save time
    assert rows.alike([]) is None


def test_the_tails_of_a_bump_are_zero(fit):
    """Numbers that single precision cannot hold would take a hundred times as long."""
    state = ScoreTest(fit, 1, 0)
    bumps, _ = candidates(fit.model, fit.measurement, [LocalBump])
    narrow = {"centre": np.array([0.0]), "width": np.array([1e-3])}
    ((_, _, phi),) = state.responses.of(bumps[0], narrow)
    assert np.count_nonzero(phi) < phi.size
    assert np.abs(phi[phi != 0.0]).min() >= 1e-30


def test_blocks_of_rows_add_up_in_several_data_sets(tmp_path, monkeypatch):
    """A block may have no row of a data set whose instrument has effects of its own."""
    case = make_case("laser_tracker", seed=3, plan={"shape": (12, 4, 4)})
    halves = {"s1": slice(0, 96), "s2": slice(96, None)}
    cases = {
        name: dataclasses.replace(case, data={k: v[rows] for k, v in case.data.items()})
        for name, rows in halves.items()
    }
    study = vcal.load_study(write_joint(tmp_path / "joint", cases) / "setup.toml")
    fit = vcal.identify(study.model, study.measurement)
    names = ("warm_up", "jump", "tracker_axes", "encoder_eccentricity", "lateral_reversal")
    tried, _ = candidates(fit.model, fit.measurement, [CATALOGUE[name] for name in names])
    assert {effect.placement.split()[0] for effect in tried} >= {"s1", "s2"}
    whole = ScoreTest(fit, 20, 0).tests(tried)
    monkeypatch.setattr(sums, "_ROOM", 0)
    monkeypatch.setattr(sums, "_BLOCK_ROWS", (31, 31))
    for one, other in zip(whole, ScoreTest(fit, 20, 0).tests(tried), strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_allclose(other.drops.stat, one.drops.stat, rtol=1e-8, atol=1e-8)


def test_blocks_of_rows_add_up(fit, monkeypatch):
    tried, _ = candidates(fit.model, fit.measurement, [CATALOGUE["warm_up"], LocalBump])
    whole = ScoreTest(fit, 60, 0).tests(tried)
    monkeypatch.setattr(sums, "_ROOM", 0)
    monkeypatch.setattr(sums, "_BLOCK_ROWS", (50, 50))
    assert any(whole)
    for one, other in zip(whole, ScoreTest(fit, 60, 0).tests(tried), strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_allclose(other.drops.stat, one.drops.stat, rtol=1e-9, atol=1e-9)
