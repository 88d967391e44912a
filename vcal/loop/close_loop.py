"""Close the loop: find what a measurement says is missing, name it, add it, report the gain."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincc
from threadpoolctl import threadpool_limits

from ..effects.base import Effect
from ..effects.registry import CATALOGUE
from ..fit import Fit
from ..identify import declared_whitener, identify
from ..learn import learned_sizes, with_sizes
from ..measurement import CheckPoints, Measurement
from ..model import Model
from .candidates import LocalBump, Untestable, candidates
from .closure import Closure, Errors, FoundEffect, Rejected, SetErrors, Verdict
from .heldout import check_rms, fit_rms, heldout_rms, improvement
from .rivals import Rival, Weighed, refit_all, weigh
from .screen import Peak, Screen, Screening, screen
from .stray import Stray, stray_rows
from .unexplained import Unexplained, described, from_structure

CERTAIN = 0.95
"""Posterior probability from which an effect is named rather than called ambiguous."""
_PRACTICAL = 0.02
"""Least fall of the held-out rms that counts where the fit is far worse than the noise: chance
alignments with what is not modelled are then significant without being real."""
_MARGIN = 30.0
_CLOSE = 8.0
"""Candidates whose linear log evidence is further behind the best than `_MARGIN` are not refined,
further than `_CLOSE` after that not refitted: their weight is below one in a thousand."""
_SHOWN = 1e-2
"""Probability below which the noise that a data set shows is not the one declared, for tests."""
_REFITS = 10
_ROOM = 16
"""Parameters that added effects may have before the solver must be compiled anew."""


@dataclass(frozen=True)
class _State:
    """The model as far as the loop has come."""

    model: Model
    fit: Fit
    """With the declared noise."""
    scored: Fit
    """With the covariance that clustered readings show, for tests and evidence; else the same."""
    screened: Fit
    """With the noise that every data set shows, for tests, where they differ; else the same."""
    keep: np.ndarray
    strays: list[Stray]


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
    state = _fit(model, measurement, None, room)
    before = state.fit
    run = _Run(check, classes, alpha, draws, seed, room, progress)
    interrupted = False
    try:
        for _ in range(max_effects):
            added = run.step(state)
            if added is None:
                break
            state = added
        if run.unexplained is None:
            state = run.prune(state)
            if learn:
                progress("learning the sizes of the families")
                learned = with_sizes(state.model, learned_sizes(state.fit))
                state = _fit(learned, measurement, state.fit, room)
            progress("describing what remains")
            # Tests go by the noise that every data set shows, sizes by what was declared.
            tested = state.screened if measurement.plan.sets else state.fit
            run.unexplained = from_structure(
                tested, _chi2_per_dof(state.fit), alpha, draws, seed + 1
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

    def step(self, state: _State) -> _State | None:
        """One round: None where nothing (more) is to be added."""
        number = len(self.added) + 1
        fit, measurement = state.scored, state.fit.measurement
        self.progress(f"round {number}: screening")
        tried, self.untestable = candidates(state.model, measurement, self.classes)
        bumps, _ = candidates(state.model, measurement, [LocalBump])
        screen_state = Screen(state.screened, self.draws, self.seed + number)
        screening = screen(screen_state, [*tried, *bumps])
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
        named = [r for r in rivals if r.effect.name != LocalBump.name]
        significant = [r for r in named if p_values[r.effect.name] <= self.alpha]
        bump = next((r for r in rivals if r.effect.name == LocalBump.name), None)
        if (
            bump is not None
            and p_values[LocalBump.name] <= self.alpha
            and (not significant or bump.log_bayes > significant[0].log_bayes)
        ):
            self.unexplained = described(
                fit,
                state.screened,
                bump,
                p_values[LocalBump.name],
                _chi2_per_dof(state.fit),
                self.alpha,
                self.draws,
                self.seed + number,
            )
            for rival in significant:
                self._reject(rival, p_values, "a local error describes the residual better")
            return None
        for rival in significant:
            after = _at_declared(rival.fit, state, self.room)
            fall, error, share = improvement(state.fit, after)
            needed = _PRACTICAL * max(0.0, 1.0 - 1.0 / max(_chi2_per_dof(after), 1e-9))
            if rival.log_bayes <= 0:
                self._reject(rival, p_values, "its evidence does not pay for its parameters")
            elif fall <= error:
                self._reject(rival, p_values, "held-out error does not fall beyond its uncertainty")
            elif share < needed:
                self._reject(rival, p_values, f"held-out rms falls by {100 * share:.1f} % only")
            else:
                weighed = weigh(fit, rival, named)
                p = p_values[rival.effect.name]
                self.progress(f"round {number}: adding {rival.effect.key}")
                refitted = _fit(rival.fit.model, measurement, after, self.room)
                # Last, so that an interruption leaves no effect without its fit.
                self.added.append(_Added(rival.effect, weighed, p, share))
                return refitted
        return None

    def prune(self, state: _State) -> _State:
        """Try once to do without each added effect; the evidence decides."""
        for item in list(self.added[:-1]):
            place = next(i for i, e in enumerate(state.model.effects) if e is item.effect)
            without = _without(state, place, self.room)
            noise = math.sqrt(max(1.0, state.scored.chi2 / state.scored.dof))
            if without.converged and without.log_evidence(noise) > state.scored.log_evidence(noise):
                self.added.remove(item)
                self.rejected.append(
                    Rejected(
                        item.effect.name,
                        item.effect.placement,
                        item.p_value,
                        "superfluous after later effects",
                    )
                )
                state = _fit(without.model, without.measurement, without, self.room)
        return state

    def _reject(self, rival: Rival, p_values: dict[str, float], reason: str) -> None:
        name, place = rival.effect.name, rival.effect.placement
        if not any((r.effect, r.placement) == (name, place) for r in self.rejected):
            self.rejected.append(Rejected(name, place, p_values[name], reason))

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
    run: _Run, nominal: Fit, before: Fit, state: _State, settings: dict, interrupted: bool
) -> Closure:
    """The result of a search: the final fit with the noise found, and the errors on the way."""
    noise = _noise_scale(state.fit, np.ones(state.fit.measurement.rows, bool))
    scales = {name: _noise_scale(state.fit, rows) for name, rows in _parts(state.fit).items()}
    after = _at_noise(state.fit, scales, run.room)
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
        noise_scales=scales,
        settings=settings,
        interrupted=interrupted,
        notes=_notes(scales, state),
    )


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
    near += [p for p in others if p.effect.name == LocalBump.name and id(p) not in ids][:1]
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


def _fit(model: Model, measurement: Measurement, start: Fit | None, room: int) -> _State:
    """Fit, leave out stray readings, and fit again with the covariance of clustered readings."""
    plan, instrument = measurement.plan, model.instrument
    folds, apart = instrument.folds(plan)
    keep = ~(np.broadcast_to(apart, plan.rows) & (folds >= 0))
    options: dict = {"keep": keep, "room": room}
    if start is not None:
        options |= {"theta": start.theta, "shapes": start.shapes}
    fit = identify(model, measurement, **options)
    strays = stray_rows(fit)
    options |= {"theta": fit.theta, "shapes": fit.shapes}
    if strays:
        keep = keep.copy()
        keep[[s.row for s in strays]] = False
        options["keep"] = keep
        fit = identify(model, measurement, **options)
    scored = fit
    if (fit.clusters >= 0).any():
        for _ in range(2):
            scored = identify(model, measurement, whitener=estimated_whitener(scored), **options)
    return _State(model, fit, scored, _screened(scored, options), keep, strays)


def _screened(fit: Fit, options: dict) -> Fit:
    """The fit with the noise that every data set shows, where that is not chance (p < 1e-2).

    One factor for all is taken care of where a test is studentised; data sets whose noise was
    declared well and badly are not.
    """
    parts = _parts(fit)
    scales = {name: _noise_scale(fit, rows, _SHOWN) for name, rows in parts.items()}
    if len(parts) == 1 or set(scales.values()) == {1.0}:
        return fit
    whitener = _scaled(fit.whitener, fit, scales)
    return identify(fit.model, fit.measurement, whitener=whitener, **options)


def _parts(fit: Fit) -> dict[str, np.ndarray]:
    return fit.measurement.plan.parts


def _scaled(whitener: np.ndarray, fit: Fit, scales: Mapping[str, float]) -> np.ndarray:
    """W for a noise that is larger by a factor of each data set."""
    scale = np.ones(len(whitener))
    for name, rows in _parts(fit).items():
        scale[rows] = scales[name]
    return whitener / scale[:, None, None]


def _at_declared(fit: Fit, state: _State, room: int) -> Fit:
    """The fit with the declared noise."""
    if (fit.clusters >= 0).any():
        return identify(
            fit.model,
            fit.measurement,
            theta=fit.theta,
            shapes=fit.shapes,
            keep=state.keep,
            room=room,
        )
    return fit


def estimated_whitener(fit: Fit) -> np.ndarray:
    """W of every row from the covariance the readings of one row show in the residuals.

    For rows whose readings share errors that are not modelled (`Instrument.clusters`): S = sum r r'
    / (rows - parameters per reading), not below the declared noise. The parameters are shared out
    evenly over all rows.
    """
    used, clusters = fit.used, fit.clusters
    found = np.ascontiguousarray(declared_whitener(fit.model, fit.measurement))
    for k in np.unique(clusters[clusters >= 0]):
        mine = clusters == k
        here = np.flatnonzero(mine & used)
        if not len(here):
            continue
        present = np.flatnonzero(fit.counted[here[0]])
        rows, m = len(here), len(present)
        r = fit.residual[np.ix_(here, present)]
        taken = len(fit.theta) * (rows / used.sum())
        covariance = r.T @ r / max(rows - taken / m, m + 1.0)
        block = np.ix_(present, present)
        declared = np.linalg.inv(found[np.flatnonzero(mine)[0]][block])
        covariance = covariance + 0.1 * declared @ declared.T
        whitener = np.eye(fit.residual.shape[1])
        whitener[block] = np.linalg.cholesky(np.linalg.inv(covariance)).T
        found[mine] = whitener
    return found


def _nominal(model: Model, measurement: Measurement, room: int) -> Fit:
    nuisances = tuple(e for e in model.effects if e.kind == "nuisance" or e.where == "instrument")
    bare = Model(model.chain, model.instrument, (*nuisances, *model.random))
    return _fit(bare, measurement, None, room).fit


def _without(state: _State, place: int, room: int) -> Fit:
    fit = state.scored
    sizes = [len(e.amplitudes) for e in state.model.effects]
    first = sum(sizes[:place])
    kept = np.r_[0:first, first + sizes[place] : sum(sizes)].astype(int)
    shapes = {i - (i > place): shape for i, shape in fit.shapes.items() if i != place}
    return identify(
        state.model.without(place),
        fit.measurement,
        theta=fit.theta[kept],
        shapes=shapes,
        whitener=fit.whitener,
        keep=state.keep,
        room=room,
    )


def _chi2_per_dof(fit: Fit) -> float:
    """chi2 per degree of freedom against the declared noise."""
    whitener = declared_whitener(fit.model, fit.measurement)
    residual = np.einsum("nij,nj->ni", whitener, fit.residual)[fit.used]
    return float((residual**2).sum() / fit.dof)


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


def _noise_scale(fit: Fit, rows: np.ndarray, chance: float = 1e-3) -> float:
    """Root of chi2/dof of these rows where that is not chance, else one."""
    chi2, dof = (fit.chi2, fit.dof) if rows.all() else fit.chi2_and_dof(rows)
    if dof <= 0.0:
        return 1.0
    p = gammaincc(0.5 * dof, 0.5 * chi2)
    ratio = math.sqrt(chi2 / dof)
    return ratio if p < chance or p > 1.0 - chance else 1.0


def _at_noise(fit: Fit, scales: Mapping[str, float], room: int) -> Fit:
    """The fit with the noise that was found instead of the one declared, where it is larger."""
    larger = {name: max(scale, 1.0) for name, scale in scales.items()}
    if set(larger.values()) == {1.0}:
        return fit
    return identify(
        fit.model,
        fit.measurement,
        theta=fit.theta,
        shapes=fit.shapes,
        whitener=_scaled(fit.whitener, fit, larger),
        room=room,
    )


def errors(fit: Fit, check: CheckPoints | None) -> Errors:
    """How wrong a fitted model is, on all the data there are."""
    aligned, raw = (None, None) if check is None else check_rms(fit, check)
    return Errors(aligned, raw, heldout_rms(fit), fit_rms(fit), _chi2_per_dof(fit), _by_set(fit))


def _notes(scales: Mapping[str, float], state: _State) -> list[str]:
    notes = []
    for name, noise in scales.items():
        if noise != 1.0:
            notes.append(
                f"the readings{f' of {name}' if name else ''} scatter {noise:.2f} times as much as "
                "declared; uncertainties "
                + ("are scaled accordingly" if noise > 1 else "are left as declared")
            )
    if not state.fit.converged:
        notes.append("the final fit did not converge: its numbers are not to be relied on")
    return notes
