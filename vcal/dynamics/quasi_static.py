"""Quasi-static compliance: the deflection of a structure under its own inertial forces.

With slowly varying acceleration no mode is excited, and every body has the acceleration of its
axis, q'' = R a, with R the rigid motion of the axes. K q = B F - M R a is solved for the deflection
q and for the forces F that keep the scales at zero, as one linear system. The displacement of the
tool point relative to the scales is E a.
"""

import jax.numpy as jnp
from jaxtyping import Float

from ..numerics.arrays import Array
from .structure import Structure


def compliance(structure: Structure) -> Float[Array, "3 axes"]:
    """E, m per m/s^2: in-talk on the diagonal, cross-talk off the diagonal, columns by axis.

    For one body with its drive at a distance h from the centre of gravity and the tool at a lever L
    along the drive, the cross-talk is E = m h L / k_phi, with k_phi = sum k_i r_i^2.
    """
    n, axes = structure.size, len(structure.axes)
    # Stiffness in N/m and readings in m are scaled to one size, as the system is ill-conditioned
    # otherwise.
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
