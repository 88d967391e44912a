"""Minimisation of a criterion within bounds by gradient, from several starts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from ..numerics.compiled import jit_outermost


@dataclass(frozen=True)
class Found:
    """The result of the search from one start."""

    z: Float[np.ndarray, " d"]
    value: float
    start: float
    """The criterion at the start."""
    iterations: int
    converged: bool
    message: str


# With many small factorisations, further BLAS threads only wait for each other.
@threadpool_limits.wrap(limits=1, user_api="blas")
def search(
    criterion: Callable[[Any], Any],
    starts: Sequence[Float[np.ndarray, " d"]],
    low: Float[np.ndarray, " d"],
    high: Float[np.ndarray, " d"],
    *,
    steps: int = 200,
    tolerance: float = 1e-5,
    with_slope: bool = False,
) -> list[Found]:
    """Minimise `criterion`, which JAX differentiates, from every start; best result first.

    A criterion `with_slope` returns its value and gradient and is called as given, so that searches
    can share compiled programs.

    The method is limited-memory BFGS within bounds (scipy's L-BFGS-B) on the relative criterion.
    The starts run one after the other, as XLA uses all processors, and calls from several threads
    can deadlock in its batched linear algebra. A search ends where a step gains less than the
    relative `tolerance`, or after `steps`. Raises `ValueError` where the criterion or its gradient
    is not finite at a start.
    """
    # Imported here, as the import takes long and only designs need it.
    from scipy.optimize import minimize

    both = criterion if with_slope else jit_outermost(jax.value_and_grad(criterion))

    def one(start: np.ndarray) -> Found:
        first, slope = both(start)
        if not (np.isfinite(float(first)) and np.isfinite(np.asarray(slope)).all()):
            raise ValueError(
                "found a criterion or a gradient that is not finite at a start, expected numbers"
            )
        scale = abs(float(first)) or 1.0

        def relative(z: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = both(z)
            return float(value) / scale, np.asarray(slope, float) / scale

        found = minimize(
            relative,
            np.clip(start, low, high),
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(low, high, strict=True)),
            options={"maxiter": steps, "ftol": tolerance, "gtol": 1e-9, "maxcor": 20},
        )
        return Found(
            z=found.x,
            value=float(found.fun) * scale,
            start=float(first),
            iterations=int(found.nit),
            converged=bool(found.success),
            message=str(found.message),
        )

    return sorted(map(one, starts), key=lambda f: f.value)
