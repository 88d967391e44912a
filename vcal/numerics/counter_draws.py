"""Random numbers by counters: many rows at once, each from a key of its own.

    bits of number i of a row = threefry2x32(key of the row, i)       (Salmon et al. 2011, SC'11)

The 20 rounds are those of `jax.random`, written so that the compiler fuses them with what uses the
numbers. A call gives 64 bits, hence two numbers with 32 bits each: u = (i + 1/2) / 2^32, a
resolution of 2.3e-10. Normal numbers follow by the transformation of Box and Muller (1958), those
of Student's t by that of Bailey (1994, Mathematics of Computation 62, 779). Logarithm, sine and
cosine are written out in elementary operations, which the compiler computes for several numbers at
once, and which give the same on all devices up to rounding.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray, UInt32, UInt64

from .arrays import Array

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)
_UNIT = 2.0**-32
_QUARTER = 2.0**-30
_FIFTY_TWO = np.uint64(0x4330000000000000)
"""The bits of 2^52, whose last bits are the units."""
_ABOVE_ROOT = np.uint64((1024 << 52) - 0x3FE6A09E667F3BCD)
_BIAS = np.uint64(1024 << 52)

Words = tuple[UInt32[Array, "..."], UInt32[Array, "..."]]


def threefry(key: Words, counter: Words) -> Words:
    """Threefry-2x32 with 20 rounds; key and counter broadcast."""
    ks = (*key, key[0] ^ key[1] ^ _PARITY)
    a, b = counter[0] + ks[0], counter[1] + ks[1]
    for group in range(5):
        for r in _ROTATIONS[group % 2]:
            a = a + b
            b = ((b << np.uint32(r)) | (b >> np.uint32(32 - r))) ^ a
        a = a + ks[(group + 1) % 3]
        b = b + ks[(group + 2) % 3] + np.uint32(group + 1)
    return a, b


def key_words(key: PRNGKeyArray) -> Words:
    """The two words of a key of `jax.random` (threefry2x32), on the host."""
    data = np.asarray(jax.random.key_data(key))
    return data[..., :1], data[..., 1:]


def bits_of(keys: UInt32[Array, "k 2"], count: int) -> Words:
    """Two words for each of `count` numbers of every row."""
    number = jnp.arange(count, dtype=jnp.uint32)
    words = threefry((keys[:, :1], keys[:, 1:]), (number, jnp.zeros_like(number)))
    # Without the barrier, every use of the words would compute all rounds again.
    return jax.lax.optimization_barrier(words)


def uniform_rows(bits: Words) -> Float[Array, "k count"]:
    """Independent numbers, rectangular on (0, 1), two per pair of words."""
    return _side_by_side(_unit(bits[0]), _unit(bits[1]))


def normal_rows(bits: Words) -> Float[Array, "k count"]:
    """Independent N(0, 1) numbers, two per pair of words; the largest possible one is 6.8."""
    radius = jnp.sqrt(-2.0 * _log(_unit(bits[0])))
    cosine, sine = _turn(bits[1])
    return _side_by_side(radius * cosine, radius * sine)


def polar_rows(bits: Words) -> tuple[Float[Array, "k count"], Float[Array, "k count"]]:
    """-2 ln u and cos(2 pi v) of independent rectangular u and v on (0, 1), by pair of words.

    sqrt(nu (exp(-2 ln u / nu) - 1)) cos(2 pi v) has Student's t distribution.
    """
    return -2.0 * _log(_unit(bits[0])), _turn(bits[1])[0]


def _side_by_side(left: Float[Array, "k n"], right: Float[Array, "k n"]) -> Float[Array, "k 2n"]:
    # The compiler computes a concatenation three times slower than a stack, and without the barrier
    # what both sides have in common twice.
    both = jax.lax.optimization_barrier((left, right))
    return jnp.stack(both, axis=1).reshape(len(left), -1)


def _float(whole: UInt64[Array, "..."]) -> Float[Array, "..."]:
    """Whole numbers below 2^52 as float64, by the bits: processors without a vector instruction
    for the conversion would take them one after the other.
    """
    return jax.lax.bitcast_convert_type(whole | _FIFTY_TWO, jnp.float64) - 2.0**52


def _unit(bits: UInt32[Array, "..."]) -> Float[Array, "..."]:
    return (_float(bits.astype(jnp.uint64)) + 0.5) * _UNIT


def _log(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Natural logarithm of normal numbers, to a relative error of 3e-14."""
    bits = jax.lax.bitcast_convert_type(x, jnp.uint64)
    # The exponent, plus 1024, for which the fraction is in [sqrt(1/2), sqrt(2)).
    exponent = (bits + _ABOVE_ROOT) >> np.uint64(52)
    fraction = jax.lax.bitcast_convert_type(bits - (exponent << np.uint64(52)) + _BIAS, jnp.float64)
    s = (fraction - 1.0) / (fraction + 1.0)
    square = s * s
    series = jnp.zeros_like(s) + 1.0 / 15.0
    for odd in range(13, 0, -2):
        series = series * square + 1.0 / odd
    return (_float(exponent) - 1024.0) * math.log(2.0) + 2.0 * s * series


def _turn(bits: UInt32[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Cosine and sine of an angle that is uniform over the circle.

    Two bits are the quarter of the circle, the others the angle within it, from -pi/4 to pi/4.
    The series are cut at an error of 4e-13, a thousandth of the resolution of the angle.
    """
    wide = bits.astype(jnp.uint64)
    rest = _float(wide & np.uint64(0x3FFFFFFF))
    angle = ((rest + 0.5) * _QUARTER - 0.5) * (0.5 * math.pi)
    square = angle * angle
    cosine = jnp.zeros_like(angle) + 1.0 / math.factorial(12)
    for n in range(10, -1, -2):
        cosine = cosine * square + (-1.0) ** (n // 2) / math.factorial(n)
    sine = jnp.zeros_like(angle) + 1.0 / math.factorial(13)
    for n in range(11, 0, -2):
        sine = sine * square + (-1.0) ** (n // 2) / math.factorial(n)
    sine = sine * angle
    odd = (wide & np.uint64(1 << 30)) != 0
    sign = jnp.where((wide & np.uint64(1 << 31)) != 0, -1.0, 1.0)
    return (
        sign * jnp.where(odd, -sine, cosine),
        sign * jnp.where(odd, cosine, sine),
    )
