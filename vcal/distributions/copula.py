"""Correlation between quantities of any distribution: the Gaussian copula."""

from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Multivariate, Raw, Univariate, in_float64
from .matrix import correlation_matrix, square_root
from .registry import register
from .scores import series_covariance

_ORDER = 1024
"""Terms of the series of a covariance: sufficient for correlations up to 0.99 between step
functions, and up to 1 between distributions with a density.
"""


@register
class GaussianCopula(Multivariate):
    """Quantities with given distributions whose normal scores are correlated.

    X_i = F_i^-1(Phi(Z_i)), with Z standard normal and correlated by `correlation` (d, d), which may
    be semi-definite. `correlation` is that of the scores Z, not of the quantities: the two are the
    same for normal distributions only. `covariance` is that of the quantities. `names` are those
    of the margins, for messages.

    Raises `ValueError` for a margin that is not univariate, or a correlation matrix that is not
    one.
    """

    name: ClassVar[str] = "gaussian_copula"
    raw: ClassVar[Raw | None] = "normal"
    margins: tuple[Univariate, ...]
    correlation: Float[Array, "d d"]
    """Correlation of the normal scores."""
    root: Float[Array, "d d"]
    """A with A A' = correlation."""

    def __init__(self, margins: Sequence[Univariate], correlation: Any, names: Sequence[str] = ()):
        for i, margin in enumerate(margins):
            if margin.shape != ():
                raise ValueError(
                    f"{self.name}: found {margin.name} of shape {margin.shape} as margin {i}, "
                    "expected a univariate distribution; it has correlations of its own"
                )
        if not margins:
            raise ValueError(f"{self.name}: found no margins, expected at least one")
        what = f"{self.name}: correlation"
        checked = correlation_matrix(what, correlation, len(margins), names)
        self.margins = tuple(margins)
        self.correlation = in_float64(jnp.asarray(checked))
        self.root = jnp.asarray(square_root(checked))

    @property
    def mean(self) -> Float[Array, " d"]:
        """Means of the margins."""
        return jnp.stack([margin.mean for margin in self.margins])

    @property
    def dof(self) -> Float[Array, " d"]:
        """Degrees of freedom of the margins."""
        return jnp.stack([margin.dof for margin in self.margins])

    @property
    def covariance(self) -> Float[Array, "d d"]:
        """Product-moment covariance of the quantities.

        std_i std_j sum_n c_in c_jn r_ij^n with the margins' Hermite coefficients c (Mehler's
        series, `vcal.distributions.scores`), computed at every call. Raises `ValueError`
        where a margin has no standard deviation.
        """
        std = jnp.stack([margin.std for margin in self.margins])
        series = jnp.stack([margin.score_series(_ORDER) for margin in self.margins])
        found = series_covariance(series, self.correlation)
        return jnp.outer(std, std) * jnp.where(jnp.eye(len(std), dtype=bool), 1.0, found)

    @property
    def stated_covariance(self) -> Float[Array, "d d"]:
        stated = [jnp.sqrt(margin.stated_covariance[0, 0]) for margin in self.margins]
        ratio = jnp.stack([s / m.std for s, m in zip(stated, self.margins, strict=True)])
        return self.covariance * jnp.outer(ratio, ratio)

    @property
    def tail_index(self) -> Float[Array, ""]:
        return jnp.min(jnp.stack([margin.tail_index for margin in self.margins]))

    @property
    def independent(self) -> bool:
        r = np.asarray(self.correlation)
        return not np.any(r - np.diag(np.diag(r)))

    @property
    def symmetric(self) -> bool:
        return all(margin.symmetric for margin in self.margins)

    @property
    def kinds(self) -> tuple[str, ...]:
        return tuple(margin.name for margin in self.margins)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        z = jax.random.normal(key, (*shape, self.dimension), dtype=float) @ self.root.T
        return self._from_scores(z)

    def from_raw(self, raw: Array) -> Array:
        return self._from_scores(raw.T @ self.root.T)

    def _from_scores(self, z: Float[Array, "... d"]) -> Float[Array, "... d"]:
        return jnp.stack([m.from_score(z[..., i]) for i, m in enumerate(self.margins)], axis=-1)
