"""Log-normal, gamma and beta distributions."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import gammainc, gammaln, ndtr, ndtri, xlogy
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Raw, Univariate, degrees, finite, number, ordered, positive
from .inverse import beta_logit_quantile, beta_tails, gamma_log_quantile, log_beta
from .registry import register


@register
class LogNormal(Univariate):
    """exp(Y) of a normal Y with mean `mu` and standard deviation `sigma`.

    Mean exp(mu + sigma^2/2), variance mean^2 (exp(sigma^2) - 1). Raises `ValueError` unless sigma
    is above zero.
    """

    name: ClassVar[str] = "log_normal"
    raw: ClassVar[Raw | None] = "normal"
    mu: Float[Array, ""]
    sigma: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, mu: ArrayLike, sigma: ArrayLike, *, dof: ArrayLike = math.inf):
        self.mu = number(mu)
        self.sigma = number(sigma)
        finite(self.name, mu=self.mu)
        positive(self.name, sigma=self.sigma)
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """exp(mu + sigma^2 / 2)."""
        return jnp.exp(self.mu + 0.5 * self.sigma**2)

    @property
    def std(self) -> Array:
        return self.mean * jnp.sqrt(jnp.expm1(self.sigma**2))

    @property
    def symmetric(self) -> bool:
        return False

    @property
    def support(self) -> tuple[Array, Array]:
        return jnp.asarray(0.0), jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        inside = x > 0.0
        z = (jnp.log(jnp.where(inside, x, 1.0)) - self.mu) / self.sigma
        return jnp.where(inside, ndtr(z), 0.0)

    def log_density(self, x: Array) -> Array:
        inside = x > 0.0
        y = jnp.log(jnp.where(inside, x, 1.0))
        z = (y - self.mu) / self.sigma
        value = -0.5 * z**2 - y - jnp.log(self.sigma) - 0.5 * jnp.log(2.0 * jnp.pi)
        return jnp.where(inside, value, -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q
        z = ndtri(jnp.where(upper, q, p))
        return self.from_score(jnp.where(upper, -z, z))

    def from_score(self, z: Array) -> Array:
        return jnp.exp(self.mu + self.sigma * z)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self.from_score(jax.random.normal(key, shape, dtype=float))

    def from_raw(self, raw: Array) -> Array:
        return self.from_score(raw[0])


@register
class Gamma(Univariate):
    """Gamma distribution (JCGM 101 6.4.11) with density x^(k-1) exp(-x/s) / (Gamma(k) s^k).

    `shape` is k (kept as the field `k`), `scale` is s: mean k s, variance k s^2. Raises
    `ValueError` unless both are above zero.
    """

    name: ClassVar[str] = "gamma"
    k: Float[Array, ""]
    scale: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, shape: ArrayLike, scale: ArrayLike, *, dof: ArrayLike = math.inf):
        self.k = number(shape)
        self.scale = number(scale)
        positive(self.name, shape=self.k, scale=self.scale)
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """Shape times scale."""
        return self.k * self.scale

    @property
    def std(self) -> Array:
        return jnp.sqrt(self.k) * self.scale

    @property
    def symmetric(self) -> bool:
        return False

    @property
    def support(self) -> tuple[Array, Array]:
        return jnp.asarray(0.0), jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        return gammainc(self.k, jnp.maximum(x / self.scale, 0.0))

    def log_density(self, x: Array) -> Array:
        inside = x >= 0.0
        y = jnp.where(inside, x, 1.0) / self.scale
        value = xlogy(self.k - 1.0, y) - y - gammaln(self.k) - jnp.log(self.scale)
        return jnp.where(inside, value, -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        return self.scale * jnp.exp(gamma_log_quantile(self.k, p, q))

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self.scale * jnp.exp(jax.random.loggamma(key, self.k, shape, dtype=float))


@register
class Beta(Univariate):
    """Beta distribution between two limits, density (x-low)^(a-1) (high-x)^(b-1) up to a factor.

    Mean low + (high - low) a/(a+b), variance (high - low)^2 a b / ((a+b)^2 (a+b+1)). Raises
    `ValueError` unless a and b are above zero and low < high.
    """

    name: ClassVar[str] = "beta"
    a: Float[Array, ""]
    b: Float[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(
        self,
        a: ArrayLike,
        b: ArrayLike,
        low: ArrayLike = 0.0,
        high: ArrayLike = 1.0,
        *,
        dof: ArrayLike = math.inf,
    ):
        self.a = number(a)
        self.b = number(b)
        self.low = number(low)
        self.high = number(high)
        positive(self.name, a=self.a, b=self.b)
        ordered(self.name, self.low, self.high)
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """low + (high - low) a / (a + b)."""
        return self.low + (self.high - self.low) * self.a / (self.a + self.b)

    @property
    def std(self) -> Array:
        total = self.a + self.b
        return (self.high - self.low) * jnp.sqrt(self.a * self.b / (total + 1.0)) / total

    @property
    def symmetric(self) -> bool:
        return bool(self.a == self.b)

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low, self.high

    def cdf(self, x: Array) -> Array:
        inside = (x > self.low) & (x < self.high)
        held = jnp.where(inside, x, self.mean)
        logit = jnp.log(held - self.low) - jnp.log(self.high - held)
        lower, _ = beta_tails(self.a, self.b, logit)
        return jnp.where(inside, lower, jnp.where(x >= self.high, 1.0, 0.0))

    def log_density(self, x: Array) -> Array:
        inside = (x >= self.low) & (x <= self.high)
        x = jnp.where(inside, x, self.mean)
        width = self.high - self.low
        up = xlogy(self.a - 1.0, (x - self.low) / width)
        down = xlogy(self.b - 1.0, (self.high - x) / width)
        return jnp.where(inside, up + down - log_beta(self.a, self.b) - jnp.log(width), -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        return self._at_logit(beta_logit_quantile(self.a, self.b, p, q))

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        # x / (x + y) of two gamma numbers; their logarithms do not underflow for a small shape.
        first, second = jax.random.split(key)
        log_x = jax.random.loggamma(first, self.a, shape, dtype=float)
        return self._at_logit(log_x - jax.random.loggamma(second, self.b, shape, dtype=float))

    def _at_logit(self, logit: Array) -> Array:
        depth = (self.high - self.low) * jax.nn.sigmoid(-jnp.abs(logit))
        return jnp.where(logit > 0.0, self.high - depth, self.low + depth)
