"""Distributions against scipy.stats, numerical integrals and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

from vcal.distributions import (
    CATALOGUE,
    Arcsine,
    Beta,
    CurvilinearTrapezoid,
    Empirical,
    Gamma,
    GaussianCopula,
    Inputs,
    Laplace,
    LogNormal,
    MultivariateNormal,
    MultivariateT,
    Normal,
    StudentT,
    Trapezoidal,
    Triangular,
    Uniform,
    Weibull,
    distribution,
)
from vcal.errors import StudyError

# Every distribution that scipy has too, in shapes that reach each branch.
CASES = {
    "normal": (Normal(1.2, 0.3), stats.norm(1.2, 0.3)),
    "t 3.5": (StudentT(-1.0, 0.2, 3.5), stats.t(3.5, -1.0, 0.2)),
    "t 0.7": (StudentT(0.0, 1.0, 0.7), stats.t(0.7)),
    "t 300": (StudentT(5.0, 2.0, 300.0), stats.t(300.0, 5.0, 2.0)),
    "uniform": (Uniform(-1.0, 3.0), stats.uniform(-1.0, 4.0)),
    "triangular": (Triangular(0.0, 2.0), stats.triang(0.5, 0.0, 2.0)),
    "triangular skew": (Triangular(-1.0, 4.0, 0.5), stats.triang(0.3, -1.0, 5.0)),
    "triangular falling": (Triangular(0.0, 2.0, 0.0), stats.triang(0.0, 0.0, 2.0)),
    "triangular rising": (Triangular(0.0, 2.0, 2.0), stats.triang(1.0, 0.0, 2.0)),
    "arcsine": (Arcsine(-0.5, 0.5), stats.arcsine(-0.5, 1.0)),
    "trapezoidal": (Trapezoidal(1.0, 5.0, 0.4), stats.trapezoid(0.3, 0.7, 1.0, 4.0)),
    "trapezoidal 0": (Trapezoidal(0.0, 2.0, 0.0), stats.triang(0.5, 0.0, 2.0)),
    "trapezoidal 1": (Trapezoidal(0.0, 2.0, 1.0), stats.uniform(0.0, 2.0)),
    "log_normal": (LogNormal(0.3, 0.8), stats.lognorm(0.8, scale=np.exp(0.3))),
    "gamma": (Gamma(2.5, 0.4), stats.gamma(2.5, scale=0.4)),
    "gamma 0.3": (Gamma(0.3, 2.0), stats.gamma(0.3, scale=2.0)),
    "gamma 400": (Gamma(400.0, 1.0), stats.gamma(400.0)),
    "beta": (Beta(2.0, 3.5, -1.0, 2.0), stats.beta(2.0, 3.5, -1.0, 3.0)),
    "beta U": (Beta(0.5, 0.7), stats.beta(0.5, 0.7)),
    "beta 200": (Beta(200.0, 8.0), stats.beta(200.0, 8.0)),
    "laplace": (Laplace(-0.4, 1.5), stats.laplace(-0.4, 1.5)),
    "weibull": (Weibull(2.0, 1.7, -1.0), stats.weibull_min(1.7, -1.0, 2.0)),
    "weibull 0.6": (Weibull(0.3, 0.6), stats.weibull_min(0.6, 0.0, 0.3)),
}
CTRAP = CurvilinearTrapezoid(-1.0, 2.0, 0.6)
OWN = {name: ours for name, (ours, _) in CASES.items()} | {
    "ctrap": CTRAP,
    "ctrap narrow": CurvilinearTrapezoid(0.0, 1.0, 1e-6),
    "ctrap wide": CurvilinearTrapezoid(0.0, 1.0, 0.4999),
}
SCIPY = [pytest.param(*pair, id=name) for name, pair in CASES.items()]
ALL = [pytest.param(ours, id=name) for name, ours in OWN.items()]
P = np.concatenate([[1e-12, 1e-6, 1e-3], np.linspace(0.02, 0.98, 27), [0.999, 1 - 1e-6]])


SHAPE = P.shape


def padded(*values):
    """Few numbers in the shape of all others here, for which everything is compiled already."""
    return np.append(np.asarray(values, float), np.full(SHAPE[0] - len(values), 0.5))


N = 20_000
TAIL = padded(1e-15, 1e-10, 1e-5, 0.1)
FAR = padded(1e-290, 1e-150, 1e-60, 1e-20)
DECADES = padded(1e-300, 1e-100, 1e-20, 1e-8, 1e-3, 0.1, 0.4999999)


def slope(function, x):
    return np.asarray(jax.jvp(function, (jnp.asarray(x),), (jnp.ones(SHAPE),))[1])


@pytest.mark.parametrize(("ours", "theirs"), SCIPY)
def test_cdf_and_density_are_those_of_scipy(ours, theirs):
    x = theirs.ppf(np.linspace(1e-3, 1 - 1e-3, SHAPE[0]))
    np.testing.assert_allclose(ours.cdf(x), theirs.cdf(x), rtol=1e-10)
    np.testing.assert_allclose(ours.log_density(x), theirs.logpdf(x), rtol=0, atol=1e-10)
    low, high = (float(end) for end in ours.support)
    assert (low, high) == pytest.approx(theirs.support(), abs=1e-15)
    x[:2] = max(low, -1e300) - 0.1, min(high, 1e300) + 0.1
    np.testing.assert_allclose(ours.cdf(x)[:2], [0.0, 1.0], atol=1e-15)
    assert (np.asarray(ours.log_density(x))[:2] < -100.0).all()


@pytest.mark.parametrize(("ours", "theirs"), SCIPY)
def test_moments_are_those_of_scipy(ours, theirs):
    if np.isfinite(theirs.var()):
        assert float(ours.std) == pytest.approx(theirs.std(), rel=1e-12)
        np.testing.assert_allclose(ours.covariance, [[theirs.var()]], rtol=1e-12)
    if np.isfinite(theirs.mean()):
        assert float(ours.mean) == pytest.approx(theirs.mean(), rel=1e-12, abs=1e-15)
    if np.isfinite(theirs.stats("s")):
        assert ours.symmetric == (abs(theirs.stats("s")) < 1e-9)


@pytest.mark.parametrize(("ours", "theirs"), SCIPY)
def test_quantile_is_that_of_scipy_in_both_tails(ours, theirs):
    # Next to a limit that is not zero the last digit of x is what counts.
    digit = {"rtol": 1e-9, "atol": 1e-15 * np.abs(theirs.ppf([0.1, 0.9])).max()}
    np.testing.assert_allclose(ours.quantile(P), theirs.ppf(P), **digit)
    np.testing.assert_allclose(ours.inverse(TAIL, 1 - TAIL), theirs.ppf(TAIL), **digit)
    np.testing.assert_allclose(ours.inverse(1 - TAIL, TAIL), theirs.isf(TAIL), **digit)


@pytest.mark.parametrize("name", ["normal", "t 3.5", "t 300", "gamma", "gamma 400", "log_normal"])
def test_quantile_far_out_in_the_upper_tail(name):
    ours, theirs = CASES[name]
    np.testing.assert_allclose(theirs.logsf(ours.inverse(1 - FAR, FAR)), np.log(FAR), rtol=1e-11)
    # From nine sigma on, the probability below is not distinguishable from one.
    z = padded(12.0, 20.0, 35.0)
    np.testing.assert_allclose(theirs.logsf(ours.from_score(z)), stats.norm.logsf(z), rtol=1e-11)


@pytest.mark.parametrize("shape", 10.0 ** np.arange(-1, 5))
def test_shapes_of_gamma_and_beta_over_many_decades(shape):
    ours = Gamma(shape, 1.0)
    low = np.asarray(ours.inverse(DECADES, 1 - DECADES))
    high = np.asarray(ours.inverse(1 - DECADES, DECADES))
    seen = low > 1e-290
    log = np.log(DECADES)
    np.testing.assert_allclose(np.log(special.gammainc(shape, low[seen])), log[seen], rtol=3e-9)
    np.testing.assert_allclose(np.log(special.gammaincc(shape, high)), log, rtol=3e-9)
    for b in (0.3, 1.0, 4.0, 1e3):
        low = np.asarray(Beta(shape, b).inverse(DECADES, 1 - DECADES))
        seen = (low > 1e-290) & (low < 0.99)
        back = special.betainc(shape, b, low[seen])
        np.testing.assert_allclose(np.log(back), log[seen], rtol=3e-9)


@pytest.mark.parametrize("ours", ALL)
def test_quantile_undoes_cdf(ours):
    x = ours.quantile(P[2:-1].repeat(2)[: SHAPE[0]])
    np.testing.assert_allclose(ours.quantile(ours.cdf(x)), x, rtol=1e-9, atol=1e-12)
    found = np.asarray(ours.quantile(padded(0.0, 1.0, -0.1, 1.1, np.nan)))
    assert list(found[:2]) == pytest.approx([float(end) for end in ours.support], abs=1e-300)
    assert np.isnan(found[2:5]).all()


@pytest.mark.parametrize("ours", ALL)
def test_derivatives_of_quantile_and_cdf(ours):
    p = np.linspace(0.02, 0.98, SHAPE[0])
    p[0] = 0.5  # where the two tails meet
    x, step = ours.quantile(p), 1e-5 * np.minimum(p, 1 - p)
    difference = (ours.quantile(p + step) - ours.quantile(p - step)) / (2 * step)
    np.testing.assert_allclose(slope(ours.quantile, p), difference, rtol=1e-5)
    density = np.exp(ours.log_density(x))
    np.testing.assert_allclose(slope(ours.quantile, p) * density, 1.0, rtol=1e-8)
    np.testing.assert_allclose(slope(ours.cdf, x), density, rtol=1e-8)


@pytest.mark.parametrize("name", ["normal", "t 3.5", "triangular skew", "trapezoidal"])
def test_jit_and_vmap_give_the_same(name):
    ours = OWN[name]
    x = ours.quantile(P)
    compiled = eqx.filter_jit(lambda d, p: jax.vmap(jax.value_and_grad(d.quantile))(p))
    value, derivative = compiled(ours, jnp.asarray(P))
    np.testing.assert_allclose(value, x, rtol=1e-12)
    np.testing.assert_allclose(derivative, slope(ours.quantile, P), rtol=1e-10)


def test_compiled_draws_are_the_same():
    ours, key = OWN["trapezoidal"], jax.random.key(3)
    drawn = jax.jit(jax.vmap(ours.sample))(jnp.stack([key, jax.random.key(4)]))
    np.testing.assert_allclose(drawn[0], ours.sample(key), rtol=1e-12)


def test_many_distributions_at_once():
    scales = np.array([0.5, 1.0, 4.0])
    several = eqx.filter_vmap(lambda s: LogNormal(0.1, s))(scales)
    found = eqx.filter_vmap(lambda d: d.quantile(0.3))(several)
    np.testing.assert_allclose(found, stats.lognorm.ppf(0.3, scales, 0, np.exp(0.1)), rtol=1e-12)


def ctrap_cdf(ours, x):
    """From the density of JCGM 101 6.4.3.2, integrated by hand."""
    a, b, d = float(ours.low), float(ours.high), float(ours.inexact)
    w, t = (b - a) / 2, np.abs(x - (a + b) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        flank = (w + d - t - t * np.log((w + d) / t)) / (4 * d)
    tail = np.where(t > w - d, flank, 0.5 - t * np.log((w + d) / (w - d)) / (4 * d))
    return np.where(x > (a + b) / 2, 1 - tail, tail)


@pytest.mark.parametrize("name", OWN)
def test_samples_follow_the_distribution(name):
    n, key, ours = N, jax.random.key(7), OWN[name]
    drawn = np.asarray(ours.sample(key, (n,)))
    assert drawn.dtype == np.float64 and drawn.shape == (n,)
    known = CASES[name][1].cdf if name in CASES else lambda x: ctrap_cdf(ours, x)
    assert stats.kstest(drawn, known).pvalue > 1e-3
    np.testing.assert_array_equal(ours.sample(key, (n,)), drawn)
    assert not np.array_equal(ours.sample(jax.random.key(8), (n,)), drawn)
    if name != "t 0.7":
        standard = (drawn - float(ours.mean)) / float(ours.std)
        fourth = np.sqrt(np.mean(standard**4) / n)
        assert abs(standard.mean()) < 4 / np.sqrt(n)
        assert standard.var() == pytest.approx(1.0, abs=4 * fourth)


@pytest.mark.parametrize("d", [0.6, 1.4, 1e-3])
def test_curvilinear_trapezoid_is_a_rectangle_of_uncertain_width(d):
    """JCGM 101 6.4.3: half-width W rectangular in w -+ d, X rectangular in middle -+ W."""
    a, b = -1.0, 2.0
    ours, middle, w = CurvilinearTrapezoid(a, b, d), 0.5 * (a + b), 0.5 * (b - a)

    def mixed(of, start=0.0):
        low = max(start, w - d)
        return integrate.quad(lambda h: of(h) / (2 * d), low, w + d, epsabs=0, epsrel=1e-12)[0]

    assert [float(end) for end in ours.support] == pytest.approx([a - d, b + d], rel=1e-15)
    assert float(ours.std) ** 2 == pytest.approx(mixed(lambda h: h**2 / 3), rel=1e-12)
    assert float(ours.std) ** 2 == pytest.approx((b - a) ** 2 / 12 + d**2 / 9, rel=1e-14)
    assert float(ours.mean) == middle
    t = padded(0.0, 0.3, 0.55, 0.8, 0.97) * (w + d)
    # Only rectangles wider than t count: density 1 / (2 h), and (h - t) / (2 h) beyond t.
    density = [mixed(lambda h, s=s: (h > s) / (2 * h), s) for s in t]
    beyond = [mixed(lambda h, s=s: max(h - s, 0) / (2 * h), s) for s in t]
    for x in (middle - t, middle + t):
        np.testing.assert_allclose(np.exp(ours.log_density(x)), density, rtol=1e-9)
    np.testing.assert_allclose(ours.cdf(middle - t), beyond, rtol=1e-9)
    np.testing.assert_allclose(ours.cdf(middle + t), 1 - np.array(beyond), rtol=1e-9)


def test_trapezoid_is_the_sum_of_two_rectangles():
    """JCGM 101 6.4.4: R(a1, b1) + R(a2, b2) has beta = |w1 - w2| / (w1 + w2)."""
    ours = Trapezoidal(0.0, 4.0, (3.0 - 1.0) / 4.0)
    assert float(ours.std) ** 2 == pytest.approx(3.0**2 / 12 + 1.0**2 / 12)
    # P(U1 + U2 <= x) for widths 3 and 1.
    for x in (0.4, 1.0, 2.2, 3.7):
        exact = integrate.quad(lambda u, x=x: stats.uniform.cdf(x - u, 0, 3), 0, 1, points=[x % 1])
        assert float(ours.cdf(x)) == pytest.approx(exact[0], rel=1e-9)


def test_degrees_of_freedom():
    assert float(Normal(0, 1).dof) == np.inf
    assert float(Uniform(0, 1, dof=12).dof) == 12.0
    assert float(StudentT(0, 1, 4).dof) == 4.0
    # JCGM 101 6.4.9.4: the deviation exceeds the scale by sqrt(nu / (nu - 2)).
    assert float(StudentT(0, 2, 4).std) == pytest.approx(2 * np.sqrt(2))
    with pytest.raises(ValueError, match=r"found dof = 2\.0, expected more than 2"):
        _ = StudentT(0, 1, 2).std
    deviation = eqx.filter_jit(lambda d: d.std)
    assert np.isnan(deviation(StudentT(0, 1, 1.5)))
    assert float(deviation(StudentT(0, 1, 4))) == pytest.approx(np.sqrt(2))


def test_parameters_do_not_retrace():
    traced = []

    @eqx.filter_jit
    def third(d):
        traced.append(d)
        return d.quantile(1 / 3)

    values = [float(third(Normal(m, 1.0))) for m in (0.0, 1.0, 2.0)]
    assert len(traced) == 1
    assert np.diff(values) == pytest.approx([1.0, 1.0])


def test_derivatives_with_respect_to_parameters():
    p = np.full(SHAPE, 0.3)
    for make, alone in [
        (lambda s: Gamma(2.0, s), stats.gamma(2.0)),
        (lambda s: StudentT(0.0, s, 3.5), stats.t(3.5)),
    ]:
        moved = jax.jvp(lambda s, make=make: make(s).quantile(p), (1.5,), (1.0,))[1]
        np.testing.assert_allclose(moved, alone.ppf(p), rtol=1e-10)
    for refused in (
        lambda k: Gamma(k, 1.0).quantile(0.3),
        lambda a: Beta(a, 1.0).quantile(0.3),
        lambda nu: StudentT(0.0, 1.0, nu).quantile(0.3),
    ):
        with pytest.raises(NotImplementedError, match="hold the shape fixed"):
            jax.grad(refused)(2.0)


VALUES = np.array([3.0, -1.0, 2.0, 2.0, 7.5])
WEIGHTS = np.array([1.0, 2.0, 0.5, 2.5, 2.0])


def test_empirical_is_the_set_itself():
    ours = Empirical(VALUES)
    assert float(ours.mean) == pytest.approx(VALUES.mean())
    assert float(ours.std) == pytest.approx(VALUES.std(ddof=0))
    p = np.linspace(0.01, 1.0, SHAPE[0])
    np.testing.assert_array_equal(ours.quantile(p), np.quantile(VALUES, p, method="inverted_cdf"))
    x = padded(-2.0, -1.0, 1.9, 2.0, 2.1, 7.4, 7.5, 9.0)
    np.testing.assert_allclose(ours.cdf(x), stats.ecdf(VALUES).cdf.evaluate(x))
    x = np.resize(VALUES, SHAPE)
    np.testing.assert_array_equal(ours.quantile(ours.cdf(x)), x)
    assert [float(end) for end in ours.support] == [-1.0, 7.5]
    assert not ours.symmetric and Empirical([-1.0, 3.0, 1.0]).symmetric
    with pytest.raises(ValueError, match="no density"):
        ours.log_density(2.0)


@pytest.mark.parametrize("weights", [None, WEIGHTS])
def test_empirical_draws_have_the_weights(weights):
    ours, n = Empirical(VALUES, weights), N
    drawn = np.asarray(ours.sample(jax.random.key(2), (n,)))
    w = np.ones(len(VALUES)) if weights is None else weights
    levels = np.unique(VALUES)
    expected = np.array([w[VALUES == v].sum() for v in levels]) / w.sum() * n
    counted = np.array([(drawn == v).sum() for v in levels])
    assert counted.sum() == n
    assert stats.chisquare(counted, expected).pvalue > 1e-3
    assert float(ours.mean) == pytest.approx(np.average(VALUES, weights=w))
    spread = np.average((VALUES - float(ours.mean)) ** 2, weights=w)
    assert float(ours.std) == pytest.approx(np.sqrt(spread))
    via_scores = np.asarray(ours.from_score(np.random.default_rng(4).standard_normal(n)))
    counted = np.array([(via_scores == v).sum() for v in levels])
    assert stats.chisquare(counted, expected).pvalue > 1e-3


COVARIANCE = np.array([[4.0, 1.2, -0.6], [1.2, 1.0, 0.1], [-0.6, 0.1, 0.25]])


def within(found, exact, error):
    """Every element within four standard errors."""
    found, exact = np.asarray(found), np.asarray(exact)
    assert (np.abs(found - exact) <= 4 * error).all(), (found, exact, error)


def squared_distance(deviations):
    return np.einsum("ni,ij,nj->n", deviations, np.linalg.inv(COVARIANCE), deviations)


def test_multivariate_normal_moments():
    n, ours = N, MultivariateNormal([1.0, -2.0, 0.5], COVARIANCE, dof=[9, 9, 4])
    assert ours.dimension == 3 and ours.shape == (3,) and not ours.independent
    np.testing.assert_array_equal(ours.dof, [9, 9, 4])
    np.testing.assert_allclose(ours.root @ ours.root.T, COVARIANCE, rtol=0, atol=1e-14)
    drawn = np.asarray(ours.sample(jax.random.key(0), (n,)))
    assert drawn.shape == (n, 3) and ours.sample(jax.random.key(0)).shape == (3,)
    variance = np.diag(COVARIANCE)
    within(drawn.mean(0), ours.mean, np.sqrt(variance / n))
    error = np.sqrt((np.outer(variance, variance) + COVARIANCE**2) / n)
    within(np.cov(drawn.T), COVARIANCE, error)
    distance = np.einsum(
        "ni,ij,nj->n", drawn - ours.mean, np.linalg.inv(COVARIANCE), drawn - ours.mean
    )
    assert stats.kstest(distance, stats.chi2(3).cdf).pvalue > 1e-3
    assert MultivariateNormal([0, 0], np.diag([1.0, 0.0])).independent


def test_multivariate_t_moments():
    n, nu = N, 9.0
    ours = MultivariateT([1.0, -2.0, 0.5], COVARIANCE, nu)
    np.testing.assert_allclose(ours.covariance, COVARIANCE * nu / (nu - 2))
    np.testing.assert_array_equal(ours.dof, [nu] * 3)
    drawn = np.asarray(ours.sample(jax.random.key(6), (n,)))
    exact = np.asarray(ours.covariance)
    within(drawn.mean(0), ours.mean, np.sqrt(np.diag(exact) / n))
    # The fourth moments of t exceed the normal ones by (nu - 2) / (nu - 4).
    fourth = (nu - 2) / (nu - 4) * (np.outer(np.diag(exact), np.diag(exact)) + 2 * exact**2)
    within(np.cov(drawn.T), exact, np.sqrt((fourth - exact**2) / n))
    for i in range(3):
        one = stats.t(nu, float(ours.mean[i]), np.sqrt(COVARIANCE[i, i]))
        assert stats.kstest(drawn[:, i], one.cdf).pvalue > 1e-3
    distance = np.einsum(
        "ni,ij,nj->n", drawn - ours.mean, np.linalg.inv(COVARIANCE), drawn - ours.mean
    )
    assert stats.kstest(distance / 3, stats.f(3, nu).cdf).pvalue > 1e-3
    with pytest.raises(ValueError, match="expected more than 2"):
        _ = MultivariateT([0.0], [[1.0]], 2.0).covariance


def test_rank_deficient_matrices_work():
    """Perfectly correlated, and a sum that is known."""
    known_sum = np.eye(3) - 1 / 3
    for ours in (
        MultivariateNormal([1.0, 2.0, 3.0], known_sum),
        MultivariateT([1.0, 2.0, 3.0], known_sum, 5.0),
    ):
        drawn = np.asarray(ours.sample(jax.random.key(1), (N,)))
        np.testing.assert_allclose(drawn.sum(1), 6.0, atol=1e-12)
        assert drawn.std(0).min() > 0.5
    # Micrometres beside kilometres.
    scaled = np.diag([1e-6, 1e3]) @ np.array([[1.0, 0.5], [0.5, 1.0]]) @ np.diag([1e-6, 1e3])
    ours = MultivariateNormal([0.0, 0.0], scaled)
    np.testing.assert_allclose(ours.root @ ours.root.T, scaled, rtol=1e-13)
    copula = GaussianCopula([Uniform(0, 1), Uniform(0, 2), Uniform(0, 3)], np.ones((3, 3)))
    x, y, z = np.asarray(copula.sample(jax.random.key(1), (N,))).T
    np.testing.assert_allclose(y, 2 * x, atol=1e-12)
    np.testing.assert_allclose(z, 3 * x, atol=1e-12)
    fixed = MultivariateNormal([1.0, 2.0, 3.0], np.diag([0.0, 1.0, 2.0]))
    assert (np.asarray(fixed.sample(jax.random.key(1), (N,)))[:, 0] == 1.0).all()


@pytest.mark.parametrize("r", [-0.97, -0.4, 0.6, 0.99])
@pytest.mark.thorough
def test_copula_covariance_against_closed_forms(r):
    def covariance(one, other):
        return float(GaussianCopula([one, other], [[1.0, r], [r, 1.0]]).covariance[0, 1])

    assert covariance(Normal(3, 2), Normal(-1, 0.5)) == pytest.approx(r, rel=1e-10)
    # Pearson 1907: the correlation of the ranks.
    uniform = 6 / np.pi * np.arcsin(r / 2) * 2 * 5 / 12
    assert covariance(Uniform(0, 2), Uniform(-2, 3)) == pytest.approx(uniform, rel=1e-10)
    a, b = LogNormal(0.1, 0.5), LogNormal(-0.2, 0.9)
    exact = float(a.mean * b.mean) * np.expm1(r * 0.5 * 0.9)
    assert covariance(a, b) == pytest.approx(exact, rel=1e-10)
    # Stein: E[Z g(W)] = r E[W g(W)], here of exp(W).
    assert covariance(Normal(0, 3), LogNormal(0, 1)) == pytest.approx(
        3 * r * np.exp(0.5), rel=1e-10
    )
    # Sheppard: P(both above the median) = 1/4 + arcsin(r) / (2 pi).
    coin = Empirical([0.0, 1.0])
    assert covariance(coin, coin) == pytest.approx(np.arcsin(r) / (2 * np.pi), rel=1e-6)
    die = Empirical(VALUES, WEIGHTS)
    staircase = sum(
        step * stats.norm.pdf(stats.norm.ppf(level))
        for step, level in [(3.0, 2 / 8), (1.0, 5 / 8), (4.5, 6 / 8)]
    )
    assert covariance(Normal(0, 1), die) == pytest.approx(r * staircase, rel=1e-10)


@pytest.mark.parametrize(
    ("one", "other", "r"),
    [
        (Triangular(0.0, 1.0), LogNormal(0.0, 0.7), 0.8),
        (Arcsine(0.0, 2.0), Triangular(0.0, 1.0, 0.2), -0.95),
        (Trapezoidal(0.0, 2.0, 0.5), Uniform(0.0, 1.0), 0.4),
    ],
    ids=lambda x: getattr(x, "name", str(x)),
)
def test_copula_covariance_against_a_double_integral(one, other, r):
    # E[g1(Z1) g2(r Z1 + s Z2)] by the trapezoidal rule on scores.
    z = np.linspace(-9.0, 9.0, 601)
    w = stats.norm.pdf(z) * (z[1] - z[0])
    scored = eqx.filter_jit(lambda d, z: d.from_score(z))
    first = np.asarray(scored(one, z)) - float(one.mean)
    second = np.asarray(scored(other, r * z[:, None] + np.sqrt(1 - r**2) * z[None, :]))
    exact = (w * first) @ (second - float(other.mean)) @ w
    found = float(GaussianCopula([one, other], [[1.0, r], [r, 1.0]]).covariance[0, 1])
    assert found == pytest.approx(exact, rel=2e-6)
    assert abs(found) < abs(r) * float(one.std * other.std)


@pytest.mark.thorough
def test_copula_covariance_of_a_t_quantity():
    """E[Z1 g(Z2)] = r E[Z g(Z)], here with scipy's quantile of t."""

    def integrand(z):
        return z * stats.t.isf(stats.norm.sf(z), 3.0) * stats.norm.pdf(z)

    alone = 2 * integrate.quad(integrand, 0, 20, epsrel=1e-12)[0]
    ours = GaussianCopula([Normal(0, 2), StudentT(1, 5, 3)], [[1.0, -0.8], [-0.8, 1.0]])
    assert float(ours.covariance[0, 1]) == pytest.approx(-0.8 * 2 * 5 * alone, rel=1e-9)


