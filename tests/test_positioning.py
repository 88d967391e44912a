"""ISO 230-2: against a published evaluation, hand calculation, and simple limits."""

import math

import numpy as np
import pytest

from vcal.geometry.positioning import Contributors, positioning, runs_at_targets, systematic

# The motion test report of axis 1 in the public repository anderssandstrom/ecmc_bifrost_slits_sat
# (tests_2/11358), five positions and five runs each way, in mm.
TARGET = np.array([15.0, 25.2, 35.4, 45.6, 55.8])
FORWARD = np.array([
    [15.00335, 15.00233, 15.00172, 15.00213, 15.00172],
    [25.19974, 25.20015, 25.20096, 25.20056, 25.20056],
    [35.40102, 35.3996, 35.40225, 35.40306, 35.40449],
    [45.59151, 45.5909, 45.59212, 45.5909, 45.58947],
    [55.80583, 55.80624, 55.80685, 55.80562, 55.80562],
])  # fmt: skip
BACKWARD = np.array([
    [15.00518, 15.00518, 15.00416, 15.00335, 15.00314],
    [25.19628, 25.19607, 25.19567, 25.19587, 25.19526],
    [35.39817, 35.39837, 35.3998, 35.39939, 35.4],
    [45.59232, 45.59191, 45.59293, 45.59191, 45.59151],
    [55.80705, 55.80725, 55.80705, 55.80705, 55.80644],
])  # fmt: skip
# Its results. E and R are not compared: the report takes the smaller of E+ and E- for E, and leaves
# the reversal error out of R, other than ISO 230-2:2014.
PRINTED = {
    "A": 0.01858, "A+": 0.01806, "A-": 0.01655, "E+": 0.01505, "E-": 0.01485, "M": 0.01495,
    "B": 0.00456, "B_mean": 0.00069, "R+": 0.0075, "R-": 0.00388,
}  # fmt: skip
PRINTED_S = ([0.00067, 0.00046, 0.00188, 0.00098, 0.00052], [0.00097, 0.00039, 0.00083, 0.00054,
                                                             0.00031])  # fmt: skip
PRINTED_R = [0.00524, 0.00628, 0.00835, 0.00419, 0.00259]


def test_a_published_evaluation_to_the_last_digit():
    found = positioning(TARGET, FORWARD - TARGET[:, None], BACKWARD - TARGET[:, None])
    # Readings and results are printed with five decimals: sums of rounded numbers differ by one.
    for name, printed in PRINTED.items():
        assert found.values[name] == pytest.approx(printed, abs=1.1e-5), name
    np.testing.assert_allclose(found.s_up, PRINTED_S[0], atol=0.51e-5)
    np.testing.assert_allclose(found.s_down, PRINTED_S[1], atol=0.51e-5)
    np.testing.assert_allclose(found.repeatability, PRINTED_R, atol=1.1e-5)
    # R is the largest R_i of the report, and E the range of all means in it.
    assert found.values["R"] == pytest.approx(0.00835, abs=1.1e-5)
    assert found.values["E"] == pytest.approx(0.00697 + 0.00902, abs=1.1e-5)


def test_hand_calculation():
    # Two positions, two runs; all sums are whole numbers.
    up = np.array([[1.0, 3.0], [6.0, 6.0]])  # means 2, 6; s = sqrt(2), 0
    down = np.array([[0.0, 0.0], [3.0, 9.0]])  # means 0, 6; s = 0, sqrt(18)
    found = positioning(np.array([0.0, 100.0]), up, down)
    root = math.sqrt(2.0)
    by_hand = {
        "A": 6.0 + 6 * root - (6.0 - 6 * root),
        "A+": 6.0 - (2.0 - 2 * root),
        "A-": 6.0 + 6 * root - (6.0 - 6 * root),
        "R": 12 * root,  # at 100: 2 s- + 2 s+ + |B| = 6 root, R- = 12 root
        "R+": 4 * root,
        "R-": 12 * root,
        "E": 6.0,
        "E+": 4.0,
        "E-": 6.0,
        "M": 5.0,
        "B": 2.0,
        "B_mean": 1.0,
    }
    assert found.values == pytest.approx(by_hand, rel=1e-14)
    assert list(found.values) == list(by_hand)
    np.testing.assert_allclose(found.repeatability, [max(2 * root + 2.0, 4 * root), 12 * root])


