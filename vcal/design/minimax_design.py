"""Minimisation of the largest of several criteria, under bounds and linear constraints.

    min over z, t of t   with   f_i(z) <= t,   low <= z <= high,   A z >= b

This problem is smooth although the largest of the f_i is not. It is solved by sequential quadratic
programming (scipy's SLSQP) with exact derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost


@dataclass(frozen=True)
class Minimax:
    """The end of a minimax search."""

    z: Float[np.ndarray, " d"]
    values: Float[np.ndarray, " q"]
    """Criteria at the end."""
    start: Float[np.ndarray, " q"]
    """Criteria at the start."""
    iterations: int
    converged: bool
    message: str

    @property
    def largest(self) -> float:
        """The largest criterion, which was minimised."""
        return float(self.values.max())


def minimax(
    criteria: Callable[[Any], Float[Array, " q"]],
    start: Float[np.ndarray, " d"],
    low: Float[np.ndarray, " d"],
    high: Float[np.ndarray, " d"],
    *,
    slopes: Callable[[Float[np.ndarray, " d"]], Float[np.ndarray, "q d"]] | None = None,
    at_least: tuple[Float[np.ndarray, "c d"], Float[np.ndarray, " c"]] | None = None,
    steps: int = 200,
    tolerance: float = 1e-6,
) -> Minimax:
    """Minimise the largest of `criteria`, a function that JAX differentiates unless `slopes` gives
    its derivative.

    `at_least` holds A and b. The result is the best feasible point, or the start if no other is
    better. Raises `ValueError` where the start violates a bound or a constraint, or a criterion is
    not finite there.
    """
    z = np.asarray(start, float)
    A, b = (np.zeros((0, len(z))), np.zeros(0)) if at_least is None else at_least
    value_of = jit_outermost(criteria) if slopes is None else criteria
    first = np.asarray(value_of(z))
    if slopes is None:
        slopes = jit_outermost((jax.jacfwd if len(z) < len(first) else jax.jacrev)(criteria))
    if not np.isfinite(first).all():
        raise ValueError("found a criterion that is not finite at the start, expected a number")
    slack = 1e-9
    if (z < low - slack).any() or (z > high + slack).any() or (A @ z < b - slack).any():
        raise ValueError(
            "found a start that violates a bound or a constraint, expected a feasible one"
        )
    unit = abs(float(first.max())) or 1.0
    best = [first.max(), z]

    def values(y: np.ndarray) -> np.ndarray:
        found = np.asarray(value_of(y[:-1]))
        kept = (y[:-1] >= low - slack) & (y[:-1] <= high + slack)
        if kept.all() and (A @ y[:-1] >= b - slack).all() and found.max() < best[0]:
            best[:] = found.max(), y[:-1].copy()
        return y[-1] - found / unit

    def steepness(y: np.ndarray) -> np.ndarray:
        found = np.asarray(slopes(y[:-1]))
        return np.column_stack([-found / unit, np.ones(len(found))])

    # Imported here, as the import takes long and only designs need it.
    from scipy.optimize import minimize

    target = np.zeros(len(z) + 1)
    target[-1] = 1.0
    constraints = [{"type": "ineq", "fun": values, "jac": steepness}]
    if len(A):
        wide = np.column_stack([A, np.zeros(len(A))])
        constraints.append({"type": "ineq", "fun": lambda y: wide @ y - b, "jac": lambda y: wide})
    found = minimize(
        lambda y: y[-1],
        np.append(z, first.max() / unit),
        jac=lambda y: target,
        method="SLSQP",
        bounds=[*zip(low, high, strict=True), (None, None)],
        constraints=constraints,
        options={"maxiter": steps, "ftol": tolerance},
    )
    z = np.asarray(best[1])
    return Minimax(
        z=z,
        values=np.asarray(value_of(z)),
        start=first,
        iterations=int(found.nit),
        converged=bool(found.success),
        message=str(found.message),
    )
