"""Coverage regions of several outputs: JCGM 102, against closed forms and scipy."""

import math

import numpy as np
import pytest
from scipy import stats

from vcal.uncertainty import (
    Output,
    coverage_box,
    coverage_ellipsoid,
    normal_box,
    normal_ellipsoid,
    stream,
)

LABELS = ("y[0]", "y[1]")


def campaign(sample, size=2, draws=200_000, **options):
    """A Monte Carlo of `sample(rng, count)` (count, size)."""

    def evaluate(first, count):
        return {"y": sample(np.random.default_rng([3, first]), count)}

    return stream(evaluate, draws, [Output("y", (size,))], block=5000, **options)


def normal(rng, count):
    """Two normal outputs of very different size, correlated by 0.8."""
    z = rng.standard_normal((count, 2))
    return np.stack([5.0 + 2.0 * z[:, 0], 1e-6 * (0.8 * z[:, 0] + 0.6 * z[:, 1])], axis=1)


def disc(rng, count):
    """Evenly over the unit disc."""
    phi, r = 2.0 * math.pi * rng.random(count), np.sqrt(rng.random(count))
    return np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)


@pytest.mark.parametrize(
    ("k", "p", "printed"), [(2, 0.95, 2.45), (3, 0.95, 2.80), (2, 0.99, 3.03), (6, 0.95, 3.55)]
)
def test_factor_of_the_normal_ellipsoid(k, p, printed):
    region = normal_ellipsoid([""] * k, np.zeros(k), np.eye(k), p)
    assert region.factor == pytest.approx(math.sqrt(stats.chi2.ppf(p, k)), rel=1e-12)
    assert region.factor == pytest.approx(printed, abs=5e-3)
    few = normal_ellipsoid([""] * k, np.zeros(k), np.eye(k), p, dof=9.0)
    square = k * 9.0 / (10.0 - k) * stats.f.ppf(p, k, 10.0 - k)
    assert few.factor == pytest.approx(math.sqrt(square), rel=1e-9)
    many = normal_ellipsoid([""] * k, np.zeros(k), np.eye(k), p, dof=1e9)
    assert many.factor == pytest.approx(region.factor, rel=1e-6)


def test_factor_of_the_normal_box():
    one = normal_box(["a"], np.zeros(1), np.ones(1))
    assert one.factor == pytest.approx(stats.norm.ppf(0.975), rel=1e-12)
    two = normal_box(LABELS, np.zeros(2), np.ones(2))
    inside = stats.norm.cdf(two.factor) - stats.norm.cdf(-two.factor)
    assert inside**2 == pytest.approx(0.95, rel=1e-12)
    few = normal_box(LABELS, np.zeros(2), np.ones(2), dof=4.0)
    assert few.factor == pytest.approx(stats.t.ppf(0.5 * (1.0 + math.sqrt(0.95)), 4.0), rel=1e-9)
    correlated = stats.multivariate_normal([0.0, 0.0], [[1.0, 0.8], [0.8, 1.0]])
    ends = np.full(2, two.factor)
    assert correlated.cdf(ends, lower_limit=-ends) > 0.95, "on the safe side"


def test_regions_of_normal_draws_are_those_of_normal_theory():
    found = campaign(normal)
    region = coverage_ellipsoid(found)
    theory = normal_ellipsoid(LABELS, found.mean, found.covariance)
    assert region.labels == LABELS
    # d^2 is exponential with mean 2: the standard error of its quantile, halved for d.
    error = 2.0 * math.sqrt(0.95 / 0.05 / found.draws) / (2.0 * theory.factor)
    assert region.factor == pytest.approx(theory.factor, abs=3.0 * error)
    fresh = normal(np.random.default_rng(99), 100_000)
    share = np.mean(region.contains(fresh))
    assert share == pytest.approx(0.95, abs=3.0 * math.sqrt(0.95 * 0.05 / 1e5 * 1.5))
    box = coverage_box(found)
    assert np.mean(box.contains(fresh)) == pytest.approx(0.95, abs=0.0026)
    assert box.factor < normal_box(LABELS, found.mean, found.u).factor
    np.testing.assert_allclose(box.high - box.low, 2.0 * box.factor * found.u)
    np.testing.assert_allclose(box.low + box.high, 2.0 * found.mean, rtol=0, atol=1e-12)


