"""Close the loop: find what a measurement says is missing, name it, add it, report the gain."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from ..effects.base import Effect
from ..effects.registry import CATALOGUE
from ..fit import HARDLY_TOLD, Fit
from ..identify import identify
from ..instruments.conditions import file_column
from ..learn import learned_sizes, with_sizes
from ..measurement import CheckPoints, Measurement
from ..model import Model
from .adding import Added
from .begin import shapes_begun
from .certainty import doubted
from .chance import LEAST_NOISE
from .closure import Closure, Errors, FoundEffect, Rejected, SetErrors, Verdict
from .confounded import confounded, unrecorded_time
from .doubt import Doubt
from .empirical import EMPIRICAL
from .heldout import Rms, check_rms, fit_rms, heldout_rms
from .loop_settings import checked, classes_of
from .rivals import CERTAIN, Rival, Weighed
from .search import Search, place_of
from .state import (
    State,
    at_noise_found,
    chi2_per_dof,
    fitted,
    scales_told,
)
from .steps import uncertainties
from .stray import at_an_end, too_many
from .together import contradiction
from .unexplained import from_structure
from .vibration import vibration
from .whitened import declared_residual

_NO_MACHINE_UM = 2000.0
"""What remains of a fit beyond which the data are not what they are said to be, um."""
_ALIGNED = 0.1
"""Share of that which may be left after a rigid alignment, where it is one place that is wrong."""
_MANY = 50.0
"""Degrees of freedom from which a search is worth its name."""
_BEYOND = 0.1
"""Share of the span that was measured, and of the check points, from which on these are beyond."""
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
    effects: Iterable[type[Effect] | str] | None = None,
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
    `alpha` (of the whole search). `effects` restricts the search to some classes, or names of the
    catalogue; `check` adds the error at independent points; `learn` learns the
    sizes of the declared families (`vcal.learn`) for the final fit, after the search.
    `KeyboardInterrupt` ends the search with what is known so far; before the declared model is
    fitted nothing is, and it passes on. Raises
    `RuntimeError` in float32, and `ValueError` for settings out of their bounds (`LoopSettings`).
    """
    checked(alpha=alpha, draws=draws, seed=seed, max_effects=max_effects, learn=learn)
    classes = classes_of(CATALOGUE.values() if effects is None else effects)
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
    state = fitted(model, measurement, None, room)
    before = state.fit
    run = Search(check, classes, alpha, draws, seed, room, progress)
    interrupted = False

    def reached(found: State) -> None:
        nonlocal state
        state = found

    try:
        state = run.rounds(state, max_effects, reached)
        if run.described_by_noise(state):
            run.unexplained = None
        if run.unexplained is None:
            full = len(run.added(state)) >= max_effects
            state, correlated = run.prune_correlated(run.prune(state, reached), reached)
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
            )
    except KeyboardInterrupt:
        interrupted = True
    try:
        progress("comparing before and after")
        return _finish(run, model, before, state, settings, interrupted)
    except KeyboardInterrupt:  # what was found is known, and the comparison takes a moment only
        return _finish(run, model, before, state, settings, interrupted)


def _found(item: Added, after: Fit, state: State, room: int) -> FoundEffect:
    """The report of an added effect, with its parameters from the final fit."""
    effect, weighed = item.effect, item.weighed
    place = place_of(item, after.model.effects)
    stepped = uncertainties(state, place, room)
    certain = weighed.probability >= CERTAIN
    same = [k for k in weighed.equivalent if k.split(" ")[0] == effect.name]
    places = sorted({effect.placement, *(k.partition(" ")[2] for k in same)})
    return FoundEffect(
        effect=effect,
        status="named" if certain else "ambiguous",
        placement="|".join(places),
        parameters=[
            (p.name, value, p.unit, stepped[p.name] / p.si if p.name in stepped else u)
            for _, p, value, u in after.values_of(place)
        ],
        p_value=item.p_value,
        log_evidence=weighed.best.log_bayes,
        delta_bic=weighed.best.delta_bic,
        heldout_gain=item.gain,
        equivalent=weighed.equivalent,
        alternatives=weighed.alternatives,
        separation="" if certain else _separation(weighed, after.measurement.plan.axes),
    )


