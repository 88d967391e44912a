"""Shapes of an effect, such as the pitches of a screw, that the readings cannot distinguish."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve

from ...effects.base import Effect
from ...effects.shape_class import ShapeClass, with_shape
from ...identification.fit import Fit
from ...identification.identify import NEARLY, identify
from ...identification.model_averaging import Alternatives
from ...model.forward import Model
from ..screening.maxima import refined_maxima
from ..screening.score_test import Peak, ScoreTest
from .state import State, fitted, without

_ROUNDS = 7
"""Refinements of a maximum, each by a factor of four."""
_DISTINGUISHED = 9.0
"""Chi-square, in units of the noise, by which a shape must fit worse, or leave of the other one, to
be distinguished."""
_FITS = 24
"""Most members of a class that are fitted, for the uncertainty between them."""


@dataclass(frozen=True)
class Shapes:
    """The shapes that an added effect may have."""

    effect: Effect
    """As in the model, before the class replaced it."""
    values: tuple[Mapping[str, float], ...]
    """SI; the most probable one first."""
    uncertainties: Mapping[str, float]
    """Standard uncertainty (SI) of every shape parameter of the first, so that two of them reach
    all members."""
    alternatives: Alternatives
    """The members, against their mean."""


def with_shape_classes(
    state: State, effects: Sequence[Effect], room: int
) -> tuple[State, list[Shapes]]:
    """The state with every one of `effects` whose shape is not distinguished replaced by the mean
    of its class (`ShapeClass`), and these classes.
    """
    found: list[Shapes] = []
    for effect in effects:
        place = next(i for i, e in enumerate(state.model.effects) if e.alike(effect))
        its = _class_at(state, place, room)
        if its is None:
            continue
        shared, values, spread = its
        state = _replaced(state, place, shared, room)
        others = _members(state, place, shared, room)
        doubt = Alternatives(state.scored, others)
        found.append(Shapes(effect, values, spread, doubt))
    return state, found


def _class_at(
    state: State, place: int, room: int
) -> tuple[ShapeClass, tuple[Mapping[str, float], ...], dict[str, float]] | None:
    """The class of the effect at a place of the model, with its shapes and their spread; None where
    there is one shape only.
    """
    effect = state.model.effects[place]
    if not effect.shapes or not all(p.moves for p in effect.shapes):
        return None
    base = without(state, place, room)
    if not base.converged:
        return None
    test = ScoreTest(base, 1, 0)
    (tested,) = test.tests([effect])
    if tested is None:
        return None
    noise2 = max(1.0, state.scored.chi2 / state.scored.dof)
    peaks = refined_maxima(test, tested, _ROUNDS)
    peaks = [p for p in peaks if p.statistic > peaks[0].statistic - _DISTINGUISHED * noise2]
    if len(peaks) < 2:
        return None
    local = [_local(test, peak, noise2) for peak in peaks]
    plan = base.measurement.plan
    odds = [
        0.5 * peak.statistic / noise2 + math.log(max(effect.shape_odds(plan, p, u), 1e-300))
        for peak, (p, u) in zip(peaks, local, strict=True)
    ]
    first = int(np.argmax(odds))
    peaks = [peaks[first], *peaks[:first], *peaks[first + 1 :]]
    peaks = [p for p in peaks if p is peaks[0] or _same(test, peaks[0], p, noise2)]
    if len(peaks) < 2:
        return None
    stat = np.array([p.statistic for p in peaks])
    weights = np.exp(0.5 * (stat - stat.max()) / noise2)
    step = np.array([p.step for p in effect.amplitudes])
    maps = [_map(test, p, peaks[0]) * step[:, None] / step for p in peaks]
    values = tuple(dict(p.shape) for p in peaks)
    spread = {
        name: max(u, 0.5 * max(abs(v[name] - values[0][name]) for v in values))
        for name, u in local[first][1].items()
        if name in values[0]
    }
    return ShapeClass.of(effect, values, weights / weights.sum(), maps), values, spread


def _local(test: ScoreTest, peak: Peak, noise2: float) -> tuple[dict[str, float], dict[str, float]]:
    """Estimates (SI) of the parameters of a peak, and their uncertainties with the shape of this
    one: from the curvature of the statistic and the information.
    """
    effect, plan = peak.effect, test.fit.measurement.plan
    grids = effect.scan(plan)
    values = {p.name: float(a * p.step) for p, a in zip(effect.amplitudes, peak.amplitudes,
                                                        strict=True)}  # fmt: skip
    spread = {p.name: p.step for p in effect.amplitudes}
    for name, value in peak.shape.items():
        near = np.argsort(np.abs(grids[name] - value))[:2]
        h = abs(float(np.ptp(grids[name][near]))) / 16.0
        at = {n: np.full(3, v) for n, v in peak.shape.items()}
        at[name] = value + h * np.array([-1.0, 0.0, 1.0])
        low, middle, high = test.statistics(effect, at)
        curvature = (2.0 * middle - low - high) / (2.0 * h**2)
        values[name] = value
        spread[name] = math.sqrt(noise2 / curvature) if curvature > 0.0 else 16.0 * h
    return values, spread


def _inner(test: ScoreTest, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner products of whitened columns, with the parameters of the model eliminated."""
    j = test.fit.jacobian
    return a.T @ b - (j.T @ a).T @ cho_solve(test.factor, j.T @ b)


