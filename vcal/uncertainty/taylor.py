"""Moments of a function of uncertain inputs from its Taylor series.

With x = E[x] + L z, L L' = S the covariance of the inputs, z standardised and uncorrelated, and
a, H, T the first, second and third derivatives with respect to z:

    E[y]   = f + 1/2 sum_i H_ii
    var(y) = sum_i a_i^2 + 1/2 sum_ij H_ij^2 + sum_i a_i sum_j T_ijj

The series is that of JCGM 100, H.1.7 and the note to 5.1.2, written for standardised uncorrelated
directions, so that it covers correlated inputs. For normal z it is complete to fourth order in the
uncertainties.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..numerics.arrays import Array
from ..numerics.compiled import filter_jit_outermost
from .evaluation import compiled_for

Vector = Callable[[Float[Array, " k"]], Float[Array, " m"]]
"""A function from the vector of all inputs to the vector of all outputs."""


@dataclass(frozen=True)
class Taylor:
    """Derivatives of m outputs with respect to r standardised, uncorrelated inputs.

    An independent input with skewness s and excess kurtosis e adds to cov(y, y'), with h_i = H_ii
    and t_i = T_iii,

        1/2 sum_i s_i (a_i h'_i + h_i a'_i) + 1/4 sum_i e_i h_i h'_i
        + 1/6 sum_i e_i (a_i t'_i + t_i a'_i)
    """

    a: Float[np.ndarray, "m r"] = field(repr=False)
    H: Float[np.ndarray, "m r r"] = field(repr=False)
    """Second derivatives; of shape (m, 0, 0) for a first-order series."""
    T: Float[np.ndarray, "m r"] = field(repr=False)
    """sum_j d3f / dz_i dz_j^2."""
    t: Float[np.ndarray, "m r"] = field(repr=False)
    """d3f / dz_i^3."""
    skewness: Float[np.ndarray, " r"] = field(repr=False)
    excess: Float[np.ndarray, " r"] = field(repr=False)

    @property
    def finite(self) -> Bool[np.ndarray, " m"]:
        """Whether all derivatives of an output are finite."""
        parts = (self.a, self.H, self.T, self.t)
        return np.all([np.isfinite(p).all(tuple(range(1, p.ndim))) for p in parts], axis=0)

    @property
    def shift(self) -> Float[np.ndarray, " m"]:
        """E[y] - f."""
        return 0.5 * np.trace(self.H, axis1=1, axis2=2)

    @property
    def linear(self) -> Float[np.ndarray, " m"]:
        """First-order part of the variance."""
        return (self.a**2).sum(1)

    @property
    def variance(self) -> Float[np.ndarray, " m"]:
        """Variance of every output."""
        return np.sum([w * (p * q).sum(1) for p, q, w in self._pairs], axis=0)

    @property
    def covariance(self) -> Float[np.ndarray, "m m"]:
        """Covariance of the outputs."""
        return np.sum([0.5 * w * (p @ q.T + q @ p.T) for p, q, w in self._pairs], axis=0)

    @property
    def _pairs(self) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Factors p, q (m, .) and weights w with cov = sum of w/2 (p q' + q p')."""
        if not self.H.size:
            return [(self.a, self.a, 1.0)]
        flat = self.H.reshape(len(self.H), -1)
        h = np.diagonal(self.H, axis1=1, axis2=2)
        return [
            (self.a, self.a, 1.0),
            (flat, flat, 0.5),
            (self.a, self.T, 1.0),
            (self.a * self.skewness, h, 1.0),
            (h * self.excess, h, 0.25),
            (self.a * self.excess, self.t, 1.0 / 3.0),
        ]


def first_order(a: Float[np.ndarray, "m r"]) -> Taylor:
    """The first-order series."""
    m, r = a.shape
    none, nothing = np.zeros_like(a), np.zeros(r)
    return Taylor(a, np.zeros((m, 0, 0)), none, none, nothing, nothing)


def first_derivatives(
    function: Vector, x: Float[np.ndarray, " k"], root: Float[np.ndarray, "k r"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m k"], Float[np.ndarray, "2 r m"]]:
    """Outputs at `x`, their sensitivities c = df/dx, and the outputs at x + root_i, x - root_i."""
    program, arrays = compiled_for(_first, (function,))
    value, jacobian, moved = program(arrays, x, root)
    return np.asarray(value), np.asarray(jacobian), np.asarray(moved)


def values_at(function: Vector, points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n m"]:
    """Outputs at many points."""
    return np.asarray(_many(function, points))


def second_order(
    function: Vector,
    x: Float[np.ndarray, " k"],
    root: Float[np.ndarray, "k r"],
    skewness: Float[np.ndarray, " r"],
    excess: Float[np.ndarray, " r"],
) -> Taylor:
    """The series with its second-order terms, for inputs x + root z."""
    a, H, T, t = (np.asarray(d) for d in _second(function, jnp.asarray(x), jnp.asarray(root)))
    return Taylor(a, H, T, t, skewness, excess)


def _first(function: Vector, x: Array, root: Array) -> tuple[Array, Array, Array]:
    x, root = jnp.asarray(x), jnp.asarray(root)
    # The value does not depend on the direction, and is computed once.
    value, jacobian = jax.vmap(lambda v: jax.jvp(function, (x,), (v,)), out_axes=(None, 1))(
        jnp.eye(len(x))
    )
    moves = jnp.stack([root.T, -root.T])
    return value, jacobian, jax.vmap(jax.vmap(lambda d: function(x + d)))(moves)


@filter_jit_outermost
def _many(function: Vector, points: Array) -> Array:
    return jax.vmap(function)(jnp.asarray(points))


@filter_jit_outermost
def _second(function: Vector, x: Array, root: Array) -> tuple[Array, Array, Array, Array]:
    def moved(z: Array) -> Array:
        return function(x + root @ z)

    def along(f: Vector, z: Array, direction: Array) -> Array:
        return jax.jvp(f, (z,), (direction,))[1]

    def curvature(z: Array, direction: Array) -> Array:
        return along(lambda s: along(moved, s, direction), z, direction)

    zero, axes = jnp.zeros(root.shape[1]), jnp.eye(root.shape[1])
    # Differentiating the trace of the curvature takes r^2 passes; all of T would take r^3.
    trace = lambda z: jax.vmap(partial(curvature, z))(axes).sum(0)  # noqa: E731
    own = jax.vmap(lambda axis: along(lambda s: curvature(s, axis), zero, axis))(axes)
    hessian = jax.jacfwd(jax.jacfwd(moved))(zero)
    return jax.jacfwd(moved)(zero), hessian, jax.jacfwd(trace)(zero), own.T