@pytest.mark.parametrize("margin", [StudentT(0.0, 1.0, 2.5), Triangular(0, 1), Arcsine(0, 3)])
@pytest.mark.thorough
def test_copula_of_the_same_quantity_twice_is_its_variance(margin):
    twice = GaussianCopula([margin, margin], [[1.0, 1.0], [1.0, 1.0]])
    np.testing.assert_allclose(twice.covariance[0, 1], twice.covariance[0, 0], rtol=1e-6)


def test_copula_draws():
    margins = [LogNormal(0.0, 0.8), Uniform(-1, 1), Triangular(0, 1, 0)]
    r = np.array([[1.0, 0.7, -0.2], [0.7, 1.0, 0.3], [-0.2, 0.3, 1.0]])
    ours, n = GaussianCopula(margins, r), N
    drawn = np.asarray(ours.sample(jax.random.key(9), (n,)))
    assert drawn.shape == (n, 3)
    known = [stats.lognorm(0.8), stats.uniform(-1, 2), stats.triang(0, 0, 1)]
    levels = np.stack([m.cdf(x) for m, x in zip(known, drawn.T, strict=True)])
    for u in levels:
        assert stats.kstest(u, "uniform").pvalue > 1e-3
    within(np.corrcoef(stats.norm.ppf(levels)), r, (1 - r**2) / np.sqrt(n) + 1e-12)
    spread = drawn - drawn.mean(0)
    products = spread[:, :, None] * spread[:, None, :]
    within(products.mean(0), ours.covariance, products.std(0) / np.sqrt(n))
    # The product moments are not those of the scores.
    exact = np.asarray(ours.covariance)
    moments = exact / np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs(moments - r).max() > 0.01


