"""Error motions and location errors of a fitted machine, with their uncertainty."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..machine.plan import Plan
from ..units import si_factor

if TYPE_CHECKING:
    from ..identification.fit import Fit
    from ..identification.model_averaging import Alternatives

NODES = 41
"""Default number of positions per axis."""
_GEOMETRY = ("geometric", "geometric_order")
"""Effects that are error motions."""
_LOCATION = re.compile(r"E[ABCXYZ]0\w+")
"""Name of a location error, such as ``"EC0Y"``."""


@dataclass(frozen=True)
class ErrorMotionTable:
    """One identified error motion on a grid, or one identified location error."""

    name: str
    """ISO 230-1 name, such as ``"EXY"`` or ``"EC0Y"``."""
    axis: str
    unit: str
    """``"um"`` or ``"urad"``."""
    position: np.ndarray
    """Positions (nodes,) in `position_unit`; empty for a location error, which has no position."""
    position_unit: str
    """``"mm"`` or ``"deg"``."""
    value: np.ndarray
    """Values in `unit`, one per position; a single one for a location error."""
    u: np.ndarray
    """Standard uncertainty, in `unit`."""
    prior: np.ndarray
    """Standard deviation before the measurement, in `unit`."""

    information: np.ndarray
    """Share of information from the data: 1 - variance / prior variance."""

    @property
    def constant(self) -> bool:
        """Whether value and uncertainty do not depend on the position."""
        return bool(np.ptp(self.value) == 0.0 and np.ptp(self.u) == 0.0)


def error_motion_tables(
    fit: "Fit", nodes: int = NODES, alternatives: "Sequence[Alternatives]" = ()
) -> list[ErrorMotionTable]:
    """Every error motion on `nodes` positions over the travel of its axis (or the measured range,
    where no travel is declared), then the location errors.

    Value and standard uncertainty are those of the posterior, E = F theta and sqrt(F C F'), with F
    the functions of the family; refinements by `geometric_order` are included. Where the identity
    of an effect is uncertain (`alternatives`), the between-model variance of the error motions is
    part of the uncertainty, and the value is the average of the models where that is predicted.
    """
    lines = [line_of(fit, axis, nodes) for axis in fit.model.chain.axes]
    functions = functions_on(fit, lines)
    spread = Spread.of_fit(fit)
    between = _between_models(
        alternatives, lines, {name: len(mean) for name, (_, mean) in functions.items()}
    )
    return [
        _table(name, *functions[name], *between[name], fit, spread, lines)
        for name in _sorted(functions, fit.model.chain.axes)
    ]


def functions_on(
    fit: "Fit", lines: Sequence[np.ndarray]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """F (nodes, k) of every error motion on these positions of every axis, or (1, k) of a location
    error, and the prior mean, SI.

    `lines` are the positions (nodes,) of every axis in the order of the chain, m or rad.
    """
    model, nodes = fit.model, len(lines[0])
    # At least as many rows as the measurement, with the last one repeated: compiled already.
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
            block[:, k] = column * p.step  # a location error has several ports, but one column
            mean = means.setdefault(name, np.zeros(len(column)))
            if not located or not mean.any():
                means[name] = mean + column * p.mean * p.si
    return {name: (block, means[name]) for name, block in columns.items()}


def _between_models(
    alternatives: "Sequence[Alternatives]", lines: Sequence[np.ndarray], sizes: Mapping[str, int]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Change by averaging over the models (nodes,), m or rad, and between-model variance (nodes,),
    of every error motion; `sizes` gives nodes.
    """

    def of(fit: "Fit") -> np.ndarray:
        functions = functions_on(fit, lines)
        found = {name: mean + block @ fit.theta for name, (block, mean) in functions.items()}
        # An error motion that a model does not have, such as a further degree, is zero there.
        return np.concatenate([found.get(name, np.zeros(n)) for name, n in sizes.items()])

    # Imported here, as it takes long and an identified machine needs none of it.
    from ..identification.model_averaging import model_average

    if not sizes:
        return {}  # no error motions are declared, as for circles of an R-test
    found = model_average(alternatives, of, np.zeros(sum(sizes.values())))
    moved, variance = (np.split(v, np.cumsum(list(sizes.values()))[:-1]) for v in found)
    return dict(zip(sizes, zip(moved, variance, strict=True), strict=True))


@dataclass(frozen=True)
class Spread:
    """Covariances of theta in solver units: the stated one, the planned one, and the prior's.

    They are `Fit.covariance` (k, k), `Fit.planned_covariance` (k, k) and a diagonal (k,), with zero
    for a flat prior.
    """

    stated: np.ndarray
    planned: np.ndarray
    prior: np.ndarray

    @classmethod
    def of_fit(cls, fit: "Fit") -> "Spread":
        """The covariances of a fit."""
        proper = fit.precision > 0
        return cls(
            stated=fit.covariance,
            planned=fit.planned_covariance,
            prior=np.where(proper, 1.0 / np.where(proper, fit.precision, 1.0), 0.0),
        )

    def of(self, block: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Standard uncertainty, prior standard deviation and share of information of F theta, for
        the rows of F (q, k).
        """
        stated, planned = (
            ((block @ matrix) * block).sum(1) for matrix in (self.stated, self.planned)
        )
        prior = block**2 @ self.prior
        information = 1.0 - planned / np.where(prior > 0, prior, np.inf)
        information = np.where(prior > 0, np.clip(information, 0.0, 1.0), 0.0)
        return np.sqrt(np.maximum(stated, 0.0)), np.sqrt(prior), information


def _sorted(names: Iterable[str], axes: Sequence[str]) -> list[str]:
    """The names of error motions axis by axis, then of location errors."""
    order = [f"E{c}{axis}" for axis in axes for c in "XYZABC"]
    return sorted(names, key=lambda name: order.index(name) if name in order else len(order))


def line_of(fit: "Fit", axis: str, nodes: int) -> np.ndarray:
    """Positions (nodes,) of an axis over its travel, or over the measured range where no travel is
    declared, m or rad.
    """
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
    moved: np.ndarray,
    between: np.ndarray,
    fit: "Fit",
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
        value=(mean + block @ fit.theta + moved) / si,
        u=np.sqrt(u**2 + between) / si,
        prior=prior / si,
        information=information,
    )
