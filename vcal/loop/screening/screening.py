"""Screening of all candidates: the best of each kind of effect, and its significance.

The p-value of the best is corrected for the search within its kind first, then over the kinds.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...effects.base import Effect
from ...effects.reference import same_effect
from .score_test import Peak, ScoreTest, Tested, largest
from .significance import corrected, effective_trials


@dataclass(frozen=True)
class KindResult:
    """The best candidates of one kind of effect, corrected for the whole search within the kind."""

    kind: str
    peaks: list[Peak]
    instances: int
    """Number of places and components that were tried."""
    minus_log_p: float
    """Uncorrected."""
    trials: float
    """Effective number of independent trials in the search."""
    p_value: float
    """Corrected within the kind."""


@dataclass(frozen=True)
class Screening:
    """The result of a screening."""

    kinds: list[KindResult]
    p_value: float
    """Of the best kind, corrected over all kinds."""
    trials: float
    noise_scale: float
    """Root of chi-square per degree of freedom, after the best candidate's drop is subtracted."""
    unseen: list[Effect]
    """Candidates whose columns the declared model already spans."""
    added: Effect | None = None
    """The effect that was added after this screening, whether or not it was kept."""
    refined_p: Mapping[str, float] = field(default_factory=dict)
    """Corrected p-value, by kind, of the effect that was added or of the description that ended the
    search. It holds for its fitted shape, which may lie between the steps of the grid."""

    def corrected(self, kind: KindResult) -> float:
        """p-value of a kind's best candidate, corrected within the kind and over all kinds."""
        return float(corrected(_minus_log_corrected(kind), self.trials))

    def corrected_as(self, kind: str, minus_log_p: float) -> float:
        """p-value of any candidate of a kind, corrected within the kind and over all kinds."""
        it = next(found for found in self.kinds if found.kind == kind)
        within = float(corrected(minus_log_p, it.trials))
        return self.corrected(replace(it, minus_log_p=minus_log_p, p_value=within))

    @property
    def peaks(self) -> list[Peak]:
        """All peaks, highest evidence first."""
        found = [peak for kind in self.kinds for peak in kind.peaks]
        return sorted(found, key=lambda peak: -peak.log_bayes)

    @property
    def best_log_odds(self) -> float:
        """Log of the posterior odds of the most probable candidate, over all its shapes, against
        the present model.
        """
        together: dict[int, list[float]] = {}
        for kind in self.kinds:
            for peak in kind.peaks:
                odds = math.log(peak.effect.odds / kind.instances)
                together.setdefault(id(peak.effect), []).append(peak.log_bayes_at_its_size + odds)
        return max(map(np.logaddexp.reduce, together.values()), default=-math.inf)


def screen(state: ScoreTest, effects: Sequence[Effect], *, peaks: int = 10) -> Screening:
    """Test all candidates against a fit (method: `score_test`).

    `peaks` is the number of maxima of a grid that are kept.
    """
    groups: dict[str, list[Tested]] = {}
    unseen = []
    for effect, tested in zip(effects, state.tests(effects), strict=True):
        if tested is None:
            unseen.append(effect)
        else:
            groups.setdefault(effect.name, []).append(tested)
    kinds, null, best_drop = [], [], 0.0
    for kind, members in groups.items():
        kind_null = state.rarest(largest(t.drops.null for t in members), state.null_cost)
        trials = effective_trials(kind_null)
        instances = len({same_effect(t.effect) for t in members})
        best = float(state.rarest(largest(t.largest() for t in members), state.cost))
        found = sorted(
            (peak for t in members for peak in t.peaks(peaks)), key=lambda peak: -peak.log_bayes
        )
        best_drop = max(best_drop, *(peak.statistic for peak in found))
        kinds.append(
            KindResult(kind, found, instances, best, trials, float(corrected(best, trials)))
        )
        null.append(-np.log(np.maximum(corrected(kind_null, trials), 1e-300)))
    if not kinds:
        return Screening([], 1.0, 0.0, math.sqrt(state.chi2 / state.dof), unseen)
    over_kinds = np.max(null, axis=0)
    trials = effective_trials(over_kinds)
    best = max(_minus_log_corrected(kind) for kind in kinds)
    return Screening(
        kinds=sorted(kinds, key=lambda kind: -_minus_log_corrected(kind)),
        p_value=float(corrected(best, trials)),
        trials=trials,
        noise_scale=math.sqrt(max(state.chi2 - best_drop, 0.0) / state.dof),
        unseen=unseen,
    )


def _minus_log_corrected(kind: KindResult) -> float:
    """-ln of the corrected p-value, also where the p-value underflows."""
    if kind.p_value > 1e-290:
        return -math.log(kind.p_value)
    return kind.minus_log_p - math.log(kind.trials)
