"""Covariance matrices: checks, and their square root."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..numerics.eigen import eigh

# Tolerance, due to rounding, of the symmetry and of a zero eigenvalue of a computed matrix.
_ROUNDING = 1e-10
# Eigenvalues of a correlation matrix per row, below which they are zero.
_SINGULAR = 1e-14


def covariance_matrix(what: str, matrix: Any, size: int) -> Float[np.ndarray, "d d"]:
    """`matrix` (d, d), checked to be a covariance matrix, which may be semi-definite.

    Raises `ValueError` for a wrong size, a value that is not finite, a negative variance, an
    asymmetry, or an eigenvalue below zero, which is stated.
    """
    found = _square(what, matrix, size)
    variance = np.diag(found)
    if (variance < 0.0).any():
        i = int(np.argmin(variance))
        raise ValueError(
            f"{what}: found the variance {variance[i]} at position {i} of the diagonal, expected "
            "none below 0"
        )
    std = np.sqrt(variance)
    scale = np.where(std > 0.0, std, 1.0)
    correlation = found / np.outer(scale, scale)
    known = std == 0.0
    if np.any(correlation[known]):
        i = int(np.flatnonzero(known & correlation.any(1))[0])
        raise ValueError(
            f"{what}: found a variance of 0 at position {i} with covariances that are not 0, "
            "expected none with a quantity that does not vary; correct the one or the other"
        )
    np.fill_diagonal(correlation, 1.0)
    _check(what, correlation)
    return 0.5 * (found + found.T)


def correlation_matrix(
    what: str, matrix: Any, size: int, names: Sequence[str] = ()
) -> Float[np.ndarray, "d d"]:
    """`matrix` (d, d), checked to be a correlation matrix, which may be semi-definite.

    `names` are those of its rows, for the message. Raises `ValueError` for a wrong size, a value
    that is not finite or outside [-1, 1], a diagonal that is not one, an asymmetry, or an
    eigenvalue below zero, which is stated.
    """
    found = _square(what, matrix, size)
    if np.abs(np.diag(found) - 1.0).max() > _ROUNDING:
        i = int(np.argmax(np.abs(np.diag(found) - 1.0)))
        raise ValueError(
            f"{what}: found {found[i, i]} at position {i} of the diagonal, expected 1; divide a "
            "covariance by both of the standard deviations"
        )
    if np.abs(found).max() > 1.0 + _ROUNDING:
        i, j = np.unravel_index(np.argmax(np.abs(found)), found.shape)
        raise ValueError(
            f"{what}: found {found[i, j]} at position ({i}, {j}), expected a correlation from -1 "
            "to 1"
        )
    _check(what, found, names)
    return 0.5 * (found + found.T)


def square_root(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """A with A A' = covariance: the symmetric root of the correlations, in standard deviations.

    The symmetric root is unique, so draws made with it do not depend on the arbitrary signs and
    order of a decomposition; and it exists for semi-definite matrices.
    """
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    values, vectors = eigh(covariance / np.outer(scale, scale))
    # The root of a rounding error is eight digits larger: a singular matrix must stay singular.
    values = np.where(values > _SINGULAR * len(values), values, 0.0)
    return std[:, None] * ((vectors * np.sqrt(values)) @ vectors.T)


def _square(what: str, matrix: Any, size: int) -> Float[np.ndarray, "d d"]:
    try:
        found = np.array(matrix, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{what}: found rows that differ in length, or something other than numbers, expected "
            f"a matrix ({size}, {size})"
        ) from error
    if found.shape != (size, size):
        raise ValueError(
            f"{what}: found shape {found.shape}, expected ({size}, {size}), one row and one column "
            "for every element"
        )
    if not np.isfinite(found).all():
        i, j = np.argwhere(~np.isfinite(found))[0]
        raise ValueError(
            f"{what}: found {found[i, j]} at position ({i}, {j}), expected finite numbers"
        )
    return found


def _check(what: str, correlation: Float[np.ndarray, "d d"], names: Sequence[str] = ()) -> None:
    skew = np.abs(correlation - correlation.T)
    if skew.max() > _ROUNDING:
        i, j = np.unravel_index(np.argmax(skew), skew.shape)
        raise ValueError(
            f"{what}: not symmetric: the elements ({i}, {j}) and ({j}, {i}) differ by "
            f"{skew[i, j]:.3g} as correlations, expected the same value in both places"
        )
    smallest = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0])
    if smallest < -_ROUNDING:
        of = f" of {', '.join(names)}" if names else ""
        raise ValueError(
            f"{what}: the correlations{of} cannot all hold: the smallest eigenvalue of their "
            f"matrix is {smallest:.3g}, expected none below 0 (positive semi-definite); make them "
            "smaller, or state the ones that are missing"
        )
