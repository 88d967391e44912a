"""Lines of an interferometer in a table: the axis that moves, directions of approach, checks."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from ..errors import RowError
from ..machine.chain import Chain
from ..machine.plan import Plan
from .conditions import LINEAR, file_column
from .line_setup import LINE, POSITION, STRAIGHT, Lines

_STILL_M, _STILL_RAD = 5e-5, 1e-4
"""Scatter of the positions of an axis that stands still, as read back."""
_FEWEST = 3
"""Least number of positions of a line: two determine zero and slope."""
_LARGEST = 0.02
"""Largest plausible deviation, as a share of the length of the line."""
_ALIKE = 0.02


def moving_axes(
    chain: Chain, line: Int[np.ndarray, " n"], position: Float[np.ndarray, "n axes"]
) -> tuple[str, ...]:
    """The axis that moves in every line, in the order of their numbers.

    Raises `RowError` for a line in which none, several, or a rotary axis moves, and for one of
    fewer than three positions.
    """
    still = np.array([_STILL_M if axis in LINEAR else _STILL_RAD for axis in chain.axes])
    found = []
    for number in np.unique(line):
        rows = np.flatnonzero(line == number)
        moved = np.ptp(position[rows], axis=0) > still
        names = [axis for axis, moves in zip(chain.axes, moved, strict=True) if moves]
        if len(names) != 1 or names[0] not in LINEAR:
            columns = [file_column(axis, chain.axes)[0] for axis in names]
            apart = np.abs(position[rows] - position[rows[0]]) > still
            raise RowError(
                int(rows[np.argmax(apart.any(1))]),
                f"column {', '.join(columns) or LINE}",
                f"line {number}, in which {' and '.join(names) or 'no axis'} "
                f"{'move' if len(names) > 1 else 'moves'}",
                "one linear axis that moves in every line; the others stand still",
                "give every set-up a number of its own in the column line",
            )
        places = np.unique(np.round(position[rows, chain.axes.index(names[0])] / _STILL_M))
        if len(places) < _FEWEST:
            raise RowError(
                int(rows[-1]),
                f"column {LINE}",
                f"{len(places)} positions in line {number}",
                f"at least {_FEWEST}, as zero and alignment of a line are unknown",
                "measure more positions, or correct the column line",
            )
        found.append(names[0])
    return tuple(found)


def approach_directions(plan: Plan, lines: Lines) -> dict[str, np.ndarray]:
    """Directions of approach (n,), +1 or -1, of the axes that move, by the covariate's name.

    A row was approached from the row before it in its line. One at the same position as the row
    before was approached anew from the other side, after the axis had turned beyond it (ISO 230-2,
    standard test cycle), and the first row of a line or run in the direction of the second. In
    lines of other axes, the direction is constant, so that it is part of the zero.
    """
    found = {f"dir_{axis}": np.ones(plan.rows) for axis in dict.fromkeys(lines.axes)}
    index = lines.index(plan)
    run = np.asarray(plan.groups["run"]) if "run" in plan.groups else np.zeros(plan.rows, int)
    for k, r in np.unique(np.column_stack([index, run]), axis=0):
        axis = lines.axes[k]
        rows = plan.in_time(np.flatnonzero((index == k) & (run == r)))
        x = np.asarray(plan.x(axis))[rows]
        move = np.diff(x, prepend=x[0])
        move[np.abs(move) <= _STILL_M] = 0.0
        # Without a move, the direction is that of the next one.
        for i in range(len(move) - 2, -1, -1):
            move[i] = move[i] or move[i + 1]
        for i in range(1, len(move)):
            move[i] = move[i] or -move[i - 1]
        found[f"dir_{axis}"][rows] = np.where(move < 0.0, -1.0, 1.0)
    return found


def check_deviations(
    table: Mapping[str, np.ndarray],
    line: Int[np.ndarray, " n"],
    lines: Lines,
    position: Float[np.ndarray, "n axes"],
    chain: Chain,
) -> None:
    """Raise `RowError` where readings are no deviations of a machine: they vary in a line by more
    than a fiftieth of its length. The cause is named where they follow the positions.
    """
    for k, number in enumerate(lines.numbers):
        rows = np.flatnonzero(line == number)
        x = 1e6 * position[rows, chain.axes.index(lines.axes[k])]
        for name in (POSITION, *STRAIGHT):
            column = f"{name}_um"
            if name not in lines.reads[k] or column not in table:
                continue
            values = np.asarray(table[column], float)[rows]
            if np.ptp(values) <= _LARGEST * np.ptp(x):
                continue
            slope = float(np.polyfit(x - x.mean(), values, 1)[0])
            near = next((f for f in (1.0, -1.0) if abs(slope - f) <= _ALIKE), 0.0)
            raise RowError(
                int(rows[np.argmax(np.abs(values - np.median(values)))]),
                f"column {column}",
                f"readings that vary by {1e-3 * np.ptp(values):.4g} mm over the "
                f"{1e-3 * np.ptp(x):.4g} mm of line {number}",
                f"deviations from the commanded positions, within {100 * _LARGEST:g} % of that",
                "they follow the commanded positions"
                + (" with the other sign" if near < 0 else "")
                + ": subtract these from the measured ones"
                if near
                else "correct the unit of the readings, or the column line",
            )
