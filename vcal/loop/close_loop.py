"""Close the loop: find, name and add the effects that a model lacks, and report the gain."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from ..effects.base import Effect
from ..effects.clock import CLOCKS
from ..effects.cyclic import ScrewCyclic
from ..effects.data_set import OfDataSet
from ..effects.reference import FreeReference
from ..effects.registry import CATALOGUE
from ..identification.family_sizes import learned_sizes, with_sizes
from ..identification.fit import Fit, normalised_residuals
from ..identification.identify import identify
from ..identification.model_averaging import Alternatives
from ..instruments.conditions import file_column
from ..machine.parameters import in_units
from ..machine.plan import Plan
from ..model.forward import Model
from ..model.measurement import CheckPoints, Measurement
from ..units import si_factor
from ..words import some_values, unsolvable
from .empirical import EMPIRICAL
from .notes import Facts, notes
from .outcome.closure import Closure, Errors, FoundEffect, Rejected, SetErrors, Verdict
from .outcome.gain import no_gain
from .outcome.misdeclared import Misdeclared
from .outcome.unexplained import from_structure
from .residuals.vibration import vibration
from .screening.candidates import UntestableError
from .screening.screening import Screening
from .search.certainty import chance, doubted, hinted, jump_time_uncertainty, odds_of_kinds
from .search.forward_selection import Added, place_of
from .search.initial_shapes import initial_shapes
from .search.search import Search
from .search.shape_classes import Shapes, with_shape_classes
from .search.sizes import misdeclared
from .search.state import (
    State,
    at_noise_found,
    chi2_per_dof,
    evenly_scattered,
    fitted,
    reported_noise_scales,
)
from .settings import checked, classes_of, null_draws
from .weighing.cross_validation import check_rms, fit_rms, heldout_fall, heldout_rms
from .weighing.weighing import CERTAIN, Weighed

_ROOM = 16
"""Parameters that added effects may have before the solver must be recompiled."""


# The loop consists of many products of small matrices. A second BLAS thread gains nothing on an
# idle machine and slows a busy one down several times.
@threadpool_limits.wrap(limits=1, user_api="blas")
def close_loop(
    model: Model,
    measurement: Measurement,
    *,
    check: CheckPoints | None = None,
    effects: Iterable[type[Effect] | str] | None = None,
    alpha: float = 0.01,
    draws: int | None = None,
    seed: int = 0,
    max_effects: int = 32,
    learn: bool = False,
    require_testable: bool = False,
    declared: Callable[[Fit], None] = lambda fit: None,
    progress: Callable[[str], None] = lambda text: None,
    known: Callable[[list[dict[str, Any]]], None] = lambda found: None,
) -> Closure:
    """Find, name and add the effects that are missing from `model`.

    Fit, screen every effect of the catalogue with correction for the search, refit the best, weigh
    it against its rivals, test it on held-out readings, add it, and repeat until nothing is
    significant at `alpha` (for the whole search).

    `effects` restricts the search to some classes, or names of the catalogue; with
    `require_testable`, `UntestableError` is raised before any fit where the data can test none of
    them. `check` adds the error at independent points. `draws` and `seed` define the null
    residuals (`LoopSettings`), `max_effects` limits the number of added effects. `learn` learns
    the sizes of the declared families (`vcal.identification.family_sizes`) for the final fit,
    after the search.
    `declared` receives the fit of the declared model before the search, and may raise.
    `progress` receives a text before every step, `known` the effects that were added so far as
    plain values whenever they change.

    Where the declared sizes of the families do not fit, and other sizes are more probable than any
    effect that could be missing, the search starts from a fit with these sizes.

    `KeyboardInterrupt` ends the search, and the result holds what was found so far; before the
    declared model is fitted it is passed on. Raises `RuntimeError` in float32, `ValueError` for
    settings out of their bounds (`LoopSettings`), and `LinAlgError` where the readings do not
    determine the parameters.
    """
    checked(alpha=alpha, draws=draws, seed=seed, max_effects=max_effects, learn=learn)
    draws = null_draws(draws, measurement.readings.size)
    classes = classes_of(CATALOGUE.values() if effects is None else effects)
    settings = {
        "alpha": alpha,
        "draws": draws,
        "seed": seed,
        "max_effects": max_effects,
        "learn": learn,
        "effects": [cls.name for cls in classes],
    }
    # Room for further effects, so that the solver is compiled once.
    room = len(model.entries) + _ROOM
    run = Search(check, classes, alpha, draws, seed, room, progress)
    if require_testable:
        tried, untestable = run.candidates(model, measurement)
        if not tried:
            raise UntestableError(untestable)
    progress("fitting the declared model")
    state = fitted(model, measurement, None, room)
    before = state.fit
    declared(state.scored)
    interrupted, stopped, sizes = False, "", None
    undistinguished: list[Shapes] = []

    def reached(found: State) -> None:
        nonlocal state
        state = found
        known(_so_far(run, state))

    try:
        state, sizes = run.with_fitting_sizes(state)
        state = run.rounds(state, max_effects, reached)
        if run.described_by_noise(state):
            run.unexplained = None
        if run.unexplained is None:
            pruned, full = run.prune(state, reached), len(run.added(state)) >= max_effects
            if full and pruned is not state:
                # Effects that were removed make room for others: once.
                pruned = run.rounds(pruned, max_effects, reached)
                if run.unexplained is None:
                    pruned = run.prune(pruned, reached)
            state = pruned
        if run.unexplained is None:
            state, correlated = run.prune_correlated(state, reached)
            full = len(run.added(state)) >= max_effects
            if learn:
                progress("learning the sizes of the families")
                learned = with_sizes(state.model, learned_sizes(state.fit))
                state = fitted(learned, measurement, state.fit, room)
            if full and run.refused is None:
                run.look_on(state)
            progress("describing what remains")
            run.unexplained = from_structure(
                state.remaining,
                chi2_per_dof(state.fit),
                alpha,
                draws,
                seed + 1,
                correlated,
                run.refusal,
                full,
                evenly_scattered(state),
            )
        run.weigh_again(state)
        progress("looking for shapes that the readings cannot distinguish")
        added = [item.effect for item in run.added(state)]
        state, undistinguished = with_shape_classes(state, added, room)
    except KeyboardInterrupt:
        interrupted = True
    except np.linalg.LinAlgError as error:  # the effects that were added hold without the rest
        interrupted, stopped = True, unsolvable(error)
    if sizes is None:
        sizes = misdeclared(state, model, room)
        if sizes is not None and run.unexplained is not None and not sizes.test.gross:
            sizes = None  # the errors may have absorbed a part of what is unexplained
    result = (run, model, before, state, undistinguished, settings, interrupted, stopped, sizes)
    try:
        progress("comparing before and after")
        return _finish(*result)
    except KeyboardInterrupt:  # the result is known, and the comparison takes a moment only
        return _finish(*result)


def _so_far(run: Search, state: State) -> list[dict[str, Any]]:
    """The added effects as plain values, without the tests that come at the end of the search."""
    fit = state.fit
    return [
        {
            "effect": item.effect.name,
            "placement": item.effect.placement,
            "p_value": float(item.p_value),
            "parameters": [
                {"name": p.name, "value": float(value), "unit": p.unit, "u": float(u)}
                for _, p, value, u in fit.values_of(place_of(item, fit.model.effects))
            ],
        }
        for item in run.added(state)
    ]


def _undecided(effect: FoundEffect) -> bool:
    """Whether several models stand beside an effect: a hint, a name that is not certain, or a place
    that the readings cannot distinguish from others (a jump of ``frame|tool``). Predictions are
    then those of the average, whose error is not above that of the worst of them.
    """
    return bool(effect.hint) or effect.status == "ambiguous" or bool(effect.equivalent)


def _found(
    item: Added, after: Fit, state: State, classes: Sequence[Shapes], room: int, odds: float
) -> FoundEffect:
    """The report of an added effect, with its parameters from the final fit. `odds` are the prior
    odds of all kinds that were tried.
    """
    effect, weighed = item.effect, item.weighed
    place = place_of(item, after.model.effects)
    stepped = jump_time_uncertainty(state, place, room)
    shapes = next((one for one in classes if one.effect.alike(effect)), None)
    if shapes is not None:
        stepped |= shapes.uncertainties
    certain = weighed.probability >= CERTAIN
    same = [k for k in weighed.equivalent if k.split(" ")[0] == effect.name]
    places = sorted({effect.placement, *(k.partition(" ")[2] for k in same)})
    return FoundEffect(
        effect=effect,
        status="named" if certain else "ambiguous",
        placement="|".join(places),
        parameters=[
            *(
                (p.name, value, p.unit, stepped[p.name] / p.si if p.name in stepped else u)
                for _, p, value, u in after.values_of(place)
            ),
            *_reference(after, place),
        ],
        p_value=item.p_value,
        probability=weighed.probability,
        chance=chance(weighed.log_odds, odds),
        log_evidence=weighed.best.log_bayes,
        delta_bic=weighed.best.delta_bic,
        heldout_gain=item.gain,
        equivalent=weighed.equivalent,
        alternatives=weighed.alternatives,
        separation="" if certain else _separation(weighed, after.measurement.plan.axes),
        shapes=() if shapes is None else tuple(in_units(effect.shapes, v) for v in shapes.values),
        alike=weighed.alike,
    )


def _reference(fit: Fit, place: int) -> list[tuple[str, float, str, float]]:
    """How far the reference value of an effect is from the declared one, as a parameter, where the
    readings determine it.
    """
    effect = fit.model.effects[place]
    inner = effect.effect if isinstance(effect, OfDataSet) else effect
    if not isinstance(inner, FreeReference):
        return []
    mine = fit.places_of(place)[0]
    step = np.array([p.step for p in effect.amplitudes])
    mean = np.array([p.mean * p.si for p in effect.amplitudes])
    covariance = fit.covariance[np.ix_(mine, mine)] * np.outer(step, step)
    zero = inner.zero(mean + fit.theta[mine] * step, covariance)
    if zero is None:
        return []
    unit = inner.reference.unit
    value, u = (v / si_factor(unit) for v in zero)
    return [("zero_shift", value, unit, u)]


def _finish(
    run: Search,
    model: Model,
    before: Fit,
    state: State,
    classes: Sequence[Shapes],
    settings: dict,
    interrupted: bool,
    stopped: str,
    sizes: Misdeclared | None,
) -> Closure:
    """The result of a search: the final fit with the estimated noise, and the errors of the
    declared `model` before and of the identified one after it.

    `stopped` says which equations without a solution ended the search.
    """
    nominal = _nominal(model, state, run.room)
    noise, scales = reported_noise_scales(state)
    after = at_noise_found(state, run.room)
    odds = odds_of_kinds(run.screenings[0]) if run.screenings else 1.0
    found = [_found(item, after, state, classes, run.room, odds) for item in run.added(state)]
    found = [doubted(effect, state.fit, run.unexplained, run.untestable) for effect in found]
    found = [hinted(effect, state.fit, run.unexplained) for effect in found]
    alternatives = [
        replace(_alternatives(item.weighed, classes), averaged=_undecided(effect))
        for item, effect in zip(run.added(state), found, strict=True)
    ]
    alternatives += [one.alternatives for one in classes]
    described = run.unexplained.empirical if run.unexplained is not None else None
    if described is not None:
        alternatives.append(Alternatives(state.scored, ((1.0, described.fit),)))
    verdict: Verdict | None = None if interrupted else "nothing_missing"
    likely = [item for item in found if not item.perhaps_chance]
    if run.unexplained is not None:
        verdict = "unexplained"
    elif any(item.status == "ambiguous" for item in likely or found):
        verdict = "ambiguous"
    elif found:
        verdict = "named"
    wrong: dict[Literal["uncompensated", "before", "after"], Errors] = {
        "uncompensated": errors(nominal, run.check),
        "before": errors(before, run.check),
        "after": errors(after, run.check, alternatives),
    }
    compensated = any(e.where == "machine" and e.kind == "systematic" for e in after.model.effects)
    fall = heldout_fall(nominal, after, alternatives) if compensated else None
    useless = no_gain(wrong, fall) if compensated else ""
    swings = vibration(state.fit)
    return Closure(
        verdict=verdict,
        effects=found,
        errors=wrong,
        before=before,
        after=after,
        nominal=nominal,
        alternatives=alternatives,
        check=run.check,
        unexplained=run.unexplained,
        vibration=swings,
        suspected=state.outliers,
        rejected=still_rejected(run.rejected, found),
        untestable=run.untestable,
        unseen=[
            name
            for first in run.screenings[:1]
            for name in (
                *(e.key for e in first.unseen),
                *_unseen_pitches(first, after.measurement.plan),
            )
        ],
        screenings=run.screenings,
        noise_scale=noise,
        noise_components=() if state.noise is None else state.noise.parts,
        noise_scales=scales,
        noise_uneven=state.noise is not None and state.noise.uneven,
        settings=settings,
        interrupted=interrupted,
        sizes=sizes,
        no_gain=useless,
        notes=notes(
            Facts(
                before=before,
                after=after,
                errors=wrong,
                check=run.check,
                found=found,
                added=run.added(state),
                state=state,
                scales=scales,
                unexplained=run.unexplained,
                untestable=run.untestable,
                vibration=swings,
                interrupted=interrupted,
                stopped=stopped,
                sizes=sizes,
                no_gain=useless,
                room=run.room,
            )
        ),
    )


def _unseen_pitches(screening: Screening, plan: Plan) -> Iterable[str]:
    """Pitches that positions in equal steps do not show, with the effect that has them."""
    for kind in screening.kinds:
        effects = {id(p.effect): p.effect for p in kind.peaks if isinstance(p.effect, ScrewCyclic)}
        for effect in effects.values():
            found = effect.aliases(plan)
            if found is not None and found.unseen:
                (p,) = effect.shapes
                pitches = [pitch / p.si for pitch in found.unseen]
                yield f"{effect.key} with a pitch of {some_values(pitches, p.unit)}"


def still_rejected(rejected: Iterable[Rejected], found: Iterable[FoundEffect]) -> list[Rejected]:
    """Rejected effects without those that a later round added."""
    added = {(item.effect.name, item.effect.placement) for item in found}
    return [r for r in rejected if (r.effect, r.placement) not in added]


def _separation(weighed: Weighed, axes: tuple[str, ...]) -> str:
    """The measurement that would distinguish the best from its most probable rivals, in words.

    It names the columns of the data file that one of them depends on and the others do not.
    """
    rivals, own = weighed.alternatives[:2], weighed.best.effect
    effects = {(r.effect.name, r.effect.placement): r.effect for _, r in weighed.instead[::-1]}
    others = [effects[key] for name, place, _ in rivals if (key := (name, place)) in effects]

    def columns(names: Iterable[str]) -> str:
        return " and ".join(dict.fromkeys(file_column(name, axes)[0] for name in names))

    follows = own.indicators
    theirs = [name for other in others for name in other.indicators]
    if rivals and rivals[0][0] in {kind.name for kind in EMPIRICAL}:
        # A description depends on the same covariate, and differs between the measured positions
        # and times.
        return (
            f"measure at further values of {columns(follows) or 'its own covariate'}, between and "
            "beyond those measured"
        )
    if alone := [name for name in follows if name not in theirs]:
        beside = columns(name for name in theirs if name not in alone)
        return f"vary {columns(alone)} independently of {beside or 'the rest'}"
    if alone := [name for name in theirs if name not in follows]:
        return f"vary {columns(alone)} independently of {columns(follows)}"
    names = " and ".join(f"{name} {place}".strip() for name, place, _ in rivals)
    further = "moments and positions" if {*CLOCKS} & {*follows} else "positions"
    return (
        f"it depends on {columns(follows) or 'the same'}, and so does {names}: measure at further "
        f"{further}, where their errors differ"
    )


def _alternatives(weighed: Weighed, classes: Sequence[Shapes]) -> Alternatives:
    """What an effect may be instead; other shapes of it only where they form no class."""
    best = weighed.best
    classed = any(one.effect.alike(best.effect) for one in classes)
    others = (
        (p, rival.fit)
        for p, rival in weighed.instead
        if not (classed and rival.effect.alike(best.effect))
    )
    return Alternatives(best.fit, tuple(others))


def _nominal(model: Model, state: State, room: int) -> Fit:
    """The nominal machine without errors, from the readings that the final fit uses."""
    nuisances = tuple(e for e in model.effects if e.kind == "nuisance" or e.where == "instrument")
    bare = Model(model.chain, model.instrument, (*nuisances, *model.random))
    measurement, keep = state.fit.measurement, state.keep
    begun = initial_shapes(bare, measurement, keep, room)
    return identify(bare, measurement, shapes=begun, keep=keep, room=room)


def errors(
    fit: Fit, check: CheckPoints | None, alternatives: Sequence[Alternatives] = ()
) -> Errors:
    """Errors of a fitted model on all data. The alternatives to its effects are part of the
    uncertainty at the check points, and of the prediction where it is that of their average.
    """
    aligned, raw = (None, None) if check is None else check_rms(fit, check, alternatives)
    heldout = heldout_rms(fit, alternatives=alternatives)
    return Errors(aligned, raw, heldout, fit_rms(fit), chi2_per_dof(fit), _by_set(fit))


def _by_set(fit: Fit) -> dict[str, SetErrors]:
    """Errors by data set, where there are several. The degrees of freedom of a data set are its
    readings less its part of tr(J H^-1 J').
    """
    plan = fit.measurement.plan
    if not plan.sets:
        return {}
    squares = (normalised_residuals(fit) ** 2).sum(1)
    found = {}
    for name, inside in plan.parts.items():
        _, dof = fit.chi2_and_dof(inside)
        ratio = float(squares[inside & fit.used].sum() / dof) if dof > 0.0 else math.nan
        found[name] = SetErrors(heldout_rms(fit, inside), fit_rms(fit, inside), ratio)
    return found
