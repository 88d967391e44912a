"""Inputs from readings and certificates, numbers of events, and what a correlation is of."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from vcal.distributions import (
    Certificate,
    Empirical,
    Groups,
    Inputs,
    LogNormal,
    MultivariateNormal,
    Normal,
    Poisson,
    Repeats,
    Series,
    StudentT,
    Uniform,
    Weibull,
    degrees_of_freedom,
    distribution,
    pooled_deviation,
    rescaled,
)
from vcal.errors import StudyError
from vcal.uncertainty import propagate, propagate_distributions

READINGS = [10.3, 10.1, 10.7, 10.2, 10.6]

# JCGM 100, Table H.9: mean and standard deviation of five readings on each of ten days, V and uV.
DAYS = {
    "means": [
        10.000172, 10.000116, 10.000013, 10.000144, 10.000106,
        10.000031, 10.000060, 10.000125, 10.000163, 10.000041,
    ],
    "s": np.array([60, 77, 111, 101, 67, 93, 80, 73, 88, 86]) * 1e-6,
    "n": 5,
}  # fmt: skip


def total(values):
    return sum(values.values())


# --- repeats ---


def test_repeats_are_a_t_of_their_mean():
    """JCGM 100, 4.2; JCGM 101, 6.4.9: against numpy and scipy."""
    x = Repeats(READINGS)
    scale = np.std(READINGS, ddof=1) / math.sqrt(5)
    theirs = stats.t(4, np.mean(READINGS), scale)
    assert (float(x.mean), x.u) == pytest.approx((np.mean(READINGS), scale), rel=1e-14)
    assert float(x.std) == pytest.approx(theirs.std())
    assert float(x.dof) == 4.0 and x.kinds == ("t",) and float(x.n) == 5.0
    p = np.array([0.01, 0.3, 0.5, 0.99])
    np.testing.assert_allclose(x.quantile(p), theirs.ppf(p), rtol=1e-12)
    np.testing.assert_allclose(x.cdf(theirs.ppf(p)), p, rtol=1e-10)
    np.testing.assert_allclose(x.log_density(jnp.asarray(10.2)), theirs.logpdf(10.2), rtol=1e-12)
    drawn = np.asarray(x.sample(jax.random.key(1), (5000,)))
    assert stats.kstest(drawn, theirs.cdf).pvalue > 1e-3


def test_gum_and_monte_carlo_take_the_same_repeats():
    inputs = Inputs({"x": Repeats(READINGS), "c": Certificate(0.0, 0.3, k=2.0, dof=6)})
    budget = propagate(total, Inputs({"x": inputs.distributions["x"]}))
    drawn = propagate_distributions(total, inputs, draws=20_000)
    # One t alone: the GUM's interval is that of the distribution.
    exact = stats.t.interval(0.95, 4, np.mean(READINGS), np.std(READINGS, ddof=1) / math.sqrt(5))
    assert budget.interval("y") == pytest.approx(exact, rel=1e-9)
    # u as the standard deviation of the t: that of Monte Carlo.
    known = propagate(total, inputs, t="std")
    assert known.u[0] == pytest.approx(
        math.hypot(*(float(d.std) for d in inputs.distributions.values()))
    )
    assert math.isinf(known.nu_eff[0]) and known.k[0] == pytest.approx(stats.norm.ppf(0.975))
    assert drawn.u[0] == pytest.approx(known.u[0], rel=0.04)
    assert propagate(total, inputs).u[0] < known.u[0]
    with pytest.raises(ValueError, match="t: found 'sd', expected 'scale' or 'std'"):
        propagate(total, inputs, t="sd")


def test_repeats_with_a_known_standard_deviation():
    pooled = pooled_deviation([[1.0, 1.2, 1.1], [3.0, 3.4], [9.0]])
    # (0.02 + 0.08) / (2 + 1)
    assert pooled == pytest.approx((math.sqrt(0.1 / 3), 3.0))
    from_summaries = pooled_deviation(s=[0.1, math.sqrt(0.08), 0.0], n=[3, 2, 1])
    assert from_summaries == pytest.approx(pooled)
    one = Repeats([7.3], s=pooled.s, dof=pooled.dof)
    assert (one.u, float(one.dof)) == pytest.approx((pooled.s, 3.0))
    known = Repeats([7.3, 7.5], s=0.2)
    assert known.kinds == ("normal",) and known.u == pytest.approx(0.2 / math.sqrt(2))
    assert float(known.mean) == pytest.approx(7.4)


# --- groups ---


def test_gum_h5_between_and_within_days():
    """JCGM 100, H.5 (also in the public tests of suncal): Table H.9 and equations H.24 to H.27."""
    days = Groups(**DAYS)
    found = days.anova
    assert float(days.mean) == pytest.approx(10.000097, abs=5e-7)
    assert np.std(DAYS["means"], ddof=1) == pytest.approx(57e-6, abs=5e-7)
    assert math.sqrt(found.between) == pytest.approx(128e-6, abs=5e-7)
    assert found.s_within == pytest.approx(85e-6, abs=5e-7)
    assert (found.dof_between, found.dof_within) == (9.0, 40.0)
    # Printed 2.25, of digits that the table does not have.
    assert pytest.approx(2.25, abs=0.02) == found.F
    assert stats.f.ppf(0.95, 9, 40) < found.F < stats.f.ppf(0.975, 9, 40)
    assert found.p == pytest.approx(stats.f.sf(found.F, 9, 40), rel=1e-9)
    assert found.s_between == pytest.approx(43e-6, abs=5e-7)
    assert days.u == pytest.approx(18e-6, abs=5e-7) and float(days.dof) == 9.0
    # H.5.2.5: without an effect between days.
    alone = Groups(**DAYS, between=False)
    assert alone.u == pytest.approx(13e-6, abs=5e-7) and float(alone.dof) == 49.0


def test_groups_of_readings_against_scipy():
    rng = np.random.default_rng(3)
    groups = [rng.normal(m, 0.3, n) for m, n in [(1.0, 4), (1.5, 7), (0.7, 3), (1.2, 5)]]
    found = Groups(groups)
    theirs = stats.f_oneway(*groups)
    assert found.anova.F == pytest.approx(theirs.statistic, rel=1e-10)
    assert found.anova.p == pytest.approx(theirs.pvalue, rel=1e-9)
    means = np.array([g.mean() for g in groups])
    assert float(found.mean) == pytest.approx(means.mean())
    assert found.u == pytest.approx(stats.sem(means))
    together = np.concatenate(groups)
    alone = Groups(groups, between=False)
    assert float(alone.mean) == pytest.approx(together.mean())
    assert alone.u == pytest.approx(stats.sem(together))


def test_mean_of_groups_covers_where_readings_as_one_set_do_not():
    rng = np.random.default_rng(8)
    held = np.zeros((2, 150), bool)
    for case in range(150):
        data = rng.normal(0.0, 1.0, (6, 1)) + rng.normal(0.0, 0.5, (6, 4))
        for row, between in enumerate((True, False)):
            found = Groups(data, between=between)
            half = stats.t.ppf(0.975, float(found.dof)) * found.u
            held[row, case] = abs(float(found.mean)) <= half
    assert held[0].mean() == pytest.approx(0.95, abs=0.05)
    assert held[1].mean() < 0.85


# --- a series ---


def test_series_of_known_correlation():
    """u^2 = s^2 over its expectation, times 1' R 1 / n^2: both from the matrix R."""
    x, r = np.array([2.0, 2.3, 1.8, 2.6, 2.1, 2.2, 2.4, 1.9]), np.array([0.4, 0.1])
    found = Series(x, correlation=r)
    n, lags = len(x), np.abs(np.subtract.outer(np.arange(8), np.arange(8)))
    matrix = np.where(lags == 0, 1.0, np.where(lags == 1, r[0], np.where(lags == 2, r[1], 0.0)))
    ones = np.ones(n)
    centred = np.eye(n) - 1.0 / n
    expected = np.trace(centred @ matrix @ centred) / (n - 1)  # of s^2 for variance one
    u = math.sqrt(x.var(ddof=1) / expected * (ones @ matrix @ ones) / n**2)
    assert found.u == pytest.approx(u, rel=1e-12)
    assert float(found.n_eff) == pytest.approx(n**2 / (ones @ matrix @ ones), rel=1e-12)
    assert float(found.dof) == pytest.approx(float(found.n_eff) - 1.0)
    assert Series(x, correlation=[]).u == pytest.approx(Repeats(x).u, rel=1e-12)


