"""Corrections on a grid, linear in the conditions, and their interpolation as controls do it.

    c(q, s) = c0(q) + sum_j (s_j - s_j0) g_j(q)

with trilinear interpolation between the nodes; beyond the grid, the value at its edge holds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .machine import IdentifiedMachine

_DIR = "dir_"


@dataclass(frozen=True)
class Field:
    """Corrections of the commands of linear axes on a grid."""

    axes: tuple[str, ...]
    """Axes on which the corrections depend, in the order of `lines`."""
    lines: tuple[Float[np.ndarray, " nodes"], ...]
    """Ascending positions of the nodes of every axis, m or rad."""
    base: Float[np.ndarray, "*nodes c"]
    """c0, for the corrected axes, m."""
    corrected: tuple[str, ...]
    """Axes that are corrected, in the order of the last dimension."""
    slopes: Mapping[str, Float[np.ndarray, "*nodes c"]]
    """g of every condition, m per unit (direction: 1; temperature: K)."""
    zeros: Mapping[str, float]
    """s0 of every condition."""

    def rounded(self, step_m: float) -> "Field":
        """The field with values in whole multiples of `step_m`; slopes are not rounded."""
        return Field(
            self.axes,
            self.lines,
            np.round(self.base / step_m) * step_m,
            self.corrected,
            self.slopes,
            self.zeros,
        )

    def at(
        self,
        position: Float[np.ndarray, "n axes"],
        conditions: Mapping[str, Float[np.ndarray, " n"]],
    ) -> Float[np.ndarray, "n c"]:
        """Corrections (n, c), m, at positions (n, axes) in the order of `axes`."""
        found = interpolated(self.lines, self.base, position)
        for name, slope in self.slopes.items():
            amount = np.asarray(conditions[name], float) - self.zeros[name]
            found = found + amount[:, None] * interpolated(self.lines, slope, position)
        return found


def field_of(
    machine: IdentifiedMachine,
    lines: Sequence[Float[np.ndarray, " nodes"]],
    conditions: Sequence[str],
    at: Mapping[str, float],
) -> Field:
    """The corrections of a machine on the grid of `lines` (one per axis, m or rad), linear in those
    of `conditions` on which it depends (`IdentifiedMachine.varying`).

    Every other condition, and s0 of these, has its value in `at`, or else `at_rest`.
    """
    position = np.stack([v.ravel() for v in np.meshgrid(*lines, indexing="ij")], 1)
    shape = (*(len(line) for line in lines), len(machine.linear))
    varying = [name for name in conditions if name in machine.varying]
    zeros = {name: at.get(name, machine.at_rest(name)) for name in varying}

    def corrections(name: str = "", change: float = 0.0) -> np.ndarray:
        directions = np.zeros_like(position)
        given = dict(at)
        if name.startswith(_DIR):
            directions[:, machine.axes.index(name.removeprefix(_DIR))] = change
        elif name:
            given[name] = zeros[name] + change
        return machine.correction(position, directions, given)[:, machine.linear].reshape(shape)

    slopes = {name: (corrections(name, 1.0) - corrections(name, -1.0)) / 2.0 for name in varying}
    return Field(
        tuple(machine.axes),
        tuple(np.asarray(line, float) for line in lines),
        corrections(),
        tuple(machine.axes[i] for i in machine.linear),
        slopes,
        zeros,
    )


def conditions_of(
    field: Field,
    machine: IdentifiedMachine,
    directions: Float[np.ndarray, "n axes"],
    covariates: Mapping[str, Float[np.ndarray, " n"] | float],
) -> dict[str, Float[np.ndarray, " n"]]:
    """The conditions of a field in every row; those that are not given are at its zero."""
    rows = len(directions)
    found = {}
    for name in field.slopes:
        if name.startswith(_DIR):
            found[name] = np.asarray(directions, float)[:, machine.axes.index(name[len(_DIR) :])]
        else:
            found[name] = np.broadcast_to(
                np.asarray(covariates.get(name, field.zeros[name]), float), (rows,)
            )
    return found


def interpolated(
    lines: Sequence[Float[np.ndarray, " nodes"]],
    values: Float[np.ndarray, "*nodes c"],
    position: Float[np.ndarray, "n axes"],
) -> Float[np.ndarray, "n c"]:
    """Multilinear interpolation; beyond the ends of a line, the value at its end holds."""
    size = len(lines)
    below, share = [], []
    for line, x in zip(lines, np.asarray(position, float).T, strict=True):
        if len(line) == 1:
            below.append(np.zeros(len(x), int))
            share.append(np.zeros(len(x)))
            continue
        cell = np.clip(np.searchsorted(line, x, side="right") - 1, 0, len(line) - 2)
        below.append(cell)
        share.append(np.clip((x - line[cell]) / (line[cell + 1] - line[cell]), 0.0, 1.0))
    found = np.zeros((len(position), values.shape[-1]))
    for corner in np.ndindex(*(2,) * size):
        weight = np.ones(len(position))
        index = []
        for k, (cell, part) in enumerate(zip(below, share, strict=True)):
            weight = weight * (part if corner[k] else 1.0 - part)
            index.append(np.minimum(cell + corner[k], len(lines[k]) - 1))
        found += weight[:, None] * values[tuple(index)]
    return found


def spaced(low: float, high: float, points: int) -> Float[np.ndarray, " points"]:
    """Positions of `points` nodes from `low` to `high`."""
    return np.linspace(low, high, points)
