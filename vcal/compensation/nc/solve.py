"""Corrections at many positions: the command whose displaced tool point is the wanted one."""

from typing import NamedTuple

import numpy as np

from ...errors import StudyError
from .options import Displacement

SIZES = (256, 2048, 16384)
"""Numbers of rows with which a displacement is called, so that few programs are compiled."""
_CONVERGED_M = 1e-9
_ITERATIONS = 20


class Points(NamedTuple):
    """Wanted positions (n, 3) and directions (n, 3), m, with the tool lengths (n,) or None."""

    positions: np.ndarray
    directions: np.ndarray
    tool_lengths: np.ndarray | None


def evaluate(displacement: Displacement, points: Points) -> np.ndarray:
    """Displacements (n, 3), m, in calls of few sizes; the last rows are padding.

    Raises `StudyError` where the displacement is not a number.
    """
    n = len(points.positions)
    found = np.empty((n, 3))
    at = 0
    while at < n:
        left = n - at
        size = next((s for s in SIZES if s >= left), SIZES[-1])
        rows = slice(at, min(at + size, n))
        padded = [_padded(a[rows], size) for a in points if a is not None]
        found[rows] = np.asarray(displacement(*padded))[: rows.stop - at]
        at = rows.stop
    if not np.isfinite(found).all():
        worst = 1e3 * points.positions[~np.isfinite(found).all(axis=1)][0]
        where = ", ".join(f"{c} = {v:.3f} mm" for c, v in zip("XYZ", worst, strict=True))
        raise StudyError(
            f"displacement at {where}: found no finite number, expected one; check that the "
            "program and its work offsets lie within the calibrated travels"
        )
    return found


def _padded(values: np.ndarray, size: int) -> np.ndarray:
    if len(values) == size:
        return values
    return np.concatenate([values, np.repeat(values[-1:], size - len(values), axis=0)])


def corrections(displacement: Displacement, points: Points) -> np.ndarray:
    """Corrections c (n, 3), m, with c = -displacement(p + c): fixed-point iteration to 1e-9 m.

    The iteration contracts by the slope of the displacement, some 1e-4. The error after a step of
    length s is at most s q / (1 - q) with the observed ratio q of two steps. Raises `StudyError`
    where it does not converge.
    """
    found = -evaluate(displacement, points)
    step = np.linalg.norm(found, axis=1)
    open_rows = np.flatnonzero(step > 0.0)
    for _ in range(_ITERATIONS):
        if not len(open_rows):
            return found
        tools = points.tool_lengths
        part = Points(
            points.positions[open_rows] + found[open_rows],
            points.directions[open_rows],
            None if tools is None else tools[open_rows],
        )
        better = -evaluate(displacement, part)
        length = np.linalg.norm(better - found[open_rows], axis=1)
        ratio = length / np.maximum(step[open_rows], 1e-300)
        found[open_rows], step[open_rows] = better, length
        bound = np.where(ratio < 0.5, length * ratio / (1.0 - np.minimum(ratio, 0.5)), length)
        open_rows = open_rows[bound > _CONVERGED_M]
    worst = 1e3 * points.positions[open_rows[0]]
    where = ", ".join(f"{c} = {v:.3f} mm" for c, v in zip("XYZ", worst, strict=True))
    raise StudyError(
        f"displacement at {where}: found a slope with which the correction does not converge, "
        "expected errors that change by far less than the position; check the identified errors"
    )
