"""Skewness and excess kurtosis of the values of a Monte Carlo."""

import numpy as np
from jaxtyping import Float

from .quantile_counts import Column


def shape_of_values(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """g_1 = m_3 / m_2^(3/2) and g_2 = m_4 / m_2^2 - 3 with m_j the central moments.

    Both are zero for a normal distribution; NaN for values that do not vary.
    """
    return _shape(values, np.full(len(values), 1.0 / max(len(values), 1)))


def shape_of_counts(column: Column) -> tuple[float, float]:
    """The same from counts in fine bins, with every value in the middle of its bin."""
    middle = 0.5 * (column.edges[1:] + column.edges[:-1])
    counts = np.diff(column.total).astype(float)
    filled = counts > 0.0
    return _shape(middle[filled], counts[filled] / max(counts.sum(), 1.0))


def _shape(x: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> tuple[float, float]:
    if not len(x):
        return np.nan, np.nan
    apart = x - weight @ x
    size = np.abs(apart).max()
    if not size > 1e-13 * np.abs(x).max():
        return np.nan, np.nan
    apart = apart / size  # no overflow of fourth powers
    second, third, fourth = (float(weight @ apart**j) for j in (2, 3, 4))
    return third / second**1.5, fourth / second**2 - 3.0
