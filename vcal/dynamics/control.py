"""Cascaded PPI control: position P, velocity PI, sampled.

    v_c = Kv (z_s - z_m) + f v_s,    F = Kp (e + I),    e = v_c - v_m,    I' = e / Tn

for every axis, with z the position, v the velocity, s set and m measured (Zirn, Weikert 2006). The
position is that of the scale; the velocity is that of the motor for a drive with a screw. The force
acts one delay after the sample.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from ..numerics.arrays import Array
from .structure import Structure


class Controller(eqx.Module):
    """Gains of all axes, each an array (axes,).

    Raises `ValueError` for a delay below zero, and for one of two sample times or more, as only the
    forces of two samples are stored.
    """

    position_gain: Float[Array, " axes"]
    """Kv, 1/s."""
    velocity_gain: Float[Array, " axes"]
    """Kp, N s/m."""
    integral_time: Float[Array, " axes"]
    """Tn, s."""
    feed_forward: Float[Array, " axes"]
    """Share f of the set velocity that is added to the velocity command."""
    delay: Float[Array, ""]
    """Delay from a sample to its force, s; less than two sample times."""
    sample_time: float = eqx.field(static=True)
    """Sample time, s."""

    def __check_init__(self):
        if isinstance(self.delay, Tracer):
            return
        delay, T = np.asarray(self.delay), self.sample_time
        if not (T > 0.0 and (delay >= 0.0).all() and (delay < 2.0 * T).all()):
            raise ValueError(
                f"controller: found a delay of {1e3 * delay} ms at a sample time of {1e3 * T:g} "
                "ms, expected at least zero and less than two sample times; correct one of them"
            )

    @classmethod
    def of(
        cls,
        structure: Structure,
        *,
        position_gain: Float[Array | np.ndarray, " axes"] | float,
        bandwidth: Float[Array | np.ndarray, " axes"] | float,
        integral_time: Float[Array | np.ndarray, " axes"] | float,
        feed_forward: Float[Array | np.ndarray, " axes"] | float = 0.0,
        delay: float = 0.0,
        sample_time: float = 1e-3,
    ) -> "Controller":
        """A controller from the bandwidth w_v of the velocity loop, rad/s: Kp = m w_v, with m the
        mass that the drive moves.
        """
        count = len(structure.axes)

        def each(value: Float[Array | np.ndarray, " axes"] | float) -> Array:
            return jnp.broadcast_to(jnp.asarray(value, float), (count,))

        return cls(
            each(position_gain),
            structure.moved_mass * each(bandwidth),
            each(integral_time),
            each(feed_forward),
            jnp.asarray(delay, float),
            sample_time,
        )