CORRELATION = {("V", "L"): 0.6, ("L", "T"): -0.3}
INPUTS = Inputs(
    {
        "V": Normal(5.0, 0.1, dof=4),
        "phi": MultivariateNormal([1.0, 2.0], [[0.04, 0.01], [0.01, 0.09]], dof=6),
        "T": Uniform(19.0, 21.0),
        "L": LogNormal(0.0, 0.5),
        "s": Arcsine(-1.0, 1.0),
    },
    correlation=CORRELATION,
)


def test_inputs_in_a_row():
    assert INPUTS.names == ("V", "phi", "T", "L", "s")
    assert INPUTS.labels == ("V", "phi[0]", "phi[1]", "T", "L", "s")
    assert INPUTS.kinds[:3] == ("normal", "multivariate_normal", "multivariate_normal")
    assert INPUTS.size == 6 and not INPUTS.independent and not INPUTS.symmetric
    np.testing.assert_array_equal(INPUTS.dof, [4, 6, 6, np.inf, np.inf, np.inf])
    np.testing.assert_allclose(
        INPUTS.flat_mean, [5.0, 1.0, 2.0, 20.0, np.exp(0.125), 0.0], atol=1e-15
    )
    values = INPUTS.unflatten(jnp.arange(6.0))
    assert set(values) == set(INPUTS.names) and values["V"].shape == ()
    np.testing.assert_array_equal(values["phi"], [1.0, 2.0])
    np.testing.assert_array_equal(INPUTS.flatten(values), np.arange(6.0))
    batch = INPUTS.unflatten(jnp.ones((7, 6)))
    assert batch["V"].shape == (7,) and batch["phi"].shape == (7, 2)
    assert list(INPUTS.mean) == list(INPUTS.distributions) == list(INPUTS.names)


