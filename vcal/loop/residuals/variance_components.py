"""Variance components: the noise of every kind of reading, relative to the declared noise.

    V_i = sum_c f_c^2 V_ic,    c: the components of a reading, and the declared random effects

The factors f_c are estimated by restricted maximum likelihood, iterated as Henderson's and
Forstner's almost unbiased estimate,

    f_c^2 <- f_c^2 (e' V^-1 V_c V^-1 e) / tr(P V_c),    P = V^-1 - V^-1 J H^-1 J' V^-1,

with the residual e of the fit under V and H = J' V^-1 J + L. tr(P V_c) accounts for the degrees of
freedom that the parameters take (Searle, Casella, McCulloch 1992, ch. 8; Forstner 1979).
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import gammaincc

from ...identification.fit import Fit
from ...model.declared_noise import absent, declared_covariances, whitener_of
from ..screening.significance import LEAST_DOF, LEAST_NOISE

_ROUNDS = 100
_SETTLED = 1e-3
_CHANCE = 1e-3
"""Probability by chance below which the factors count as different."""


@dataclass(frozen=True)
class Component:
    """The noise of one kind of reading."""

    name: str
    factor: float
    """Estimated standard deviation over the declared one."""
    u: float
    """Standard uncertainty of `factor`; nan where the readings do not determine it."""


@dataclass(frozen=True)
class Components:
    """The noise of every kind of reading."""

    parts: tuple[Component, ...]
    p_value: float
    """Probability of factors as different as these, if all were equal."""
    declared: np.ndarray
    """Declared covariance of each component for every row (c, n, m, m), SI."""
    absent: np.ndarray
    """Placeholder covariance for readings that a row lacks (n, m, m)."""
    factor: float
    """Estimated standard deviation over the declared one, of all components together."""

    @property
    def uneven(self) -> bool:
        """Whether the factors differ significantly."""
        return self.p_value < _CHANCE

    @property
    def whitener(self) -> np.ndarray:
        """W of every row (n, m, m)."""
        return self._whitener(np.array([part.factor for part in self.parts]))

    @property
    def whitener_at_least_declared(self) -> np.ndarray:
        """W of every row (n, m, m), with no component below its declared noise."""
        return self._whitener(np.array([max(part.factor, 1.0) for part in self.parts]))

    @property
    def whitener_alike(self) -> np.ndarray:
        """W of every row (n, m, m), with one common factor."""
        return self._whitener(np.full(len(self.parts), self.factor))

    def _whitener(self, factors: np.ndarray) -> np.ndarray:
        return whitener_of(np.einsum("c,cnij->nij", factors**2, self.declared) + self.absent)


def components(fit: Fit) -> Components:
    """Variance components of a fit; the parameters are re-estimated with them, linearly."""
    parts = declared_covariances(fit.model, fit.measurement)
    used = fit.used
    each = np.array([v for _, v in parts])[:, used]
    n, m = fit.residual.shape
    back = np.linalg.inv(fit.whitener[used])
    jacobian = back @ fit.jacobian.reshape(n, m, -1)[used]
    missing = absent(fit.model, fit.measurement.plan)
    # A shape parameter that the readings do not determine is confined to its grid.
    precision = fit.within_scans / _stretched(fit)
    problem = _Problem(fit.residual[used], jacobian, fit.theta, precision, missing[used])
    whole, dof, level = problem.estimate(each.sum(0)[None], np.ones(1, bool))
    factors = np.full(len(each), whole[0])
    free = problem.seen(each, factors) > LEAST_DOF  # the others share one factor
    if free.sum() > 1:
        factors, dof, apart = problem.estimate(each, free, factors)
        p_value = float(gammaincc(0.5 * (free.sum() - 1), max(apart - level, 0.0)))
    else:
        free, dof, p_value = np.zeros(len(each), bool), np.full(len(each), np.nan), 1.0
    known = [
        Component(name, float(f), float(f / np.sqrt(2.0 * d)) if seen else float("nan"))
        for (name, _), f, d, seen in zip(parts, factors, dof, free, strict=True)
    ]
    every = np.array([v for _, v in parts])
    return Components(tuple(known), p_value, every, missing, float(whole[0]))


def _stretched(fit: Fit) -> float:
    """Mean square of the parameters in units of their prior, at least one.

    Where a missing effect has driven the parameters far beyond their prior, the prior is wrong. It
    must not turn the rest of that effect into noise.
    """
    informed = np.count_nonzero(fit.precision)
    return max(1.0, float(fit.theta**2 @ fit.precision) / max(informed, 1))


def _times(matrices: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The matrices (n, m, m) of all rows, which are mostly diagonal, times columns (n, m, k)."""
    diagonal = np.einsum("nii->ni", matrices)
    if np.count_nonzero(matrices) == np.count_nonzero(diagonal):
        return diagonal[:, :, None] * columns
    return matrices @ columns


@dataclass(frozen=True)
class _Problem:
    """The linearised fit: residual = data - J delta, with the prior of the parameters."""

    residual: np.ndarray
    jacobian: np.ndarray
    theta: np.ndarray
    precision: np.ndarray
    absent: np.ndarray

    def _solved(self, covariance: np.ndarray):
        inverse = np.linalg.inv(covariance)
        weighted = _times(inverse, self.jacobian)
        size = len(self.theta)
        flat, rows = self.jacobian.reshape(-1, size), weighted.reshape(-1, size)
        factor = cho_factor(flat.T @ rows + np.diag(self.precision))
        pull = rows.T @ self.residual.ravel() - self.precision * self.theta
        delta = cho_solve(factor, pull)
        error = self.residual - self.jacobian @ delta
        return inverse, weighted, factor, error, self.theta + delta

    def _shares(self, each: np.ndarray, factors: np.ndarray):
        """Sum of squares and trace of every component (c,), and the log likelihood."""
        covariance = np.einsum("c,cnij->nij", factors**2, each) + self.absent
        inverse, weighted, factor, error, theta = self._solved(covariance)
        turned = (inverse @ error[:, :, None])[:, :, 0]
        rows = weighted.reshape(-1, len(theta))
        squares, trace = [], []
        for part in each:
            squares.append((turned * (part @ turned[:, :, None])[:, :, 0]).sum())
            # tr(P V_c) with P = V^-1 - (V^-1 J) H^-1 (V^-1 J)'.
            inside = rows.T @ _times(part, weighted).reshape(rows.shape)
            trace.append((inverse * part).sum() - np.trace(cho_solve(factor, inside)))
        likelihood = -0.5 * (
            np.linalg.slogdet(covariance)[1].sum()
            + 2.0 * np.log(np.diag(factor[0])).sum()
            + (error * turned).sum()
            + theta**2 @ self.precision
        )
        return np.array(squares), np.array(trace), float(likelihood)

    def seen(self, each: np.ndarray, factors: np.ndarray) -> np.ndarray:
        """Degrees of freedom of every component."""
        return factors**2 * self._shares(each, factors)[1]

    def estimate(
        self, each: np.ndarray, free: np.ndarray, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Factors, degrees of freedom and log likelihood. Components that are not in `free` (c,)
        keep their start.
        """
        factors = np.ones(len(each)) if start is None else start.copy()
        for _ in range(_ROUNDS):
            squares, trace, _ = self._shares(each, factors)
            new = np.where(free, factors * np.sqrt(squares / np.where(free, trace, 1.0)), factors)
            new = np.maximum(new, LEAST_NOISE)
            moved = np.abs(new / factors - 1.0).max()
            factors = new
            if moved < _SETTLED:
                break
        _, trace, likelihood = self._shares(each, factors)
        return factors, factors**2 * trace, likelihood
