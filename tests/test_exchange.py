"""Choosing measurements one by one: against enumeration, against the bound, and the poses' joint
matrices against the elimination they stand for.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turn

from vcal import Model
from vcal.design import (
    ArrayPoses,
    array_curvature,
    balls_precision,
    exchange,
    expected_rms,
    inverse,
    pairs_precision,
    pose_information,
    touches,
    volumetric_gram,
    weigh_average,
)
from vcal.effects.geometric import ErrorMotion, GeometricErrors
from vcal.instruments.ball_array import BallArray
from vcal.machine.chain import chain_from_string
from vcal.machine.error_functions import Legendre
from vcal.machine.plan import Plan

N, M, PROBE = 4, 9, 5e-7
TRAVEL = {"X": (0.0, 1.2), "Y": (0.0, 0.8), "Z": (0.0, 0.6)}


def drawn(seed, n, k, rank):
    """Candidates of some rank, a prior, and a form of the first half of the unknowns only."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((n, rank, k)) * rng.uniform(0.3, 3.0, (n, 1, 1))
    root = rng.standard_normal((k // 2, k // 2))
    gram = np.zeros((k, k))
    gram[: k // 2, : k // 2] = root @ root.T
    return rows.swapaxes(1, 2) @ rows, np.diag(rng.uniform(0.1, 1.0, k)), gram


def value_of(F, L, G, chosen):
    return np.sqrt(np.trace(G @ np.linalg.inv(L + F[list(chosen)].sum(0))))


@pytest.mark.parametrize("seed", range(8))
def test_against_enumeration(seed):
    F, L, G = drawn(seed, 9, 8, 2)
    everything = [value_of(F, L, G, c) for c in itertools.combinations(range(9), 3)]
    found = exchange(F, L, G, 3)
    assert found.value == pytest.approx(value_of(F, L, G, found.chosen), rel=1e-12)
    assert found.counts.sum() == 3 and found.counts.max() == 1
    # A local minimum, here always the best: among 84, in all of these draws.
    assert found.value == pytest.approx(min(everything), rel=1e-12)
    bound = weigh_average(F, L, G, 3, most=1, gap=1e-4)
    loose = weigh_average(F, L, G, 3, gap=1e-4)
    assert loose.bound <= bound.bound * (1 + 1e-3) and bound.bound <= found.value
    assert bound.value == pytest.approx(bound.bound, rel=2e-4)
    assert bound.weights.sum() == pytest.approx(3) and bound.weights.max() <= 1 + 1e-12
    assert found.value < np.median(everything)


def test_repeats_and_costs():
    F, L, G = drawn(20, 7, 6, 1)
    everything = {
        c: value_of(F, L, G, c) for c in itertools.combinations_with_replacement(range(7), 4)
    }
    found = exchange(F, L, G, 4, most=4)
    assert found.value == pytest.approx(min(everything.values()), rel=1e-12)
    assert weigh_average(F, L, G, 4).bound <= found.value
    # Where each may cost something else, what is bought stays within the total.
    costs = np.array([1.0, 2.0, 1.5, 1.0, 3.0, 2.5, 0.5])
    some = [c for r in range(1, 8) for c in itertools.combinations(range(7), r)]
    within = min(value_of(F, L, G, c) for c in some if costs[list(c)].sum() <= 4.0)
    bought = exchange(F, L, G, 4.0, costs=costs)
    assert costs @ bought.counts <= 4.0
    assert within <= bought.value <= 1.1 * within
    bound = weigh_average(F, L, G, 4.0, costs=costs, most=1)
    assert bound.bound <= within
    assert costs @ bound.weights == pytest.approx(4.0)


def test_without_a_prior():
    """Two ends of a line tell its slope best, and a line needs two points."""
    x = np.linspace(-1.0, 1.0, 11)
    rows = np.stack([np.ones_like(x), x], 1)
    F = np.einsum("nk,nl->nkl", rows, rows)
    slope = np.diag([0.0, 1.0])
    found = exchange(F, np.zeros((2, 2)), slope, 2)
    assert found.chosen.tolist() == [0, 10]
    assert found.value == pytest.approx(np.sqrt(0.5))
    four = exchange(F, np.zeros((2, 2)), slope, 4, most=2)
    assert four.counts[[0, 10]].tolist() == [2, 2]
    assert weigh_average(F, np.zeros((2, 2)), slope, 4).bound == pytest.approx(0.5, rel=1e-3)
    with pytest.raises(ValueError, match="undetermined"):
        exchange(F, np.zeros((2, 2)), slope, 1)
    with pytest.raises(ValueError, match="undetermined"):
        weigh_average(F[:1], np.zeros((2, 2)), slope, 1)
    with pytest.raises(ValueError, match="from 1 to 11"):
        exchange(F, np.zeros((2, 2)), slope, 12)
    with pytest.raises(ValueError, match="the cheapest candidate"):
        exchange(F, np.zeros((2, 2)), slope, 1.0, costs=np.full(11, 2.0))
    with pytest.raises(ValueError, match="numbers above zero"):
        exchange(F, np.zeros((2, 2)), slope, 1.0, costs=np.zeros(11))
    with pytest.raises(ValueError, match="at most 5.5"):
        weigh_average(F, np.zeros((2, 2)), slope, 6, most=0.5)


# --- poses of an artefact ---


@pytest.fixture(scope="module")
def given():
    chain = chain_from_string("w b X Y Z t", TRAVEL, (0.01, -0.02, 0.15))
    motions = tuple(
        ErrorMotion(f"E{c}{a}", a, Legendre(TRAVEL[a], (1, 2), 1e-5)) for a in "XY" for c in "XYAC"
    )
    x = np.linspace(-0.25, 0.25, N)
    balls = np.column_stack([x, 0.03 * (-1.0) ** np.arange(N), 0.04 * np.cos(np.arange(N))])
    rotation = Turn.random(M, random_state=3).as_matrix()
    origin = np.random.default_rng(4).uniform([0.3, 0.3, 0.4], [0.9, 0.5, 0.6], (M, 3))
    poses = ArrayPoses(*map(jnp.asarray, (balls, rotation, origin)))
    instrument = BallArray(
        centres=balls,
        numbers=np.arange(N),
        probe_sigma=PROBE,
        position_sigma=0.0,
        supports=(0.0, 1.0),
        pose_numbers=np.arange(M),
        pose_rotation=rotation,
        pose_origin=origin,
    )
    model = Model(chain, instrument, (GeometricErrors(motions=motions, locations=()),))
    points = Plan(chain.axes, np.random.default_rng(5).uniform(0.0, 0.6, (30, 3)), {})
    return model, touches(model, poses), volumetric_gram(model, points).aligned, balls


def precision_of(kind, balls):
    return balls_precision(N, 1.4e-6) if kind == "B" else pairs_precision(balls, 2e-6)


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["S", "P", "B"])
def test_joint_matrices_of_poses(given, kind):
    """The same criterion as the elimination of poses and balls, for any set and any repeats."""
    model, seen, gram, balls = given
    K, fresh = precision_of(kind, balls), kind == "P"
    joint = pose_information(seen, model, PROBE, K, fresh=fresh)
    assert joint.precision.shape[0] == len(model.entries) + (0 if fresh else 3 * N)
    padded = joint.padded(gram)
    for often in ([1, 1, 1, 1, 0, 0, 0, 0, 0], [0, 2, 0, 1, 0, 1, 0, 3, 0]):
        H = joint.precision + jnp.einsum("m,mkl->kl", jnp.array(often, float), joint.information)
        H_own = array_curvature(seen, model, PROBE, K, fresh=fresh, often=jnp.array(often, float))
        value, expected = expected_rms(padded, inverse(H)), expected_rms(gram, inverse(H_own))
        assert float(value) == pytest.approx(float(expected), rel=1e-9)
    part = type(seen)(*(p[:4] for p in seen))
    left_out = array_curvature(part, model, PROBE, K, fresh=fresh)
    ones = jnp.array([1.0] * 4 + [0.0] * 5)
    whole = array_curvature(seen, model, PROBE, K, fresh=fresh, often=ones)
    np.testing.assert_allclose(whole, left_out, rtol=1e-9, atol=1e-9 * float(abs(whole).max()))


@pytest.mark.parametrize("kind", ["S", "P"])
@pytest.mark.thorough
def test_three_poses_of_nine(given, kind):
    model, seen, gram, balls = given
    joint = pose_information(seen, model, PROBE, precision_of(kind, balls), fresh=kind == "P")
    F, L, G = (np.asarray(part) for part in (*joint, joint.padded(gram)))
    everything = [value_of(F, L, G, c) for c in itertools.combinations(range(M), 3)]
    found = exchange(F, L, G, 3)
    assert found.value == pytest.approx(min(everything), rel=1e-6)
    bound = weigh_average(F, L, G, 3, most=1)
    assert bound.bound <= found.value <= np.median(everything)
    # Three of nine are far from shares of all: the bound is below, but of the same size.
    assert bound.bound > 0.7 * found.value
