"""The way of shape parameters from one linear problem to the next.

Linear about some shapes is linear about the amplitudes that are at their best there: with those of
another place the slopes are of another effect, and where what was measured is not quite the effect
that is fitted, one may seem to lead down for ever. A step goes as far as the linear model says, but
no shape by more than one step of its scan. One that stands at an end of its scan and would go
further stands still, and all others are found beside it. Of an effect that is a hundred times the
noise the linear model does not hold as far as that, nor of one that a few readings see from afar:
where all amplitudes at their best then leave more than before, the step is taken back, and a
quarter of it is tried. Where steps come to no end, too long again and again or too short, the last
few of them tell together how far to go (Anderson 1965, J. ACM 12, 547). The way ends where another
step would change nothing, or at a corner of the cost.
"""

import math
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import numpy as np

from .fit import shape_step
from .model import Model
from .parameters import Parameter
from .plan import Plan

_PLAIN, _SECANTS = 4, 2
"""Steps after which the last few are taken together, and how many of their changes."""
SETTLED = 1e-4
"""What is left to gain (in units of the noise variance) below which shapes count as found: the
parameters would move by less than a hundredth of their standard uncertainty."""
_CORNER = 1e-3
"""What may be left to gain at a corner of the cost, in the same unit."""


class Solved(Protocol):
    """The solution of the problem that is linear in the shapes, about some of them."""

    @property
    def shapes(self) -> dict[int, dict[str, float]]:
        """By place in the model and name, SI."""
        ...

    @property
    def found(self) -> np.ndarray:
        """Amplitudes, and by how much the shapes should move (solver units)."""
        ...

    @property
    def steps(self) -> int:
        """That the solution took."""
        ...

    @property
    def cost(self) -> float:
        """In units of the noise variance, with the shapes moved as the linear model has it."""
        ...

    def amplitudes(self, count: int) -> np.ndarray:
        """What was found, the shapes where they are."""
        ...


S = TypeVar("S", bound=Solved)


