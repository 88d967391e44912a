"""Quantiles of the gamma and the beta distribution, which have no closed form.

Both have a log-concave density in a coordinate y on the whole real line (log x, logit x). So do
their tails T(y), and Newton's method on log T(y) = log(tail) converges from every start. The steps
are Halley's, which cost no more: with h = f/T, n = log(T / tail) / h and l = (log f)'::

    y + n / (1 + n (l + h) / 2)

inside a bracket, with bisection as the fallback. Far out in a tail the leading term of its series
is exact in float64, and no step is needed. Values are as accurate as `jax.scipy.special.gammainc`
and `betainc`: about 1e-13 relative, 1e-9 for shape parameters above 1e5.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.nn import softplus
from jax.scipy.special import betainc, gammainc, gammaincc, gammaln, ndtri
from jaxtyping import Bool, Float

from ..numerics.arrays import Array

_STEPS = 8
# Leading terms of the tails are exact where x (or 1 - x) is this far below its natural scale.
_FAR = -38.0
_UNDERFLOW = 1e-305

Tail = Callable[[Float[Array, "..."]], tuple[Array, Array, Array]]
"""v -> (T, log f, d log f / dv), with T decreasing in v."""


def gamma_log_quantile(
    shape: Float[Array, "..."] | float, p: Float[Array, "..."], q: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Logarithm of the x with P(X <= x) = p and P(X > x) = q, X gamma with unit scale.

    Differentiable in p and q, not in the shape. Raises `NotImplementedError` for a derivative with
    respect to the shape.
    """
    upper = p > q
    return _gamma(jnp.where(upper, q, p), jnp.asarray(shape, float), upper)


def beta_logit_quantile(
    a: Float[Array, "..."] | float,
    b: Float[Array, "..."] | float,
    p: Float[Array, "..."],
    q: Float[Array, "..."],
) -> Float[Array, "..."]:
    """Logit of the x with P(X <= x) = p and P(X > x) = q, X beta with parameters a and b.

    Differentiable in p and q. Raises `NotImplementedError` for a derivative with respect to a or b.
    """
    upper = p > q
    return _beta(jnp.where(upper, q, p), jnp.asarray(a, float), jnp.asarray(b, float), upper)


def log_beta(a: Float[Array, "..."] | float, b: Float[Array, "..."] | float) -> Float[Array, "..."]:
    """Logarithm of the beta function B(a, b)."""
    # jax.scipy.special.betaln is wrong by up to 5e-7 where a parameter is above 8 (JAX 0.10).
    return gammaln(a) + gammaln(b) - gammaln(a + b)


