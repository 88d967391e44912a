"""The Monte Carlo examples of JCGM 101 and 102, against closed forms or quadrature and in print.

Exact results are computed here with scipy. A Monte Carlo result may be three of its own standard
deviations away from them; printed figures must be what the exact result rounds to.
"""

import hashlib
import itertools
import math
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, special, stats

import vcal
from vcal.distributions import (
    Arcsine,
    CurvilinearTrapezoid,
    Inputs,
    MultivariateNormal,
    Normal,
    StudentT,
    Uniform,
)
from vcal.uncertainty import coverage_ellipsoid, propagate, propagate_distributions

ROOT3 = math.sqrt(3.0)


def assert_close(ensemble, output, y=None, u=None, interval=None, p=0.95, kind="symmetric"):
    """Within three standard deviations of the Monte Carlo itself."""
    at = ensemble.index(output)
    s = ensemble.precision(p, kind)
    if y is not None:
        assert abs(ensemble.mean[at] - y) <= 3.0 * s.y[at]
    if u is not None:
        assert abs(ensemble.u[at] - u) <= 3.0 * s.u[at]
    if interval is not None:
        low, high = ensemble.interval(output, p, kind)
        assert abs(low - interval[0]) <= 3.0 * s.low[at]
        assert abs(high - interval[1]) <= 3.0 * s.high[at]


def quantiles(cdf, p, low, high):
    """Ends of the probabilistically symmetric interval."""
    return tuple(
        optimize.brentq(lambda x, q=q: cdf(x) - q, low, high, xtol=1e-12 * (high - low))
        for q in (0.5 * (1.0 - p), 0.5 * (1.0 + p))
    )


def shortest(quantile, p):
    """Ends of the shortest interval, from the quantile function."""
    found = optimize.minimize_scalar(
        lambda a: quantile(a + p) - quantile(a),
        bounds=(0.0, 1.0 - p),
        method="bounded",
        options={"xatol": 1e-9},
    )
    edge = min((0.0, 1.0 - p, float(found.x)), key=lambda a: quantile(a + p) - quantile(a))
    return quantile(edge), quantile(edge + p)


# ---------------------------------------------------------------- JCGM 101, 9.2: additive model


def total(v):
    return v["x1"] + v["x2"] + v["x3"] + v["x4"]


def four(kind, half=(1.0, 1.0, 1.0, 1.0)):
    return Inputs({f"x{k + 1}": kind(sigma) for k, sigma in enumerate(half)})


def rectangular(sigma):
    return Uniform(-ROOT3 * sigma, ROOT3 * sigma)


