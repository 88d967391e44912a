"""Gauss-Newton where it converges quickly: step by step, and nothing is compiled for the size of a
model.

Most of the problems of a search are that: near their minimum already, and well conditioned. What
is not is left to `vcal.least_squares`, from where this ended.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from .anderson import anderson_step

_MOST = 20
"""Steps that are tried: together they take less than to compile another solver."""
_LINEAR = 0.1
"""Share of what was left that is left after a step, from which on steps are taken together."""
_SECANTS = 3
"""How many of the last ones are."""
_LONGER = 5.0
"""Most by which that lengthens a step."""
_FLAT = 1e-6
"""Curvature downwards, relative to that of the linear model, that may be rounding."""
_SOME = 50
"""Rows by which derivatives are compared."""
_SQUARED = 1e6
"""Bound of the condition number up to which a step may be found from J'J, as in
`vcal.least_squares`."""


@dataclass(frozen=True)
class Point:
    """What is known about |W (y - h)|^2 + |L^(1/2) theta|^2 at one theta (k,)."""

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
    """Finds `rows`."""

    @cached_property
    def rows(self) -> np.ndarray:
        """W dh/dtheta, one row per parameter (k, n m)."""
        return self.derive()

    def beside(self, other: "Point") -> "Point":
        """The same with the derivative of another point close by, and what follows from that."""
        found = replace(self, derive=lambda: other.rows)
        vars(found).update(squared=other.squared, _root=other._root)
        return found

    @cached_property
    def squared(self) -> np.ndarray:
        """J'J, without the prior."""
        return self.rows @ self.rows.T

    @cached_property
    def cost(self) -> float:
        """What is minimised, there."""
        return float(self.whitened @ self.whitened + self.theta**2 @ self.precision)

    @cached_property
    def _root(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """R, the prior's rows included, its inverse with columns as of unit length, and their
        lengths; None where the condition of R may be too bad for it to be found from its square.
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
    def certain(self) -> bool:
        """Whether a step from here can be found from J'J; all parameters are told then."""
        return np.isfinite(self.cost) and self._root is not None

    def seen(self, moves: np.ndarray) -> np.ndarray:
        """R times some moves (k, s): their lengths are what they change in the residual."""
        assert self._root is not None
        return self._root[0] @ moves

    @cached_property
    def foretold(self) -> np.ndarray:
        """R times the step to the minimum of the linear problem, R^-T times the slope."""
        assert self._root is not None
        _, inverse, norms = self._root
        return inverse @ ((self.rows @ self.whitened - self.precision * self.theta) / norms)

    def move(self, seen: np.ndarray) -> np.ndarray:
        """The move (k,) of which R times it is that."""
        assert self._root is not None
        return solve_triangular(self._root[0], seen)

    @cached_property
    def step(self) -> np.ndarray:
        """To the minimum of the linear problem."""
        return self.move(self.foretold)

    @cached_property
    def left(self) -> float:
        """|J g|: how far that is, in standard uncertainties of a noise of one."""
        return float(np.linalg.norm(self.foretold))

    def ends(self, tolerance: float) -> bool:
        """Whether it is that near to the minimum, in standard uncertainties by the scatter of the
        residuals, or by their noise of one where that is larger.
        """
        used = max(int(np.count_nonzero(self.whitened)), 1)
        return self.left <= tolerance * max(1.0, (self.cost / used) ** 0.5)


def _same_derivative(one: Point, other: Point, share: float) -> bool:
    """Whether derivatives by the ports differ by less than a share, by some of the rows: by what
    they differ the residual is then nearer to orthogonal than by so many standard uncertainties of
    its scatter.
    """
    some = slice(None, None, max(1, len(one.by_port) // _SOME))
    before, after = one.by_port[some], other.by_port[some]
    return bool(np.linalg.norm(after - before) <= share * np.linalg.norm(before))


def quickly(
    at: Callable[[np.ndarray], Point], begin: np.ndarray, tolerance: float, alike: bool = False
) -> tuple[Point, int, bool]:
    """The last point of steps from `begin`, how many there were, and whether it is within the
    tolerance (`Point.ends`) of a minimum; else it is the lowest one, from where another solver may
    go on. Where it is no matter (`alike`), the last one has the derivative of the one before it, if
    it is a minimum by that.
    """
    place = lowest = at(begin)
    before: list[Point] = []
    for steps in range(_MOST):
        if not place.certain:
            return lowest, steps, False
        if place.ends(tolerance):
            return place, steps, True
        after = at(place.theta + _onward(place, before))
        if alike:
            near = after.beside(place)
            ends = near.certain and near.cost <= place.cost and near.ends(tolerance)
            if ends and _same_derivative(place, after, tolerance):
                return near, steps + 1, True
        # Those of before a step that does not lead nearer are of another landscape.
        nearer = after.certain and after.cost <= place.cost and after.left < place.left
        before = [*before[1 - _SECANTS :], place] if nearer else []
        place = after
        if place.certain and place.cost < lowest.cost:
            lowest = place
    return lowest, _MOST, False


def _onward(place: Point, before: list[Point]) -> np.ndarray:
    """The step from a place: where Gauss-Newton alone is slow, together with those of before
    (`vcal.least_squares`), if the cost curves upwards along all of them.
    """
    if not before or place.left <= _LINEAR * before[-1].left:
        return place.step
    way = [*before, place]
    moved = place.seen(np.diff([p.theta for p in way], axis=0).T)
    changed = place.seen(np.diff([p.step for p in way], axis=0).T)
    further = anderson_step(place.foretold, moved, changed)
    # J'J times the change of a step is minus the Hessian times the move.
    lengths = np.linalg.norm(moved, axis=0)
    bends = -(moved.T @ changed) / np.outer(lengths, lengths)
    upwards = np.linalg.eigvalsh(bends + bends.T)[0] > -_FLAT
    if not upwards or np.linalg.norm(further) > _LONGER * place.left:
        return place.step
    return place.move(further)
