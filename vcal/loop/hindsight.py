"""What an effect may be instead, weighed again beside what was found after it."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from ..effects.base import Effect
from .adding import Added, place_of
from .empirical import Empirical
from .rivals import Rival, refit_all
from .screen import Peak
from .state import State, without
from .weighing import Weighed, classes_of, weigh

_FAR = 1e-3
"""Probability in its round below which a rival was too far behind to catch up."""


def weighed_again(item: Added, state: State, room: int) -> Weighed:
    """The rivals of an effect, weighed beside all other effects of a state.

    In its round they stood beside fewer: what was missing then is part of what they differed by,
    and what was added since is no rival any more. It is as it was where nothing was, or a fit does
    not end in a minimum.
    """
    weighed, place = item.weighed, place_of(item, state.model.effects)
    others = [e for i, e in enumerate(state.model.effects) if i != place]
    if not weighed.instead or not _more(others, weighed.best.fit.model.effects):
        return weighed
    near = [r for share, r in weighed.instead if share > _FAR]
    rivals = [r for r in near if _more([r.effect], others)]
    if not rivals:
        return weigh([[weighed.best]], weighed.best)
    base = without(state, place, room)
    if not base.converged:
        return weighed
    begun = _begun(weighed.best, state.scored.shapes.get(place))
    instances = {r.effect.name: _instances(r) for r in [weighed.best, *rivals]}
    peaks = [begun, *(_begun(r) for r in rivals)]
    found = refit_all(base, peaks, instances, state.keep, room)
    # Of one that ran to where another shape of the same effect did, one is left.
    same = [r for r in found if r.effect is begun.effect]
    if not same:
        return weighed
    best = next((r for r in same if r.peak is begun), same[0])
    effects = [r for r in found if not isinstance(r.effect, Empirical)]
    described = next((r for r in found if isinstance(r.effect, Empirical)), None)
    return weigh(classes_of(base, effects), best, described)


def _more(effects: Sequence[Effect], than: Sequence[Effect]) -> bool:
    return any(not any(one.alike(other) for other in than) for one in effects)


def _begun(rival: Rival, shape: Mapping[str, float] | None = None) -> Peak:
    """Where the refit of a rival begins: where its fit ended, or at another shape."""
    fit = rival.fit
    amplitudes = fit.theta[fit.model.places[-1]] * rival.wider
    if shape is None:
        shape = fit.shapes.get(len(fit.model.effects) - 1, {})
    return dataclasses.replace(rival.peak, shape=shape, amplitudes=amplitudes)


def _instances(rival: Rival) -> int:
    """How many places and components of its kind were tried in its round."""
    return round(rival.effect.odds / math.exp(rival.log_prior))
