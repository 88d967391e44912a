"""Which uncertainty of one input gives a wanted one of the result, and sweeps over an input."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..distributions import Inputs, Univariate, rescaled
from ..registry import nearest
from .budget import Budget, coverage_factor
from .propagation import Function, effective_dof, propagate

_STEPS = 400
"""Steps of the search for the largest factor, over `_DECADES` decades."""
_DECADES = 8.0
_HALVINGS = 60


@dataclass(frozen=True)
class Required:
    """The standard uncertainty of one input for a wanted one of an output."""

    input: str
    output: str
    u: float
    """Largest standard uncertainty of the input, in its unit."""
    factor: float
    """That over the present one."""
    others: float
    """u of the output if the input were exact."""


def required_u(
    budget: Budget,
    input: str,
    *,
    u: float | None = None,
    U: float | None = None,
    output: str | None = None,
) -> Required:
    """The largest standard uncertainty of one input that gives a wanted `u` or `U` of an output.

    At first order, with s the factor by which u(x) changes while correlations stay,

        u^2(y) = V_0 + 2 s V_1 + s^2 V_2,   V_2 = c^2 u^2(x),   V_1 = sum_j c c_j u(x, x_j)

    For U, nu_eff and k follow s (JCGM 100, G.4). U may fall while u(x) grows, where a share with
    few degrees of freedom gets smaller: the largest u(x) with this U is found.

    Raises `ValueError` for an unknown input or output, unless one of u and U is given above zero,
    for a budget of second order (take `sweep`), an input on which the output does not depend, and
    a wanted uncertainty that the other inputs alone exceed, with theirs.
    """
    at = _position(input, budget.source.labels)
    if output is None and len(budget.labels) != 1:
        raise ValueError(f"the budget has {len(budget.labels)} outputs; name the one that is meant")
    i = budget.index(budget.labels[0] if output is None else output)
    wanted = u if U is None else U
    if (u is None) == (U is None) or wanted is None or not 0.0 < wanted < math.inf:
        raise ValueError(
            f"found u = {u} and U = {U}, expected one of the two, the wanted uncertainty above 0"
        )
    if budget.order != 1:
        raise ValueError(
            "the budget is of second order, in which u(y) is not quadratic in u(x); take sweep "
            "over u of the input"
        )
    parts = _parts(budget, i, at)
    if not parts[2] > 0.0:
        raise ValueError(
            f"{input}: {budget.labels[i]} does not depend on it, or it is exact already; choose "
            "another input"
        )
    factor = _quadratic(parts, wanted) if U is None else _searched(budget, i, at, parts, wanted)
    if factor is None:
        least = math.sqrt(max(parts[0], 0.0))
        raise ValueError(
            f"{budget.labels[i]}: found {'u' if U is None else 'U'} = {wanted:g} wanted, but "
            f"u = {least:.4g} is left with an exact {input}; reduce another input too"
        )
    present = float(budget.source.u[at])
    return Required(
        input, budget.labels[i], factor * present, factor, math.sqrt(max(parts[0], 0.0))
    )


@dataclass(frozen=True)
class Sweep:
    """Outputs of a measurement function over one input's value or standard uncertainty."""

    input: str
    what: Literal["value", "u"]
    at: Float[np.ndarray, " n"]
    """Values of the input, or of its standard uncertainty."""
    labels: tuple[str, ...]
    """Names of the outputs."""
    value: Float[np.ndarray, "n m"] = field(repr=False)
    u: Float[np.ndarray, "n m"] = field(repr=False)
    U: Float[np.ndarray, "n m"] = field(repr=False)
    share: Float[np.ndarray, "n m"] = field(repr=False)
    """Share of u^2 of the input itself."""
    coverage: float

    def index(self, output: str) -> int:
        """Index of an output; raises `ValueError` for an unknown name."""
        if output not in self.labels:
            raise ValueError(
                f"output: found {output!r}{nearest(output, self.labels)}, expected one of "
                f"{', '.join(self.labels)}"
            )
        return self.labels.index(output)


