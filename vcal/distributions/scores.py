"""Functions of a standard normal number as series in Hermite polynomials::

    g(Z) = c_0 + sum_n c_n h_n(Z),  h_n = He_n / sqrt(n!),  E[h_m(Z) h_n(Z)] = [m = n]

For two standard normal numbers with correlation r, E[h_m(Z1) h_n(Z2)] = r^n [m = n] (Mehler), so
that cov(g1(Z1), g2(Z2)) = sum_n c1_n c2_n r^n, n >= 1.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..numerics.arrays import Array

# Beyond 37 the normal tail is below the smallest normal float64, and a quantile of it infinite.
_REACH = 37.0
_STEP = 0.01


def score_coefficients(
    g: Callable[[Float[Array, " n"]], Float[Array, " n"]], order: int
) -> Float[Array, " order"]:
    """c_n = E[g(Z) h_n(Z)] for n = 1 to `order`, by the trapezoidal rule.

    The rule converges exponentially for smooth g, and with the third power of the step where the
    second derivative of g jumps.
    """
    z = jnp.arange(-_REACH, _REACH + _STEP / 2, _STEP)
    weighted = g(z) * jnp.exp(-0.5 * z**2) * (_STEP / jnp.sqrt(2.0 * jnp.pi))
    return _projections(weighted, z, order)[1:]


def step_coefficients(
    steps: Float[Array, " n"], z: Float[Array, " n"], order: int
) -> Float[Array, " order"]:
    """c_n for n = 1 to `order` of a g that rises by `steps` at the places `z`: exact.

    c_n = sum_k steps_k h_(n-1)(z_k) phi(z_k) / sqrt(n), because the integral of He_n phi from z
    to infinity is He_(n-1)(z) phi(z).
    """
    weighted = steps * jnp.exp(-0.5 * z**2) / jnp.sqrt(2.0 * jnp.pi)
    return _projections(weighted, z, order - 1) / jnp.sqrt(jnp.arange(1.0, order + 1.0))


@partial(jax.jit, static_argnames="order")
def _projections(
    weighted: Float[Array, " n"], z: Float[Array, " n"], order: int
) -> Float[Array, " order+1"]:
    """sum_k weighted_k h_n(z_k) for n = 0 to `order`."""

    def following(pair: tuple[Array, Array], n: Array) -> tuple[tuple[Array, Array], Array]:
        last, this = pair
        # sqrt(n + 1) h_(n+1) = z h_n - sqrt(n) h_(n-1)
        after = (z * this - jnp.sqrt(n) * last) / jnp.sqrt(n + 1.0)
        return (this, after), weighted @ this

    start = (jnp.zeros_like(z), jnp.ones_like(z))
    return jax.lax.scan(following, start, jnp.arange(order + 1.0))[1]


@jax.jit
def series_covariance(
    coefficients: Float[Array, "d n"], correlation: Float[Array, "d d"]
) -> Float[Array, "d d"]:
    """sum_n c_in c_jn r_ij^n: covariance of functions of correlated standard normal numbers."""

    def add(state: tuple[Array, Array], c: Array) -> tuple[tuple[Array, Array], None]:
        total, power = state
        power = power * correlation
        return (total + c[:, None] * c * power, power), None

    start = (jnp.zeros_like(correlation), jnp.ones_like(correlation))
    return jax.lax.scan(add, start, coefficients.T)[0][0]
