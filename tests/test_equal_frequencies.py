"""Sums of waves of equally spaced frequencies, and the score test that uses them."""

import numpy as np
import pytest

import vcal
from oracle import make_case, write_study
from vcal.effects.cyclic import ScrewCyclic
from vcal.loop.screening import score_test
from vcal.numerics.equal_frequencies import EqualFrequencies


@pytest.mark.parametrize(("single", "error"), [(False, 1e-13), (True, 1e-6)])
@pytest.mark.parametrize("rows", [3, 4_000])
def test_sums_are_those_of_the_definition(single, error, rows):
    rng = np.random.default_rng(1)
    x, step, count = rng.uniform(-0.2, 0.7, rows), 0.28, 700
    weights = rng.standard_normal((rows, 3))
    waves = EqualFrequencies(x, 16 * step, step, count, single=single)
    half = rows // 2
    grid = waves.spread(slice(0, half), weights[:half])
    grid = grid + waves.spread(slice(half, rows), weights[half:])
    expected = np.exp(2j * np.pi * np.outer((16 + np.arange(count)) * step, x)) @ weights
    assert np.abs(waves.sums(grid) - expected).max() < error * np.abs(weights).sum()


def test_the_first_frequency_is_a_whole_multiple_of_the_step():
    with pytest.raises(ValueError, match=r"first: found 2\.5 steps, expected a whole number"):
        EqualFrequencies(np.arange(3.0), 2.5, 1.0, 10)


@pytest.mark.parametrize("jitter", [1.0, 0.0], ids=["scattered", "in equal steps"])
def test_the_score_test_of_screws_is_the_same(tmp_path, monkeypatch, jitter):
    """In equal steps, some waves are zero at every position, and others constant."""
    plan = {"shape": (21, 6, 5)} if jitter else {"shape": (21, 6, 5), "margin": 0.0, "jitter": 0.0}
    screw = {"effect": "screw_cyclic", "axis": "X", "amplitude_um": 3.0, "pitch_mm": 10.0,
             "phase": 0.3}  # fmt: skip
    case = make_case("laser_tracker", seed=5, effects=[screw], plan=plan)
    write_study(tmp_path, case)
    study = vcal.load_study(tmp_path / "setup.toml")
    fit = vcal.identify(study.model, study.measurement)
    screws = [ScrewCyclic(port=f"E{a}{a}", placement=a) for a in "XYZ"]
    assert all(s.tones(study.measurement.plan) is not None for s in screws)
    found = []
    for rows in (10**9, 1):
        monkeypatch.setattr(score_test, "_MANY_ROWS", rows)
        found.append(score_test.ScoreTest(fit, 50, 0).tests(screws))
    for one, other in zip(*found, strict=True):
        a, b = one.drops, other.drops
        np.testing.assert_array_equal(a.rank, b.rank)
        np.testing.assert_allclose(b.stat, a.stat, rtol=1e-8, atol=1e-7)
        np.testing.assert_allclose(b.amplitudes, a.amplitudes, rtol=1e-6, atol=1e-6)
        for r, largest in a.null.items():
            np.testing.assert_allclose(b.null[r], largest, rtol=1e-3)  # single precision
