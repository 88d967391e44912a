"""The space of an interferometer: the targets of every line, and where the lines are."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...instruments.conditions import LINEAR
from ...instruments.interferometer import Interferometer
from ...machine.chain import Chain
from ...model.forward import Model
from ...numerics.arrays import Array
from ..plan_space import Subject, Varied, register
from .points import Placed, PointsDesign, PointSpace

_SAME_M = 2e-4
"""Positions of a line that are closer are one target, which all of its runs visit."""


class InterferometerDesign(PointsDesign):
    """Keys of ``[design]`` for ``kind = "interferometer"``; its points are targets."""

    places: bool = False
    """Whether the lines may be anywhere in the travel of the axes that stand still."""


@register
@dataclass(frozen=True)
class InterferometerSpace(PointSpace):
    """Targets of every line within the travel of its axis, the same in all of its runs, and the
    positions of the axes that stand still.

    The set-ups themselves (moving axis, readings, place of the reflector, alignment) and the
    directions of approach are those of the plan. Rotary axes are not placed.
    """

    kind = "interferometer"
    Settings = InterferometerDesign

    targets: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    """Index of the target of every row (n,)."""
    lines: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    """Index of the line of every row (n,)."""

    # --- construction ---------------------------------------------------------------------------
    @classmethod
    def of(cls, subject: Subject, model: Model, settings: InterferometerDesign) -> Self:
        return super().of(subject, model, settings)._indexed()

    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        # Further targets belong to the last line, whose other axes stay where they are.
        space = super().following(count, varied)
        settings = self.settings.model_copy(update={"points": True, "places": False})
        position = np.repeat(self.position[-1:], count, 0)
        axis = self._moving[-1]
        position[:, axis] = np.linspace(*self.chain.travel[axis], num=count)
        return dataclasses.replace(space, position=position, settings=settings)._indexed()

    def _indexed(self) -> Self:
        assert isinstance(self.device, Interferometer)
        lines = np.searchsorted(self.device.lines.numbers, self.index["line"])
        column = [self.chain.axes.index(axis) for axis in self.device.lines.axes]
        x = self.position[np.arange(len(lines)), np.array(column)[lines]]
        keys = np.column_stack([lines, np.round(x / _SAME_M)])
        targets = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        return dataclasses.replace(self, lines=lines, targets=targets)

    @property
    def _moving(self) -> np.ndarray:
        """Column of the moving axis of every row (n,)."""
        column = [self.chain.axes.index(axis) for axis in self.device.lines.axes]
        return np.array(column)[self.lines]

    @property
    def _still(self) -> np.ndarray:
        """Line and column (s, 2) of the axes that stand still in every line."""
        linear = [i for i, axis in enumerate(self.chain.axes) if axis in LINEAR]
        moving = dict(zip(self.lines.tolist(), self._moving.tolist(), strict=True))
        return np.array([(line, i) for line in moving for i in linear if i != moving[line]])

    # --- numbers within bounds ------------------------------------------------------------------
    @property
    def start(self) -> Float[np.ndarray, " d"]:
        parts, rows = [], np.arange(len(self.targets))
        low, high = self.chain.travel.T
        shares = (self.position - low) / (high - low)
        if self.settings.points:
            first = np.unique(self.targets, return_index=True)[1]
            parts.append(shares[rows, self._moving][first])
        if self.settings.places:
            row = {int(line): int(np.argmax(self.lines == line)) for line in np.unique(self.lines)}
            parts.append(np.array([shares[row[int(line)], i] for line, i in self._still]))
        parts.append(0.5 * (self._ends(0) + self._ends(1)))
        return np.clip(np.concatenate(parts), self.low, self.high)

    @property
    def _placed_numbers(self) -> int:
        points = len(np.unique(self.targets)) * self.settings.points
        return points + len(self._still) * self.settings.places

    # --- the placed measurement -----------------------------------------------------------------
    def placed(self, z: Float[Array, " d"]) -> Placed:
        position, used = jnp.asarray(self.position), 0
        low, high = (jnp.asarray(ends) for ends in self.chain.travel.T)
        rows = np.arange(len(self.targets))
        if self.settings.points:
            used = len(np.unique(self.targets))
            share = z[:used][self.targets]
            axis = self._moving
            moved = low[axis] + (high - low)[axis] * share
            position = position.at[rows, axis].set(moved)
        if self.settings.places:
            for k, (line, i) in enumerate(self._still):
                mine = np.flatnonzero(self.lines == line)
                position = position.at[mine, i].set(low[i] + (high - low)[i] * z[used + k])
            used += len(self._still)
        covariates = dict(self.known)
        n = len(self.numbering)
        for varied, values in zip(self.varied, z[used:].reshape(-1, n), strict=True):
            covariates[varied.name] = values
        return Placed(position, covariates, jnp.zeros(0))

    def standing(self, station: Float[Array, " s"]) -> Interferometer:
        del station
        return self.device

    @classmethod
    def follows(cls, chain: Chain) -> tuple[str, ...]:
        del chain
        return ()

    def following_from(self, placed: Placed) -> Mapping[str, Any]:
        del placed
        return {}
