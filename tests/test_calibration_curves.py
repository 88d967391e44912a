"""Calibration curves against ISO/TS 28037, JCGM 100 H.3, scipy and simulated calibrations."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from vcal.distributions import Inputs, Normal
from vcal.uncertainty import calibration_curve, propagate

SIX = np.arange(1.0, 7.0)
EQUAL = (SIX, [3.3, 5.6, 7.1, 9.3, 10.7, 12.1])
BOTH = ([1.2, 1.9, 2.9, 4.0, 4.7, 5.9], [3.4, 4.4, 7.2, 8.5, 10.8, 13.5])
U_BOTH = {"u_x": 0.2, "u_y": [0.2, 0.2, 0.2, 0.4, 0.4, 0.4]}
UNKNOWN = (SIX, [3.014, 5.225, 7.004, 9.061, 11.201, 12.762])


# --- ISO/TS 28037:2010. Data and printed values as in the public documentation of GTC (section
# "Straight-line calibration functions"), which quotes the standard; those of predictions from the
# public test of QWTB's ISOTS28037. ---


def test_clause_6_equal_weights():
    curve = calibration_curve(*EQUAL, u_y=0.5)
    assert curve.method == "weighted" and math.isinf(curve.dof)
    assert curve.coefficients == pytest.approx([1.867, 1.757], abs=5e-4)
    assert curve.u == pytest.approx([0.465, 0.120], abs=5e-4)
    assert curve.covariance[0, 1] == pytest.approx(-0.050, abs=5e-4)
    assert curve.chi_squared == pytest.approx(1.665, abs=5e-4) and curve.chi_dof == 4
    assert curve.consistent() and stats.chi2.ppf(0.95, 4) == pytest.approx(9.488, abs=5e-4)
    back = curve.inverse(10.5, 0.5)
    assert (back.value[0], back.u[0]) == pytest.approx((4.913, 0.322), abs=5e-4)
    forward = curve.predict([3.5, 4.5], [0.2, 0.4])
    assert forward.value == pytest.approx([8.017, 9.774], abs=5e-4)
    assert forward.u == pytest.approx([0.406, 0.742], abs=5e-4)


def test_clause_6_unequal_weights():
    y, u = [3.2, 4.3, 7.6, 8.6, 11.7, 12.8], [0.5, 0.5, 0.5, 1.0, 1.0, 1.0]
    curve = calibration_curve(SIX, y, u_y=u)
    assert curve.coefficients == pytest.approx([0.885, 2.057], abs=5e-4)
    assert curve.u == pytest.approx([0.530, 0.178], abs=5e-4)
    assert curve.covariance[0, 1] == pytest.approx(-0.082, abs=5e-4)
    assert curve.chi_squared == pytest.approx(4.131, abs=5e-4)
    back = curve.inverse(10.5, 1.0)
    assert (back.value[0], back.u[0]) == pytest.approx((4.674, 0.533), abs=5e-4)


@pytest.fixture(scope="module")
def both():
    return calibration_curve(*BOTH, **U_BOTH)


def test_clause_7_uncertainty_in_x_and_y(both):
    assert both.method == "errors in both"
    assert both.coefficients == pytest.approx([0.5788, 2.1597], abs=5e-5)
    assert both.u == pytest.approx([0.4764, 0.1355], abs=5e-5)
    assert both.covariance[0, 1] == pytest.approx(-0.0577, abs=5e-5)
    assert both.chi_squared == pytest.approx(2.743, abs=5e-4) and both.consistent()
    forward = both.predict([3.5, 4.5], [0.2, 0.4])
    assert forward.value == pytest.approx([8.138, 10.297], abs=5e-4)
    assert forward.u == pytest.approx([0.484, 0.909], abs=5e-4)


def test_annex_e_unknown_uncertainty():
    curve = calibration_curve(*UNKNOWN)
    same = calibration_curve(*UNKNOWN, u_y=1.0, known=False)
    assert curve.method == "ordinary" and curve.dof == same.dof == 4.0
    np.testing.assert_allclose(same.covariance, curve.covariance, rtol=1e-12)
    assert curve.coefficients == pytest.approx([1.172, 1.964], abs=5e-4)
    # Printed before the factor of the standard deviation of a t.
    assert curve.u == pytest.approx([0.159, 0.041], abs=5e-4)
    assert curve.covariance[0, 1] == pytest.approx(-0.006, abs=5e-4)
    # Two digits as GTC gives them.
    back = curve.inverse(10.5)
    assert (back.value[0], back.u[0]) == pytest.approx((4.751, 0.097), abs=6e-4)
    assert curve.predict(3.5, reading="scatter").u[0] == pytest.approx(0.18, abs=5e-3)
    assert curve.predict(3.5).u[0] == pytest.approx(0.070, abs=5e-4)
    with pytest.raises(ValueError, match="chi-squared says nothing"):
        curve.consistent()


# Data of the examples in clauses 9 and 10, from the public NPL software for the standard; the
# results are held against plain numpy and scipy, as the printed ones were not at hand.
CLAUSE_9 = (
    np.arange(1.0, 11.0),
    np.array([1.3, 4.1, 6.9, 7.5, 10.2, 12.0, 14.5, 17.1, 19.5, 21.0]),
    np.kron(np.diag([1.0, 4.0]), np.ones((5, 5))) + np.eye(10),
)
CLAUSE_10 = (
    np.array([50.4, 99.0, 149.9, 200.4, 248.5, 299.7, 349.1]),
    np.array([52.3, 97.8, 149.7, 200.1, 250.4, 300.9, 349.2]),
    np.array(
        [
            [0.5, 0, 0.25, 0, 0.25, 0, 0.25],
            [0, 1.25, 1, 0, 0, 1, 1],
            [0.25, 1, 1.5, 0, 0.25, 1, 1.25],
            [0, 0, 0, 1.25, 1, 1, 1],
            [0.25, 0, 0.25, 1, 1.5, 1, 1.25],
            [0, 1, 1, 1, 1, 2.25, 2],
            [0.25, 1, 1.25, 1, 1.25, 2, 2.5],
        ]
    ),
    np.ones((7, 7)) + 4.0 * np.eye(7),
)


def by_scipy(x, y, joint, degree):
    """Coefficients, covariance and chi-squared by scipy's solver, all true x among the unknowns."""
    n, root = len(x), np.linalg.cholesky(joint)

    def residual(theta):
        true = theta[degree + 1 :]
        apart = np.concatenate([x - true, y - np.polyval(theta[degree::-1], true)])
        return np.linalg.solve(root, apart)

    start = np.concatenate([np.polyfit(x, y, degree)[::-1], x])
    scale = np.maximum(np.abs(start), 0.1)
    limits = {"xtol": 1e-15, "ftol": 1e-15, "x_scale": scale}
    found = optimize.least_squares(residual, start, "3-point", method="lm", **limits)
    assert len(found.fun) == 2 * n
    spread = np.linalg.inv(found.jac.T @ found.jac)
    p = degree + 1
    return found.x[:p], spread[:p, :p], float(found.fun @ found.fun)


