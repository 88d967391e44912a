"""Artefacts designed by gradient: the engine's derivatives against its own identification, scipy's
and finite differences; the search, and what it must keep.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turn

from vcal import Model
from vcal.design import (
    ArrayPoses,
    ArraySpace,
    array_curvature,
    balls_precision,
    expected_rms,
    inverse,
    pairs_precision,
    search,
    spread,
    touches,
    volumetric_gram,
)
from vcal.design.spaces.ball_information import without_poses
from vcal.effects.geometric import ErrorMotion, GeometricErrors, LocationError
from vcal.identification.batch import prepare_batch
from vcal.instruments.ball_array import BallArray
from vcal.machine.chain import chain_from_string
from vcal.machine.error_functions import Fourier, Legendre
from vcal.machine.plan import Plan
from vcal.model.forward import port_values, tool_points
from vcal.numerics.spatial import align_rigid

TRAVEL = {"X": (0.0, 1.2), "Y": (0.0, 0.8), "Z": (0.0, 0.6)}
TOOL = (0.01, -0.02, 0.15)
PROBE = 5e-7
N, M = 5, 4


def machine():
    chain = chain_from_string("w b X Y Z t", TRAVEL, TOOL)
    motions = [
        ErrorMotion(f"E{c}{a}", a, Legendre(TRAVEL[a], (1, 2, 3), 1e-5))
        for a in "XYZ"
        for c in "XYZABC"
        if c != "B"
    ]
    motions.append(ErrorMotion("EBX", "X", Fourier(TRAVEL["X"], 1e-5, 2e-5, [(0.5, 1e-5, 2e-5)])))
    squareness = LocationError.of(chain, "EC0Y", 3e-5)
    errors = GeometricErrors(motions=tuple(motions), locations=(squareness,))
    return chain, errors


def design(seed=0, tool=None):
    rng = np.random.default_rng(seed)
    x = np.linspace(-0.25, 0.25, N)
    balls = np.column_stack([x, 0.03 * (-1.0) ** np.arange(N), 0.04 * np.cos(np.arange(N))])
    rotation = Turn.random(M, random_state=seed).as_matrix()
    origin = rng.uniform([0.4, 0.35, 0.45], [0.8, 0.45, 0.5], (M, 3))
    return ArrayPoses(jnp.asarray(balls), jnp.asarray(rotation), jnp.asarray(origin), tool)


def instrument_of(poses, sigma):
    return BallArray(
        centres=np.asarray(poses.balls),
        numbers=np.arange(N),
        probe_sigma=PROBE,
        position_sigma=sigma,
        supports=(0.2, 0.8),
        pose_numbers=np.arange(M),
        pose_rotation=np.asarray(poses.rotation),
        pose_origin=np.asarray(poses.origin),
    )


@pytest.mark.campaign
def test_as_the_engine_identifies():
    """Against the batched identification of a ball array, all unknowns in one matrix."""
    chain, errors = machine()
    poses = design()
    u = 1.4e-6
    instrument = instrument_of(poses, u)
    position = np.asarray(poses.position(chain)).reshape(-1, 3)
    index = {"pose": np.repeat(np.arange(M), N), "ball": np.tile(np.arange(N), M)}
    plan = Plan(chain.axes, position, {}, index)
    whole = Model(chain, instrument, (errors, *instrument.effects(plan)))
    batch = prepare_batch(whole, plan)
    k = len(errors.amplitudes)
    own = Model(chain, instrument, (errors,))
    H = array_curvature(touches(own, poses), own, PROBE, balls_precision(N, u))
    np.testing.assert_allclose(inverse(H), np.asarray(batch.inverse)[:k, :k], rtol=2e-4, atol=1e-7)


def by_readings(seen, model, covariance_of_balls, fresh):
    """H from the covariance of all readings: no elimination, poses with a wide prior."""
    J, A, B = (np.asarray(part) for part in seen)
    m, n, k = J.shape
    V = np.kron(np.eye(m), PROBE**2 * np.eye(n))
    wide = np.diag([1e-2] * 3 + [1e-2] * 3) ** 2
    for i, j in itertools.product(range(m), repeat=2):
        block = np.zeros((n, n))
        if i == j:
            block += A[i] @ wide @ A[i].T
        if i == j or not fresh:
            block += B[i] @ covariance_of_balls @ B[j].T
        V[i * n : (i + 1) * n, j * n : (j + 1) * n] += block
    J = J.reshape(m * n, k)
    return np.eye(k) + J.T @ np.linalg.solve(V, J)


@pytest.mark.thorough
@pytest.mark.parametrize("fresh", [False, True])
def test_elimination_against_the_readings_covariance(fresh):
    chain, errors = machine()
    poses = design(1)
    model = Model(chain, instrument_of(poses, 0.0), (errors,))
    seen = touches(model, poses)
    K = np.asarray(pairs_precision(poses.balls, 2e-6)) + np.eye(3 * N) / 1e-3**2
    H = array_curvature(seen, model, PROBE, pairs_precision(poses.balls, 2e-6), fresh=fresh)
    expected = by_readings(seen, model, np.linalg.inv(K), fresh)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        H / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-4
    )


@pytest.mark.thorough
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, 45.0), (30.0, -20.0, 70.0)])
@pytest.mark.parametrize("touched", ["a line", "two of each"])
def test_balls_on_a_line_leave_the_turn_about_it_open(turn, touched):
    """The same in any frame of the certificate; against a projection by singular values."""
    chain, errors = machine()
    poses = design(1)
    frame = Turn.from_euler("xyz", turn, degrees=True).as_matrix()
    balls = np.asarray(poses.balls) * ([1.0, 0.0, 0.0] if touched == "a line" else 1.0)
    turned = ArrayPoses(jnp.asarray(balls @ frame.T), poses.rotation @ frame.T, poses.origin)
    model = Model(chain, instrument_of(turned, 0.0), (errors,))
    seen = touches(model, turned)
    if touched != "a line":
        here = np.zeros((M, 3 * N))
        for pose in range(M):
            for ball in {pose % N, (pose + 2) % N}:
                here[pose, 3 * ball : 3 * ball + 3] = 1.0
        seen = type(seen)(*(part * here[:, :, None] for part in seen))
    J, A, B = (np.asarray(part) for part in seen)
    found = np.asarray(without_poses(seen))
    for pose in range(M):
        u, s, _ = np.linalg.svd(A[pose] / np.sqrt((A[pose] ** 2).sum(0)).max())
        u = u[:, :6][:, s > 1e-9]
        assert u.shape[1] == 5
        both = np.concatenate([J[pose], B[pose]], -1)
        size = np.abs(both).max()
        np.testing.assert_allclose(found[pose], both - u @ (u.T @ both), atol=1e-7 * size)

    def summed(balls):
        return without_poses(
            touches(model, ArrayPoses(balls, turned.rotation, turned.origin))
        ).sum()

    assert np.isfinite(jax.grad(summed)(turned.balls)).all()


@pytest.mark.thorough
def test_distances_say_the_same_as_their_precision():
    """Distances of all pairs, measured and calibrated, in place of coordinates and poses."""
    chain, errors = machine()
    poses = design(2)
    model = Model(chain, instrument_of(poses, 0.0), (errors,))
    seen = touches(model, poses)
    balls = np.asarray(poses.balls)
    rows = []
    for i, j in itertools.combinations(range(N), 2):
        row = np.zeros(3 * N)
        u = (balls[i] - balls[j]) / np.linalg.norm(balls[i] - balls[j])
        row[3 * i : 3 * i + 3], row[3 * j : 3 * j + 3] = u, -u
        rows.append(row)
    U = np.array(rows)
    np.testing.assert_allclose(pairs_precision(poses.balls, 2e-6), U.T @ U / 4e-12, rtol=1e-9)
    pairs = len(U)
    D = np.concatenate(
        [
            U @ np.kron(np.eye(N), np.asarray(r).T) @ np.asarray(j)
            for r, j in zip(poses.rotation, seen.machine, strict=True)
        ]
    )
    V = np.kron(np.eye(M), PROBE**2 * U @ U.T) + np.kron(np.ones((M, M)), 4e-12 * np.eye(pairs))
    expected = np.eye(D.shape[1]) + D.T @ np.linalg.solve(V + 1e-20 * np.eye(len(V)), D)
    found = array_curvature(seen, model, PROBE, pairs_precision(poses.balls, 2e-6))
    one, other = (np.sqrt(np.diag(np.linalg.inv(np.asarray(h)))) for h in (found, expected))
    np.testing.assert_allclose(one, other, rtol=1e-3)


def test_the_gram_against_moved_tool_points():
    chain, errors = machine()
    model = Model(chain, instrument_of(design(), 0.0), (errors,))
    rng = np.random.default_rng(3)
    points = Plan(chain.axes, rng.uniform(0.0, 0.6, (40, 3)), {})
    gram = volumetric_gram(model, points)
    theta = 1e-3 * rng.standard_normal(len(model.entries))
    terms = model.terms(points)
    both = [
        np.asarray(
            tool_points(
                chain,
                jnp.asarray(points.position),
                port_values(terms, jnp.asarray(s * theta), len(model.layout)),
            )
        )
        for s in (1.0, -1.0, 0.0)
    ]
    moved = 0.5 * (both[0] - both[1])
    assert theta @ gram.raw @ theta == pytest.approx((moved**2).sum(1).mean(), rel=1e-6)
    left = align_rigid(both[2], moved)
    assert theta @ gram.aligned @ theta == pytest.approx((left**2).sum(1).mean(), rel=1e-5)


@pytest.mark.campaign
@pytest.mark.parametrize(("fresh", "pairs"), [(False, True), (True, False)])
def test_gradient_against_finite_differences(fresh, pairs):
    chain, errors = machine()
    poses = design(4)
    model = Model(chain, instrument_of(poses, 0.0), (errors,))
    points = Plan(chain.axes, np.random.default_rng(5).uniform(0.0, 0.6, (30, 3)), {})
    gram = jnp.asarray(volumetric_gram(model, points).aligned)
    space = ArraySpace(poses, TRAVEL, across=(0.06, 0.06), along=True, tool=TOOL)
    z = space.scattered(jax.random.key(1), 0.2, 0.1)
    z = np.clip(z, space.low + 0.05, space.high - 0.05)
    way = np.random.default_rng(6).standard_normal(len(z))

    @jax.jit
    def rms(step):
        made = space.candidate(z + step * way).poses
        K = pairs_precision(made.balls, 2e-6) if pairs else balls_precision(N, 1.4e-6)
        H = array_curvature(touches(model, made), model, PROBE, K, fresh=fresh)
        return 1e6 * expected_rms(gram, inverse(H))

    slope = jax.grad(rms)(0.0)
    h = 1e-4
    found = (8.0 * (rms(h) - rms(-h)) - (rms(2 * h) - rms(-2 * h))) / (12.0 * h)
    assert slope == pytest.approx(float(found), rel=1e-6)


@pytest.mark.thorough
def test_tools_by_touch():
    """A side stylus in every second touch is another lever; the same stylus everywhere none."""
    chain, errors = machine()
    plain = design(7)
    same = design(7, jnp.broadcast_to(jnp.asarray(TOOL), (M, N, 3)))
    model = Model(chain, instrument_of(plain, 0.0), (errors,))
    np.testing.assert_allclose(
        touches(model, plain).machine, touches(model, same).machine, atol=1e-18
    )
    side = np.tile(np.asarray(TOOL), (M, N, 1))
    side[:, 1::2] += [0.15, 0.0, -0.05]
    moved = touches(model, design(7, jnp.asarray(side)))
    # EAZ turns the tool: lever y, z; at the touches of the side stylus the lever has changed.
    names = [e.parameter.name for e in model.entries]
    column = names.index("ECZ.P1")
    before, after = (
        np.asarray(t.machine)[:, :, column].reshape(M, N, 3) for t in (touches(model, plain), moved)
    )
    changed = np.abs(after - before).max((0, 2)) > 1e-9
    # The axes stand elsewhere for the other stylus, so that even its own part of ECZ changes.
    assert changed.tolist() == [False, True, False, True, False]


# --- the space of designs ---


@pytest.mark.thorough
def test_balls_stay_inside_the_travel():
    poses = design(8)
    space = ArraySpace(poses, TRAVEL, across=(0.06, 0.03), along=True, tool=TOOL)
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    for key in range(20):
        z = space.scattered(jax.random.key(key), 2.0, 2.0)
        made = space.candidate(z)
        if float(made.excess) > 0.0:
            continue
        at = np.asarray(made.poses.centres) - TOOL
        assert (at >= low - 1e-12).all() and (at <= high + 1e-12).all()
        balls = np.asarray(made.poses.balls)
        assert np.diff(balls[:, 0]).min() >= space.spacing - 1e-12
        assert np.ptp(balls[:, 0]) == pytest.approx(0.5)
        assert np.abs(balls[:, 1]).max() <= 0.06 and np.abs(balls[:, 2]).max() <= 0.03
    # The nominal design is where the numbers start, but for the safe distance from the ends.
    start = space.candidate(space.start)
    np.testing.assert_allclose(start.poses.balls, np.asarray(poses.balls), atol=0.011)
    np.testing.assert_allclose(start.poses.rotation, poses.rotation, atol=1e-12)


def test_an_artefact_longer_than_the_travel():
    poses = design(9)
    upright = jnp.asarray(Turn.from_euler("y", 90, degrees=True).as_matrix())
    long = ArrayPoses(3.0 * poses.balls, jnp.broadcast_to(upright, (M, 3, 3)), poses.origin)
    made = ArraySpace(long, TRAVEL, tool=TOOL)
    assert float(made.candidate(made.start).excess) > 1.5  # four poses, each 0.9 m too long
    with pytest.raises(ValueError, match="expected at least 200 mm in ascending order"):
        ArraySpace(poses, TRAVEL, spacing=0.2)


def test_the_search_finds_known_minima():
    def bowl(z):
        return 1.0 + (z[0] - 0.3) ** 2 + 10.0 * (z[1] + 0.2) ** 2

    found = search(bowl, [np.array([1.0, 1.0]), np.array([-1.0, 0.5])], -np.ones(2), np.ones(2))
    np.testing.assert_allclose(found[0].z, [0.3, -0.2], atol=1e-3)
    assert found[0].value <= found[1].value and found[0].converged
    held = search(bowl, [np.array([1.0, 1.0])], np.array([0.5, -1.0]), np.ones(2))[0]
    assert held.z[0] == pytest.approx(0.5)
    below = search(lambda z: bowl(z) - 5.0, [np.array([1.0, 1.0])], -np.ones(2), np.ones(2))[0]
    np.testing.assert_allclose(below.z, [0.3, -0.2], atol=1e-3)
    assert below.value == pytest.approx(-4.0, abs=1e-5)
    high = search(lambda z: bowl(z) - 100.0, [np.array([1.0, 1.0])], -np.ones(2), np.ones(2))[0]
    assert high.start == pytest.approx(1.0 + 0.49 + 14.4 - 100.0)
    assert high.value == pytest.approx(-99.0, abs=1e-3)
    with pytest.raises(ValueError, match="not finite"):
        search(lambda z: z[0] / 0.0, [np.ones(1)], -np.ones(1), np.ones(1))
    with pytest.raises(ValueError, match="gradient"):
        search(
            lambda z: 1.0 + jnp.sqrt(jnp.maximum(z[0], 0.0)), [np.zeros(1)], -np.ones(1), np.ones(1)
        )


@pytest.mark.campaign
def test_the_search_makes_a_better_artefact():
    chain, errors = machine()
    poses = design(10)
    model = Model(chain, instrument_of(poses, 0.0), (errors,))
    points = Plan(chain.axes, np.random.default_rng(5).uniform(0.0, 0.6, (30, 3)), {})
    gram = jnp.asarray(volumetric_gram(model, points).aligned)
    space = ArraySpace(poses, TRAVEL, across=(0.06, 0.06), tool=TOOL)

    def rms(z):
        made = space.candidate(z)
        K = pairs_precision(made.poses.balls, 2e-6)
        H = array_curvature(touches(model, made.poses), model, PROBE, K)
        return 1e6 * expected_rms(gram, inverse(H)) * made.penalty

    found = search(rms, spread(space, jax.random.key(0), 2), space.low, space.high, steps=40)
    assert found[0].value < 0.8 * float(rms(space.start))
    assert float(space.candidate(found[0].z).excess) < 1e-3
