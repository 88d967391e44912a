"""Checked points of a calibration curve: values, standard uncertainties, covariance matrices."""

from typing import Any

import numpy as np
from jaxtyping import Float


def checked_points(x: Any, y: Any, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the points; raises `ValueError` where they do not suffice for this degree."""
    if not isinstance(degree, int) or degree < 1:
        raise ValueError(f"degree: found {degree!r}, expected a whole number of at least 1")
    found = [vector(name, values) for name, values in (("x", x), ("y", y))]
    if len(found[0]) != len(found[1]):
        raise ValueError(
            f"found {len(found[0])} x and {len(found[1])} y, expected one y for every x"
        )
    different = len(np.unique(found[0]))
    if different <= degree:
        raise ValueError(
            f"x: found {different} different values, expected at least {degree + 1} for a "
            f"polynomial of degree {degree}"
        )
    return found[0], found[1]


def values_with_u(name: str, values: Any, u: Any) -> tuple[np.ndarray, np.ndarray]:
    """One or more values and their standard uncertainties, which may be zero."""
    found = vector(name, np.atleast_1d(values))
    return found, standard_uncertainties(f"u_{name}", u, len(found), zero=True)


def vector(name: str, values: Any) -> Float[np.ndarray, " n"]:
    """Finite numbers (n,)."""
    try:
        found = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: found {values!r}, expected a list of numbers") from error
    if found.ndim != 1:
        raise ValueError(f"{name}: found shape {found.shape}, expected a list (n,)")
    bad = np.flatnonzero(~np.isfinite(found))
    if len(bad):
        raise ValueError(
            f"{name}: found {found[bad[0]]} at position {bad[0]}, expected finite numbers"
        )
    return found


def standard_uncertainties(
    name: str, u: Any, n: int, zero: bool = False
) -> Float[np.ndarray, " n"]:
    """Standard uncertainties (n,) from one number or n, above zero unless `zero` allows it."""
    found = np.asarray(u, float)
    if found.shape not in ((), (n,)):
        raise ValueError(f"{name}: found shape {found.shape}, expected one number or ({n},)")
    found = np.broadcast_to(found, (n,)).copy()
    bad = np.flatnonzero(~np.isfinite(found) | (found < 0.0) | ((found == 0.0) & (not zero)))
    if len(bad):
        raise ValueError(
            f"{name}: found {found[bad[0]]} at position {bad[0]}, expected a finite standard "
            f"uncertainty {'of at least' if zero else 'above'} 0"
        )
    return found


def covariance_matrix(name: str, matrix: Any, n: int) -> Float[np.ndarray, "n n"] | None:
    """A positive definite covariance matrix (n, n), or None without one."""
    if matrix is None:
        return None
    found = np.asarray(matrix, float)
    if found.shape != (n, n):
        raise ValueError(f"{name}: found shape {found.shape}, expected {(n, n)}")
    lower_root(name, found)
    return found


def lower_root(name: str, matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Lower Cholesky factor; raises `ValueError` for a matrix that is no covariance or singular."""
    size = np.sqrt(np.abs(np.diag(matrix)))
    if not (np.isfinite(matrix).all() and (np.diag(matrix) > 0.0).all()):
        raise ValueError(f"{name}: expected finite numbers with variances above 0 on the diagonal")
    scaled = matrix / np.outer(size, size)
    if not np.allclose(scaled, scaled.T, rtol=0.0, atol=1e-9):
        raise ValueError(f"{name}: expected a symmetric matrix")
    try:
        return size[:, None] * np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        smallest = float(np.linalg.eigvalsh(scaled)[0])
        raise ValueError(
            f"{name}: the correlations cannot all hold, or leave a combination without "
            f"uncertainty: the smallest eigenvalue is {smallest:.3g}, expected it above 0"
        ) from None