def test_covariance_of_inputs():
    c = np.asarray(INPUTS.covariance)
    np.testing.assert_allclose(np.sqrt(np.diag(c)), INPUTS.std, rtol=1e-14)
    np.testing.assert_allclose(c[1:3, 1:3], [[0.04, 0.01], [0.01, 0.09]])
    pair = GaussianCopula([Normal(5.0, 0.1), LogNormal(0.0, 0.5)], [[1.0, 0.6], [0.6, 1.0]])
    assert c[0, 4] == c[4, 0] == pytest.approx(float(pair.covariance[0, 1]), rel=1e-12)
    assert c[3, 4] < 0.0
    # V and T are both correlated with L, but not with each other.
    apart = np.ones((6, 6), bool)
    for i, j in [(0, 4), (3, 4), (1, 2)]:
        apart[i, j] = apart[j, i] = False
    np.fill_diagonal(apart, False)
    assert (c[apart] == 0.0).all()
    n = N
    draws = jax.jit(jax.vmap(INPUTS.sample))(jax.random.split(jax.random.key(0), n))
    flat = np.asarray(jax.vmap(INPUTS.flatten)(draws))
    spread = flat - flat.mean(0)
    products = spread[:, :, None] * spread[:, None, :]
    within(flat.mean(0), INPUTS.flat_mean, flat.std(0) / np.sqrt(n))
    within(products.mean(0), c, products.std(0) / np.sqrt(n))


