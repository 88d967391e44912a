"""Propagation by the GUM: published examples, closed forms, and what it says of its own limits."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy import stats

from vcal.distributions import (
    Arcsine,
    CurvilinearTrapezoid,
    Inputs,
    LogNormal,
    MultivariateNormal,
    MultivariateT,
    Normal,
    StudentT,
    Uniform,
)
from vcal.uncertainty.budget import coverage_factor
from vcal.uncertainty.propagation import propagate
from vcal.uncertainty.table import budget_table

# GUM H.2: five simultaneous observations of voltage (V), current (A) and phase (rad).
OBSERVED = np.array(
    [
        [5.007, 4.994, 5.005, 4.990, 4.999],
        [19.663e-3, 19.639e-3, 19.640e-3, 19.685e-3, 19.678e-3],
        [1.0456, 1.0438, 1.0468, 1.0428, 1.0433],
    ]
)


def total(values):
    return sum(values.values())


def mass(values):
    """JCGM 101, 9.3: deviation from 100 g, mg."""
    buoyancy = (values["rho_a"] - 1.2) * (1 / values["rho_W"] - 1 / values["rho_R"])
    return (values["m_Rc"] + values["dm_Rc"]) * (1 + buoyancy) - 1e5


MASS = {
    "m_Rc": Normal(1e5, 0.05),
    "dm_Rc": Normal(1.234, 0.02),
    "rho_a": Uniform(1.1, 1.3),
    "rho_W": Uniform(7000, 9000),
    "rho_R": Uniform(7950, 8050),
}


def mismatch(values):
    """JCGM 101, 9.4."""
    return values["x1"] ** 2 + values["x2"] ** 2


def mismatched(x1, r):
    pair = {"x1": Normal(x1, 0.005), "x2": Normal(0.0, 0.005)}
    return Inputs(pair, {("x1", "x2"): r})


def gauge(values):
    """GUM H.1: deviation from 50 mm, nm."""
    ls = values["ls"]
    expansion = values["d_alpha"] * values["theta"] + values["alpha_s"] * values["d_theta"]
    return ls + values["d"] - ls * expansion - 5e7


GAUGE = {
    "ls": Normal(50000623, 25, dof=18),
    "d": Normal(215, 9.7, dof=25.6),
    "d_alpha": Normal(0, 0.58e-6, dof=50),
    "theta": Normal(-0.1, 0.41),
    "alpha_s": Normal(11.5e-6, 1.2e-6),
    "d_theta": Normal(0, 0.029, dof=2),
}


def impedance(values):
    z = values["V"] / values["I"]
    return {"Z": z, "R": z * jnp.cos(values["phi"]), "X": z * jnp.sin(values["phi"])}


def impedance_inputs(dof=4.0):
    mean, covariance = OBSERVED.mean(1), np.cov(OBSERVED) / 5
    u = np.sqrt(np.diag(covariance))
    r = covariance / np.outer(u, u)
    names = ("V", "I", "phi")
    normal = {n: Normal(m, s, dof=dof) for n, m, s in zip(names, mean, u, strict=True)}
    pairs = {(names[i], names[j]): r[i, j] for i in range(3) for j in range(i)}
    return Inputs(normal, pairs)


def polar(values):
    """JCGM 102: magnitude and phase."""
    x1, x2 = values["x1"], values["x2"]
    return {"r": jnp.hypot(x1, x2), "theta": jnp.arctan2(x2, x1)}


# --- published examples ---


@pytest.mark.parametrize(
    "inputs, u, half",
    [
        ([Normal(0, 1)] * 4, 2.0, 3.92),
        ([Uniform(-math.sqrt(3), math.sqrt(3))] * 4, 2.0, 3.92),
        (
            [Uniform(-math.sqrt(3), math.sqrt(3))] * 3 + [Uniform(-(300**0.5), 300**0.5)],
            10.15,
            19.9,
        ),
    ],
)
def test_jcgm_101_9_2_additive_model(inputs, u, half):
    budget = propagate(total, Inputs({f"X{i}": d for i, d in enumerate(inputs)}))
    assert budget.value[0] == pytest.approx(0.0, abs=1e-12)
    assert budget.u[0] == pytest.approx(u, abs=0.005)
    assert budget.interval("y") == pytest.approx((-half, half), abs=0.05 if half > 10 else 0.005)


def test_jcgm_101_9_3_mass_first_order():
    budget = propagate(mass, Inputs(MASS))
    assert budget.value[0] == pytest.approx(1.2340, abs=5e-5)
    assert budget.u[0] == pytest.approx(math.hypot(0.05, 0.02), rel=1e-9)
    assert budget.u[0] == pytest.approx(0.0539, abs=5e-5)
    assert budget.interval("y") == pytest.approx((1.1285, 1.3395), abs=5e-5)


def test_jcgm_101_9_3_mass_second_order():
    budget = propagate(mass, Inputs(MASS), order=2)
    # Only the products rho_a / rho_W and rho_a / rho_R curve: 1/2 (2 f_ij^2 u_i^2 u_j^2) each.
    slope = (1e5 + 1.234) / 8000**2
    u_a, u_w, u_r = 0.1 / math.sqrt(3), 1000 / math.sqrt(3), 50 / math.sqrt(3)
    curved = (slope * u_a) ** 2 * (u_w**2 + u_r**2)
    assert budget.u[0] == pytest.approx(math.sqrt(0.05**2 + 0.02**2 + curved), rel=1e-9)
    assert budget.u[0] == pytest.approx(0.0750, abs=5e-5)
    # Printed with u rounded to 0.0750 before it was multiplied; one more unit of the last digit.
    assert budget.interval("y") == pytest.approx((1.0870, 1.3810), abs=1.0e-4)
    assert budget.share_higher[0] == pytest.approx(curved / budget.u[0] ** 2, rel=1e-9)


@pytest.mark.parametrize("r", [0.0, 0.9])
@pytest.mark.parametrize("x1", [0.0, 0.010, 0.050])
def test_jcgm_101_9_4_mismatch(x1, r):
    first = propagate(mismatch, mismatched(x1, r))
    assert first.value[0] == pytest.approx(x1**2)
    assert first.u[0] == pytest.approx(2 * x1 * 0.005)
    assert ("order=2" in "".join(first.notes)) == (x1 == 0.0)
    # A quadratic of normal inputs is exact at second order.
    second = propagate(mismatch, mismatched(x1, r), order=2)
    covariance = 0.005**2 * np.array([[1.0, r], [r, 1.0]])
    exact = 4 * x1**2 * covariance[0, 0] + 2 * np.trace(covariance @ covariance)
    assert second.value[0] == pytest.approx(x1**2 + 2 * 0.005**2, rel=1e-12)
    assert second.u[0] == pytest.approx(math.sqrt(exact), rel=1e-12)
    printed = {0.0: (50, 67 if r else 50), 0.010: (150, None if r else 112), 0.050: (2550, 502)}
    value, u = printed[x1]
    assert 1e6 * second.value[0] == pytest.approx(value, abs=0.5)
    if u is not None and (r == 0.0 or x1 == 0.0):
        assert 1e6 * second.u[0] == pytest.approx(u, abs=0.5)


def test_jcgm_101_9_5_gauge_block():
    inputs = {
        "Ls": StudentT(50000623, 25, 18),
        "D": StudentT(215, 6, 24),
        "d1": StudentT(0, 4, 5),
        "d2": StudentT(0, 7, 8),
        "alpha_s": Uniform(9.5e-6, 13.5e-6),
        "theta0": Normal(-0.1, 0.2),
        "Delta": Arcsine(-0.5, 0.5),
        "d_alpha": CurvilinearTrapezoid(-1e-6, 1e-6, 0.1e-6, dof=50),
        "d_theta": CurvilinearTrapezoid(-0.05, 0.05, 0.025, dof=2),
    }

    def length(values):
        v = dict(values)
        v |= {"ls": v["Ls"], "d": v["D"] + v["d1"] + v["d2"], "theta": v["theta0"] + v["Delta"]}
        return gauge(v)

    budget = propagate(length, Inputs(inputs), coverage=0.99)
    assert budget.value[0] == pytest.approx(838.0, abs=1e-6)
    # The scale of t is the GUM's u; variance of CTrap: (b - a)^2/12 + d^2/9 (JCGM 101, 6.4.3).
    alpha = 50000623 * 0.1 * math.sqrt((2e-6) ** 2 / 12 + (1e-7) ** 2 / 9)
    theta = 50000623 * 11.5e-6 * math.sqrt(0.1**2 / 12 + 0.025**2 / 9)
    assert budget.u[0] == pytest.approx(math.hypot(25, 6, 4, 7, alpha, theta), rel=1e-9)
    assert round(float(budget.u[0])) == 32
    parts = {25: 18, 6: 24, 4: 5, 7: 8, alpha: 50, theta: 2}
    nu = budget.u[0] ** 4 / sum(part**4 / dof for part, dof in parts.items())
    assert budget.nu_eff[0] == pytest.approx(nu, rel=1e-9)


def test_gum_h1_end_gauge():
    budget = propagate(gauge, Inputs(GAUGE), coverage=0.99)
    assert budget.value[0] == pytest.approx(838.0, abs=1e-6)
    assert budget.u[0] == pytest.approx(31.71, abs=0.005)
    assert math.floor(budget.nu_eff[0]) == 16
    assert budget.k[0] == pytest.approx(stats.t.ppf(0.995, 16), rel=1e-9)
    assert budget.U[0] == pytest.approx(92.62, abs=0.005)
    assert budget.interval("y") == pytest.approx((745, 931), abs=0.5)
    # Table H.1: contributions 25, 9.7, 2.9, 0, 0, 16.6 nm (the last is 16.7 unrounded).
    printed = [25, 9.7, 2.9, 0, 0, 16.6]
    assert budget.contribution[0] == pytest.approx(printed, abs=0.1)
    second = propagate(gauge, Inputs(GAUGE), order=2, coverage=0.99)
    assert second.u[0] == pytest.approx(33.91, abs=0.005)
    # H.1.7 names the two terms: 11.7 nm (u(theta) = 0.41 and u(d_alpha)) and 1.7 nm.
    terms = [50000623 * 0.58e-6 * 0.41, 50000623 * 1.2e-6 * 0.029]
    assert terms == pytest.approx([11.7, 1.7], abs=0.25)
    assert second.u[0] == pytest.approx(math.hypot(31.7106, *terms), abs=1e-3)
    assert second.nu_eff[0] == budget.nu_eff[0]


def test_gum_h2_resistance_reactance_impedance():
    budget = propagate(impedance, impedance_inputs())
    found = {name: i for i, name in enumerate(budget.labels)}
    order = [found[name] for name in "RXZ"]
    assert budget.labels == ("Z", "R", "X")
    assert budget.value[order] == pytest.approx([127.732, 219.847, 254.260], abs=5e-4)
    # u(X) is 0.2956 here; print has 0.295, as the five single results give it below.
    assert budget.u[order] == pytest.approx([0.071, 0.295, 0.236], abs=6e-4)
    correlation = budget.correlation[np.ix_(order, order)]
    assert correlation[0, 1] == pytest.approx(-0.588, abs=5e-4)
    assert correlation[0, 2] == pytest.approx(-0.485, abs=5e-4)
    assert correlation[1, 2] == pytest.approx(0.993, abs=5e-4)
    # Approach 2 of H.2.4: every observation by itself. It is no linearisation.
    voltage, current, phase = OBSERVED
    z = voltage / current
    single = np.stack([z * np.cos(phase), z * np.sin(phase), z])
    u = single.std(1, ddof=1) / math.sqrt(5)
    assert u == pytest.approx([0.071, 0.295, 0.236], abs=5e-4)
    assert budget.u[order] == pytest.approx(u, rel=0.003)
    assert correlation == pytest.approx(np.corrcoef(single), abs=3e-4)
    # Means of five: four degrees of freedom, whatever is made of them.
    assert budget.nu_eff == pytest.approx([4.0, 4.0, 4.0], rel=1e-12)
    assert budget.U == pytest.approx(stats.t.ppf(0.975, 4) * budget.u, rel=1e-9)


def test_gum_h2_against_the_closed_form():
    v, i, phi = OBSERVED.mean(1)
    c, s = math.cos(phi), math.sin(phi)
    sensitivity = np.array(
        [
            [1 / i, -v / i**2, 0.0],
            [c / i, -v * c / i**2, -v * s / i],
            [s / i, -v * s / i**2, v * c / i],
        ]
    )
    covariance = sensitivity @ (np.cov(OBSERVED) / 5) @ sensitivity.T
    together = MultivariateNormal(OBSERVED.mean(1), np.cov(OBSERVED) / 5, dof=4)

    def of_one(values):
        return impedance(dict(zip(("V", "I", "phi"), values["means"], strict=True)))

    for budget in (
        propagate(impedance, impedance_inputs()),
        propagate(of_one, Inputs({"means": together})),
    ):
        assert budget.sensitivity == pytest.approx(sensitivity, rel=1e-10)
        assert budget.covariance == pytest.approx(covariance, rel=1e-9)
        assert budget.nu_eff == pytest.approx([4.0] * 3)
    assert propagate(of_one, Inputs({"means": together})).source.labels[1] == "means[1]"


@pytest.mark.parametrize("r", [0.0, 0.9])
@pytest.mark.parametrize("x1", [0.001, 0.010, 0.100])
def test_jcgm_102_magnitude_and_phase_first_order(x1, r):
    inputs = Inputs({"x1": Normal(x1, 0.01), "x2": Normal(0.0, 0.01)}, {("x1", "x2"): r})
    budget = propagate(polar, inputs)
    assert budget.value == pytest.approx([x1, 0.0])
    assert budget.u == pytest.approx([0.01, 0.01 / x1])
    assert budget.correlation[0, 1] == pytest.approx(r, abs=1e-12)


@pytest.mark.parametrize(
    "r, value, u",
    [(0.0, (0.1005, 0.0), (0.0100, 0.1005)), (0.9, (0.1005, -0.009), (0.0099, 0.1024))],
)
def test_jcgm_102_magnitude_and_phase_second_order(r, value, u):
    # At x1 = 10 u the second order reaches what the standard prints for Monte Carlo.
    inputs = Inputs({"x1": Normal(0.1, 0.01), "x2": Normal(0.0, 0.01)}, {("x1", "x2"): r})
    budget = propagate(polar, inputs, order=2)
    assert budget.value == pytest.approx(value, abs=5e-5)
    assert budget.u == pytest.approx(u, abs=1.2e-4)


# --- closed forms ---


def test_sensitivities_equal_finite_differences():
    names = {"V": Normal(5.0, 0.3), "I": Normal(0.02, 0.001), "phi": Normal(1.0, 0.1)}
    inputs = Inputs(names)
    budget = propagate(impedance, inputs)
    x, step = budget.source.value, 1e-5 * np.abs(budget.source.value)

    def at(x):
        return np.array(list(impedance(inputs.unflatten(jnp.asarray(x))).values()))

    for k in range(3):
        h = step * np.eye(3)[k]
        assert budget.sensitivity[:, k] == pytest.approx((at(x + h) - at(x - h)) / (2 * step[k]))


def test_covariance_of_quadratic_outputs_is_exact():
    rng = np.random.default_rng(4)
    shapes = rng.normal(size=(2, 3, 3))
    shapes = shapes + shapes.transpose(0, 2, 1)
    root, mean = rng.normal(size=(3, 3)), rng.normal(size=3)
    covariance = root @ root.T

    def forms(values):
        x = values["x"]
        return jnp.stack([x @ jnp.asarray(a) @ x for a in shapes])

    inputs = Inputs({"x": MultivariateNormal(mean, covariance)})
    budget = propagate(forms, inputs, order=2)
    assert budget.labels == ("y[0]", "y[1]")
    for i, a in enumerate(shapes):
        assert budget.value[i] == pytest.approx(mean @ a @ mean + np.trace(a @ covariance))
        for j, b in enumerate(shapes):
            s = covariance
            exact = 2 * np.trace(a @ s @ b @ s) + 4 * mean @ a @ s @ b @ mean
            assert budget.covariance[i, j] == pytest.approx(exact)
    assert budget.u == pytest.approx(np.sqrt(np.diag(budget.covariance)))


def test_third_derivatives_enter_the_variance():
    # Var(x^3) of a normal x is 9 m^4 s^2 + 36 m^2 s^4 + 15 s^6; the series ends before the last.
    mean, u = 2.0, 0.1
    budget = propagate(lambda v: v["x"] ** 3, Inputs({"x": Normal(mean, u)}), order=2)
    assert budget.value[0] == pytest.approx(mean**3 + 3 * mean * u**2)
    assert budget.u[0] ** 2 == pytest.approx(9 * mean**4 * u**2 + 36 * mean**2 * u**4, rel=1e-12)
    assert budget.share_higher[0] == pytest.approx(36 * mean**2 * u**4 / budget.u[0] ** 2)


@pytest.mark.parametrize(
    "distribution, reference",
    [
        (Uniform(-1.0, 3.0), stats.uniform(-1.0, 4.0)),
        (Arcsine(-1.0, 2.0), stats.arcsine(-1.0, 3.0)),
        (LogNormal(0.2, 0.3), stats.lognorm(0.3, scale=math.exp(0.2))),
    ],
)
def test_own_moments_make_the_square_exact(distribution, reference):
    inputs = Inputs({"x": distribution, "z": Normal(1.0, 0.2)})

    def square(values):
        return values["x"] ** 2 + values["z"]

    own = propagate(square, inputs, order=2, moments="own")
    exact = reference.moment(4) - reference.moment(2) ** 2 + 0.04
    assert own.u[0] ** 2 == pytest.approx(exact, rel=1e-6)
    assert own.covariance[0, 0] == pytest.approx(exact, rel=1e-6)
    normal = propagate(square, inputs, order=2)
    m, s = reference.mean(), reference.std()
    assert normal.u[0] ** 2 == pytest.approx(4 * m**2 * s**2 + 2 * s**4 + 0.04, rel=1e-9)
    assert abs(normal.u[0] / own.u[0] - 1) > 0.05


def test_own_moments_of_a_cubic():
    # Terms of x^3 of a rectangular x up to the fourth power of u: moments m_2 and m_4 alone.
    mean, half = 5.0, 0.1
    inputs = Inputs({"x": Uniform(mean - half, mean + half)})
    budget = propagate(lambda v: v["x"] ** 3, inputs, order=2, moments="own")
    m2, m4 = half**2 / 3, half**4 / 5
    series = 9 * mean**4 * m2 + 9 * mean**2 * (m4 - m2**2) + 6 * mean**2 * m4
    assert budget.u[0] ** 2 == pytest.approx(series, rel=1e-10)


def test_own_moments_that_overflow():
    inputs = Inputs({"x": LogNormal(0.0, 6.0)})
    with pytest.raises(ValueError, match="fourth moment is beyond"):
        propagate(lambda v: v["x"] ** 2, inputs, order=2, moments="own")


@pytest.mark.parametrize("order", [1, 2])
def test_shares_add_to_one(order):
    inputs = Inputs(
        {
            "V": Normal(5.0, 0.3),
            "I": Uniform(1.0, 2.0),
            "phi": Arcsine(0.8, 1.2),
            "unused": Normal(0.0, 1.0),
        },
        {("V", "phi"): -0.7},
    )
    budget = propagate(impedance, inputs, order=order)
    for label in budget.labels:
        rows = budget.rows(label)
        names = [row.name for row in rows]
        assert names[4:] == ["correlation of V, phi", "second order"][:order]
        assert sum(row.share for row in rows) == pytest.approx(1.0)
        assert rows[3].share == rows[3].contribution == 0.0
    assert budget.rows("R")[4].share > 0.05 and budget.rows("Z")[4].share == 0.0


def test_outputs_keep_the_order_of_the_function_and_their_shapes():
    def several(values):
        x = values["x"]
        return {"b": x * jnp.arange(1.0, 3.0), "a": 7.0 * x, "c": jnp.ones((1, 2)) * x**2}

    budget = propagate(several, Inputs({"x": Normal(3.0, 0.1)}))
    assert budget.labels == ("b[0]", "b[1]", "a", "c[0, 0]", "c[0, 1]")
    assert budget.value == pytest.approx([3, 6, 21, 9, 9])
    assert budget.u == pytest.approx([0.1, 0.2, 0.7, 0.6, 0.6])
    assert budget.correlation == pytest.approx(np.ones((5, 5)))


def test_large_outputs_need_no_matrix_of_their_size():
    grid = jnp.linspace(0.0, 1.0, 50_000)

    def field(values):
        return values["a"] + values["b"] * grid

    budget = propagate(field, Inputs({"a": Normal(0, 3.0), "b": Normal(0, 4.0)}))
    assert budget.u == pytest.approx(np.hypot(3.0, 4.0 * np.asarray(grid)))


def test_same_function_is_traced_once():
    traced = []

    def function(values):
        traced.append(1)
        return jnp.exp(values["x"])

    propagate(function, Inputs({"x": Normal(0.0, 0.1)}))
    before = len(traced)
    budget = propagate(function, Inputs({"x": Normal(1.0, 0.2)}))
    assert len(traced) == before
    assert budget.u[0] == pytest.approx(0.2 * math.e)


def test_semi_definite_covariance():
    # Three copies of one quantity, whose sum and difference are known beforehand.
    inputs = Inputs({"x": MultivariateNormal([1.0, 1.0, 1.0], np.full((3, 3), 0.04))})

    def combine(values):
        a, b, c = values["x"]
        return {"sum": a + b + c, "difference": a - b, "product": a * b}

    budget = propagate(combine, inputs, order=2)
    assert budget.u == pytest.approx([0.6, 0.0, math.sqrt(4 * 0.04 + 2 * 0.04**2)], abs=1e-9)


@pytest.mark.slow
def test_uncertain_constant_moves_what_is_identified():
    # A slope fitted to readings of an artefact whose expansion is uncertain: through the solver.
    nominal = jnp.linspace(0.1, 0.5, 5)
    readings = 1.002 * nominal

    def slope(values):
        length = nominal * (1.0 + values["alpha"] * values["theta"])

        def residual(b, _):
            return readings - b * length - 0.1 * (b * length) ** 3

        solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
        return optx.least_squares(residual, solver, jnp.asarray(1.0)).value

    inputs = Inputs({"alpha": Normal(11.5e-6, 0.6e-6), "theta": Normal(3.0, 0.2)})
    budget = propagate(slope, inputs)
    # The fit knows b length alone, so that b (1 + alpha theta) stays as it is.
    b, gain = budget.value[0], 1.0 + 11.5e-6 * 3.0
    assert budget.sensitivity[0] == pytest.approx([-b * 3.0 / gain, -b * 11.5e-6 / gain], rel=1e-7)


# --- degrees of freedom and coverage factors ---


def test_coverage_factor_truncates():
    nu = np.array([0.5, 1.0, 4.0 - 1e-13, 16.66, 1e6, np.inf])
    whole = np.array([0.5, 1.0, 4.0, 16.0, 1e6])
    assert coverage_factor(nu, 0.99)[:5] == pytest.approx(stats.t.ppf(0.995, whole), rel=1e-6)
    assert coverage_factor(nu, 0.95)[5] == pytest.approx(stats.norm.ppf(0.975), rel=1e-12)


def test_welch_satterthwaite_of_independent_inputs():
    inputs = Inputs({"a": Normal(0, 3.0, dof=5), "b": Normal(0, 4.0, dof=9), "c": Normal(0, 2.0)})
    budget = propagate(total, inputs)
    assert budget.nu_eff[0] == pytest.approx(29**2 / (81 / 5 + 256 / 9))
    assert budget.notes == ()


def test_members_of_a_group_that_differ_count_with_the_fewest():
    inputs = {"a": Normal(0, 3.0, dof=5), "b": Normal(0, 4.0, dof=9), "c": Normal(0, 2.0, dof=7)}
    budget = propagate(total, Inputs(inputs, {("a", "b"): 0.5}))
    together = 9 + 16 + 2 * 0.5 * 12
    assert budget.nu_eff[0] == pytest.approx((together + 4) ** 2 / (together**2 / 5 + 16 / 7))
    assert len(budget.notes) == 1 and "a, b are correlated" in budget.notes[0]


def test_multivariate_t_is_exact_for_a_linear_function():
    # c x of a multivariate t is a t with the same dof, whose interval the GUM must give.
    scale = np.array([[4.0, 1.0], [1.0, 9.0]])
    inputs = Inputs({"x": MultivariateT([1.0, 2.0], scale, 6.0)})
    budget = propagate(lambda v: v["x"] @ jnp.array([2.0, -1.0]), inputs)
    c = np.array([2.0, -1.0])
    half = stats.t.ppf(0.975, 6) * math.sqrt(c @ scale @ c)
    assert budget.interval("y") == pytest.approx((-half, half), rel=1e-9)


@pytest.mark.parametrize("nu", [0.7, 1.0, 2.0])
def test_two_or_three_repeats_have_a_scale(nu):
    """JCGM 100, 4.2.3: whatever standard deviation JCGM 101 has for them."""
    alone = Inputs({"x": StudentT(1.0, 2.0, nu), "b": MultivariateT([0.0], [[1e-20]], nu)})
    budget = propagate(lambda v: 3.0 * v["x"] + v["b"][0], alone, order=2, moments="own")
    assert budget.u[0] == pytest.approx(6.0) and budget.nu_eff[0] == pytest.approx(nu)
    half = 6.0 * stats.t.ppf(0.975, nu)
    assert budget.interval("y") == pytest.approx((3.0 - half, 3.0 + half))
    pair = {"a": StudentT(0.0, 1.0, nu), "b": Normal(0.0, 1.0)}
    with pytest.raises(ValueError, match=f"t: found dof = {nu}, expected more than 2"):
        propagate(total, Inputs(pair, {("a", "b"): 0.5}))


def test_uncorrelated_elements_of_one_estimate_are_one_group():
    # Estimated from the same seven observations: their variances are not independent evidence.
    inputs = Inputs({"x": MultivariateT([0.0, 0.0], np.diag([4.0, 9.0]), 6.0)})
    assert propagate(lambda v: v["x"].sum(), inputs).nu_eff[0] == pytest.approx(6.0)
    apart = Inputs({"a": StudentT(0.0, 2.0, 6.0), "b": StudentT(0.0, 3.0, 6.0)})
    assert propagate(total, apart).nu_eff[0] == pytest.approx(13**2 / (16 / 6 + 81 / 6))


def test_interval_of_joint_observations_covers_as_often_as_it_says():
    # Correlated normal data, five observations each: the group rule gives exactly 95 %.
    rng = np.random.default_rng(11)
    root, c, cases = np.array([[1.0, 0.0], [0.95, 0.3]]), np.array([1.0, -0.8]), 40_000
    data = rng.standard_normal((cases, 5, 2)) @ root.T
    mean, u = (data @ c).mean(1), np.empty(cases)
    covariance = np.einsum("nij,nik->njk", *(2 * [data - data.mean(1, keepdims=True)])) / 20
    u = np.sqrt(np.einsum("j,njk,k->n", c, covariance, c))
    one = Inputs({"x": MultivariateNormal(data[0].mean(0), covariance[0], dof=4)})
    budget = propagate(lambda v: v["x"] @ jnp.asarray(c), one)
    assert budget.u[0] == pytest.approx(u[0])
    held = np.mean(np.abs(mean) <= budget.k[0] * u)
    assert held == pytest.approx(0.95, abs=3 * math.sqrt(0.95 * 0.05 / cases))


def test_first_order_part_of_zero_takes_the_fewest_degrees_of_freedom():
    inputs = Inputs({"x1": Normal(0.0, 0.1, dof=8), "x2": Normal(0.0, 0.1, dof=3)})
    assert propagate(mismatch, inputs, order=2).nu_eff[0] == 3.0


# --- mistakes ---


def test_function_that_fails_at_the_estimates():
    with pytest.raises(ValueError, match=r"fails at the estimates \(x = -1.0\): ValueError: math"):
        propagate(lambda v: math.sqrt(v["x"]), Inputs({"x": Normal(-1.0, 0.1)}))


@pytest.mark.parametrize("given", [{}, jnp.zeros(0)])
def test_function_without_outputs(given):
    with pytest.raises(ValueError, match="gave no outputs"):
        propagate(lambda v: given, Inputs({"x": Normal(1.0, 0.1)}))


def test_function_that_gives_something_else():
    with pytest.raises(ValueError, match="expected a number, an array"):
        propagate(lambda v: {"a": {"b": v["x"]}}, Inputs({"x": Normal(1.0, 0.1)}))


@pytest.mark.parametrize(
    "function, what",
    [
        (lambda v: jnp.log(v["x"]), "the value of 'y'"),
        (lambda v: {"a": v["x"], "b": jnp.sqrt(v["x"])}, "the derivative of 'b'"),
    ],
)
def test_not_finite_at_the_estimates(function, what):
    with pytest.raises(ValueError, match=what):
        propagate(function, Inputs({"x": Normal(0.0, 0.1)}))


def test_second_derivative_that_is_not_finite():
    with pytest.raises(ValueError, match="second or third derivative of 'y'"):
        propagate(lambda v: jnp.abs(v["x"]) ** 1.5, Inputs({"x": Normal(0.0, 0.1)}), order=2)


def test_second_order_variance_that_is_negative():
    inputs = Inputs({"x1": Normal(0.001, 0.01), "x2": Normal(0.0, 0.01)})
    with pytest.raises(ValueError, match="variance of 'r' is negative"):
        propagate(polar, inputs, order=2)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"order": 3}, "order: found 3"),
        ({"coverage": 1.0}, "coverage probability: found 1.0"),
        ({"order": 2, "moments": "all"}, "moments: found 'all'"),
        ({"moments": "own"}, "first order"),
    ],
)
def test_settings_that_make_no_sense(settings, message):
    with pytest.raises(ValueError, match=message):
        propagate(total, Inputs({"x": Normal(1.0, 0.1)}), **settings)


def test_output_that_is_not_there():
    inputs = Inputs({"x1": Normal(1.0, 0.1), "x2": Normal(1.0, 0.1)})
    budget = propagate(polar, inputs)
    with pytest.raises(ValueError, match="found 'phase', expected one of r, theta"):
        budget.interval("phase")
    with pytest.raises(ValueError, match="name the one"):
        budget_table(budget)


def test_float32_is_refused():
    with jax.enable_x64(False), pytest.raises(RuntimeError, match="float64"):
        propagate(total, Inputs({"x": Normal(1.0, 0.1)}))


# --- the table ---


def test_budget_as_a_table():
    text = budget_table(propagate(gauge, Inputs(GAUGE), order=2, coverage=0.99))
    table, result = text.split("\n\n")
    lines = table.splitlines()
    assert len({line.count("|") for line in lines}) == 1 and len(lines) == 2 + 6 + 1
    assert lines[2] == "| ls | 50000623 | 25 | normal | 18 | 1 | 25 | 54.3 % |"
    assert lines[-1].startswith("| second order |")
    assert result == "y = 838, u = 34, ν_eff = 16.7, k = 2.92, U = 99 (99 %): [739, 937]"


def test_table_tells_the_notes():
    text = budget_table(propagate(mismatch, mismatched(0.0, 0.0)))
    assert text.splitlines()[-1].startswith("- y has no first-order sensitivity to any input")
