"""Rigid alignment of check points: exact for frames that differ by any rotation."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from vcal.identification.identify import identify
from vcal.loop.weighing.cross_validation import check_rms
from vcal.model.measurement import CheckPoints
from vcal.numerics.spatial import after_alignment, after_small_alignment, align_rigid
from vcal.study.study import load_study

TURN = Rotation.from_rotvec(math.radians(91.0) * np.array([1.0, 2.0, -2.0]) / 3.0).as_matrix()


def cloud(count=30, noise=1e-4, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 3))
    return points, points + noise * rng.standard_normal((count, 3))


def test_against_a_minimisation():
    found, target = cloud()
    target = target @ TURN.T + [3.0, -2.0, 1.0]
    left, r = after_alignment(found, target)

    def cost(x):
        return 1e8 * np.sum(
            (target - found @ Rotation.from_rotvec(x[:3]).as_matrix().T - x[3:]) ** 2
        )

    start = np.r_[Rotation.from_matrix(TURN).as_rotvec(), 3.0, -2.0, 1.0]
    best = minimize(cost, start, tol=1e-12)
    assert 1e8 * (left**2).sum() == pytest.approx(best.fun, rel=1e-6)
    np.testing.assert_allclose(r, TURN, atol=1e-3)
    # To first order, the frames would have to agree.
    assert np.abs(align_rigid(target, target - found)).max() > 0.1


def test_it_does_not_mirror():
    """Points near a plane, as seen in a mirror: a proper rotation only."""
    found, _ = cloud(40)
    found[:, 2] *= 1e-3
    left, r = after_alignment(found, found * [1.0, 1.0, -1.0])
    assert np.linalg.det(r) == pytest.approx(1.0)
    assert np.sqrt((left**2).sum(1).mean()) > 1e-4


def test_the_first_order_and_the_exact_alignment_differ_to_second_order():
    found, target = cloud(noise=0.0)
    for angle in (1e-4, 1e-3):
        turned = target @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().T
        assert np.abs(after_alignment(found, turned)[0]).max() < 1e-14
        first = np.abs(align_rigid(found, turned - found)).max()
        assert 0.1 * angle**2 < first < 1.0 * angle**2


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.08])
@pytest.mark.thorough
def test_the_differentiable_form(angle):
    found, target = cloud(12)
    target = target @ Rotation.from_rotvec([angle, -angle, 0.0]).as_matrix().T + 0.01
    expected, r = after_alignment(found, target)
    got = after_small_alignment(jnp.asarray(found), jnp.asarray(target))
    np.testing.assert_allclose(got, expected, atol=1e-13)
    # Its derivative, against differences of the closed form.
    moved = 1e-3 * np.random.default_rng(1).standard_normal(found.shape)
    slope = jax.jvp(lambda f: after_small_alignment(f, target), (found,), (moved,))[1]
    above, below = (after_alignment(found + s * moved, target)[0] for s in (1e-4, -1e-4))
    np.testing.assert_allclose(slope, (above - below) / 2e-4, atol=1e-9)
    np.testing.assert_allclose(slope, -align_rigid(found @ r.T, moved @ r.T), atol=2e-6)


def test_points_on_a_line():
    points = np.linspace(0.0, 1.0, 9)[:, None] * [1.0, 2.0, 0.5]
    moved = points @ Rotation.from_rotvec([0.0, 0.0, 1e-3]).as_matrix().T
    assert np.abs(after_small_alignment(jnp.asarray(points), jnp.asarray(moved))).max() < 1e-12


def test_check_points_in_any_frame(small_tracker_study):
    """The error after alignment, and its uncertainty, do not depend on the frame."""
    study = load_study(small_tracker_study)
    fit = identify(study.model, study.measurement)
    plan = study.plan
    rng = np.random.default_rng(2)
    points = study.chain.tool_point(np.asarray(plan.position))
    points = points + 2e-6 * rng.standard_normal(points.shape)
    here = check_rms(fit, CheckPoints(plan, points))
    there = check_rms(fit, CheckPoints(plan, points @ TURN.T + [0.3, 0.1, -2.0]))
    assert there[0].value == pytest.approx(here[0].value, rel=1e-6)
    assert there[0].u == pytest.approx(here[0].u, rel=1e-6)
    assert there[1].value > 1e3 * here[1].value
    # The part of the uncertainty from the parameters, by differences of the aligned rms.
    from vcal.geometry.compensated import compensated_points

    found, jacobian = compensated_points(fit, plan)
    rms = lambda p: math.sqrt((after_alignment(p, points)[0] ** 2).sum(1).mean())  # noqa: E731
    step = 1e-3
    gradient = np.array(
        [
            (rms(found + step * column) - rms(found - step * column)) / (2 * step)
            for column in np.moveaxis(jacobian, 2, 0)
        ]
    )
    passed = 1e6 * math.sqrt(gradient @ fit.covariance @ gradient)
    scatter = dataclasses.replace(fit)  # the same fit
    value, u = check_rms(scatter, CheckPoints(plan, points))[0].value, here[0].u
    squares = (after_alignment(found, points)[0] ** 2).sum(1)
    own = squares.std() / math.sqrt(len(squares)) / (2.0 * 1e-6 * value) * 1e6
    assert u == pytest.approx(math.hypot(own, passed), rel=1e-3)
