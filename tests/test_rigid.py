"""Kinematics in components: against scipy, against arrays, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Scipy
from scipy.stats import kstest

from vcal.machine.chain import chain_from_dh, chain_from_string
from vcal.numerics.normal_draws import standard_normal
from vcal.numerics.rigid import IDENTITY, Rotation, Vector, about, exp, left_jacobian

CHAINS = {
    "table": chain_from_string("w X b Y Z t"),
    "arm": chain_from_dh(
        [
            {"type": "revolute", "alpha": -1.5, "d": 0.29},
            {"type": "prismatic", "alpha": 0.7, "theta": -1.6},
        ]
    ),
}


@pytest.mark.parametrize(
    ("angle", "digits"), [(0.0, 1e-15), (1e-9, 1e-15), (1.0, 2e-15), (3.1, 1e-12)]
)
def test_exp_against_scipy(angle, digits):
    rng = np.random.default_rng(0)
    for axis in [*np.eye(3), *rng.standard_normal((5, 3))]:
        v = angle * axis / np.linalg.norm(axis)
        got = exp(Vector.of(jnp.asarray(v))).array()
        np.testing.assert_allclose(got, Scipy.from_rotvec(v).as_matrix(), rtol=0, atol=digits)


def test_rotation_about_an_axis():
    axis = np.array([0.6, -0.64, 0.48])
    got = about(Vector.of(axis), jnp.asarray(2.0)).array()
    np.testing.assert_allclose(got, Scipy.from_rotvec(2.0 * axis).as_matrix(), atol=1e-15)


def test_constants_are_left_out():
    assert exp(Vector(0.0, 0.0, 0.0)) is IDENTITY
    turned = IDENTITY @ Vector(jnp.asarray(2.0), 0.0, 0.0)
    assert turned.y == 0.0 and isinstance(turned.y, float)
    one = Vector(1.0, 0.0, 0.0).cross(Vector(0.0, 1.0, 0.0))
    assert one.parts == (0.0, 0.0, 1.0)


def test_exp_derivative_against_differences():
    v = np.array([0.3, -0.5, 0.2])
    slope = jax.jacfwd(lambda v: exp(Vector.of(v)).array())(jnp.asarray(v))
    back = jax.jacrev(lambda v: exp(Vector.of(v)).array())(jnp.asarray(v))
    np.testing.assert_allclose(slope, back, atol=1e-15)
    step = 1e-5
    for k, unit in enumerate(step * np.eye(3)):
        ends = [Scipy.from_rotvec(v + s * unit).as_matrix() for s in (1, -1)]
        np.testing.assert_allclose(slope[..., k], (ends[0] - ends[1]) / (2 * step), atol=1e-9)
    turn = left_jacobian(Vector.of(jnp.asarray(v)), Vector(0.0, 1e-5, 0.0)).array()
    small = Scipy.from_rotvec(v + [0, 1e-5, 0]) * Scipy.from_rotvec(v).inv()
    np.testing.assert_allclose(turn, small.as_rotvec(), atol=1e-10)


@pytest.mark.parametrize("name", CHAINS)
@pytest.mark.thorough
def test_pose_in_components_is_the_pose_in_arrays(name):
    chain, rng = CHAINS[name], np.random.default_rng(1)
    n = len(chain.joints)
    q, twists = rng.uniform(-1, 1, n), 0.3 * rng.standard_normal((n, 6))

    def components(q, twists):
        r, t = chain.pose(list(q), [list(row) for row in twists])
        return r.array(), t.array()

    for got, expected in zip(
        components(jnp.asarray(q), jnp.asarray(twists)),
        chain.pose_as_arrays(jnp.asarray(q), jnp.asarray(twists)),
        strict=True,
    ):
        np.testing.assert_allclose(got, expected, rtol=0, atol=2e-15)
    for derivative in (jax.jacfwd, jax.jacrev):
        ours = jax.jit(derivative(components, (0, 1)))(q, twists)
        plain = jax.jit(jax.jacfwd(chain.pose_as_arrays, (0, 1)))(q, twists)
        for got, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(plain), strict=True):
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14)


def test_a_chain_has_no_derivative_by_its_own_dimensions():
    import equinox as eqx

    chain = jax.tree.map(jnp.asarray, CHAINS["arm"])
    q, twists = [0.1] * 2, [[0.0] * 6] * 2

    def height(chain):
        return chain.pose([jnp.asarray(v) for v in q], twists)[1].z

    with pytest.raises(NotImplementedError, match="dimensions of the chain.*pose_as_arrays"):
        eqx.filter_grad(height)(chain)


def test_inverse_and_product():
    rng = np.random.default_rng(2)
    a, b = (Scipy.from_rotvec(v).as_matrix() for v in rng.standard_normal((2, 3)))
    ra, rb = Rotation.of(a), Rotation.of(b)
    np.testing.assert_allclose((ra @ rb).array(), a @ b, atol=1e-15)
    np.testing.assert_allclose((ra.T @ ra).array(), np.eye(3), atol=1e-15)


@pytest.mark.thorough
def test_noise_is_standard_normal():
    values = np.asarray(standard_normal(jax.random.key(1), (200_001,)))
    assert values.dtype == np.float64
    assert kstest(values, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(values[:-1], values[1:])[0, 1]) < 4.5 / np.sqrt(len(values))
    half = len(values) // 2  # both come from the same bits
    assert abs(np.corrcoef(values[:half], values[half + 1 :])[0, 1]) < 4.5 / np.sqrt(half)
    again = standard_normal(jax.random.key(1), (200_001,))
    np.testing.assert_array_equal(values, again)
    assert standard_normal(jax.random.key(1), (3, 0)).shape == (3, 0)