def sum_of_rectangles(half):
    """CDF of a sum of rectangular quantities about zero: their half-widths, in closed form."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(half))))
    scale = math.factorial(len(half)) * np.prod(2.0 * np.asarray(half))
    knots, weights = signs @ half, signs.prod(1)
    return lambda x: float(np.sum(weights * np.maximum(x + knots, 0.0) ** len(half)) / scale)


@pytest.mark.thorough
def test_9_2_2_four_normal_inputs():
    found = propagate_distributions(total, four(lambda s: Normal(0.0, s)))
    assert found.labels == ("y",) and found.kept == "exact" and found.draws == 1_000_000
    assert_close(found, "y", 0.0, 2.0, (-3.919928, 3.919928))
    assert_close(found, "y", interval=(-3.919928, 3.919928), kind="shortest")
    assert_close(found, "y", interval=stats.norm.interval(0.99, 0, 2), p=0.99)


def test_9_2_3_four_rectangular_inputs():
    end = 2.0 * ROOT3 * (2.0 - (3.0 / 5.0) ** 0.25)
    exact = quantiles(sum_of_rectangles([ROOT3] * 4), 0.95, -7.0, 7.0)
    np.testing.assert_allclose(exact, (-end, end), rtol=1e-9)
    assert end == pytest.approx(3.8794, abs=5e-5)
    found = propagate_distributions(total, four(rectangular))
    assert_close(found, "y", 0.0, 2.0, (-end, end))


def test_9_2_4_one_dominant_rectangular_input():
    sizes = (1.0, 1.0, 1.0, 10.0)
    cdf = sum_of_rectangles([ROOT3 * s for s in sizes])
    exact = quantiles(cdf, 0.95, -25.0, 25.0)
    assert math.sqrt(103.0) == pytest.approx(10.15, abs=5e-3)
    assert exact[1] == pytest.approx(17.0, abs=5e-2)
    found = propagate_distributions(total, four(rectangular, sizes))
    assert_close(found, "y", 0.0, math.sqrt(103.0), exact)
    gum = propagate(total, four(rectangular, sizes)).interval("y")
    assert gum[1] == pytest.approx(19.9, abs=5e-2)


# ---------------------------------------------------------------- JCGM 101, 9.3: mass calibration


def mass(v):
    air = (v["rho_a"] - 1.2) * (1.0 / v["rho_W"] - 1.0 / v["rho_R"])
    return (v["m_Rc"] + v["dm_Rc"]) * (1.0 + air) - 1e5


MASS = {
    "m_Rc": (1e5, 0.05),
    "dm_Rc": (1.234, 0.02),
    "rho_a": (1.1, 1.3),
    "rho_W": (7e3, 9e3),
    "rho_R": (7950.0, 8050.0),
}


def mass_exact():
    """Mean, standard deviation and CDF of the mass by Gauss quadrature over the densities."""
    nodes, weights = np.polynomial.legendre.leggauss(80)
    rho_a, rho_W, rho_R = (
        0.5 * (high + low) + 0.5 * (high - low) * nodes
        for low, high in (MASS["rho_a"], MASS["rho_W"], MASS["rho_R"])
    )
    air = (rho_a[:, None, None] - 1.2) * (1.0 / rho_W[:, None] - 1.0 / rho_R)
    share = 0.125 * weights[:, None, None] * weights[:, None] * weights
    m, s = 100001.234, math.hypot(0.05, 0.02)
    centre, width = m * (1.0 + air) - 1e5, s * (1.0 + air)
    mean = np.sum(share * centre)
    u = math.sqrt(np.sum(share * (width**2 + (centre - mean) ** 2)))
    return mean, u, lambda x: np.sum(share * special.ndtr((x - centre) / width))


@pytest.mark.thorough
def test_9_3_mass_calibration():
    normal, rest = list(MASS.items())[:2], list(MASS.items())[2:]
    inputs = Inputs(
        {name: Normal(*a) for name, a in normal} | {name: Uniform(*a) for name, a in rest}
    )
    mean, u, cdf = mass_exact()
    exact = quantiles(cdf, 0.95, 0.8, 1.7)
    np.testing.assert_allclose([mean, u], [1.2340, 0.0755], atol=5e-5)
    np.testing.assert_allclose(exact, [1.084, 1.384], atol=5e-4)
    found = propagate_distributions(mass, inputs, seed=2)
    assert_close(found, "y", mean, u, exact)


# ---------------------------------------------------------------- JCGM 101, 9.4: loss in reflection


def loss(v):
    return v["x1"] ** 2 + v["x2"] ** 2


def loss_quantile(x1, r, u=0.005):
    """Quantile function of the loss: two squares of normal quantities along the principal axes."""
    major, minor = u * math.sqrt(1.0 + r), u * math.sqrt(1.0 - r)
    along = x1 / math.sqrt(2.0)  # the mean, in both principal directions
    if r == 0.0:
        return lambda q: u**2 * stats.ncx2.ppf(q, 2, (x1 / u) ** 2)
    # Of the smaller square the density, of the larger the CDF.
    nodes, weights = np.polynomial.legendre.leggauss(400)
    z = 9.0 * nodes
    share = 9.0 * weights * stats.norm.pdf(z)
    rest = (along + minor * z) ** 2

    def cdf(y):
        far = np.sqrt(np.maximum(y - rest, 0.0))
        inside = special.ndtr((far - along) / major) - special.ndtr((-far - along) / major)
        return float(np.sum(share * inside))

    top = (x1 + 10.0 * u) ** 2 * 2.0
    # A table, since its inverse is asked for often.
    y = np.linspace(0.0, math.sqrt(top), 4000) ** 2
    table = np.maximum.accumulate([cdf(value) for value in y])
    return lambda q: float(np.interp(q, table, y))


@pytest.mark.parametrize(
    ("x1", "r", "u", "interval"),
    [
        (0.0, 0.0, 50, (0, 149.8)),
        (0.0, 0.9, 67, (0, 185)),
        (0.010, 0.0, 112, (0, 366)),
        (0.050, 0.0, 502, (1593.6, 3548.6)),
    ],
)
def test_9_4_loss_in_reflection(x1, r, u, interval):
    inputs = Inputs({"x1": Normal(x1, 0.005), "x2": Normal(0.0, 0.005)}, {("x1", "x2"): r})
    mean = x1**2 + 2.0 * 0.005**2
    exact = math.sqrt(4.0 * x1**2 * 0.005**2 + 4.0 * 0.005**4 * (1.0 + r**2))
    assert exact * 1e6 == pytest.approx(u, abs=0.5)
    ends = shortest(loss_quantile(x1, r), 0.95)
    np.testing.assert_allclose(np.multiply(ends, 1e6), interval, atol=0.5)
    found = propagate_distributions(loss, inputs, seed=4)
    assert_close(found, "y", mean, exact)
    low, high = found.interval("y", 0.95, "shortest")
    # The least width is flat about its place, so that the ends wander more than the width.
    s = found.precision(0.95, "shortest")
    assert high - low == pytest.approx(ends[1] - ends[0], abs=3.0 * float(s.high[0] + s.low[0]))
    cdf = np.searchsorted(np.sort(found.values[:, 0]), ends) / found.draws
    assert cdf[1] - cdf[0] == pytest.approx(0.95, abs=3.0 * math.sqrt(0.95 * 0.05 / 1e6))
    if interval[0] == 0:
        assert low == found.minimum[0], "the mode is at the edge"
        assert high == pytest.approx(ends[1], abs=4.0 * float(s.high[0]))


def test_9_4_closed_form_of_the_interval():
    assert 2.0 * 0.005**2 * math.log(20.0) == pytest.approx(149.8e-6, abs=5e-8)


# ---------------------------------------------------------------- JCGM 101, 9.5: gauge block


def gauge(v):
    d = v["d_bar"] + v["d_1"] + v["d_2"]
    theta = v["theta_0"] + v["Delta"]
    expansion = v["d_alpha"] * theta + v["alpha_s"] * v["d_theta"]
    return v["l_s"] - 5e7 + d - v["l_s"] * expansion


@pytest.mark.campaign
def test_inputs_without_a_standard_deviation_are_told():
    """JCGM 101, 6.4.9.5: there are coverage intervals all the same."""
    done = propagate_distributions(
        lambda v: 1.0 + v["x"] + v["b"], Inputs({"x": StudentT(0, 3, 1.0), "b": Normal(0, 1e-9)})
    )
    low, high = done.interval("y")
    half = 3.0 * stats.t.ppf(0.975, 1)
    assert (low, high) == (pytest.approx(1 - half, rel=0.01), pytest.approx(1 + half, rel=0.01))
    assert "x (dof = 1) has no standard deviation" in done.notes[0]
    three = Inputs({"x": StudentT(0, 3, 3.0)})
    assert propagate_distributions(lambda v: v["x"], three, draws=100).notes == ()


@pytest.mark.slow
def test_9_5_gauge_block():
    inputs = Inputs(
        {
            "l_s": StudentT(50_000_623.0, 25.0, 18),
            "d_bar": StudentT(215.0, 6.0, 24),
            "d_1": StudentT(0.0, 4.0, 5),
            "d_2": StudentT(0.0, 7.0, 8),
            "alpha_s": Uniform(9.5e-6, 13.5e-6),
            "theta_0": Normal(-0.1, 0.2),
            "Delta": Arcsine(-0.5, 0.5),
            "d_alpha": CurvilinearTrapezoid(-1e-6, 1e-6, 0.1e-6),
            "d_theta": CurvilinearTrapezoid(-0.05, 0.05, 0.025),
        }
    )
    t = sum(s**2 * nu / (nu - 2.0) for s, nu in ((25, 18), (6, 24), (4, 5), (7, 8)))
    theta2 = 0.1**2 + 0.2**2 + 0.5**2 / 2.0
    d_alpha2 = 2e-6**2 / 12.0 + 0.1e-6**2 / 9.0
    d_theta2 = 0.1**2 / 12.0 + 0.025**2 / 9.0
    alpha2 = 11.5e-6**2 + 4e-6**2 / 12.0
    l2 = 50_000_623.0**2 + 25.0**2 * 18.0 / 16.0
    u = math.sqrt(t + l2 * (d_alpha2 * theta2 + alpha2 * d_theta2))
    assert u == pytest.approx(35.8, abs=0.05)
    found = propagate_distributions(gauge, inputs, 300_000, seed=5, coverage=0.99)
    assert_close(found, "y", 838.0, u, p=0.99)
    s = found.precision(0.99)
    low, high = found.interval("y", 0.99)
    assert low == pytest.approx(744.5, abs=3.0 * float(s.low[0]) + 0.05)
    assert high == pytest.approx(931.8, abs=3.0 * float(s.high[0]) + 0.05)


# ---------------------------------------------------------------- JCGM 102: magnitude and phase


def polar(v):
    x = v["x"]
    return {"magnitude": jnp.hypot(x[0], x[1]), "phase": jnp.arctan2(x[1], x[0])}


def polar_exact(x1, r, u=0.01):
    """Means, standard deviations and covariance by quadrature over the plane, in polar form."""
    inverse = np.linalg.inv(u**2 * np.array([[1.0, r], [r, 1.0]]))
    rho = np.linspace(0.0, x1 + 12.0 * u, 801)
    phi = np.linspace(-math.pi, math.pi, 1201)
    a, b = rho[:, None] * np.cos(phi) - x1, rho[:, None] * np.sin(phi)
    exponent = inverse[0, 0] * a**2 + 2.0 * inverse[0, 1] * a * b + inverse[1, 1] * b**2
    density = rho[:, None] * np.exp(-0.5 * exponent)

    def mean(of):
        return integrate.simpson(integrate.simpson(of * density, x=phi), x=rho)

    one = mean(np.ones_like(density))
    m = [mean(rho[:, None] + 0.0 * phi) / one, mean(0.0 * rho[:, None] + phi) / one]
    parts = (rho[:, None] - m[0] + 0.0 * phi, phi - m[1] + 0.0 * rho[:, None])
    return np.array(m), np.array([[mean(p * q) / one for q in parts] for p in parts])


@pytest.mark.parametrize(
    ("x1", "r", "magnitude", "phase"),
    [
        (0.001, 0.0, (0.0126, 0.0066), (0.0, 1.744)),
        (0.01, 0.0, (0.0155, 0.0078), (0.0, 1.117)),
        (0.1, 0.0, (0.1005, 0.0100), (0.0, 0.1005)),
        (0.001, 0.9, (0.0117, 0.0080), (-0.556, 1.599)),
        (0.01, 0.9, (0.0153, 0.0081), (-0.343, 0.903)),
        (0.1, 0.9, (0.1005, 0.0099), (-0.009, 0.1024)),
    ],
)
def test_102_magnitude_and_phase(x1, r, magnitude, phase):
    mean, covariance = polar_exact(x1, r)
    u = np.sqrt(np.diag(covariance))
    if r == 0.0:
        rice = stats.rice(x1 / 0.01, scale=0.01)
        np.testing.assert_allclose([mean[0], u[0]], [rice.mean(), rice.std()], rtol=1e-6)
    printed = np.array([magnitude, phase])
    np.testing.assert_allclose([mean[0], u[0]], printed[0], atol=5.5e-5)
    # These are themselves Monte Carlo results of 1e6 draws, with an error of u/1000.
    np.testing.assert_allclose([mean[1], u[1]], printed[1], atol=5e-4 + 3e-3 * u[1])
    V = 1e-4 * np.array([[1.0, r], [r, 1.0]])
    inputs = Inputs({"x": MultivariateNormal([x1, 0.0], V)})
    found = propagate_distributions(polar, inputs, 300_000, seed=6)
    assert found.labels == ("magnitude", "phase")
    assert_close(found, "magnitude", mean[0], u[0])
    assert_close(found, "phase", mean[1], u[1])
    products = np.prod(found.values - found.mean, axis=1)
    error = products.std() / math.sqrt(found.draws)
    assert found.covariance[0, 1] == pytest.approx(covariance[0, 1], abs=3.0 * error)


# ---------------------------------------------------------------- GUM H.2: three outputs


def impedance(v):
    V, I, phi = v["observed"]  # noqa: E741
    return {"R": V / I * jnp.cos(phi), "X": V / I * jnp.sin(phi), "Z": V / I}


def test_gum_h_2_by_monte_carlo():
    observed = np.array(
        [
            [5.007, 4.994, 5.005, 4.990, 4.999],
            [19.663e-3, 19.639e-3, 19.640e-3, 19.685e-3, 19.678e-3],
            [1.0456, 1.0438, 1.0468, 1.0428, 1.0433],
        ]
    )
    mean, covariance = observed.mean(1), np.cov(observed) / 5.0
    inputs = Inputs({"observed": MultivariateNormal(mean, covariance)})
    found = propagate_distributions(impedance, inputs, 200_000, seed=7)
    assert found.labels == ("R", "X", "Z")
    s = found.precision()
    np.testing.assert_allclose(found.mean, [127.732, 219.847, 254.260], atol=5e-4 + 3 * s.y.max())
    np.testing.assert_allclose(found.u, [0.071, 0.295, 0.236], atol=5e-4 + 3 * s.u.max())
    # The function is as good as linear here.
    I, phi, Z = mean[1], mean[2], mean[0] / mean[1]  # noqa: E741
    c, d = np.cos(phi), np.sin(phi)
    slopes = np.array([[c / I, -Z * c / I, -Z * d], [d / I, -Z * d / I, Z * c], [1 / I, -Z / I, 0]])
    linear = slopes @ covariance @ slopes.T
    np.testing.assert_allclose(
        found.correlation, linear / np.sqrt(np.outer(*[np.diag(linear)] * 2)), atol=0.006
    )
    region = coverage_ellipsoid(found, ["R", "X"])
    assert region.factor == pytest.approx(math.sqrt(stats.chi2.ppf(0.95, 2)), abs=0.02)


# ---------------------------------------------------------------- the campaign


def two(v):
    return jnp.stack([v["x"], v["x"] * v["y"]])


def small(**changes):
    options = {"draws": 30_000, "seed": 1} | changes
    inputs = options.pop("inputs", Inputs({"x": Normal(1.0, 0.1), "y": Uniform(0.0, 1.0)}))
    return propagate_distributions(options.pop("function", two), inputs, **options)


def test_a_draw_is_the_function_of_a_draw_of_the_inputs():
    inputs = Inputs({"x": Normal(1.0, 0.1), "y": Uniform(0.0, 1.0)}, {("x", "y"): 0.5})
    found = small(inputs=inputs)
    assert found.labels == ("y[0]", "y[1]")
    keys = inputs.row_keys(1, np.arange(3))
    sample = jax.jit(lambda own: inputs.draws(own, 10_000))
    for block in range(3):
        drawn = sample(keys[block])
        expected = np.column_stack([drawn["x"], drawn["x"] * drawn["y"]])
        np.testing.assert_allclose(found.values[10_000 * block :][:10_000], expected, rtol=1e-14)


def test_the_seed_alone_decides_and_more_draws_begin_with_the_same():
    found = small()
    np.testing.assert_array_equal(found.values, small().values)
    np.testing.assert_array_equal(found.values[:12_345], small(draws=12_345).values)
    # Blocks that are computed together are the same.
    np.testing.assert_array_equal(small(draws=61_000).values[:30_000], found.values)
    assert np.abs(found.mean - small(seed=2).mean).max() > 0.0


def test_an_output_that_is_never_finite_holds_nothing_up():
    def f(x):
        return {"a": x["x"], "b": jnp.sqrt(-1.0 - x["x"] ** 2)}

    inputs = Inputs({"x": Normal(0.0, 1.0)})
    found = propagate_distributions(f, inputs, "adaptive", digits=1, most=400_000)
    assert found.adaptive is not None and found.adaptive.done and found.draws < 400_000
    assert not found.adaptive.settled and f"b: {found.draws} of {found.draws}" in found.notes[0]


def test_an_adaptive_campaign_meets_its_tolerance():
    inputs = four(lambda s: Normal(0.0, s))
    found = propagate_distributions(total, inputs, "adaptive", digits=1, seed=3)
    assert found.adaptive is not None and found.adaptive.settled
    assert found.adaptive.tolerance[0] == 0.5
    assert found.draws == 20_000
    finer = propagate_distributions(total, inputs, "adaptive", digits=2, seed=3)
    assert finer.adaptive is not None and finer.adaptive.settled
    assert finer.adaptive.tolerance[0] == pytest.approx(0.05)
    assert max(float(s[0]) for s in finer.scatter) <= 0.025
    # Three sub-blocks tell their own scatter badly; that of a normal quantity is known.
    assert abs(finer.mean[0]) <= 3.0 * 2.0 / math.sqrt(finer.draws)
    assert abs(finer.u[0] - 2.0) <= 3.0 * 2.0 / math.sqrt(2.0 * finer.draws)


def test_draws_outside_of_the_domain_are_counted():
    def root(v):
        return {"root": jnp.sqrt(v["x"]), "x": v["x"]}

    found = propagate_distributions(root, Inputs({"x": Normal(0.0, 1.0)}), 50_000)
    below = int(np.sum(found.values[:, 1] < 0.0))
    assert found.failed == {"root": below} and 24_000 < below < 26_000
    # E[sqrt(x) | x > 0] of a standard normal quantity
    exact = 2.0**0.25 * math.gamma(0.75) / math.sqrt(math.pi)
    assert found.mean[0] == pytest.approx(exact, abs=4.0 * found.u[0] / math.sqrt(25_000))


def test_a_folder_knows_the_function_and_the_inputs(tmp_path):
    def scaled(factor):
        return lambda v: factor * v["x"] ** 2 + v["y"]

    found = small(function=scaled(2.0), folder=tmp_path)
    again = small(function=scaled(2.0), folder=tmp_path, draws=50_000)
    np.testing.assert_array_equal(again.values[:30_000], found.values)
    others = Inputs({"x": Normal(1.0, 0.11), "y": Uniform(0.0, 1.0)})
    for changes, name in (
        ({"function": scaled(2.5)}, "measurement function"),
        ({"function": scaled(2.0), "inputs": others}, "inputs"),
        ({"function": scaled(2.0), "seed": 2}, "seed"),
    ):
        with pytest.raises(vcal.StudyError, match=f"another campaign: found {name} = "):
            small(folder=tmp_path, draws=50_000, **changes)


def test_the_function_is_traced_once():
    traced = []

    def counted(v):
        traced.append(1)
        return v["x"] + v["y"]

    small(function=counted)
    first = len(traced)
    small(function=counted, seed=5, draws=70_000)
    assert first <= 2, "once for the shapes of the outputs, once for the program"
    assert len(traced) <= first + 1


DEVICES = """
import hashlib
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from vcal.distributions import Inputs, Normal, Uniform
from vcal.uncertainty import propagate_distributions

