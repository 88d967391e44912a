"""Budgets that are published: EA-4/02 M, supplements S2, S3, S4, S9, S10; NIST TN 1900, E2.

Inputs and results are those that the documents print; every u is computed here from the stated
limits or readings. Of EA-4/02, the supplements whose inputs were not all at hand are left out.
"""

import math

import pytest
from scipy import stats

from vcal.distributions import Certificate, Inputs, Normal, Repeats, Triangular, Uniform
from vcal.uncertainty import propagate, propagate_distributions, result_line


def total(values):
    return sum(values.values())


def within(half, middle=0.0):
    return Uniform(middle - half, middle + half)


def test_ea_4_02_s2_weight_of_10_kg():
    """g and mg: m_X = m_S + dm_D + dm + dm_C + dB."""
    inputs = Inputs(
        {
            "m_S": Certificate(10000.005, 0.045, k=2),
            "dm_D": within(0.015),
            "dm": Repeats([0.01, 0.03, 0.02], s=0.025),
            "dm_C": within(0.010),
            "dB": within(0.010),
        }
    )
    budget = propagate(total, inputs)
    assert budget.value[0] == pytest.approx(10000.025, abs=5e-4)
    printed = [22.5, 8.66, 14.4, 5.77, 5.77]
    assert 1e3 * budget.source.u == pytest.approx(printed, abs=0.05)
    assert 1e3 * budget.u[0] == pytest.approx(29.3, abs=0.05)
    assert 1e3 * budget.stated(k=2).U[0] == pytest.approx(59, abs=0.5)
    assert "u = 0.029" in result_line(budget) and "10000.025" in result_line(budget)


def test_ea_4_02_s3_resistor_of_10_kilohm():
    """ohm: R_X = (R_S + dR_D + dR_TS) r_C r - dR_TX."""
    inputs = Inputs(
        {
            "R_S": Certificate(10000.053, 0.005, k=2),
            "dR_D": within(0.010, 0.020),
            "dR_TS": within(2.75e-3),
            "r_C": Triangular(1.0 - 1e-6, 1.0 + 1e-6),
            "r": Repeats([1.0000104, 1.0000107, 1.0000106, 1.0000103, 1.0000105]),
            "dR_TX": within(5.5e-3),
        }
    )

    def resistance(v):
        return (v["R_S"] + v["dR_D"] + v["dR_TS"]) * v["r_C"] * v["r"] - v["dR_TX"]

    budget = propagate(resistance, inputs)
    assert budget.value[0] == pytest.approx(10000.178, abs=5e-4)
    printed = [2.5, 5.8, 1.6, 4.1, 0.7, 3.2]
    assert 1e3 * budget.contribution[0] == pytest.approx(printed, abs=0.05)
    assert 1e3 * budget.u[0] == pytest.approx(8.33, abs=5e-3)
    assert 1e3 * budget.stated(k=2).U[0] == pytest.approx(17, abs=0.5)


def test_ea_4_02_s4_gauge_block_of_50_mm():
    """nm from 50 mm: l_X = l_S + dl_D + dl + dl_C - L (alpha dt + dalpha Dt) - dl_V."""
    inputs = Inputs(
        {
            "l_S": Certificate(20.0, 30.0, k=2),
            "dl_D": within(30.0),
            "dl": Repeats([-94.0] * 5, s=12.0),
            "dl_C": within(32.0),
            "dt": within(0.05),
            "dalpha": Triangular(-2e-6, 2e-6),
            "Dt": within(0.5),
            "dl_V": within(6.7),
        }
    )

    def length(v):
        expansion = 11.5e-6 * v["dt"] + v["dalpha"] * v["Dt"]
        return v["l_S"] + v["dl_D"] + v["dl"] + v["dl_C"] - 5e7 * expansion - v["dl_V"]

    # The product of two quantities whose estimates are zero needs the second order.
    budget = propagate(length, inputs, order=2)
    assert budget.value[0] == pytest.approx(-74.0, abs=0.5)  # 49.999 926 mm
    printed = {"l_S": 15.0, "dl_D": 17.3, "dl": 5.37, "dl_C": 18.5, "dt": 16.6, "dl_V": 3.87}
    found = dict(zip(budget.source.labels, budget.contribution[0], strict=True))
    assert {k: found[k] for k in printed} == pytest.approx(printed, abs=0.05)
    product = math.sqrt(budget.share_higher[0]) * budget.u[0]
    assert product == pytest.approx(11.8, abs=0.05)
    assert budget.u[0] == pytest.approx(36.4, abs=0.05)
    assert budget.stated(k=2).U[0] == pytest.approx(73, abs=0.5)