def beta_tails(
    a: Float[Array, "..."] | float, b: Float[Array, "..."] | float, y: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """P(X <= x) and P(X > x) of a beta distribution at logit(x) = y.

    The smaller of the two keeps its relative accuracy, because neither x nor 1 - x is ever formed
    as a difference.
    """
    x, rest = jax.nn.sigmoid(y), jax.nn.sigmoid(-y)
    # The side on which the continued fraction converges fast, and betainc leaves x as it is.
    swap = x > (a + 1.0) / (a + b + 2.0)
    near = betainc(jnp.where(swap, b, a), jnp.where(swap, a, b), jnp.where(swap, rest, x))
    return jnp.where(swap, 1.0 - near, near), jnp.where(swap, near, 1.0 - near)


def beta_log_density(
    a: Float[Array, "..."] | float, b: Float[Array, "..."] | float, y: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Logarithm of the density of y = logit(x) of a beta distribution."""
    return -a * softplus(-y) - b * softplus(y) - log_beta(a, b)


def refuse_shape_derivative(tangents: tuple) -> None:
    """Raise `NotImplementedError` unless these tangents of shape parameters are symbolic zeros."""
    if not all(isinstance(t, SymbolicZero) for t in tangents):
        raise NotImplementedError(
            "the derivative of a gamma, beta or t probability or quantile with respect to its "
            "shape parameters or degrees of freedom is not available; differentiate with respect "
            "to the argument, location or scale, and hold the shape fixed"
        )


def instantiated(tangent: Any, like: Array) -> Array:
    """The tangent as an array, also where it is a symbolic zero."""
    return jnp.zeros_like(like) if isinstance(tangent, SymbolicZero) else tangent


@jax.custom_jvp
def _gamma(tail: Array, k: Array, upper: Bool[Array, "..."]) -> Array:
    return _gamma_solved(tail, k, upper)


# Compiled once per shape, also for calls outside of compiled functions.
@jax.jit
def _gamma_solved(tail: Array, k: Array, upper: Bool[Array, "..."]) -> Array:
    p = jnp.where(upper, 1.0 - tail, tail)
    # P = x^k / Gamma(k + 1) (1 - k x / (k + 1) + ...), an upper bound of P.
    leading = (jnp.log(p) + gammaln(k + 1.0)) / k
    far = leading < _FAR
    z = jnp.where(upper, -1.0, 1.0) * ndtri(tail)
    wilson_hilferty = 1.0 - 1.0 / (9.0 * k) + z / (3.0 * jnp.sqrt(k))
    likely = jnp.log(k) + 3.0 * jnp.log(jnp.maximum(wilson_hilferty, 1e-100))
    start = jnp.clip(jnp.maximum(leading, likely), _FAR - 1.0, 7.0 + jnp.log(k + 1.0))
    sign = jnp.where(upper, 1.0, -1.0)

    def at(v: Array) -> tuple[Array, Array, Array]:
        y = sign * v
        x = jnp.exp(y)
        t = jnp.where(upper, gammaincc(k, x), gammainc(k, x))
        return t, k * y - x - gammaln(k), sign * (k - x)

    ends = _FAR - 1.0, 7.0 + jnp.log(k + 1.0)
    low = jnp.where(upper, ends[0], -ends[1])
    high = jnp.where(upper, ends[1], -ends[0])
    found = sign * _solve(at, jnp.log(tail), sign * start, low, high)
    ended = jnp.where(upper, jnp.inf, -jnp.inf)
    return jnp.where(tail == 0.0, ended, jnp.where(far, leading, found))


@jax.custom_jvp
def _beta(tail: Array, a: Array, b: Array, upper: Bool[Array, "..."]) -> Array:
    return _beta_solved(tail, a, b, upper)


@jax.jit
def _beta_solved(tail: Array, a: Array, b: Array, upper: Bool[Array, "..."]) -> Array:
    p, q = jnp.where(upper, 1.0 - tail, tail), jnp.where(upper, tail, 1.0 - tail)
    # P = x^a / (a B(a, b)) (1 + a (1 - b) x / (a + 1) + ...), and the same from the other end.
    log_b = log_beta(a, b)
    left = (jnp.log(p) + jnp.log(a) + log_b) / a
    right = -(jnp.log(q) + jnp.log(b) + log_b) / b
    reach_left = _FAR - jnp.log1p(b)
    reach_right = -_FAR + jnp.log1p(a)
    z = jnp.where(upper, -1.0, 1.0) * ndtri(tail)
    start = jnp.clip(_likely(a, b, z, left, right), reach_left, reach_right)
    sign = jnp.where(upper, 1.0, -1.0)

    def at(v: Array) -> tuple[Array, Array, Array]:
        y = sign * v
        lower, higher = beta_tails(a, b, y)
        slope = a * jax.nn.sigmoid(-y) - b * jax.nn.sigmoid(y)
        t = jnp.where(upper, higher, lower)
        return t, beta_log_density(a, b, y), sign * slope

    low = jnp.where(upper, reach_left, -reach_right) - 1.0
    high = jnp.where(upper, reach_right, -reach_left) + 1.0
    found = sign * _solve(at, jnp.log(tail), sign * start, low, high)
    found = jnp.where(left < reach_left, left, jnp.where(right > reach_right, right, found))
    ended = jnp.where(upper, jnp.inf, -jnp.inf)
    return jnp.where(tail == 0.0, ended, found)


def _likely(a: Array, b: Array, z: Array, left: Array, right: Array) -> Array:
    """Approximate logit of a beta-distributed number with normal score z.

    x / (1 - x) is a ratio of gamma numbers, whose cube roots are nearly normal (Wilson-Hilferty)
    with means u, w and variances s, t: the ratio of roots r solves r w - u = z sqrt(r^2 t + s).
    """
    s, t = 1.0 / (9.0 * a), 1.0 / (9.0 * b)
    u, w = 1.0 - s, 1.0 - t
    square = jnp.maximum(w**2 - z**2 * t, 1e-3)
    root = jnp.abs(z) * jnp.sqrt(jnp.maximum(u**2 * t + w**2 * s - z**2 * s * t, 0.0))
    big = (jnp.maximum(u * w, 0.0) + root) / square
    small = (u**2 - z**2 * s) / jnp.where(square * big == 0.0, 1.0, square * big)
    ratio = jnp.where(z > 0.0, big, small)
    fair = (ratio > 1e-2) & (ratio < 1e2)
    centre, spread = jnp.log(a) - jnp.log(b), jnp.sqrt(1.0 / a + 1.0 / b)
    rough = jnp.clip(centre + spread * z, jnp.minimum(left, centre), jnp.maximum(right, centre))
    return jnp.where(fair, centre + 3.0 * jnp.log(jnp.where(fair, ratio, 1.0)), rough)


def _solve(at: Tail, log_tail: Array, start: Array, low: Array, high: Array) -> Array:
    """The v with T(v) = tail between `low` and `high`."""

    def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        v, low, high = state
        t, log_f, slope = at(v)
        # Where T underflows it is f / (-l), the first term of its expansion in a far tail.
        gone = t < _UNDERFLOW
        fall = jnp.maximum(-slope, 1e-3)
        log_t = jnp.where(gone, log_f - jnp.log(fall), jnp.log(jnp.where(gone, 1.0, t)))
        hazard = jnp.where(gone, fall, jnp.exp(log_f - log_t))
        excess = log_t - log_tail
        low, high = jnp.where(excess > 0.0, v, low), jnp.where(excess > 0.0, high, v)
        newton = excess / hazard
        halley = newton / (1.0 + 0.5 * newton * (slope + hazard))
        middle = 0.5 * (low + high)
        for candidate in (v + newton, v + halley):
            inside = (candidate >= low) & (candidate <= high)
            middle = jnp.where(inside, candidate, middle)
        return middle, low, high

    shape = jnp.broadcast_shapes(start.shape, low.shape, high.shape, log_tail.shape)
    state = tuple(jnp.broadcast_to(x, shape) for x in (start, low, high))
    return jax.lax.fori_loop(0, _STEPS, step, state)[0]


@partial(_gamma.defjvp, symbolic_zeros=True)
def _gamma_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    tail, k, upper = primals
    refuse_shape_derivative(tangents[1:2])
    y = _gamma(tail, k, upper)
    density = jnp.exp(k * y - jnp.exp(y) - gammaln(k))
    return y, _along(tangents[0], upper, density)


@partial(_beta.defjvp, symbolic_zeros=True)
def _beta_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    tail, a, b, upper = primals
    refuse_shape_derivative(tangents[1:3])
    y = _beta(tail, a, b, upper)
    return y, _along(tangents[0], upper, jnp.exp(beta_log_density(a, b, y)))


def _along(tangent: Any, upper: Array, density: Array) -> Array:
    return jnp.where(upper, -1.0, 1.0) * instantiated(tangent, density) / density