def test_one_direction_and_single_runs():
    up = np.array([[1.0], [4.0], [2.0]])
    found = positioning(np.arange(3.0), up)
    assert found.values == {"E+": 3.0}
    assert list(positioning(np.arange(3.0), None, up).values) == ["E-"]
    both = positioning(np.arange(3.0), up, up - 1.0)
    assert both.values == pytest.approx(
        {"E": 4.0, "E+": 3.0, "E-": 3.0, "M": 3.0, "B": 1.0, "B_mean": 1.0}
    )
    with pytest.raises(ValueError, match="found no runs"):
        positioning(np.arange(3.0))
    with pytest.raises(ValueError, match=r"expected \(3, runs\)"):
        positioning(np.arange(3.0), np.zeros((2, 1)))
    with pytest.raises(ValueError, match="no deviation at the target 1"):
        positioning(np.arange(3.0), np.array([[0.0], [np.nan], [0.0]]))


def test_uncertainties_by_hand():
    about = Contributors(
        device=0.3, misalignment=0.4, temperature=0.1, expansion=12.0, expansion_u=0.6, away=-2.0,
        environment=math.sqrt(12.0),
    )  # fmt: skip
    up = np.random.default_rng(1).standard_normal((4, 5))
    found = positioning(np.linspace(0, 2, 4), up, -up, about)
    along = 4.0 * (0.09 + 0.16 + 1.44 + 1.44)
    assert found.u["M"] == pytest.approx(math.sqrt(along + 0.2))
    assert found.u["E"] == pytest.approx(math.sqrt(along + 0.4))
    assert found.u["A"] == pytest.approx(math.sqrt(along + 0.4 + 1.0))
    assert found.u["B"] == pytest.approx(math.sqrt(0.4))
    assert found.u["B_mean"] == pytest.approx(math.sqrt(0.1))
    assert found.u["R+"] == pytest.approx(math.sqrt(2.0))
    assert found.u["R"] == pytest.approx(math.sqrt(1.4))
    assert found.U("M") == 2.0 * found.u["M"]
    # A test without any contributor but its scatter has none.
    assert set(positioning(np.linspace(0, 2, 4), up, -up).u.values()) == {0.0}


@pytest.mark.thorough
def test_uncertainty_of_means_agrees_with_monte_carlo():
    """The parts of environment and scale, by drawing both."""
    rng = np.random.default_rng(2)
    target, n = np.linspace(0.0, 1.0, 6), 5
    # Errors that determine the extreme positions: first and last.
    true = np.array([0.0, 20.0, 30.0, 40.0, 50.0, 90.0])
    drawn: dict[str, list[float]] = {"M": [], "E+": [], "B_mean": []}
    for _ in range(4000):
        slope = 0.5 * rng.standard_normal()
        up, down = (
            true[:, None] + slope * target[:, None] + rng.uniform(-1, 1, (6, n)) for _ in range(2)
        )
        values = positioning(target, up, down).values
        for name, found in drawn.items():
            found.append(values[name])
    stated = positioning(
        target, np.tile(true[:, None], n), np.tile(true[:, None], n),
        Contributors(device=0.5, environment=2.0),
    ).u  # fmt: skip
    for name, found in drawn.items():
        assert np.std(found) == pytest.approx(stated[name], rel=0.05), name


def test_runs_at_targets_from_readings_in_any_order():
    rng = np.random.default_rng(3)
    target, up, down = np.array([0.0, 0.1, 0.25]), rng.random((3, 2)), rng.random((3, 2))
    x = np.concatenate([np.repeat(target, 2), np.repeat(target, 2), [0.7]])
    way = np.repeat([1.0, -1.0, 1.0], [6, 6, 1])
    values = np.concatenate([up.ravel(), down.ravel(), [5.0]])
    mixed = rng.permutation(len(x))
    found = runs_at_targets(x[mixed], way[mixed], values[mixed], apart=1e-4)
    np.testing.assert_allclose(found[0], target)
    assert found[1] is not None and found[2] is not None
    np.testing.assert_allclose(np.sort(found[1]), np.sort(up))
    np.testing.assert_allclose(np.sort(found[2]), np.sort(down))
    target, one, none = runs_at_targets(x[:6], way[:6], values[:6], apart=1e-4)
    assert none is None and one is not None and one.shape == (3, 2)


@pytest.mark.parametrize("given", [(True, True), (True, False), (False, True)])
def test_systematic_quantities_are_weights_of_the_means(given):
    rng = np.random.default_rng(4)
    up, down = (rng.standard_normal(7) if one else None for one in given)
    values = np.concatenate([x for x in (up, down) if x is not None])
    found = positioning(np.arange(7.0), *(None if x is None else x[:, None] for x in (up, down)))
    weights = systematic(up, down)
    assert {name: w @ values for name, w in weights.items()} == pytest.approx(found.values)
