"""Gains of controllers from the physical parameters of a machine."""

import jax
import numpy as np
from jaxtyping import Float

from ..numerics.arrays import Array
from .closed_loop import check_sampled, controlled
from .control import Controller
from .structure import Structure

_MARGIN = 2.0
"""Gain margin of the velocity loop."""
_BANDWIDTHS = np.geomspace(3000.0, 20.0, 61)
"""Bandwidths, rad/s, tried in descending order."""


def propose(
    structure: Structure,
    *,
    position_gain: Float[Array | np.ndarray, " axes"] | None = None,
    bandwidth: Float[Array | np.ndarray, " axes"] | None = None,
    integral_time: Float[Array | np.ndarray, " axes"] | None = None,
    feed_forward: float = 0.0,
    delay: float = 0.0,
    sample_time: float = 1e-3,
) -> Controller:
    """A controller whose missing gains follow from the physical parameters of the machine.

    The bandwidth is the largest one at which the velocity loops of all axes are stable at twice
    their gain, and at most a fifth of the sampling rate. Tn = 4 / w_v and Kv = w_v / 4 give
    critical damping of the position loop of a rigid mass. Raises `ValueError` where no bandwidth is
    low enough, and where the sample time is too long for the machine.
    """

    def controller(w: Array, factor: float = 1.0) -> Controller:
        return Controller.of(
            structure,
            position_gain=w / 4.0 if position_gain is None else position_gain,
            bandwidth=factor * w,
            integral_time=4.0 / w if integral_time is None else integral_time,
            feed_forward=feed_forward,
            delay=delay,
            sample_time=sample_time,
        )

    if bandwidth is not None:
        return controller(bandwidth)
    check_sampled(structure, sample_time)
    transition = jax.jit(lambda w: controlled(structure, controller(w, _MARGIN)).transition)
    for w in _BANDWIDTHS[_BANDWIDTHS * sample_time <= 0.2 * 2.0 * np.pi]:
        after = np.asarray(transition(w))
        if np.abs(np.linalg.eigvals(after)).max() < 1.0:
            return controller(w)
    do = "shorten the delay, stiffen the machine, or give the gains"
    if structure.undamped:
        do = f"declare the damping of the springs, which have none, or {do}"
    raise ValueError(
        f"[controller]: found no bandwidth down to {_BANDWIDTHS[-1]:g} rad/s with which the loop "
        f"is stable at twice its gain, expected one; {do}"
    )
