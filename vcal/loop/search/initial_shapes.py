"""Initial shape parameters of declared effects whose pitch, time constant or moment is not
declared.

A solver that starts in the middle of a grid converges to the nearest minimum, and a pitch has many.
"""

import dataclasses

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit
from ...identification.identify import identify
from ...model.forward import Model, Shapes
from ...model.measurement import Measurement
from ..screening.score_test import ScoreTest

_PEAKS = 5
"""Local maxima of a grid from which a fit is started."""


def initial_shapes(model: Model, measurement: Measurement, keep: np.ndarray, room: int) -> Shapes:
    """Shape parameters (SI) of the effects of a model that leave some open, by place.

    They come from the best of the fits that start at the maxima of the score test. The effects are
    treated one by one, the most evident first, beside what is in the model already. Effects that no
    reading shows are left out.
    """
    waiting = {i for i, effect in enumerate(model.effects) if _open(effect)}
    found: dict[int, dict[str, float]] = {}
    while waiting:
        kept = [i for i in range(len(model.effects)) if i not in waiting]
        less = _identified(model, kept, found, measurement, keep, room)
        screen = ScoreTest(less, 1, 0)
        places = sorted(waiting)
        tested = screen.tests([_of_any_size(model.effects[i]) for i in places])
        peaks = {i: t.peaks(_PEAKS) for i, t in zip(places, tested, strict=True) if t is not None}
        if not any(peaks.values()):
            break
        plainest = max((i for i in peaks if peaks[i]), key=lambda i: peaks[i][0].log_bayes)
        effect = model.effects[plainest]
        begins = [dict(screen.refine(peak).shape) for peak in peaks[plainest]]
        begins += [begins[0] | _expected(effect)]
        free, best = _open(effect), None
        for begin in begins:
            shape = {name: value for name, value in begin.items() if name in free}
            tried = found | {plainest: shape}
            fit = _identified(model, sorted([*kept, plainest]), tried, measurement, keep, room)
            at = dict(fit.shapes[sorted([*kept, plainest]).index(plainest)])
            cost = fit.cost + _unlikely(effect, at)
            if best is None or cost < best[0]:
                best = cost, at
        assert best is not None
        found[plainest] = best[1]
        waiting.remove(plainest)
    return found


def _open(effect: Effect) -> set[str]:
    """Names of the shape parameters without a declared value."""
    return {p.name for p in effect.shapes} - {name for name, *_ in effect.given}


def _of_any_size(effect: Effect) -> Effect:
    """The effect with the default prior of its amplitudes, independent of what is declared."""
    shapes = {p.name for p in effect.shapes}
    given = tuple(row for row in effect.given if row[0] in shapes)
    return dataclasses.replace(effect, given=given, priors=())


def _expected(effect: Effect) -> dict[str, float]:
    """Expectation of the shape parameters with a declared distribution, SI."""
    return {p.name: float(p.law.mean) * p.si for p in effect.shapes if p.law is not None}


def _unlikely(effect: Effect, shape: dict[str, float]) -> float:
    """-2 ln of the declared density of shape parameters; zero where none is declared."""
    laws = [(p.law, shape[p.name] / p.si) for p in effect.shapes if p.law is not None]
    return sum(-2.0 * float(law.log_density(np.asarray(x))) for law, x in laws)


def _identified(
    model: Model,
    places: list[int],
    shapes: Shapes,
    measurement: Measurement,
    keep: np.ndarray,
    room: int,
) -> Fit:
    """The model with the effects at these places only, fitted from these shapes."""
    effects = (*(model.effects[i] for i in places), *model.random)
    mine = {places.index(i): shape for i, shape in shapes.items() if i in places}
    of = Model(model.chain, model.instrument, effects)
    return identify(of, measurement, shapes=mine, keep=keep, room=room)