def _finish(
    run: Search, model: Model, before: Fit, state: State, settings: dict, interrupted: bool
) -> Closure:
    """The result of a search: the final fit with the noise found, and the errors on the way from
    the `model` that was declared.
    """
    nominal = _nominal(model, state, run.room)
    noise, scales = scales_told(state)
    after = at_noise_found(state, run.room)
    found = [_found(item, after, state, run.room) for item in run.added(state)]
    found = [doubted(effect, state.fit, run.unexplained, run.untestable) for effect in found]
    doubts = [_doubt(item.weighed) for item in run.added(state)]
    described = run.unexplained.empirical if run.unexplained is not None else None
    if described is not None:
        doubts.append(Doubt(state.scored, ((1.0, described.fit),)))
    verdict: Verdict | None = None if interrupted else "nothing_missing"
    if run.unexplained is not None:
        verdict = "unexplained"
    elif any(item.status == "ambiguous" for item in found):
        verdict = "ambiguous"
    elif found:
        verdict = "named"
    wrong: dict[Literal["uncompensated", "before", "after"], Errors] = {
        "uncompensated": errors(nominal, run.check),
        "before": errors(before, run.check),
        "after": errors(after, run.check, doubts),
    }
    swings = vibration(state.fit)
    apart = "" if interrupted else contradiction(before, after, run.room)
    return Closure(
        verdict=verdict,
        effects=found,
        errors=wrong,
        before=before,
        after=after,
        nominal=nominal,
        doubts=doubts,
        check=run.check,
        unexplained=run.unexplained,
        vibration=swings,
        suspected=state.strays,
        rejected=still_rejected(run.rejected, found),
        untestable=run.untestable,
        unseen=run.unseen,
        screenings=run.screenings,
        noise_scale=noise,
        noise_components=() if state.noise is None else state.noise.parts,
        noise_scales=scales,
        noise_uneven=state.noise is not None and state.noise.uneven,
        settings=settings,
        interrupted=interrupted,
        notes=[
            *([apart] if apart else []),
            *_elsewhere(wrong["after"]),
            *_not_at_the_check(after, run.check),
            *_beyond_at_the_check(found, after, run.check),
            *_worse(wrong["before"], wrong["after"], bool(found)),
            *_described_at_the_check(described, wrong["after"], run.check),
            *_untold(after, dict.fromkeys(item.effect.key for item in found)),
            *_notes(scales, state, run),
            *([swings.words] if swings is not None and run.unexplained is None else []),
        ],
    )


def still_rejected(rejected: Iterable[Rejected], found: Iterable[FoundEffect]) -> list[Rejected]:
    """Without those that a later round added after all."""
    added = {(item.effect.name, item.effect.placement) for item in found}
    return [r for r in rejected if (r.effect, r.placement) not in added]


def _elsewhere(after: Errors) -> list[str]:
    """That the check points as a whole are not where the machine is, where no machine is so wrong:
    of another frame, or of another tool.
    """
    if after.check is None or after.check_raw is None:
        return []
    raw, aligned = after.check_raw.value, after.check.value
    if raw < _NO_MACHINE_UM or aligned > _ALIGNED * raw:
        return []
    return [
        f"the check points as a whole are {raw / 1e3:.3g} mm off: they are of another tool offset, "
        "or in another frame; the error after alignment, which leaves that out, is the one to go by"
    ]


def _not_at_the_check(after: Fit, check: CheckPoints | None) -> list[str]:
    """That the error at the check points leaves out effects for want of a column, where it does."""
    if check is None:
        return []
    lacking = {
        effect.key: [name for name in effect.needs if not check.plan.has(name)]
        for effect in after.model.effects
        if effect.where == "machine" and effect.kind != "nuisance"
    }
    axes = after.measurement.plan.axes
    return [
        f"{key} is not in the error at the check points, which have no "
        f"{' and no '.join(file_column(name, axes)[0] for name in missing)}: it is that of the "
        "machine without it there; record it with the check points"
        for key, missing in lacking.items()
        if missing
    ]


