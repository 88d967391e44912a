"""Least squares within a prior against scipy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from vcal.numerics.least_squares import Status
from vcal.numerics.trust_region import within_prior


def curved(z, data):
    """Amplitudes of two springs in series, exponentially far from linear in z."""
    k = jnp.exp(2.0 * z)
    told = jnp.array([1.0 / k[0] + 1.0 / k[1], 1.0 / k[0], k[1] / (k[0] + k[2])])
    return jnp.concatenate([(told - data) / 1e-4, z])


@pytest.mark.parametrize("seed", range(6))
def test_against_scipy(seed):
    rng = np.random.default_rng(seed)
    true = jnp.asarray(rng.standard_normal(3))
    data = curved(true, jnp.zeros(3))[:3] * 1e-4
    found = within_prior(curved, jnp.zeros(3), data)
    assert found.status == Status.CONVERGED
    other = least_squares(lambda z: np.asarray(curved(z, data)), np.asarray(true), xtol=1e-14,
                          ftol=1e-14, gtol=1e-14, x_scale="jac")  # fmt: skip
    assert float(found.cost) == pytest.approx(2 * other.cost, rel=1e-6)
    np.testing.assert_allclose(found.value, other.x, atol=1e-5)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(other.jac.T @ other.jac), rtol=1e-3)


def test_a_linear_problem_takes_its_newton_step():
    A = np.random.default_rng(0).standard_normal((7, 3))
    y = 0.1 * np.ones(7)
    found = within_prior(lambda z, _: jnp.concatenate([A @ z - y, z]), jnp.zeros(3))
    whole = np.linalg.solve(A.T @ A + np.eye(3), A.T @ y)
    np.testing.assert_allclose(found.value, whole, rtol=1e-12)
    assert found.steps == 1


def test_steps_keep_within_the_radius():
    """From the first on, until the model has proved good."""
    trials = []

    def residual(z, _):
        jax.debug.callback(lambda z: trials.append(np.asarray(z)), z)
        return jnp.concatenate([100.0 * (z - 5.0), z])

    found = within_prior(residual, jnp.zeros(2))
    jax.effects_barrier()
    np.testing.assert_allclose(found.value, 5.0 * 1e4 / (1e4 + 1.0), rtol=1e-9)
    sizes = [np.linalg.norm(b - a) for a, b in zip(trials[:-1], trials[1:], strict=True)]
    assert sizes[0] == pytest.approx(1.0, rel=1e-6)
    assert all(b <= 2.0 * a * (1 + 1e-6) for a, b in zip(sizes[:-1], sizes[1:], strict=True))


def test_failures_are_values():
    found = within_prior(lambda z, _: jnp.concatenate([jnp.log(z), z]), -jnp.ones(2))
    assert found.status == Status.NON_FINITE
    found = within_prior(curved, jnp.zeros(3), jnp.array([9.0, 2.0, 0.1]), max_steps=1)
    assert found.status == Status.STEP_LIMIT
