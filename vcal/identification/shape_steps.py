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
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..model.forward import Model
from ..numerics.anderson import anderson_step
from .fit import shape_step

_PLAIN, _SECANTS = 4, 2
"""Steps after which the last few are taken together, and how many of their changes."""
SETTLED = 1e-4
"""What is left to gain (in units of the noise variance) below which shapes count as found: the
parameters would move by less than a hundredth of their standard uncertainty."""
_CORNER = 1e-3
"""What may be left to gain at a corner of the cost, in the same unit."""


class Step(NamedTuple):
    """Where the problem goes that is linear in amplitudes and shapes, from the place it is of."""

    amplitudes: np.ndarray
    """There (solver units)."""
    shapes: np.ndarray
    """By how much the shapes should move (solver units)."""
    gain: float
    """What that would take off the cost at the place."""


class Place(Protocol):
    """Some shapes, with all amplitudes at their best there."""

    @property
    def shapes(self) -> dict[int, dict[str, float]]:
        """By place in the model and name, SI."""
        ...

    @property
    def cost(self) -> float:
        """In units of the noise variance."""
        ...

    def step(self, still: np.ndarray) -> Step:
        """The step from there, with some of the shapes standing still."""
        ...


P = TypeVar("P", bound=Place)


class Walk(Generic[P]):
    """The way of the shapes of a model on a plan, until what is left to gain is less than that."""

    def __init__(self, model: Model, plan: Plan, settled: float = SETTLED):
        self._model, self._settled = model, settled
        self._scans = {i: e.scan(plan) for i, e in enumerate(model.effects) if e.shapes}
        self._reach = 1.0
        self._last: tuple[P, Step] | None = None
        self._places: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []
        """Shapes on the way, and by how much they should have moved from there (SI)."""
        self._taken, self._together = 0, False
        """Steps that were not taken back, and whether the next one is that of several together."""

    @property
    def last(self) -> P:
        """The last place that was not taken back; after the end, where it ended."""
        assert self._last is not None
        return self._last[0]

    def ends(self, place: P) -> bool:
        """Whether another step from there would change nothing any more."""
        step = self._step_from(place)
        if step.gain < self._settled:
            self._last = place, step
            return True
        if self._last is None:
            self._last = place, step
            self._remember()
            return False
        last, before = self._last
        change = (place.cost - step.gain) - (last.cost - before.gain)
        growing = change > self._settled or float(step.shapes @ step.shapes) > float(
            before.shapes @ before.shapes
        )
        if self._cornered((place, step), self._last):
            self._last = min(((place, step), self._last), key=lambda one: one[0].cost)
            return True
        if growing and place.cost > last.cost + self._settled:
            if not self._together:
                self._reach /= 4.0
            self._places, self._steps = self._places[-1:], self._steps[-1:]
            return False
        self._taken += 1
        if step.shapes @ before.shapes > 0.0:
            self._reach = min(1.0, 2.0 * self._reach)
        self._last = place, step
        self._remember()
        return False

    def onward(self) -> tuple[dict[int, dict[str, float]], np.ndarray]:
        """Shapes and amplitudes (solver units) to go on from."""
        assert self._last is not None
        place, step = self._last
        shapes = {i: dict(shape) for i, shape in place.shapes.items()}
        moving = self._moving(shapes)
        units = np.array([unit for _, _, unit, _, _ in moving])
        delta = self._reach * np.clip(self._next(units), -1.0, 1.0)
        for move, (i, p, unit, low, high) in zip(delta, moving, strict=True):
            shapes[i][p.name] = float(np.clip(shapes[i][p.name] + unit * move, low, high))
        return shapes, step.amplitudes

    def _step_from(self, place: P) -> Step:
        """The step from a place, none of the shapes beyond an end of its scan."""
        moving = self._moving(place.shapes)
        still = np.zeros(len(moving), bool)
        while True:
            step = place.step(still)
            further = ~still & self._beyond(place.shapes, step.shapes)
            if not further.any():
                return step
            still = still | further

    def _remember(self) -> None:
        assert self._last is not None
        place, step = self._last
        moving = self._moving(place.shapes)
        self._places.append(np.array([place.shapes[i][p.name] for i, p, *_ in moving]))
        self._steps.append(np.array([unit for _, _, unit, _, _ in moving]) * step.shapes)

    def _next(self, units: np.ndarray) -> np.ndarray:
        """Where to go from the last shapes, in those units."""
        step = self._steps[-1] / units
        self._together = self._taken >= _PLAIN and len(self._steps) > _SECANTS
        if not self._together:
            return step
        moved, changed = (
            np.diff(np.array(rows[-1 - _SECANTS :]), axis=0).T / units[:, None]
            for rows in (self._places, self._steps)
        )
        return anderson_step(step, moved, changed)

    def _cornered(self, one: tuple[P, Step], other: tuple[P, Step]) -> bool:
        """Whether the minimum is at a corner between two places, with next to nothing to gain: each
        would go past the other one, so that there is no place between them with a slope of zero (as
        of a kink at a position that was measured).
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
        if not shorter > apart:  # nor where a problem without a solution has no place
            return False
        # Along a step the linear model gains most at first: twice its whole gain over its length.
        return 2.0 * max(mine.gain, its.gain) * apart / shorter < _CORNER

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