class Walk(Generic[S]):
    """The way of the shapes of a model, which has so many amplitudes, on a plan.

    `solve` gives the solution of the problem that is linear about some shapes, from parameters to
    begin at (solver units), with some of the shapes standing still.
    """

    def __init__(
        self,
        model: Model,
        plan: Plan,
        amplitudes: int,
        solve: Callable[[dict[int, dict[str, float]], np.ndarray, np.ndarray], S],
    ):
        self._model, self._amplitudes = model, amplitudes
        self._solve = solve
        self._scans = {i: e.scan(plan) for i, e in enumerate(model.effects) if e.shapes}
        self._reach = 1.0
        self._last: S | None = None
        self._stood: list[tuple[S, S]] = []
        """The last one and the one after it, and the same with all shapes where they are."""
        self._places: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []
        """Shapes on the way, and by how much they should have moved from there (SI)."""
        self._taken, self._together = 0, False
        """Steps that were not taken back, and whether the next one is that of several together."""

    def solved(self, shapes: dict[int, dict[str, float]], begin: np.ndarray) -> tuple[S, int]:
        """The linear problem about these shapes, and the steps its solution took."""
        still = np.zeros(len(begin) - self._amplitudes, bool)
        if not len(still):
            it = self._solve(shapes, begin, still)
            return it, it.steps
        stood = self._solve(shapes, begin, ~still)
        steps, begin = stood.steps, stood.amplitudes(self._amplitudes)
        while True:
            it = self._solve(shapes, begin, still)
            steps += it.steps
            further = ~still & self._beyond(shapes, it.found[self._amplitudes :])
            if not further.any():
                kept = [pair for pair in self._stood if pair[0] is self._last]
                self._stood = [*kept, (it, stood)]
                return it, steps
            still = still | further

    @property
    def last(self) -> S:
        """The last that was not taken back; after the end, where it ended."""
        assert self._last is not None
        return self._last

    @property
    def standing(self) -> S:
        """The same with all shapes where they are."""
        return self._standing(self.last)

    def ends(self, it: S) -> bool:
        """Whether another step would change nothing any more."""
        if self._standing(it).cost - it.cost < SETTLED:
            self._last = it
            return True
        if self._last is None:
            self._last = it
            self._remember(it)
            return False
        change, k = it.cost - self._last.cost, self._amplitudes
        step, before = it.found[k:], self._last.found[k:]
        growing = change > SETTLED or float(step @ step) > float(before @ before)
        if self._cornered(it, self._last):
            self._last = min((it, self._last), key=lambda one: self._standing(one).cost)
            return True
        if growing and self._rises(it):
            if not self._together:
                self._reach /= 4.0
            self._places, self._steps = self._places[-1:], self._steps[-1:]
            return False
        self._taken += 1
        if step @ before > 0.0:
            self._reach = min(1.0, 2.0 * self._reach)
        self._last = it
        self._remember(it)
        return False

    def onward(self) -> tuple[dict[int, dict[str, float]], np.ndarray]:
        """Shapes and amplitudes (solver units) to go on from."""
        shapes = {i: dict(shape) for i, shape in self.last.shapes.items()}
        moving = self._moving(shapes)
        units = np.array([step for _, _, step, _, _ in moving])
        delta = self._reach * np.clip(self._step(units), -1.0, 1.0)
        for move, (i, p, step, low, high) in zip(delta, moving, strict=True):
            shapes[i][p.name] = float(np.clip(shapes[i][p.name] + step * move, low, high))
        return shapes, self.last.amplitudes(self._amplitudes)

    def _remember(self, it: S) -> None:
        moving = self._moving(it.shapes)
        self._places.append(np.array([it.shapes[i][p.name] for i, p, *_ in moving]))
        units = np.array([step for _, _, step, _, _ in moving])
        self._steps.append(units * it.found[self._amplitudes :])

    def _step(self, units: np.ndarray) -> np.ndarray:
        """Where to go from the last shapes, in those units."""
        step = self._steps[-1] / units
        self._together = self._taken >= _PLAIN and len(self._steps) > _SECANTS
        if not self._together:
            return step
        moved, changed = (
            np.diff(np.array(rows[-1 - _SECANTS :]), axis=0).T / units[:, None]
            for rows in (self._places, self._steps)
        )
        weights = np.linalg.lstsq(changed, step, rcond=1e-6)[0]
        return step - (moved + changed) @ weights

    def _rises(self, it: S) -> bool:
        return self._standing(it).cost > self._standing(self.last).cost + SETTLED

    def _standing(self, it: S) -> S:
        return next(stood for known, stood in self._stood if known is it)

    def _cornered(self, it: S, last: S) -> bool:
        """Whether the minimum is at a corner between two places, with next to nothing to gain: each
        would go past the other one, so that there is no place between them with a slope of zero (as
        of a kink at a position that was measured).
        """
        steps = [one.found[self._amplitudes :] for one in (it, last)]
        if (steps[0] * steps[1] > 0.0).any():
            return False
        units = self._moving(last.shapes)
        apart = math.hypot(
            *((it.shapes[i][p.name] - last.shapes[i][p.name]) / step for i, p, step, *_ in units)
        )
        shorter = min(float(np.linalg.norm(step)) for step in steps)
        if not shorter > apart:  # nor where a problem without a solution has no place
            return False
        # Along a step the linear model gains most at first: twice its whole gain over its length.
        gain = max(self._standing(one).cost - one.cost for one in (it, last))
        return 2.0 * gain * apart / shorter < _CORNER

    def _beyond(self, shapes: dict[int, dict[str, float]], delta: np.ndarray) -> np.ndarray:
        """Which shapes stand at an end of their scan and would go further."""
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
        """Every shape parameter that moves: its effect's place, the step of its scan there and the
        ends of that (SI).
        """
        found = []
        for i, grids in self._scans.items():
            for p in self._model.effects[i].shapes:
                if p.moves:
                    step, grid = shape_step(p, shapes[i][p.name], grids), grids[p.name]
                    found.append((i, p, step, float(grid.min()), float(grid.max())))
        return found
