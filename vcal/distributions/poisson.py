"""The distribution of a number of independent events."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import gammainc, gammaincc, gammaln, ndtri, xlogy
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Univariate, degrees, demand, number, positive
from .registry import register
from .scores import step_coefficients

_REACH = 40.0
"""Half the range of numbers whose steps are counted, in standard deviations (and as many more)."""
_LARGEST = 1e9
"""Largest mean: the numbers are exact integers, and the steps of a series fit into memory."""


@register
class Poisson(Univariate):
    """Number of independent events that happen at a constant rate, P(X = n) = m^n e^-m / n!.

    `mean` is m, also the variance. It is discrete: there is no density, `quantile` is the smallest
    n with P(X <= n) >= p, and its derivative is zero. For the rate behind an observed number,
    take `Gamma`. Raises `ValueError` unless 0 < mean <= 1e9.
    """

    name: ClassVar[str] = "poisson"
    discrete: ClassVar[bool] = True
    mean: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, mean: ArrayLike, *, dof: ArrayLike = math.inf):
        self.mean = number(mean)
        positive(self.name, mean=self.mean)
        demand(
            self.mean <= _LARGEST,
            f"{self.name}: found mean = {self.mean}, expected at most {_LARGEST:g}; take a normal "
            "distribution with the variance of the mean, which is the same by then",
        )
        self.dof = degrees(self.name, dof)

    @property
    def std(self) -> Array:
        return jnp.sqrt(self.mean)

    @property
    def symmetric(self) -> bool:
        return False

    @property
    def support(self) -> tuple[Array, Array]:
        return jnp.asarray(0.0), jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        n = jnp.floor(x)
        return jnp.where(n >= 0.0, gammaincc(jnp.maximum(n, 0.0) + 1.0, self.mean), 0.0)

    def log_density(self, x: Array) -> Array:
        """Raises `ValueError`: a number of events has no density, see `log_probability`."""
        raise ValueError(
            f"{self.name}: a number of events has no density; take log_probability, or Gamma for "
            "the rate"
        )

    def log_probability(self, n: Array) -> Array:
        """Logarithm of P(X = n), elementwise; -inf unless n is a whole number of at least zero."""
        n = jnp.asarray(n, dtype=float)
        whole = (n >= 0.0) & (n == jnp.floor(n))
        held = jnp.where(whole, n, 0.0)
        value = xlogy(held, self.mean) - self.mean - gammaln(held + 1.0)
        return jnp.where(whole, value, -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q

        def enough(n: Array) -> Array:
            """Whether P(X <= n) >= p."""
            below, above = gammaincc(n + 1.0, self.mean), gammainc(n + 1.0, self.mean)
            return jnp.where(upper, above <= q, below >= p)

        def halve(state: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = state
            middle = jnp.floor(0.5 * (low + high))
            found = enough(middle)
            return jnp.where(found, low, middle), jnp.where(found, middle, high)

        low = jnp.full(jnp.shape(p), -1.0)
        # 1 - P(X <= n) is below the smallest float64 there.
        high = jnp.full(jnp.shape(p), jnp.ceil(self.mean + 45.0 * jnp.sqrt(self.mean) + 800.0))
        found = jax.lax.while_loop(
            lambda state: jnp.any(state[1] - state[0] > 1.0), halve, (low, high)
        )[1]
        return jnp.where(q == 0.0, jnp.inf, jnp.where(p == 0.0, 0.0, found))

    def score_series(self, order: int) -> Float[Array, " order"]:
        # The function from_score is a step function, whose coefficients are known exactly.
        if isinstance(self.mean, Tracer):
            raise ValueError(f"{self.name}: a correlation cannot be computed inside jit")
        mean = float(self.mean)
        reach = _REACH * (math.sqrt(mean) + 1.0)
        n = np.arange(max(0.0, math.floor(mean - reach)), math.ceil(mean + reach))
        z = jnp.where(
            n < mean,
            ndtri(gammaincc(n + 1.0, mean)),
            -ndtri(gammainc(n + 1.0, mean)),
        )
        z = z[np.isfinite(np.asarray(z))]
        return step_coefficients(jnp.full(len(z), 1.0 / math.sqrt(mean)), z, order)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return jax.random.poisson(key, self.mean, shape, dtype=np.int64).astype(float)