def test_clause_8_covariance_within_a_point():
    """Data of the example in clause 8, from the public NPL software in its translation to R."""
    between = 0.036 * np.eye(6)
    curve = calibration_curve(*BOTH, **U_BOTH, covariance_xy=between)
    spread = np.diag(np.array(U_BOTH["u_y"]) ** 2)
    joint = np.block([[0.04 * np.eye(6), between], [between, spread]])
    coefficients, covariance, chi = by_scipy(np.array(BOTH[0]), np.array(BOTH[1]), joint, 1)
    assert curve.coefficients == pytest.approx(coefficients, rel=1e-6)
    assert curve.covariance == pytest.approx(covariance, rel=1e-4)
    assert curve.chi_squared == pytest.approx(chi, rel=1e-6)


def test_clause_9_correlated_y():
    x, y, covariance = CLAUSE_9
    curve = calibration_curve(x, y, covariance_y=covariance)
    design, weight = np.vander(x, 2, increasing=True), np.linalg.inv(covariance)
    spread = np.linalg.inv(design.T @ weight @ design)
    beta = spread @ design.T @ weight @ y
    assert curve.method == "generalised"
    np.testing.assert_allclose(curve.coefficients, beta, rtol=1e-10)
    np.testing.assert_allclose(curve.covariance, spread, rtol=1e-9)
    residual = y - design @ beta
    assert curve.chi_squared == pytest.approx(residual @ weight @ residual, rel=1e-9)