def sweep(
    function: Function,
    inputs: Inputs,
    input: str,
    *,
    value: Sequence[float] | np.ndarray | None = None,
    u: Sequence[float] | np.ndarray | None = None,
    order: Literal[1, 2] = 1,
    coverage: float = 0.95,
) -> Sweep:
    """Propagate by the GUM for many values of one input, or for many of its standard uncertainty.

    The distribution of the input keeps its shape: it is moved to another mean, or stretched about
    it; correlations and degrees of freedom stay. Raises `ValueError` for an unknown or multivariate
    input, unless one of `value` and `u` is given, and as `propagate` does.
    """
    if (value is None) == (u is None):
        raise ValueError("sweep: expected one of value and u, the numbers to go through")
    if input not in inputs.names:
        raise ValueError(
            f"sweep: found input {input!r}{nearest(input, inputs.names)}, expected one of "
            f"{', '.join(inputs.names)}"
        )
    d = inputs.distributions[input]
    if not isinstance(d, Univariate):
        raise ValueError(f"sweep: {input} is multivariate, expected an input that is one number")
    what = "u" if value is None else "value"
    at = np.asarray(u if value is None else value, float)
    if at.ndim != 1 or not len(at):
        raise ValueError(f"sweep: found {what} of shape {at.shape}, expected a list of numbers")
    budgets = [
        propagate(
            function,
            inputs.replaced(input, rescaled(d, **{what: float(number)})),
            order=order,
            coverage=coverage,
        )
        for number in at
    ]
    column = inputs.labels.index(input)
    return Sweep(
        input=input,
        what=what,
        at=at,
        labels=budgets[0].labels,
        value=np.stack([b.value for b in budgets]),
        u=np.stack([b.u for b in budgets]),
        U=np.stack([b.U for b in budgets]),
        share=np.stack([b.share[:, column] for b in budgets]),
        coverage=coverage,
    )


def _position(name: str, labels: tuple[str, ...]) -> int:
    if name not in labels:
        raise ValueError(
            f"input: found {name!r}{nearest(name, labels)}, expected one of {', '.join(labels)}"
        )
    return labels.index(name)


def _parts(budget: Budget, i: int, at: int) -> tuple[float, float, float]:
    """V_0, V_1 and V_2 of output i and the input at this position."""
    c = budget.sensitivity[i]
    terms = np.outer(c, c) * budget.source.covariance
    own = float(terms[at, at])
    cross = float(terms[at].sum()) - own
    return float(terms.sum()) - own - 2.0 * cross, cross, own


def _quadratic(parts: tuple[float, float, float], u: float) -> float | None:
    """The larger factor s > 0 with u^2 = V_0 + 2 s V_1 + s^2 V_2."""
    rest, cross, own = parts
    inside = cross**2 - own * (rest - u**2)
    if inside < 0.0:
        return None
    factor = (math.sqrt(inside) - cross) / own
    return factor if factor > 0.0 else None


def _searched(
    budget: Budget, i: int, at: int, parts: tuple[float, float, float], U: float
) -> float | None:
    """The largest factor with k u <= U."""

    def fits(factor: float) -> bool:
        scale = np.ones(len(budget.source.labels))
        scale[at] = factor
        covariance = budget.source.covariance * np.outer(scale, scale)
        source = replace(budget.source, covariance=covariance)
        nu = effective_dof(source, budget.sensitivity[[i]])[0]
        if budget.stated_dof:
            nu = budget.nu_eff[[i]]
        k = coverage_factor(nu, budget.coverage)[0]
        k = budget.stated_k if budget.stated_k is not None else k
        rest, cross, own = parts
        return k * math.sqrt(max(rest + factor * (2.0 * cross + factor * own), 0.0)) <= U

    least = budget.stated_k or float(coverage_factor(np.array([np.inf]), budget.coverage)[0])
    most = _quadratic(parts, U / least)
    if most is None:
        return None
    # No larger factor fits, as k is at least the normal one.
    low = high = most * (1.0 + 1e-12)
    for step in range(_STEPS + 1):
        low = most * 10.0 ** (-_DECADES * step / _STEPS)
        if fits(low):
            break
        high = low
    else:
        return None
    if low == most:
        return low
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
