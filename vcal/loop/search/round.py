"""One round of the search: significant candidates are refitted and weighed before one is added."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...identification.fit import Fit, declared_chi2
from ..empirical import Empirical
from ..residuals.autocorrelation import persists
from ..screening.maxima import refined_maxima, without_duplicates
from ..screening.score_test import Peak, ScoreTest
from ..screening.screening import Screening
from ..weighing.cross_validation import (
    improvement,
    predicted_squares_fall,
    rms_fall,
    supported_by_one_fold,
    weighted_squares,
)
from ..weighing.rivals import Rival, refit_all
from ..weighing.subsets import MOST, Subset, smallest_subset
from ..weighing.weighing import DISTINGUISHABLE, Names, classes_of, outdoes
from .state import State, at_declared, chi2_per_dof, rescored

_MARGIN, _UNRESOLVED = 30.0, 0.3
_CLOSE = 8.0
"""Candidates whose linear log evidence is behind the best by more than `_MARGIN`, and by more than
that share of it which a grid may miss between two steps, are not refined; after that, those behind
by more than `_CLOSE` are not refitted. Their weight is below one in a thousand."""
_REFITS = 12
"""Most candidates that are refitted, without further shapes of them that fit alike."""
_ROUNDS = 3
"""Refinements of such a shape between the steps of its scan, each by a factor of four."""


def shortlist(
    state: ScoreTest, worth: Sequence[Peak], others: Sequence[Peak], instances: Mapping[str, int]
) -> list[Peak]:
    """The peaks to refit: the most significant of each kind, and others that are close enough to be
    rivals.

    Their shapes are moved to the best point between the steps of the grid. `instances` is the
    number of places and components of each kind that were tried.
    """
    if not worth:
        return []
    best = max(p.log_bayes_at_its_size for p in worth)
    least = best - max(_MARGIN, _UNRESOLVED * best)
    near = [p for p in worth if p.log_bayes_at_its_size > least]
    ids = {id(p) for p in near}
    near += [p for p in others if id(p) not in ids and p.log_bayes_at_its_size > least]
    # Only the best of each kind of empirical description, because many are alike.
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
    # The best of every kind first, because many places of one kind may be alike.
    firsts = sorted({p.effect.name: p for p in reversed(close)}.values(), key=weight, reverse=True)
    ids = {id(p) for p in firsts}
    chosen = [*firsts, *(p for p in close if id(p) not in ids)][:_REFITS]
    # Poor rivals must not hide the next significant candidate if the best one fails.
    chosen += [p for p in refined if weight(p) <= most - _CLOSE][: max(0, 2 - len(chosen))]
    # A significant candidate that is not added needs a reason, however improbable it is.
    ids = {id(p) for p in chosen}
    chosen += [moved[id(p)] for p in significant if id(moved[id(p)]) not in ids]
    return sorted(chosen, key=weight, reverse=True)


def with_alike_shapes(state: ScoreTest, peaks: Sequence[Peak]) -> list[Peak]:
    """The peaks, and all others of an effect of which several fit alike, such as the pitches of a
    screw on positions in equal steps.

    The odds of a name are the sum over its shapes. Where only some of a class are refitted, an
    effect with one shape would be too probable beside it.
    """
    found = list(peaks)
    for effect in {id(p.effect): p.effect for p in peaks}.values():
        if not effect.shapes or not all(p.moves for p in effect.shapes):
            continue
        mine = [p for p in peaks if p.effect is effect]
        highest = max(p.statistic for p in mine)
        least = highest - DISTINGUISHABLE * max(1.0, (state.chi2 - highest) / state.dof)
        if sum(p.statistic > least for p in mine) < 2:
            continue
        (tested,) = state.tests([effect])
        maxima = [] if tested is None else refined_maxima(state, tested, _ROUNDS)
        alike = [p for p in maxima if p.statistic > least]
        found += without_duplicates(effect, [*mine, *alike], state.fit)[len(mine) :]
    return found


_PRACTICAL = 0.02
"""Least relative fall of the held-out rms (lengths, or in units of the noise) that counts where the
fit is far worse than the noise and the residual is not white. Chance correlations with unmodelled
errors are then significant without being real."""
_POOR = 2.0
"""Chi-square per degree of freedom from which a fit is far worse than the noise."""
_BEYOND_NOISE = 5.0
"""Standard deviations of chi-square by which a fit exceeds the declared noise."""
_PLAINLY = 3.0
"""Multiple of that limit above which no refit with the declared noise is needed to decide."""
_SOMETHING = 1.0
"""Least fall of chi-square by an empirical description."""
_BEHIND = 4
"""Most kinds that are refitted although their evidence is far behind."""
_HOPELESS = 0.3
"""Share of the residual beyond the noise of the best effect above which a subset, by its linear
fit, is not refitted: it could not reach the noise."""
_UNLIKELIER = "the readings are no more probable with it than without it"
_UNEXPECTED = "its size is far larger than expected, and its evidence does not outweigh that"


@dataclass(frozen=True)
class Round:
    """The candidates of one round, refitted and weighed against each other."""

    state: State
    fit: Fit
    """The fit that they are weighed against: the state's fit for tests and evidence."""
    screening: Screening
    peaks: list[Peak]
    """Peaks that were refitted."""
    rivals: list[Rival]
    """Converged refits, most probable first, with the descriptions among them."""
    p_values: dict[int, float]
    """Corrected p-value of every rival, by the id of its effect."""
    classes: list[list[Rival]]
    """Classes of effects that the data cannot distinguish."""
    ranked: list[tuple[Rival, float]]
    """Effects with their log odds, the most probable name first."""
    structured: bool
    """Whether the best fit exceeds the declared noise and its residual is not white."""
    behind: list[Rival]
    """Significant kinds whose evidence is far behind; only where `structured`."""
    alpha: float
    room: int
    _declared: dict[int, tuple[Fit, Fit]] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(
        cls, state: State, screen: ScoreTest, screening: Screening, alpha: float, room: int
    ) -> "Round":
        """Refit and weigh the significant candidates of a screening, and their possible rivals."""
        fit = state.scored
        instances = {kind.kind: kind.instances for kind in screening.kinds}
        significant = {k.kind for k in screening.kinds if screening.corrected(k) <= alpha}
        worth = [p for p in screening.peaks if p.effect.name in significant]
        peaks = shortlist(screen, worth, screening.peaks, instances)
        peaks = with_alike_shapes(screen, peaks)
        rivals = refit_all(fit, peaks, instances, state.keep, room)
        if rivals and (better := rescored(state, rivals[0].fit, room)) is not fit:
            fit = better
            rivals = refit_all(fit, peaks, instances, state.keep, room)
        classes = classes_of(fit, [r for r in rivals if not isinstance(r.effect, Empirical)])
        ranked = Names.of(classes).ranked() if classes else []
        behind = []
        structured = bool(rivals) and _structured(state, _best(rivals).fit, room)
        if structured:
            others = _of_other_kinds(worth, rivals, min(_BEHIND, max(0, MOST - len(classes))))
            behind = refit_all(fit, others, instances, state.keep, room)
        # The p-value of a kind is that of its best candidate, which need not be this one.
        tested = [*screening.peaks, *peaks]
        p_values = {
            id(r.effect): screening.corrected_as(
                r.effect.name, max(screen.rarity_of(p) for p in tested if p.effect is r.effect)
            )
            for r in [*rivals, *behind]
        }
        return cls(
            state, fit, screening, peaks, rivals, p_values, classes, ranked, structured, behind,
            alpha, room
        )  # fmt: skip

    @property
    def odds(self) -> dict[int, float]:
        """Log odds of the effects, by the id of the rival."""
        return {id(rival): odds for rival, odds in self.ranked}

    @property
    def significant(self) -> list[Rival]:
        """Effects that are significant themselves, the most probable name first."""
        return [rival for rival, _ in self.ranked if self.p_value(rival) <= self.alpha]

    @property
    def leads(self) -> list[Rival]:
        """The first rival of every significant name; equivalent names count once."""
        names = {id(r): members[0].effect.key for members in self.classes for r in members}
        found: dict[str, Rival] = {}
        for rival in self.significant:
            found.setdefault(names[id(rival)], rival)
        return list(found.values())

    @property
    def description(self) -> Rival | None:
        """The most probable significant empirical description that lowers chi-square noticeably.
        Where the plan hardly determines it, a rare p-value does not imply a better fit.
        """
        found = (r for r in self.rivals if isinstance(r.effect, Empirical))
        noticeable = (r for r in found if self.fit.chi2 - r.fit.chi2 > _SOMETHING)
        return next((r for r in noticeable if self.p_value(r) <= self.alpha), None)

    def p_value(self, rival: Rival) -> float:
        """p-value corrected for the search."""
        return self.p_values[id(rival.effect)]

    def trials(self, rival: Rival) -> float:
        """Effective number of independent trials in which a rival was found."""
        kinds = self.screening.kinds
        its = next(kind.trials for kind in kinds if kind.kind == rival.effect.name)
        return self.screening.trials * its

    def outdone(self) -> bool:
        """Whether an empirical description is preferred to every effect."""
        best, odds = self.description, self.odds
        return best is not None and outdoes(best, [(r, odds[id(r)]) for r in self.significant])

    def at_declared(self, fit: Fit) -> Fit:
        """A fit of this round, with the declared noise."""
        if id(fit) not in self._declared:
            # The fit is stored with it, so that its id is not reused.
            self._declared[id(fit)] = fit, at_declared(fit, self.state, self.room)
        return self._declared[id(fit)][1]

    def gain(self, rival: Rival) -> float:
        """Relative fall of the held-out rms of lengths."""
        return rms_fall(self.state.fit, self.at_declared(rival.fit), self._rows(rival))

    def unlikely(self, rival: Rival) -> str:
        """Reason where the evidence of an effect is too small, else empty."""
        return unlikely(rival, self.odds[id(rival)], len(self.screening.kinds)) or ""

    def fails(self, rival: Rival) -> str:
        """Reason where an effect does not hold on held-out readings, else empty."""
        noise = math.sqrt(max(1.0, rival.fit.chi2 / rival.fit.dof))
        fall, error = improvement(self.fit, rival.fit, noise)
        if _in_the_prior(self.fit, rival.fit, noise):
            return ""
        if fall <= (self._chosen(rival) if self._in_one_fold(rival) else error):
            return "held-out readings are not predicted better beyond their uncertainty"
        return ""

    def too_little(self, rival: Rival) -> str:
        """Reason where an effect that holds makes too small a difference on held-out readings, else
        empty.

        It applies where the fit is poor, because nearly any effect then describes a part of the
        rest. Rows that are never fitted may hardly depend on the effect, such as those at the end
        of a warm-up. The largest of three relative falls counts: of the held-out rms in lengths,
        the same in units of the noise, and of all predictions.
        """
        noise = math.sqrt(max(1.0, rival.fit.chi2 / rival.fit.dof))
        if not self._poor(rival.fit) or _in_the_prior(self.fit, rival.fit, noise):
            return ""
        share = self.gain(rival)
        weighted = rms_fall(self.fit, rival.fit, self._rows(rival), weighted_squares)
        if max(share, weighted, predicted_squares_fall(self.fit, rival.fit, noise)) >= _PRACTICAL:
            return ""
        way = f"falls by only {100 * share:.1f} %" if share > 0 else "does not fall"
        return f"the held-out rms {way}"

    def hidden_by_each_other(self) -> Subset | None:
        """Significant effects that together leave no more than noise, where each alone, and each
        description, leaves more. The most probable single effect may be a mixture of all of them.
        """
        names = [*self.leads, *self.behind][:MOST]
        if not self.structured or len(names) < 2:
            return None
        alone = _best(self.rivals)

        def enough(fit: Fit) -> bool:
            return not _structured(self.state, fit, self.room)

        beyond = declared_chi2(alone.fit) / alone.fit.dof - 1.0
        noise = _BEYOND_NOISE * math.sqrt(2.0 / self.fit.dof)
        most = self.fit.dof * (1.0 + max(_HOPELESS * beyond, 2.0 * noise))
        found = smallest_subset(self.fit, names, enough, most, self.state.keep, self.room)
        if found is None:
            return None
        noise = math.sqrt(max(1.0, found.fit.chi2 / found.fit.dof))
        fall, error = improvement(self.fit, found.fit, noise)
        return found if fall > error else None

    def classes_with(self, rival: Rival) -> list[list[Rival]]:
        """The classes, and one more for a rival that is in none of them."""
        among = any(one is rival for members in self.classes for one in members)
        return self.classes if among else [*self.classes, [rival]]

    def _in_one_fold(self, rival: Rival) -> bool:
        return supported_by_one_fold(rival.fit, len(rival.fit.model.effects) - 1)

    def _chosen(self, rival: Rival) -> float:
        """Deviance that a moment or a pitch owes to having been selected with the held-out
        readings: those of one fold, whose sum has no scatter to compare with.
        """
        scan = rival.effect.scan(self.fit.measurement.plan) if rival.effect.shapes else {}
        return 2.0 * math.fsum(math.log(len(grid)) for grid in scan.values())

    def _rows(self, rival: Rival) -> np.ndarray:
        # Readings of another instrument do not test an effect of this one.
        return np.asarray(rival.effect.rows(self.state.fit.measurement.plan))

    def _poor(self, fit: Fit) -> bool:
        """Whether a fit is far worse than the declared noise, and its residual is not white."""
        return _beyond(self.state, self.at_declared(fit), _POOR)


