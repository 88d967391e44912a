"""Close the loop: find what a measurement says is missing, name it, add it, report the gain."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from ..effects.base import Effect
from ..effects.registry import CATALOGUE
from ..fit import Fit
from ..identify import declared_whitener
from ..learn import learned_sizes, with_sizes
from ..measurement import CheckPoints, Measurement
from ..model import Model
from .candidates import Untestable, candidates
from .closure import Closure, Errors, FoundEffect, Rejected, SetErrors, Verdict
from .confounded import confounded
from .empirical import EMPIRICAL, Empirical
from .heldout import check_rms, fit_rms, heldout_rms, improvement, rms_fall
from .rivals import Rival, Weighed, fits_better, refit_all, weigh
from .scales import over_scales
from .screen import Peak, Screen, Screening, screen
from .serial import Serial, gain_beside, persists, serial
from .state import (
    State,
    at_declared,
    at_noise_found,
    chi2_per_dof,
    fitted,
    noise_scale,
    noise_scales,
    rescored,
    without,
)
from .unexplained import Unexplained, described, from_structure

CERTAIN = 0.95
"""Posterior probability from which an effect is named rather than called ambiguous."""
_PRACTICAL = 0.02
"""Least fall of the held-out rms that counts where the fit is far worse than the noise, and what
remains is no white noise: chance alignments with what is not modelled are then significant without
being real."""
_MARGIN = 30.0
_CLOSE = 8.0
"""Candidates whose linear log evidence is further behind the best than `_MARGIN` are not refined,
further than `_CLOSE` after that not refitted: their weight is below one in a thousand."""
_CONTRADICTED = math.log(5.0)
"""Log odds of an effect that held-out readings refuse over the next, from which that one is no name
either: what fits as the one and holds as the other is something else."""
_REFITS = 12
_MANY = 50.0
"""Degrees of freedom from which a search is worth its name."""
_ROOM = 16
"""Parameters that added effects may have before the solver must be compiled anew."""


# The loop is many products of small matrices: a second BLAS thread gains nothing on an idle machine
# and, waiting for a busy one, costs a multiple.
@threadpool_limits.wrap(limits=1, user_api="blas")
def close_loop(
    model: Model,
    measurement: Measurement,
    *,
    check: CheckPoints | None = None,
    effects: Iterable[type[Effect]] | None = None,
    alpha: float = 0.01,
    draws: int = 500,
    seed: int = 0,
    max_effects: int = 6,
    learn: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> Closure:
    """Find, name and add what is missing from `model`.

    Fit, screen every effect of the catalogue, pay for the search, refit the best, weigh it against
    its rivals, check it on held-out readings, add it, and repeat until nothing is significant at
    `alpha` (of the whole search). `effects` restricts the search to some classes; `check` adds the
    error at independent points; `learn` learns the sizes of the declared families (`vcal.learn`)
    for the final fit, after the search. `KeyboardInterrupt` ends the search with what
    is known so far; before the declared model is fitted nothing is, and it passes on. Raises
    `RuntimeError` in float32.
    """
    if effects is None:
        effects = [cls for cls in CATALOGUE.values() if cls.searched]
    classes = list(effects)
    settings = {
        "alpha": alpha,
        "draws": draws,
        "seed": seed,
        "max_effects": max_effects,
        "learn": learn,
        "effects": [cls.name for cls in classes],
    }
    progress("fitting the declared model")
    # Room for the effects to come, so that the solver is compiled once.
    room = len(model.entries) + _ROOM
    nominal = _nominal(model, measurement, room)
    state = fitted(model, measurement, None, room)
    before = state.fit
    run = _Run(check, classes, alpha, draws, seed, room, progress)
    interrupted = False
    try:
        for _ in range(max_effects):
            added = run.step(state)
            if added is None:
                break
            state = added
        state = run.reconsider(state) if run.unexplained is None else run.beside_empirical(state)
        if run.unexplained is None:
            state, correlated = run.prune_correlated(run.prune(state))
            if learn:
                progress("learning the sizes of the families")
                learned = with_sizes(state.model, learned_sizes(state.fit))
                state = fitted(learned, measurement, state.fit, room)
            progress("describing what remains")
            run.unexplained = from_structure(
                state.remaining,
                chi2_per_dof(state.fit),
                alpha,
                draws,
                seed + 1,
                correlated,
                run.refused,
            )
    except KeyboardInterrupt:
        interrupted = True
    try:
        progress("comparing before and after")
        return _finish(run, nominal, before, state, settings, interrupted)
    except KeyboardInterrupt:  # what was found is known, and the comparison takes a moment only
        return _finish(run, nominal, before, state, settings, interrupted)


@dataclass(frozen=True)
class _Added:
    effect: Effect
    weighed: Weighed
    p_value: float
    gain: float
    trials: float
    """Effective number of independent trials in which it was found."""


class _Run:
    """One pass through the loop: what was tried, added and left over."""

    def __init__(self, check, classes, alpha, draws, seed, room, progress):
        self.check, self.classes, self.alpha = check, classes, alpha
        self.draws, self.seed, self.room, self.progress = draws, seed, room, progress
        self.added: list[_Added] = []
        self.rejected: list[Rejected] = []
        self.untestable: list[Untestable] = []
        self.unseen: list[str] = []
        self.screenings: list[Screening] = []
        self.unexplained: Unexplained | None = None
        self.refused: Effect | None = None
        """What was significant in the last round, and did not hold."""

    def step(self, state: State) -> State | None:
        """One round: None where nothing (more) is to be added."""
        number = len(self.added) + 1
        fit, measurement = state.scored, state.fit.measurement
        self.progress(f"round {number}: screening")
        tried, self.untestable = candidates(state.model, measurement, self.classes)
        empirical, _ = candidates(state.model, measurement, EMPIRICAL)
        screen_state = Screen(fit, self.draws, self.seed + number)
        screening = screen(screen_state, [*tried, *empirical])
        self.screenings.append(screening)
        self.unseen = [effect.key for effect in screening.unseen]
        if screening.p_value > self.alpha:
            return None
        self.progress(f"round {number}: refitting the best candidates")
        instances = {kind.kind: kind.instances for kind in screening.kinds}
        p_values = {kind.kind: screening.corrected(kind) for kind in screening.kinds}
        worth = [p for p in screening.peaks if p_values[p.effect.name] <= self.alpha]
        peaks = _shortlist(screen_state, worth, screening.peaks)
        rivals = refit_all(fit, peaks, instances, state.keep, self.room)
        if rivals and not state.as_declared:
            fit = rescored(state, rivals[0].fit, self.room)
            rivals = refit_all(fit, peaks, instances, state.keep, self.room)
        named = [r for r in rivals if not isinstance(r.effect, Empirical)]
        # The p-value of a kind is that of its best candidate, which need not be this one.
        own = {
            id(r.effect): screening.corrected_as(
                r.effect.name,
                max(
                    float(screen_state.minus_log_p(p.statistic, screen_state.cost, p.rank))
                    for p in peaks
                    if p.effect is r.effect
                ),
            )
            for r in rivals
        }
        significant = [r for r in named if own[id(r.effect)] <= self.alpha]
        best = next((r for r in rivals if isinstance(r.effect, Empirical)), None)
        if (
            best is not None
            and own[id(best.effect)] <= self.alpha
            and (not significant or best.log_weight > significant[0].log_weight)
            # What a physical effect describes as well needs no description of its own.
            and fits_better(best, significant)
        ):
            self.unexplained = described(
                fit,
                state.scored,
                best,
                own[id(best.effect)],
                chi2_per_dof(state.fit),
                self.alpha,
                self.draws,
                self.seed + number,
            )
            for rival in significant:
                self._reject(rival, own, f"{best.effect.summary}: describes the residual better")
            return None
        refused: Rival | None = None
        for rival in significant:
            after = at_declared(rival.fit, state, self.room)
            noise = math.sqrt(max(1.0, rival.fit.chi2 / rival.fit.dof))
            fall, error = improvement(fit, rival.fit, noise)
            share = rms_fall(state.fit, after)
            needed = 0.0
            if state.noise is None or persists(after):
                needed = _PRACTICAL * max(0.0, 1.0 - 1.0 / max(chi2_per_dof(after), 1e-9))
            if rival.log_bayes <= 0:
                self._reject(rival, own, "its evidence does not pay for its parameters")
            elif fall <= error and not _in_the_prior(fit, rival.fit, noise):
                self._reject(rival, own, "held-out error does not fall beyond its uncertainty")
                refused = refused or rival
            elif share < needed and not _in_the_prior(fit, rival.fit, noise):
                self._reject(rival, own, f"held-out rms falls by {100 * share:.1f} % only")
                refused = refused or rival
            elif refused is not None and refused.log_weight - rival.log_weight > _CONTRADICTED:
                self._reject(rival, own, "a far likelier one does not hold on held-out readings")
            else:
                weighed = weigh(fit, rival, named)
                p = own[id(rival.effect)]
                self.progress(f"round {number}: adding {rival.effect.key}")
                refitted = fitted(rival.fit.model, measurement, after, self.room)
                # Last, so that an interruption leaves no effect without its fit.
                trials = screening.trials * next(
                    kind.trials for kind in screening.kinds if kind.kind == rival.effect.name
                )
                self.added.append(_Added(rival.effect, weighed, p, share, trials))
                return refitted
        self.refused = None if refused is None else refused.effect
        return None

    def reconsider(self, state: State) -> State:
        """Search anew beside the others for what each of several effects is: what was found first
        may have stood for a part of what was not yet known.
        """
        if len(self.added) < 2:
            return state
        for item in list(self.added):
            before = list(self.added), list(self.rejected), list(self.screenings), self.refused
            less = without(state, _place(state, item), self.room)
            if not less.converged:
                continue
            bare = fitted(less.model, less.measurement, less, self.room)
            self.added.remove(item)
            found = self.step(bare)
            self.screenings = before[2]
            if self.unexplained is not None or (
                found is not None and not _same_effect(self.added[-1].effect, item.effect)
            ):
                self.rejected.append(_dropped(item, "beside the others it is something else"))
                state, self.refused = (bare if found is None else found), None
                if found is None:
                    return state
            else:
                self.added, self.rejected, _, self.refused = before
        return state

    def beside_empirical(self, state: State) -> State:
        """Do without the effects that are superfluous beside the empirical description that ended
        the search: they stood for a part of it.
        """
        described = self.unexplained.empirical if self.unexplained is not None else None
        if described is None or not self.added:
            return state
        effect = described.effect
        with_it = fitted(described.fit.model, described.fit.measurement, described.fit, self.room)
        dropped = []
        for item in list(self.added):
            less = without(with_it, _place(with_it, item), self.room)
            if less.converged and _no_worse(less, with_it, _place(with_it, item)):
                dropped.append(item)
                self.added.remove(item)
                self.rejected.append(_dropped(item, f"superfluous beside the {effect.summary}"))
                with_it = fitted(less.model, less.measurement, less, self.room)
        if not dropped:
            return state
        for item in dropped:
            less = without(state, _place(state, item), self.room)
            state = fitted(less.model, less.measurement, less, self.room)
        # What it depends on is told anew without them; what then has a name after all, has it.
        screenings, self.unexplained = list(self.screenings), None
        found = self.step(state)
        self.screenings = screenings
        return state if found is None else found

    def prune(self, state: State) -> State:
        """Try once to do without each added effect; the evidence decides."""
        for item in list(self.added[:-1]):
            less = without(state, _place(state, item), self.room)
            if less.converged and _no_worse(less, state, _place(state, item)):
                state = self._drop(item, less, "superfluous after later effects")
        return state

    def prune_correlated(self, state: State) -> tuple[State, Serial | None]:
        """Do without the added effects that noise correlated in time describes as well, the last
        one first; and what is correlated at the end.

        Where the noise is correlated, all that changes slowly fits a part of it. An effect stays if
        its evidence beside such noise pays for the search: were there nothing, a Bayes factor
        above b has a probability of less than 1/b (Ville's inequality).
        """
        for item in reversed(list(self.added)):
            fit = state.remaining
            if serial(fit) is None:
                break
            gain = gain_beside(fit, _columns_of(fit, _place(state, item)))
            if item.trials * math.exp(-min(gain, 700.0)) > self.alpha:
                less = without(state, _place(state, item), self.room)
                state = self._drop(item, less, "noise that is correlated in time describes it too")
        found = serial(state.remaining)
        return state, found if found is not None and found.p_value <= self.alpha else None

    def _drop(self, item: _Added, less: Fit, reason: str) -> State:
        self.added.remove(item)
        self.rejected.append(_dropped(item, reason))
        return fitted(less.model, less.measurement, less, self.room)

    def _reject(self, rival: Rival, p_values: dict[int, float], reason: str) -> None:
        name, place = rival.effect.name, rival.effect.placement
        if not any((r.effect, r.placement) == (name, place) for r in self.rejected):
            self.rejected.append(Rejected(name, place, p_values[id(rival.effect)], reason))

    def finished(self, item: _Added, after: Fit) -> FoundEffect:
        """The report of an added effect, with its parameters from the final fit."""
        effect, weighed = item.effect, item.weighed
        certain = weighed.probability >= CERTAIN
        same = [k for k in weighed.equivalent if k.split(" ")[0] == effect.name]
        places = sorted({effect.placement, *(k.partition(" ")[2] for k in same)})
        return FoundEffect(
            effect=effect,
            status="named" if certain else "ambiguous",
            placement="|".join(places),
            parameters=[
                (p.name, value, p.unit, u)
                for key, p, value, u in after.parameter_values()
                if key == effect.key and p.name in {q.name for q in effect.parameters}
            ],
            p_value=item.p_value,
            log_evidence=weighed.best.log_bayes,
            delta_bic=weighed.best.delta_bic,
            heldout_gain=item.gain,
            equivalent=weighed.equivalent,
            alternatives=weighed.alternatives,
            separation="" if certain else _separation(weighed),
        )


def _finish(
    run: _Run, nominal: Fit, before: Fit, state: State, settings: dict, interrupted: bool
) -> Closure:
    """The result of a search: the final fit with the noise found, and the errors on the way."""
    noise = noise_scale(state.fit, np.ones(state.fit.measurement.rows, bool))
    scales = noise_scales(state.fit)
    after = at_noise_found(state, run.room)
    found = [run.finished(item, after) for item in run.added]
    verdict: Verdict | None = None if interrupted else "nothing_missing"
    if run.unexplained is not None:
        verdict = "unexplained"
    elif any(item.status == "ambiguous" for item in found):
        verdict = "ambiguous"
    elif found:
        verdict = "named"
    return Closure(
        verdict=verdict,
        effects=found,
        errors={
            "uncompensated": errors(nominal, run.check),
            "before": errors(before, run.check),
            "after": errors(after, run.check),
        },
        before=before,
        after=after,
        nominal=nominal,
        check=run.check,
        unexplained=run.unexplained,
        suspected=state.strays,
        rejected=run.rejected,
        untestable=run.untestable,
        unseen=run.unseen,
        screenings=run.screenings,
        noise_scale=noise,
        noise_components=() if state.noise is None else state.noise.parts,
        noise_scales=scales,
        noise_uneven=state.noise is not None and state.noise.uneven,
        settings=settings,
        interrupted=interrupted,
        notes=_notes(scales, state, run),
    )


def _shape_text(effect: Effect, shape: Mapping[str, float]) -> str:
    return ", ".join(
        f"{p.name} {shape[p.name] / p.si:.4g} {p.unit}" for p in effect.shapes if p.name in shape
    )


def _in_the_prior(before: Fit, after: Fit, noise: float) -> bool:
    """Whether it is what was declared, more than the readings, that an effect is at odds without:
    other parameters had taken its part, far from what is known of them, and foretell as well.
    """
    data = (before.chi2 - after.chi2) / noise**2
    prior = float(before.theta**2 @ before.precision - after.theta**2 @ after.precision)
    return prior > data


def _no_worse(less: Fit, state: State, place: int) -> bool:
    """Whether the evidence is higher without the effect at that position."""
    fit = state.scored
    noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
    sizes = [len(e.amplitudes) for e in state.model.effects]
    mine = slice(sum(sizes[:place]), sum(sizes[: place + 1]))
    return less.log_evidence(noise) > fit.log_evidence(noise) + over_scales(fit, mine, noise)


def _same_effect(a: Effect, b: Effect) -> bool:
    return a.key == b.key and [p.name for p in a.parameters] == [p.name for p in b.parameters]


def _dropped(item: _Added, reason: str) -> Rejected:
    return Rejected(item.effect.name, item.effect.placement, item.p_value, reason)


def _shortlist(state: Screen, worth: Sequence[Peak], others: Sequence[Peak]) -> list[Peak]:
    """The peaks to refit: the significant ones, and others close enough to be rivals, after their
    shapes were moved to the best point between the steps of the scan.
    """
    if not worth:
        return []
    best = worth[0].log_bayes
    near = [p for p in worth if p.log_bayes > best - _MARGIN]
    ids = {id(p) for p in near}
    near += [p for p in others if id(p) not in ids and p.log_bayes > best - _MARGIN]
    # Of the empirical descriptions only the best of each kind: many are alike.
    empirical: dict[str, Peak] = {}
    for peak in others:
        if isinstance(peak.effect, Empirical):
            empirical.setdefault(peak.effect.name, peak)
    near = [p for p in near if not isinstance(p.effect, Empirical)]
    near += [p for p in empirical.values() if p.log_bayes > best - _MARGIN]
    refined = sorted((state.refine(p) for p in near), key=lambda p: -p.log_bayes)
    best = refined[0].log_bayes
    chosen = [p for p in refined if p.log_bayes > best - _CLOSE][:_REFITS]
    # A run of worthless rivals must not hide the next significant candidate, should the best fail.
    chosen += [p for p in refined if p.log_bayes <= best - _CLOSE][: max(0, 2 - len(chosen))]
    return chosen


def _separation(weighed: Weighed) -> str:
    rivals = weighed.alternatives[:2]
    own = weighed.best.effect
    other = " and ".join(f"{name} {place}".strip() for name, place, _ in rivals)
    betrays = ", ".join(own.betrayed_by) or "its own covariate"
    return f"vary {betrays} independently of what betrays {other}"


def _nominal(model: Model, measurement: Measurement, room: int) -> Fit:
    nuisances = tuple(e for e in model.effects if e.kind == "nuisance" or e.where == "instrument")
    bare = Model(model.chain, model.instrument, (*nuisances, *model.random))
    return fitted(bare, measurement, None, room).fit


def _place(state: State, item: _Added) -> int:
    return next(i for i, e in enumerate(state.model.effects) if e is item.effect)


def _columns_of(fit: Fit, place: int) -> list[int]:
    """Entries of theta that belong to the effect at that position."""
    effects = fit.model.effects
    start = sum(len(e.amplitudes) for e in effects[:place])
    found = list(range(start, start + len(effects[place].amplitudes)))
    moving = [i for i, e in enumerate(effects) for p in e.shapes if p.moves]
    return found + [len(fit.model.entries) + k for k, i in enumerate(moving) if i == place]


def errors(fit: Fit, check: CheckPoints | None) -> Errors:
    """How wrong a fitted model is, on all the data there are."""
    aligned, raw = (None, None) if check is None else check_rms(fit, check)
    return Errors(aligned, raw, heldout_rms(fit), fit_rms(fit), chi2_per_dof(fit), _by_set(fit))


def _by_set(fit: Fit) -> dict[str, SetErrors]:
    """Errors of every data set, where there are several; the degrees of freedom of one are its
    readings less its own part of tr(J H^-1 J').
    """
    plan = fit.measurement.plan
    if not plan.sets:
        return {}
    whitener = declared_whitener(fit.model, fit.measurement)
    squares = (np.einsum("nij,nj->ni", whitener, fit.residual) ** 2).sum(1)
    found = {}
    for name, inside in plan.parts.items():
        _, dof = fit.chi2_and_dof(inside)
        ratio = float(squares[inside & fit.used].sum() / dof) if dof > 0.0 else math.nan
        found[name] = SetErrors(heldout_rms(fit, inside), fit_rms(fit, inside), ratio)
    return found


def _notes(scales: Mapping[str, float], state: State, run: _Run) -> list[str]:
    notes = []
    if state.noise is not None and state.noise.uneven:
        each = ", ".join(
            f"{part.name} {part.factor:.2f}" for part in state.noise.parts if part.u == part.u
        )
        notes.append(
            f"the readings do not scatter alike, in parts of what is declared: {each}; tests and "
            "uncertainties are with these, or what is declared where that is larger"
        )
    else:
        notes += [
            f"the readings{f' of {name}' if name else ''} scatter {noise:.2f} times as much as "
            "declared; uncertainties "
            + ("are scaled accordingly" if noise > 1 else "are left as declared")
            for name, noise in scales.items()
            if noise != 1.0
        ]
    if state.fit.dof < _MANY:
        notes.append(
            f"only {state.fit.dof:.0f} degrees of freedom are left beside what is declared: "
            "effects that are not large go unseen"
        )
    betraying = [name for item in run.added for name in item.effect.betrayed_by]
    if run.unexplained is not None:
        betraying += run.unexplained.depends_on[:1]
    notes += [
        f"{item.effect.key}: {_shape_text(item.effect, shape)} fits nearly as well (probability "
        f"{100 * probability:.2g} %): these positions and times hardly tell them apart"
        for item in run.added
        for shape, probability in item.weighed.other_shapes
    ]
    notes += confounded(state.fit.measurement.plan, betraying)
    if not state.fit.converged:
        notes.append("the final fit did not converge: its numbers are not to be relied on")
    return notes
