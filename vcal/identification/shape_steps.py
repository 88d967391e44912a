"""Steps of the shape parameters, with the amplitudes eliminated: variable projection.

At given shapes all amplitudes are optimal (Golub, Pereyra 1973, SIAM J. Numer. Anal. 10, 413). The
problem is linearised about these shapes *and* these amplitudes. With the amplitudes of another
point, the slopes would belong to another effect; where the measured effect is not exactly the
fitted one, such a slope may point downhill without end.

- A step goes as far as the linear model says, but no shape moves by more than one step of its scan.
- A shape at an end of its scan that would go further is held there; the step of the others is
  computed with it fixed.
- For an effect of a hundred times the noise, or one that only a few readings observe, the linear
  model is not valid that far. Where the cost with optimal amplitudes is larger after a step, the
  step is undone and a quarter of it is tried.
- Where steps do not converge, because they are repeatedly too long or too short, the last few are
  combined (`vcal.numerics.anderson`).
- The iteration ends where another step would change nothing, or at a corner of the cost.
"""

import math
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..model.forward import Model
from ..numerics.anderson import anderson_step
from .fit import shape_step

_PLAIN, _SECANTS = 4, 2
"""Number of steps after which the last few are combined, and how many changes are used."""
SETTLED = 1e-4
"""Predicted reduction of the cost (in units of the noise variance) below which shapes count as
converged: the parameters would move by less than a hundredth of their standard uncertainty."""
_CORNER = 1e-3
"""Largest predicted reduction of the cost that may remain at a corner, in the same unit."""


class Step(NamedTuple):
    """The step to the minimum of the problem that is linear in amplitudes and shapes."""

    amplitudes: np.ndarray
    """Amplitudes at the minimum (solver units)."""
    shapes: np.ndarray
    """Moves of the shapes to the minimum (solver units)."""
    gain: float
    """Reduction of the cost that the linear model predicts for the step."""


class LinearisedPoint(Protocol):
    """Some shapes, with all amplitudes optimal there, and the problem linearised about both."""

    @property
    def shapes(self) -> dict[int, dict[str, float]]:
        """Shape parameters by position of the effect in the model and by name, SI."""
        ...

    @property
    def cost(self) -> float:
        """The cost with optimal amplitudes, in units of the noise variance."""
        ...

    def step(self, still: np.ndarray) -> Step:
        """The step from here, with the shapes marked in `still` held fixed."""
        ...


P = TypeVar("P", bound=LinearisedPoint)


