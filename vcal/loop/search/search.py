"""The search of the loop: effects are added, and those that were are looked at again."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit, declared_chi2
from ...identification.identify import identify
from ..empirical import Empirical
from ..outcome.closure import Rejected, in_words
from ..residuals.autocorrelation import Serial, gain_beside, serial
from ..screening.score_test import Peak
from ..screening.screening import Screening
from ..screening.size_evidence import over_scales
from ..weighing.rivals import Rival, refit_all
from ..weighing.weighing import Weighed, classes_of, likelier, weigh
from .forward_selection import Added, ForwardSelection, Kept, place_of
from .state import State, fitted, without

_INSTEAD = 1
"""How often several effects may take the place of a description that ended the search."""
_SUPERFLUOUS = "superfluous after later effects"
_AGAIN = 2
"""How often the search goes on after an effect was replaced."""
_SAME = 1.0
"""Difference in chi-square of two fits that are the same."""
_QUICKER = 2.0
"""How many times as much as the best effect so far one that is added later may describe."""
_EXCHANGES = 1
"""How often one of several effects gives way to others that leave nothing unexplained."""
_EXCHANGEABLE = 5
"""Most effects of which one is exchanged, or all are looked for anew where something is left: of
more, on data that hold yet others, it would take minutes, and something is left all the same; of
those only what a rival outweighs, beside what was found later, is looked for anew.
"""
_BARS = 1
"""How often each of several is not to be the answer, while others are searched for."""


class Search(ForwardSelection):
    """One pass through the loop: rounds, until nothing is to be added, and what is then looked at
    again: whether each effect is still needed, and whether others take its place.
    """

    def __init__(self, check, classes, alpha, draws, seed, room, progress):
        super().__init__(check, classes, alpha, draws, seed, room, progress)
        self._again = _AGAIN
        self._instead, self._exchanges = _INSTEAD, _EXCHANGES
        self._bars = _BARS

    def rounds(self, state: State, most: int, reached: Callable[[State], None]) -> State:
        """Add effects until nothing is to be added, or there are `most`; then look at them again:
        at each, or, where more would be added if it might, at those that a rival outweighs. Beside
        what is missing each is part of something else. What is `reached` on the way is told, and is
        never left without its fit.
        """
        while len(self.added(state)) < most:
            found = self.step(state)
            if found is None:
                break
            reached(state := found)
        else:
            self.look_on(state)
        full = self.refused is not None and len(self.added(state)) >= most
        before = state
        if self.unexplained is not None:
            state = self.beside_empirical(state)
            several = self.instead_of_description(state, most) or self.exchanged(state, most)
            if several is not None:
                reached(several)
                return self.rounds(several, most, reached)
        else:
            few = self.refused is None or len(self.added(state)) <= _EXCHANGEABLE
            each = few and not full
            if not each:
                self.weigh_again(state)
            for item in self.added(state) if len(self.added(state)) > 1 else ():
                if each or item.weighed.outweighed:
                    reached(state := self.anew(state, item))
                if self.unexplained is not None:
                    return state
            if each and (others := self.exchanged(state, most)) is not None:
                reached(others)
                return self.rounds(others, most, reached)
        reached(state)
        if state is not before and self.unexplained is None and self._again:
            self._again -= 1
            return self.rounds(state, most, reached)
        return state

    def anew(self, state: State, item: Added) -> State:
        """Search anew, beside the others, for what one of several effects is: what was found first
        may have stood for a part of what was not yet known. Where nothing is significant without
        it, nor is it.
        """
        less = without(state, _place(state, item), self.room)
        if not less.converged:
            return state
        kept = self._kept()
        self.progress(f"searching anew for what was named {item.effect.key}")
        bare = fitted(less.model, less.measurement, less, self.room)
        found, screening = self._step_untold(bare, kept)
        if screening.p_value > self.alpha:
            return self._drop(item, less, _SUPERFLUOUS)
        if found is None and (self.unexplained is None or not self._describes_better(state)):
            self._restore(kept)
            return state
        if found is not None and self.history[-1].effect.alike(item.effect):
            again = self.history[-1]
            self._restore(kept)
            # What it may be instead is told beside what was found after it.
            both = found.fit.used & state.fit.used
            left, before = (declared_chi2(one.fit, both) for one in (found, state))
            # Of the same name, it may begin at another moment.
            better = left < before - _SAME
            told = again if better else replace(item, weighed=again.weighed)
            self.history = [told if other is item else other for other in self.history]
            return found if better else state
        self.rejected.append(_dropped(item, "beside the others it is something else"))
        self.refused = None
        return bare if found is None else found

    def _describes_better(self, state: State) -> bool:
        """Whether the description that ended the search leaves less than a state does."""
        of = self._description
        return of is None or declared_chi2(of.fit) < declared_chi2(state.fit)

    def instead_of_description(self, state: State, most: int) -> State | None:
        """Several effects that together describe better what one description, which fits better
        than each of them, ended the search with; None where there are none.

        One after the other they are added as if nothing could be described, and must then fit
        better and be clearly likelier than the description.
        """
        if self.unexplained is None or self._description is None or not self._instead:
            return None
        kept = self._kept()
        self.unexplained, self._describing = None, False
        self.rejected = [r for r in self.rejected if r not in self._outdone]
        begun = len(self.added(state))
        better = False
        try:
            found = self._added_to(state, most, goal=declared_chi2(self._description.fit))
            items, description = self.added(found)[begun:], self._description
            better = len(items) > 1 and self._likelier(
                found.scored, items, description.fit, [], description
            )
        finally:
            self._describing = True
            if not better:
                self._restore(kept)
        if not better:
            return None
        self._instead -= 1
        return found

    def exchanged(self, state: State, most: int) -> State | None:
        """Other effects in the place of one of several beside which something is left, so that
        nothing is; None where there are none. What was found first may have stood for parts of two
        others, and hides both.

        Each is left out, and all are searched again; then, where that leads nowhere, each is not to
        be the answer either, and what is found in its stead must be clearly likelier: one wrong
        name may hide that another one is wrong, of which each alone is the best beside the other.
        """
        items = self.added(state)
        left = self.unexplained is not None or self.refused is not None
        if not left or not self._exchanges or not 1 < len(items) < min(most, _EXCHANGEABLE + 1):
            return None
        for barred in (False, True):
            if barred and not self._bars:
                break
            self._bars -= barred
            for item in items:
                found = self._instead_of(state, items, item, most, barred)
                if found is not None:
                    self._exchanges -= 1
                    return found
        return None

    def _instead_of(
        self, state: State, items: Sequence[Added], item: Added, most: int, barred: bool
    ) -> State | None:
        """What leaves nothing in the place of one of these effects, where there is such. Where the
        effect is barred, or nothing describes what is left beside it, that must be likelier too.
        """
        less = without(state, _place(state, item), self.room)
        if not less.converged:
            return None
        self.progress(f"searching for what may take the place of {item.effect.key}")
        bare = fitted(less.model, less.measurement, less, self.room)
        kept, description = self._kept(), self._description
        if self.unexplained is None:
            description = None
        self.unexplained = self.refused = None
        self.rejected.append(_dropped(item, "others leave nothing unexplained"))
        if barred:
            self._barred = frozenset({item.effect.key, *item.weighed.equivalent})
        done = False
        try:
            found = self._added_to(bare, most, state)
            if barred and not self._nothing_left():
                found = self._looked_at_again(found, most)
            done = self._nothing_left()
            if done and barred:
                # Nor is anything left of what was barred.
                self._barred = frozenset()
                done = self.step(found) is None and self._nothing_left()
            if done and (barred or description is None):
                other = state.scored if description is None else description.fit
                done = self._likelier(found.scored, self.added(found), other, items, description)
        finally:
            self._barred = frozenset()
            if not done:
                self._restore(kept)
        return found if done else None

    def _nothing_left(self) -> bool:
        return self.screenings[-1].p_value > self.alpha

    def _looked_at_again(self, state: State, most: int) -> State:
        """A state whose effects were each searched anew beside the others, and what is then found
        beside them.
        """
        for item in self.added(state):
            if any(item.effect.alike(one.effect) for one in self.added(state)):
                self.unexplained = None
                state = self.anew(state, item)
        self.unexplained = self.refused = None
        return self._added_to(state, most)

    def _likelier(
        self,
        one: Fit,
        mine: Sequence[Added],
        other: Fit,
        others: Sequence[Added],
        description: Rival | None,
    ) -> bool:
        """Whether effects in a fit are clearly likelier than others in another fit, which may have
        a description at its end: on readings that both use, with the noise that the one leaves.
        """
        named, beside = _placed(mine, one), _placed(others, other)
        if description is not None:
            beside.append((len(other.model.effects) - 1, description))
        if not np.array_equal(one.whitener, other.whitener):
            keep, whitener = one.used & other.used, one.whitener
            one, other = (
                identify(f.model, f.measurement, theta=f.theta, shapes=f.shapes,
                         whitener=whitener, keep=keep, room=self.room)
                for f in (one, other)
            )  # fmt: skip
        return likelier(one, named, other, beside)

    def _added_to(
        self, state: State, most: int, but: State | None = None, goal: float = math.inf
    ) -> State:
        """Effects added one after the other, until none is to be added, the first leads back to the
        state that was left, or as many more as there may be come nowhere near a `goal`.
        """
        fastest, near = 0.0, math.inf
        while (more := most - len(self.added(state))) > 0:
            if 0.0 < _QUICKER * fastest * more < near - goal:
                break
            further = self.step(state)
            if further is None:
                break
            if math.isfinite(goal):
                before, near = declared_chi2(state.fit), declared_chi2(further.fit)
                fastest = max(fastest, before - near)
            state = further
            if but is not None and abs(state.fit.chi2 - but.fit.chi2) < _SAME:
                break
            but = None
        return state

    def beside_empirical(self, state: State) -> State:
        """Do without the effects that are superfluous beside the empirical description that ended
        the search: they stood for a part of it.
        """
        described = self.unexplained.empirical if self.unexplained is not None else None
        if described is None:
            return state
        effect = described.effect
        with_it = fitted(described.fit.model, described.fit.measurement, described.fit, self.room)
        dropped, bare = [], state
        for item in self.added(state):
            less = without(with_it, _place(with_it, item), self.room)
            if less.converged and _no_worse(less, with_it, item):
                dropped.append(item)
                with_it = fitted(less.model, less.measurement, less, self.room)
        if not dropped:
            return state
        for item in dropped:
            less = without(bare, _place(bare, item), self.room)
            bare = fitted(less.model, less.measurement, less, self.room)
        # What it depends on is told anew without them; what then has a name after all, has it.
        kept = self._kept()
        why = f"superfluous beside an empirical description ({in_words(effect)})"
        self.rejected += [_dropped(item, why) for item in dropped]
        self.unexplained = None
        found, _ = self._step_untold(bare, kept)
        return bare if found is None else found

    def _step_untold(self, state: State, kept: Kept) -> tuple[State | None, Screening]:
        """A round and its screening, which is not among those that are told; an interruption leaves
        what was `kept`.
        """
        try:
            found = self.step(state)
        except KeyboardInterrupt:
            self._restore(kept)
            raise
        screening = self.screenings[-1]
        self.screenings = list(kept.screenings)
        return found, screening

    def weigh_again(self, state: State) -> None:
        """Say of every effect what it may be instead beside those that were added after it."""
        self.progress("weighing rivals again")
        for item in self.added(state):
            now = replace(item, weighed=reweigh_rivals(item, state, self.room))
            self.history = [now if other is item else other for other in self.history]

    def prune(self, state: State, reached: Callable[[State], None]) -> State:
        """Try once to do without each added effect; the evidence decides."""
        for item in self.added(state)[:-1]:
            less = without(state, _place(state, item), self.room)
            if less.converged and _no_worse(less, state, item):
                reached(state := self._drop(item, less, _SUPERFLUOUS))
        return state

    def prune_correlated(
        self, state: State, reached: Callable[[State], None]
    ) -> tuple[State, Serial | None]:
        """Do without the added effects that noise correlated in time describes as well, the last
        one first; and what is correlated at the end.

        Where the noise is correlated, all that changes slowly fits a part of it. An effect stays if
        its evidence beside such noise pays for the search: were there nothing, a Bayes factor
        above b has a probability of less than 1/b (Ville's inequality).
        """
        for item in reversed(self.added(state)):
            fit = state.remaining
            if serial(fit) is None:
                break
            gain = gain_beside(fit, np.concatenate(fit.places_of(_place(state, item))))
            if item.trials * math.exp(-min(gain, 700.0)) > self.alpha:
                less = without(state, _place(state, item), self.room)
                why = "noise that is correlated in time describes it too"
                reached(state := self._drop(item, less, why))
        found = serial(state.remaining)
        return state, found if found is not None and found.p_value <= self.alpha else None

    def described_by_noise(self, state: State) -> bool:
        """Whether the search ended with a description of what noise correlated in time describes
        as well: its evidence beside such noise does not pay for the search, as above.
        """
        description = self._description
        if self.unexplained is None or description is None:
            return False
        noise = serial(state.remaining)
        if noise is None or noise.p_value > self.alpha:
            return False
        fit = description.fit
        gain = gain_beside(fit, np.concatenate(fit.places_of(len(fit.model.effects) - 1)))
        return self._description_trials * math.exp(-min(gain, 700.0)) > self.alpha

    def _drop(self, item: Added, less: Fit, reason: str) -> State:
        dropped = fitted(less.model, less.measurement, less, self.room)
        self.rejected.append(_dropped(item, reason))
        return dropped


def _no_worse(less: Fit, state: State, item: Added) -> bool:
    """Whether the evidence is higher without an added effect."""
    fit, place = state.scored, _place(state, item)
    noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
    with_it = fit.log_evidence(noise) + over_scales(fit, fit.places_of(place)[0], noise)
    return less.log_evidence(noise) > with_it + item.weighed.best.log_shape


def _dropped(item: Added, reason: str) -> Rejected:
    return Rejected(item.effect.name, item.effect.placement, item.p_value, reason)


def _placed(items: Sequence[Added], fit: Fit) -> list[tuple[int, Rival]]:
    """Added effects by their place in the model of a fit, with what spoke for each."""
    return [(place_of(item, fit.model.effects), item.weighed.best) for item in items]


def _place(state: State, item: Added) -> int:
    return place_of(item, state.model.effects)


_FAR = 1e-3
"""Probability in its round below which a rival was too far behind to catch up."""


def reweigh_rivals(item: Added, state: State, room: int) -> Weighed:
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