def _beyond_at_the_check(
    found: Iterable[FoundEffect], after: Fit, check: CheckPoints | None
) -> list[str]:
    """Which of the effects found are foretold at the check points for times, temperatures or other
    conditions that were not measured: how they go on there no reading tells.
    """
    if check is None:
        return []
    plan, notes = after.measurement.plan, []
    for item in found:
        for name in item.effect.needs if item.effect.where == "machine" else ():
            if name in plan.axes or not (plan.has(name) and check.plan.has(name)):
                continue
            column, unit = file_column(name, plan.axes)
            known, asked = (unit * np.asarray(p.values(name), float) for p in (plan, check.plan))
            low, high = np.nanmin(known), np.nanmax(known)
            room = _BEYOND * (high - low)
            share = float(((asked < low - room) | (asked > high + room)).mean())
            if share > _BEYOND:
                notes.append(
                    f"{item.effect.key} is foretold for {100 * share:.2g} % of the check points "
                    f"beyond what was measured ({column} {low:.4g} to {high:.4g}, there "
                    f"{asked.min():.4g} to {asked.max():.4g}): whether it goes on as it did is not "
                    "part of the uncertainty"
                )
    return notes


def _worse(before: Errors, after: Errors, found: bool) -> list[str]:
    """That held-out readings or check points speak against what was found, where they do."""
    what = "what was found describes" if found else "the noise that was found suits"
    compared = (
        ("held-out readings are foretold worse", before.heldout, after.heldout),
        ("the error at the check points is larger", before.check, after.check),
    )
    return [
        f"{said} after closing the loop ({_um(new)}) than before ({_um(old)}): {what} the readings "
        "that were fitted, no more, and is not to be relied on"
        for said, old, new in compared
        if old is not None and new is not None and new.value - old.value > math.hypot(old.u, new.u)
    ]


def _described_at_the_check(
    described: Rival | None, after: Errors, check: CheckPoints | None
) -> list[str]:
    """What the error at the check points would be with the description of what is unexplained,
    where that is most of its uncertainty.
    """
    if described is None or check is None or after.check is None:
        return []
    value = check_rms(described.fit, check)[0].value
    apart = abs(value - after.check.value)
    if not apart > math.sqrt(0.5) * after.check.u:
        return []
    summary = described.effect.summary.removeprefix("empirical: ")
    return [
        f"the error at the check points is {_um(after.check)}: with what describes what is "
        f"unexplained ({summary}) it would be {value:.3g} µm, which is most of its uncertainty"
    ]


def _untold(after: Fit, found: Iterable[str]) -> list[str]:
    """Which parameters of the effects that were `found` are as uncertain as before: such as an
    acceleration in a direction in which nothing moved.
    """
    told = zip(after.entries, after.information, strict=True)
    hardly = [(key, p.name) for (key, p), share in told if share < HARDLY_TOLD]
    return [
        f"{key}: the readings say next to nothing of {', '.join(names)}; what is given is what "
        "was known before"
        for key in found
        if (names := [name for its, name in hardly if its == key])
    ]


def _um(it: Rms) -> str:
    return f"{it.value:.3g} ± {float(f'{it.u:.1g}'):g} µm"


def _shape_text(effect: Effect, shape: Mapping[str, float]) -> str:
    return ", ".join(
        f"{p.name} {shape[p.name] / p.si:.4g} {p.unit}" for p in effect.shapes if p.name in shape
    )


def _separation(weighed: Weighed, axes: tuple[str, ...]) -> str:
    """The measurement that would tell the best from its likeliest rivals, in columns of the data
    file: of what some of them follow, that which the others do not.
    """
    rivals, own = weighed.alternatives[:2], weighed.best.effect
    effects = {(r.effect.name, r.effect.placement): r.effect for _, r in weighed.instead[::-1]}
    others = [effects[key] for name, place, _ in rivals if (key := (name, place)) in effects]

    def columns(names: Iterable[str]) -> str:
        return " and ".join(dict.fromkeys(file_column(name, axes)[0] for name in names))

    follows = own.betrayed_by
    theirs = [name for other in others for name in other.betrayed_by]
    if rivals and rivals[0][0] in {kind.name for kind in EMPIRICAL}:
        # A description depends on the same; between the positions and times measured it differs.
        return (
            f"measure at further values of {columns(follows) or 'its own covariate'}, between and "
            "beyond those there are"
        )
    if alone := [name for name in follows if name not in theirs]:
        beside = columns(name for name in theirs if name not in alone)
        return f"vary {columns(alone)} independently of {beside or 'the rest'}"
    if alone := [name for name in theirs if name not in follows]:
        return f"vary {columns(alone)} independently of {columns(follows)}"
    names = " and ".join(f"{name} {place}".strip() for name, place, _ in rivals)
    further = "moments and positions" if "t" in follows else "positions"
    return (
        f"it follows {columns(follows) or 'the same'}, and so does {names}: measure at further "
        f"{further}, where their errors differ"
    )