def test_clause_10_correlated_x_and_y():
    x, y, u_x, u_y = CLAUSE_10
    curve = calibration_curve(x, y, covariance_x=u_x, covariance_y=u_y)
    zero = np.zeros((7, 7))
    beta, spread, chi = by_scipy(x, y, np.block([[u_x, zero], [zero, u_y]]), 1)
    np.testing.assert_allclose(curve.coefficients, beta, rtol=1e-6)
    np.testing.assert_allclose(curve.covariance, spread, rtol=1e-5)
    assert curve.chi_squared == pytest.approx(chi, rel=1e-8)


def test_polynomial_with_correlated_x_and_y():
    rng = np.random.default_rng(2)
    x = np.linspace(0.0, 3.0, 8)
    y = 1.0 + 2.0 * x - 0.4 * x**2 + rng.normal(0, 0.05, 8)
    between = np.diag(np.full(8, 0.0006))
    curve = calibration_curve(x, y, 2, u_x=0.04, u_y=0.05, covariance_xy=between)
    joint = np.block([[0.04**2 * np.eye(8), between], [between, 0.05**2 * np.eye(8)]])
    beta, spread, chi = by_scipy(x, y, joint, 2)
    np.testing.assert_allclose(curve.coefficients, beta, rtol=1e-6)
    np.testing.assert_allclose(curve.covariance, spread, rtol=1e-5)
    assert curve.chi_squared == pytest.approx(chi, rel=1e-7)


def test_exact_x_are_allowed_for_some_points(both):
    u_x = np.array([0.2, 0.0, 0.2, 0.2, 0.0, 0.2])
    x, y = map(np.asarray, BOTH)
    curve = calibration_curve(x, y, u_x=u_x, u_y=U_BOTH["u_y"])
    joint = np.diag(np.concatenate([np.maximum(u_x, 1e-6), U_BOTH["u_y"]]) ** 2)
    beta, spread, chi = by_scipy(x, y, joint, 1)
    np.testing.assert_allclose(curve.coefficients, beta, rtol=1e-5)
    np.testing.assert_allclose(curve.covariance, spread, rtol=1e-4)
    assert curve.chi_squared == pytest.approx(chi, rel=1e-6)
    all_exact = calibration_curve(x, y, u_x=0.0, u_y=U_BOTH["u_y"])
    assert all_exact.method == "weighted" and all_exact.u[1] < both.u[1]


# --- JCGM 100, H.3: calibration of a thermometer, Table H.6 ---


