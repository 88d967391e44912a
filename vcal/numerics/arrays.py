"""Arrays of either library: JAX inside a compiled function, numpy outside."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Array = jax.Array | np.ndarray
"""Type of the array arguments of every function; results are JAX arrays where JAX computed them."""


def array(values: Any) -> Any:
    """Values as an array; values that have a shape, traced or not, are returned as they are."""
    return values if hasattr(values, "shape") else np.asarray(values)


def arrays(table: Mapping[str, Any]) -> dict[str, Any]:
    """`array` of every column of a table."""
    return {name: array(values) for name, values in table.items()}


def known(values: Any) -> bool:
    """Whether the numbers are available: not for a traced value, nor for a mere shape."""
    return isinstance(values, np.ndarray | jax.Array) and not isinstance(values, Tracer)


def namespace(*values: Any) -> Any:
    """The module whose functions suit these values: `jax.numpy` if one of them is an array of JAX,
    traced or not, else `numpy`, which has nothing to compile for a new shape.
    """
    return jnp if any(isinstance(value, jax.Array) for value in values) else np
