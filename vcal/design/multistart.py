"""Minimisation of a criterion within bounds from several starts: gradient and exchange."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from ..numerics.compiled import jit_outermost

_ROUNDS = 4
"""Largest number of searches by gradient with an exchange of choices after each."""


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
    levels: Int[np.ndarray, " d"] | None = None,
) -> list[Found]:
    """Minimise `criterion`, which JAX differentiates, from every start; best result first.

    A criterion `with_slope` returns its value and gradient and is called as given, so that searches
    can share compiled programs.

    The method is limited-memory BFGS within bounds (scipy's L-BFGS-B) on the relative criterion.
    The starts run one after the other, as XLA uses all processors, and calls from several threads
    can deadlock in its batched linear algebra. A search ends where a step gains less than the
    relative `tolerance`, or after `steps`.

    Numbers with `levels` are choices 0, 1, ..., on which the criterion depends in steps, with a
    gradient of zero. They are exchanged one after the other for the best of their levels
    (coordinate exchange, Meyer and Nachtsheim 1995), and the search is continued, until no exchange
    gains anything. Raises `ValueError` where the criterion or its gradient is not finite at a
    start.
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

        z, iterations = np.clip(start, low, high), 0
        for _ in range(_ROUNDS):
            found = minimize(
                relative,
                z,
                jac=True,
                method="L-BFGS-B",
                bounds=list(zip(low, high, strict=True)),
                options={"maxiter": steps, "ftol": tolerance, "gtol": 1e-9, "maxcor": 20},
            )
            iterations += int(found.nit)
            z = exchanged(lambda z: relative(z)[0], found.x, float(found.fun), levels, tolerance)
            if np.array_equal(z, found.x):
                break
        return Found(
            z=z,
            value=float(both(z)[0]),
            start=float(first),
            iterations=iterations,
            converged=bool(found.success),
            message=str(found.message),
        )

    return sorted(map(one, starts), key=lambda f: f.value)


def exchanged(
    criterion: Callable[[Float[np.ndarray, " d"]], float],
    z: Float[np.ndarray, " d"],
    value: float,
    levels: Int[np.ndarray, " d"] | None,
    tolerance: float,
) -> Float[np.ndarray, " d"]:
    """A vector after an exchange of each of its choices for the best of their `levels`, one after
    the other, where that gains more than the relative `tolerance`; `value` is the criterion at `z`.
    """
    z = np.array(z)
    for i in [] if levels is None else np.flatnonzero(levels):
        for level in range(int(levels[i])):  # type: ignore[index]
            other = z.copy()
            other[i] = level
            if level != round(z[i]) and (tried := criterion(other)) < value * (1.0 - tolerance):
                z, value = other, tried
    return z
