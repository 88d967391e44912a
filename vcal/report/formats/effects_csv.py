"""effects.csv: parameters of the identified and of the declared effects.

Source: the final fit of the closed loop.
Sign: parameters refer to the effect's own frame, as the catalogue defines each effect; a model or a
control that has the effect subtracts the error which the parameters describe.
Units: the unit of each parameter stands in its row, for value and uncertainty alike.
"""

import math

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit
from ...loop.outcome.closure import Closure
from ..loop.derived import declared, parameters, place_of
from .base import FORMATS, Format, Results, csv_text, number

_HEADER = "effect,placement,parameter,value,unit,standard_uncertainty,status,fitted_placement"


@FORMATS.register
class EffectsCsv(Format):
    """Parameters, one per line; source, sign rule and units as in the docstring of this file."""

    file = "effects.csv"
    summary = "parameters of the identified and declared effects"

    def text(self, results: Results) -> str:
        return effects_csv(results.closure)


def effects_csv(closure: Closure) -> str:
    """Parameters of the identified and declared effects as CSV, one per line.

    Those of an effect at one of several placements, ``"X|Y"``, apply to the placement that was
    fitted, in the last column.
    """
    rows: list[list[str]] = [[*_HEADER.split(",")]]
    effects = [
        (found.effect, found.placement, parameters(closure, found), found.status)
        for found in closure.effects
    ]
    effects += [(e, e.placement, listed, "declared") for e, listed in declared(closure)]
    for effect, placement, listed, status in effects:
        for name, value, unit, u in [*listed, *_amounts(closure.after, effect)]:
            cells = [name, number(value), unit, number(u)]
            rows.append([effect.name, placement, *cells, status, effect.placement])
    return csv_text(rows)


def _amounts(fit: Fit, effect: Effect) -> list[tuple[str, float, str, float]]:
    """Quantities that follow from the amplitudes of an effect (`Effect.amounts_to`)."""
    asked = effect.amounts_to
    if not asked:
        return []
    place = place_of(fit, effect)
    places, _ = fit.places_of(place)
    values = fit.values_of(place)
    steps = np.array([p.step / p.si for _, p, *_ in values[: len(places)]])
    found = {p.name: value for _, p, value, _ in values}
    covariance = fit.covariance[np.ix_(places, places)] * np.outer(steps, steps)
    amounts = []
    for name, unit, weights in asked:
        row = np.array([weights.get(p.name, 0.0) for p in effect.amplitudes])
        value = math.fsum(w * found[n] for n, w in weights.items())
        u = math.sqrt(max(float(row @ covariance @ row), 0.0))
        amounts.append((name, value, unit, u))
    return amounts
