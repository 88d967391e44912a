"""Error motions and named effects as tables: what a control, or another program, compensates."""

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..effects.base import Effect
from ..fit import Fit
from ..loop.closure import Closure
from ..loop.doubt import Doubt, of_doubts
from ..plan import Plan
from ..plots import ErrorMotionTable
from ..units import si_factor
from .derived import declared, parameters, place_of

NODES = 41
_GEOMETRY = ("geometric", "geometric_order")
_LOCATION = re.compile(r"E[ABCXYZ]0\w+")


def error_motion_tables(
    fit: Fit, nodes: int = NODES, doubts: Sequence[Doubt] = ()
) -> list[ErrorMotionTable]:
    """Every error motion on `nodes` positions over its axis's travel (or the range used, where no
    travel is declared), then the location errors.

    Value and standard uncertainty are those of the posterior, E = F theta and sqrt(F C F'), with
    F the family's functions; refinements by `geometric_order` are included. Where the effects in
    `doubts` may be others, with which error motions are not the same, that is part of the
    uncertainty.
    """
    lines = [line_of(fit, axis, nodes) for axis in fit.model.chain.axes]
    functions = functions_on(fit, lines)
    spread = Spread.of_fit(fit)
    doubted = _doubted(doubts, lines, {name: len(mean) for name, (_, mean) in functions.items()})
    return [
        _table(name, *functions[name], doubted[name], fit, spread, lines)
        for name in _sorted(functions, fit.model.chain.axes)
    ]


def functions_on(fit: Fit, lines: Sequence[np.ndarray]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """F (nodes, k) of every error motion on these positions of every axis, or (1, k) of a location
    error, and its mean, SI.
    """
    model, nodes = fit.model, len(lines[0])
    # As many rows as the measurement has, the last one repeated: shapes that are compiled already.
    rows = np.minimum(np.arange(max(nodes, fit.measurement.rows)), nodes - 1)
    on_lines = Plan(model.chain.axes, np.stack(lines, axis=1)[rows])
    columns: dict[str, np.ndarray] = {}
    means: dict[str, np.ndarray] = {}
    for effect, place in zip(model.effects, model.places, strict=True):
        if effect.name not in _GEOMETRY:
            continue
        amplitudes = {p.name: (k, p) for k, p in enumerate(effect.amplitudes, place.start)}
        for (port, amplitude), response in effect.response(on_lines, {}).items():
            k, p = amplitudes[amplitude]
            located = _LOCATION.fullmatch(amplitude)
            name = amplitude if located else port
            full = np.broadcast_to(np.asarray(response), rows.shape)[:nodes]
            column = np.ones(1) if located else full
            block = columns.setdefault(name, np.zeros((len(column), len(fit.theta))))
            block[:, k] = column * p.step  # a location error has several ports: the same once
            mean = means.setdefault(name, np.zeros(len(column)))
            if not located or not mean.any():
                means[name] = mean + column * p.mean * p.si
    return {name: (block, means[name]) for name, block in columns.items()}


def _doubted(
    doubts: Sequence[Doubt], lines: Sequence[np.ndarray], sizes: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Variance of every error motion of so many nodes, m^2 or rad^2, by what effects may be
    instead.
    """

    def of(fit: Fit) -> np.ndarray:
        functions = functions_on(fit, lines)
        found = {name: mean + block @ fit.theta for name, (block, mean) in functions.items()}
        # What one of them has and another has not, such as a degree more, is nothing there.
        return np.concatenate([found.get(name, np.zeros(n)) for name, n in sizes.items()])

    if not sizes:
        return {}  # no error motions are declared, as for circles of an R-test
    variance = of_doubts(doubts, of, np.zeros(sum(sizes.values())))
    parts = np.split(variance, np.cumsum(list(sizes.values()))[:-1])
    return dict(zip(sizes, parts, strict=True))


@dataclass(frozen=True)
class Spread:
    """Covariances of theta: as stated, as planned, and the diagonal of the prior's."""

    stated: np.ndarray
    planned: np.ndarray
    prior: np.ndarray

    @classmethod
    def of_fit(cls, fit: Fit) -> "Spread":
        """Those of a fit."""
        proper = fit.precision > 0
        return cls(
            stated=fit.covariance,
            planned=fit.planned_covariance,
            prior=np.where(proper, 1.0 / np.where(proper, fit.precision, 1.0), 0.0),
        )

    def of(self, block: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Standard uncertainty, prior standard deviation and share of information of F theta."""
        stated, planned = (
            ((block @ matrix) * block).sum(1) for matrix in (self.stated, self.planned)
        )
        prior = block**2 @ self.prior
        information = 1.0 - planned / np.where(prior > 0, prior, np.inf)
        information = np.where(prior > 0, np.clip(information, 0.0, 1.0), 0.0)
        return np.sqrt(np.maximum(stated, 0.0)), np.sqrt(prior), information


def _sorted(names: Iterable[str], axes: Sequence[str]) -> list[str]:
    """Error motions axis by axis, then location errors."""
    order = [f"E{c}{axis}" for axis in axes for c in "XYZABC"]
    return sorted(names, key=lambda name: order.index(name) if name in order else len(order))


def line_of(fit: Fit, axis: str, nodes: int) -> np.ndarray:
    """So many positions of an axis over its travel, or over the range used where it has none."""
    joint = fit.model.chain.joint(axis)
    low, high = np.asarray(joint.travel, float)
    if joint.kind == "revolute" or not (math.isfinite(low) and math.isfinite(high)):
        x = np.asarray(fit.measurement.plan.x(axis), float)
        low, high = x.min(), x.max()
    return np.linspace(low, high, nodes)


def _table(
    name: str,
    block: np.ndarray,
    mean: np.ndarray,
    doubted: np.ndarray,
    fit: Fit,
    spread: Spread,
    lines: Sequence[np.ndarray],
) -> ErrorMotionTable:
    axes = fit.model.chain.axes
    located = _LOCATION.fullmatch(name) is not None
    axis = name[3:] if located else name[2:]
    unit = "um" if name[1] in "XYZ" else "urad"
    position_unit = "deg" if fit.model.chain.joint(axis).turns else "mm"
    si = si_factor(unit)
    u, prior, information = spread.of(block)
    return ErrorMotionTable(
        name=name,
        axis=axis,
        unit=unit,
        position=np.zeros(0) if located else lines[axes.index(axis)] / si_factor(position_unit),
        position_unit=position_unit,
        value=(mean + block @ fit.theta) / si,
        u=np.sqrt(u**2 + doubted) / si,
        prior=prior / si,
        information=information,
    )


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
