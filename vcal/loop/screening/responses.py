"""The grid over an effect's shape parameters, and the response of the readings at its points."""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import jax
import numpy as np

from ...effects.base import Effect
from ...machine.plan import Plan

_ROOM = 2**28
"""Most bytes of responses that are cached."""

_NOTHING = 1e-30
"""Displacement, in solver units, that is taken as zero."""

Response = list[tuple[str, tuple[int, ...], np.ndarray]]
"""(port, amplitudes that act on it (a), displacement in solver units (g, a, n)) of every port."""


@dataclass(frozen=True)
class Scan:
    """The grid of an effect: all combinations of values of its shape parameters."""

    names: list[str]
    lengths: tuple[int, ...]
    mesh: np.ndarray
    """(steps, shape parameters); one step for an effect without shape parameters."""

    @classmethod
    def of(cls, effect: Effect, plan: Plan) -> "Scan":
        """The grid of an effect on a plan."""
        grids = effect.scan(plan)
        mesh = np.array(list(itertools.product(*grids.values()))) if grids else np.zeros((1, 0))
        return cls(list(grids), tuple(len(grid) for grid in grids.values()), mesh)

    def grid(self, rows: slice) -> dict[str, np.ndarray]:
        """Values of each shape parameter at some of the steps."""
        return {name: self.mesh[rows, i] for i, name in enumerate(self.names)}

    def parts(self, most: int) -> list[slice]:
        """All steps in order, in slices of at most `most`."""
        return [slice(i, min(i + most, len(self.mesh))) for i in range(0, len(self.mesh), most)]


def filled(scans: Iterable[tuple[int, Scan]], most: int) -> Iterator[list[tuple[int, slice]]]:
    """Slices of all grids in order, grouped so that a group has at most `most` steps; each with the
    index of its grid.

    A grid is always split at the same steps, independently of the other grids.
    """
    together, steps = [], 0
    for i, scan in scans:
        for part in scan.parts(most):
            size = part.stop - part.start
            if together and steps + size > most:
                yield together
                together, steps = [], 0
            together.append((i, part))
            steps += size
    if together:
        yield together


class Responses:
    """Responses of the rows of a plan to candidates.

    They are cached from one screening to the next while there is room (bytes), because most
    candidates are the same in every round.
    """

    def __init__(self, plan: Plan, room: int = _ROOM):
        self.plan, self._room = plan, room
        self._kept: dict[tuple, Response] = {}
        self._groups: dict[bytes, Responses] = {}
        self._blocks: dict[tuple[int, int], Responses] = {}

    def at(self, rows: np.ndarray) -> "Responses":
        """Responses of some rows only, by their numbers."""
        key = rows.tobytes()
        if key not in self._groups:
            self._groups[key] = Responses(self.plan.take(rows), self._room)
        return self._groups[key]

    def of_rows(self, rows: slice) -> "Responses":
        """Responses of a block of rows, which are not cached; the whole plan is itself."""
        if rows.stop - rows.start >= self.plan.rows:
            return self
        key = rows.start, rows.stop
        if key not in self._blocks:
            self._blocks[key] = Responses(self.plan.take(rows), 0)
        return self._blocks[key]

    def of(self, effect: Effect, grid: Mapping[str, np.ndarray]) -> Response:
        """Response to an effect at the values `grid` (g,) of its shape parameters, SI; g = 1 where
        it has none.
        """
        amplitudes = {p.name: (k, p.step) for k, p in enumerate(effect.amplitudes)}
        shape = {name: values[:, None] for name, values in grid.items()}
        size = len(next(iter(grid.values()))) if grid else 1
        ports: dict[str, list[tuple[int, float, np.ndarray]]] = {}
        for (port, name), phi in effect.response(self.plan, shape).items():
            ports.setdefault(port, []).append((*amplitudes[name], np.asarray(phi)))
        found = []
        for port, moved in ports.items():
            values = np.empty((size, len(moved), self.plan.rows))
            for i, (_, step, phi) in enumerate(moved):
                np.multiply(phi, step, out=values[:, i])
            # The tails of a bump have no place in single precision, and a processor is slow there.
            values[np.abs(values) < _NOTHING] = 0.0
            found.append((port, tuple(k for k, _, _ in moved), values))
        return found

    def scanned(self, effect: Effect, scan: Scan, rows: slice) -> Response:
        """The same at some steps of the effect's grid, cached."""
        leaves, structure = jax.tree.flatten(effect)
        values = tuple(np.asarray(leaf).tobytes() for leaf in leaves)
        key = structure, values, rows.start, rows.stop
        if (kept := self._kept.get(key)) is not None:
            return kept
        found = self.of(effect, scan.grid(rows))
        size = sum(phi.nbytes for *_, phi in found)
        if size <= self._room:
            self._kept[key] = found
            self._room -= size
        return found
