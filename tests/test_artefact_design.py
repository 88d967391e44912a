"""The artefact's publication: family, poses, trends, least squares, machines by Monte Carlo."""

import itertools

import numpy as np
import pytest

from vcal.design import expected_rms, pairs_precision, touches, volumetric_gram
from vcal.effects.geometric import ErrorMotion, GeometricErrors
from vcal.identification.batch import prepare_batch
from vcal.instruments.ball_shape import BallShape
from vcal.machine.error_functions import Legendre
from vcal.machine.plan import Plan
from vcal.model.forward import Model
from vcal.reproduce.artefact_design.expected import bayes_um, plain_least_squares, posterior, task
from vcal.reproduce.artefact_design.machines import calibrate, measured_by
from vcal.reproduce.artefact_design.searches import FREEDOMS, optimise
from vcal.reproduce.artefact_design.setting import (
    BALLS,
    KNOWN,
    NOMINAL,
    OFFSETS,
    POSES,
    SQUARENESS_URAD,
    TABLE_ONE,
    TOOL,
    TRAVEL,
    ball_line,
    grid_points,
    outer_faces,
    placed,
)

_WAVES = {"X": (0.5, 3.0), "Y": (0.5, 1.0), "Z": (0.5, 1.0)}


@pytest.fixture(scope="module")
def given():
    return task()


@pytest.fixture(scope="module")
def nominal():
    return placed(outer_faces(), ball_line(*NOMINAL))


def test_the_family_by_hand(given):
    """Variance of the displacement from Table 1 and the formulas of the chain, in plain numpy."""
    counts = (60, 20, 20)
    at = np.stack(
        np.meshgrid(*(np.linspace(*TRAVEL[c], n) for c, n in zip("XYZ", counts, strict=True)),
                    indexing="ij"), -1).reshape(-1, 3)  # fmt: skip
    x, y, z = at.T
    tx, ty, tz = TOOL
    levers = {  # of every rotation of every axis: displacement per radian
        "AX": (0 * x, -(z + tz), y + ty), "BX": (z + tz, 0 * x, -tx + 0 * x),
        "CX": (-(y + ty), tx + 0 * x, 0 * x),
        "AY": (0 * x, -(z + tz), ty + 0 * x), "BY": (z + tz, 0 * x, -tx + 0 * x),
        "CY": (-ty + 0 * x, tx + 0 * x, 0 * x),
        "AZ": (0 * x, -tz + 0 * x, ty + 0 * x), "BZ": (tz + 0 * x, 0 * x, -tx + 0 * x),
        "CZ": (-ty + 0 * x, tx + 0 * x, 0 * x),
    }  # fmt: skip
    total = np.zeros(len(at))
    for name, amplitudes in TABLE_ONE.items():
        axis = "XYZ".index(name[2])
        low, high = TRAVEL[name[2]]
        u = (2 * at[:, axis] - low - high) / (high - low)
        a0, a1, b1, c1, b2, c2 = amplitudes
        n1, n2 = _WAVES[name[2]]
        variance = a0**2 + (a1 * u) ** 2
        for n, b, c in ((n1, b1, c1), (n2, b2, c2)):
            variance = variance + (b * np.sin(n * np.pi * u)) ** 2
            variance = variance + (c * np.cos(n * np.pi * u)) ** 2
        if name[1] in "XYZ":
            size = 1.0
        else:
            size = sum(v**2 for v in levers[name[1:]])
        total += variance / 3.0 * size
    total += SQUARENESS_URAD**2 / 3.0 * (z**2 + z**2 + y**2)
    raw = np.sqrt(np.trace(given.gram.raw)) * 1e6
    assert raw == pytest.approx(np.sqrt(total.mean()), rel=1e-9)
    assert np.sqrt(np.trace(given.gram.aligned)) * 1e6 == pytest.approx(33.8, abs=0.05)
    assert len(given.model.entries) == 90


def test_poses(given):
    for make in POSES.values():
        assert len(make()) == 12
        for count, a, b in (NOMINAL, (17, 0.06, 0.06)):
            poses = placed(make(), ball_line(count, a, b))
            at = np.asarray(poses.position(given.model.chain))
            for i, c in enumerate("XYZ"):
                low, high = TRAVEL[c]
                assert low - 1e-12 <= at[..., i].min() and at[..., i].max() <= high + 1e-12
            R = np.asarray(poses.rotation)
            np.testing.assert_allclose(
                R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12
            )
            assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.campaign
def test_the_first_set_is_the_strongest(given):
    for known in KNOWN:
        found = [
            bayes_um(given, placed(make(), ball_line(*NOMINAL)), known)[0]
            for make in POSES.values()
        ]
        assert found[0] == min(found)


@pytest.mark.thorough
@pytest.mark.parametrize("known", KNOWN)
def test_trends(given, known):
    def rms(count, a, b):
        return bayes_um(given, placed(outer_faces(), ball_line(count, a, b)), known)[0]

    n, a, b = NOMINAL
    few, some, many = (rms(k, a, b) for k in BALLS[::3])
    assert few > some > many
    # Diminishing: six balls more gain less than half of what the six before did.
    assert some - many < 0.5 * (few - some)
    assert (np.diff([rms(n, v, b) for v in OFFSETS]) < 0.0).all()
    assert (np.diff([rms(n, a, v) for v in OFFSETS]) < 0.0).all()


@pytest.mark.thorough
def test_better_than_plain_least_squares(given, nominal):
    for known, limit in (("S", 0.15), ("P", 0.35), ("B", 0.15)):
        plain = plain_least_squares(given, nominal, known)
        assert bayes_um(given, nominal, known)[0] <= limit * min(p.aligned_um for p in plain)
        assert all(p.rank < p.columns for p in plain)
        # Higher orders take the machine's waves for something else.
        assert plain[1].aligned_um > plain[0].aligned_um