def test_series_with_estimated_correlation():
    """First-order autoregression, 0.7: the variance of the mean by its closed form."""
    rng = np.random.default_rng(5)
    phi, n, cases = 0.7, 1000, 60
    lags = np.arange(1, n)
    exact = (1.0 + 2.0 * ((1.0 - lags / n) * phi**lags).sum()) / n
    variances = []
    for _ in range(cases):
        noise = rng.standard_normal(n) * math.sqrt(1.0 - phi**2)
        x = np.empty(n)
        x[0] = rng.standard_normal()
        for i in range(1, n):
            x[i] = phi * x[i - 1] + noise[i]
        variances.append(Series(x).u ** 2)
    assert np.mean(variances) == pytest.approx(exact, rel=0.15)
    assert np.mean(variances) > 4.0 / n  # five times that of independent readings


# --- certificates ---


def test_certificate_with_k_or_coverage():
    assert Certificate(5.0, 0.4, k=2).u == 0.2 and Certificate(5.0, 0.4, k=2).kinds == ("normal",)
    nu = 7.0
    x = Certificate(5.0, 0.4, coverage=0.95, dof=nu)
    assert x.u == pytest.approx(0.4 / stats.t.ppf(0.975, nu)) and float(x.dof) == nu
    assert float(x.quantile(0.975)) == pytest.approx(5.4)
    normal = Certificate(5.0, 0.4, coverage=0.99)
    assert normal.u == pytest.approx(0.4 / stats.norm.ppf(0.995))
    std = Certificate(5.0, 0.4, k=2, dof=nu, u_is="std")
    assert float(std.std) == pytest.approx(0.2) and std.u == pytest.approx(0.2 * math.sqrt(5 / 7))
    assert float(StudentT.from_std(1.0, 3.0, 4.0).std) == pytest.approx(3.0)


