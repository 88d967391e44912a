"""The uncertainty budget of outputs by the GUM (JCGM 100, 102), as numbers."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri, stdtrit

from .intervals import check_coverage
from .taylor import Taylor


class Row(NamedTuple):
    """One line of a budget; `None` where a column does not apply."""

    name: str
    share: float
    """Share of u^2(y); negative where a correlation or a higher-order term reduces it."""
    value: float | None = None
    u: float | None = None
    distribution: str | None = None
    dof: float | None = None
    sensitivity: float | None = None
    contribution: float | None = None
    """|c| u, in the unit of the output."""


@dataclass(frozen=True)
class Source:
    """The k scalar inputs of a budget, with g groups of correlated ones."""

    labels: tuple[str, ...]
    """``"V"``, ``"phi[1]"``."""
    distributions: tuple[str, ...]
    value: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"] = field(repr=False)
    dof: Float[np.ndarray, " k"]
    groups: tuple[tuple[int, ...], ...]
    """Indices of the inputs that are correlated with each other; uncorrelated inputs are absent."""

    @property
    def u(self) -> Float[np.ndarray, " k"]:
        """Standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def independent(self) -> tuple[tuple[int, ...], ...]:
        """All inputs, in mutually independent groups."""
        grouped = {i for group in self.groups for i in group}
        return (*self.groups, *((i,) for i in range(len(self.labels)) if i not in grouped))