def test_ea_4_02_s9_multimeter_at_100_v():
    """V: E_X = V_iX - V_S + dV_iX - dV_S; one rectangular contribution dominates."""
    inputs = Inputs(
        {"V_S": Certificate(100.0, 0.002, k=2), "dV_iX": within(0.05), "dV_S": within(0.011)}
    )

    def error(v):
        return 100.1 - v["V_S"] + v["dV_iX"] - v["dV_S"]

    budget = propagate(error, inputs)
    assert budget.value[0] == pytest.approx(0.1, abs=1e-9)
    assert budget.contribution[0] == pytest.approx([0.001, 0.029, 0.0064], abs=2e-4)
    assert budget.u[0] == pytest.approx(0.030, abs=5e-4)
    # k = 0.95 sqrt(3) of a rectangle, as the document states it.
    k = 0.95 * math.sqrt(3.0)
    assert k == pytest.approx(1.65, abs=5e-3)
    assert budget.stated(k=1.65).U[0] == pytest.approx(0.05, abs=5e-3)
    low, high = propagate_distributions(error, inputs, draws=50_000).interval("y")
    assert 0.5 * (high - low) == pytest.approx(0.05, abs=2e-3)


def test_ea_4_02_s10_vernier_caliper():
    """um from 150 mm: the two largest contributions are rectangular, their sum a trapezoid."""
    inputs = Inputs(
        {"l_S": within(0.8), "Dt": within(2.0), "dl_iX": within(25.0), "dl_M": within(50.0)}
    )

    def error(v):
        return 100.0 - v["l_S"] + 1.7 * v["Dt"] + v["dl_iX"] + v["dl_M"]

    budget = propagate(error, inputs)
    assert budget.value[0] == pytest.approx(100.0)
    # Printed with two digits: 0.46, 2.0, 15 and 29 um, which give 33.
    assert budget.contribution[0] == pytest.approx([0.46, 2.0, 14.4, 28.9], abs=0.06)
    assert budget.u[0] == pytest.approx(33, abs=1.0)
    assert budget.stated(k=1.83).U[0] == pytest.approx(60, abs=2.0)
    drawn = propagate_distributions(error, inputs, draws=50_000)
    low, high = drawn.interval("y")
    assert 0.5 * (high - low) / drawn.u[0] == pytest.approx(1.83, abs=0.02)


def test_tn_1900_e2_surface_temperature():
    """degC: 22 daily maxima; NIST prints 25.6, u = 0.872 and (23.8, 27.4) by Student's t."""
    maxima = [
        18.75, 28.25, 25.75, 28.00, 28.50, 20.75, 21.00, 22.75, 18.50, 27.25, 20.75,
        26.50, 28.00, 23.25, 28.00, 21.75, 26.00, 26.50, 28.00, 33.25, 32.00, 29.50,
    ]  # fmt: skip
    inputs = Inputs({"t": Repeats(maxima)})
    budget = propagate(lambda v: v["t"], inputs)
    assert budget.value[0] == pytest.approx(25.6, abs=0.05)
    assert budget.u[0] == pytest.approx(0.872, abs=5e-4)
    assert budget.nu_eff[0] == pytest.approx(21.0)
    assert budget.interval("y") == pytest.approx((23.8, 27.4), abs=0.05)
    assert budget.interval("y") == pytest.approx(
        stats.t.interval(0.95, 21, budget.value[0], budget.u[0]), rel=1e-9
    )


def test_normal_with_degrees_of_freedom_differs_from_its_t():
    """The GUM counts dof of a normal input, Monte Carlo draws it as normal: take the t instead."""
    normal = propagate(total, Inputs({"x": Normal(0.0, 1.0, dof=4)}))
    assert normal.k[0] == pytest.approx(stats.t.ppf(0.975, 4))
    drawn = propagate_distributions(total, Inputs({"x": Normal(0.0, 1.0, dof=4)}), draws=20_000)
    low, high = drawn.interval("y")
    assert high - low == pytest.approx(2 * 1.96, rel=0.03)