def test_draws_of_inputs_depend_on_the_key_alone():
    key = jax.random.key(4)
    direct = INPUTS.sample(key)
    compiled = eqx.filter_jit(lambda inputs, key: inputs.sample(key))(INPUTS, key)
    for name, value in direct.items():
        np.testing.assert_allclose(compiled[name], value, rtol=1e-14)
    longer = Inputs(
        INPUTS.distributions | {"new": Normal(0, 1)}, {("V", "L"): 0.6, ("L", "T"): -0.3}
    )
    more = longer.sample(key)
    for name, value in direct.items():
        np.testing.assert_array_equal(more[name], value)
    plain = Inputs({"a": Normal(0, 1), "b": Normal(0, 1)})
    assert plain.independent and plain.symmetric
    assert float(plain.sample(key)["a"]) != float(plain.sample(key)["b"])


def test_inputs_survive_a_compiled_function():
    back = eqx.filter_jit(lambda inputs: inputs)(INPUTS)
    assert back.names == INPUTS.names and back.labels == INPUTS.labels
    np.testing.assert_array_equal(back.std, INPUTS.std)


TWO = {"x": Normal(0, 1), "y": Normal(0, 1)}
THREE = TWO | {"z": Normal(0, 1)}
MISTAKES = {
    "negative std": (lambda: Normal(0, -0.1), r"normal: found std = -0\.1, expected .* above 0"),
    "zero std": (lambda: Normal(0, 0), r"found std = 0\.0"),
    "zero scale": (lambda: StudentT(0, 0, 3), r"t: found scale = 0\.0"),
    "dof 0": (lambda: StudentT(0, 1, 0), r"found dof = 0\.0"),
    "dof -1": (lambda: Uniform(0, 1, dof=-1), r"found dof = -1\.0, expected a number above 0"),
    "dof nan": (lambda: Uniform(0, 1, dof=np.nan), "found dof = nan"),
    "nan mean": (lambda: Normal(np.nan, 1), "found mean = nan, expected a finite number"),
    "infinite std": (lambda: Normal(0, np.inf), "found std = inf, expected a finite number"),
    "text": (lambda: Normal("a", 1), "found 'a', expected one number"),
    "list": (lambda: Normal([1, 2], 1), "expected one number"),
    "low above high": (lambda: Uniform(2, 1), r"found low = 2\.0 and high = 1\.0, expected low <"),
    "low is high": (lambda: Arcsine(1, 1), "expected low < high"),
    "infinite limit": (lambda: Triangular(0, np.inf), "found high = inf"),
    "mode outside": (lambda: Triangular(0, 1, 2), r"found mode = 2\.0, expected it between"),
    "top": (lambda: Trapezoidal(0, 1, 1.2), r"found top = 1\.2, expected the ratio"),
    "inexact": (lambda: CurvilinearTrapezoid(0, 1, 0.5), r"expected low \+ inexact < high"),
    "inexact 0": (lambda: CurvilinearTrapezoid(0, 1, 0.0), r"found inexact = 0\.0"),
    "sigma": (lambda: LogNormal(0, -1), r"log_normal: found sigma = -1\.0"),
    "gamma": (lambda: Gamma(-2, 1), r"gamma: found shape = -2\.0"),
    "beta": (lambda: Beta(1, 0), r"beta: found b = 0\.0"),
    "beta limits": (lambda: Beta(1, 1, 2, 1), "expected low < high"),
    "one value": (lambda: Empirical([1.0]), "found 1 different values"),
    "equal values": (lambda: Empirical([1.0, 1.0]), "found 1 different values"),
    "nan value": (lambda: Empirical([1.0, np.nan]), "found nan at position 1"),
    "table": (lambda: Empirical([[1.0, 2.0]]), r"found shape \(1, 2\)"),
    "weights": (lambda: Empirical([1.0, 2.0], [1.0]), "found 2 values and 1 weights"),
    "negative weight": (lambda: Empirical([1.0, 2.0], [1, -1]), "found weights down to -1"),
    "one weight": (lambda: Empirical([1.0, 2.0], [0, 1]), "found 1 different values"),
    "zero weights": (lambda: Empirical([1.0, 2.0], [0, 0]), "found 0 different values"),
    "not definite": (
        lambda: MultivariateNormal([0, 0], [[1.0, 2.0], [2.0, 1.0]]),
        r"smallest eigenvalue of their matrix is -1, expected none below 0",
    ),
    "t not definite": (
        lambda: MultivariateT([0, 0], [[1.0, 2.0], [2.0, 1.0]], 5),
        "multivariate_t: scale_matrix: .* smallest eigenvalue",
    ),
    "not symmetric": (
        lambda: MultivariateNormal([0, 0], [[1.0, 0.2], [0.3, 1.0]]),
        r"not symmetric: the elements \(0, 1\) and \(1, 0\) differ by 0\.1",
    ),
    "size": (
        lambda: MultivariateNormal([0, 0, 0], np.eye(2)),
        r"shape \(2, 2\), expected \(3, 3\)",
    ),
    "ragged": (lambda: MultivariateNormal([0, 0], [[1], [0, 1]]), "differ in length"),
    "nan covariance": (lambda: MultivariateNormal([0], [[np.nan]]), "found nan at position"),
    "variance": (lambda: MultivariateNormal([0, 0], np.diag([1, -1])), r"the variance -1\.0"),
    "no variance": (
        lambda: MultivariateNormal([0, 0], [[0, 0.1], [0.1, 1]]),
        "variance of 0 at position 0 with covariances that are not 0",
    ),
    "t dof": (lambda: MultivariateT([0], [[1]], -1), r"found dof = -1\.0"),
    "dof length": (lambda: MultivariateNormal([0], [[1]], dof=[1, 2]), r"dof: found shape \(2,\)"),
    "diagonal": (lambda: GaussianCopula([Normal(0, 1)], [[2.0]]), r"found 2\.0 at position 0"),
    "beyond one": (
        lambda: GaussianCopula([Normal(0, 1)] * 2, [[1, 1.5], [1.5, 1]]),
        r"found 1\.5 at position \(0, 1\), expected a correlation from -1 to 1",
    ),
    "margin": (
        lambda: GaussianCopula([MultivariateNormal([0], [[1]])], [[1.0]]),
        "expected a univariate distribution",
    ),
    "no inputs": (lambda: Inputs({}), "found none, expected at least one"),
    "a number": (lambda: Inputs({"x": 1.0}), "found 1.0 for 'x', expected a distribution"),
    "unknown input": (
        lambda: Inputs({"speed": Normal(0, 1), "y": Normal(0, 1)}, {("sped", "y"): 0.1}),
        r"unknown input 'sped' \(did you mean 'speed'\?\), expected one of speed, y",
    ),
    "with itself": (lambda: Inputs(TWO, {("x", "x"): 0.5}), "a name with itself"),
    "twice": (lambda: Inputs(TWO, {("x", "y"): 0.5, ("y", "x"): 0.4}), "stated twice"),
    "no pair": (lambda: Inputs(TWO, {"xy": 0.5}), "expected a pair of names"),
    "r": (lambda: Inputs(TWO, {("x", "y"): 1.1}), r"found 1\.1 for \('x', 'y'\)"),
    "r nan": (lambda: Inputs(TWO, {("x", "y"): np.nan}), "found nan"),
    "of an array": (
        lambda: Inputs(TWO | {"v": MultivariateNormal([0], [[1]])}, {("x", "v"): 0.5}),
        "v is multivariate, expected two univariate inputs",
    ),
    "cannot all hold": (
        lambda: Inputs(THREE, {("x", "y"): 0.9, ("y", "z"): 0.9, ("x", "z"): -0.9}),
        r"of x, y, z cannot all hold: the smallest eigenvalue of their matrix is -0\.8",
    ),
    "missing value": (lambda: Inputs(TWO).flatten({"x": 1.0}), "y missing, expected x, y"),
    "unknown value": (lambda: Inputs(TWO).flatten({"x": 1, "y": 1, "w": 1}), "unknown input 'w'"),
    "shape": (lambda: Inputs(TWO).flatten({"x": [1.0], "y": 1}), r"found x of shape \(1,\)"),
    "length": (lambda: Inputs(TWO).unflatten(jnp.ones(3)), "found 3 numbers, expected 2"),
}


