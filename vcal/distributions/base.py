"""The base classes of all distributions.

A distribution is a frozen record of its parameters as float64 arrays, and can be an argument of
compiled functions. Its parameters are checked when it is constructed outside of these, where their
values are known.
"""

import abc
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.special import ndtr
from jax.typing import ArrayLike
from jaxtyping import Float, PRNGKeyArray

from ..numerics.arrays import Array
from ..numerics.record import Record
from .scores import score_coefficients

Raw = Literal["normal", "uniform", "polar"]


class Distribution(Record):
    """Base class of all distributions; subclasses are final.

    Class attribute: `name`, the identifier used in study files and tables.
    """

    name: ClassVar[str]
    raw: ClassVar[Raw | None] = None
    """Random numbers from which `from_raw` makes draws; None where only `sample` does."""

    mean: eqx.AbstractVar[Array]
    """Expectation, (): univariate, or (d,)."""
    dof: eqx.AbstractVar[Array]
    """Degrees of freedom of the standard uncertainty (JCGM 100 G.3), in the shape of `mean`; `inf`
    where the standard deviation is assumed to be known.
    """
    covariance: eqx.AbstractVar[Array]
    """Covariance matrix (d, d) of the elements of one draw; (1, 1) if univariate."""

    @property
    def stated_covariance(self) -> Float[Array, "d d"]:
        """Covariance matrix (d, d) in the sense of JCGM 100 (4.2.3, G.3), where `dof` accounts for
        few repeats: for Student's t, the square of the scale, which exists for any `dof`.
        """
        return self.covariance

    @property
    def tail_index(self) -> Float[Array, ""]:
        """Order below which moments exist."""
        return np.asarray(np.inf)

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of one draw: (), or (d,)."""

    @property
    @abc.abstractmethod
    def independent(self) -> bool:
        """Whether the elements of one draw are independent of each other."""

    @property
    @abc.abstractmethod
    def symmetric(self) -> bool:
        """Whether the distribution is symmetric about its mean; not inside `jit`."""

    @property
    @abc.abstractmethod
    def kinds(self) -> tuple[str, ...]:
        """Names of the distributions of the elements of one draw, for tables."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Draws of shape `shape` + `self.shape`, which depend only on the key and the shape."""

    def from_raw(self, raw: Float[Array, "d n"]) -> Float[Array, "n ..."]:
        """n draws from n random numbers of the kind `self.raw` per element.

        ``"normal"``: N(0, 1); ``"uniform"``: rectangular on (0, 1); ``"polar"``: two rows,
        -2 ln u and cos(2 pi v) of rectangular u and v.
        """
        raise NotImplementedError(f"{self.name} has no draws from {self.raw}")


