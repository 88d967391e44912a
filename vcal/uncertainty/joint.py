"""Several outputs as one vector measurand: joint effective degrees of freedom and region."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..numerics.eigen import eigh
from .budget import Budget
from .regions import Ellipsoid, normal_ellipsoid

Weighting = Literal["elements", "invariant"]


@dataclass(frozen=True)
class Joint:
    """Several outputs with their covariance and joint effective degrees of freedom."""

    labels: tuple[str, ...]
    value: Float[np.ndarray, " m"]
    covariance: Float[np.ndarray, "m m"]
    dof: float
    coverage: float

    @property
    def region(self) -> Ellipsoid:
        """Elliptical coverage region (JCGM 102, 6.5), Hotelling's for finite degrees of freedom.

        Raises `ValueError` for fewer degrees of freedom than outputs.
        """
        return normal_ellipsoid(self.labels, self.value, self.covariance, self.coverage, self.dof)


def joint_outputs(
    budget: Budget,
    outputs: Sequence[str] | str | None = None,
    weighting: Weighting = "elements",
) -> Joint:
    """Outputs of a budget as one vector, with their joint effective degrees of freedom.

    The name of a complex output stands for its real and imaginary part. With V = sum_g V_g over
    independent groups of inputs, V_g = c_g S_g c_g', every element of V_g has, as one of a Wishart
    matrix, the variance (v_ij^2 + v_ii v_jj) / nu_g. Matching their sum over i <= j gives

        nu = sum_ij (v_ij^2 + v_ii v_jj) / sum_g [sum_ij (v_g,ij^2 + v_g,ii v_g,jj) / nu_g]

    (Willink and Hall 2002, Metrologia 39, 361, for two outputs; `weighting` ``"elements"``). It is
    Welch and Satterthwaite's formula for one output. It depends on the units of outputs that
    differ in their unit: ``"invariant"`` first scales all to V = 1, and sums over all i, j (the
    form of Nel and van der Merwe made affine invariant by Krishnamoorthy and Yu 2004, Statistics
    and Probability Letters 66, 161).

    Raises `ValueError` for unknown or repeated outputs, and, where invariant, for outputs that
    depend on each other.
    """
    labels = _named(budget, outputs)
    at = [budget.index(label) for label in labels]
    parts, dofs = [], []
    for group in budget.source.independent:
        members = [i for i in group if budget.source.u[i] > 0.0]
        if members:
            c = budget.sensitivity[np.ix_(at, members)]
            parts.append(c @ budget.source.covariance[np.ix_(members, members)] @ c.T)
            dofs.append(float(budget.source.dof[members].min()))
    total = np.sum(parts, axis=0) if parts else np.zeros((len(at), len(at)))
    parts = [total, *parts]
    if weighting == "invariant":
        parts = _scaled(parts, labels)
    elif weighting != "elements":
        raise ValueError(f"weighting: found {weighting!r}, expected 'elements' or 'invariant'")
    sizes = [_scatter(part, weighting == "elements") for part in parts]
    scatter = sum(size / nu for size, nu in zip(sizes[1:], dofs, strict=True))
    dof = sizes[0] / scatter if scatter > 0.0 else math.inf
    covariance = budget.covariance[np.ix_(at, at)]
    return Joint(labels, budget.value[at], covariance, float(dof), budget.coverage)


def _named(budget: Budget, outputs: Sequence[str] | str | None) -> tuple[str, ...]:
    """Labels of the outputs, with both parts of complex ones."""
    if outputs is None:
        return budget.labels
    found: list[str] = []
    for name in (outputs,) if isinstance(outputs, str) else outputs:
        complex_parts = [
            label
            for label in budget.labels
            if label.startswith((f"{name}.re", f"{name}.im")) and name not in budget.labels
        ]
        found += complex_parts or [budget.labels[budget.index(name)]]
    twice = [label for label in found if found.count(label) > 1]
    if twice:
        raise ValueError(f"outputs: found {twice[0]!r} twice, expected every output once")
    return tuple(found)


def _scatter(v: Float[np.ndarray, "m m"], once: bool) -> float:
    """sum (v_ij^2 + v_ii v_jj) over i <= j, or over all pairs."""
    d = np.diag(v)
    terms = v**2 + np.outer(d, d)
    return float((np.triu(terms) if once else terms).sum())


def _scaled(parts: list[np.ndarray], labels: tuple[str, ...]) -> list[np.ndarray]:
    """V^-1/2 V_g V^-1/2 for all, the first of which is V."""
    total = parts[0]
    u = np.sqrt(np.diag(total))
    size, axes = eigh(total / np.outer(*(2 * [np.where(u > 0.0, u, 1.0)])))
    if size[0] <= 1e-12 * size[-1]:
        raise ValueError(
            f"outputs: {', '.join(labels)} depend on each other or do not vary, and have no "
            "invariant degrees of freedom; leave one out"
        )
    root = (axes / np.sqrt(size)).T / u
    return [root @ part @ root.T for part in parts]
