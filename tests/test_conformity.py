"""Conformity by JCGM 106: printed examples, and risks against quadrature and counts by scipy."""

import math

import numpy as np
import pytest
from scipy import integrate, optimize, stats

from vcal.distributions import Inputs, LogNormal, Normal, StudentT, Triangular, Uniform
from vcal.uncertainty import (
    Tolerance,
    conformity,
    global_risks,
    guard_band_for_risk,
    propagate,
    propagate_distributions,
)


def test_printed_conformance_probabilities():
    """JCGM 106, 7.3.3: a Zener diode, V, and a container, kPa; 7.4: viscosity of an oil, mm2/s."""
    zener = conformity(Normal(-5.47, 0.05), Tolerance(upper=-5.40))
    burst = conformity(Normal(509.7, 8.6), Tolerance(lower=490.0))
    oil = conformity(Normal(13.6, 1.8), Tolerance(12.5, 16.3))
    assert [round(one.probability, 2) for one in (zener, burst, oil)] == [0.92, 0.99, 0.66]
    assert oil.probability == pytest.approx(stats.norm.cdf(1.5) - stats.norm.cdf(-1.1 / 1.8))
    assert [one.verdict for one in (zener, burst, oil)] == ["undecided", "conforms", "undecided"]
    assert oil.consumer_risk == pytest.approx(1.0 - oil.probability)
    assert oil.producer_risk == oil.probability
    assert np.isnan(oil.acceptance).all(), "the tolerance is narrower than 2 U"


@pytest.mark.parametrize(
    ("p", "z"), [(0.80, 0.84), (0.90, 1.28), (0.95, 1.64), (0.99, 2.33), (0.999, 3.09)]
)
def test_guard_bands_of_table_1(p, z):
    upper = conformity(Normal(0.0, 2.0), Tolerance(upper=20.0), risk=1.0 - p)
    lower = conformity(Normal(0.0, 2.0), Tolerance(lower=-20.0), risk=1.0 - p)
    assert round(upper.guard_band[1] / 2.0, 2) == round(lower.guard_band[0] / 2.0, 2) == z
    assert upper.guard_band[0] == 0.0 and lower.acceptance[1] == math.inf
    assert upper.rejection[1] == pytest.approx(20.0 + upper.guard_band[1])