def test_gum_h3_thermometer():
    t = [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
    b = [171, 169, 166, 159, 164, 165, 156, 157, 159, 161, 160]
    curve = calibration_curve(np.array(t) - 20.0, -1e-3 * np.array(b))
    assert curve.coefficients == pytest.approx([-0.1712, 0.00218], abs=5e-5)
    assert curve.u == pytest.approx([0.0029, 0.00067], abs=5e-5)
    assert curve.covariance[0, 1] / curve.u.prod() == pytest.approx(-0.930, abs=5e-4)
    assert curve.scatter == pytest.approx(0.0035, abs=5e-5) and curve.dof == 9.0
    at_30 = curve.predict(10.0)
    assert (at_30.value[0], at_30.u[0]) == pytest.approx((-0.1494, 0.0041), abs=6e-5)
    assert at_30.extrapolated[0] and at_30.dof[0] == pytest.approx(9.0)
    # The coefficients as an input give the same.
    inputs = Inputs({"c": curve.distribution})
    budget = propagate(lambda v: v["c"][0] + 10.0 * v["c"][1], inputs)
    assert budget.u[0] == pytest.approx(at_30.u[0], rel=1e-9)
    assert budget.nu_eff[0] == pytest.approx(9.0)


# --- against scipy and simulation ---


def test_ordinary_line_is_that_of_scipy():
    theirs = stats.linregress(*UNKNOWN)
    ours = calibration_curve(*UNKNOWN)
    assert ours.coefficients == pytest.approx([theirs.intercept, theirs.slope], rel=1e-12)
    assert ours.u == pytest.approx([theirs.intercept_stderr, theirs.stderr], rel=1e-10)


def test_polynomial_far_from_zero_is_that_of_numpy():
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 10.0, 12)
    x, y = 2000.0 + t, 3.0 + 0.5 * t - 0.1 * t**2 + 0.01 * t**3 + rng.normal(0, 0.1, 12)
    near, far = calibration_curve(t, y, 3), calibration_curve(x, y, 3)
    theirs, covariance = np.polyfit(t, y, 3, cov=True)
    np.testing.assert_allclose(near.coefficients, theirs[::-1], rtol=1e-9)
    np.testing.assert_allclose(near.covariance, covariance[::-1, ::-1], rtol=1e-8)
    at = np.array([1.3, 6.6])
    np.testing.assert_allclose(far.predict(2000.0 + at).value, near.predict(at).value, rtol=1e-10)
    np.testing.assert_allclose(far.predict(2000.0 + at).u, near.predict(at).u, rtol=1e-8)
    expected = np.vander(at, 4, increasing=True) @ covariance[::-1, ::-1]
    expected = expected @ np.vander(at, 4, increasing=True).T
    np.testing.assert_allclose(near.predict(at).covariance, expected, rtol=1e-7)


def test_inverse_undoes_prediction():
    x = np.linspace(0.0, 4.0, 9)
    curve = calibration_curve(x, 1.0 + x + 0.2 * x**3, 3, u_y=0.01)
    at = np.array([0.4, 2.2, 3.9])
    forward = curve.predict(at)
    back = curve.inverse(forward.value, 0.02)
    np.testing.assert_allclose(back.value, at, rtol=1e-9)
    slope = 1.0 + 0.6 * at**2
    np.testing.assert_allclose(back.u, np.hypot(forward.u, 0.02) / slope, rtol=1e-7)
    assert not back.extrapolated.any()


def test_a_value_that_is_taken_twice_needs_a_place():
    x = np.linspace(-1.0, 3.0, 7)
    curve = calibration_curve(x, (x - 1.0) ** 2, 2, u_y=0.1)
    with pytest.raises(ValueError, match=r"takes at x = 0 and 2; state near which x"):
        curve.inverse(1.0, 0.1)
    assert curve.inverse(1.0, 0.1, near=2.4).value[0] == pytest.approx(2.0)
    with pytest.raises(ValueError, match="does not take for any x"):
        curve.inverse(-3.0, 0.1)


@pytest.mark.parametrize("known", [True, False])
def test_intervals_of_x_cover_as_often_as_they_say(known):
    rng, cases = np.random.default_rng(7), 600
    x, held = np.linspace(0.0, 10.0, 6), 0
    for _ in range(cases):
        y = 2.0 + 3.0 * x + rng.normal(0.0, 0.3, 6)
        reading = 2.0 + 3.0 * 6.4 + rng.normal(0.0, 0.3)
        if known:
            found = calibration_curve(x, y, u_y=0.3).inverse(reading, 0.3)
        else:
            found = calibration_curve(x, y).inverse(reading)
            assert found.dof[0] == pytest.approx(4.0)
        held += abs(found.value[0] - 6.4) <= found.U[0]
    assert held / cases == pytest.approx(0.95, abs=0.03)