def test_degrees_of_freedom_that_a_certificate_implies():
    """t_p(nu) for 95.45 % as scipy has it; k = 2.28 is printed for 10 in JCGM 100, Table G.2."""
    p = 0.9545
    for nu in (1.5, 10.0, 57.3):
        k = stats.t.ppf(0.5 * (1 + p), nu)
        assert degrees_of_freedom(k, p) == pytest.approx(nu, rel=1e-6)
    assert degrees_of_freedom(2.28, p) == pytest.approx(10.0, abs=0.3)
    assert math.isinf(degrees_of_freedom(2.0, p))
    with pytest.raises(ValueError, match=r"k: found 1\.9, expected a number from 2"):
        degrees_of_freedom(1.9, p)


def test_evaluated_inputs_in_a_study_file():
    x = distribution("certificate", value=1.0, U=0.2, k=2)
    assert float(x.mean) == 1.0 and x.u == 0.1
    assert distribution("repeats", values=READINGS).u == pytest.approx(stats.sem(READINGS))
    with pytest.raises(StudyError, match="distribution 'repeats': repeats: found 1 reading"):
        distribution("repeats", values=[1.0])


# --- numbers of events ---


@pytest.mark.parametrize("mean", [0.3, 4.2, 250.0])
def test_poisson_is_that_of_scipy(mean):
    ours, theirs = Poisson(mean), stats.poisson(mean)
    p = np.array([1e-12, 1e-3, 0.1, 0.4, 0.6, 0.9, 1 - 1e-6, 1 - 1e-12])
    np.testing.assert_array_equal(ours.quantile(p), theirs.ppf(p))
    q = np.array([1e-200, 1e-30, 1e-5])
    found = np.asarray(ours.inverse(1 - q, q))
    assert (theirs.sf(found) <= q * (1 + 1e-9)).all() and (theirs.sf(found - 1) > q).all()
    n = np.arange(-1.0, 3 * mean + 5)
    np.testing.assert_allclose(ours.cdf(n + 0.4), theirs.cdf(n + 0.4), rtol=1e-11, atol=1e-300)
    np.testing.assert_allclose(ours.log_probability(n[1:]), theirs.logpmf(n[1:]), rtol=1e-10)
    assert np.isneginf(np.asarray(ours.log_probability(np.array([-1.0, 0.5])))).all()
    assert float(ours.std) == pytest.approx(math.sqrt(mean)) and not ours.symmetric
    assert float(ours.quantile(1.0)) == np.inf and float(ours.quantile(0.0)) == 0.0
    drawn = np.asarray(ours.sample(jax.random.key(3), (20_000,)))
    assert drawn.mean() == pytest.approx(mean, abs=4 * math.sqrt(mean / 20_000))
    assert drawn.var() == pytest.approx(mean, rel=4 * math.sqrt((2 + 1 / mean) / 20_000))
    with pytest.raises(ValueError, match="no density"):
        ours.log_density(jnp.asarray(1.0))


