"""The response of the closed loop to a circle, by the sampled frequency response of the plant.

A force that is held between samples is a sum of harmonics of the sampling frequency, and so is the
response of the plant. With s_k = i (omega + 2 pi k / T), the delay tau and
G(s) = (s^2 M + s D + K)^-1 B,

    P = sum_k G(s_k) c_k,    c_k = exp(-s_k tau) (1 - exp(-s_k T)) / (s_k T),

is the response of the plant at the samples per force F exp(i omega t) (Poisson summation; Astrom,
Wittenmark 1997, ch. 7). `steady` computes the sum over all k exactly. Far above the natural
frequencies the plant behaves like free masses, G = M^-1 B / s^2, for which the sum is known. Only
the difference is summed, which needs few k. The method solves systems of the size of the degrees of
freedom instead of an exponential, so that derivatives by many parameters take a tenth of the time.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ..numerics.arrays import Array
from .control import Controller
from .structure import Structure

_LOST = 1e-7
"""Largest share of the omitted harmonics in the response of the plant."""
_MOST = 64


def harmonics(structure: Structure, controller: Controller, omega: float) -> int | None:
    """Number of harmonics on both sides that `response` needs for seven digits of the error at an
    angular velocity; None where even 64 are too few.

    Beyond the fastest mode, they decrease with the fourth power of their number. A compliant
    machine with heavy motors needs one harmonic; a machine whose modes are faster than the sampling
    needs dozens.
    """
    T = float(controller.sample_time)
    M, D, K, B = (
        np.asarray(part)
        for part in (structure.mass, structure.damping, structure.stiffness, structure.force)
    )
    scale = np.asarray(structure.scale)
    place = ["XYZ".index(axis) for axis in structure.axes]
    rows = np.concatenate([scale, np.asarray(structure.tool)[place] - scale])
    free = rows @ np.linalg.solve(M, B)

    def added(number: np.ndarray) -> np.ndarray:
        """Contribution (k, rows, axes) of harmonics in addition to that of free masses."""
        s = 1j * (omega + 2.0 * np.pi / T * number)[:, None, None]
        held = (1.0 - np.exp(-s * T)) / (s * T)
        return held * (rows @ np.linalg.solve(s * s * M + s * D + K, B[None]) - free / s**2)

    s = 1j * omega
    whole = np.abs(rows @ np.linalg.solve(s * s * M + s * D + K, B))
    size = np.repeat([part.max() for part in np.split(whole, 2)], len(scale))[:, None]
    number = 1
    while number <= _MOST:
        beyond = np.arange(number + 1, 4 * number + 1)
        left = sum(np.abs(added(sign * beyond)).sum(0) for sign in (-1.0, 1.0))
        if (left <= _LOST * size).all():
            return number
        number *= 2
    return None


def response(
    structure: Structure, controller: Controller, omega: Float[Array, ""] | float, aliases: int = 1
) -> tuple[Complex[Array, "axes axes"], Complex[Array, "3 axes"]]:
    """Response of the scales, and of the tool point relative to them, per set position
    exp(i omega t) of every axis.

    `aliases` is the number of harmonics of the sampling frequency on both sides.
    """
    T, tau = controller.sample_time, controller.delay
    s = 1j * (omega + 2.0 * jnp.pi / T * jnp.arange(-aliases, aliases + 1))
    held = jnp.exp(-s * tau) * (1.0 - jnp.exp(-s * T)) / (s * T)
    rows = jnp.concatenate([structure.scale, structure.pace, structure.tool])
    plant = _plant(structure.mass, structure.damping, structure.stiffness, structure.force, rows, s)
    free = rows @ jnp.linalg.solve(structure.mass, structure.force)
    # A free mass from sample to sample: the force of d + 1 samples ago acts for `part`, then that
    # of d samples ago.
    d = jnp.floor(jax.lax.stop_gradient(tau) / T)
    part = tau - d * T
    new = jnp.exp(-1j * omega * T * d)
    old = new * jnp.exp(-1j * omega * T)
    lead = jnp.expm1(1j * omega * T)
    pushed = (part * old + (T - part) * new) / lead
    shifted = part * (T - 0.5 * part) * old + 0.5 * (T - part) ** 2 * new
    travelled = (T * pushed + shifted) / lead
    moved = jnp.einsum("k,kra->ra", held, plant)
    moving = jnp.einsum("k,kra->ra", s * held, plant)
    moved = moved + (travelled - (held / s**2).sum()) * free
    moving = moving + (pushed - (held / s).sum()) * free
    axes = len(structure.axes)
    scale, pace, tool = moved[:axes], moving[axes : 2 * axes], moved[2 * axes :]
    # F = g e with the integrator's I[k+1] = I[k] + T e / Tn; e = Kv (r - scale F) + f v - pace F.
    g = controller.velocity_gain * (1.0 + T / controller.integral_time / lead)
    asked = controller.position_gain + 1j * omega * controller.feed_forward
    loop = jnp.diag(1.0 / g) + controller.position_gain[:, None] * scale + pace
    force = jnp.linalg.solve(loop, jnp.diag(asked))
    read = scale @ force
    place = jnp.array(["XYZ".index(axis) for axis in structure.axes])
    return read, jnp.asarray(tool @ force).at[place].add(-read)


@jax.custom_jvp
def _plant(M: Array, D: Array, K: Array, B: Array, C: Array, s: Array) -> Array:
    """C (s^2 M + s D + K)^-1 B for every s: (k, rows, axes)."""
    return C @ _inverse(M, D, K, s) @ B


def _inverse(M: Array, D: Array, K: Array, s: Array) -> Array:
    s = s[:, None, None]
    return jnp.linalg.inv(s * s * M + s * D + K)


@_plant.defjvp
def _(primals, tangents):
    # With L = C A^-1 and R = A^-1 B, the tangent is dC R + L (dB - dA R). These products of a few
    # rows and columns replace many solutions.
    (M, D, K, B, C, s), (dM, dD, dK, dB, dC, ds) = primals, tangents
    inverse = _inverse(M, D, K, s)
    L, R = C @ inverse, inverse @ B
    k, n, axes = R.shape
    table = jnp.moveaxis(R, 0, 1).reshape(n, k * axes)
    table = jnp.concatenate([table.real, table.imag], axis=1)

    def bent(tangent: Array) -> Array:
        real, imaginary = jnp.split(tangent @ table, 2, axis=1)
        return jnp.moveaxis((real + 1j * imaginary).reshape(n, k, axes), 0, 1)

    s, ds = s[:, None, None], ds[:, None, None]
    off = s * s * bent(dM) + s * bent(dD) + bent(dK)
    off = off + ds * (2.0 * s * (M @ R) + D @ R)
    return C @ R, dC @ R + L @ (dB - off)