def test_degrees_of_freedom_of_a_reading_of_its_own():
    curve = calibration_curve(*UNKNOWN)
    found = curve.inverse(10.5, 0.1, dof_y=7)
    row = np.array([1.0, found.value[0]])
    own = row @ curve.covariance @ row
    nu = (own + 0.01) ** 2 / (own**2 / 4 + 0.01**2 / 7)
    assert found.dof[0] == pytest.approx(nu, rel=1e-9)
    several = curve.inverse(10.5, readings=5)
    assert several.u[0] < curve.inverse(10.5).u[0] and several.dof[0] == pytest.approx(4.0)


def test_curve_as_an_input_of_an_evaluation(both):
    inputs = Inputs({"c": both.distribution, "y": Normal(9.0, 0.4)})
    budget = propagate(lambda v: (v["y"] - v["c"][0]) / v["c"][1], inputs)
    back = both.inverse(9.0, 0.4)
    assert (budget.value[0], budget.u[0]) == pytest.approx((back.value[0], back.u[0]), rel=1e-9)


def test_points_that_disagree_are_not_consistent():
    x, y = EQUAL
    assert not calibration_curve(x, y, u_y=0.1).consistent()
    assert calibration_curve(x, y, u_y=0.1).p_value == pytest.approx(
        stats.chi2.sf(1.6647619 * 25, 4), rel=1e-5
    )


MISTAKES = {
    "lengths": (lambda: calibration_curve([1, 2, 3], [1, 2]), "found 3 x and 2 y"),
    "nan": (lambda: calibration_curve([1, 2, np.nan], [1, 2, 3]), "x: found nan at position 2"),
    "same x": (lambda: calibration_curve([1, 1, 1], [1, 2, 3]), "found 1 different values"),
    "two points": (lambda: calibration_curve([1, 2], [1, 2]), "found 2 points for 2 coefficients"),
    "degree": (lambda: calibration_curve([1, 2], [1, 2], 0), "degree: found 0"),
    "u_y": (lambda: calibration_curve([1, 2], [1, 2], u_y=[0.1, 0]), r"u_y: found 0\.0 at pos"),
    "u_y shape": (lambda: calibration_curve(*EQUAL, u_y=[0.1, 0.2]), r"u_y: found shape \(2,\)"),
    "x alone": (lambda: calibration_curve(*EQUAL, u_x=0.1), "uncertainties of x alone"),
    "twice": (
        lambda: calibration_curve(*EQUAL, u_y=1, covariance_y=np.eye(6)),
        "found u_y and covariance_y",
    ),
    "singular": (
        lambda: calibration_curve(*EQUAL, covariance_y=np.ones((6, 6))),
        "covariance_y: the correlations cannot all hold, or leave",
    ),
    "xy alone": (
        lambda: calibration_curve(*EQUAL, u_y=1, covariance_xy=np.eye(6)),
        "covariance_xy without uncertainties of x",
    ),
    "reading": (
        lambda: calibration_curve(*EQUAL, u_y=0.5).inverse(5.0),
        "scatter of a single reading is not known from a weighted fit",
    ),
    "no slope": (
        lambda: calibration_curve([-1, 0, 1.0], [1, 0, 1.0], 2, u_y=0.1).inverse(0.0, 0.1),
        "where the curve has no slope",
    ),
    "no test": (
        lambda: calibration_curve([1, 2], [1, 2], u_y=0.1).p_value,
        "found as many coefficients as points",
    ),
}


@pytest.mark.parametrize(("make", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_predictions_share_the_curve():
    curve = calibration_curve(*EQUAL, u_y=0.5)
    pair = curve.predict([2.0, 5.0], 0.1)
    rows = np.array([[1.0, 2.0], [1.0, 5.0]])
    expected = rows @ curve.covariance @ rows.T + (curve.coefficients[1] * 0.1) ** 2 * np.eye(2)
    np.testing.assert_allclose(pair.covariance, expected, rtol=1e-10)
    assert jnp.all(pair.U == pair.k * pair.u)
