"""The geometry as tests of it would find it, against paths of the oracle and lines of numpy."""

import dataclasses
import math

import numpy as np
import pytest

from known import Known
from oracle import compose, error_motions
from vcal import identify
from vcal.geometry.acceptance import geometric_tests
from vcal.identification.model_averaging import Alternatives
from vcal.uncertainty import LineErrors
from vcal.uncertainty.campaign import virtual_pair
from vcal.uncertainty.linear import linearised

SQUARE = {
    "EC(0X)Y": ("X", "Y", (0, 1)),
    "EB(0X)Z": ("X", "Z", (2, 0)),
    "EA(0Y)Z": ("Y", "Z", (1, 2)),
}
"""Between which axes, and the plane, from its first to its second direction, that it turns in."""


@pytest.fixture(scope="module", params=["laser_tracker", "ball_array"])
def known(request, tmp_path_factory):
    """A machine, and a fit of its measurement that has found the truth."""
    it = Known(request.param, tmp_path_factory.mktemp("geometry"))
    fit = identify(it.model, it.measurement, room=it.room)
    return it, dataclasses.replace(fit, theta=it.theta)


def paths(machine) -> np.ndarray:
    """Errors (axis, node, 3), um, of the tool point along each axis, by the oracle."""
    low, high = machine.travel.T
    q = np.tile(0.5 * (low + high), (3, 41, 1))
    for k in range(3):
        q[k, :, k] = np.linspace(low[k], high[k], 41)
    q = q.reshape(-1, 3)
    nominal = dataclasses.replace(
        machine, motion=np.zeros_like(machine.motion), squareness=np.zeros(3), smooth=None
    )
    found = [compose(m, q, *error_motions(m, q)) for m in (machine, nominal)]
    return 1e6 * (found[0] - found[1]).reshape(3, 41, 3)


def expected(machine) -> dict[tuple[str, str], float]:
    """Every deviation by its definition."""
    found, slopes, error = {}, np.zeros((3, 3)), paths(machine)
    for k, axis in enumerate("XYZ"):
        x = np.linspace(machine.travel[k, 0], machine.travel[k, 1], 41)
        for c, component in enumerate("XYZ"):
            slopes[k, c], start = np.polyfit(x, error[k, :, c], 1)
            name = f"E{component}{axis}"
            if c == k:
                found[name, "positioning, range"] = np.ptp(error[k, :, c])
                found[name, "positioning, slope"] = slopes[k, c]
            else:
                left = error[k, :, c] - slopes[k, c] * x - start
                found[name, "straightness"] = np.ptp(left)
        q = np.zeros((41, 3))
        q[:, k] = x
        turned = 1e6 * error_motions(machine, q)[1][:, k]
        for c, component in enumerate("ABC"):
            found[f"E{component}{axis}", "angular error, range"] = np.ptp(turned[:, c])
    # How far the second line is turned from its nominal direction more than the first is.
    lines = 1e6 * np.eye(3) + slopes
    for name, (first, second, plane) in SQUARE.items():
        a, b = (
            math.atan2(*lines[k][[*plane]][::-1]) - math.atan2(*np.eye(3)[k][[*plane]][::-1])
            for k in ("XYZ".index(first), "XYZ".index(second))
        )
        found[name, f"squareness of {second} to {first}"] = 1e6 * (b - a)
    return found


def test_deviations_are_those_of_the_oracles_paths(known):
    it, fit = known
    tests = geometric_tests(fit)
    values = expected(it.case.machine)
    assert {(t.name, t.what) for t in tests} == set(values)
    for t in tests:
        assert t.value == pytest.approx(values[t.name, t.what], rel=5e-4, abs=2e-3), t
        assert t.unit == {"slope": "um/m"}.get(t.what[-5:], "urad" if t.name[1] in "ABC" else "um")
        assert t.u > 0.0 and 0.0 <= t.information <= 1.0


@pytest.mark.campaign
def test_uncertainties_are_those_of_differences(known):
    """u^2 = g'C g with g the change of the deviation by every parameter."""
    _, fit = known
    tests = geometric_tests(fit)
    steps = 1e-3 * np.eye(len(fit.theta))
    changed = np.array(
        [
            [t.value for t in geometric_tests(dataclasses.replace(fit, theta=fit.theta + step))]
            for step in steps
        ]
    )
    gradient = (changed - [t.value for t in tests]) / 1e-3
    u = np.sqrt(np.einsum("kt,kl,lt->t", gradient, fit.covariance, gradient))
    np.testing.assert_allclose([t.u for t in tests], u, rtol=0.02)


def test_doubts_are_part_of_the_uncertainty(known):
    _, fit = known
    by = np.random.default_rng(4).standard_normal(len(fit.theta))
    other = dataclasses.replace(fit, theta=fit.theta + 0.1 * by)
    alone, doubted = (
        geometric_tests(fit),
        geometric_tests(fit, alternatives=[Alternatives(fit, ((0.3, other),))]),
    )
    of_other = {(t.name, t.what): t.value for t in geometric_tests(other)}
    for one, more in zip(alone, doubted, strict=True):
        assert more.value == one.value
        if one.what.startswith("squareness") or one.what.endswith("slope"):
            change = of_other[one.name, one.what] - one.value
            assert more.u**2 - one.u**2 == pytest.approx(0.3 * change**2, rel=1e-6)
        assert more.u >= one.u


@pytest.mark.thorough
def test_a_plan_foretells_the_uncertainty_of_squareness(known):
    """The GUM before measuring against the posterior of a fit of readings of the same plan."""
    it, fit = known
    pair = virtual_pair(it.model, it.model, it.plan)
    budget = linearised(pair, [LineErrors(41).measure(pair)]).budget
    told = {t.name: t for t in geometric_tests(fit) if t.name in SQUARE or "slope" in t.what}
    assert len(budget.labels) == len(told) == 6
    for label, u in zip(budget.labels, budget.u, strict=True):
        assert u == pytest.approx(told[label.split()[0].removesuffix(" slope")].u, rel=0.01), label
