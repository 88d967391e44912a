"""Quasi-static compliance: how a structure bends under its own inertial forces.

Accelerated so slowly that no mode is excited, every body moves with the acceleration of its axis,
q'' = R a with R the rigid motion of the axes. What is left, K q = B F - M R a, is solved for the
deflection and for the forces F that keep the scales at zero: one linear system. The displacement of
the tool point against the scales is E a.
"""

import jax.numpy as jnp
from jaxtyping import Float

from ..numerics.arrays import Array
from .structure import Structure


def compliance(structure: Structure) -> Float[Array, "3 axes"]:
    """E, m per m/s^2: in-talk on the diagonal, cross-talk beside it, columns by axis.

    For one body with its drive h beside the centre of gravity and the tool at a lever L along the
    drive, E = m h L / k_phi across, with k_phi = sum k_i r_i^2.
    """
    n, axes = structure.size, len(structure.axes)
    # Stiffness in N/m and readings in m: brought to one size, or the system is badly conditioned.
    size = jnp.trace(structure.stiffness) / n
    whole = jnp.block(
        [
            [structure.stiffness / size, -structure.force],
            [structure.scale, jnp.zeros((axes, axes))],
        ]
    )
    inertia = -structure.mass @ structure.travel / size
    found = jnp.linalg.solve(whole, jnp.concatenate([inertia, jnp.zeros((axes, axes))]))
    return structure.tool @ found[:n]
