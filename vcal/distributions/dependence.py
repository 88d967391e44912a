"""What a stated correlation means for quantities that are not normal.

A Gaussian copula couples normal scores Z_i, X_i = F_i^-1(Phi(Z_i)). Measures of dependence of the
quantities follow from the correlation r of the scores:

    Spearman's rank correlation    6/pi arcsin(r / 2)
    Kendall's rank correlation     2/pi arcsin(r)
    product-moment correlation     sum_n c_n c'_n r^n,  c the margins' Hermite coefficients

(Kruskal 1958, Journal of the American Statistical Association 53, 814; Mehler's series, `scores`).
All three grow with r, so that r follows from any of them.
"""

import math
from typing import Literal

import numpy as np

from .base import Univariate

Measure = Literal["scores", "product_moment", "spearman", "kendall"]
"""Of what a correlation is stated: of the normal scores, or one of the measures above."""
MEASURES: tuple[Measure, ...] = ("scores", "product_moment", "spearman", "kendall")
_ORDER = 1024
_HALVINGS = 60


def score_correlation(
    stated: float, measure: Measure, first: Univariate, second: Univariate, pair: str
) -> float:
    """The correlation r of the normal scores of a pair for a stated measure of dependence.

    Raises `ValueError` for an unknown measure, a rank correlation of discrete quantities, and a
    product-moment correlation that the two distributions cannot have (with the range).
    """
    if measure not in MEASURES:
        raise ValueError(
            f"correlation_of: found {measure!r}, expected one of {', '.join(map(repr, MEASURES))}"
        )
    if measure == "scores":
        return stated
    if measure == "product_moment":
        return _from_product_moment(stated, first, second, pair)
    ties = [d.name for d in (first, second) if d.discrete]
    if ties:
        raise ValueError(
            f"correlation: found a rank correlation for {pair}, of which one is {ties[0]}, whose "
            "values have ties; state the product-moment correlation"
        )
    if measure == "kendall":
        return math.sin(0.5 * math.pi * stated)
    return 2.0 * math.sin(math.pi * stated / 6.0)


def _from_product_moment(stated: float, first: Univariate, second: Univariate, pair: str) -> float:
    if all(d.kinds == ("normal",) for d in (first, second)) or stated == 0.0:
        return stated
    c = np.asarray(first.score_series(_ORDER)) * np.asarray(second.score_series(_ORDER))
    powers = np.arange(1, _ORDER + 1)

    def moment(r: float) -> float:
        return float(c @ r**powers)

    low, high = moment(-1.0), moment(1.0)
    # The series ends early: its value at r = 1 is slightly below the one that can be attained.
    if not low - 1e-9 <= stated <= high + 1e-9:
        raise ValueError(
            f"correlation: found {stated} for {pair}, expected a product-moment correlation from "
            f"{low:.3f} to {high:.3f}, beyond which these distributions cannot be correlated by a "
            "Gaussian copula; state a rank correlation, or change the distributions"
        )
    left, right = -1.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (left + right)
        left, right = (middle, right) if moment(middle) < stated else (left, middle)
    return 0.5 * (left + right)
