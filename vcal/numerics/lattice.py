"""Positions on a lattice: whole multiples of one step."""

import numpy as np

_FEWEST = 5
"""Least different values: fewer are on a lattice by chance, and show no wave."""
_PARTS = 12
"""Most parts of the smallest distance that the step may be."""


def lattice_step(values: np.ndarray, tolerance: float) -> float | None:
    """The largest step s for which all values (n,) are x0 + s times a whole number, to `tolerance`.

    None where there is none of at least a twelfth of the smallest distance, and of four times the
    tolerance; and for fewer than five different values.
    """
    places = np.unique(values)
    places = places[np.concatenate([[True], np.diff(places) > tolerance])]
    if len(places) < _FEWEST:
        return None
    away = places - places[0]
    for parts in range(1, _PARTS + 1):
        step = float(np.diff(places).min()) / parts
        if step < 4.0 * tolerance:
            return None
        # The first estimate holds for one distance; those further away refine it.
        for end in np.unique(np.geomspace(2, len(away), 8).astype(int)):
            whole = np.round(away[:end] / step)
            if whole.any():
                step = float(whole @ away[:end] / (whole @ whole))
        if np.abs(away - step * np.round(away / step)).max() <= tolerance:
            return step
    return None
