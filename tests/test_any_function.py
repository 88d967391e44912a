"""Measurement functions that are not written in JAX, or have no derivative, and what the notes say.

Differences are held against closed forms and automatic derivatives; random numbers against the
distributions of scipy.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

from vcal.distributions import Inputs, MultivariateNormal, Normal, StudentT, Uniform
from vcal.errors import StudyError
from vcal.numerics.counter_draws import (
    normal,
    polar,
    random_words,
    seed_words,
    threefry,
    uniform,
)
from vcal.numerics.differences import extrapolated, first_differences
from vcal.uncertainty import compare, comparison_table, propagate, propagate_distributions
from vcal.uncertainty.evaluation import Plain, evaluation_of

TWO = Inputs({"x": Normal(4.0, 0.1), "y": Normal(0.0, 0.1)})


def in_python(v):
    return math.sqrt(v["x"]) * math.exp(v["y"])


def in_numpy(v):
    return np.sqrt(v["x"]) * np.exp(v["y"])


def in_jax(v):
    return jnp.sqrt(v["x"]) * jnp.exp(v["y"])


# --- derivatives ---


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("function", [in_python, in_numpy])
def test_differences_give_what_automatic_derivatives_give(function, order):
    found, exact = propagate(function, TWO, order=order), propagate(in_jax, TWO, order=order)
    np.testing.assert_allclose(found.sensitivity, exact.sensitivity, rtol=1e-9)
    np.testing.assert_allclose(found.value, exact.value, rtol=1e-9)
    np.testing.assert_allclose(found.u, exact.u, rtol=1e-7)
    assert exact.notes == () and "u of y may be off by less than 0.01 %" in found.notes[0]


def test_second_order_by_differences_with_correlation_and_arrays():
    inputs = Inputs({"x": MultivariateNormal([1.0, 2.0], [[0.04, 0.02], [0.02, 0.09]])})
    plain = propagate(lambda v: {"a": math.exp(v["x"][0] * v["x"][1] / 4)}, inputs, order=2)
    exact = propagate(lambda v: {"a": jnp.exp(v["x"][0] * v["x"][1] / 4)}, inputs, order=2)
    assert plain.u == pytest.approx(exact.u, rel=1e-6) and plain.labels == ("a",)
    assert plain.value == pytest.approx(exact.value, rel=1e-7)


def test_an_implicit_function_solved_by_a_root_finder():
    """Temperature of a sensor: R = R0 (1 + A t + B t^2), solved by a program of scipy."""
    A, B = 3.9083e-3, -5.775e-7
    solve = lambda v: brentq(lambda t: 100 * (1 + A * t + B * t * t) - v["R"], -50, 300)  # noqa: E731
    found = propagate(solve, Inputs({"R": Normal(120.0, 0.05)}))
    slope = 1.0 / (100 * (A + 2 * B * found.value[0]))
    assert found.sensitivity[0, 0] == pytest.approx(slope, rel=1e-7)


def test_the_estimated_error_covers_the_error_of_a_noisy_function():
    noise = np.random.default_rng(1)
    step = np.array([0.5])

    def function(points):
        return np.sin(points) + 1e-6 * noise.uniform(-1, 1, points.shape)

    misses = 0
    for x in np.linspace(0.2, 1.2, 20):
        found = first_differences(function, np.array([x]), step, np.sin([x]))
        error = abs(found.derivative[0, 0] - math.cos(x))
        misses += error > 5.0 * found.error[0, 0]
        assert error < 1e-4
    assert misses <= 4


def test_extrapolation_of_a_known_series():
    h = 0.5 ** np.arange(6)
    best, error = extrapolated(3.0 + 2.0 * h**2 - h**4 + 0.5 * h**6)
    assert best == pytest.approx(3.0, abs=1e-12) and abs(best - 3.0) <= error + 1e-15


def test_a_derivative_of_one_side_where_there_is_no_other():
    found = propagate(lambda v: math.sqrt(v["x"]) ** 3 + v["x"], Inputs({"x": Normal(0.0, 0.1)}))
    assert found.sensitivity[0, 0] == pytest.approx(1.0, rel=0.02)
    assert "is not finite at the estimates plus or minus" in " ".join(found.notes)


def test_a_derivative_of_jax_that_is_not_finite_is_replaced():
    def f(v):
        return jnp.sqrt(1.0 - jnp.cos(v["x"]) ** 2) * v["x"] + v["y"]

    inputs = Inputs({"x": Normal(0.0, 0.1), "y": Normal(0.0, 0.3)})
    assert not np.isfinite(jax.jacfwd(lambda x: f({"x": x, "y": 0.0}))(0.0))
    found = propagate(f, inputs)
    assert found.sensitivity[0] == pytest.approx([0.0, 1.0], abs=1e-9)
    assert found.u[0] == pytest.approx(0.3) and "differences" in found.notes[0]


def test_a_kink_is_told():
    found = propagate(
        lambda v: abs(v["x"]) + v["y"], Inputs({"x": Normal(0, 1), "y": Normal(0, 1)})
    )
    far = propagate(lambda v: abs(float(v["x"])), Inputs({"x": Normal(5, 1)}))
    kinked = propagate(lambda v: math.fabs(v["x"]), Inputs({"x": Normal(0, 1)}))
    assert "those of both sides differ for y to x" in kinked.notes[1]
    assert far.u[0] == pytest.approx(1.0) and not any("kink" in note for note in far.notes)
    assert any("departs by" in note for note in found.notes)


# --- Monte Carlo ---


def test_plain_functions_have_the_draws_of_those_in_jax():
    expected = propagate_distributions(in_jax, TWO, 25_000, seed=3).values
    for function in (in_python, in_numpy):
        found = propagate_distributions(function, TWO, 25_000, seed=3)
        np.testing.assert_allclose(found.values, expected, rtol=1e-13)


def test_a_block_is_computed_together_only_where_that_is_the_same():
    random = np.random.default_rng(0)
    inputs = Inputs({"x": Normal(0.0, 1.0), "p": MultivariateNormal([1.0, 2.0], np.eye(2))})
    drawn = {"x": random.normal(size=500), "p": random.normal(size=(500, 2))}
    calls = []

    def counted(function):
        def call(v):
            calls.append(1)
            return function(v)

        return call

    cases = {
        "together": (lambda v: {"a": np.sin(v["x"]) + v["p"][1], "b": np.stack(v["p"])}, True),
        "mean": (lambda v: float(np.mean(v["x"])) + v["p"][0] * 1.0, False),
        "rank": (lambda v: np.sort(v["x"]) if np.ndim(v["x"]) else v["x"], False),
        "branch": (lambda v: math.exp(v["x"]) if v["x"] > 0 else 0.0, False),
        "any": (lambda v: v["x"] * (2.0 if np.any(v["x"] > 3.0) else 1.0), None),
    }
    drawn["x"][77] = 3.5
    for name, (function, together) in cases.items():
        plain = Plain(counted(function), inputs, ())
        how = evaluation_of(
            lambda v, f=function: f({k: np.asarray(n) for k, n in v.items()}), inputs
        )
        plain = Plain(counted(function), inputs, how.outputs)
        calls.clear()
        found = plain.block(drawn)
        x = np.column_stack([drawn["x"], drawn["p"]])
        flat = np.concatenate([v.reshape(500, -1) for v in found.values()], axis=1)
        np.testing.assert_allclose(flat, plain.rows(x), rtol=1e-12, err_msg=name)
        if together is not None:
            assert (len(calls) < 600) == together, name


def test_errors_of_arithmetic_are_failed_draws_and_their_share_is_told():
    inputs = Inputs({"x": Normal(0.1, 0.1)})
    found = propagate_distributions(lambda v: math.sqrt(v["x"]), inputs, 20_000)
    other = propagate_distributions(lambda v: jnp.sqrt(v["x"]), inputs, 20_000)
    share = stats.norm.cdf(-1.0)
    assert found.failed["y"] == other.failed["y"]
    assert found.failed["y"] / 20_000 == pytest.approx(share, abs=4 * math.sqrt(share / 20_000))
    comparison = compare(propagate(lambda v: jnp.sqrt(v["x"]), inputs), other)
    assert comparison.failed[0] == other.failed["y"] / 20_000
    told = f"y: {other.failed['y']} of 20000 draws (16 %) are not finite"
    assert told in other.notes[0] and told in comparison_table(comparison)
    assert any(told in note for note in comparison.notes)


@pytest.mark.parametrize("draws", [20_000, "adaptive"])
def test_no_finite_draw_is_an_error(draws):
    with pytest.raises(ValueError, match="none of the 20000 draws is finite"):
        propagate_distributions(
            lambda v: jnp.log(-1.0 - v["x"] ** 2), Inputs({"x": Normal(0, 1)}), draws
        )


def test_a_mistake_in_a_plain_function_is_not_a_failed_draw():
    def function(v):
        return float(v["x"]) if v["x"] < 2.0 else {}["missing"]

    with pytest.raises(KeyError, match="missing"):
        propagate_distributions(function, Inputs({"x": Normal(0.0, 1.0)}), 10_000)

    def changing(v):
        return float(v["x"]) if v["x"] < 2.0 else np.ones(2)

    with pytest.raises(ValueError, match="expected the shape .* that it has at the estimates"):
        propagate_distributions(changing, Inputs({"x": Normal(0.0, 1.0)}), 10_000)


def test_a_campaign_of_a_plain_function_resumes_and_is_identified_by_its_code(tmp_path):
    first = propagate_distributions(in_python, TWO, 20_000, folder=tmp_path)
    more = propagate_distributions(in_python, TWO, 30_000, folder=tmp_path)
    np.testing.assert_array_equal(more.values[:20_000], first.values)
    with pytest.raises(StudyError, match="belongs to another campaign"):
        propagate_distributions(lambda v: 2 * in_python(v), TWO, 40_000, folder=tmp_path)
    with pytest.raises(StudyError, match="identified by its code"):
        propagate_distributions(_Callable(), TWO, 10_000, folder=tmp_path / "b")


class _Callable:
    def __call__(self, v):
        return math.sin(v["x"])


# --- notes where numbers mislead ---


def test_a_norm_near_zero_is_told_at_every_order():
    norm = lambda v: jnp.sqrt(v["x"] ** 2 + v["y"] ** 2)  # noqa: E731
    inputs = Inputs({"x": Normal(0.1, 10.0), "y": Normal(0.0, 0.01)})
    first = propagate(norm, inputs)
    exact = propagate_distributions(norm, inputs, 20_000)
    assert first.u[0] == pytest.approx(10.0) and exact.u[0] < 7.0
    assert "departs by" in first.notes[0] and "use Monte Carlo" in first.notes[0]
    cubic = propagate(lambda v: v["x"] ** 3 / 3, Inputs({"x": Normal(0.1, 1.0)}))
    assert "series of first order" in cubic.notes[0]
    square = propagate(lambda v: v["x"] ** 2, Inputs({"x": Normal(0.0, 1.0)}), order=2)
    assert square.notes == (), "the series of second order is exact here"


def test_results_ruled_by_single_draws_are_told():
    ratio = propagate_distributions(lambda v: 1.0 / v["x"], Inputs({"x": Normal(1.0, 1.0)}), 50_000)
    assert any("a single draw has" in note and "median" in note for note in ratio.notes)
    for law in (Normal(0, 1), Uniform(0, 1), StudentT(0, 1, 5.0)):
        for draws in (50, 1000, 100_000):
            assert propagate_distributions(lambda v: v["x"], Inputs({"x": law}), draws).notes == ()


# --- the generator ---


def test_threefry_gives_the_known_answers_of_its_authors():
    """Test vectors of Random123 (kat_vectors): key and counter of zeros, and of ones."""
    for word, known in ((0, [0x6B200159, 0x99BA4EFE]), (0xFFFFFFFF, [0x1CB996FC, 0xBB002BE7])):
        words = (np.array([word], np.uint32),) * 2
        assert [int(w[0]) for w in threefry(words, words)] == known


def test_splitmix_gives_the_known_answers_of_its_authors():
    """The first words of splitmix64.c for the seed 0."""
    words = np.asarray(random_words(jnp.zeros(1, jnp.uint64), 3))[0]
    assert [int(w) for w in words] == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]


@pytest.mark.parametrize("seed", [0, 7, -5, 2**40 + 3, 2**63 - 1])
def test_a_seed_is_that_of_jax(seed):
    key = jax.random.key_data(jax.random.key(seed, impl="threefry2x32"))
    np.testing.assert_array_equal(np.concatenate(seed_words(seed)), key)


@pytest.mark.parametrize("seed", [2**64, 1.5, "1"])
def test_a_seed_that_is_none(seed):
    with pytest.raises(ValueError, match="seed: found .* expected a whole number"):
        propagate_distributions(lambda v: v["x"], Inputs({"x": Normal(0, 1)}), 100, seed)


def test_numbers_from_words_are_those_of_numpy():
    edges = [0, 1, 2**30, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**63 - 1, 2**63, 2**64 - 1]
    drawn = np.random.default_rng(3).integers(0, 2**64, 100_000, dtype=np.uint64)
    words = np.concatenate([np.array(edges, np.uint64), drawn])
    i = (words >> np.uint64(12)).astype(float)
    np.testing.assert_array_equal(uniform(words), (i + 0.5) / 2.0**52)
    high, low = ((words >> np.uint64(s)).astype(np.uint32).view(np.int32) for s in (32, 0))
    log_square, cosine = map(np.asarray, polar(words))
    expected = -2.0 * np.log(high / 2.0**32 + (0.5 + 2.0**-33))
    np.testing.assert_allclose(log_square, expected, rtol=3e-10)
    np.testing.assert_allclose(cosine, np.cos(2.0 * np.pi * low / 2.0**32), atol=5e-11)
    np.testing.assert_allclose(normal(words), np.sqrt(expected) * cosine, rtol=2e-10)


LAWS = {
    "normal": (Normal(0, 1), stats.norm()),
    "uniform": (Uniform(0, 1), stats.uniform()),
    "t": (StudentT(0, 1, 3.0), stats.t(3)),
    "t of many": (StudentT(0, 1, 1e6), stats.norm()),
}


def test_draws_of_a_block_have_their_distributions():
    pair = MultivariateNormal([0.0, 0.0], np.eye(2))
    inputs = Inputs({name: own for name, (own, _) in LAWS.items()} | {"pair": pair})
    sample = jax.jit(lambda i, keys: i.draws(keys, 10_000))
    blocks = [sample(inputs, keys) for keys in inputs.row_keys(7, np.arange(20))]
    drawn = {name: np.concatenate([b[name] for b in blocks]) for name in inputs.names}
    for name, (_, law) in LAWS.items():
        assert stats.kstest(drawn[name], law.cdf).pvalue > 1e-3, name
    columns = np.column_stack([drawn[n] for n in ("normal", "uniform", "t of many", "pair")])
    r = np.corrcoef(columns.T) - np.eye(5)
    assert np.abs(r).max() < 4.5 / math.sqrt(200_000)
    one = drawn["normal"]
    for lag in (1, 2, 5_000, 10_000):
        assert abs(np.corrcoef(one[lag:], one[:-lag])[0, 1]) < 4.5 / math.sqrt(200_000)
    # An input at the end changes nothing before it.
    longer = Inputs(inputs.distributions | {"last": Normal(5, 2)})
    other = sample(longer, longer.row_keys(7, np.arange(4, 5))[0])
    for name in inputs.names:
        np.testing.assert_array_equal(other[name], blocks[4][name])
