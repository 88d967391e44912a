"""A rectangular distribution whose limits are not known exactly."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import gammainc
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Univariate, degrees, demand, number, ordered, positive
from .inverse import gamma_log_quantile
from .registry import register


@register
class CurvilinearTrapezoid(Univariate):
    """Rectangular distribution with inexact limits, CTrap(a, b, d) of JCGM 101 6.4.3.

    The limits lie within low +/- inexact and high +/- inexact (a, b and d in the standard) about
    a known midpoint; the support is [low - inexact, high + inexact]. Variance
    (b - a)^2 / 12 + d^2 / 9. With c = (b - a)/2 + d and t the distance from the middle, the density
    is log(c / t) / (4 d) on the flanks; with u = log(c / t) the tail is c / (4 d) times P(U <= u)
    for U gamma with shape 2.

    Raises `ValueError` unless low + inexact < high - inexact and inexact > 0.
    """

    name: ClassVar[str] = "curvilinear_trapezoid"
    low: Float[Array, ""]
    high: Float[Array, ""]
    inexact: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(
        self, low: ArrayLike, high: ArrayLike, inexact: ArrayLike, *, dof: ArrayLike = math.inf
    ):
        self.low = number(low)
        self.high = number(high)
        self.inexact = number(inexact)
        ordered(self.name, self.low, self.high)
        positive(self.name, inexact=self.inexact)
        demand(
            self.low + self.inexact < self.high - self.inexact,
            f"{self.name}: found low = {self.low}, high = {self.high}, inexact = {self.inexact}, "
            "expected low + inexact < high - inexact; inexact is half the width of the interval "
            "that holds a limit",
        )
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """(low + high) / 2."""
        return 0.5 * (self.low + self.high)

    @property
    def std(self) -> Array:
        return jnp.sqrt((self.high - self.low) ** 2 / 12.0 + self.inexact**2 / 9.0)

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low - self.inexact, self.high + self.inexact

    def cdf(self, x: Array) -> Array:
        outer, inner, plateau = self._parts()
        upper = x > self.mean
        t = jnp.where(upper, x - self.mean, self.mean - x)
        flank = (t > inner) & (t < outer)
        u = self._log_ratio(jnp.where(flank, t, 0.5 * (inner + outer)))
        tail = outer / (4.0 * self.inexact) * gammainc(2.0, u)
        tail = jnp.where(flank, tail, jnp.where(t < outer, 0.5 - t * plateau, 0.0))
        return jnp.where(upper, 1.0 - tail, tail)

    def log_density(self, x: Array) -> Array:
        outer, inner, plateau = self._parts()
        t = jnp.abs(x - self.mean)
        flank = (t > inner) & (t < outer)
        height = self._log_ratio(jnp.where(flank, t, 0.5 * (inner + outer))) / (4.0 * self.inexact)
        return jnp.where(t < outer, jnp.log(jnp.where(flank, height, plateau)), -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        outer, inner, plateau = self._parts()
        upper = p > q
        tail = jnp.where(upper, q, p)
        on_flank = tail < 0.5 - inner * plateau
        share = 4.0 * self.inexact / outer * jnp.where(on_flank, tail, 0.0)
        u = jnp.exp(gamma_log_quantile(2.0, share, 1.0 - share))
        depth = jnp.where(on_flank, -outer * jnp.expm1(-u), outer - (0.5 - tail) / plateau)
        low, high = self.support
        return jnp.where(upper, high - depth, low + depth)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        # JCGM 101 6.4.3.4: the lower limit first, then a rectangular number between the limits.
        first, second = jax.random.uniform(key, (2, *shape), dtype=float)
        low = self.low + self.inexact * (2.0 * first - 1.0)
        return low + (self.low + self.high - 2.0 * low) * second

    def _parts(self) -> tuple[Array, Array, Array]:
        """Half-widths of the support and of the plateau, and the density of the plateau."""
        half = 0.5 * (self.high - self.low)
        outer, inner = half + self.inexact, half - self.inexact
        return outer, inner, jnp.log1p(2.0 * self.inexact / inner) / (4.0 * self.inexact)

    def _log_ratio(self, t: Array) -> Array:
        """log(outer / t), exact where t is close to outer."""
        outer = 0.5 * (self.high - self.low) + self.inexact
        return jnp.log1p((outer - t) / t)
