"""The GUM compared with the Monte Carlo: where they agree, and where and why they differ."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.integrate import quad

from ...uncertainty.comparison import Comparison, compare
from .trials import Trials, component_labels, length_labels

_PER_POINT = 3


@dataclass(frozen=True)
class Length:
    """|d| of one point, for which there is no first-order uncertainty: d has the expectation zero.

    Its distribution still follows from the GUM, as that of the length of a normal vector with the
    covariance the GUM gives for the components.
    """

    label: str
    mean: tuple[float, float]
    """From the GUM's covariance of the components, and of the Monte Carlo."""
    sd: tuple[float, float]
    high: float
    """95 % of the Monte Carlo's values are below."""


@dataclass(frozen=True)
class Rung:
    """The GUM against the Monte Carlo in one setting."""

    trials: Trials
    motions: Comparison
    components: Comparison
    lengths: tuple[Length, ...]
    undefined: tuple[str, ...]
    """Outputs for which the GUM gives nothing."""
    covariance: Float[np.ndarray, "k k"]
    """Of all components, by the GUM."""

    @property
    def both(self) -> tuple[Comparison, Comparison]:
        """Error motions and components."""
        return self.motions, self.components


def rung(trials: Trials) -> Rung:
    """Compare the two for every error motion and every component and length at named points."""
    found = trials.gum()
    budget, ensemble = found.budget, trials.ensemble
    everything = compare(budget, ensemble, digits=1)
    own = component_labels(trials.points)
    at = [budget.index(label) for label in own]
    rest = [i for i in range(len(budget.labels)) if i not in set(at)]
    covariance = budget.covariance[np.ix_(at, at)]
    lengths = []
    for i, label in enumerate(length_labels(trials.points)):
        block = slice(_PER_POINT * i, _PER_POINT * (i + 1))
        mean, sd = normal_length(covariance[block, block])
        k = ensemble.index(label)
        means, sds = (mean, float(ensemble.mean[k])), (sd, float(ensemble.u[k]))
        lengths.append(Length(label, means, sds, ensemble.quantile(label, 0.95)))
    both = part(everything, rest), part(everything, at)
    return Rung(trials, *both, tuple(lengths), found.undefined, covariance)


def part(comparison: Comparison, at: list[int]) -> Comparison:
    """Some outputs of a comparison."""
    c = comparison
    own = {name: getattr(c, name)[at] for name in ("value", "u", "low", "high", "delta")}
    precision = type(c.precision)(*(s[at] for s in c.precision))
    return replace(c, labels=tuple(c.labels[i] for i in at), precision=precision, **own)


def normal_length(covariance: Float[np.ndarray, "3 3"]) -> tuple[float, float]:
    """Mean and standard deviation of |d|, d normal with expectation zero.

    With Q = |d|^2 of the eigenvalues v_i, E[exp(-t Q)] = prod (1 + 2 v_i t)^(-1/2), and

        E|d| = 1/(2 sqrt(pi)) int_0^inf (1 - E[exp(-t Q)]) t^(-3/2) dt,   E|d|^2 = sum v_i

    (Mathai and Provost 1992, Quadratic Forms in Random Variables). Raises `ValueError` for a
    covariance without a positive eigenvalue.
    """
    v = np.clip(np.linalg.eigvalsh(covariance), 0.0, None)
    total = float(v.sum())
    if total <= 0.0:
        raise ValueError("found a covariance of zero, expected a positive variance")
    v = v / total

    # With t = s^2 the integrand is bounded at both ends; beyond one, with t = 1/s^2.
    def near(s: float) -> float:
        if s == 0.0:
            return 2.0 * float(v.sum())
        return -2.0 * float(np.expm1(-0.5 * np.log1p(2.0 * v * s * s).sum())) / (s * s)

    def far(s: float) -> float:
        if s == 0.0:
            return 2.0
        return 2.0 * (1.0 - float(np.exp(-0.5 * np.log1p(2.0 * v / (s * s)).sum())))

    area = quad(near, 0.0, 1.0, epsabs=1e-11)[0] + quad(far, 0.0, 1.0, epsabs=1e-11)[0]
    mean = area / (2.0 * np.pi**0.5)
    return float(mean * total**0.5), float((total * max(1.0 - mean**2, 0.0)) ** 0.5)
