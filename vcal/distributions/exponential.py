"""Laplace and Weibull distributions, whose tails are exponential functions in closed form."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln, xlogy
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Univariate, degrees, finite, number, positive
from .registry import register


@register
class Laplace(Univariate):
    """Laplace (double exponential) distribution, density exp(-|x - mean| / scale) / (2 scale).

    Variance 2 scale^2. Raises `ValueError` unless the scale is above zero.
    """

    name: ClassVar[str] = "laplace"
    mean: Float[Array, ""]
    scale: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, mean: ArrayLike, scale: ArrayLike, *, dof: ArrayLike = math.inf):
        self.mean = number(mean)
        self.scale = number(scale)
        finite(self.name, mean=self.mean)
        positive(self.name, scale=self.scale)
        self.dof = degrees(self.name, dof)

    @property
    def std(self) -> Array:
        return jnp.sqrt(2.0) * self.scale

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        t = (x - self.mean) / self.scale
        # Not the absolute value, which has no derivative in the middle.
        tail = 0.5 * jnp.exp(jnp.where(t > 0.0, -t, t))
        return jnp.where(t > 0.0, 1.0 - tail, tail)

    def log_density(self, x: Array) -> Array:
        return -jnp.abs(x - self.mean) / self.scale - jnp.log(2.0 * self.scale)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q
        depth = self.scale * jnp.log(2.0 * jnp.where(upper, q, p))
        return self.mean + jnp.where(upper, -depth, depth)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self.mean + self.scale * jax.random.laplace(key, shape, dtype=float)


@register
class Weibull(Univariate):
    """Weibull distribution, P(X > x) = exp(-((x - low) / scale)^k) for x >= low.

    `shape` is k (kept as the field `k`): mean low + scale Gamma(1 + 1/k), variance
    scale^2 (Gamma(1 + 2/k) - Gamma(1 + 1/k)^2). With k = 1 it is the exponential distribution.
    Raises `ValueError` unless scale and shape are above zero.
    """

    name: ClassVar[str] = "weibull"
    scale: Float[Array, ""]
    k: Float[Array, ""]
    low: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(
        self,
        scale: ArrayLike,
        shape: ArrayLike,
        low: ArrayLike = 0.0,
        *,
        dof: ArrayLike = math.inf,
    ):
        self.scale = number(scale)
        self.k = number(shape)
        self.low = number(low)
        positive(self.name, scale=self.scale, shape=self.k)
        finite(self.name, low=self.low)
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """low + scale Gamma(1 + 1/k)."""
        return self.low + self.scale * jnp.exp(gammaln(1.0 + 1.0 / self.k))

    @property
    def std(self) -> Array:
        first = gammaln(1.0 + 1.0 / self.k)
        second = gammaln(1.0 + 2.0 / self.k)
        return self.scale * jnp.exp(first) * jnp.sqrt(jnp.expm1(second - 2.0 * first))

    @property
    def symmetric(self) -> bool:
        return False

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low, jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        inside = x > self.low
        t = jnp.where(inside, x - self.low, 1.0) / self.scale
        return jnp.where(inside, -jnp.expm1(-(t**self.k)), 0.0)

    def log_density(self, x: Array) -> Array:
        inside = x >= self.low
        t = jnp.where(inside, x - self.low, 1.0) / self.scale
        value = jnp.log(self.k / self.scale) + xlogy(self.k - 1.0, t) - t**self.k
        return jnp.where(inside, value, -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q
        depth = jnp.where(
            upper, -jnp.log(jnp.where(upper, q, 0.5)), -jnp.log1p(-jnp.where(upper, 0.5, p))
        )
        return self.low + self.scale * depth ** (1.0 / self.k)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        depth = jax.random.exponential(key, shape, dtype=float)
        return self.low + self.scale * depth ** (1.0 / self.k)
