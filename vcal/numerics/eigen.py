"""Eigenvalues of symmetric matrices."""

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike


def eigh(matrices: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (..., n), ascending, and eigenvectors in columns (..., n, n) of symmetric
    matrices.

    Divide and conquer (LAPACK dsyevd, as in numpy) does not converge for a few harmless matrices,
    such as one with several nearly equal eigenvalues; these are solved by QR iterations (dsyev).
    Raises `LinAlgError` where a matrix is not finite.
    """
    matrices = np.asarray(matrices)
    try:
        return np.linalg.eigh(matrices)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrices).all():
            raise
    stack = np.reshape(matrices, (-1, *np.shape(matrices)[-2:]))
    values, vectors = zip(*map(_one, stack), strict=True)
    shape = np.shape(matrices)
    return np.reshape(values, shape[:-1]), np.reshape(vectors, shape)


def _one(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    try:
        return np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        return scipy.linalg.eigh(matrix, driver="ev")
