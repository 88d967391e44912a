"""Conformity of a measured quantity with its tolerance: JCGM 106:2012.

`conformity` decides on one item, from its distribution. `global_risks` states what a decision rule
costs for items of a production process whose distribution, the prior, is known:

    R_C = integral of g_0(eta) P(accepted | eta) over eta outside of the tolerance      (clause 9.5)
    R_P = integral of g_0(eta) P(rejected | eta) over eta within the tolerance

`guard_band_for_risk` is the inverse. The decision itself is `vcal.numerics.conformity`, which the
report of an identified machine uses as well.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from ..distributions import Univariate
from ..numerics.arrays import Array
from ..numerics.conformity import Conformity, Continuous, Draws, Law, Requirement, Rule, Tolerance
from ..numerics.conformity import decide as _decide
from .budget import Budget, whole_dof
from .ensemble import Ensemble

Measured = Budget | Ensemble | Univariate | np.ndarray
"""A result by the GUM or by Monte Carlo, the distribution of the quantity, or draws of it."""

_REACH = 9.0
"""Normal score of the prior up to which risks are integrated; 2e-19 lies beyond."""
_PANELS, _NODES = 36, 16
"""Intervals of the integration at least, and nodes in each."""
_NEAR = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0)
"""Distances from a limit of acceptance, in standard deviations of the measurement, at which the
integration is divided."""


def conformity(
    result: Measured,
    tolerance: Tolerance,
    output: str | None = None,
    *,
    risk: float = 0.05,
    rule: Rule = "guarded",
    guard_band: float | None = None,
) -> Conformity:
    """The decision whether a quantity conforms with its tolerance (JCGM 106:2012, 7 and 8).

    `result` is that of `propagate`, a normal or t distribution with its effective degrees of
    freedom; of `propagate_distributions` or a campaign, whose draws are counted; a distribution,
    such as ``Normal(value, u)`` of a certificate; or an array of draws. `output` names one of
    several outputs.

    With the rule ``"guarded"``, the item conforms where the conformance probability p_c is at least
    1 - `risk`, and does not conform where p_c is at most `risk`. `guard_band` sets the distance
    from the limits directly: U for w = U (8.3.2). With ``"simple"``, the estimate decides (8.2).

    Raises `ValueError` for a risk, rule or guard band that `Requirement` refuses, for an unknown or
    missing output, and for fewer than two finite draws; `TypeError` for another kind of result.
    """
    return _decide(_law(result, output), Requirement(tolerance, risk, rule, guard_band))


@dataclass(frozen=True)
class GlobalRisks:
    """Probabilities for an item of the process before it is measured (JCGM 106, 9.5)."""

    consumer: float
    """R_C: it does not conform and is accepted."""
    producer: float
    """R_P: it conforms and is rejected."""
    conforming: float
    """P(T_L <= Y <= T_U), of the process."""
    accepted: float
    """Probability that it is accepted."""

    @property
    def consumer_of_accepted(self) -> float:
        """Share of the accepted items that do not conform; NaN where none is accepted."""
        return self.consumer / self.accepted if self.accepted > 0.0 else math.nan

    @property
    def producer_of_rejected(self) -> float:
        """Share of the rejected items that conform; NaN where none is rejected."""
        rejected = 1.0 - self.accepted
        return self.producer / rejected if rejected > 0.0 else math.nan


def global_risks(
    prior: Univariate,
    measurement: float | Univariate,
    tolerance: Tolerance,
    guard_band: float = 0.0,
) -> GlobalRisks:
    """Global consumer's and producer's risk of accepting where T_L + w <= y_m <= T_U - w.

    `prior` is the distribution of the quantity over the items; `measurement` the standard
    uncertainty u_m of a normal measurement error, or the distribution of that error. A guard band w
    below zero accepts beyond the limits. By Gauss-Legendre quadrature over the normal score of the
    prior.

    Raises `ValueError` for a u_m that is not finite and above zero, and `TypeError` for a prior
    that is no univariate distribution.
    """
    return _Process(prior, measurement, tolerance).risks(guard_band)


def guard_band_for_risk(
    prior: Univariate,
    measurement: float | Univariate,
    tolerance: Tolerance,
    wanted: float,
    of: Literal["consumer", "producer"] = "consumer",
) -> float:
    """The guard band w with which the global risk of the consumer or the producer is `wanted`.

    A result below zero means that simple acceptance has a smaller risk of the consumer, or a larger
    one of the producer. Raises as `global_risks` does, and `ValueError` for a risk that no guard
    band attains (with the range that is possible).
    """
    if of not in ("consumer", "producer"):
        raise ValueError(f"of: found {of!r}, expected 'consumer' or 'producer'")
    process = _Process(prior, measurement, tolerance)
    reach = 8.0 * process.u_m
    width = tolerance.upper - tolerance.lower
    ends = (-reach, min(reach, 0.5 * width * (1.0 - 1e-9)))

    def excess(w: float) -> float:
        return float(getattr(process.risks(w), of)) - wanted

    low, high = sorted(excess(end) + wanted for end in ends)
    if not low <= wanted <= high:
        raise ValueError(
            f"wanted: found a global {of}'s risk of {wanted:g}, expected one from {low:.3g} to "
            f"{high:.3g}, which guard bands from {ends[0]:.3g} to {ends[1]:.3g} give; measure with "
            "a smaller uncertainty"
        )
    return float(root_scalar(excess, bracket=ends, xtol=1e-10 * process.u_m).root)


class _Process:
    """A production process with its measurement, prepared for integration."""

    def __init__(self, prior: Univariate, measurement: float | Univariate, tolerance: Tolerance):
        if not isinstance(prior, Univariate):
            raise TypeError(
                f"prior: found {prior!r}, expected a univariate distribution of the items, such as "
                "Normal(mean, standard_deviation)"
            )
        self.prior, self.tolerance = prior, tolerance
        self.u_m, self.error = _error(measurement)

    def risks(self, w: float) -> GlobalRisks:
        """The risks with a guard band w."""
        limits = (self.tolerance.lower, self.tolerance.upper)
        accept = (limits[0] + w, limits[1] - w)
        x, weight = self._nodes(limits, accept)
        passed = np.maximum(self.error(accept[1] - x) - self.error(accept[0] - x), 0.0)
        good = (x >= limits[0]) & (x <= limits[1])
        return GlobalRisks(
            consumer=float(weight @ np.where(good, 0.0, passed)),
            producer=float(weight @ np.where(good, 1.0 - passed, 0.0)),
            conforming=float(weight @ good),
            accepted=float(weight @ passed),
        )

    def _nodes(
        self, limits: tuple[float, float], accept: tuple[float, float]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Values of the prior and their weights, with no panel across a limit."""
        at = [x for x in limits if math.isfinite(x)]
        at += [
            limit + way * near * self.u_m
            for limit in accept
            if math.isfinite(limit)
            for near in _NEAR
            for way in (-1.0, 1.0)
        ]
        scores = ndtri(np.asarray(self.prior.cdf(jnp.asarray(at))))
        edges = np.unique(
            np.clip(
                np.concatenate([np.linspace(-_REACH, _REACH, _PANELS + 1), scores]), -_REACH, _REACH
            )
        )
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        half = 0.5 * np.diff(edges)
        z = (0.5 * (edges[1:] + edges[:-1])[:, None] + half[:, None] * nodes).ravel()
        weight = (half[:, None] * weights).ravel() * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
        return np.asarray(self.prior.from_score(jnp.asarray(z))), weight