def test_weibull_with_shape_one_is_exponential():
    ours, theirs = Weibull(2.5, 1.0), stats.expon(scale=2.5)
    assert float(ours.mean) == pytest.approx(2.5) and float(ours.std) == pytest.approx(2.5)
    np.testing.assert_allclose(ours.quantile(np.array([0.1, 0.99])), theirs.ppf([0.1, 0.99]))


# --- what a correlation is of ---

PAIRS = {
    "log_normal and uniform": (LogNormal(0.0, 0.8), Uniform(0.0, 1.0)),
    "poisson and normal": (Poisson(2.5), Normal(0.0, 1.0)),
}


def drawn_pairs(inputs, n=20_000):
    drawn = jax.vmap(inputs.sample)(jax.random.split(jax.random.key(6), n))
    return np.asarray(drawn["a"]), np.asarray(drawn["b"])


@pytest.mark.parametrize("name", PAIRS)
def test_product_moment_correlation(name):
    a, b = PAIRS[name]
    inputs = Inputs({"a": a, "b": b}, {("a", "b"): 0.6}, correlation_of="product_moment")
    covariance = np.asarray(inputs.covariance)
    stated = covariance[0, 1] / math.sqrt(covariance[0, 0] * covariance[1, 1])
    assert stated == pytest.approx(0.6, abs=1e-9)
    assert np.corrcoef(*drawn_pairs(inputs))[0, 1] == pytest.approx(0.6, abs=0.03)


def test_rank_correlations():
    a, b = PAIRS["log_normal and uniform"]
    for measure, statistic in (("spearman", stats.spearmanr), ("kendall", stats.kendalltau)):
        inputs = Inputs({"a": a, "b": b}, {("a", "b"): -0.5}, correlation_of=measure)
        found = statistic(*drawn_pairs(inputs, 8000)).statistic
        assert found == pytest.approx(-0.5, abs=0.03)


def test_product_moment_of_normal_inputs_is_that_of_the_scores():
    pair = {"a": Normal(0, 1), "b": Normal(3, 2)}
    inputs = Inputs(pair, {("a", "b"): 1.0}, correlation_of="product_moment")
    assert np.asarray(inputs.covariance)[0, 1] == pytest.approx(2.0, rel=1e-12)


def test_replaced_and_rescaled_inputs():
    trio = {"a": LogNormal(0, 0.5), "b": Uniform(0, 1), "c": Normal(0, 1)}
    inputs = Inputs(trio, {("a", "c"): 0.7})
    moved = inputs.replaced("a", rescaled(trio["a"], value=5.0, u=0.1))
    a = moved.distributions["a"]
    assert (float(a.mean), float(a.std)) == pytest.approx((5.0, 0.1))
    # The shape stays: quantiles are those of the log-normal, moved and stretched.
    z = np.array([0.05, 0.5, 0.999])
    inner = (np.asarray(trio["a"].quantile(z)) - float(trio["a"].mean)) / float(trio["a"].std)
    np.testing.assert_allclose(a.quantile(z), 5.0 + 0.1 * inner, rtol=1e-12)
    np.testing.assert_allclose(a.cdf(a.quantile(z)), z, rtol=1e-10)
    correlation = [np.asarray(i.covariance) for i in (inputs, moved)]
    correlation = [c[0, 2] / math.sqrt(c[0, 0] * c[2, 2]) for c in correlation]
    assert correlation[0] == pytest.approx(correlation[1], rel=1e-9)
    t = rescaled(Repeats(READINGS), u=0.5)
    assert float(jnp.sqrt(t.stated_covariance[0, 0])) == pytest.approx(0.5) and float(t.dof) == 4.0


