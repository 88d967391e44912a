"""The covariance of a choice of measurements, where it determines everything."""

import numpy as np
from jaxtyping import Float

_SURE = 1e12
"""Condition number from which a parameter counts as undetermined."""


def covariance_of(
    precision: Float[np.ndarray, "k k"], *, check: bool = True
) -> Float[np.ndarray, "k k"]:
    """Inverse of a precision, taken with its diagonal scaled to one.

    With `check`, raises `ValueError` where the condition number of what is scaled says that some
    combination of parameters is not determined.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
    units = np.outer(scale, scale)
    scaled = precision * units
    if check and np.linalg.cond(scaled) > _SURE:
        raise ValueError(
            "found measurements that leave a parameter undetermined, expected every parameter to "
            "be seen by some of them or to have a prior; choose more, or add candidates"
        )
    return np.linalg.inv(scaled) * units
