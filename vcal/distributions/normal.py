"""The distributions of a repeated measurement: normal, and Student's t for few repeats."""

import math
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Raw, Univariate, degrees, demand, finite, number, positive
from .inverse import (
    beta_logit_quantile,
    beta_tails,
    instantiated,
    log_beta,
    refuse_shape_derivative,
)
from .registry import register


@register
class Normal(Univariate):
    """Normal distribution with a mean and a standard deviation (JCGM 101 6.4.7).

    `dof` are the degrees of freedom of `std`, where it was estimated. Raises `ValueError` for a
    standard deviation that is not above zero.
    """

    name: ClassVar[str] = "normal"
    raw: ClassVar[Raw | None] = "normal"
    mean: Float[Array, ""]
    std: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, mean: ArrayLike, std: ArrayLike, *, dof: ArrayLike = math.inf):
        self.mean = number(mean)
        self.std = number(std)
        finite(self.name, mean=self.mean)
        positive(self.name, std=self.std)
        self.dof = degrees(self.name, dof)

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        return ndtr((x - self.mean) / self.std)

    def log_density(self, x: Array) -> Array:
        z = (x - self.mean) / self.std
        return -0.5 * z**2 - 0.5 * jnp.log(2.0 * jnp.pi) - jnp.log(self.std)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q
        z = ndtri(jnp.where(upper, q, p))
        return self.mean + self.std * jnp.where(upper, -z, z)

    def from_score(self, z: Array) -> Array:
        return self.mean + self.std * z

    def score_series(self, order: int) -> Float[Array, " order"]:
        # The function from_score is the first polynomial.
        return jnp.zeros(order).at[0].set(1.0)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        return self.mean + self.std * jax.random.normal(key, shape, dtype=float)

    def from_raw(self, raw: Array) -> Array:
        return self.from_score(raw[0])


@register
class StudentT(Univariate):
    """Shifted and scaled t distribution (JCGM 101 6.4.9).

    For n repeats with mean m and standard deviation s: mean m, scale s / sqrt(n), dof n - 1.
    `mean` is the centre, also where dof <= 1 and there is no expectation. Raises `ValueError`
    for a scale or degrees of freedom that are not finite and above zero.
    """

    name: ClassVar[str] = "t"
    raw: ClassVar[Raw | None] = "polar"
    mean: Float[Array, ""]
    scale: Float[Array, ""]
    dof: Float[Array, ""]

    def __init__(self, mean: ArrayLike, scale: ArrayLike, dof: ArrayLike):
        self.mean = number(mean)
        self.scale = number(scale)
        self.dof = number(dof)
        finite(self.name, mean=self.mean)
        positive(self.name, scale=self.scale, dof=self.dof)

    @classmethod
    def from_std(cls, mean: ArrayLike, std: ArrayLike, dof: ArrayLike) -> "StudentT":
        """The t with this standard deviation: scale std sqrt((dof - 2) / dof).

        The GUM takes the scale as u, and t_p(dof) times the scale as U: its interval is that of
        the distribution. Raises `ValueError` for a standard deviation that is not above zero, or
        dof <= 2.
        """
        deviation, nu = number(std), number(dof)
        positive(cls.name, std=deviation, dof=nu)
        demand(
            nu > 2.0,
            f"{cls.name}: found dof = {nu}, expected more than 2, below which there is no standard "
            "deviation; state the scale",
        )
        return cls(mean, deviation * jnp.sqrt((nu - 2.0) / nu), nu)

    @property
    def std(self) -> Float[Array, ""]:
        """scale sqrt(dof / (dof - 2)).

        Raises `ValueError` where dof <= 2, for which the variance is infinite; inside a compiled
        function it is nan there.
        """
        demand(
            self.dof > 2.0,
            f"{self.name}: found dof = {self.dof}, expected more than 2, below which there is no "
            "standard deviation; take more repeats, or state a normal distribution with its dof "
            "as JCGM 100 does",
        )
        proper = self.dof > 2.0
        ratio = self.dof / (jnp.where(proper, self.dof, 3.0) - 2.0)
        return jnp.where(proper, self.scale * jnp.sqrt(ratio), jnp.nan)

    @property
    def stated_covariance(self) -> Float[Array, "1 1"]:
        return jnp.reshape(self.scale**2, (1, 1))

    @property
    def tail_index(self) -> Float[Array, ""]:
        return self.dof

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def support(self) -> tuple[Array, Array]:
        return jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)

    def cdf(self, x: Array) -> Array:
        return _t_cdf((x - self.mean) / self.scale, self.dof)

    def log_density(self, x: Array) -> Array:
        t = (x - self.mean) / self.scale
        return _t_log_density(t, self.dof) - jnp.log(self.scale)

    def inverse(self, p: Array, q: Array) -> Array:
        upper = p > q
        size = _t_size(jnp.where(upper, q, p), jnp.abs(p - q), self.dof)
        return self.mean + self.scale * jnp.where(upper, size, -size)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        normal, spread = jax.random.split(key)
        half = 0.5 * self.dof
        # log of chi-square / dof
        log_w = jax.random.loggamma(spread, half, shape, dtype=float) - jnp.log(half)
        z = jax.random.normal(normal, shape, dtype=float)
        return self.mean + self.scale * z * jnp.exp(-0.5 * log_w)

    def from_raw(self, raw: Array) -> Array:
        # Bailey 1994. exp - 1 loses digits for many degrees of freedom only: 1e-10 for a million.
        log_square, cosine = raw
        size = jnp.sqrt(self.dof * (jnp.exp(log_square / self.dof) - 1.0))
        return self.mean + self.scale * size * cosine


@jax.custom_jvp
def _t_cdf(t: Array, dof: Array) -> Array:
    # dof / (dof + t^2) has a beta distribution, whose lower tail is the sum of both tails of t.
    zero = t == 0.0
    logit = jnp.log(dof) - 2.0 * jnp.log(jnp.abs(jnp.where(zero, 1.0, t)))
    outer = jnp.where(zero, 1.0, beta_tails(0.5 * dof, 0.5, logit)[0])
    return jnp.where(t > 0.0, 1.0 - 0.5 * outer, 0.5 * outer)


# The logarithm has no derivative at t = 0, where the cdf has one.
@partial(_t_cdf.defjvp, symbolic_zeros=True)
def _t_cdf_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    t, dof = primals
    refuse_shape_derivative(tangents[1:])
    return _t_cdf(t, dof), instantiated(tangents[0], t) * jnp.exp(_t_log_density(t, dof))


@jax.custom_jvp
def _t_size(tail: Array, rest: Array, dof: Array) -> Array:
    """The t with P(T > t) = tail, where `rest` = 1 - 2 tail, exact where it is small."""
    return jnp.sqrt(dof) * jnp.exp(-0.5 * beta_logit_quantile(0.5 * dof, 0.5, 2.0 * tail, rest))


# As for the cdf: the logarithm has no derivative at t = 0. `rest` moves with `tail`.
@partial(_t_size.defjvp, symbolic_zeros=True)
def _t_size_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    tail, _, dof = primals
    refuse_shape_derivative(tangents[2:])
    t = _t_size(*primals)
    return t, -instantiated(tangents[0], tail) / jnp.exp(_t_log_density(t, dof))


def _t_log_density(t: Array, dof: Array) -> Array:
    constant = log_beta(0.5 * dof, 0.5) + 0.5 * jnp.log(dof)
    return -0.5 * (dof + 1.0) * jnp.log1p(t**2 / dof) - constant
