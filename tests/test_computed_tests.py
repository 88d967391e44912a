"""Tests of ISO 230-1, -2 and -6 computed from an identified machine."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from identified import exact_points, identified
from vcal.compensation.computed_tests import largest_of, line_tests
from vcal.compensation.machine import Rival
from vcal.effects.reversal import Backlash, Repeatability
from vcal.geometry.positioning import positioning
from vcal.report.loop.computed import computed_section

SIZE, SCATTER = 12.0, 1.5


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return identified(tmp_path_factory.mktemp("computed") / "study")


def with_effect(machine, effect, value, sigma):
    """The machine with one more amplitude, in its unit."""
    k = len(machine.theta)
    (p,) = effect.amplitudes
    wider = np.zeros((k + 1, k + 1))
    wider[:k, :k] = machine.covariance
    wider[k, k] = (sigma * p.si / p.step) ** 2
    return replace(
        machine,
        effects=(*machine.effects, effect),
        theta=np.append(machine.theta, value * p.si / p.step),
        shapes=(*machine.shapes, {}),
        covariance=wider,
        planned=wider,
        prior=np.append(machine.prior, 1.0),
    )


@pytest.fixture(scope="module")
def reversing(known):
    return with_effect(known[1], Backlash(port="EYY", unit="um", placement="Y"), SIZE, 0.7)


def corners(machine):
    """Start and end of every line, by its name: axes, then diagonals."""
    low, high = machine.volume.T
    middle, found = machine.volume.mean(1), {}
    for axes in ("X", "Y", "Z", "XY", "XZ", "YZ", "XYZ"):
        for signs in itertools.product((1, -1), repeat=len(axes) - 1):
            start, end = middle.copy(), middle.copy()
            name = ""
            for axis, sign in zip(axes, (*signs, 1), strict=True):
                i = "XYZ".index(axis)
                start[i], end[i] = (low[i], high[i]) if sign > 0 else (high[i], low[i])
                name += f"{'+' if sign > 0 else '-'}{axis}"
            found[name if axes[1:] else axes] = (start, end)
    return found


def test_deviations_are_those_of_exact_kinematics(known):
    case, machine, _ = known
    (effect,) = machine.effects
    tests = {test.name: test for test in line_tests(machine, 9)}
    ends = corners(machine)
    assert set(tests) == set(ends)
    assert sum(test.kind == "body diagonal" for test in tests.values()) == 4
    for name, (start, end) in ends.items():
        q = start + np.linspace(0.0, 1.0, 9)[:, None] * (end - start)
        nominal = machine.nominal(q)
        error = exact_points(case, effect, machine.theta, q) - nominal
        along = (nominal[-1] - nominal[0]) / np.linalg.norm(nominal[-1] - nominal[0])
        test = tests[name]
        np.testing.assert_allclose(test.up, 1e6 * error @ along, atol=0.05)
        assert test.length == pytest.approx(np.linalg.norm(end - start))
        assert set(test.quantities) == {"E"} and test.down is None
        assert test.quantities["E"].value == pytest.approx(np.ptp(test.up))


def test_uncertainty_is_the_spread_of_drawn_machines(known):
    """Of the difference between the two positions that determine E, by exact kinematics."""
    case, machine, root = known
    tests, ends = line_tests(machine, 5), corners(machine)
    q, along = [], []
    for test in tests:
        start, end = ends[test.name]
        share = np.array([test.up.argmax(), test.up.argmin()]) / 4.0
        q.append(start + share[:, None] * (end - start))
        chord = np.subtract(*machine.nominal(np.stack([end, start])))
        along.append(chord / np.linalg.norm(chord))
    at, random = np.concatenate(q), np.random.default_rng(8)
    nominal, drawn = machine.nominal(at), []
    for _ in range(300):
        theta = machine.theta + root @ random.normal(size=len(machine.theta))
        error = exact_points(case, machine.effects[0], theta, at) - nominal
        high, low = error.reshape(len(tests), 2, 3).transpose(1, 0, 2)
        drawn.append(1e6 * ((high - low) * along).sum(1))
    for test, mean, spread in zip(tests, np.mean(drawn, 0), np.std(drawn, 0), strict=True):
        found = test.quantities["E"]
        assert found.u == pytest.approx(spread, rel=0.2)
        assert abs(found.value - mean) < 4.0 * spread / np.sqrt(300) + 0.1
        assert 0.0 < found.information < 1.0


def test_a_squareness_makes_the_diagonals_differ(known):
    """E = |EC0Y| Lx Ly / D, with opposite signs on the two diagonals of a plane."""
    _, machine, _ = known
    (effect,) = machine.effects
    names = [p.name for p in effect.amplitudes]
    theta = np.zeros(len(names))
    angle = 50e-6
    theta[names.index("EC0Y")] = angle / effect.amplitudes[names.index("EC0Y")].step
    tests = {t.name: t for t in line_tests(replace(machine, theta=theta), 5)}
    x, y, z = np.ptp(machine.volume, axis=1)
    for name, across in (("+X+Y", z * 0), ("-X+Y", z * 0), ("+X+Y+Z", z), ("-X-Y+Z", z)):
        length = np.linalg.norm([x, y, across])
        test = tests[name]
        assert test.quantities["E"].value == pytest.approx(1e6 * angle * x * y / length, rel=1e-3)
    assert np.sign(tests["+X+Y"].up[-1] - tests["+X+Y"].up[0]) == -np.sign(
        tests["-X+Y"].up[-1] - tests["-X+Y"].up[0]
    )
    assert tests["+X+Z"].quantities["E"].value == pytest.approx(0.0, abs=1e-6)


def test_backlash_is_the_reversal_of_its_axis_and_of_diagonals(reversing):
    tests = line_tests(reversing)
    span = np.ptp(reversing.volume, axis=1)
    for test in tests:
        if "Y" not in test.name:
            assert test.down is None and "B" not in test.quantities
            continue
        moving = [span["XYZ".index(c)] if c in test.name else 0.0 for c in "XYZ"]
        share = span[1] / np.linalg.norm(moving)
        for name in ("B", "B_mean"):
            found = test.quantities[name]
            sign = -1.0 if name == "B_mean" and "-Y" in test.name else 1.0
            # A rotation changes the direction of Y by less than the 1e-4 th part.
            assert sign * abs(found.value) == pytest.approx(sign * SIZE * share, rel=1e-3)
            assert found.u == pytest.approx(0.7 * share, rel=1e-3)
    largest = largest_of(tests, "body diagonal", "B")
    assert largest is not None and largest[1].value == pytest.approx(
        SIZE * span[1] / np.linalg.norm(span), rel=1e-3
    )
    assert largest_of(tests, "axis", "no such") is None


def test_quantities_are_those_of_iso_230_2(reversing):
    """Against the evaluation of readings that scatter by exactly the declared repeatability."""
    scatter = Repeatability(port="EYY", unit="um", placement="Y", given=(("size", SCATTER, 0.0),))
    tests = {t.name: t for t in line_tests(replace(reversing, random=(scatter,)))}
    test = tests["Y"]
    ways = [np.stack([x - SCATTER, x, x + SCATTER], 1) for x in (test.up, test.down)]
    stated = positioning(test.target, *ways)
    assert set(test.quantities) == {"A", "R", "E", "E+", "E-", "M", "B", "B_mean"}
    for name, found in test.quantities.items():
        assert found.value == pytest.approx(stated.values[name], abs=0.002), name
    assert test.quantities["R"].u == pytest.approx(test.quantities["B"].u)
    assert test.standard == "ISO 230-2:2014" and test.length == pytest.approx(1.0)
    assert "A" not in tests["X"].quantities and "A" not in tests["+X+Y"].quantities


def test_rivals_add_the_variance_between_models(known):
    _, machine, _ = known
    other = replace(machine, theta=machine.theta + 0.3)
    plain, moved = (line_tests(one, 5) for one in (machine, other))
    compared = 0
    for averaged in (False, True):
        made = replace(machine, rivals=(Rival(machine, ((0.4, other),), averaged),))
        for one, alone, its in zip(line_tests(made, 5), plain, moved, strict=True):
            np.testing.assert_allclose(
                one.up, alone.up + 0.4 * averaged * (its.up - alone.up), atol=1e-9
            )
            ends = [(t.up.argmax(), t.up.argmin()) for t in (one, alone)]
            if ends[0] != ends[1]:
                continue  # another difference
            high, low = ends[0]
            change = (its.up - alone.up)[high] - (its.up - alone.up)[low]
            weight = 0.4 - 0.16 * averaged
            u = np.hypot(alone.quantities["E"].u, np.sqrt(weight) * abs(change))
            assert one.quantities["E"].u == pytest.approx(u, rel=1e-6)
            compared += 1
    assert compared > 13


def test_the_page_says_that_nothing_was_measured(reversing):
    (section,) = computed_section(line_tests(reversing))
    assert "not measured along these lines" in section.paragraphs[0]
    axes, diagonals = section.tables
    assert {row[1] for row in axes.rows} == {"X", "Y", "Z"}
    assert {"E_d", "B_d"} < {row[2] for row in diagonals.rows}
    assert computed_section([]) == []
