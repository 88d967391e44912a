"""Test of declared prior sizes against their posterior.

Where a machine is as declared, the posterior means theta of its declared errors, in units of their
prior standard deviations, are distributed about zero with the covariance I - V, V the posterior
covariance. With the eigenvalues e and eigenvectors u of I - V, the noise s in units of the declared
noise, and d = e / (1 - e) the information of the data along u,

    z = u'theta / sqrt(e),        var z = (d + s^2) / (d + 1),

and the sum of z^2 / var z over the directions that the data determine (e > 1/2) has the chi-square
distribution.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from ..machine.parameters import Parameter
from ..numerics.eigen import eigh
from .fit import Fit

_DETERMINED = 0.5
"""Least share of information from the data of a direction that is tested."""
_MISFIT = 1e-3
"""p-value below which declared sizes do not fit."""
_NOTABLE = 1.3
"""Least ratio of the observed to the declared sizes that counts as a misfit."""
GROSS = 20.0
"""Declared standard deviations beyond which an error is no error of the declared machine: its
numbers, or a column of the data, are wrong."""


@dataclass(frozen=True)
class DeclaredSizes:
    """The declared sizes of errors against what the data say about them."""

    statistic: float
    """Sum of the squared standardised means."""
    directions: int
    """Number of directions that the data determine."""
    p_value: float
    """Probability of a larger statistic where the sizes are as declared; one where there are no
    directions to test."""
    largest: tuple[tuple[str, Parameter, float, float], ...]
    """(effect, parameter, posterior mean in declared standard deviations, the same in the unit of
    the parameter) of the errors farthest outside, largest first."""

    @property
    def ratio(self) -> float:
        """Root mean square of the observed over the declared sizes."""
        return math.sqrt(self.statistic / self.directions) if self.directions else 1.0

    @property
    def misfit(self) -> bool:
        """Whether the errors are significantly larger than declared."""
        return (self.p_value < _MISFIT and self.ratio > _NOTABLE) or self.gross

    @property
    def gross(self) -> bool:
        """Whether an error is so far outside its declared size that the machine is another one."""
        return bool(self.largest) and abs(self.largest[0][2]) > GROSS

    @property
    def far(self) -> tuple[tuple[str, Parameter, float, float], ...]:
        """The errors that are grossly outside."""
        return tuple(one for one in self.largest if abs(one[2]) > GROSS)


def declared_sizes(fit: Fit, places: Sequence[int], noise: float = 1.0) -> DeclaredSizes:
    """The test for the amplitudes of the effects at `places` of the model, with proper priors.

    `noise` is the scatter of the readings in units of the noise of the fit. The parameters of
    random effects and known ones take no part.
    """
    own = [k for i in places for k in fit.places_of(i)[0].tolist()]
    tested = np.array([k for k in own if fit.precision[k] > 0.0], int)
    if not len(tested):
        return DeclaredSizes(0.0, 0, 1.0, ())
    theta, inverse = fit.theta[tested], fit.planned_covariance[np.ix_(tested, tested)]
    shares, directions = eigh(np.eye(len(tested)) - inverse)
    kept = shares > _DETERMINED
    share = np.minimum(shares[kept], 1.0 - 1e-15)
    data = share / (1.0 - share)
    variance = (data + max(noise, 1.0) ** 2) / (data + 1.0)
    z2 = (directions[:, kept].T @ theta) ** 2 / share / variance
    statistic, count = float(z2.sum()), int(kept.sum())
    order = tested[np.argsort(-np.abs(theta))]
    # Beyond its own uncertainty: a parameter that the data do not determine is not outside.
    largest = tuple(
        (key, p, float(fit.theta[k]), float(fit.theta[k]) * p.step / p.si)
        for k in order[:6].tolist()
        for key, p in [fit.entries[k]]
    )
    return DeclaredSizes(
        statistic, count, float(chdtrc(count, statistic)) if count else 1.0, largest
    )