def _structured(state: State, fit: Fit, room: int) -> bool:
    """Whether a fit exceeds the declared noise, and its residual is not white."""
    limit = 1.0 + _BEYOND_NOISE * math.sqrt(2.0 / fit.dof)
    if declared_chi2(fit) <= _PLAINLY * limit * fit.dof:
        fit = at_declared(fit, state, room)
    return _beyond(state, fit, limit)


def _beyond(state: State, fit: Fit, limit: float) -> bool:
    return chi2_per_dof(fit) > limit and (state.noise is None or persists(fit))


def _best(rivals: Sequence[Rival]) -> Rival:
    return min(rivals, key=lambda rival: rival.fit.chi2)


def _of_other_kinds(peaks: Sequence[Peak], rivals: Sequence[Rival], most: int) -> list[Peak]:
    """The best peaks of at most `most` kinds without a rival."""
    known, best = {r.effect.name for r in rivals}, {}
    for peak in sorted(peaks, key=lambda p: -p.log_bayes_at_its_size):
        if peak.effect.name not in known and not isinstance(peak.effect, Empirical):
            best.setdefault(peak.effect.name, peak)
    return list(best.values())[:most]


def unlikely(rival: Rival, odds: float, kinds: int) -> str | None:
    """Reason where the evidence of an effect, with these log odds of its name, is too small; else
    None.

    The p-value accounts for the search, which must not be counted twice: it suffices that the
    readings are more probable with the effect than without. Where the size needs an allowance,
    chance is as good an explanation, and the evidence must outweigh all `kinds` of effects.
    """
    evidence = odds - rival.size_allowance - rival.log_prior
    if evidence <= 0.0:
        return _UNLIKELIER
    if rival.size_allowance > 0.0 and evidence <= math.log(kinds):
        return _UNEXPECTED
    return None


def _in_the_prior(before: Fit, after: Fit, noise: float) -> bool:
    """Whether an effect relieves the declared priors more than the readings.

    Without it, other parameters had taken its part, far from their priors, and predict the readings
    as well.
    """
    data = (before.chi2 - after.chi2) / noise**2
    prior = float(before.theta**2 @ before.precision - after.theta**2 @ after.precision)
    return prior > data
