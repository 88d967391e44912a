"""Quantities derived from a closure: amplitudes and phases, and columns of the data file."""

import math

import numpy as np

from ...effects.base import Effect, harmonic_summary
from ...identification.fit import Fit
from ...instruments.conditions import in_file
from ...loop.outcome.closure import Closure, FoundEffect
from ...loop.outcome.unexplained import Unexplained
from ...loop.screening.candidates import Untestable
from ...machine.plan import Plan
from ...plots import column_of, place_of
from ..html.text import number

Listed = list[tuple[str, float, str, float]]
"""(name, value, unit, standard uncertainty) of the parameters of an effect."""
FEW = 6
"""Most parameters of a declared effect that are listed one by one."""


def parameters(closure: Closure, found: FoundEffect) -> Listed:
    """Parameters of an identified effect; sine and cosine also as amplitude A and phase phi of
    A sin(u + phi).
    """
    listed = [(n, float(v), unit, float(u)) for n, v, unit, u in found.parameters]
    return listed + _harmonics(closure.after, found.effect, listed)


def declared(closure: Closure) -> list[tuple[Effect, Listed]]:
    """The declared systematic effects except error motions, with the parameters of the final fit.

    The identified error motions apply only together with these effects.
    """
    fit, found = closure.after, []
    for effect in closure.before.model.effects:
        if effect.kind != "systematic" or effect.name == "geometric":
            continue
        values = fit.values_of(place_of(fit, effect))
        listed = [(p.name, float(value), p.unit, float(u)) for _, p, value, u in values]
        found.append((effect, listed + _harmonics(fit, effect, listed)))
    return found


def in_short(effect: Effect, listed: Listed) -> str:
    """Summary of many parameters of a declared effect: the largest change by the fit, in standard
    deviations of the prior.
    """
    priors = {p.name: p for p in (*effect.amplitudes, *effect.shapes)}
    moved = {
        name: abs(value - priors[name].mean) / priors[name].sigma
        for name, value, *_ in listed
        if name in priors and priors[name].informed and not priors[name].known
    }
    count = f"{len(listed)} declared values"
    if not moved:
        return count
    most = max(moved, key=lambda name: moved[name])
    return f"{count}; the fit moved {most} most, by {number(moved[most])} of its sigma"


def _harmonics(fit: Fit, effect: Effect, listed: Listed) -> Listed:
    place = place_of(fit, effect)
    first = fit.places_of(place)[0]
    amplitudes = fit.model.effects[place].amplitudes
    names = [p.name for p in amplitudes]
    values = {name: (value, unit) for name, value, unit, _ in listed}
    derived = []
    for name in names:
        suffix = name.removeprefix("sine")
        other = f"cosine{suffix}"
        if not name.startswith("sine") or other not in names:
            continue
        pair = [names.index(name), names.index(other)]
        scale = np.array([amplitudes[k].step / amplitudes[k].si for k in pair])
        covariance = fit.covariance[np.ix_(first[pair], first[pair])] * np.outer(scale, scale)
        sine, cosine = values[name][0], values[other][0]
        size, phase = harmonic_summary(sine, cosine)
        if size == 0.0:
            continue
        along = np.array([sine, cosine]) / size
        across = np.array([-cosine, sine]) / size**2
        derived += [
            (f"amplitude{suffix}", size, values[name][1], _root(along @ covariance @ along)),
            (f"phase{suffix}", phase, "rad", _root(across @ covariance @ across)),
        ]
    return derived


def _root(variance: np.ndarray | float) -> float:
    return math.sqrt(max(float(variance), 0.0))


def shares_by_column(what: Unexplained, plan: Plan) -> dict[str, float]:
    """Columns on which an unexplained residual depends, with their shares, largest first."""
    # Two internal names may stand for one column, such as joint angles and commanded angles.
    shares: dict[str, float] = {}
    for name, share in zip(what.depends_on, what.shares, strict=True):
        shares.setdefault(column_of(name, plan)[0], share)
    return shares


def intervals_in_file(what: Unexplained, fit: Fit) -> list[tuple[str, float, float]]:
    """Intervals of an unexplained residual: column, lowest and highest value as in the file."""
    plan, found = fit.measurement.plan, []
    for interval in what.where:
        low, high = (
            float(in_file(interval.covariate, v, plan, fit.model.instrument))
            for v in (interval.low, interval.high)
        )
        found.append((column_of(interval.covariate, plan)[0], low, high))
    return found


def missing_columns(item: Untestable, plan: Plan) -> list[str]:
    """Columns of the file that an effect lacks to be tested; empty where it lacks none."""
    return [_column(name, lacking, plan) for name, lacking in item.missing]


def untested_beside(closure: Closure, found: FoundEffect) -> dict[str, list[str]]:
    """Effects that could not be tested on the axis of an identified one, by their missing columns.

    Without its column such an effect may appear as another one: backlash of an axis whose direction
    of travel is not recorded, for instance.
    """
    plan = closure.after.measurement.plan
    places = {*found.placement.split("|"), found.effect.placement} & {*plan.axes}
    beside: dict[str, list[str]] = {}
    for item in closure.untestable:
        if item.placement in places and item.missing:
            columns = ", ".join(missing_columns(item, plan))
            beside.setdefault(columns, []).append(f"{item.effect} {item.placement}")
    return {columns: list(dict.fromkeys(keys)) for columns, keys in beside.items()}


def untested_in_words(beside: dict[str, list[str]]) -> str:
    """``"backlash C (no dir_c); thermal_tilt C (no T_c_degC)"``."""
    return "; ".join(f"{', '.join(keys)} (no {columns})" for columns, keys in beside.items())


def _column(name: str, lacking: tuple[str, ...], plan: Plan) -> str:
    column = column_of(name, plan)[0]
    if plan.sets and not lacking:  # every data set has its own
        return f"{column} shared by the data sets"
    if lacking != plan.sets:
        return f"{column} (not in {', '.join(lacking)})"
    # A time that restarts with every run is not one through all runs.
    if f"{name}_run" in plan.covariates:
        return f"{column} through all runs"
    other = next((c for c in plan.covariates if c.casefold() == column.casefold()), None)
    return f"{column} (rename {other})" if other else column