def _doubt(weighed: Weighed) -> Doubt:
    return Doubt(weighed.best.fit, tuple((p, rival.fit) for p, rival in weighed.instead))


def _nominal(model: Model, state: State, room: int) -> Fit:
    """The machine without any error, from the readings that the final fit uses."""
    nuisances = tuple(e for e in model.effects if e.kind == "nuisance" or e.where == "instrument")
    bare = Model(model.chain, model.instrument, (*nuisances, *model.random))
    measurement, keep = state.fit.measurement, state.keep
    begun = shapes_begun(bare, measurement, keep, room)
    return identify(bare, measurement, shapes=begun, keep=keep, room=room)


def errors(fit: Fit, check: CheckPoints | None, doubts: Sequence[Doubt] = ()) -> Errors:
    """How wrong a fitted model is, on all the data there are; what it may be instead is part of the
    uncertainty at the check points.
    """
    aligned, raw = (None, None) if check is None else check_rms(fit, check, doubts)
    return Errors(aligned, raw, heldout_rms(fit), fit_rms(fit), chi2_per_dof(fit), _by_set(fit))


def _by_set(fit: Fit) -> dict[str, SetErrors]:
    """Errors of every data set, where there are several; the degrees of freedom of one are its
    readings less its own part of tr(J H^-1 J').
    """
    plan = fit.measurement.plan
    if not plan.sets:
        return {}
    squares = (declared_residual(fit) ** 2).sum(1)
    found = {}
    for name, inside in plan.parts.items():
        _, dof = fit.chi2_and_dof(inside)
        ratio = float(squares[inside & fit.used].sum() / dof) if dof > 0.0 else math.nan
        found[name] = SetErrors(heldout_rms(fit, inside), fit_rms(fit, inside), ratio)
    return found


def _notes(scales: Mapping[str, float], state: State, run: Search) -> list[str]:
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
            f"the readings{f' of {name}' if name else ''} scatter "
            f"{'at most ' if noise <= LEAST_NOISE else ''}{max(noise, LEAST_NOISE):.2f} times as "
            "much as declared; uncertainties "
            + (
                "are scaled accordingly"
                if noise > 1
                else "are left as declared, and what was known before counts for more than it "
                "would with the noise that was found"
            )
            for name, noise in scales.items()
            if noise != 1.0
        ]
    if state.fit.dof < _MANY:
        notes.append(
            f"only {state.fit.dof:.0f} degrees of freedom are left beside what is declared: "
            "effects that are not large go unseen"
        )
    plan = state.fit.measurement.plan
    if astray := too_many(state.fit):
        rows = ", ".join(
            plan.row_name(s.row) for s in sorted(astray, key=lambda s: -s.distance)[:5]
        )
        notes.append(
            f"{len(astray)} rows of {state.fit.used.sum()} are too far out for noise, at random "
            f"places: more stray readings than are left out; look at them first ({rows}, ...)"
        )
    notes += [
        f"row {plan.row_name(row)}, left out, is {where}: had something moved there and stayed, "
        "that would look the same; more readings of the same would tell"
        for row, where in at_an_end(state.fit, [s.row for s in state.strays]).items()
    ]
    betraying = [name for item in run.added(state) for name in item.effect.betrayed_by]
    if run.unexplained is not None:
        betraying += run.unexplained.depends_on[:1]
    notes += [
        f"{item.effect.key}: {_shape_text(item.effect, shape)} fits nearly as well (probability "
        f"{100 * probability:.2g} %): these positions and times hardly tell them apart"
        for item in run.added(state)
        for shape, probability in item.weighed.other_shapes
    ]
    notes += confounded(plan, betraying)
    if run.unexplained is not None:
        for name in run.unexplained.depends_on[:1]:
            notes += unrecorded_time(plan, name, run.untestable)
    worst = fit_rms(state.fit).value
    if worst > _NO_MACHINE_UM and chi2_per_dof(state.fit) > 1e4:
        notes.append(
            f"what remains is {worst / 1e3:.3g} mm, which no machine is off by: compare the "
            "columns, signs and units of the first rows with what was measured"
        )
    if not state.fit.converged:
        notes.append("the final fit did not converge: its numbers are not to be relied on")
    return notes
