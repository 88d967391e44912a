"""The type of an array: of JAX inside a compiled function, of numpy outside."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray
"""What every function takes; what it gives is a JAX array where JAX computed it."""


def namespace(*values: Any) -> Any:
    """The functions to use on these values: those of `jax.numpy` where one of them is an array of
    JAX, traced or not, else those of `numpy`, which have nothing to compile for a new shape.
    """
    return jnp if any(isinstance(value, jax.Array) for value in values) else np
