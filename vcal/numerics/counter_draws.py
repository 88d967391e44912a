"""Random numbers by counters: many rows at once, each from a key of its own.

    word i of a row = mix(key of the row + (i + 1) G)      G = 2^64 divided by the golden ratio

with the mixing function of SplitMix64 (Steele, Lea and Flood 2014, OOPSLA'14, 453; variant 13 of
Stafford), which maps 64 bits one to one. Rows are pieces of one sequence of 2^64 words, from places
that Threefry-2x32 gives (Salmon et al. 2011, SC'11), the generator of `jax.random`. Two of n rows
with c words each have words in common with a probability of about n^2 c / 2^64: 5e-4 for a million
rows of 10 000.

A rectangular number takes 52 bits of a word. A normal one takes all 64, 32 for the radius and 32
for the angle of the transformation of Box and Muller (1958), and one of Student's t by that of
Bailey (1994, Mathematics of Computation 62, 779) as well. Logarithm and cosine are polynomials,
which the compiler computes for several numbers at once, and which give the same on all devices up
to rounding.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt32, UInt64

from .arrays import Array

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIXED = ((30, np.uint64(0xBF58476D1CE4E5B9)), (27, np.uint64(0x94D049BB133111EB)))
_ONE = np.uint64(0x3FF << 52)
"""The bits of 1.0; those of the numbers up to 2 follow."""
_ABOVE_ROOT = np.uint64((1024 << 52) - 0x3FE6A09E667F3BCD)
_BIAS = np.uint64(1024 << 52)
_FIFTY_TWO = np.uint64(0x4330000000000000)
"""The bits of 2^52, whose last bits are the units."""

Words = tuple[UInt32[np.ndarray, "..."], UInt32[np.ndarray, "..."]]


def threefry(key: Words, counter: Words) -> Words:
    """Threefry-2x32 with 20 rounds, on the host; key and counter broadcast."""
    ks = (*key, key[0] ^ key[1] ^ _PARITY)
    a, b = counter[0] + ks[0], counter[1] + ks[1]
    for group in range(5):
        for r in _ROTATIONS[group % 2]:
            a = a + b
            b = ((b << np.uint32(r)) | (b >> np.uint32(32 - r))) ^ a
        a = a + ks[(group + 1) % 3]
        b = b + ks[(group + 2) % 3] + np.uint32(group + 1)
    return a, b


def seed_words(seed: int) -> Words:
    """The two words of a seed, as arrays of one word: the key that `jax.random.key` makes of it.

    Raises `ValueError` for a seed that is no whole number of 64 bits.
    """
    if not isinstance(seed, int | np.integer) or not -(2**63) <= seed < 2**64:
        raise ValueError(f"seed: found {seed!r}, expected a whole number of at most 64 bits")
    words = int(seed) % 2**64
    return np.array([words >> 32], np.uint32), np.array([words % 2**32], np.uint32)


def row_key(words: Words) -> UInt64[np.ndarray, "..."]:
    """The key of a row of two words."""
    return (words[0].astype(np.uint64) << np.uint64(32)) | words[1]


def random_words(keys: UInt64[Array, " k"], count: int) -> UInt64[Array, "k count"]:
    """`count` words for each of k keys."""
    x = keys[:, None] + _GOLDEN * (jnp.arange(count, dtype=jnp.uint64) + np.uint64(1))
    for shift, factor in _MIXED:
        x = (x ^ (x >> np.uint64(shift))) * factor
    return x ^ (x >> np.uint64(31))


def uniform(words: UInt64[Array, "..."]) -> Float[Array, "..."]:
    """Rectangular numbers (i + 1/2) / 2^52 between 0 and 1, one per word."""
    wide = jax.lax.bitcast_convert_type((words >> np.uint64(12)) | _ONE, jnp.float64)
    return wide - (1.0 - 2.0**-53)


def normal(words: UInt64[Array, "..."]) -> Float[Array, "..."]:
    """N(0, 1) numbers, one per word; the largest possible one is 6.8."""
    log_square, cosine = polar(words)
    return jnp.sqrt(log_square) * cosine


def polar(words: UInt64[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """-2 ln u and cos(2 pi v) of independent rectangular u and v between 0 and 1, by word.

    sqrt(nu (exp(-2 ln u / nu) - 1)) cos(2 pi v) has Student's t distribution.
    """
    u = _signed(words >> np.uint64(32)) + (0.5 + 2.0**-33)
    return -2.0 * _log(u), _cosine(_signed(words))


def _signed(words: UInt64[Array, "..."]) -> Float[Array, "..."]:
    """The lower 32 bits as i / 2^32 with whole i, from -1/2 up to but less than 1/2."""
    low = jax.lax.bitcast_convert_type(words.astype(jnp.uint32), jnp.int32)
    return low.astype(jnp.float64) * 2.0**-32


def _log(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Natural logarithm of normal numbers, with a relative error below 3e-10 up to x = 1."""
    bits = jax.lax.bitcast_convert_type(x, jnp.uint64)
    # The exponent, plus 1024, for which the fraction is in [sqrt(1/2), sqrt(2)).
    exponent = (bits + _ABOVE_ROOT) >> np.uint64(52)
    fraction = jax.lax.bitcast_convert_type(bits - (exponent << np.uint64(52)) + _BIAS, jnp.float64)
    # By the bits: processors without a vector instruction for the conversion of whole numbers of 64
    # bits would take them one after the other.
    whole = jax.lax.bitcast_convert_type(exponent | _FIFTY_TWO, jnp.float64) - (2.0**52 + 1024.0)
    beyond = fraction - 1.0
    return whole * math.log(2.0) + beyond * _polynomial(_log_coefficients(), beyond)


def _cosine(turns: Float[Array, "..."]) -> Float[Array, "..."]:
    """cos(2 pi t) for t from -1/2 to 1/2, to 3e-11: the sine of what is left to a quarter."""
    rest = 0.25 - jnp.abs(turns)
    return rest * _polynomial(_sine_coefficients(), rest * rest)


def _polynomial(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    value = coefficients[-1] * x + coefficients[-2]
    for c in coefficients[-3::-1]:
        value = value * x + c
    return value


@functools.cache
def _log_coefficients() -> tuple[float, ...]:
    """Of log(1 + x) / x in powers of x, for 1 + x from sqrt(1/2) to sqrt(2)."""
    low, high = math.sqrt(0.5) - 1.0, math.sqrt(2.0) - 1.0
    return _interpolated(lambda x: np.log1p(x) / x, low, high, 11)


@functools.cache
def _sine_coefficients() -> tuple[float, ...]:
    """Of sin(2 pi t) / t in powers of t^2, for t up to a quarter."""
    return _interpolated(
        lambda s: np.sin(2.0 * np.pi * np.sqrt(s)) / np.sqrt(s), 0.0, 1.0 / 16.0, 5
    )


def _interpolated(
    f: Callable[[np.ndarray], np.ndarray], low: float, high: float, degree: int
) -> tuple[float, ...]:
    """The polynomial through f at the Chebyshev points of an interval, none of them its ends."""
    found = np.polynomial.Chebyshev.interpolate(f, degree, domain=[low, high])
    return tuple(found.convert(kind=np.polynomial.Polynomial).coef.tolist())