assert jax.local_device_count() == 2
inputs = Inputs({"x": Normal(1.0, 0.1), "y": Uniform(0.0, 1.0)})
found = propagate_distributions(
    lambda v: jnp.stack([v["x"], v["x"] * v["y"]]), inputs, 30_000, seed=1
)
numbers = [found.values, found.mean, found.covariance, *found.scatter]
print(hashlib.sha256(b"".join(number.tobytes() for number in numbers)).hexdigest())
"""


@pytest.mark.thorough
def test_results_do_not_depend_on_the_number_of_devices():
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    found = subprocess.run(
        [sys.executable, "-c", DEVICES],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    one = small()
    numbers = [one.values, one.mean, one.covariance, *one.scatter]
    own = hashlib.sha256(b"".join(number.tobytes() for number in numbers)).hexdigest()
    assert found.stdout.strip() == own


@pytest.mark.parametrize("verb", (propagate, propagate_distributions))
def test_inputs_that_are_not_there_are_refused(verb):
    inputs = {"length": Normal(1.0, 0.1), "width": Normal(2.0, 0.1)}
    with pytest.raises(TypeError, match=r"inputs: found {'length'.*expected Inputs; write"):
        verb(lambda x: x["length"], inputs)
    with pytest.raises(ValueError, match=r"takes the input 'lenght' \(did you mean 'length'\?\)"):
        verb(lambda x: x["lenght"] * x["width"], Inputs(inputs))


def test_a_single_draw_is_refused():
    with pytest.raises(ValueError, match="draws: found 1"):
        small(draws=1)