def test_factors_of_an_even_disc_and_square_are_exact_ones():
    # On the disc u = 1/2, so that d = 2 r, and r^2 is even over (0, 1).
    found = campaign(disc)
    region = coverage_ellipsoid(found)
    exact = 2.0 * math.sqrt(0.95)
    assert region.factor == pytest.approx(exact, abs=0.004)
    assert exact < 0.8 * normal_ellipsoid(LABELS, found.mean, found.covariance).factor
    assert region.volume == pytest.approx(0.95 * math.pi, rel=0.005)
    # On the square max |y| / u <= k has the probability (k / sqrt 3)^2.
    box = coverage_box(campaign(lambda rng, count: rng.uniform(-1.0, 1.0, (count, 2))))
    assert box.factor == pytest.approx(math.sqrt(3.0 * 0.95), abs=0.003)
    assert box.volume == pytest.approx(4.0 * 0.95, rel=0.005)


def test_axes_and_volume_of_an_ellipsoid():
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    covariance = turn @ np.diag([1.0, 9.0, 4.0]) @ turn.T
    region = normal_ellipsoid("abc", np.zeros(3), covariance)
    lengths, directions = region.axes
    np.testing.assert_allclose(lengths, region.factor * np.array([3.0, 2.0, 1.0]))
    for length, direction in zip(lengths, directions.T, strict=True):
        assert region.contains(0.9999 * length * direction[None])[0]
        assert not region.contains(1.0001 * length * direction[None])[0]
    assert region.volume == pytest.approx(4.0 / 3.0 * math.pi * np.prod(lengths), rel=1e-12)


def test_regions_of_some_outputs_leave_out_draws_in_which_these_failed():
    def sample(rng, count):
        y = np.column_stack([normal(rng, count), rng.standard_normal(count)])
        y[7, 2] = np.nan
        return y

    found = campaign(sample, 3, 20_000)
    clean = campaign(lambda rng, count: sample(rng, count)[:, :2], 2, 20_000)
    one, other = coverage_ellipsoid(found, LABELS), coverage_ellipsoid(clean)
    assert one.factor == other.factor and not clean.failed
    np.testing.assert_array_equal(one.covariance, other.covariance)
    whole = coverage_ellipsoid(found)
    values = found.values[np.isfinite(found.values).all(1)]
    assert len(values) == 20_000 - 4
    np.testing.assert_allclose(whole.covariance, np.cov(values.T), rtol=1e-9)
    assert np.mean(whole.contains(values)) == pytest.approx(0.95, abs=1e-4)


def test_beyond_the_limit_regions_come_from_the_draws_kept():
    found = campaign(disc, keep=100_000)
    assert found.kept == "sketch" and len(found.values) == 50_000
    region = coverage_ellipsoid(found)
    np.testing.assert_array_equal(region.covariance, found.covariance)
    assert region.factor == pytest.approx(2.0 * math.sqrt(0.95), abs=0.008)


def test_regions_that_there_are_not_are_refused():
    found = campaign(disc, draws=10_000)
    with pytest.raises(ValueError, match=r"no scalar output is called 'y\[2\]'"):
        coverage_ellipsoid(found, ["y[0]", "y[2]"])
    with pytest.raises(ValueError, match="found 10000 draws .* expected at least 100000"):
        coverage_box(found, p=0.99999)
    with pytest.raises(ValueError, match="coverage probability: found 95"):
        coverage_box(found, p=95)
    doubled = campaign(lambda rng, n: np.repeat(disc(rng, n)[:, :1], 2, axis=1), draws=10_000)
    with pytest.raises(ValueError, match="found 1 independent outputs among 2"):
        coverage_ellipsoid(doubled)
    fixed = campaign(lambda rng, n: disc(rng, n) * [1.0, 0.0], draws=10_000)
    with pytest.raises(ValueError, match=r"'y\[1\]' does not vary"):
        coverage_box(fixed)
    with pytest.raises(ValueError, match="found 1 degrees of freedom, expected at least 2"):
        normal_ellipsoid(LABELS, np.zeros(2), np.eye(2), dof=1.0)
