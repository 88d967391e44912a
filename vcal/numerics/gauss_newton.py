"""Gauss-Newton on the host, step by step, for problems on which it converges quickly.

Nothing is compiled for the size of a model. Most problems of a search are near their minimum from
the start, and well conditioned. The others are left to `vcal.numerics.least_squares`, which starts
where this iteration ended.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from .anderson import anderson_step

_MOST = 20
"""Largest number of steps: together they take less time than the compilation of another solver."""
_LINEAR = 0.1
"""Ratio of the remaining steps after and before a step above which steps are combined."""
_SECANTS = 3
"""Number of the last steps that are combined."""
_LONGER = 5.0
"""Largest length of a combined step, relative to the step of Gauss-Newton."""
_FLAT = 1e-6
"""Downward curvature, relative to that of the linear model, that may be rounding."""
_SOME = 50
"""Number of rows by which derivatives are compared."""
_SQUARED = 1e6
"""Bound of the condition number up to which a step is computed from J'J, as in
`vcal.numerics.least_squares`."""


@dataclass(frozen=True)
class Point:
    """The cost |W (y - h)|^2 + |L^(1/2) theta|^2 and its derivatives at one theta (k,)."""

    theta: np.ndarray
    precision: np.ndarray
    """Diagonal of L."""
    residual: np.ndarray
    """y - h, (n, m), SI."""
    by_port: np.ndarray
    """dh/dports (n, m, p), not whitened."""
    whitened: np.ndarray
    """W (y - h), (n m)."""
    derive: Callable[[], np.ndarray]
    """Computes `rows`."""

    @cached_property
    def rows(self) -> np.ndarray:
        """W dh/dtheta, one row per parameter (k, n m)."""
        return self.derive()

    def with_derivative_of(self, other: "Point") -> "Point":
        """This point with the derivative, and its factorisation, of another point close by."""
        found = replace(self, derive=lambda: other.rows)
        vars(found).update(squared=other.squared, _root=other._root)
        return found

    @cached_property
    def squared(self) -> np.ndarray:
        """J'J, without the prior."""
        return self.rows @ self.rows.T

    @cached_property
    def cost(self) -> float:
        """The cost that is minimised."""
        return float(self.whitened @ self.whitened + self.theta**2 @ self.precision)

    @cached_property
    def _root(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """R of the Jacobian with the prior's rows, the inverse of R' for columns of unit length,
        and the lengths of the columns.

        None where the condition number of R may be too large to compute R from its square.
        """
        curvature = self.squared + np.diag(self.precision)
        norms = np.sqrt(np.diag(curvature))
        if not (norms > 0.0).all() or not np.isfinite(norms.sum()):
            return None
        if not len(norms):
            return np.zeros((0, 0)), np.zeros((0, 0)), norms
        try:
            lower = cholesky(curvature / np.outer(norms, norms), lower=True)
        except LinAlgError:
            return None
        inverse = solve_triangular(lower, np.eye(len(norms)), lower=True)
        if not np.linalg.norm(lower) * np.linalg.norm(inverse) < _SQUARED:
            return None
        return lower.T * norms, inverse, norms

    @property
    def well_conditioned(self) -> bool:
        """Whether a step can be computed from J'J, which determines all parameters."""
        return np.isfinite(self.cost) and self._root is not None

    def image(self, moves: np.ndarray) -> np.ndarray:
        """R times some moves (k, s): the length of an image is the change of the residual."""
        assert self._root is not None
        return self._root[0] @ moves

    @cached_property
    def step_image(self) -> np.ndarray:
        """R times the step to the minimum of the linear problem: R^-T times the slope."""
        assert self._root is not None
        _, inverse, norms = self._root
        return inverse @ ((self.rows @ self.whitened - self.precision * self.theta) / norms)

    def from_image(self, image: np.ndarray) -> np.ndarray:
        """The move (k,) with that image."""
        assert self._root is not None
        return solve_triangular(self._root[0], image)

    @cached_property
    def step(self) -> np.ndarray:
        """The step (k,) to the minimum of the linear problem."""
        return self.from_image(self.step_image)

    @cached_property
    def decrement(self) -> float:
        """|J g|, the length of that step in standard uncertainties for a noise of one."""
        return float(np.linalg.norm(self.step_image))

    def converged(self, tolerance: float) -> bool:
        """Whether the minimum is within `tolerance` standard uncertainties.

        These follow from the scatter of the residuals, or from their noise of one if that is
        larger.
        """
        used = max(int(np.count_nonzero(self.whitened)), 1)
        return self.decrement <= tolerance * max(1.0, (self.cost / used) ** 0.5)


def _same_derivative(one: Point, other: Point, share: float) -> bool:
    """Whether the derivatives by the ports differ by less than a `share`, judged by some rows.

    The slope then changes by less than that many standard uncertainties of the residuals' scatter.
    """
    some = slice(None, None, max(1, len(one.by_port) // _SOME))
    before, after = one.by_port[some], other.by_port[some]
    return bool(np.linalg.norm(after - before) <= share * np.linalg.norm(before))


def minimise(
    at: Callable[[np.ndarray], Point],
    begin: np.ndarray,
    tolerance: float,
    reuse_derivative: bool = False,
) -> tuple[Point, int, bool]:
    """Gauss-Newton steps from `begin` (k,): the last point, the number of steps, and whether it is
    within the `tolerance` (`Point.converged`) of a minimum.

    `at` evaluates a point. Without convergence the point returned is the one of lowest cost, from
    which another solver may continue. With `reuse_derivative`, the last point may have the
    derivative of the previous one, if it is a minimum with that and the two nearly agree.
    """
    point = lowest = at(begin)
    before: list[Point] = []
    for steps in range(_MOST):
        if not point.well_conditioned:
            return lowest, steps, False
        if point.converged(tolerance):
            return point, steps, True
        after = at(point.theta + _next_step(point, before))
        if reuse_derivative:
            near = after.with_derivative_of(point)
            ends = near.well_conditioned and near.cost <= point.cost and near.converged(tolerance)
            if ends and _same_derivative(point, after, tolerance):
                return near, steps + 1, True
        # Points before a step that does not lead nearer belong to another region of the cost.
        nearer = (
            after.well_conditioned
            and after.cost <= point.cost
            and after.decrement < point.decrement
        )
        before = [*before[1 - _SECANTS :], point] if nearer else []
        point = after
        if point.well_conditioned and point.cost < lowest.cost:
            lowest = point
    return lowest, _MOST, False


def _next_step(point: Point, before: list[Point]) -> np.ndarray:
    """The step from a point, combined with those from the points `before` it where Gauss-Newton
    alone is slow, if the cost curves upwards along all of the last moves.
    """
    if not before or point.decrement <= _LINEAR * before[-1].decrement:
        return point.step
    path = [*before, point]
    moved = point.image(np.diff([p.theta for p in path], axis=0).T)
    changed = point.image(np.diff([p.step for p in path], axis=0).T)
    further = anderson_step(point.step_image, moved, changed)
    # J'J times the change of a step is minus the Hessian times the move.
    lengths = np.linalg.norm(moved, axis=0)
    bends = -(moved.T @ changed) / np.outer(lengths, lengths)
    upwards = np.linalg.eigvalsh(bends + bends.T)[0] > -_FLAT
    if not upwards or np.linalg.norm(further) > _LONGER * point.decrement:
        return point.step
    return point.from_image(further)
