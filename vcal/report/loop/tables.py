"""Error motions and named effects as tables: what a control, or another program, compensates."""

import csv
import io
import math
from collections.abc import Sequence

import numpy as np

from ...effects.base import Effect
from ...geometry.error_motions import ErrorMotionTable
from ...identification.fit import Fit
from ...loop.outcome.closure import Closure
from .derived import declared, parameters, place_of


def compensation_csv(tables: Sequence[ErrorMotionTable]) -> str:
    """The tables as CSV in long format, one position of one error motion per line.

    Columns: component (ISO 230-1 name), axis, position_mm and/or position_deg, value, unit,
    standard_uncertainty, information_share (1 - variance after / variance before the measurement,
    both without what other effects would foretell instead, which the uncertainty holds). Location
    errors have no position.
    """
    units = sorted({t.position_unit for t in tables} or {"mm"}, reverse=True)
    rows = [
        ["component", "axis", *(f"position_{u}" for u in units), "value", "unit",
         "standard_uncertainty", "information_share"]
    ]  # fmt: skip
    for t in tables:
        for k in range(len(t.value)):
            place = [
                _number(t.position[k]) if len(t.position) and u == t.position_unit else ""
                for u in units
            ]
            numbers = [_number(v) for v in (t.value[k], t.u[k], t.information[k])]
            rows.append([t.name, t.axis, *place, numbers[0], t.unit, *numbers[1:]])
    return _csv(rows)


def effects_csv(closure: Closure) -> str:
    """Parameters of the effects that were found and of those that were declared, as CSV, one per
    line. Those of an effect at one of several placements, ``"X|Y"``, are what they are at the
    placement that was fitted, in the last column.
    """
    header = "effect,placement,parameter,value,unit,standard_uncertainty,status,fitted_placement"
    rows: list[list[str]] = [[*header.split(",")]]
    effects = [
        (found.effect, found.placement, parameters(closure, found), found.status)
        for found in closure.effects
    ]
    effects += [(e, e.placement, listed, "declared") for e, listed in declared(closure)]
    for effect, placement, listed, status in effects:
        for name, value, unit, u in listed:
            numbers = [name, _number(value), unit, _number(u)]
            rows.append([effect.name, placement, *numbers, status, effect.placement])
        for name, unit, value, u in _amounts(closure.after, effect):
            numbers = [name, _number(value), unit, _number(u)]
            rows.append([effect.name, placement, *numbers, status, effect.placement])
    return _csv(rows)


def _amounts(fit: Fit, effect: Effect) -> list[tuple[str, str, float, float]]:
    """What the amplitudes of an effect amount to on any plan (`Effect.amounts_to`)."""
    asked = effect.amounts_to
    if not asked:
        return []
    place = place_of(fit, effect)
    places, _ = fit.places_of(place)
    values = fit.values_of(place)
    steps = np.array([p.step / p.si for _, p, *_ in values[: len(places)]])
    found = {p.name: value for _, p, value, _ in values}
    covariance = fit.covariance[np.ix_(places, places)] * np.outer(steps, steps)
    told = []
    for name, unit, weights in asked:
        row = np.array([weights.get(p.name, 0.0) for p in effect.amplitudes])
        value = math.fsum(w * found[n] for n, w in weights.items())
        told.append((name, unit, value, math.sqrt(max(float(row @ covariance @ row), 0.0))))
    return told


def _number(value: float) -> str:
    return f"{value:.8g}" if math.isfinite(value) else ""


def _csv(rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
