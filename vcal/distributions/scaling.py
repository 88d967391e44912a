"""A distribution moved to another mean, or stretched about it."""

import math
from typing import ClassVar

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Univariate, finite, number, positive


class Rescaled(Univariate):
    """mean + factor (X - E[X]) for an X of distribution `inner`: the same shape.

    Raises `ValueError` for a mean that is not finite, or a factor that is not above zero.
    """

    name: ClassVar[str] = "rescaled"
    inner: Univariate
    mean: Float[Array, ""]
    factor: Float[Array, ""]

    def __init__(self, inner: Univariate, mean: ArrayLike, factor: ArrayLike):
        self.inner = inner
        self.mean, self.factor = number(mean), number(factor)
        finite(self.name, mean=self.mean)
        positive(self.name, factor=self.factor)

    @property
    def std(self) -> Array:
        return self.factor * self.inner.std

    @property
    def dof(self) -> Float[Array, ""]:
        """Those of the inner distribution."""
        return self.inner.dof

    @property
    def stated_covariance(self) -> Float[Array, "1 1"]:
        return self.factor**2 * self.inner.stated_covariance

    @property
    def tail_index(self) -> Float[Array, ""]:
        return self.inner.tail_index

    @property
    def symmetric(self) -> bool:
        return self.inner.symmetric

    @property
    def support(self) -> tuple[Array, Array]:
        low, high = self.inner.support
        return self._outer(low), self._outer(high)

    @property
    def kinds(self) -> tuple[str, ...]:
        return self.inner.kinds

    def cdf(self, x: Array) -> Array:
        return self.inner.cdf(self._within(x))

    def log_density(self, x: Array) -> Array:
        return self.inner.log_density(self._within(x)) - jnp.log(self.factor)

    def inverse(self, p: Array, q: Array) -> Array:
        return self._outer(self.inner.inverse(p, q))

    def from_score(self, z: Array) -> Array:
        return self._outer(self.inner.from_score(z))

    def score_series(self, order: int) -> Float[Array, " order"]:
        return self.inner.score_series(order)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self._outer(self.inner.sample(key, shape))

    def _outer(self, x: Array) -> Array:
        return self.mean + self.factor * (x - self.inner.mean)

    def _within(self, x: Array) -> Array:
        return self.inner.mean + (x - self.mean) / self.factor


def rescaled(
    distribution: Univariate, *, value: float | None = None, u: float | None = None
) -> Rescaled:
    """The distribution with another mean, another standard uncertainty, or both.

    `u` is that of JCGM 100: the scale of Student's t. Raises `ValueError` for a u that is not above
    zero, and for a multivariate distribution.
    """
    if distribution.shape != ():
        raise ValueError(
            f"{distribution.name}: found a multivariate distribution, expected a univariate one; "
            "state its covariance anew"
        )
    mean = jnp.asarray(distribution.mean if value is None else value, dtype=float)
    if u is None:
        return Rescaled(distribution, mean, 1.0)
    if not (u > 0.0 and math.isfinite(u)):
        raise ValueError(f"u: found {u}, expected a finite number above 0")
    return Rescaled(distribution, mean, u / jnp.sqrt(distribution.stated_covariance[0, 0]))
