"""The search of the loop: forward selection, and revision of the effects that were added."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit, declared_chi2
from ...identification.identify import identify
from ..empirical import Empirical
from ..outcome.closure import Rejected, in_words
from ..outcome.misdeclared import Misdeclared
from ..residuals.autocorrelation import Serial, gain_beside, serial
from ..screening.score_test import Peak
from ..screening.screening import Screening
from ..screening.size_evidence import over_scales
from ..weighing.rivals import Rival, refit_all
from ..weighing.weighing import Weighed, classes_of, likelier, probable, weigh
from .forward_selection import Added, ForwardSelection, Kept, place_of
from .sizes import LIKELIER, sizes_that_fit, tested_sizes
from .state import State, fitted, without

T = TypeVar("T")

_INSTEAD = 1
"""How often several effects may replace a description that ended the search."""
_SUPERFLUOUS = "not needed after later effects were added"
_AGAIN = 2
"""How often the search continues after an effect was replaced."""
_SAME = 1.0
"""Difference in chi-square below which two fits are the same."""
_QUICKER = 2.0
"""Most that a later effect may describe, as a multiple of the best effect so far."""
_EXCHANGES = 1
"""How often one of several effects may be exchanged for others that leave nothing unexplained."""
_EXCHANGEABLE = 5
"""Most effects for which one is exchanged, or all are searched for again while something is left.
With more, the repetition would take minutes, and data with further effects would still leave
something. Only effects that a rival outweighs, given what was found later, are then searched for
again."""
_BARS = 1
"""How often each of several effects is excluded while others are searched for."""


class Search(ForwardSelection):
    """One pass through the loop: rounds until nothing is added, then a revision.

    The revision tests whether each effect is still needed, and whether others replace it.
    """

    def __init__(self, check, classes, alpha, draws, seed, room, progress):
        super().__init__(check, classes, alpha, draws, seed, room, progress)
        self._again = _AGAIN
        self._instead, self._exchanges = _INSTEAD, _EXCHANGES
        self._bars = _BARS

    def with_fitting_sizes(self, state: State) -> tuple[State, Misdeclared | None]:
        """The state from which the search starts: with the declared sizes, or with those that the
        readings show where the declared ones do not fit and these are clearly more probable than
        the most probable effect that may be missing. Also what does not fit then.
        """
        test = tested_sizes(state.scored, state.model)
        found = sizes_that_fit(state, state.model, test, self.room) if test.misfit else None
        if found is None:
            return state, None
        self.progress("comparing declared sizes with those that fit")
        model, factors, gain = found
        kept = self._kept()
        _, screening = self._screened(state)
        self._restore(kept)
        if gain <= max(screening.best_log_odds, 0.0) + LIKELIER:
            return state, None
        try:
            wide = fitted(model, state.fit.measurement, None, self.room)
        except np.linalg.LinAlgError:
            return state, None
        return wide, Misdeclared(test, factors, True)

    def rounds(self, state: State, most: int, reached: Callable[[State], None]) -> State:
        """Add effects until nothing is added or there are `most`, then revise them.

        Each effect is searched for again; where more would be added if allowed, only those that a
        rival outweighs. While something is missing, each may stand for a part of it. `reached`
        receives every intermediate state, complete with its fit.
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
            state = self._tried(partial(self.beside_empirical, state), state)
            several = self._tried(partial(self.instead_of_description, state, most), None)
            several = several or self.exchanged(state, most)
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
                    reached(state := self._tried(partial(self.search_again, state, item), state))
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

    def _tried(self, revision: Callable[[], T], otherwise: T) -> T:
        """The result of a revision; `otherwise`, with all as before, where its equations have no
        solution: a single singular candidate does not end the search.
        """
        kept = self._kept()
        try:
            return revision()
        except np.linalg.LinAlgError:
            self._restore(kept)
            return otherwise

    def search_again(self, state: State, item: Added) -> State:
        """Search again for what one of several effects is, beside the others.

        An effect that was found early may stand for a part of what was unknown then. Where nothing
        is significant without it, it is not needed.
        """
        less = without(state, _place(state, item), self.room)
        if not less.converged:
            return state
        kept = self._kept()
        self.progress(f"searching again for what was named {item.effect.key}")
        bare = fitted(less.model, less.measurement, less, self.room)
        found, screening = self._step_unreported(bare, kept)
        if screening.p_value > self.alpha:
            return self._drop(item, less, _SUPERFLUOUS)
        if found is None and (self.unexplained is None or not self._describes_better(state)):
            self._restore(kept)
            return state
        if found is not None and self.history[-1].effect.alike(item.effect):
            again = self.history[-1]
            self._restore(kept)
            # Its alternatives are those beside what was found after it.
            both = found.fit.used & state.fit.used
            left, before = (declared_chi2(one.fit, both) for one in (found, state))
            # An effect of the same name may have another shape, such as another moment.
            better = left < before - _SAME
            kept_item = again if better else replace(item, weighed=again.weighed)
            self.history = [kept_item if other is item else other for other in self.history]
            return found if better else state
        self.rejected.append(_dropped(item, "beside the other effects, another one fits better"))
        self.refused = None
        return bare if found is None else found

    def _describes_better(self, state: State) -> bool:
        """Whether the description that ended the search leaves less than a state does."""
        of = self._description
        return of is None or declared_chi2(of.fit) < declared_chi2(state.fit)

    def instead_of_description(self, state: State, most: int) -> State | None:
        """Several effects that describe the data better than the description that ended the search;
        None where there are none.

        The description fits better than each of them alone. They are added one by one, without
        descriptions as candidates, and must then fit better and be clearly more probable than the
        description.
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
        """The state after one of several effects, beside which something is left, is exchanged for
        others that leave nothing; None where there are none.

        An effect that was found first may stand for parts of two others, and mask both. Each effect
        is left out in turn and the search repeated. Where that fails, each is excluded in turn, and
        what is found instead must be clearly more probable: two wrong names may support each other,
        so that each alone is the best beside the other.
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
                others = partial(self._instead_of, state, items, item, most, barred)
                found = self._tried(others, None)
                if found is not None:
                    self._exchanges -= 1
                    return found
        return None

    def _instead_of(
        self, state: State, items: Sequence[Added], item: Added, most: int, barred: bool
    ) -> State | None:
        """The state in which others replace `item` among `items` and leave nothing; None where
        there is none. Where the effect is barred, or no description of the rest exists, they must
        also be more probable.
        """
        less = without(state, _place(state, item), self.room)
        if not less.converged:
            return None
        self.progress(f"searching for effects that may replace {item.effect.key}")
        bare = fitted(less.model, less.measurement, less, self.room)
        kept, description = self._kept(), self._description
        if self.unexplained is None:
            description = None
        self.unexplained = self.refused = None
        self.rejected.append(_dropped(item, "other effects in its place leave nothing unexplained"))
        if barred:
            self._barred = frozenset({item.effect.key, *item.weighed.equivalent})
        done = False
        try:
            found = self._added_to(bare, most, state)
            if barred and not self._nothing_left():
                found = self._revised(found, most)
            done = self._nothing_left()
            if done and barred:
                # Nothing that was excluded may be significant either.
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

    def _revised(self, state: State, most: int) -> State:
        """A state whose effects were each searched for again beside the others, with what is then
        found in addition.
        """
        for item in self.added(state):
            if any(item.effect.alike(one.effect) for one in self.added(state)):
                self.unexplained = None
                state = self.search_again(state, item)
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
        """Whether effects in a fit are clearly more probable than others in another fit, which may
        end with a description. Both use the same readings, and the noise of `one`.
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
        """Add effects one by one, until none is added.

        The search also ends where the first effect leads back to the state `but`, or where as many
        more as are allowed would not come near the chi-square `goal`.
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
        """Remove the effects that are superfluous beside the empirical description that ended the
        search, because they stood for a part of it.
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
        # Its dependence is determined again without them. An effect that is then significant is
        # added.
        kept = self._kept()
        why = f"not needed beside an empirical description ({in_words(effect)})"
        self.rejected += [_dropped(item, why) for item in dropped]
        self.unexplained = None
        found, _ = self._step_unreported(bare, kept)
        return bare if found is None else found

    def _step_unreported(self, state: State, kept: Kept) -> tuple[State | None, Screening]:
        """A round and its screening, which is not reported; an interruption restores `kept`."""
        try:
            found = self.step(state)
        except KeyboardInterrupt:
            self._restore(kept)
            raise
        screening = self.screenings[-1]
        self.screenings = list(kept.screenings)
        return found, screening

    def weigh_again(self, state: State) -> None:
        """Determine the alternatives to every effect beside those that were added after it."""
        self.progress("weighing rivals again")
        for item in self.added(state):
            again = self._tried(partial(reweigh_rivals, item, state, self.room), item.weighed)
            now = replace(item, weighed=again)
            self.history = [now if other is item else other for other in self.history]

    def prune(self, state: State, reached: Callable[[State], None]) -> State:
        """Try once to remove each added effect; the evidence decides."""
        for item in self.added(state)[:-1]:
            reached(state := self._tried(partial(self._pruned, state, item), state))
        return state

    def _pruned(self, state: State, item: Added) -> State:
        """The state without an added effect where its evidence is higher then."""
        less = without(state, _place(state, item), self.room)
        if not (less.converged and _no_worse(less, state, item)):
            return state
        return self._drop(item, less, _SUPERFLUOUS)

    def prune_correlated(
        self, state: State, reached: Callable[[State], None]
    ) -> tuple[State, Serial | None]:
        """Remove the added effects that correlated noise describes equally well, the last one
        first. Returns the state and the correlation in its residual.

        Where the noise is correlated, every slowly varying effect fits a part of it. An effect
        stays if its evidence beside such noise outweighs the search: under the null hypothesis, a
        Bayes factor above b has a probability below 1/b (Ville's inequality).
        """
        for item in reversed(self.added(state)):
            fit = state.remaining
            if serial(fit) is None:
                break
            reached(state := self._tried(partial(self._beside_noise, state, item), state))
        found = serial(state.remaining)
        return state, found if found is not None and found.p_value <= self.alpha else None

    def _beside_noise(self, state: State, item: Added) -> State:
        """The state without an added effect whose evidence beside correlated noise is too small."""
        fit = state.remaining
        gain = gain_beside(fit, np.concatenate(fit.places_of(_place(state, item))))
        if item.trials * math.exp(-min(gain, 700.0)) <= self.alpha:
            return state
        less = without(state, _place(state, item), self.room)
        return self._drop(item, less, "noise that is correlated in time describes the same")

    def described_by_noise(self, state: State) -> bool:
        """Whether correlated noise describes equally well what the description that ended the
        search describes: its evidence beside such noise does not outweigh the search
        (`prune_correlated`).
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
    """Added effects by their place in the model of a fit, each with its best rival."""
    return [(place_of(item, fit.model.effects), item.weighed.best) for item in items]


def _place(state: State, item: Added) -> int:
    return place_of(item, state.model.effects)


_FAR = 1e-3
"""Probability in its round, of its own or of its name, below which a rival cannot become the best.
"""


def reweigh_rivals(item: Added, state: State, room: int) -> Weighed:
    """The rivals of an effect, weighed beside all other effects of a state.

    In its round, they were weighed beside fewer effects: what was missing then is part of their
    difference, and effects that were added since are rivals no more. The result is unchanged where
    nothing was added, or where a fit does not converge.
    """
    weighed, place = item.weighed, place_of(item, state.model.effects)
    others = [e for i, e in enumerate(state.model.effects) if i != place]
    if not weighed.instead or not _more(others, weighed.best.fit.model.effects):
        return weighed
    near = [r for _, r in probable(weighed.instead, _FAR)]
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
    # Of rivals that converged to another shape of the same effect, one is left.
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
    """The peak where the refit of a rival starts: the end of its fit, or another shape."""
    fit = rival.fit
    amplitudes = fit.theta[fit.model.places[-1]] * rival.wider
    if shape is None:
        shape = fit.shapes.get(len(fit.model.effects) - 1, {})
    return dataclasses.replace(rival.peak, shape=shape, amplitudes=amplitudes)


def _instances(rival: Rival) -> int:
    """Number of places and components of its kind that were tried in its round."""
    return round(rival.effect.odds / math.exp(rival.log_prior))
