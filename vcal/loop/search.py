"""The search of the loop: what was tried, added, refused and left over."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..effects.base import Effect
from ..fit import Fit
from ..identify import identify
from .candidates import Untestable, candidates
from .closure import Rejected, in_words, outdone_by
from .empirical import EMPIRICAL, Empirical
from .rivals import WIDENINGS, WIDER, Rival, Weighed, likelier, preferred, weigh, widened
from .round import Round
from .scales import over_scales
from .scan import Responses
from .screen import Screen
from .screening import Screening, screen
from .serial import Serial, gain_beside, serial
from .state import State, chi2_per_dof, fitted, without
from .unexplained import Refused, Unexplained, described
from .whitened import declared_chi2

_CONTRADICTED = math.log(5.0)
"""Log odds of an effect that is refused over the next, from which that one is no name either: what
fits as the one and holds as the other is something else."""
_INSTEAD = 1
"""How often several effects may take the place of a description that ended the search."""
_SUPERFLUOUS = "superfluous after later effects"
_NO_MINIMUM = "its fit does not end in a minimum"
_AGAIN = 2
"""How often the search goes on after an effect was replaced."""
_SAME = 1.0
"""Difference in chi-square of two fits that are the same."""
_QUICKER = 2.0
"""How many times as much as the best effect so far one that is added later may describe."""
_EXCHANGES = 1
"""How often one of several effects gives way to others that leave nothing unexplained."""
_BARS = 1
"""How often each of several is not to be the answer, while others are searched for."""


@dataclass(frozen=True)
class Added:
    """An effect that was added, and what spoke for it."""

    effect: Effect
    weighed: Weighed
    p_value: float
    gain: float
    trials: float
    """Effective number of independent trials in which it was found."""


class Search:
    """One pass through the loop: what was tried, added and left over."""

    def __init__(self, check, classes, alpha, draws, seed, room, progress):
        self.check, self.classes, self.alpha = check, classes, alpha
        self.draws, self.seed, self.room, self.progress = draws, seed, room, progress
        self.history: list[Added] = []
        """Whatever was added, whether it stayed or not."""
        self.rejected: list[Rejected] = []
        self.untestable: list[Untestable] = []
        self.unseen: list[str] = []
        self.screenings: list[Screening] = []
        self.unexplained: Unexplained | None = None
        self.refused: Effect | None = None
        """What was significant in the last round, and did not hold."""
        self._again = _AGAIN
        self._instead, self._exchanges = _INSTEAD, _EXCHANGES
        self._bars = _BARS
        self._barred: frozenset[str] = frozenset()
        """Names that are not to be candidates."""
        self._describing = True
        """Whether empirical descriptions are candidates."""
        self._description: Rival | None = None
        self._description_trials = 1.0
        """The one that ended the search, in whatever words what is unexplained is told."""
        self._outdone: list[Rejected] = []
        """What was rejected for its sake."""
        self._responses: Responses | None = None
        """What candidates do on the plan, kept from round to round."""

    def added(self, state: State) -> list[Added]:
        """What was added and is in the model as far as it has come."""
        found = []
        for effect in state.model.effects:
            mine = [item for item in self.history if item.effect.alike(effect)]
            found += mine[-1:]
        return found

    def rounds(self, state: State, most: int, reached: Callable[[State], None]) -> State:
        """Add effects until nothing is to be added, or there are `most`; then look at them again.
        What is `reached` on the way is told, and is never left without its fit.
        """
        while len(self.added(state)) < most:
            found = self.step(state)
            if found is None:
                break
            reached(state := found)
        before = state
        if self.unexplained is not None:
            state = self.beside_empirical(state)
            several = self.instead_of_description(state, most) or self.exchanged(state, most)
            if several is not None:
                reached(several)
                return self.rounds(several, most, reached)
        elif len(self.added(state)) > 1:
            for item in self.added(state):
                reached(state := self.anew(state, item))
                if self.unexplained is not None:
                    return state
            if (others := self.exchanged(state, most)) is not None:
                reached(others)
                return self.rounds(others, most, reached)
        reached(state)
        if state is not before and self.unexplained is None and self._again:
            self._again -= 1
            return self.rounds(state, most, reached)
        return state

    def step(self, state: State) -> State | None:
        """One round: None where nothing (more) is to be added."""
        number = len(self.added(state)) + 1
        screen_state, screening = self._screened(state)
        if screening.p_value > self.alpha:
            return None
        self.progress(f"round {number}: refitting the best candidates")
        found = Round.of(state, screen_state, screening, self.alpha, self.room)
        if several := found.hidden_by_each_other():
            first, size = several.rivals[0], len(several.rivals)
            self.progress(f"round {number}: adding {first.effect.key}, one of {size}")
            return self._add(found, first, None)
        if found.outdone():
            self._described(found, self.seed + number)
            return None
        refused = self._unfitted(found)
        odds, significant = found.odds, found.significant
        untried = {id(rival) for rival in significant}
        for rival in preferred(significant, odds):
            untried.discard(id(rival))
            likeliest = found.ranked[0][0]
            if why := found.unlikely(rival):
                self._reject(found, rival, why)
                continue
            why = found.fails(rival)
            behind = odds[id(likeliest)] - odds[id(rival)]
            if not why and behind > _CONTRADICTED and id(likeliest) not in untried:
                significant_itself = found.p_value(likeliest) <= self.alpha
                held = "does not hold" if significant_itself else "is not significant itself"
                why = f"a far likelier one {held}"
            if not why:
                self.progress(f"round {number}: adding {rival.effect.key}")
                return self._add(found, rival, found.description)
            self._reject(found, rival, why)
            refused = refused or rival.effect
        self.refused = refused
        return None

    def look_on(self, state: State) -> None:
        """What is significant where no more effects may be added: the first of it is refused, a
        description only where no effect is significant.
        """
        _, screening = self._screened(state)
        best = [k.peaks[0].effect for k in screening.kinds if screening.corrected(k) <= self.alpha]
        if best:
            effects = (effect for effect in best if not isinstance(effect, Empirical))
            self.refused = next(effects, best[0])

    @property
    def refusal(self) -> Refused | None:
        """What `refused` is, with the p-value and the reason that are told of it."""
        effect = self.refused
        if effect is None:
            return None
        for told in self.rejected:
            if (told.effect, told.placement) == (effect.name, effect.placement):
                return Refused(effect, told.p_value, told.reason)
        tested = (
            screening.corrected(kind)
            for screening in reversed(self.screenings)
            for kind in screening.kinds
            if kind.kind == effect.name
        )
        return Refused(effect, next(tested, math.nan), _NO_MINIMUM)

    def _screened(self, state: State) -> tuple[Screen, Screening]:
        """The screening of one round."""
        number = len(self.added(state)) + 1
        fit, measurement = state.scored, state.fit.measurement
        self.progress(f"round {number}: screening")
        tried, self.untestable = candidates(state.model, measurement, self.classes)
        kinds = EMPIRICAL if self._describing else ()
        beside = [*state.model.effects, *tried]
        empirical, _ = candidates(state.model, measurement, kinds, beside, state.fit)
        tried = [effect for effect in tried if effect.key not in self._barred]
        if self._responses is None or self._responses.plan is not measurement.plan:
            self._responses = Responses(measurement.plan)
        screen_state = Screen(fit, self.draws, self.seed + number, self._responses)
        screening = screen(screen_state, [*tried, *empirical])
        self.screenings.append(screening)
        self.refused = None
        self.unseen = [effect.key for effect in screening.unseen]
        return screen_state, screening

    def _add(self, found: Round, rival: Rival, described: Rival | None) -> State:
        """The state with one effect more."""
        measurement = found.state.fit.measurement
        weighed, gain = weigh(found.classes_with(rival), rival, described), found.gain(rival)
        after = found.at_declared(rival.fit)
        refitted = self._at_its_size(fitted(rival.fit.model, measurement, after, self.room))
        effect, p, trials = refitted.model.effects[-1], found.p_value(rival), found.trials(rival)
        self.screenings[-1] = replace(found.screening, added=effect, told={effect.name: p})
        # Last, so that an interruption leaves no effect without its fit.
        self.history.append(Added(effect, weighed, p, gain, trials))
        return refitted

    def _described(self, found: Round, seed: int) -> None:
        """End the search with the empirical description of a round."""
        best, state = found.description, found.state
        assert best is not None
        self._description, self._description_trials = best, found.trials(best)
        p = found.p_value(best)
        self.screenings[-1] = replace(found.screening, told={best.effect.name: p})
        self.unexplained = described(
            found.fit,
            state.scored,
            best,
            p,
            chi2_per_dof(state.fit),
            self.alpha,
            self.draws,
            seed,
        )
        known = len(self.rejected)
        for rival in found.significant:
            self._reject(found, rival, outdone_by(best.effect))
        self._outdone = self.rejected[known:]

    def _unfitted(self, found: Round) -> Effect | None:
        """The first of the significant kinds of which no refit ended in a minimum: none can be held
        against readings.
        """
        screening = found.screening
        p_values = {kind.kind: screening.corrected(kind) for kind in screening.kinds}
        fitted_kinds, first = {r.effect.name for r in found.rivals}, None
        for peak in found.peaks:
            effect, p = peak.effect, p_values[peak.effect.name]
            if p > self.alpha or effect.name in fitted_kinds:
                continue
            first = first or effect
            if not isinstance(effect, Empirical):
                self._refuse(effect, p, _NO_MINIMUM)
        return first

    def _at_its_size(self, state: State) -> State:
        """The state with a wider prior of the last effect, where it is larger than expected: it
        would be taken for smaller than it is, and the rest of it for something else.
        """
        for _ in range(WIDENINGS):
            last = len(state.model.effects) - 1
            effect = state.model.effects[last]
            sizes = state.fit.theta[state.fit.places_of(last)[0]]
            grown = widened(effect, WIDER)
            if grown is effect or np.abs(sizes).max() <= 1.0:
                break
            model = state.model.without(last).with_effects(grown)
            state = fitted(model, state.fit.measurement, state.fit, self.room)
        return state

    def anew(self, state: State, item: Added) -> State:
        """Search anew, beside the others, for what one of several effects is: what was found first
        may have stood for a part of what was not yet known. Where nothing is significant without
        it, nor is it.
        """
        less = without(state, _place(state, item), self.room)
        if not less.converged:
            return state
        kept = list(self.rejected), list(self.screenings), self.refused
        self.progress(f"searching anew for what was named {item.effect.key}")
        bare = fitted(less.model, less.measurement, less, self.room)
        try:
            found = self.step(bare)
        except KeyboardInterrupt:
            self.rejected, self.screenings, self.refused = kept
            raise
        significant = self.screenings[-1].p_value <= self.alpha
        self.screenings = kept[1]
        if not significant:
            return self._drop(item, less, _SUPERFLUOUS)
        if self.unexplained is not None and not self._describes_better(state):
            self.unexplained = None
            self.rejected, _, self.refused = kept
            return state
        if self.unexplained is None and (
            found is None or self.history[-1].effect.alike(item.effect)
        ):
            self.rejected, _, self.refused = kept
            if found is None:
                return state
            # What it may be instead is told beside what was found after it.
            again = self.history.pop()
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
            better = len(items) > 1 and likelier(
                found.scored, _placed(items, found.scored),
                description.fit, [(len(description.fit.model.effects) - 1, description)],
            )  # fmt: skip
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
        if not left or not self._exchanges or not 1 < len(items) < most:
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
                done = self._likelier(found, state, items, description)
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
        self, found: State, state: State, items: Sequence[Added], description: Rival | None
    ) -> bool:
        """Whether a state is clearly likelier than another, of these effects, with what describes
        what that leaves: on readings that both use, with the noise that the one leaves.
        """
        one, other = found.scored, state.scored if description is None else description.fit
        others = _placed(items, other)
        if description is not None:
            others.append((len(other.model.effects) - 1, description))
        mine = _placed(self.added(found), one)
        if not np.array_equal(one.whitener, other.whitener):
            keep, whitener = one.used & other.used, one.whitener
            one, other = (
                identify(f.model, f.measurement, theta=f.theta, shapes=f.shapes,
                         whitener=whitener, keep=keep, room=self.room)
                for f in (one, other)
            )  # fmt: skip
        return likelier(one, mine, other, others)

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

    def _kept(self) -> tuple:
        """What an attempt changes, to restore it where nothing comes of it."""
        return (list(self.history), list(self.rejected), list(self.screenings), self.refused,
                self.unexplained, self._description, self._description_trials,
                list(self._outdone), self.unseen)  # fmt: skip

    def _restore(self, kept: tuple) -> None:
        history, rejected, screenings, self.refused, self.unexplained, *described = kept
        self.history, self.rejected, self.screenings = [*history], [*rejected], [*screenings]
        self._description, self._description_trials, outdone, self.unseen = described
        self._outdone = [*outdone]

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
        kept = list(self.rejected), list(self.screenings), self.unexplained
        why = f"superfluous beside an empirical description ({in_words(effect)})"
        self.rejected += [_dropped(item, why) for item in dropped]
        self.unexplained = None
        try:
            found = self.step(bare)
        except KeyboardInterrupt:
            self.rejected, self.screenings, self.unexplained = kept
            raise
        self.screenings = kept[1]
        return bare if found is None else found

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

    def _reject(self, found: Round, rival: Rival, reason: str) -> None:
        self._refuse(rival.effect, found.p_value(rival), reason)

    def _refuse(self, effect: Effect, p_value: float, reason: str) -> None:
        name, place = effect.name, effect.placement
        if not any((r.effect, r.placement) == (name, place) for r in self.rejected):
            self.rejected.append(Rejected(name, place, p_value, reason))


def _no_worse(less: Fit, state: State, item: Added) -> bool:
    """Whether the evidence is higher without an added effect."""
    fit, place = state.scored, _place(state, item)
    noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
    with_it = fit.log_evidence(noise) + over_scales(fit, fit.places_of(place)[0], noise)
    return less.log_evidence(noise) > with_it + item.weighed.best.log_shape


def _dropped(item: Added, reason: str) -> Rejected:
    return Rejected(item.effect.name, item.effect.placement, item.p_value, reason)


def place_of(item: Added, effects: Sequence[Effect]) -> int:
    """Where among the effects of a model an added one is."""
    return next(i for i, e in enumerate(effects) if e.alike(item.effect))


def _placed(items: Sequence[Added], fit: Fit) -> list[tuple[int, Rival]]:
    """Added effects by their place in the model of a fit, with what spoke for each."""
    return [(place_of(item, fit.model.effects), item.weighed.best) for item in items]


def _place(state: State, item: Added) -> int:
    return place_of(item, state.model.effects)