# --- mistakes ---

MISTAKES = {
    "one reading": (lambda: Repeats([1.0]), "repeats: found 1 reading, expected at least 2"),
    "equal readings": (lambda: Repeats([2.0, 2.0]), "readings that are all 2.0, expected some"),
    "nan reading": (lambda: Repeats([2.0, np.nan]), "found nan at position 1"),
    "text": (lambda: Repeats(["a", "b"]), "expected a list of numbers"),
    "table": (lambda: Repeats([[1.0, 2.0]]), r"readings of shape \(1, 2\)"),
    "s": (lambda: Repeats([1.0], s=0.0), r"found s = 0\.0, expected a finite number above 0"),
    "dof alone": (lambda: Repeats([1.0, 2.0], dof=3), "found dof = 3 without s"),
    "one group": (lambda: Groups([[1.0, 2.0]]), "found 1 groups, expected at least 2"),
    "single readings": (lambda: Groups([[1.0], [2.0]]), "one reading in every group"),
    "empty group": (lambda: Groups([[1.0, 2.0], []]), "group 1: found 0 readings"),
    "no groups": (lambda: Groups(), "expected the readings of every group, or its mean"),
    "summaries": (lambda: Groups(means=[1, 2], s=[1], n=3), "2 means, 1 standard deviations"),
    "n": (lambda: Groups(means=[1, 2], s=[1, 1], n=2.5), "a whole number n of at least 1"),
    "equal means": (lambda: Groups(means=[1, 1], s=[1, 1], n=3), "means that are all 1.0"),
    "pooled": (lambda: pooled_deviation([[1.0], [2.0]]), "one reading in every group"),
    "short series": (lambda: Series([1.0, 2.0]), "series: found 2 readings, expected at least 3"),
    "one reading's worth": (
        lambda: Series([1.0, 2.0, 3.0], correlation=[0.9, 0.9]),
        "found 3 readings worth 1.1 independent ones",
    ),
    "lags": (lambda: Series([1, 2, 3.0], correlation=[0.1] * 3), "expected at most 2 from -1"),
    "k and coverage": (lambda: Certificate(1, 1, k=2, coverage=0.95), "found both of k and"),
    "neither": (lambda: Certificate(1, 1), "found neither of k and coverage"),
    "U": (lambda: Certificate(1, -1, k=2), "certificate: found U = -1"),
    "dof": (lambda: Certificate(1, 1, k=2, dof=0), "found dof = 0"),
    "per cent": (lambda: Certificate(1, 1, coverage=95), "coverage: found 95, expected a prob"),
    "meaning": (lambda: Certificate(1, 1, k=2, u_is="sd"), "found u_is = 'sd'"),
    "std of few": (lambda: Certificate(1, 1, k=2, dof=2, u_is="std"), "expected more than 2"),
    "events": (lambda: Poisson(2e9), "poisson: found mean = 2000000000.0, expected at most"),
    "ties": (
        lambda: Inputs(
            {"a": Empirical([1.0, 2.0]), "b": Normal(0, 1)}, {("a", "b"): 0.5}, "spearman"
        ),
        "rank correlation for a, b, of which one is empirical",
    ),
    "out of reach": (
        lambda: Inputs(
            {"a": LogNormal(0, 1.5), "b": Normal(0, 1)}, {("a", "b"): -0.9}, "product_moment"
        ),
        r"found -0\.9 for a, b, expected a product-moment correlation from -0\.5",
    ),
    "measure": (
        lambda: Inputs({"a": Normal(0, 1), "b": Normal(0, 1)}, {("a", "b"): 0.1}, "pearson"),
        "correlation_of: found 'pearson'",
    ),
    "stretched to nothing": (lambda: rescaled(Normal(0, 1), u=0.0), "u: found 0.0"),
    "stretched array": (
        lambda: rescaled(MultivariateNormal([0.0], [[1.0]]), u=1.0),
        "found a multivariate distribution",
    ),
    "replaced": (
        lambda: Inputs({"a": Normal(0, 1)}).replaced("b", Normal(0, 1)),
        "replaced: unknown input 'b'",
    ),
}


@pytest.mark.parametrize(("make", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