@dataclass(frozen=True)
class Budget:
    """Uncertainty of m outputs by the GUM.

    `rows` gives the budget of one output line by line. Its shares add to one.
    """

    labels: tuple[str, ...]
    """Names of the outputs: ``"y"``, ``"R"``, ``"R[2]"``."""
    value: Float[np.ndarray, " m"]
    u: Float[np.ndarray, " m"]
    """Combined standard uncertainty."""
    nu_eff: Float[np.ndarray, " m"]
    """Effective degrees of freedom, not truncated."""
    coverage: float
    """Coverage probability of `U` and `interval`."""
    order: int
    """Terms of the Taylor series: 1 or 2."""
    source: Source
    sensitivity: Float[np.ndarray, "m k"] = field(repr=False)
    """dy/dx at the estimates."""
    taylor: Taylor = field(repr=False)
    notes: tuple[str, ...] = ()
    """Remarks on these numbers, for the reader."""
    stated_k: float | None = None
    """Coverage factor that was stated, instead of the one for `coverage`."""
    stated_dof: bool = False
    """Whether `nu_eff` was stated."""

    @cached_property
    def covariance(self) -> Float[np.ndarray, "m m"]:
        """Covariance of the outputs (JCGM 102, 6.2), computed on request."""
        return self.taylor.covariance

    @cached_property
    def correlation(self) -> Float[np.ndarray, "m m"]:
        """Correlation of the outputs; NaN where one has no uncertainty."""
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(self.u, self.u)

    @property
    def k(self) -> Float[np.ndarray, " m"]:
        """Coverage factor: t_p(nu_eff), or the stated one."""
        if self.stated_k is not None:
            return np.full(len(self.labels), self.stated_k)
        return coverage_factor(self.nu_eff, self.coverage)

    @property
    def U(self) -> Float[np.ndarray, " m"]:
        """Expanded uncertainty k u."""
        return self.k * self.u

    @property
    def contribution(self) -> Float[np.ndarray, "m k"]:
        """|c| u of every input."""
        return np.abs(self.sensitivity) * self.source.u

    @property
    def share(self) -> Float[np.ndarray, "m k"]:
        """Share of u^2 of every input without correlations; zero where u is zero."""
        return self._part(self.contribution**2)

    @property
    def share_correlated(self) -> Float[np.ndarray, "m g"]:
        """Share of u^2 from the covariances within every group of correlated inputs."""
        return self._part(self.together)

    @property
    def share_higher(self) -> Float[np.ndarray, " m"]:
        """Share of u^2 from the second-order terms; zero at first order."""
        return self._part((self.taylor.variance - self.taylor.linear)[:, None])[:, 0]

    @property
    def together(self) -> Float[np.ndarray, "m g"]:
        """2 sum c_i c_j u(x_i, x_j) over the pairs of every group of correlated inputs."""
        parts = np.zeros((len(self.labels), len(self.source.groups)))
        for g, group in enumerate(self.source.groups):
            members = list(group)
            c = self.sensitivity[:, members]
            inner = self.source.covariance[np.ix_(members, members)]
            parts[:, g] = ((c @ (inner - np.diag(np.diag(inner)))) * c).sum(1)
        return parts

    def stated(
        self,
        *,
        k: float | None = None,
        nu_eff: float | None = None,
        coverage: float | None = None,
    ) -> "Budget":
        """The same budget with a stated coverage factor, effective degrees of freedom or coverage.

        A customer or a standard may ask for k = 2, or for degrees of freedom from experience. A
        stated k replaces the coverage probability, of which nothing is said then. Raises
        `ValueError` for a number that is not above zero, a coverage outside (0, 1), k together
        with one of the others, and for nothing stated.
        """
        given = {"k": k, "nu_eff": nu_eff, "coverage": coverage}
        if all(value is None for value in given.values()):
            raise ValueError("stated: found nothing, expected k, nu_eff or coverage")
        if k is not None and (nu_eff is not None or coverage is not None):
            raise ValueError(
                "stated: found k with nu_eff or coverage, from which k would follow; state one"
            )
        for name, value in given.items():
            if value is not None and not (value > 0.0 and (name == "nu_eff" or value < math.inf)):
                raise ValueError(f"stated: found {name} = {value}, expected a number above 0")
        if coverage is not None:
            check_coverage(coverage)
        found = replace(self, stated_k=None if k is None else float(k))
        if coverage is not None:
            found = replace(found, coverage=coverage)
        if nu_eff is not None:
            found = replace(found, nu_eff=np.full(len(self.labels), float(nu_eff)), stated_dof=True)
        return found

    def interval(self, output: str) -> tuple[float, float]:
        """Coverage interval [y - U, y + U] of one output; raises as `index` does."""
        i = self.index(output)
        value, half = float(self.value[i]), float(self.U[i])
        return value - half, value + half

    def index(self, output: str) -> int:
        """Index of an output; raises `ValueError` for an unknown name."""
        if output not in self.labels:
            known = ", ".join(self.labels[:10]) + (", ..." if len(self.labels) > 10 else "")
            raise ValueError(f"output: found {output!r}, expected one of {known}")
        return self.labels.index(output)

    def rows(self, output: str) -> list[Row]:
        """Budget of one output: every input, then correlations and higher-order terms.

        Raises as `index` does.
        """
        i, source = self.index(output), self.source
        share, contribution = self.share[i], self.contribution[i]
        rows = [
            Row(
                name=label,
                share=float(share[j]),
                value=float(source.value[j]),
                u=float(source.u[j]),
                distribution=source.distributions[j],
                dof=float(source.dof[j]),
                sensitivity=float(self.sensitivity[i, j]),
                contribution=float(contribution[j]),
            )
            for j, label in enumerate(source.labels)
        ]
        for group, part in zip(source.groups, self.share_correlated[i].tolist(), strict=True):
            names = ", ".join(source.labels[j] for j in group)
            rows.append(Row(f"correlation of {names}", part))
        if self.order == 2:
            rows.append(Row("second order", float(self.share_higher[i])))
        return rows

    def _part(self, variance: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
        total = (self.u**2)[:, None]
        return np.divide(variance, total, out=np.zeros_like(variance), where=total > 0.0)


def coverage_factor(nu: Float[np.ndarray, " m"], coverage: float) -> Float[np.ndarray, " m"]:
    """k = t_p(nu): half the width of an interval of Student's t (JCGM 100, G.3.2, G.6.4).

    `nu` is truncated as by `whole_dof`.
    """
    whole = whole_dof(nu)
    q = 0.5 * (1.0 + coverage)
    known = np.isinf(whole)
    return np.where(known, ndtri(q), stdtrit(np.where(known, 1.0, whole), q))


def whole_dof(nu: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Degrees of freedom truncated to the next lower integer (JCGM 100, G.4.1); values below one
    are kept.
    """
    # A rounding error must not turn a single group of 4 degrees of freedom into 3.
    return np.where(nu < 1.0, nu, np.floor(nu * (1.0 + 1e-9)))
