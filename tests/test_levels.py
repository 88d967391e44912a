"""Two-level Monte Carlo against exact draws, closed forms and its own standard errors."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from known import Known
from vcal import Prior, StudyError
from vcal.distributions import Uniform
from vcal.effects.registry import CATALOGUE
from vcal.uncertainty import (
    ErrorMotionErrors,
    ParameterErrors,
    VolumetricErrors,
    monte_carlo,
    two_level,
    virtual_pair,
)
from vcal.uncertainty.levels import LinearDraws, _Statistics


@pytest.fixture(scope="module")
def tracker(tmp_path_factory):
    return Known("laser_tracker", tmp_path_factory.mktemp("levels"))


def with_prior(effect, prior):
    """The effect with a distribution of one of its parameters."""
    return dataclasses.replace(effect, given=(), priors=(prior,))


@pytest.mark.thorough
def test_agrees_with_exact_draws(tracker):
    """With a backlash that is not fitted and uniform, scatter of every position, and results that
    are no linear function of the parameters.
    """
    play = with_prior(tracker.effect("backlash:Y:size_um=1"), Prior("size", Uniform(-20.0, 20.0)))
    setup = tracker.setup
    scatter = next(e for e in CATALOGUE["repeatability"].candidates(setup) if e.placement == "X")
    truth = tracker.model.with_effects(play, scatter)
    points = tracker.plan.take(np.arange(0, tracker.plan.rows, 12))
    quantities = (ParameterErrors(), ErrorMotionErrors(nodes=2), VolumetricErrors(points))
    options = {"quantities": quantities}
    found = two_level(truth, tracker.model, tracker.plan, draws=10_000, seed=1, **options)
    done = monte_carlo(truth, tracker.model, tracker.plan, draws=10_000, seed=2, **options)
    assert found.labels == done.quantities and found.failed == 0
    assert found.explained.min() > 0.999 and found.exact >= 2000 and found.linear >= 10_000
    exact, n = done.ensemble, done.ensemble.draws
    at = [exact.index(label) for label in found.labels]
    values = exact.values[:, at]
    # Standard errors of so many exact draws: those of the mean, and of u by the fourth moment.
    u = values.std(0, ddof=1)
    of_u = np.sqrt(((values - values.mean(0)) ** 2).var(0) / n) / (2 * u)
    for name, value, error in (("mean", values.mean(0), u / np.sqrt(n)), ("u", u, of_u)):
        own = getattr(found, f"error_of_{name}")
        assert (own < 1.1 * error).all(), name
        z = (getattr(found, name) - value) / np.hypot(own, error)
        assert np.abs(z).max() < 4.5 and np.sqrt((z**2).mean()) < 1.5, name
    for name, p in (("low", 0.025), ("high", 0.975)):
        # The share of the exact draws below the end, against the binomial distribution.
        below = (values <= getattr(found, name)).mean(0)
        assert np.abs(below - p).max() < 4.5 * np.sqrt(2.1 * p * (1 - p) / n), name
    label = found.labels[0]
    assert found.interval(label) == (found.low[0], found.high[0])
    assert label in repr(found) and found.to_pandas().loc[label, "standard_uncertainty"] > 0.0
    again = two_level(truth, tracker.model, tracker.plan, draws=10_000, seed=1, **options)
    np.testing.assert_array_equal(again.u, found.u)
    np.testing.assert_array_equal(again.low, found.low)


@pytest.mark.slow
def test_linear_draws_have_the_covariance_of_the_identification(tracker):
    """Where the prior is the population, that of the errors is the posterior covariance H^-1."""
    pair = virtual_pair(tracker.model, tracker.model, tracker.plan)
    linear = LinearDraws.of(pair)
    inverse = np.asarray(pair.batch.inverse)
    informed = np.asarray(pair.simulator.amplitudes.informed) > 0.0
    away = np.asarray(linear.by_true) - np.eye(len(inverse))
    root = np.asarray(linear.root)
    errors = root @ root.T + away[:, informed] @ away[:, informed].T
    np.testing.assert_allclose(errors, inverse, atol=1e-9 * np.abs(inverse).max(), rtol=1e-6)
    np.testing.assert_allclose(linear.at_nominal, 0.0, atol=1e-9)


@pytest.mark.thorough
def test_a_screw_of_unknown_pitch_is_refused(tracker):
    """Its derivative at one pitch says nothing of the others."""
    screw = tracker.effect("screw_cyclic:X:sine_um=1,pitch_mm=10")
    screw = dataclasses.replace(screw, given=(("sine", 0.0, 60.0), ("cosine", 0.0, 60.0)))
    truth = tracker.model.with_effects(screw)
    with pytest.raises(
        StudyError, match="linear draws explain .* expected at least 99 %; use exact"
    ):
        two_level(truth, tracker.model, tracker.plan, draws=2000)
    with pytest.raises(ValueError, match="draws: found 100, expected at least 2000"):
        two_level(tracker.model, tracker.model, tracker.plan, draws=100)


def test_corrections_against_closed_forms():
    """Y = L + L^2/8 of a standard normal L: mean, variance and quantiles are known, and the pairs
    say how exact draws differ from linear ones.
    """
    random = np.random.default_rng(0)

    def exact(x):
        return x + x**2 / 8.0

    pairs = random.standard_normal((40_000, 1))
    found = _Statistics.of(exact(pairs), pairs, 0.95)
    many = random.standard_normal(200_000)

    class Linear:
        mean, covariance, draws = np.array([many.mean()]), np.array([[many.var(ddof=1)]]), len(many)

        kept, values = "exact", many[:, None]

    told = found.corrected(Linear(), ["y"])  # type: ignore[arg-type]
    # x + x^2/8 increases above -4, so that its quantiles are those of x, transformed.
    ends = exact(stats.norm.ppf([0.025, 0.975]))
    expected = {"mean": 1 / 8, "u": np.sqrt(1 + 2 / 64), "low": ends[0], "high": ends[1]}
    for name, value in expected.items():
        error = told[f"error_of_{name}"][0]
        assert abs(told[name][0] - value) < 4 * error, name
        assert error < 0.02
    assert told["explained"][0] == pytest.approx(1 - (2 / 64) / (1 + 2 / 64), abs=0.002)
    scatter = np.sqrt(1 / len(many) + (2 / 64) / len(pairs))
    assert told["error_of_mean"][0] == pytest.approx(scatter, rel=0.05)


def test_what_does_not_vary_is_explained():
    same = np.ones((50, 1))
    found = _Statistics.of(same, same, 0.95)
    assert found.explained[0] == 1.0 and found.largest_ratio == 0.0
    with pytest.raises(StudyError, match="found no draw with an identification"):
        _Statistics.of(np.full((50, 1), np.nan), same, 0.95)
    assert jnp.isfinite(found.explained).all()
