"""Geometric errors with the posterior of an earlier campaign as their prior."""

from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
from jaxtyping import Float

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.eigen import eigh
from .base import Effect, Response
from .geometric import ErrorMotion, GeometricErrors

_LEAST = 1e-12
"""Least eigenvalue of the correlation matrix; smaller ones are rounding."""


class PreviousGeometry(Effect):
    """Geometric errors theta = M c with independent c of unit variance: M M' is the covariance of
    theta before the measurement, and M E[c] its expectation.

    An identification knows standard deviations of parameters, but no correlations. These are what a
    campaign leaves: links that are known only together.
    """

    name = "geometric"
    summary = "error motions and location errors, as known from an earlier campaign"
    remedy = (
        "Compensate by the error motions and location errors of this report; realign where a "
        "squareness is large."
    )
    errors: GeometricErrors
    root: Float[np.ndarray, "k k"]
    """M, in the units of the parameters of `errors`."""
    start: Float[np.ndarray, " k"]
    """Expectation of c."""

    @classmethod
    def of(
        cls,
        errors: GeometricErrors,
        mean: Float[np.ndarray, " k"],
        covariance: Float[np.ndarray, "k k"],
    ) -> Self:
        """From expectation and covariance of the parameters of `errors`, in their units."""
        sigma = np.sqrt(np.diag(covariance))
        values, vectors = eigh(covariance / np.outer(sigma, sigma))
        values = np.maximum(values, _LEAST * values[-1])
        root = sigma[:, None] * vectors * np.sqrt(values)
        start = vectors.T @ (mean / sigma) / np.sqrt(values)
        return cls(errors=errors, root=root, start=start)

    @property
    def motions(self) -> tuple[ErrorMotion, ...]:
        """The error motions."""
        return self.errors.motions

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"c{i}", "1", sigma=1.0, mean=float(value))
            for i, value in enumerate(self.start, start=1)
        )

    @property
    def amounts_to(self) -> Sequence[tuple[str, str, Mapping[str, float]]]:
        return tuple(
            (p.name, p.unit, {f"c{i}": float(v) for i, v in enumerate(row, start=1)})
            for p, row in zip(self.errors.parameters, self.root, strict=True)
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        rows = {
            p.name: p.si * row for p, row in zip(self.errors.parameters, self.root, strict=True)
        }
        found: dict[tuple[str, str], Array] = {}
        for (port, name), column in self.errors.response(plan, shape).items():
            for i, factor in enumerate(rows[name], start=1):
                key = port, f"c{i}"
                found[key] = found[key] + factor * column if key in found else factor * column
        return found


def posterior_of(
    effect: Effect, mean: Float[np.ndarray, " k"], covariance: Float[np.ndarray, "k k"]
) -> tuple[tuple[Parameter, ...], np.ndarray, np.ndarray] | None:
    """Parameters of geometric errors with their expectation (k,) and covariance (k, k), in their
    units, from those of the amplitudes of `effect`; None for any other effect.
    """
    if isinstance(effect, PreviousGeometry):
        moved = effect.root @ covariance @ effect.root.T
        return effect.errors.parameters, effect.root @ mean, moved
    return (effect.parameters, mean, covariance) if isinstance(effect, GeometricErrors) else None