@pytest.mark.parametrize(("make", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_distributions_by_name():
    made = distribution("curvilinear_trapezoid", low=-1, high=1, inexact=0.1)
    assert float(made.std) == pytest.approx(np.sqrt(4 / 12 + 0.01 / 9))
    assert float(distribution("gamma", shape=2, scale=3).mean) == 6.0
    assert all(kind.name == name for name, kind in CATALOGUE.items())
    assert len(CATALOGUE) == 21
    for name, settings, message in [
        (
            "unifrom",
            {},
            r"unknown distribution 'unifrom' \(did you mean 'uniform'\?\); known: .*normal",
        ),
        ("normal", {"mean": 0, "sdt": 1}, r"unknown setting 'sdt' \(did you mean 'std'\?\)"),
        ("normal", {"mean": 0}, "std missing; it takes mean, std, dof"),
        ("normal", {"mean": 0, "std": -1}, r"found std = -1\.0"),
    ]:
        with pytest.raises(StudyError, match=message):
            distribution(name, **settings)


def test_float32_is_refused():
    with jax.enable_x64(False):
        for make in (
            lambda: Normal(0, 1),
            lambda: Empirical([1.0, 2.0]),
            lambda: MultivariateNormal([0.0], [[1.0]]),
        ):
            with pytest.raises(RuntimeError, match="computes in float64"):
                make()