def _map(test: ScoreTest, of: Peak, to: Peak) -> np.ndarray:
    """The matrix R that brings the columns of one peak to those of another, C R = C_to."""
    mine, other = (test.columns(p.effect, p.shape) for p in (of, to))
    inverse = np.linalg.pinv(_inner(test, mine, mine), rcond=1e-8, hermitian=True)
    return inverse @ _inner(test, mine, other)


def _same(test: ScoreTest, one: Peak, other: Peak, noise2: float) -> bool:
    """Whether either of two peaks describes what the other one is fitted to."""

    def left(of: Peak, by: Peak) -> float:
        moved = test.columns(of.effect, of.shape) @ of.amplitudes
        columns = test.columns(by.effect, by.shape)
        across = _inner(test, columns, moved[:, None])[:, 0]
        inverse = np.linalg.pinv(_inner(test, columns, columns), rcond=1e-8, hermitian=True)
        whole = _inner(test, moved[:, None], moved[:, None])[0, 0]
        return float(whole - across @ inverse @ across)

    return max(left(one, other), left(other, one)) < _DISTINGUISHED * noise2


def _replaced(state: State, place: int, effect: Effect, room: int) -> State:
    """The state with another effect at a place, with the same amplitudes and a known shape."""
    start = _start(state.fit, place)
    model = _with(state.model, place, effect)
    return fitted(model, state.fit.measurement, start, room)


def _start(fit: Fit, place: int) -> Fit:
    """A fit as the start of one without the shape of the effect at `place`."""
    shapes = {i: shape for i, shape in fit.shapes.items() if i != place}
    amplitudes = fit.theta[: len(fit.model.entries)]
    return dataclasses.replace(fit, theta=amplitudes, shapes=shapes)


def _with(model: Model, place: int, effect: Effect) -> Model:
    effects = [effect if i == place else e for i, e in enumerate(model.effects)]
    return Model(model.chain, model.instrument, (*effects, *model.random))


def _members(
    state: State, place: int, shared: ShapeClass, room: int
) -> tuple[tuple[float, Fit], ...]:
    """Weights and fits of the members of a class; of a large one, of some that are spread over it,
    whose weights stand for all.
    """
    some = shared.members
    if len(some) > _FITS:
        chosen = np.linspace(0, len(some) - 1, _FITS).round().astype(int)
        some = tuple(some[i] for i in chosen)
    total = sum(weight for weight, *_ in some)
    fit, found = state.scored, []
    start = _start(fit, place)
    for weight, shape, _ in some:
        alone = with_shape(shared.effect, dict(shape))
        one = identify(
            _with(state.model, place, alone),
            fit.measurement,
            theta=start.theta,
            shapes=start.shapes,
            whitener=fit.whitener,
            keep=state.keep,
            room=room,
            tolerance=NEARLY,
        )
        if one.converged:
            found.append((weight / total, one))
    return tuple(found)
