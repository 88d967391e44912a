"""How the frame of a tracker moves, told by reflectors on the base."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from known import Known
from vcal import identify, load_study
from vcal.instruments.base_drift import _RATIOS, BaseDrift, _costs
from vcal.model.declared_noise import declared_covariances
from vcal.numerics.spatial import best_rigid

PLACES = np.array([[2.0, 0.5, -0.4], [2.9, 0.8, -0.6], [2.5, -0.2, -0.5], [2.2, 0.3, 0.6]])
"""Reflectors on the base, m."""
TOOL = np.array([2.6, 0.3, 0.1])
"""Middle of where the tool is, m."""
UM = 1e-6


def seen(points, motion):
    """As a tracker sees them whose frame has turned and moved."""
    turned = Rotation.from_rotvec(motion[:, 3:]).as_matrix()
    return np.einsum("nji,nkj->nki", turned, points - motion[:, None, :3])


def walk(rng, n, step):
    return step * np.cumsum(rng.standard_normal((n, 6)) * np.repeat([1.0, 0.5], 3), axis=0)


def off(found, true):
    """Root mean square of the distances, up to one rigid motion of all: the pose of the base."""
    r, t = best_rigid(found.reshape(-1, 3), true.reshape(-1, 3))
    return np.sqrt(((found.reshape(-1, 3) @ r.T + t - true.reshape(-1, 3)) ** 2).sum(1).mean())


def one_by_one(tool, base):
    """Every pose by its own base alone."""
    back = [best_rigid(one, base.mean(0)) for one in base]
    return np.stack([p @ r.T + t for p, (r, t) in zip(tool, back, strict=True)])


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize(
    ("step", "jitter", "better"),
    [
        (0.0, 0.0, 5.0),
        (3 * UM, 0.0, 0.98),
        (100 * UM, 0.0, 0.98),
        (0.0, 50 * UM, 0.98),
        (3 * UM, 50 * UM, 0.98),
    ],
)
def test_what_is_left_of_a_motion(count, step, jitter, better):
    """Less than pose by pose where the frame stands; no more where it does not. As much as is told,
    and no more alike from pose to pose than chance.
    """
    rng = np.random.default_rng(7)
    n, sigma = 200, 10 * UM
    motion = walk(rng, n, step) + jitter * rng.standard_normal((n, 6))
    true = TOOL + rng.uniform(-0.3, 0.3, (n, 2, 3))
    base = seen(np.tile(PLACES[:count], (n, 1, 1)), motion)
    base += sigma * rng.standard_normal(base.shape)
    tool = seen(true, motion)
    drift = BaseDrift.of(base, np.arange(float(n)))
    left = off(drift.undone(tool), true)
    assert left < off(one_by_one(tool, base), true) / better
    levers = true - drift.centre
    about = np.cross(drift.axes[:, None, None], levers)
    expected = np.sqrt(
        (drift.u[:3] ** 2).sum()
        + (drift.u[3:, None] ** 2 * (about**2).sum(3).mean((1, 2))[:, None]).sum()
    )
    assert left == pytest.approx(expected, rel=0.3) or left < expected < 3 * UM
    errors = (drift.undone(tool) - true).mean(1)
    r, t = best_rigid(drift.undone(tool).reshape(-1, 3), true.reshape(-1, 3))
    errors = (drift.undone(tool) @ r.T + t - true).mean(1)
    alike = (errors[1:] * errors[:-1]).sum() / (errors**2).sum()
    assert abs(alike) < 0.25 or left < 3 * UM


def test_the_likelihood_of_a_walk_is_that_of_its_differences():
    """Against the dense covariance of all of them."""
    rng = np.random.default_rng(2)
    n, s, w = 40, 2.0, 0.7
    order = np.sort(rng.choice(100, n, replace=False)).astype(float)
    steps = np.diff(order)
    y = np.cumsum(np.r_[0.0, w * np.sqrt(steps) * rng.standard_normal(n - 1)])
    y += s * rng.standard_normal(n)
    costs, variances = _costs(np.tile(y[:, None], 6), steps, np.full(6, 1e-12))
    for ratio, cost, variance in zip(_RATIOS, costs[:, 0], variances[:, 0], strict=True):
        covariance = np.eye(n) + ratio * np.minimum.outer(order, order)
        d = np.diff(np.eye(n), axis=0)
        v, z = d @ covariance @ d.T, d @ y
        expected = z @ np.linalg.solve(v, z) / (n - 1)
        assert variance == pytest.approx(expected, rel=1e-8)
        # The differences of n levels with the mean as their first: a determinant of n.
        dense = (n - 1) * np.log(expected) + (n - 1) + np.linalg.slogdet(v)[1]
        assert cost - dense == pytest.approx(costs[0, 0] - (n - 1) * (np.log(variances[0, 0]) + 1.0)
                                             - np.log(n), abs=1e-6)  # fmt: skip
    # Never below the noise.
    assert (_costs(np.tile(y[:, None], 6), steps, np.full(6, 99.0))[1] == 99.0).any()


def test_a_frame_that_stands_is_seldom_taken_for_one_that_drifts():
    rng = np.random.default_rng(6)
    drifting = 0
    for _ in range(60):
        y = rng.standard_normal((80, 6))
        costs, _ = _costs(y, np.ones(79), np.ones(6))
        drifting += int((costs[0] - costs.min(0) > 6.0).sum())
    assert drifting <= 9  # of 360, 2.6 expected


def test_a_base_that_is_knocked_for_one_pose_moves_nothing():
    rng = np.random.default_rng(3)
    n = 60
    true = TOOL + rng.uniform(-0.3, 0.3, (n, 2, 3))
    base = np.tile(PLACES, (n, 1, 1)) + 5 * UM * rng.standard_normal((n, 4, 3))
    base[20, 1] += [0.0, 4e-4, -3e-4]
    drift = BaseDrift.of(base, np.arange(float(n)))
    assert np.abs(drift.undone(true)[20] - true[20]).max() < 10 * UM
    assert off(drift.undone(true), true) < 3 * UM


def test_a_tracker_that_was_set_up_anew():
    rng = np.random.default_rng(4)
    n = 80
    true = TOOL + rng.uniform(-0.3, 0.3, (n, 2, 3))
    motion = np.zeros((n, 6))
    motion[30:] = [0.4, -0.8, 0.1, 0.02, -0.03, 0.7]
    base = seen(np.tile(PLACES, (n, 1, 1)), motion) + 5 * UM * rng.standard_normal((n, 4, 3))
    drift = BaseDrift.of(base, np.arange(float(n)))
    assert off(drift.undone(seen(true, motion)), true) < 10 * UM


def test_a_line_tells_no_turn_about_itself():
    base = np.tile(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2.0001]]), (5, 1, 1))
    with pytest.raises(ValueError, match="on one line"):
        BaseDrift.of(base, np.arange(5.0))


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return Known("reflectors", tmp_path_factory.mktemp("arm"), noise_factor=1.0)


@pytest.mark.thorough
def test_what_is_left_open_is_noise_of_the_whole_pose(arm):
    """The covariance that is declared for it, against draws of motions of the points."""
    instrument, plan = arm.instrument, arm.plan
    parts = [v for k, v in declared_covariances(arm.model, arm.measurement) if "base" in k]
    assert len(parts) == (instrument.base_u > 0.0).sum() > 0
    rng = np.random.default_rng(5)
    row, draws = 3, 200_000
    points = arm.readings(theta=0 * arm.theta).reshape(plan.rows, -1, 3)[row]
    twist = rng.standard_normal((draws, 6)) * instrument.base_u
    moves, turns = twist[:, :3] @ instrument.base_axes, twist[:, 3:] @ instrument.base_axes
    moved = moves[:, None] + np.cross(turns[:, None], points - instrument.base_centre)
    expected = np.cov(moved.reshape(draws, -1).T)
    found = np.sum(parts, axis=0)[row]
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.02
    )


@pytest.mark.campaign
def test_the_declared_noise_is_that_of_the_readings(arm):
    """Three reflectors on the base as noisy as those on the tool; the tracker stands still."""
    fit = identify(arm.model, arm.measurement, room=arm.room)
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / fit.dof))


@pytest.mark.campaign
def test_without_a_base_nothing_is_declared(small_arm_study, tmp_path):
    setup = small_arm_study / "setup.toml"
    names = [e.key for e in load_study(small_arm_study).model.random]
    assert names == ["base_reflectors"]
    setup.write_text(setup.read_text().replace("base_reflectors = 3", "base_reflectors = 2"))
    assert not load_study(small_arm_study).model.random
