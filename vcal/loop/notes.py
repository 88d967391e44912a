"""Notes on a result: what a user should know besides its numbers, what it means, and remedies."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import fdtrc

from ..effects.base import Effect
from ..identification.fit import POORLY_DETERMINED, Fit
from ..identification.identify import identify
from ..identification.predictable import unpredictable_of
from ..instruments.base import averaged_of, remarks_of
from ..instruments.conditions import file_column
from ..machine.plan import Plan
from ..model.declared_noise import declared_whitener
from ..model.forward import Model
from ..model.measurement import CheckPoints, rows_in_words
from ..words import counted, plural
from .outcome.closure import Errors, FoundEffect, in_words
from .outcome.misdeclared import Misdeclared
from .outcome.unexplained import Unexplained
from .residuals.confounded import confounded, unrecorded_time
from .residuals.implausible import implausible
from .residuals.outliers import at_an_end, too_many
from .residuals.times import backwards
from .residuals.vibration import Vibration
from .screening.candidates import Untestable
from .screening.significance import LEAST_NOISE
from .screening.unconverted import not_shown
from .search.forward_selection import Added
from .search.state import State, chi2_per_dof
from .weighing.cross_validation import Rms, check_rms, fit_rms, held_apart, predicted_rms
from .weighing.rivals import Rival

_NO_MACHINE_UM = 2000.0
"""Size of the residual, um, beyond which the data are not what they are declared to be."""
_ALIGNED = 0.1
"""Largest ratio of the error after rigid alignment to that before, where a common offset is wrong.
"""
_MANY = 50.0
"""Degrees of freedom below which a search finds only large effects."""
_BEYOND = 0.1
"""Share of the measured range beyond which a point is outside it, and least share of such check
points that is reported."""
_NOT_EXPECTED = 10.0
"""Multiple of its prior standard deviation beyond which the size of an effect is not expected."""
_SURELY, _FURTHER = 3.0, 1.5
"""Standard uncertainties, and multiple of the predicted error, by which the error at the check
points significantly exceeds it."""
_MOST_SHAPES = 30
"""Most shapes that a note lists."""
_FEW_POINTS = 10
"""Number of check points below which the alignment removes a relevant part of the error."""


@dataclass(frozen=True)
class Facts:
    """The results that the notes are made from."""

    before: Fit
    after: Fit
    errors: Mapping[Literal["uncompensated", "before", "after"], Errors]
    """Of the nominal machine, before and after closing the loop."""
    check: CheckPoints | None
    found: Sequence[FoundEffect]
    added: Sequence[Added]
    """`found` as the search has them."""
    state: State
    scales: Mapping[str, float]
    """Estimated noise of every data set, in units of the declared noise."""
    unexplained: Unexplained | None
    untestable: Sequence[Untestable]
    vibration: Vibration | None
    interrupted: bool
    stopped: str
    """What ended the search early, where equations had no solution."""
    sizes: Misdeclared | None
    """Declared sizes that do not fit."""
    no_gain: str
    """Sentence where compensation does not reduce the error."""
    room: int

    @property
    def plan(self) -> Plan:
        """Of all the data."""
        return self.after.measurement.plan

    @property
    def described(self) -> Rival | None:
        """The empirical description of what is unexplained."""
        return self.unexplained.empirical if self.unexplained is not None else None


def notes(facts: Facts) -> list[str]:
    """All notes, the most important first."""
    return [note for about in _NOTES for note in about(facts)]


def _stopped(facts: Facts) -> list[str]:
    """Note where equations without a solution ended the search."""
    if not facts.stopped:
        return []
    return [
        f"the search ended early, as the equations of one of its steps have no solution "
        f"({facts.stopped}); what was found by then holds"
    ]


def _sizes(facts: Facts) -> list[str]:
    """Note on declared sizes that do not fit."""
    sizes = facts.sizes
    if sizes is None:
        return []
    test = sizes.test
    chance = "" if test.gross else f" (p = {test.p_value:.1g} by chance)"
    do = (
        "compare the numbers of the machine, and the signs, units and order of the columns, with "
        "the machine"
        if test.gross
        else "declare the sizes that the errors have"
    )
    used = "; the search and the result use the sizes that fit" if sizes.used else ""
    return [f"the declared sizes do not fit: {sizes.words}{chance}{used}; {do}"]


def _held_out(facts: Facts) -> list[str]:
    """Note on held-out rows that the fitted rows do not predict, or did not."""
    fit, said = facts.after, []
    chosen = fit.measurement.holdout
    if chosen is not None and chosen.caution:
        said.append(chosen.caution)
    folds, apart = held_apart(fit.model, fit.measurement)
    if apart.any() or chosen is not None:
        why = unpredictable_of(fit, folds, apart)
        if why is not None:
            marked = None if chosen is None else chosen.unpredicted
            left_out = marked is not None and marked[why.rows].all()
            said.append(
                f"{why.words(facts.plan)}: "
                + (
                    "the held-out error leaves them out"
                    if left_out
                    else f"the held-out error of {_um(facts.errors['after'].heldout)} is not "
                    "evidence for or against the result"
                )
                + "; hold out others ([holdout]), such as a random share, or measure poses of "
                "their kind among the fitted ones"
            )
    return said


def _inconsistent_data_sets(facts: Facts) -> list[str]:
    """Note where the data sets are inconsistent."""
    if facts.interrupted:
        return []
    apart = data_set_consistency(facts.before, facts.after, facts.room)
    return [apart] if apart else []


def _elsewhere(facts: Facts) -> list[str]:
    """Note where a common offset of the check points is larger than any machine error: another
    frame, or another tool.
    """
    after = facts.errors["after"]
    if after.check is None or after.check_raw is None:
        return []
    raw, aligned = after.check_raw.value, after.check.value
    if raw < _NO_MACHINE_UM or aligned > _ALIGNED * raw:
        return []
    return [
        f"the check points have a common offset of {raw / 1e3:.3g} mm, larger than any machine "
        "error: their tool offset or their frame differs from that of the data; use the error "
        "after alignment, which excludes the offset, or give the check points in the frame of "
        "the data"
    ]


def _few_check_points(facts: Facts) -> list[str]:
    """Note where few check points make the rigid alignment, with six parameters, absorb a part of
    the error.
    """
    count = 0 if facts.check is None else facts.check.plan.rows
    if not 0 < count < _FEW_POINTS:
        return []
    return [
        f"there {plural(count, 'is', 'are')} only {counted(count, 'check point')}, and the rigid "
        f"alignment is fitted with six parameters to their {3 * count} coordinates: the error "
        "elsewhere is larger than theirs after alignment; measure more check points"
    ]


def _not_at_the_check(facts: Facts) -> list[str]:
    """Note on effects that the error at the check points leaves out because a column is missing
    there.
    """
    check = facts.check
    if check is None:
        return []
    lacking = {
        effect.key: [name for name in effect.needs if not check.plan.has(name)]
        for effect in facts.after.model.effects
        if effect.where == "machine" and effect.kind != "nuisance"
    }
    axes = facts.plan.axes
    return [
        f"{key} is not included in the error at the check points, which have no "
        f"{' and no '.join(file_column(name, axes)[0] for name in missing)}: this error is that of "
        "the machine without the effect; record these columns with the check points"
        for key, missing in lacking.items()
        if missing
    ]


def _beyond_at_the_check(facts: Facts) -> list[str]:
    """Note on effects whose prediction at the check points extrapolates times, temperatures or
    other conditions beyond the measured range.
    """
    check = facts.check
    if check is None:
        return []
    plan, said = facts.plan, []
    for item in facts.found:
        for name in item.effect.needs if item.effect.where == "machine" else ():
            if name in plan.axes or not (plan.has(name) and check.plan.has(name)):
                continue
            column, unit = file_column(name, plan.axes)
            known, asked = (unit * np.asarray(p.values(name), float) for p in (plan, check.plan))
            low, high = np.nanmin(known), np.nanmax(known)
            room = _BEYOND * (high - low)
            share = float(((asked < low - room) | (asked > high + room)).mean())
            if share > _BEYOND:
                said.append(
                    f"{item.effect.key} is extrapolated at {100 * share:.2g} % of the check "
                    f"points, beyond the measured range ({column} {low:.4g} to {high:.4g}, at the "
                    f"check points {asked.min():.4g} to {asked.max():.4g}): the uncertainty does "
                    "not include the error of the extrapolation; measure over the whole range"
                )
    return said


def _gain(facts: Facts) -> list[str]:
    """Note where compensation does not reduce the error."""
    return [facts.no_gain.rstrip(".")] if facts.no_gain else []


def _worse(facts: Facts) -> list[str]:
    """Note where held-out readings or check points contradict what was found."""
    before, after = facts.errors["before"], facts.errors["after"]
    what = "the effects found describe" if facts.found else "the estimated noise suits"
    compared = (
        ("held-out readings are predicted worse", before.heldout, after.heldout),
        ("the error at the check points is larger", before.check, after.check),
    )
    return [
        f"{said} after closing the loop ({_um(new)}) than before ({_um(old)}): {what} only the "
        "readings that were fitted; do not rely on the result without a further measurement"
        for said, old, new in compared
        if old is not None and new is not None and new.value - old.value > math.hypot(old.u, new.u)
    ]


def _beyond_prediction(facts: Facts) -> list[str]:
    """Note where the error at the check points significantly exceeds its prediction by the
    posterior.
    """
    check, after = facts.check, facts.errors["after"].check
    if check is None or after is None or facts.unexplained is not None:
        return []
    predicted = predicted_rms(facts.after, check)
    if after.value - _SURELY * after.u <= _FURTHER * predicted:
        return []
    return [
        f"the error at the check points is {_um(after)}, larger than the {predicted:.3g} µm "
        "predicted from the declared and identified errors: the readings do not show all errors of "
        "the machine or the instrument, or the declared family is too narrow; measure with another "
        "instrument or from another place, or declare a wider family"
    ]


def _described_at_the_check(facts: Facts) -> list[str]:
    """Note on the error at the check points with the description of what is unexplained, where that
    makes up most of its uncertainty.
    """
    described, check, after = facts.described, facts.check, facts.errors["after"]
    if described is None or check is None or after.check is None:
        return []
    value = check_rms(described.fit, check)[0].value
    apart = abs(value - after.check.value)
    if not apart > math.sqrt(0.5) * after.check.u:
        return []
    return [
        f"the error at the check points is {_um(after.check)}; with the empirical description of "
        f"what is unexplained ({in_words(described.effect)}) it would be {value:.3g} µm, which is "
        "most of its uncertainty: find the cause of what is unexplained first"
    ]


def _poorly_determined(facts: Facts) -> list[str]:
    """Note on parameters of the found effects whose uncertainty is that of the prior, such as an
    acceleration in a direction in which nothing moved.
    """
    shares = zip(facts.after.entries, facts.after.information, strict=True)
    hardly = [(key, p.name) for (key, p), share in shares if share < POORLY_DETERMINED]
    return [
        f"{key}: the readings poorly determine {', '.join(names)}; the values and uncertainties "
        "given are those of the prior; measure where the effect would be larger"
        for key in dict.fromkeys(item.effect.key for item in facts.found)
        if (names := [name for its, name in hardly if its == key])
    ]


def _beyond_prior(facts: Facts) -> list[str]:
    """Note on effects whose size is many times that which their declared prior, or that of the
    catalogue, expects. The search widens the priors of large effects.
    """
    expected = {
        effect.key: {p.name: p for p in effect.amplitudes} for effect in facts.before.model.effects
    }
    for item in facts.found:
        expected[item.effect.key] = {p.name: p for p in item.effect.parameters if not p.shape}
    said = []
    for place, effect in enumerate(facts.after.model.effects):
        if effect.kind != "systematic":
            continue
        sizes = [
            (abs(value - p.mean) / p.sigma, p, value)
            for _, its, value, _ in facts.after.values_of(place)
            if (p := expected.get(effect.key, {}).get(its.name)) and p.informed and p.sigma > 0.0
        ]
        if not sizes:
            continue
        ratio, p, value = max(sizes, key=lambda size: size[0])
        if ratio < _NOT_EXPECTED:
            continue
        about = f"{p.mean:g} ± " if p.mean else ""
        said.append(
            f"{effect.key}: {p.label} = {value:.4g} is {ratio:.0f} times the expected size of "
            f"{about}{p.sigma:.3g} {p.unit} (standard deviation of its prior): compare the units "
            "and scale factors of the data and of the study file with the measurement first; if "
            "they are right and the machine is like that, declare a prior of this size"
        )
    return said


def _noise(facts: Facts) -> list[str]:
    """Note where the readings scatter differently from what is declared."""
    noise = facts.state.noise
    if noise is not None and noise.uneven:
        each = ", ".join(
            f"{part.name} {part.factor:.2f}" for part in noise.parts if part.u == part.u
        )
        return [
            "the kinds of reading differ in the ratio of their noise to the declared noise: "
            f"{each}; tests and uncertainties use these ratios, uncertainties at least the "
            "declared noise; check the declared noise"
        ]
    return [
        f"the readings{f' of {name}' if name else ''} scatter "
        f"{'at most ' if noise <= LEAST_NOISE else ''}{max(noise, LEAST_NOISE):.2f} times as "
        "much as declared; uncertainties "
        + (
            "are scaled accordingly; check the declared noise"
            if noise > 1
            else "stay as declared, and the priors have more weight than with the estimated noise; "
            "declare a smaller noise if that is plausible"
        )
        for name, noise in facts.scales.items()
        if noise != 1.0
    ]


def _little_left(facts: Facts) -> list[str]:
    """Note where there are hardly more readings than parameters."""
    dof = facts.state.fit.dof
    if dof >= _MANY:
        return []
    return [
        f"only {dof:.0f} degrees of freedom are left beside the declared model, so that only large "
        "effects can be detected; measure more points, or declare fewer parameters"
    ]


def _blank(facts: Facts) -> list[str]:
    """Note on rows that are left out because a reading is blank."""
    return [
        f"left out: {rows_in_words(rows)} of {file}, as a reading is blank"
        for file, rows in facts.after.measurement.blank.items()
    ]


def _times(facts: Facts) -> list[str]:
    """Note on times that run backwards."""
    return backwards(facts.plan)


def _implausible(facts: Facts) -> list[str]:
    """Notes on numbers of the input that hardly any machine or instrument has."""
    model, measurement = facts.after.model, facts.after.measurement
    return implausible(model.chain, facts.plan, model.instrument, measurement.readings)


def _outliers(facts: Facts) -> list[str]:
    """Notes on outliers: more than may be left out, and those that may be a displacement."""
    plan, fit, said = facts.plan, facts.state.fit, []
    if found := too_many(fit):
        rows = ", ".join(plan.row_name(s.row) for s in sorted(found, key=lambda s: -s.distance)[:5])
        said.append(
            f"{len(found)} rows of {fit.used.sum()} are outliers at random places, more than may "
            f"be left out; check these readings first ({rows}, ...), and remove or repeat them"
        )
    said += [
        f"row {plan.row_name(row)}, left out as an outlier, is {where}: a displacement at that "
        "moment would look the same; more readings there would distinguish the two"
        for row, where in at_an_end(fit, [s.row for s in facts.state.outliers]).items()
    ]
    return said


def _other_shapes(facts: Facts) -> list[str]:
    """Note on other pitches and moments of the found effects."""
    classed = {one.effect.key for one in facts.found if one.shapes}
    return [
        *(_class_of_shapes(one) for one in facts.found if one.shapes),
        *(
            f"{item.effect.key}: {_shape_text(item.effect, shape)} fits nearly as well "
            f"(probability {100 * probability:.2g} %): these positions and times hardly "
            "distinguish them; measure at further ones"
            for item in facts.added
            for shape, probability in item.weighed.other_shapes
            if item.effect.key not in classed
        ),
    ]


def _class_of_shapes(found: FoundEffect) -> str:
    """Note on the shapes of an effect that the readings cannot distinguish."""
    said = []
    for p in found.effect.shapes:
        values = sorted({round(shape[p.name], 12) for shape in found.shapes})
        listed = ", ".join(f"{v:.4g}" for v in values[:_MOST_SHAPES])
        more = f" and {len(values) - _MOST_SHAPES} more" if len(values) > _MOST_SHAPES else ""
        said.append(f"a {p.name} of {listed}{more} {p.unit}")
    return (
        f"{found.effect.key}: {' and '.join(said)} gives the same readings; what these have in "
        "common is compensated, which is little between the measured positions; to distinguish "
        "them, measure at positions that are no multiples of one step"
    )


def _confounding(facts: Facts) -> list[str]:
    """Notes on covariates that are confounded with what an effect depends on, and on a time that
    was not recorded.
    """
    names = [name for item in facts.added for name in item.effect.indicators]
    first = facts.unexplained.depends_on[:1] if facts.unexplained is not None else []
    return [
        *confounded(facts.plan, [*names, *first]),
        *(note for name in first for note in unrecorded_time(facts.plan, name, facts.untestable)),
    ]


def _remarks(facts: Facts) -> list[str]:
    """Notes on samples that were averaged, and on settings of the instruments that the readings
    contradict.
    """
    instrument = facts.after.model.instrument
    return [*averaged_of(instrument), *remarks_of(instrument)]


def _no_machine(facts: Facts) -> list[str]:
    """Note where the residual is larger than any machine error."""
    worst = fit_rms(facts.state.fit).value
    if worst <= _NO_MACHINE_UM or chi2_per_dof(facts.state.fit) <= 1e4:
        return []
    return [
        f"the residual is {worst / 1e3:.3g} mm, larger than any machine error: compare the "
        "columns, signs and units of the first rows with what was measured"
    ]


def _column_units(facts: Facts) -> list[str]:
    """Note on own effects that depend on a column in the unit of the file."""
    fit = facts.after
    return [
        f"{effect.key}: {column.words}; otherwise its value is wrong by this factor"
        for place, effect in enumerate(fit.model.effects)
        for column in not_shown(effect, facts.plan, fit.shapes.get(place, {}))
    ]


def _unconverged(facts: Facts) -> list[str]:
    if facts.state.fit.converged:
        return []
    return [
        "the final fit did not converge, and its numbers are unreliable: declare fewer free "
        "parameters, or measure more points"
    ]


def _vibrating(facts: Facts) -> list[str]:
    """Note on a vibration, where the verdict does not mention it."""
    if facts.vibration is None or facts.unexplained is not None:
        return []
    return [facts.vibration.words]


def _um(it: Rms) -> str:
    return f"{it.value:.3g} ± {float(f'{it.u:.1g}'):g} µm"


def _shape_text(effect: Effect, shape: Mapping[str, float]) -> str:
    return ", ".join(
        f"{p.name} {shape[p.name] / p.si:.4g} {p.unit}" for p in effect.shapes if p.name in shape
    )


_NOTES = (
    _stopped,
    _remarks,
    _gain,
    _sizes,
    _held_out,
    _inconsistent_data_sets,
    _elsewhere,
    _few_check_points,
    _not_at_the_check,
    _beyond_at_the_check,
    _worse,
    _beyond_prediction,
    _described_at_the_check,
    _poorly_determined,
    _beyond_prior,
    _noise,
    _little_left,
    _blank,
    _times,
    _implausible,
    _outliers,
    _other_shapes,
    _confounding,
    _no_machine,
    _column_units,
    _unconverged,
    _vibrating,
)


_FACTOR = 2.0
"""Ratio of chi-square per degree of freedom of all data sets together to that of each alone, from
which they are inconsistent. An effect that is missing from all of them shows in each."""
_CHANCE = 1e-3
"""Probability by chance of the chi-square that is added by fitting them together."""


def data_set_consistency(before: Fit, after: Fit, room: int) -> str:
    """Sentence where the data sets do not fit one machine; empty where they do, or there is only
    one.

    The chi-square X that remains when the declared model is fitted to each data set `alone` is
    compared with that of the common fit, before or after the search: (dX / dn) / (X / n) has the F
    distribution with dn and n degrees of freedom where one machine produced all of them.
    """
    parts = before.measurement.plan.parts
    if len(parts) < 2:
        return ""
    each = {name: alone(before, rows, room) for name, rows in parts.items()}
    if any(fit.dof <= 1.0 for fit in each.values()):
        return ""
    own = {name: chi2_per_dof(fit) for name, fit in each.items()}
    # The effects found may be what makes the data sets consistent, or what makes them less so.
    together, fit = min(((chi2_per_dof(f), f) for f in (before, after)), key=lambda pair: pair[0])
    n = sum(one.dof for one in each.values())
    squares = sum(own[name] * one.dof for name, one in each.items())
    dn, dx = fit.dof - n, together * fit.dof - squares
    if together < _FACTOR * max(own.values()) or dn <= 0.0:
        return ""
    if fdtrc(dn, n, (dx / dn) / (squares / n)) > _CHANCE:
        return ""
    said = " and ".join(f"{name} {value:.3g}" for name, value in own.items())
    return (
        f"the data sets do not fit one machine: chi² per degree of freedom is {together:.3g} where "
        f"they are fitted together, but {said} where each is fitted alone with the declared model; "
        "check that they are of one machine with the same tool, units and mounting, or evaluate "
        "each alone"
    )


def alone(fit: Fit, rows: np.ndarray, room: int) -> Fit:
    """The model of a fit, identified from one data set, without effects that act in others only."""
    model, plan = fit.model, fit.measurement.plan
    places = [i for i, e in enumerate(model.effects) if (np.asarray(e.rows(plan)) & rows).any()]
    mine = tuple(model.effects[i] for i in places)
    return identify(
        Model(model.chain, model.instrument, (*mine, *model.random)),
        fit.measurement,
        shapes={k: fit.shapes[i] for k, i in enumerate(places) if i in fit.shapes},
        whitener=declared_whitener(model, fit.measurement),
        keep=fit.used & rows,
        room=room,
    )
