"""Distributions of several quantities that were estimated together."""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Multivariate, Raw, counts, demand, in_float64, number, positive
from .matrix import covariance_matrix, square_root
from .registry import register


@register
class MultivariateNormal(Multivariate):
    """Multivariate normal distribution (JCGM 101 6.4.8).

    `mean` (d,), `covariance` (d, d), which may be semi-definite; `dof` are the degrees of freedom
    of the variances where they were estimated, a number or (d,). Raises `ValueError` for a
    covariance that is not one.
    """

    name: ClassVar[str] = "multivariate_normal"
    raw: ClassVar[Raw | None] = "normal"
    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    dof: Float[Array, " d"]
    root: Float[Array, "d d"]
    """A with A A' = covariance."""

    def __init__(self, mean: Any, covariance: Any, *, dof: Any = math.inf):
        centre = _centre(self.name, mean)
        checked = covariance_matrix(f"{self.name}: covariance", covariance, len(centre))
        self.mean = in_float64(jnp.asarray(centre))
        self.covariance = jnp.asarray(checked)
        self.root = jnp.asarray(square_root(checked))
        self.dof = jnp.asarray(_broadcast(self.name, dof, len(centre)))

    @property
    def independent(self) -> bool:
        c = np.asarray(self.covariance)
        return not np.any(c - np.diag(np.diag(c)))

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def kinds(self) -> tuple[str, ...]:
        return (self.name,) * self.dimension

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        z = jax.random.normal(key, (*shape, self.dimension), dtype=float)
        return self.mean + z @ self.root.T

    def from_raw(self, raw: Array) -> Array:
        return self.mean + raw.T @ self.root.T


@register
class MultivariateT(Multivariate):
    """Multivariate t distribution (JCGM 102 5.3.2), from repeats of several quantities.

    X = mean + A z sqrt(dof / w) with A A' = scale_matrix, z standard normal and w chi-square of
    `dof` degrees of freedom, one for all elements, which are therefore never independent.
    `mean` (d,), `scale_matrix` (d, d), which may be semi-definite. For n repeats of d quantities,
    with sums of squares and products S: scale_matrix S / (n (n - d)), dof n - d. Raises
    `ValueError` for a scale matrix that is no covariance matrix, or dof not above zero.
    """

    name: ClassVar[str] = "multivariate_t"
    mean: Float[Array, " d"]
    scale_matrix: Float[Array, "d d"]
    common_dof: Float[Array, ""]
    """Degrees of freedom of the distribution."""
    root: Float[Array, "d d"]
    """A with A A' = scale_matrix."""

    def __init__(self, mean: Any, scale_matrix: Any, dof: Any):
        centre = _centre(self.name, mean)
        checked = covariance_matrix(f"{self.name}: scale_matrix", scale_matrix, len(centre))
        self.mean = in_float64(jnp.asarray(centre))
        self.scale_matrix = jnp.asarray(checked)
        self.root = jnp.asarray(square_root(checked))
        self.common_dof = number(dof)
        positive(self.name, dof=self.common_dof)

    @property
    def dof(self) -> Float[Array, " d"]:
        """Degrees of freedom of every element."""
        return jnp.broadcast_to(self.common_dof, (self.dimension,))

    @property
    def covariance(self) -> Float[Array, "d d"]:
        """scale_matrix dof / (dof - 2).

        Raises `ValueError` where dof <= 2; inside a compiled function it is nan there.
        """
        nu = self.common_dof
        demand(
            nu > 2.0,
            f"{self.name}: found dof = {nu}, expected more than 2, below which there is no "
            "covariance; take more repeats",
        )
        ratio = jnp.where(nu > 2.0, nu / (jnp.where(nu > 2.0, nu, 3.0) - 2.0), jnp.nan)
        return self.scale_matrix * ratio

    @property
    def stated_covariance(self) -> Float[Array, "d d"]:
        return self.scale_matrix

    @property
    def tail_index(self) -> Float[Array, ""]:
        return self.common_dof

    @property
    def independent(self) -> bool:
        return self.dimension == 1

    @property
    def symmetric(self) -> bool:
        return True

    @property
    def kinds(self) -> tuple[str, ...]:
        return (self.name,) * self.dimension

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        normal, common = jax.random.split(key)
        z = jax.random.normal(normal, (*shape, self.dimension), dtype=float)
        half = 0.5 * self.common_dof
        # log of chi-square / dof
        log_w = jax.random.loggamma(common, half, shape, dtype=float) - jnp.log(half)
        return self.mean + jnp.exp(-0.5 * log_w)[..., None] * (z @ self.root.T)


def _centre(name: str, mean: Any) -> Float[np.ndarray, " d"]:
    try:
        found = np.asarray(mean, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: mean: found {mean!r}, expected a list of numbers") from error
    if found.ndim != 1 or not len(found):
        raise ValueError(
            f"{name}: mean: found shape {found.shape}, expected (d,), one number per quantity"
        )
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: mean: found {found.tolist()}, expected finite numbers")
    return found


def _broadcast(name: str, dof: Any, size: int) -> Float[np.ndarray, " d"]:
    found = np.asarray(dof, dtype=float)
    if found.shape not in ((), (size,)):
        raise ValueError(
            f"{name}: dof: found shape {found.shape}, expected one number or ({size},)"
        )
    counts(name, found)
    return np.broadcast_to(found, (size,)).copy()