LAWS = {
    "normal": (Normal(0.0, 1.0), stats.norm(0.0, 1.0)),
    "t": (StudentT(0.0, 1.0, 5.0), stats.t(5.0)),
    "skewed": (LogNormal(0.0, 0.5), stats.lognorm(0.5)),
    "bounded": (Triangular(0.0, 4.0, mode=1.0), stats.triang(0.25, 0.0, 4.0)),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("width", [6.0, 8.0])
def test_limits_of_two_sides_are_where_the_probability_is_reached(name, width):
    own, law = LAWS[name]
    tolerance, mean = Tolerance(0.0, width), law.mean()

    def probability(y):
        return law.cdf(width + mean - y) - law.cdf(mean - y)

    y = np.linspace(-6.0, width + 6.0, 4001)
    for risk in (0.05, 0.2):
        found = conformity(own, tolerance, risk=risk)
        p = probability(y)
        inside, kept = y[p >= 1.0 - risk], y[p > risk]
        np.testing.assert_allclose(found.acceptance, (inside[0], inside[-1]), atol=8e-3)
        np.testing.assert_allclose(found.rejection, (kept[0], kept[-1]), atol=8e-3)
        for end in found.acceptance:
            assert probability(end) == pytest.approx(1.0 - risk, abs=1e-9)
        for end in found.rejection:
            assert probability(end) == pytest.approx(risk, abs=1e-9)


def test_draws_decide_as_their_distribution():
    draws = stats.triang(0.25, 0.0, 4.0).ppf((np.arange(100_000) + 0.5) / 100_000)
    tolerance = Tolerance(-1.0, 3.0)
    counted = conformity(draws, tolerance, risk=0.1)
    known = conformity(Triangular(0.0, 4.0, mode=1.0), tolerance, risk=0.1)
    assert counted.probability == pytest.approx(known.probability, abs=2e-5)
    np.testing.assert_allclose(counted.acceptance, known.acceptance, atol=1e-4)
    np.testing.assert_allclose(counted.rejection, known.rejection, atol=2e-3)
    assert counted.verdict == known.verdict == "conforms"
    p = counted.probability
    assert counted.u_probability == pytest.approx(math.sqrt(p * (1.0 - p) / 100_000))
    assert known.u_probability == 0.0 and known.draws is None and counted.draws == 100_000


def test_results_of_both_methods_are_judged():
    inputs = Inputs({"a": Normal(10.0, 0.3), "b": Normal(0.0, 0.4, dof=9)})
    function = lambda v: {"sum": v["a"] + v["b"], "b": v["b"]}  # noqa: E731
    tolerance = Tolerance(upper=10.9)
    budget = propagate(function, inputs)
    found = conformity(budget, tolerance, "sum")
    nu = math.floor(0.5**4 / (0.4**4 / 9.0))
    assert found.probability == pytest.approx(stats.t.cdf(0.9 / 0.5, nu))
    assert found.acceptance[1] == pytest.approx(10.9 - 0.5 * stats.t.ppf(0.95, nu))
    drawn = propagate_distributions(function, inputs, 20_000)
    counted = conformity(drawn, tolerance, "sum")
    assert counted.probability == pytest.approx(stats.norm.cdf(1.8), abs=4 * counted.u_probability)
    with pytest.raises(ValueError, match="has 2, sum, b; name the one to judge"):
        conformity(budget, tolerance)


def test_a_sketch_is_judged_as_its_values():
    from dataclasses import replace

    from vcal.uncertainty.quantile_counts import sketch_of

    inputs = Inputs({"a": Normal(0.0, 1.0)})
    exact = propagate_distributions(lambda v: v["a"] ** 2, inputs, 20_000)
    sketch = sketch_of(exact.values[:10_000])
    sketch.add(exact.values)
    column = sketch.column(float(exact.minimum[0]), float(exact.maximum[0]), 0)
    large = replace(exact, kept="sketch", columns=(column,))
    one, other = (conformity(e, Tolerance(upper=3.0)) for e in (exact, large))
    assert other.probability == pytest.approx(one.probability, abs=1e-4)
    assert other.acceptance[1] == pytest.approx(one.acceptance[1], abs=5e-3)
    assert other.draws == 20_000


def test_a_stated_guard_band_and_simple_acceptance():
    for y, verdict in ((9.4, "conforms"), (9.8, "undecided"), (10.7, "does_not_conform")):
        found = conformity(Normal(y, 0.25), Tolerance(0.0, 10.0), guard_band=0.5)
        assert (found.verdict, found.acceptance) == (verdict, (0.5, 9.5))
        assert found.rejection == (-0.5, 10.5) and found.guard_band == (0.5, 0.5)
    for y, verdict in ((9.9, "conforms"), (10.1, "does_not_conform")):
        assert conformity(Normal(y, 1.0), Tolerance(0.0, 10.0), rule="simple").verdict == verdict


# --- global risks ---


RESISTOR = (Normal(1500.0, 0.12), 0.04, Tolerance(1499.8, 1500.2))
"""JCGM 106, 9.5.4: resistors of a process, ohm, and their measurement."""


def by_scipy(prior, error, tolerance, w):
    """Both risks by adaptive quadrature of scipy."""
    low, high = tolerance.lower, tolerance.upper

    def passed(x):
        return error.cdf(high - w - x) - error.cdf(low + w - x)

    def over(a, b, f):
        a, b = max(a, prior.ppf(1e-15)), min(b, prior.isf(1e-15))
        points = [x for x in (low + w, high - w, low, high) if a < x < b]
        return integrate.quad(f, a, b, points=points or None, epsabs=1e-13, limit=400)[0]

    outside = lambda x: prior.pdf(x) * passed(x)  # noqa: E731
    consumer = over(-np.inf, low, outside) + over(high, np.inf, outside)
    return consumer, over(low, high, lambda x: prior.pdf(x) * (1.0 - passed(x)))


@pytest.mark.parametrize("w", [-0.03, 0.0, 0.08])
def test_global_risks_of_a_normal_process(w):
    found = global_risks(*RESISTOR, guard_band=w)
    expected = by_scipy(stats.norm(1500.0, 0.12), stats.norm(0.0, 0.04), RESISTOR[2], w)
    assert (found.consumer, found.producer) == pytest.approx(expected, abs=1e-11)
    assert found.conforming == pytest.approx(1.0 - 2.0 * stats.norm.sf(0.2 / 0.12), abs=1e-13)
    spread = math.hypot(0.12, 0.04)
    assert found.accepted == pytest.approx(1.0 - 2.0 * stats.norm.sf((0.2 - w) / spread), abs=1e-12)
    assert found.conforming - found.producer + found.consumer == pytest.approx(found.accepted)
    assert found.consumer_of_accepted == pytest.approx(found.consumer / found.accepted)


def test_global_risks_of_other_distributions_and_one_limit():
    prior, error = LogNormal(0.0, 0.3), Uniform(-0.2, 0.2)
    found = global_risks(prior, error, Tolerance(upper=1.4), guard_band=0.05)
    expected = by_scipy(stats.lognorm(0.3), stats.uniform(-0.2, 0.4), Tolerance(upper=1.4), 0.05)
    assert (found.consumer, found.producer) == pytest.approx(expected, abs=1e-5)
    random = np.random.default_rng(3)
    true = random.lognormal(0.0, 0.3, 1_000_000)
    accepted = true + random.uniform(-0.2, 0.2, true.size) <= 1.35
    counted = [np.mean(accepted & (true > 1.4)), np.mean(~accepted & (true <= 1.4))]
    for share, risk in zip(counted, (found.consumer, found.producer), strict=True):
        assert share == pytest.approx(risk, abs=4.0 * math.sqrt(risk / 1e6))


def test_guard_band_for_a_wanted_risk():
    w = guard_band_for_risk(*RESISTOR, 0.001)
    assert global_risks(*RESISTOR, guard_band=w).consumer == pytest.approx(0.001, rel=1e-8)
    law, error = stats.norm(1500.0, 0.12), stats.norm(0.0, 0.04)
    oracle = optimize.brentq(lambda w: by_scipy(law, error, RESISTOR[2], w)[0] - 0.001, 0.0, 0.2)
    assert w == pytest.approx(oracle, abs=1e-7)
    wide = guard_band_for_risk(*RESISTOR, 0.005, of="producer")
    assert wide < 0.0
    assert global_risks(*RESISTOR, guard_band=wide).producer == pytest.approx(0.005, rel=1e-8)
    with pytest.raises(ValueError, match="risk of 0.9, expected one from .* smaller uncertainty"):
        guard_band_for_risk(*RESISTOR, 0.9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Tolerance(), "found no limit"),
        (lambda: Tolerance(2.0, 1.0), "lower = 2 and upper = 1, expected lower < upper"),
        (lambda: conformity(Normal(0, 1), Tolerance(upper=1), risk=0.7), "risk: found 0.7"),
        (lambda: conformity(Normal(0, 1), Tolerance(upper=1), rule="strict"), "rule: found 'str"),
        (lambda: conformity(Normal(0, 1), Tolerance(upper=1), guard_band=-1.0), "guard band: fo"),
        (lambda: conformity(np.ones(1), Tolerance(upper=1)), "found 1 values"),
        (lambda: global_risks(Normal(0, 1), 0.0, Tolerance(upper=1)), "uncertainty of 0, expec"),
        (lambda: guard_band_for_risk(*RESISTOR, 0.1, of="both"), "of: found 'both'"),
    ],
)
def test_bad_requirements_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_results_of_another_kind_are_refused():
    with pytest.raises(TypeError, match="found tuple, expected a result of propagate"):
        conformity((1.0, 0.1), Tolerance(upper=1))
    with pytest.raises(TypeError, match="prior: found 0.1, expected a univariate"):
        global_risks(0.1, 0.1, Tolerance(upper=1))
