"""The empirical distribution of a set of values."""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from .base import Univariate, counts, in_float64, number
from .registry import register
from .scores import step_coefficients


@register
class Empirical(Univariate):
    """Empirical distribution of observed values: drawn with replacement.

    `values` (n,), and their `weights` (n,), equal by default. It is discrete:
    `std` is that of the set itself, sqrt(sum_i w_i (x_i - mean)^2), without n - 1; there is no
    density, and `quantile` is the smallest value x with P(X <= x) >= p, whose derivative is zero.

    Raises `ValueError` for fewer than two different values (with a weight above zero), values that
    are not finite, or weights that are negative or do not match.
    """

    name: ClassVar[str] = "empirical"
    discrete: ClassVar[bool] = True
    values: Float[Array, " n"]
    """In ascending order."""
    probabilities: Float[Array, " n"]
    """They sum to one."""
    cumulative: Float[Array, " n"]
    dof: Float[Array, ""]

    def __init__(self, values: Any, weights: Any = None, *, dof: Any = math.inf):
        x = _vector("values", values)
        w = np.ones(len(x)) if weights is None else _vector("weights", weights)
        if len(w) != len(x):
            raise ValueError(
                f"{self.name}: found {len(x)} values and {len(w)} weights, expected one weight "
                "for every value"
            )
        if (w < 0.0).any():
            raise ValueError(
                f"{self.name}: found weights down to {w.min()}, expected none below 0; leave such "
                "values out"
            )
        x, w = x[w > 0.0], w[w > 0.0]
        if len(np.unique(x)) < 2:
            raise ValueError(
                f"{self.name}: found {len(np.unique(x))} different values of a weight above 0, "
                "expected at least 2; a quantity that is known exactly needs no distribution"
            )
        order = np.argsort(x, kind="stable")
        w = w[order] / w.sum()
        cumulative = np.cumsum(w)
        self.values = in_float64(jnp.asarray(x[order]))
        self.probabilities = in_float64(jnp.asarray(w))
        self.cumulative = in_float64(jnp.asarray(np.append(cumulative[:-1], 1.0)))
        self.dof = number(dof)
        counts(self.name, self.dof)

    @property
    def mean(self) -> Float[Array, ""]:
        """Weighted mean of the values."""
        return self.probabilities @ self.values

    @property
    def std(self) -> Array:
        return jnp.sqrt(self.probabilities @ (self.values - self.mean) ** 2)

    @property
    def symmetric(self) -> bool:
        centred = np.asarray(self.values - self.mean)
        mirrored = np.allclose(centred, -centred[::-1], rtol=0.0, atol=1e-12 * np.ptp(centred))
        weights = np.asarray(self.probabilities)
        return bool(mirrored and np.allclose(weights, weights[::-1], rtol=1e-12, atol=0.0))

    @property
    def support(self) -> tuple[Array, Array]:
        return self.values[0], self.values[-1]

    def cdf(self, x: Array) -> Array:
        below = jnp.searchsorted(self.values, x, side="right")
        return jnp.where(below > 0, self.cumulative[jnp.maximum(below - 1, 0)], 0.0)

    def log_density(self, x: Array) -> Array:
        """Raises `ValueError`: a set of values has no density."""
        raise ValueError(
            f"{self.name}: a set of values has no density; fit a distribution to the values where "
            "one is needed"
        )

    def inverse(self, p: Array, q: Array) -> Array:
        del q
        return self.values[jnp.searchsorted(self.cumulative, p, side="left")]

    def score_series(self, order: int) -> Float[Array, " order"]:
        # The function from_score is a step function, whose coefficients are known exactly.
        steps = jnp.diff(self.values) / self.std
        return step_coefficients(steps, ndtri(self.cumulative[:-1]), order)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Array:
        p = jax.random.uniform(key, shape, dtype=float)
        return self.values[jnp.searchsorted(self.cumulative, p, side="right")]


def _vector(what: str, values: Any) -> Float[np.ndarray, " n"]:
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"empirical: {what}: found something other than numbers, expected a list of numbers"
        ) from error
    if found.ndim != 1:
        raise ValueError(f"empirical: {what}: found shape {found.shape}, expected a list (n,)")
    bad = np.flatnonzero(~np.isfinite(found))
    if len(bad):
        raise ValueError(
            f"empirical: {what}: found {found[bad[0]]} at position {bad[0]}, expected finite "
            "numbers; leave out what was not observed"
        )
    return found
