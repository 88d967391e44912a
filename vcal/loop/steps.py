"""How well a shape parameter without a derivative is known: the moment of a jump."""

import math

import numpy as np

from .screen import Screen
from .state import State, without


def uncertainties(state: State, place: int, room: int) -> dict[str, float]:
    """Standard uncertainty (SI) of those of the effect at that position in the model, by name.

    Seen from the model without it, every interval between two of its edges has the evidence of a
    step there: about the value found, the second moment of the posterior, even within an interval.
    """
    effect, shape = state.model.effects[place], state.fit.shapes.get(place, {})
    edges = effect.edges(state.fit.measurement.plan)
    free = {p.name for p in effect.shapes if not p.known}
    edges = {name: values for name, values in edges.items() if name in free and len(values) > 1}
    if not edges:
        return {}
    less = without(state, place, room)
    if not less.converged:
        return dict.fromkeys(edges, math.nan)
    screen, found = Screen(less, 1, 0), {}
    for name, values in edges.items():
        middle, width = 0.5 * (values[1:] + values[:-1]), np.diff(values)
        grid = {n: np.full(len(middle), v) for n, v in shape.items()} | {name: middle}
        log_odds = screen.log_bayes(effect, grid) + np.log(width)
        odds = np.exp(log_odds - log_odds.max())
        squares = (middle - shape[name]) ** 2 + width**2 / 12.0
        found[name] = math.sqrt(float(odds @ squares / odds.sum()))
    return found
