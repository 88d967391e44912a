"""Residuals in units of the declared noise, whatever noise a fit is with."""

import numpy as np
from jaxtyping import Bool, Float

from ..declared_noise import declared_whitener
from ..fit import Fit


def declared_residual(fit: Fit) -> Float[np.ndarray, "n m"]:
    """W (y - h) of every row, also of those that were left out."""
    whitener = declared_whitener(fit.model, fit.measurement)
    return np.einsum("nij,nj->ni", whitener, fit.residual)


def declared_chi2(fit: Fit, rows: Bool[np.ndarray, " n"] | None = None) -> float:
    """Sum of their squares over the rows that were used, or over these."""
    return float((declared_residual(fit)[fit.used if rows is None else rows] ** 2).sum())
