"""The type of an array: of JAX inside a compiled function, of numpy outside."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Array = jax.Array | np.ndarray
"""What every function takes; what it gives is a JAX array where JAX computed it."""


def array(values: Any) -> Any:
    """Values as an array: those that have a shape, traced or not, as they are."""
    return values if hasattr(values, "shape") else np.asarray(values)


def arrays(table: Mapping[str, Any]) -> dict[str, Any]:
    """The same of every column of a table."""
    return {name: array(values) for name, values in table.items()}


def known(values: Any) -> bool:
    """Whether there are numbers: not where a value is traced, or only its shape stands for it."""
    return isinstance(values, np.ndarray | jax.Array) and not isinstance(values, Tracer)


def namespace(*values: Any) -> Any:
    """The functions to use on these values: those of `jax.numpy` where one of them is an array of
    JAX, traced or not, else those of `numpy`, which have nothing to compile for a new shape.
    """
    return jnp if any(isinstance(value, jax.Array) for value in values) else np
