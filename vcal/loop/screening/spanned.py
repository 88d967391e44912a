"""Effects that cannot be seen on a plan, and what takes them up: before a measurement too."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ...effects.base import Effect
from ...effects.reference import with_known_reference
from ...identification.identify import identify
from ...machine.plan import Plan
from ...model.forward import Model, compared_with_jacobian
from ...model.measurement import Measurement
from .candidates import candidates
from .score_test import ScoreTest, Tested

_SILENT = 1e-3
"""Squared change of all readings together, in units of their noise, by a standard deviation of the
prior of an effect, below which no reading is said to respond. Such a change is the product of the
effect and of errors of the machine."""
_PART = 1e-3
"""Share of the readings of an effect from which a declared effect is said to take it up."""


@dataclass(frozen=True)
class Spanned:
    """An effect of which no size can be seen on a plan."""

    effect: Effect
    by: tuple[str, ...]
    """Effects of the model that, together, change the readings in the same way, the largest share
    first; empty where no reading responds to the effect."""


def spanned(
    state: ScoreTest, effects: Sequence[Effect], tested: Sequence[Tested | None]
) -> list[Spanned]:
    """The effects that the model spans over their whole grids (`ScoreTest.tests`), those with a
    free reference value left out, and what takes them up at the middle of the grid.
    """
    return [
        Spanned(effect, _taken_up_by(state, effect))
        for effect, one in zip(effects, tested, strict=True)
        if one is None and with_known_reference(effect) is effect
    ]


def _taken_up_by(state: ScoreTest, effect: Effect) -> tuple[str, ...]:
    fit = state.fit
    grids = effect.scan(fit.measurement.plan)
    shape = {name: float(grid[len(grid) // 2]) for name, grid in grids.items()}
    columns = state.columns(effect, shape)
    whole = float((columns**2).sum())
    if whole <= _SILENT:
        return ()
    scale = np.linalg.norm(fit.jacobian, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    taken = np.linalg.lstsq(fit.jacobian / scale, columns, rcond=1e-9)[0] / scale[:, None]
    shares: dict[str, float] = {}
    for place, own in enumerate(fit.model.places):
        size = float(((fit.jacobian[:, own] @ taken[own]) ** 2).sum())
        key = fit.model.effects[place].key
        shares[key] = shares.get(key, 0.0) + size
    return tuple(
        key
        for key, size in sorted(shares.items(), key=lambda item: -item[1])
        if size >= _PART**2 * whole
    )


def spanned_on_plan(
    model: Model, measurement: Measurement | Plan, classes: Iterable[type[Effect]]
) -> list[Spanned] | None:
    """The effects of these classes that cannot be seen beside a model with a measurement, or with a
    plan that is not yet measured.

    A plan is taken at the readings of the nominal machine. None where the model cannot be
    identified from it, for example because a place is neither declared nor measured.
    """
    if isinstance(measurement, Plan):
        measurement = Measurement(measurement, _nominal_readings(model, measurement))
    fit = identify(model, measurement)
    if not (fit.converged and fit.determined):
        return None
    found, _ = candidates(model, measurement, classes, fit=fit)
    state = ScoreTest(fit, 1, 0)
    return spanned(state, found, state.tests(found))


def _nominal_readings(model: Model, plan: Plan) -> np.ndarray:
    width = len(model.instrument.readings)
    difference, _ = compared_with_jacobian(
        model.chain,
        model.instrument,
        plan,
        model.instrument.rows(plan),
        np.zeros((plan.rows, width)),  # type: ignore[arg-type]
        np.zeros((plan.rows, len(model.layout))),  # type: ignore[arg-type]
    )
    return -np.asarray(difference)
