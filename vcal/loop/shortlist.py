"""Which candidates of a screening are worth a non-linear refit."""

import math
from collections.abc import Mapping, Sequence

from .empirical import Empirical
from .screen import Peak, Screen

_MARGIN = 30.0
_CLOSE = 8.0
"""Candidates whose linear log evidence is further behind the best than `_MARGIN` are not refined,
further than `_CLOSE` after that not refitted: their weight is below one in a thousand."""
_REFITS = 12
"""Most that are refitted."""


def shortlist(
    state: Screen, worth: Sequence[Peak], others: Sequence[Peak], instances: Mapping[str, int]
) -> list[Peak]:
    """The peaks to refit: what made each kind significant, and others close enough to be rivals,
    after their shapes were moved to the best point between the steps of the scan. `instances` tells
    how many places and components of each kind were tried.
    """
    if not worth:
        return []
    least = max(p.log_bayes_at_its_size for p in worth) - _MARGIN
    near = [p for p in worth if p.log_bayes_at_its_size > least]
    ids = {id(p) for p in near}
    near += [p for p in others if id(p) not in ids and p.log_bayes_at_its_size > least]
    # Of the empirical descriptions only the best of each kind: many are alike.
    empirical: dict[str, Peak] = {}
    for peak in others:
        if isinstance(peak.effect, Empirical):
            best = empirical.setdefault(peak.effect.name, peak)
            if peak.log_bayes_at_its_size > best.log_bayes_at_its_size:
                empirical[peak.effect.name] = peak
    rarest = {p.effect.name: p for p in sorted(worth, key=state.rarity_of)}
    significant = [p for p in rarest.values() if p.log_bayes_at_its_size > least]
    near = [p for p in near if not isinstance(p.effect, Empirical)]
    near += [p for p in empirical.values() if p.log_bayes_at_its_size > least]
    ids = {id(p) for p in near}
    near += [p for p in significant if id(p) not in ids]

    def weight(peak: Peak) -> float:
        odds = math.log(peak.effect.odds / instances[peak.effect.name])
        return peak.log_bayes_at_its_size + odds

    moved = {id(p): state.refine(p) for p in near}
    refined = sorted(moved.values(), key=weight, reverse=True)
    most = weight(refined[0])
    close = [p for p in refined if weight(p) > most - _CLOSE]
    # The best of every kind first: many places of one kind may be alike.
    firsts = sorted({p.effect.name: p for p in reversed(close)}.values(), key=weight, reverse=True)
    ids = {id(p) for p in firsts}
    chosen = [*firsts, *(p for p in close if id(p) not in ids)][:_REFITS]
    # A run of worthless rivals must not hide the next significant candidate, should the best fail.
    chosen += [p for p in refined if weight(p) <= most - _CLOSE][: max(0, 2 - len(chosen))]
    # Whatever is likelier: what is significant, and is not added, has to have a reason.
    ids = {id(p) for p in chosen}
    chosen += [moved[id(p)] for p in significant if id(moved[id(p)]) not in ids]
    return sorted(chosen, key=weight, reverse=True)
