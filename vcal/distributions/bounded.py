"""Distributions between two known limits, with straight or square-root flanks."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Raw, Univariate, degrees, demand, finite, number, ordered
from .registry import register


@register
class Uniform(Univariate):
    """Rectangular distribution between two limits (JCGM 101 6.4.2), variance (high - low)^2 / 12.

    Raises `ValueError` unless low < high.
    """

    name: ClassVar[str] = "uniform"
    raw: ClassVar[Raw | None] = "uniform"
    low: Float[Array, ""]
    high: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, low: ArrayLike, high: ArrayLike, *, dof: ArrayLike = math.inf):
        self.low = number(low)
        self.high = number(high)
        ordered(self.name, self.low, self.high)
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """(low + high) / 2."""
        return 0.5 * (self.low + self.high)

    @property
    def std(self) -> Array:
        return (self.high - self.low) / jnp.sqrt(12.0)

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low, self.high

    def cdf(self, x: Array) -> Array:
        return jnp.clip((x - self.low) / (self.high - self.low), 0.0, 1.0)

    def log_density(self, x: Array) -> Array:
        inside = (x >= self.low) & (x <= self.high)
        return jnp.where(inside, -jnp.log(self.high - self.low), -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        width = self.high - self.low
        return jnp.where(p > q, self.high - width * q, self.low + width * p)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self.low + (self.high - self.low) * jax.random.uniform(key, shape, dtype=float)

    def from_raw(self, raw: Array) -> Array:
        return self.low + (self.high - self.low) * raw[0]


@register
class Triangular(Univariate):
    """Triangular distribution with its peak at `mode`, the middle unless given (JCGM 101 6.4.5).

    Variance ((m - a)^2 + (m - a)(b - m) + (b - m)^2) / 18. Raises `ValueError` unless low < high
    and low <= mode <= high.
    """

    name: ClassVar[str] = "triangular"
    raw: ClassVar[Raw | None] = "uniform"
    low: Float[Array, ""]
    high: Float[Array, ""]
    mode: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(
        self,
        low: ArrayLike,
        high: ArrayLike,
        mode: ArrayLike | None = None,
        *,
        dof: ArrayLike = math.inf,
    ):
        self.low = number(low)
        self.high = number(high)
        self.mode = 0.5 * (self.low + self.high) if mode is None else number(mode)
        ordered(self.name, self.low, self.high)
        finite(self.name, mode=self.mode)
        demand(
            (self.low <= self.mode) & (self.mode <= self.high),
            f"{self.name}: found mode = {self.mode}, expected it between low = {self.low} and "
            f"high = {self.high}; correct it, or leave it out for the middle",
        )
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """(low + mode + high) / 3."""
        return (self.low + self.mode + self.high) / 3.0

    @property
    def std(self) -> Array:
        left, right = self.mode - self.low, self.high - self.mode
        return jnp.sqrt((left**2 + left * right + right**2) / 18.0)

    @property
    def symmetric(self) -> bool:
        return bool(jnp.isclose(self.mode, 0.5 * (self.low + self.high), rtol=1e-12, atol=0.0))

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low, self.high

    def cdf(self, x: Array) -> Array:
        left, right, width = self._flanks()
        x = jnp.clip(x, self.low, self.high)
        rising = x < self.mode
        up = (x - self.low) ** 2 / (width * jnp.where(rising, left, 1.0))
        down = 1.0 - (self.high - x) ** 2 / (width * jnp.where(rising | (right == 0), 1.0, right))
        return jnp.where(rising, up, down)

    def log_density(self, x: Array) -> Array:
        left, right, width = self._flanks()
        rising = x < self.mode
        far = jnp.where(rising, x - self.low, self.high - x)
        flank = jnp.where(rising, left, right)
        peak = x == self.mode
        share = jnp.where(peak, 1.0, far / jnp.where(flank == 0.0, 1.0, flank))
        inside = (x >= self.low) & (x <= self.high)
        return jnp.where(inside, _log(2.0 * share / width), -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        left, right, width = self._flanks()
        rising = p * width < left
        up = self.low + jnp.sqrt(jnp.where(rising, p * width * left, 1.0))
        down = self.high - jnp.sqrt(jnp.where(rising, 1.0, q * width * right))
        return jnp.where(rising, up, down)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        p = jax.random.uniform(key, shape, dtype=float)
        return self.inverse(p, 1.0 - p)

    def from_raw(self, raw: Array) -> Array:
        return self.inverse(raw[0], 1.0 - raw[0])

    def _flanks(self) -> tuple[Array, Array, Array]:
        return self.mode - self.low, self.high - self.mode, self.high - self.low


@register
class Trapezoidal(Univariate):
    """Symmetric trapezoidal distribution (JCGM 101 6.4.4): the sum of two rectangular quantities.

    `top` is the ratio of the top to the base, beta in the standard: 0 gives a triangular, 1 a
    rectangular distribution. Variance (high - low)^2 (1 + top^2) / 24. Raises `ValueError` unless
    low < high and 0 <= top <= 1.
    """

    name: ClassVar[str] = "trapezoidal"
    low: Float[Array, ""]
    high: Float[Array, ""]
    top: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(
        self, low: ArrayLike, high: ArrayLike, top: ArrayLike, *, dof: ArrayLike = math.inf
    ):
        self.low = number(low)
        self.high = number(high)
        self.top = number(top)
        ordered(self.name, self.low, self.high)
        demand(
            (self.top >= 0.0) & (self.top <= 1.0),
            f"{self.name}: found top = {self.top}, expected the ratio of the top to the base of "
            "the trapezoid, from 0 to 1; divide the two lengths",
        )
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """(low + high) / 2."""
        return 0.5 * (self.low + self.high)

    @property
    def std(self) -> Array:
        return (self.high - self.low) * jnp.sqrt((1.0 + self.top**2) / 24.0)

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low, self.high

    def cdf(self, x: Array) -> Array:
        _, flank, plateau = self._parts()
        upper = x > self.mean
        depth = jnp.where(upper, self.high - x, x - self.low)
        tail = jnp.where(
            depth < flank,
            0.5 * plateau * jnp.maximum(depth, 0.0) ** 2 / jnp.where(flank > 0.0, flank, 1.0),
            plateau * (depth - 0.5 * flank),
        )
        tail = jnp.where(depth < 0.0, 0.0, tail)
        return jnp.where(upper, 1.0 - tail, tail)

    def log_density(self, x: Array) -> Array:
        half, flank, plateau = self._parts()
        depth = half - jnp.abs(x - self.mean)
        share = jnp.where(depth < flank, depth / jnp.where(flank > 0.0, flank, 1.0), 1.0)
        return jnp.where(depth >= 0.0, _log(plateau * share), -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        _, flank, plateau = self._parts()
        upper = p > q
        tail = jnp.where(upper, q, p)
        on_flank = tail < 0.5 * plateau * flank
        root = jnp.sqrt(2.0 * jnp.where(on_flank, tail, 1.0) * flank / plateau)
        depth = jnp.where(on_flank, root, tail / plateau + 0.5 * flank)
        return jnp.where(upper, self.high - depth, self.low + depth)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        first, second = jax.random.uniform(key, (2, *shape), dtype=float)
        half = 0.5 * (self.high - self.low)
        return self.low + half * ((1.0 + self.top) * first + (1.0 - self.top) * second)

    def _parts(self) -> tuple[Array, Array, Array]:
        """Half the base, the width of a flank, and the density of the plateau."""
        half = 0.5 * (self.high - self.low)
        return half, half * (1.0 - self.top), 1.0 / (half * (1.0 + self.top))


@register
class Arcsine(Univariate):
    """U-shaped distribution of a sine at an unknown phase (JCGM 101 6.4.6).

    Variance (high - low)^2 / 8. Raises `ValueError` unless low < high.
    """

    name: ClassVar[str] = "arcsine"
    raw: ClassVar[Raw | None] = "uniform"
    low: Float[Array, ""]
    high: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, low: ArrayLike, high: ArrayLike, *, dof: ArrayLike = math.inf):
        self.low = number(low)
        self.high = number(high)
        ordered(self.name, self.low, self.high)
        self.dof = degrees(self.name, dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """(low + high) / 2."""
        return 0.5 * (self.low + self.high)

    @property
    def std(self) -> Array:
        return (self.high - self.low) / jnp.sqrt(8.0)

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return self.low, self.high

    def cdf(self, x: Array) -> Array:
        x = jnp.clip(x, self.low, self.high)
        upper = x > self.mean
        near = jnp.where(upper, self.high - x, x - self.low) / (self.high - self.low)
        tail = 2.0 / jnp.pi * jnp.arcsin(jnp.sqrt(near))
        return jnp.where(upper, 1.0 - tail, tail)

    def log_density(self, x: Array) -> Array:
        inside = (x >= self.low) & (x <= self.high)
        product = jnp.where(inside, (x - self.low) * (self.high - x), 1.0)
        return jnp.where(inside, -jnp.log(jnp.pi) - 0.5 * jnp.log(product), -jnp.inf)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q
        depth = (self.high - self.low) * jnp.sin(0.5 * jnp.pi * jnp.where(upper, q, p)) ** 2
        return jnp.where(upper, self.high - depth, self.low + depth)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        p = jax.random.uniform(key, shape, dtype=float)
        return self.inverse(p, 1.0 - p)

    def from_raw(self, raw: Array) -> Array:
        return self.inverse(raw[0], 1.0 - raw[0])


def _log(x: Array) -> Array:
    """Logarithm, -inf at zero and below, with a derivative that is not nan."""
    positive = x > 0.0
    return jnp.where(positive, jnp.log(jnp.where(positive, x, 1.0)), -jnp.inf)
