"""Steps of an iteration that converges linearly, taken together."""

import numpy as np
from jaxtyping import Float

_ALIKE = 1e-6
"""Singular value, relative to the largest, below which changes are the same but for rounding."""


def anderson_step(
    step: Float[np.ndarray, " k"],
    moved: Float[np.ndarray, "k s"],
    changed: Float[np.ndarray, "k s"],
) -> Float[np.ndarray, " k"]:
    """The step to where the next one would be the shortest, were it linear in the place: the last
    moves, and how the step has changed by each (Anderson 1965, J. ACM 12, 547).
    """
    weights = np.linalg.lstsq(changed, step, rcond=_ALIKE)[0]
    return step - (moved + changed) @ weights
