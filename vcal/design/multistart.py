"""A criterion made small by gradient, from several starts, within bounds."""

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
    """Where one start led."""

    z: Float[np.ndarray, " d"]
    value: float
    start: float
    """The criterion at the start."""
    iterations: int
    converged: bool
    message: str


# Many small factorisations: more threads of BLAS only wait for each other.
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
    """Minimise `criterion`, which JAX differentiates, from every start; best first.

    A criterion `with_slope` returns its gradient beside its value and is called as it is, so that
    searches can share what they compile.

    Limited-memory BFGS within bounds (scipy's L-BFGS-B) on the relative criterion, one start after
    the other: XLA has the processors to itself, and calls from several threads can wait for each
    other for ever in its batched linear algebra. Ends where a step gains less than the relative
    `tolerance`, or after `steps`. Raises `ValueError` where the criterion or its gradient is not
    finite at a start.
    """
    # Only here: whoever designs nothing need not wait for it.
    from scipy.optimize import minimize

    both = criterion if with_slope else jit_outermost(jax.value_and_grad(criterion))

    def one(start: np.ndarray) -> Found:
        first, slope = both(start)
        if not (np.isfinite(float(first)) and np.isfinite(np.asarray(slope)).all()):
            raise ValueError(
                "found a criterion that is not finite at a start, or its gradient, expected numbers"
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
