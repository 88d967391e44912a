"""Readings that do not belong: single rows far outside what all the others say."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import gammainccinv

from ..fit import Fit
from .screen import minus_log_chi2_tail

_CHANCE = 1e-3
"""Probability that any row of a clean measurement is suspected."""
_MOST = 0.01
"""More suspected rows than this share are a structure, not stray readings."""


@dataclass(frozen=True)
class Stray:
    """A suspected reading."""

    row: int
    distance: float
    """Mahalanobis distance of the row's residual, in robust standard deviations."""
    p_value: float


def stray_rows(fit: Fit) -> list[Stray]:
    """Rows whose own residual has a probability below 1e-3 / rows, given the robust scale of all.

    The residual of a row is taken with the covariance it has in the fit, I - J_i H^-1 J_i'; the
    scale is that of its data set. None of a data set where more than 1 % of its rows stand out:
    that is something systematic.
    """
    n, m = fit.residual.shape
    jacobian = fit.jacobian.reshape(n, m, -1)
    whitened = fit.whitened.reshape(n, m)
    solved = cho_solve(fit.factor, fit.jacobian.T).T.reshape(n, m, -1)
    own = np.eye(m) - np.einsum("nik,njk->nij", jacobian, solved)
    strays = []
    for inside in fit.measurement.plan.parts.values():
        rows = np.flatnonzero(fit.used & inside)
        if not len(rows):
            continue
        readings = fit.counted[rows[0]].sum()
        distance = np.einsum(
            "ni,ni->n", whitened[rows], np.linalg.solve(own[rows], whitened[rows, :, None])[:, :, 0]
        )
        median = 2.0 * gammainccinv(0.5 * readings, 0.5)
        scaled = distance / max(np.median(distance) / median, 1e-30)
        minus_log_p = minus_log_chi2_tail(scaled, readings)
        found = np.flatnonzero(minus_log_p > -np.log(_CHANCE / fit.used.sum()))
        if len(found) > max(3, _MOST * len(rows)):
            continue
        strays += [
            Stray(int(rows[i]), float(np.sqrt(scaled[i])), float(np.exp(-minus_log_p[i])))
            for i in found
        ]
    return strays
