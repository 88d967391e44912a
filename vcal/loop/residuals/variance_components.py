"""Variance components: the noise of every kind of reading, relative to the declared noise.

    V_i = sum_c f_c^2 V_ic,    c: the components of a reading, and the declared random effects

The factors f_c are estimated by restricted maximum likelihood, iterated as Henderson's and
Forstner's almost unbiased estimate,

    f_c^2 <- f_c^2 (e' V^-1 V_c V^-1 e) / tr(P V_c),    P = V^-1 - V^-1 J H^-1 J' V^-1,

with the residual e of the fit under V and H = J' V^-1 J + L. tr(P V_c) accounts for the degrees of
freedom that the parameters take (Searle, Casella, McCulloch 1992, ch. 8; Forstner 1979).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

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
    missing = absent(fit.model, fit.measurement.plan)
    # A shape parameter that the readings do not determine is confined to its grid.
    precision = fit.within_scans / _stretched(fit)
    jacobian = fit.jacobian.reshape(n, m, -1)[used]
    problem = _Problem(
        fit.residual[used], fit.whitener[used], jacobian, fit.theta, precision, missing[used]
    )
    apart, together = problem.apart_and_together(each)
    whole, dof, level = _estimated(together, np.ones(1, bool))
    factors = np.full(len(each), whole[0])
    free = factors**2 * apart(factors)[1] > LEAST_DOF  # the others share one factor
    if free.sum() > 1:
        factors, dof, likelihood = _estimated(apart, free, factors)
        p_value = float(gammaincc(0.5 * (free.sum() - 1), max(likelihood - level, 0.0)))
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


Shares = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, float]]
"""Sum of squares and trace of every component (c,), and the log likelihood, by the factors."""


@dataclass(frozen=True)
class _Problem:
    """The linearised fit: residual = data - J delta, with the prior of the parameters."""

    residual: np.ndarray
    """(n, m), SI."""
    whitener: np.ndarray
    """Of the Jacobian (n, m, m)."""
    jacobian: np.ndarray
    """Whitened (n, m, k)."""
    theta: np.ndarray
    precision: np.ndarray
    absent: np.ndarray

    def apart_and_together(self, each: np.ndarray) -> tuple[Shares, Shares]:
        """Shares of components with these covariances (c, n, m, m), and of all as one."""
        if (separate := self._separate(each)) is not None:
            return separate, partial(_tied, separate, len(each))
        whole = each.sum(0)[None]
        return self._general(each), self._separate(whole) or self._general(whole)

    def _separate(self, each: np.ndarray) -> "_Separate | None":
        """None where a reading is in several components."""
        diagonal = np.einsum("cnii->cni", each)
        alone = np.count_nonzero(each) == np.count_nonzero(diagonal.any(0))
        lacking = np.einsum("nii->ni", self.absent) > 0.0
        if not alone and len(each) > 1 or diagonal[:, lacking].any():
            return None
        return _Separate(self, each.sum(0), [*(diagonal > 0.0), lacking])

    def _general(self, each: np.ndarray) -> Shares:
        return partial(self._shares, self._plain, each)

    @cached_property
    def _plain(self) -> np.ndarray:
        """The Jacobian, not whitened."""
        return _times(np.linalg.inv(self.whitener), self.jacobian)

    def _solved(self, jacobian: np.ndarray, covariance: np.ndarray):
        inverse = np.linalg.inv(covariance)
        weighted = _times(inverse, jacobian)
        size = len(self.theta)
        flat, rows = jacobian.reshape(-1, size), weighted.reshape(-1, size)
        factor = cho_factor(flat.T @ rows + np.diag(self.precision))
        pull = rows.T @ self.residual.ravel() - self.precision * self.theta
        delta = cho_solve(factor, pull)
        error = self.residual - jacobian @ delta
        return inverse, weighted, factor, error, self.theta + delta

    def _shares(self, jacobian: np.ndarray, each: np.ndarray, factors: np.ndarray):
        covariance = np.einsum("c,cnij->nij", factors**2, each) + self.absent
        inverse, weighted, factor, error, theta = self._solved(jacobian, covariance)
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


class _Separate:
    """Shares of components of which no reading is in two: all that depends on the factors follows
    from sums over the readings of each.

    With J and r of a component whitened for a factor of one, J'V^-1 J is the sum of J'J / f^2 and
    so on. `members` (n, m) are the readings of every component; the last, which a row lacks, keep
    a factor of one.
    """

    def __init__(self, problem: _Problem, covariance: np.ndarray, members: Sequence[np.ndarray]):
        self._theta, self._precision = problem.theta, problem.precision
        whitener, size = whitener_of(covariance + problem.absent), len(problem.theta)
        residual = _times(whitener, problem.residual[:, :, None])
        again = _times(whitener, np.linalg.inv(problem.whitener))
        whitened = _times(again, problem.jacobian).reshape(-1, size), residual.reshape(-1)
        logarithms = -2.0 * np.log(np.einsum("nii->ni", whitener)).reshape(-1)
        self._counts, self._determinants, self._squares = np.zeros((3, len(members)))
        self._slopes = np.zeros((len(members), size))
        self._normal = np.zeros((len(members), size, size))
        for c, inside in enumerate(members):
            at = slice(None) if inside.all() else inside.reshape(-1)
            J, r = (values[at] for values in whitened)
            self._counts[c], self._determinants[c] = len(r), logarithms[at].sum()
            self._squares[c], self._slopes[c], self._normal[c] = r @ r, J.T @ r, J.T @ J

    def __call__(self, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        squared = np.array([*factors, 1.0]) ** 2
        normal = np.einsum("c,cij->ij", 1.0 / squared, self._normal)
        factor = cho_factor(normal + np.diag(self._precision))
        delta = cho_solve(factor, self._slopes.T @ (1.0 / squared) - self._precision * self._theta)
        errors = self._squares - 2.0 * self._slopes @ delta + (self._normal @ delta) @ delta
        taken = np.einsum("ij,cij->c", cho_solve(factor, np.eye(len(delta))), self._normal)
        trace = self._counts / squared - taken / squared**2
        theta = self._theta + delta
        likelihood = -0.5 * (
            (self._determinants + self._counts * np.log(squared)).sum()
            + 2.0 * np.log(np.diag(factor[0])).sum()
            + (errors / squared).sum()
            + theta**2 @ self._precision
        )
        return (errors / squared**2)[:-1], trace[:-1], float(likelihood)


def _tied(apart: Shares, count: int, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Shares of `count` components with one factor (1,)."""
    squares, trace, likelihood = apart(np.full(count, factors[0]))
    return squares.sum(keepdims=True), trace.sum(keepdims=True), likelihood


def _estimated(
    shares: Shares, free: np.ndarray, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Factors, degrees of freedom and log likelihood. Components that are not in `free` (c,) keep
    their start.
    """
    factors = np.ones(len(free)) if start is None else start.copy()
    for _ in range(_ROUNDS):
        squares, trace, _ = shares(factors)
        new = np.where(free, factors * np.sqrt(squares / np.where(free, trace, 1.0)), factors)
        new = np.maximum(new, LEAST_NOISE)
        moved = np.abs(new / factors - 1.0).max()
        factors = new
        if moved < _SETTLED:
            break
    _, trace, likelihood = shares(factors)
    return factors, factors**2 * trace, likelihood
