"""Forward selection: effects added one by one, with what was rejected and what was left."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit
from ...machine.plan import Plan
from ...model.forward import Model
from ...model.measurement import Measurement
from ..empirical import EMPIRICAL, Empirical
from ..outcome.closure import Rejected, outdone_by
from ..outcome.unexplained import Refused, Unexplained, described
from ..screening.candidates import Untestable, candidates
from ..screening.responses import Responses
from ..screening.score_test import ScoreTest
from ..screening.screening import Screening, screen
from ..weighing.rivals import WIDENINGS, WIDER, Rival, widened
from ..weighing.subsets import Subset
from ..weighing.weighing import Weighed, preferred, weigh
from .round import Round
from .state import State, chi2_per_dof, fitted

_SINGULAR = "its equations have no solution with these readings"
_NO_MINIMUM = "its fit does not converge to a minimum"


@dataclass(frozen=True)
class Added:
    """An effect that was added, and the evidence for it."""

    effect: Effect
    weighed: Weighed
    p_value: float
    gain: float
    trials: float
    """Effective number of independent trials in which it was found."""


def place_of(item: Added, effects: Sequence[Effect]) -> int:
    """Place of an added effect among the effects of a model."""
    return next(i for i, e in enumerate(effects) if e.alike(item.effect))


def _several(found: Round) -> Subset | None:
    """`Round.hidden_by_each_other`; None where its equations have no solution."""
    try:
        return found.hidden_by_each_other()
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True)
class Kept:
    """What rounds change, as it was before them."""

    history: tuple[Added, ...]
    rejected: tuple[Rejected, ...]
    screenings: tuple[Screening, ...]
    refused: Effect | None
    unexplained: Unexplained | None
    description: Rival | None
    description_trials: float
    outdone: tuple[Rejected, ...]


@dataclass(frozen=True)
class _Tested:
    """The candidates of a model on a plan."""

    model: Model
    plan: Plan
    effects: list[Effect]
    untestable: list[Untestable]


class ForwardSelection:
    """Rounds of a search, each of which adds one effect or ends it."""

    def __init__(self, check, classes, alpha, draws, seed, room, progress):
        self.check, self.classes, self.alpha = check, classes, alpha
        self.draws, self.seed, self.room, self.progress = draws, seed, room, progress
        self.history: list[Added] = []
        """Every effect that was added, whether or not it was kept."""
        self.rejected: list[Rejected] = []
        self.untestable: list[Untestable] = []
        self.screenings: list[Screening] = []
        self.unexplained: Unexplained | None = None
        self.refused: Effect | None = None
        """The effect that was significant in the last round and was rejected."""
        self._barred: frozenset[str] = frozenset()
        """Names that are excluded as candidates."""
        self._describing = True
        """Whether empirical descriptions are candidates."""
        self._description: Rival | None = None
        self._description_trials = 1.0
        """The description that ended the search, even where a covariate is reported instead of it.
        """
        self._outdone: list[Rejected] = []
        """Effects that were rejected because of it."""
        self._tested: _Tested | None = None
        """The candidates of the model that was last asked for."""
        self._responses: Responses | None = None
        """Responses to candidates, cached from round to round."""

    def added(self, state: State) -> list[Added]:
        """Added effects that are in the present model."""
        found = []
        for effect in state.model.effects:
            mine = [item for item in self.history if item.effect.alike(effect)]
            found += mine[-1:]
        return found

    def step(self, state: State) -> State | None:
        """One round: the state with one effect more, or None where nothing is added."""
        number = len(self.added(state)) + 1
        screen_state, screening = self._screened(state)
        if screening.p_value > self.alpha:
            return None
        self.progress(f"round {number}: refitting the best candidates")
        found = Round.of(state, screen_state, screening, self.alpha, self.room)
        if several := _several(found):
            first, size = several.rivals[0], len(several.rivals)
            self.progress(f"round {number}: adding {first.effect.key}, one of {size}")
            with suppress(np.linalg.LinAlgError):
                return self._add(found, first, None)
        if found.outdone():
            self._described(found, self.seed + number)
            return None
        refused = self._unfitted(found)
        odds, significant = found.odds, found.significant
        for rival in preferred(significant, odds):
            if why := found.unlikely(rival):
                self._reject(found, rival, why)
                continue
            try:
                why = found.fails(rival) or found.too_little(rival)
                if not why:
                    self.progress(f"round {number}: adding {rival.effect.key}")
                    return self._add(found, rival, found.description)
            except np.linalg.LinAlgError:
                why = _SINGULAR
            self._reject(found, rival, why)
            refused = refused or rival.effect
        self.refused = refused
        return None

    def look_on(self, state: State) -> None:
        """Screen where no more effects may be added. The first significant effect is recorded as
        refused, a description only where no effect is significant.
        """
        _, screening = self._screened(state)
        best = [k.peaks[0].effect for k in screening.kinds if screening.corrected(k) <= self.alpha]
        if best:
            effects = (effect for effect in best if not isinstance(effect, Empirical))
            self.refused = next(effects, best[0])

    @property
    def refusal(self) -> Refused | None:
        """`refused` with the p-value and the reason that are reported."""
        effect = self.refused
        if effect is None:
            return None
        for known in self.rejected:
            if (known.effect, known.placement) == (effect.name, effect.placement):
                return Refused(effect, known.p_value, known.reason)
        tested = (
            screening.corrected(kind)
            for screening in reversed(self.screenings)
            for kind in screening.kinds
            if kind.kind == effect.name
        )
        return Refused(effect, next(tested, math.nan), _NO_MINIMUM)

    def candidates(
        self, model: Model, measurement: Measurement
    ) -> tuple[list[Effect], list[Untestable]]:
        """The effects to try beside a model, and those that cannot be tested (`candidates`).

        Computed once per model and plan: the first screening uses the list that `close_loop` has
        checked.
        """
        last = self._tested
        if last is None or last.model is not model or last.plan is not measurement.plan:
            found = candidates(model, measurement, self.classes)
            self._tested = last = _Tested(model, measurement.plan, *found)
        return list(last.effects), list(last.untestable)

    def _screened(self, state: State) -> tuple[ScoreTest, Screening]:
        """The screening of one round."""
        number = len(self.added(state)) + 1
        fit, measurement = state.scored, state.fit.measurement
        self.progress(f"round {number}: screening")
        tried, self.untestable = self.candidates(state.model, measurement)
        kinds = EMPIRICAL if self._describing else ()
        beside = [*state.model.effects, *tried]
        empirical, _ = candidates(state.model, measurement, kinds, beside, state.fit)
        tried = [effect for effect in tried if effect.key not in self._barred]
        if self._responses is None or self._responses.plan is not measurement.plan:
            self._responses = Responses(measurement.plan)
        screen_state = ScoreTest(fit, self.draws, self.seed + number, self._responses)
        screening = screen(screen_state, [*tried, *empirical])
        screen_state.release_draws()
        self.screenings.append(screening)
        self.refused = None
        return screen_state, screening

    def _add(self, found: Round, rival: Rival, described: Rival | None) -> State:
        """The state with one effect more."""
        measurement = found.state.fit.measurement
        weighed, gain = weigh(found.classes_with(rival), rival, described), found.gain(rival)
        after = found.at_declared(rival.fit)
        refitted = self._fitted(rival.fit.model, measurement, after)
        effect, p, trials = refitted.model.effects[-1], found.p_value(rival), found.trials(rival)
        self.screenings[-1] = replace(found.screening, added=effect, refined_p={effect.name: p})
        # Last, so that an interruption leaves no effect without its fit.
        self.history.append(Added(effect, weighed, p, gain, trials))
        return refitted

    def _described(self, found: Round, seed: int) -> None:
        """End the search with the empirical description of a round."""
        best, state = found.description, found.state
        assert best is not None
        self._description, self._description_trials = best, found.trials(best)
        p = found.p_value(best)
        self.screenings[-1] = replace(found.screening, refined_p={best.effect.name: p})
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
        """The first of the significant kinds without a converged refit. Such kinds cannot be tested
        on held-out readings.
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

    def _fitted(self, model: Model, measurement: Measurement, start: Fit) -> State:
        """The fitted state of a model, with a wider prior of its last effect where that is larger
        than expected. The declared prior would shrink it and leave the rest to other effects.
        """
        last, left, state = len(model.effects) - 1, WIDENINGS, None
        while True:
            effect = model.effects[last]
            size = np.abs(start.theta[start.places_of(last)[0]]).max()
            while left and size > 1.0 and (grown := widened(effect, WIDER)) is not effect:
                effect, size, left = grown, size / WIDER, left - 1
            if state is not None and effect is model.effects[last]:
                return state
            if effect is not model.effects[last]:
                model = model.without(last).with_effects(effect)
            state = fitted(model, measurement, start, self.room)
            start = state.fit

    def _kept(self) -> Kept:
        """What an attempt changes, to restore it where the attempt fails."""
        return Kept(
            history=tuple(self.history),
            rejected=tuple(self.rejected),
            screenings=tuple(self.screenings),
            refused=self.refused,
            unexplained=self.unexplained,
            description=self._description,
            description_trials=self._description_trials,
            outdone=tuple(self._outdone),
        )

    def _restore(self, kept: Kept) -> None:
        self.history, self.rejected = list(kept.history), list(kept.rejected)
        self.screenings, self.refused = list(kept.screenings), kept.refused
        self.unexplained, self._description = kept.unexplained, kept.description
        self._description_trials = kept.description_trials
        self._outdone = list(kept.outdone)

    def _reject(self, found: Round, rival: Rival, reason: str) -> None:
        self._refuse(rival.effect, found.p_value(rival), reason)

    def _refuse(self, effect: Effect, p_value: float, reason: str) -> None:
        name, place = effect.name, effect.placement
        if not any((r.effect, r.placement) == (name, place) for r in self.rejected):
            self.rejected.append(Rejected(name, place, p_value, reason))
