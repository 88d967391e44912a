"""Anderson acceleration: the last steps of an iteration, combined into one.

An iteration takes the step f(theta) from theta. Its last moves are d_1, ..., d_s, and each move d_i
has changed f by c_i. If f were linear, the next step would be the shortest from

    theta + f - sum_i w_i (d_i + c_i),      w = argmin |f - sum_i w_i c_i|

(Anderson 1965, J. ACM 12, 547). A linear iteration in k dimensions ends after k independent moves.
Length is measured as the caller chooses; Gauss-Newton uses the change of the residual, |J f|.

There are two implementations, because no single one suits both callers without changing results.
`anderson_step` runs in numpy on the host; it solves for w by singular values, in LAPACK.
`anderson_step_traced` is part of a compiled program that is mapped over many problems. Singular
values would add a library call per problem and lengthen the compilation of every solver; it
orthogonalises the few changes one after the other instead. Both give the same step up to rounding
where the changes are independent.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .arrays import Array

_RANK = 1e-6
"""Singular value, relative to the largest, below which changes are equal except for rounding."""
_DEPENDENT = 1e-5
"""Share of a change outside the span of the others below which that share is rounding."""


def anderson_step(
    step: Float[np.ndarray, " k"],
    moved: Float[np.ndarray, "k s"],
    changed: Float[np.ndarray, "k s"],
) -> Float[np.ndarray, " k"]:
    """The combined step, in coordinates whose Euclidean length is the length that is minimised.

    `step` (k,) is the step from here, `moved` (k, s) the last moves, `changed` (k, s) the change of
    the step with each of them; all have one unit. The combination w is the shortest one where the
    changes depend on each other. Without moves (s = 0) the step is returned as it is.
    """
    weights = np.linalg.lstsq(changed, step, rcond=_RANK)[0]
    return step - (moved + changed) @ weights


def anderson_step_traced(
    step: Float[Array, " p"],
    moved: Float[Array, "s p"],
    changed: Float[Array, "s p"],
    step_image: Float[Array, " k"],
    changed_image: Float[Array, "s k"],
) -> Float[Array, " p"]:
    """The same in a compiled program, with the length given by images of the vectors.

    `step` (p,), `moved` (s, p) and `changed` (s, p) are in any coordinates. `step_image` (k,) and
    `changed_image` (s, k) are a linear map of step and changes; the Euclidean length of an image is
    the length that is minimised. The changes are orthogonalised in the order of their rows
    (Gram-Schmidt). A change that depends on those before it is left out, and so is a row of zeros.
    """
    found, known, rows = step, [], moved + changed
    for i in range(len(moved)):
        column, row, size = changed_image[i], rows[i], _length(changed_image[i])
        for other, its in known:
            share = other @ column
            column, row = column - share * other, row - share * its
        left = _length(column)
        # What is next to nothing except for the others is rounding.
        scale = jnp.where(left > _DEPENDENT * size, 1.0 / jnp.where(left > 0.0, left, 1.0), 0.0)
        known.append((column * scale, row * scale))
        found = found - (known[-1][0] @ step_image) * known[-1][1]
    return found


def _length(vector: Float[Array, " k"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(vector**2, axis=0))