@pytest.mark.thorough
def test_plain_least_squares_by_drawing(given, nominal):
    """Machines, distances and noise drawn by numpy; lstsq of order one."""
    (found,) = plain_least_squares(given, nominal, "S", (1,))
    own = given.model.effects[0]
    lines = GeometricErrors(
        motions=tuple(
            ErrorMotion(m.name, m.axis, Legendre(TRAVEL[m.axis], (0, 1), 1e-5)) for m in own.motions
        ),
        locations=own.locations,
    )
    both = Model(given.model.chain, given.model.instrument, (own, lines))
    seen = np.asarray(touches(both, nominal).machine)
    centres = np.asarray(nominal.centres)
    rows, pairs = [], list(itertools.combinations(range(11), 2))
    for k in range(12):
        for i, j in pairs:
            u = centres[k, i] - centres[k, j]
            u /= np.linalg.norm(u)
            rows.append(u @ (seen[k, 3 * i : 3 * i + 3] - seen[k, 3 * j : 3 * j + 3]))
    D = np.array(rows)
    rng = np.random.default_rng(0)
    theta = np.sqrt(3.0) * rng.uniform(-1.0, 1.0, (90, 400))
    noise = np.tile(2e-6 * rng.standard_normal((55, 400)), (12, 1))
    fitted = np.linalg.pinv(D[:, 90:], rcond=1e-9) @ (D[:, :90] @ theta + noise)
    e = np.concatenate([theta, -fitted])
    gram = volumetric_gram(both, grid_points(given.model.chain, (30, 10, 10))).aligned
    by_drawing = 1e6 * np.sqrt(np.einsum("an,ab,bn->n", e, gram, e).mean())
    assert found.aligned_um == pytest.approx(by_drawing, rel=0.06)
    assert (found.columns, found.rank) == (39, 11)


@pytest.mark.campaign
def test_machines_confirm_the_theory(given, nominal):
    """Exact kinematics, uniform priors, poses and artefact identified with the machine."""
    done = calibrate(given, nominal, "S", draws=1000, seed=3)
    assert done.campaign.failed == 0
    # 1000 machines, each the root of a mean over few effective errors: 3 % is two deviations.
    assert done.rms() == pytest.approx(bayes_um(given, nominal, "S")[0], rel=0.04)
    assert done.rms("before") == pytest.approx(33.8, rel=0.05)
    assert done.rms("after", "raw") == pytest.approx(bayes_um(given, nominal, "S")[1], rel=0.05)


def test_shapes_have_the_covariance_of_their_precision():
    balls = ball_line(5, 0.03, 0.04)
    K = np.asarray(pairs_precision(balls, 2e-6))
    shape = BallShape.of(balls, K, 1.0)
    T = shape.columns.reshape(15, -1)
    assert T.shape[1] == 9  # three per ball, less six
    np.testing.assert_allclose(T @ T.T, np.linalg.pinv(K, rcond=1e-9), rtol=1e-6, atol=1e-15)
    # On a straight line distances know nothing across it: as loose as is said.
    straight = BallShape.of(
        ball_line(5, 0.0, 0.0), pairs_precision(ball_line(5, 0.0, 0.0), 2e-6), 1e-3
    )
    sizes = np.linalg.norm(straight.columns.reshape(15, -1), axis=0)
    assert (sizes > 0.99e-3).sum() == 6 and straight.columns.shape[2] == 10
    plan = Plan(
        ("X",),
        np.zeros((4, 1)),
        {},
        {"ball": np.array([0, 1, 0, 1]), "pose": np.array([0, 0, 1, 1])},
    )
    fresh = BallShape.of(balls, K, 1.0, (0, 1))
    assert len(fresh.amplitudes) == 18 and len(shape.amplitudes) == 9
    response = fresh.response(plan, {})
    np.testing.assert_allclose(response["ball.X", "1.3"], [0, 0, *shape.columns[[0, 1], 0, 3]])


@pytest.mark.campaign
def test_the_engine_has_the_same_posterior(given, nominal):
    """Poses and shape as parameters of one identification."""
    model, plan = measured_by(given, nominal, "S")
    batch = prepare_batch(model, plan)
    C = np.asarray(batch.inverse)[:90, :90]
    gram = given.gram.aligned
    found = 1e6 * float(expected_rms(gram, C))
    assert found == pytest.approx(bayes_um(given, nominal, "S")[0], rel=1e-3)
    theory = np.asarray(posterior(given.model, nominal, "S"))
    np.testing.assert_allclose(np.sqrt(np.diag(C)), np.sqrt(np.diag(theory)), rtol=2e-3)


@pytest.mark.campaign
def test_a_better_design_by_gradient(given, nominal):
    """Judged on machines that the search never saw, with exact kinematics."""
    found = optimise(given, nominal, "S", FREEDOMS["poses, balls within 60 mm"], starts=2)
    assert found.gain > 0.4 and len(found.found) == 2
    balls = np.asarray(found.poses.balls)
    assert np.ptp(balls[:, 0]) == pytest.approx(1.5) and np.diff(balls[:, 0]).min() > 0.05 - 1e-9
    assert np.abs(balls[:, 1:]).max() <= 0.06
    done = calibrate(given, found.poses, "S", draws=1000, seed=77)
    assert done.campaign.failed == 0
    assert done.rms() == pytest.approx(found.rms_um, rel=0.04)