class Univariate(Distribution):
    """A distribution of one number; subclasses are final."""

    discrete: ClassVar[bool] = False
    """Whether single values have probabilities, so that there is no density."""

    std: eqx.AbstractVar[Array]
    """Standard deviation: the standard uncertainty of JCGM 100 4.3."""

    @property
    @abc.abstractmethod
    def support(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Smallest interval that contains all of the probability."""

    @abc.abstractmethod
    def cdf(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """P(X <= x), elementwise."""

    @abc.abstractmethod
    def log_density(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Natural logarithm of the density, elementwise; -inf outside of the support."""

    @abc.abstractmethod
    def inverse(self, p: Float[Array, "..."], q: Float[Array, "..."]) -> Float[Array, "..."]:
        """The x with P(X <= x) = p and P(X > x) = q, where p + q = 1.

        Both are arguments because 1 - q loses the digits of a small q: the upper tail uses only q.
        """

    def quantile(self, p: Float[Array, "..."]) -> Float[Array, "..."]:
        """The x with P(X <= x) = p, elementwise; nan unless 0 <= p <= 1."""
        p = jnp.asarray(p, dtype=float)
        inside = (p >= 0.0) & (p <= 1.0)
        safe = jnp.where(inside, p, 0.5)
        return jnp.where(inside, self.inverse(safe, 1.0 - safe), jnp.nan)

    def from_score(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        """The x with P(X <= x) = Phi(z): the image of a standard normal z in a Gaussian copula."""
        return self.inverse(ndtr(z), ndtr(-z))

    def score_series(self, order: int) -> Float[Array, " order"]:
        """Coefficients 1 to `order` of `from_score` in normalised Hermite polynomials.

        They are those of (X - mean) / std, so that their squares sum to one as the order grows.
        """
        return _score_series(self, order)

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    @property
    def covariance(self) -> Float[Array, "1 1"]:
        return jnp.reshape(self.std**2, (1, 1))

    @property
    def independent(self) -> bool:
        return True

    @property
    def kinds(self) -> tuple[str, ...]:
        return (self.name,)


# Compiled once for a class of distributions, for all parameters.
@eqx.filter_jit
def _score_series(d: Univariate, order: int) -> Float[Array, " order"]:
    return score_coefficients(lambda z: (d.from_score(z) - d.mean) / d.std, order)


class Multivariate(Distribution):
    """A distribution of several numbers; subclasses are final."""

    @property
    def dimension(self) -> int:
        """Number of elements of one draw."""
        return self.mean.shape[0]

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.dimension,)


def number(value: Any) -> Float[Array, ""]:
    """`value` as one float64 number.

    Raises `ValueError` if it is not one number, `RuntimeError` where JAX runs in float32.
    """
    try:
        array = jnp.asarray(value, dtype=float)
    except (TypeError, ValueError):
        array = None
    if array is None or array.ndim:
        raise ValueError(
            f"found {value!r}, expected one number; several quantities are several distributions, "
            "or a multivariate one"
        )
    return in_float64(array)


def in_float64(array: jax.Array) -> jax.Array:
    """The array; raises `RuntimeError` that explains how to enable float64 if it is float32."""
    if array.dtype != jnp.dtype("float64"):
        raise RuntimeError(
            "vcal computes in float64, but JAX is set to float32. Call vcal.enable_float64() "
            "(or jax.config.update('jax_enable_x64', True)) once, before any other call."
        )
    return array


def degrees(name: str, dof: ArrayLike) -> Float[Array, ""]:
    """Degrees of freedom of a standard deviation: `inf` where it is known.

    Raises `ValueError` if they are not one number above zero.
    """
    value = number(dof)
    counts(name, value)
    return value


def finite(name: str, **values: Array) -> None:
    """Raise `ValueError` for values that are nan or infinite."""
    for key, value in values.items():
        if _known(value) and not np.isfinite(value):
            raise ValueError(f"{name}: found {key} = {value}, expected a finite number; correct it")


def positive(name: str, **values: Array) -> None:
    """Raise `ValueError` for values that are not finite and above zero."""
    finite(name, **values)
    for key, value in values.items():
        if _known(value) and not value > 0.0:
            raise ValueError(
                f"{name}: found {key} = {value}, expected a number above 0; a quantity that is "
                "known exactly needs no distribution"
            )


def counts(name: str, dof: Array) -> None:
    """Raise `ValueError` for degrees of freedom that are not above zero (`inf` is)."""
    if _known(dof) and not np.all(np.asarray(dof) > 0.0):
        raise ValueError(
            f"{name}: found dof = {dof}, expected a number above 0; leave it out where the "
            "standard deviation is known"
        )


def ordered(name: str, low: Array, high: Array) -> None:
    """Raise `ValueError` unless low < high, both finite."""
    finite(name, low=low, high=high)
    if _known(low) and _known(high) and not low < high:
        raise ValueError(
            f"{name}: found low = {low} and high = {high}, expected low < high; exchange them, or "
            "give a quantity that is known exactly without a distribution"
        )


def demand(condition: Any, message: str) -> None:
    """Raise `ValueError` with this message if the condition is known to be false."""
    if _known(condition) and not condition:
        raise ValueError(message)


def _known(value: Any) -> bool:
    return not isinstance(value, Tracer)
