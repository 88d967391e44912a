"""The type of an array: of JAX inside a compiled function, of numpy outside."""

import jax
import numpy as np

Array = jax.Array | np.ndarray
"""What every function takes; what it gives is a JAX array where JAX computed it."""