def _error(measurement: float | Univariate) -> tuple[float, Callable[[np.ndarray], np.ndarray]]:
    """Standard deviation and distribution function of the measurement error."""
    if isinstance(measurement, Univariate):
        return float(measurement.std), lambda e: np.asarray(measurement.cdf(jnp.asarray(e)))
    u = float(measurement)
    if not (math.isfinite(u) and u > 0.0):
        raise ValueError(
            f"measurement: found a standard uncertainty of {u:g}, expected a number above 0, or "
            "the distribution of the measurement error"
        )
    return u, lambda e: ndtr(e / u)


def _law(result: Measured, output: str | None) -> Law:
    if isinstance(result, Budget):
        return _by_gum(result, _at(result.labels, output, result.index))
    if isinstance(result, Ensemble):
        return _by_draws(result, _at(result.labels, output, result.index))
    if isinstance(result, Univariate):
        return _known(result)
    draws: Any = result
    if isinstance(draws, np.ndarray) and draws.ndim == 1:
        return Draws(draws[np.isfinite(draws)])
    raise TypeError(
        f"result: found {type(result).__name__}, expected a result of propagate or "
        "propagate_distributions, a univariate distribution such as Normal(value, u), or a "
        "one-dimensional array of draws"
    )


def _at(labels: tuple[str, ...], output: str | None, index: Callable[[str], int]) -> int:
    if output is None and len(labels) > 1:
        raise ValueError(
            f"output: the result has {len(labels)}, {', '.join(labels[:5])}; name the one to judge"
        )
    return index(next(iter(labels)) if output is None else output)


def _by_gum(budget: Budget, i: int) -> Law:
    y, u, nu = float(budget.value[i]), float(budget.u[i]), float(whole_dof(budget.nu_eff)[i])
    if not u > 0.0:
        raise ValueError(
            f"{budget.labels[i]}: found u = {u:g}, expected an uncertainty above 0; without one, "
            "compare the value with the limits"
        )
    if math.isinf(nu):
        return Continuous(
            y, u, lambda x: float(ndtr((x - y) / u)), lambda p: y + u * float(ndtri(p))
        )
    return Continuous(
        y, u, lambda x: float(stdtr(nu, (x - y) / u)), lambda p: y + u * float(stdtrit(nu, p))
    )


def _by_draws(ensemble: Ensemble, i: int) -> Law:
    if ensemble.columns:
        column = ensemble.columns[i]
        share = column.total / max(column.draws, 1)
        return Continuous(
            float(ensemble.mean[i]),
            float(ensemble.u[i]),
            lambda x: float(np.interp(x, column.edges, share)),
            lambda p: float(np.interp(p, share, column.edges)),
            column.draws,
        )
    values = ensemble.values[:, i]
    return Draws(values[np.isfinite(values)])


def _known(d: Univariate) -> Law:
    return Continuous(
        float(d.mean),
        float(np.sqrt(np.asarray(d.stated_covariance)[0, 0])),
        lambda x: float(_cdf(d, np.asarray(x))),
        lambda p: float(_quantile(d, np.asarray(p))),
    )


@eqx.filter_jit
def _cdf(d: Univariate, x: Float[np.ndarray, ""]) -> Float[Array, ""]:
    return d.cdf(jnp.asarray(x))


@eqx.filter_jit
def _quantile(d: Univariate, p: Float[np.ndarray, ""]) -> Float[Array, ""]:
    return d.quantile(p)