class ShapeSteps(Generic[P]):
    """The iteration over the shapes of a model on a plan.

    The caller alternates `converged`, with a point at the present shapes, and `propose`, which
    gives the next shapes. `settled` is the predicted reduction of the cost below which the
    iteration ends.
    """

    def __init__(self, model: Model, plan: Plan, settled: float = SETTLED):
        self._model, self._settled = model, settled
        self._scans = {i: e.scan(plan) for i, e in enumerate(model.effects) if e.shapes}
        self._reach = 1.0
        self._last: tuple[P, Step] | None = None
        self._visited: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []
        """Shapes visited, and the full step of the linear model from each (SI)."""
        self._taken, self._combined = 0, False
        """Number of steps that were not undone, and whether the present one is a combined step."""

    @property
    def last(self) -> P:
        """The last point that was not undone; after the end, the final point."""
        assert self._last is not None
        return self._last[0]

    def converged(self, point: P) -> bool:
        """Whether the iteration ends at this point, or at the last one: another step would change
        nothing, or the minimum is a corner.
        """
        step = self._step_from(point)
        if step.gain < self._settled:
            self._last = point, step
            return True
        if self._last is None:
            self._last = point, step
            self._remember()
            return False
        last, before = self._last
        change = (point.cost - step.gain) - (last.cost - before.gain)
        growing = change > self._settled or float(step.shapes @ step.shapes) > float(
            before.shapes @ before.shapes
        )
        if self._at_corner((point, step), self._last):
            self._last = min(((point, step), self._last), key=lambda one: one[0].cost)
            return True
        if growing and point.cost > last.cost + self._settled:
            if not self._combined:
                self._reach /= 4.0
            self._visited, self._steps = self._visited[-1:], self._steps[-1:]
            return False
        self._taken += 1
        if step.shapes @ before.shapes > 0.0:
            self._reach = min(1.0, 2.0 * self._reach)
        self._last = point, step
        self._remember()
        return False

    def propose(self) -> tuple[dict[int, dict[str, float]], np.ndarray]:
        """The next shapes (SI), and amplitudes (solver units) to start from."""
        assert self._last is not None
        point, step = self._last
        shapes = {i: dict(shape) for i, shape in point.shapes.items()}
        moving = self._moving(shapes)
        units = np.array([unit for _, _, unit, _, _ in moving])
        delta = self._reach * np.clip(self._next(units), -1.0, 1.0)
        for move, (i, p, unit, low, high) in zip(delta, moving, strict=True):
            shapes[i][p.name] = float(np.clip(shapes[i][p.name] + unit * move, low, high))
        return shapes, step.amplitudes

    def _step_from(self, point: P) -> Step:
        """The step from a point, with no shape beyond an end of its scan."""
        moving = self._moving(point.shapes)
        still = np.zeros(len(moving), bool)
        while True:
            step = point.step(still)
            further = ~still & self._beyond(point.shapes, step.shapes)
            if not further.any():
                return step
            still = still | further

    def _remember(self) -> None:
        assert self._last is not None
        point, step = self._last
        moving = self._moving(point.shapes)
        self._visited.append(np.array([point.shapes[i][p.name] for i, p, *_ in moving]))
        self._steps.append(np.array([unit for _, _, unit, _, _ in moving]) * step.shapes)

    def _next(self, units: np.ndarray) -> np.ndarray:
        """The full step from the last shapes, in these units."""
        step = self._steps[-1] / units
        self._combined = self._taken >= _PLAIN and len(self._steps) > _SECANTS
        if not self._combined:
            return step
        moved, changed = (
            np.diff(np.array(rows[-1 - _SECANTS :]), axis=0).T / units[:, None]
            for rows in (self._visited, self._steps)
        )
        return anderson_step(step, moved, changed)

    def _at_corner(self, one: tuple[P, Step], other: tuple[P, Step]) -> bool:
        """Whether the minimum is a corner of the cost between two points, with almost no reduction
        left.

        The step from each point passes the other point, so that no point between them has a slope
        of zero. An example is a kink at a measured position.
        """
        (here, mine), (there, its) = one, other
        if (mine.shapes * its.shapes > 0.0).any():
            return False
        apart = math.hypot(
            *(
                (here.shapes[i][p.name] - there.shapes[i][p.name]) / unit
                for i, p, unit, *_ in self._moving(there.shapes)
            )
        )
        shorter = min(float(np.linalg.norm(step.shapes)) for step in (mine, its))
        if not shorter > apart:  # also false for nan, where a problem has no solution
            return False
        # Along a step the linear model gains most at its start: twice its total gain per length.
        return 2.0 * max(mine.gain, its.gain) * apart / shorter < _CORNER

    def _beyond(self, shapes: dict[int, dict[str, float]], delta: np.ndarray) -> np.ndarray:
        """Which shapes are at an end of their scan and would move beyond it."""
        return np.array(
            [
                (move > 0.0 and shapes[i][p.name] >= high)
                or (move < 0.0 and shapes[i][p.name] <= low)
                for move, (i, p, _, low, high) in zip(delta, self._moving(shapes), strict=True)
            ],
            bool,
        )

    def _moving(
        self, shapes: dict[int, dict[str, float]]
    ) -> list[tuple[int, Parameter, float, float, float]]:
        """Every shape parameter that moves: the position of its effect in the model, the parameter,
        and the step of its scan at the present value and the ends of the scan (SI).
        """
        found = []
        for i, grids in self._scans.items():
            for p in self._model.effects[i].shapes:
                if p.moves:
                    step, grid = shape_step(p, shapes[i][p.name], grids), grids[p.name]
                    found.append((i, p, step, float(grid.min()), float(grid.max())))
        return found
