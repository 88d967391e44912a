"""The GUM against Monte Carlo by clause 8 of JCGM 101, and how often intervals hold the truth."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from vcal.distributions import Inputs, Normal, StudentT, Uniform
from vcal.uncertainty.adaptive import Precision
from vcal.uncertainty.comparison import attained_coverage, compare
from vcal.uncertainty.functions import propagate_distributions
from vcal.uncertainty.propagation import propagate
from vcal.uncertainty.table import comparison_table

ROOT3 = math.sqrt(3.0)


def total(values):
    return sum(values.values())


def mass(values):
    """JCGM 101, 9.3: deviation from 100 g, mg."""
    buoyancy = (values["rho_a"] - 1.2) * (1 / values["rho_W"] - 1 / values["rho_R"])
    return (values["m_Rc"] + values["dm_Rc"]) * (1 + buoyancy) - 1e5


MASS = Inputs(
    {
        "m_Rc": Normal(1e5, 0.05),
        "dm_Rc": Normal(1.234, 0.02),
        "rho_a": Uniform(1.1, 1.3),
        "rho_W": Uniform(7000, 9000),
        "rho_R": Uniform(7950, 8050),
    }
)


@pytest.fixture(scope="module")
def weighed():
    return propagate_distributions(mass, MASS, 1_000_000, seed=1)


@pytest.mark.thorough
def test_jcgm_101_9_3_first_order_fails_and_second_order_passes(weighed):
    first = compare(propagate(mass, MASS), weighed, digits=1)
    second = compare(propagate(mass, MASS, order=2), weighed, digits=1)
    assert first.delta[0] == second.delta[0] == pytest.approx(0.005)
    # Monte Carlo: 0.0755, [1.084, 1.384]; first order [1.1285, 1.3395], second [1.0871, 1.3809].
    assert first.d_low[0] == pytest.approx(0.0445, abs=1.5e-3)
    assert first.d_high[0] == pytest.approx(0.0445, abs=1.5e-3)
    assert max(second.d_low[0], second.d_high[0]) < 0.0045
    assert not first.passed[0] and second.passed[0]
    assert first.verdicts == ("failed",) and second.verdicts == ("passed",)


def test_two_digits_ask_for_more_than_the_second_order_gives(weighed):
    comparison = compare(propagate(mass, MASS, order=2), weighed)
    assert comparison.delta[0] == pytest.approx(0.0005)
    assert not comparison.passed[0]
    assert comparison.verdicts == ("failed",)


def test_differences_against_a_monte_carlo_of_numpy(weighed):
    rng, n = np.random.default_rng(5), 1_000_000
    drawn = {
        "m_Rc": rng.normal(1e5, 0.05, n),
        "dm_Rc": rng.normal(1.234, 0.02, n),
        "rho_a": rng.uniform(1.1, 1.3, n),
        "rho_W": rng.uniform(7000, 9000, n),
        "rho_R": rng.uniform(7950, 8050, n),
    }
    low, high = np.quantile(mass(drawn), [0.025, 0.975])
    comparison = compare(propagate(mass, MASS), weighed)
    # Both ends scatter by sqrt(p (1 - p) / n) / density: about 2.5e-4 at each of the two.
    assert comparison.d_low[0] == pytest.approx(abs(1.12845 - low), abs=1.1e-3)
    assert comparison.d_high[0] == pytest.approx(abs(1.33955 - high), abs=1.1e-3)
    assert 1e-4 < comparison.precision.low[0] < 5e-4


def test_inputs_that_cancel_leave_rounding_and_nothing_to_judge():
    """3 x - y with sd(y) = 3 sd(x) and r = 1 is constant; what sums leave is no uncertainty."""
    inputs = Inputs({"x": Normal(1.0, 0.1), "y": Normal(2.0, 0.3)}, correlation={("x", "y"): 1.0})

    def constant(q):
        return {"f": 3.0 * q["x"] - q["y"]}

    drawn = propagate_distributions(constant, inputs, 20_000, seed=1)
    found = compare(propagate(constant, inputs), drawn)
    assert found.verdicts == ("passed",) and found.delta[0] < 1e-12


@pytest.mark.thorough
def test_jcgm_101_9_2_normal_passes_and_a_dominant_rectangle_fails():
    def several(values):
        x, y = values["x"], values["y"]
        return {"normal": total(x), "rectangular": total(y) + 9.0 * y["a"]}

    def flat(values):
        x = {name: values[name] for name in "abcd"}
        y = {name[1:]: values[name] for name in ("ra", "rb", "rc", "rd")}
        return several({"x": x, "y": y})

    normal = {name: Normal(0, 1) for name in "abcd"}
    rectangular = {f"r{name}": Uniform(-ROOT3, ROOT3) for name in "abcd"}
    inputs = Inputs(normal | rectangular)
    ensemble = propagate_distributions(flat, inputs, 500_000, seed=2)
    comparison = compare(propagate(flat, inputs), ensemble, digits=2)
    assert comparison.labels == ("normal", "rectangular")
    assert comparison.u[:, 0] == pytest.approx([2.0, 10.15], abs=5e-3)
    assert comparison.delta == pytest.approx([0.05, 0.5])
    # +/-3.92 by both; +/-19.9 by the GUM against +/-17.0.
    assert comparison.high[:, 0] == pytest.approx([3.92, 19.9], abs=0.01)
    assert comparison.high[:, 1] == pytest.approx([3.92, 17.0], abs=0.05)
    assert comparison.verdicts == ("passed", "failed")


def test_jcgm_101_9_4_no_interval_of_the_gum_stands_at_the_origin():
    def mismatch(values):
        return 1e6 * (values["x1"] ** 2 + values["x2"] ** 2)

    inputs = Inputs({"x1": Normal(0.0, 0.005), "x2": Normal(0.0, 0.005)})
    ensemble = propagate_distributions(mismatch, inputs, 300_000, seed=3)
    first = compare(propagate(mismatch, inputs), ensemble, digits=1, kind="shortest")
    second = compare(propagate(mismatch, inputs, order=2), ensemble, digits=1, kind="shortest")
    # The first-order u is zero: delta comes from the Monte Carlo's.
    assert first.u[0, 0] == 0.0 and first.delta[0] == pytest.approx(5.0)
    assert first.d_high[0] == pytest.approx(2 * 25 * math.log(20), abs=2.0)
    assert first.verdicts == second.verdicts == ("failed",)
    # y and u agree at second order, the interval [-48, 148] against [0, 149.8] does not.
    assert second.value[0] == pytest.approx([50.0, 50.0], abs=0.5)
    assert second.u[0] == pytest.approx([50.0, 50.0], abs=0.5)
    assert second.d_low[0] == pytest.approx(48.0, abs=0.2)


@pytest.mark.thorough
def test_scale_of_t_makes_the_gum_right_for_one_t():
    # Standard deviation and coverage factor of t together would count the tails twice.
    inputs = Inputs({"x": StudentT(10.0, 2.0, 5.0)})
    budget = propagate(lambda v: v["x"], inputs)
    exact = stats.t.interval(0.95, 5, loc=10.0, scale=2.0)
    assert budget.interval("y") == pytest.approx(exact, rel=1e-9)
    comparison = compare(budget, propagate_distributions(lambda v: v["x"], inputs, 400_000))
    assert comparison.u[0] == pytest.approx([2.0, 2.0 * math.sqrt(5 / 3)], abs=0.02)
    assert comparison.verdicts == ("passed",)


def test_few_draws_leave_a_close_verdict_open(weighed):
    few = propagate_distributions(mass, MASS, 20_000, seed=4)
    close = compare(propagate(mass, MASS, order=2), weighed, digits=1)
    doubt = np.array([0.0025])
    rough = dataclasses.replace(close, precision=Precision(doubt, doubt, doubt, doubt))
    assert close.verdicts == ("passed",)
    assert rough.verdicts == ("undecided",) and rough.passed[0]
    # What is far off stays failed with any number of draws.
    far = compare(propagate(mass, MASS), few, digits=1)
    assert far.verdicts == ("failed",)


def test_fewer_than_two_blocks_say_nothing_of_their_precision():
    inputs = Inputs({"x": Normal(0.0, 1.0)})
    few = propagate_distributions(total, inputs, 5_000)
    comparison = compare(propagate(total, inputs), few)
    assert np.isinf(comparison.precision.low[0])
    assert comparison.verdicts == ("undecided",)


def test_coverage_probability_is_that_of_the_budget(weighed):
    budget = propagate(mass, MASS, order=2, coverage=0.6827)
    comparison = compare(budget, weighed, digits=1)
    assert comparison.coverage == 0.6827
    assert comparison.low[0, 1] == weighed.interval("y", 0.6827)[0]
    assert comparison.low[0, 0] == budget.interval("y")[0]


def test_results_of_different_functions_are_refused(weighed):
    inputs = Inputs({"x": Normal(0.0, 1.0)})
    other = propagate(lambda v: {"z": v["x"]}, inputs)
    with pytest.raises(ValueError, match="no scalar output 'z', only y"):
        compare(other, weighed)


def test_digits_are_one_or_two(weighed):
    with pytest.raises(ValueError, match="digits: found 3"):
        compare(propagate(mass, MASS), weighed, digits=3)  # type: ignore[arg-type]


def test_comparison_as_a_table(weighed):
    text = comparison_table(compare(propagate(mass, MASS), weighed, digits=1))
    lines = text.splitlines()
    assert len(lines) == 4 and len({line.count("|") for line in lines}) == 1
    assert lines[2].startswith("| y | GUM | 1.2340 | 0.0539 | 1.1285 | 1.3395 |")
    assert "| 0.005 | 0.04" in lines[3] and lines[3].endswith("| failed |")


# --- attained coverage ---


def test_attained_coverage_of_t_and_of_normal_intervals():
    rng = np.random.default_rng(7)
    data = rng.normal(3.0, 2.0, (20_000, 5))
    mean, u = data.mean(1), data.std(1, ddof=1) / math.sqrt(5)
    half = np.stack([stats.t.ppf(0.975, 4) * u, 1.96 * u], axis=1)
    attained = attained_coverage(mean[:, None] - half, mean[:, None] + half, 3.0)
    exact = np.array([0.95, 1 - 2 * stats.t.sf(1.96, 4)])
    assert attained.u == pytest.approx(np.sqrt(exact * (1 - exact) / 20_000), rel=0.05)
    assert np.all(np.abs(attained.share - exact) < 3 * attained.u)
    low, high = attained.bounds()
    assert np.all((low < attained.share) & (attained.share < high))


def test_interval_of_the_gum_covers_over_simulated_truth():
    # A budget per case: the truth drawn, read with noise, and evaluated.
    rng = np.random.default_rng(8)
    truth = rng.uniform(0.5, 1.5, 400)
    readings = truth + rng.normal(0.0, 0.01, 400)

    def root(values):
        return jnp.sqrt(values["x"])

    budgets = [propagate(root, Inputs({"x": Normal(x, 0.01)})) for x in readings]
    low, high = np.array([budget.interval("y") for budget in budgets]).T
    attained = attained_coverage(low, high, np.sqrt(truth))
    assert attained.cases == 400
    assert abs(attained.share - 0.95) < 3 * math.sqrt(0.95 * 0.05 / 400)


@pytest.mark.parametrize("held, cases", [(0, 20), (20, 20), (19, 20), (950, 1000)])
def test_bounds_of_the_coverage_are_clopper_and_pearsons(held, cases):
    truth = np.where(np.arange(cases) < held, 0.0, 5.0)
    attained = attained_coverage(np.full(cases, -1.0), np.full(cases, 1.0), truth)
    assert attained.share == pytest.approx(held / cases)
    expected = stats.binomtest(held, cases).proportion_ci(0.9)
    assert attained.bounds(0.9) == pytest.approx((expected.low, expected.high), rel=1e-9)


def test_intervals_that_are_not_numbers_are_left_out():
    low = np.array([[-1.0, np.nan], [-1.0, np.nan], [np.nan, np.nan], [2.0, np.nan]])
    attained = attained_coverage(low, low + 2.0, 0.0)
    assert attained.cases.tolist() == [3, 0] and attained.left_out.tolist() == [1, 4]
    assert attained.share[0] == pytest.approx(2 / 3) and np.isnan(attained.share[1])
    assert np.isnan(attained.u[1]) and attained.bounds()[0][1] == 0.0


def test_unbounded_intervals_count():
    attained = attained_coverage(np.array([-np.inf, 1.0]), np.array([1.0, np.inf]), 0.5)
    assert attained.share == 0.5 and attained.cases == 2


@pytest.mark.parametrize(
    "low, high, truth, message",
    [
        (np.zeros(3), np.ones(2), 0.0, "expected the same"),
        (0.0, 1.0, 0.5, "one interval per case"),
        (np.ones(3), np.zeros(3), 0.5, "above its upper"),
        (np.zeros(3), np.ones(3), np.zeros(2), "found a truth of shape"),
    ],
)
@pytest.mark.thorough
def test_intervals_that_make_no_sense(low, high, truth, message):
    with pytest.raises(ValueError, match=message):
        attained_coverage(low, high, truth)
