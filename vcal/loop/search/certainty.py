"""Reasons why a name stays uncertain, however probable it is among the candidates tried."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.special import expit

from ...effects.data_set import OfDataSet
from ...effects.geometric import GeometricErrors
from ...effects.reference import with_known_reference
from ...geometry.compensated import machine_terms
from ...identification.fit import POORLY_DETERMINED, Fit, declared_chi2
from ...instruments.conditions import file_column
from ...words import some_values
from ..empirical.base import Empirical
from ..outcome.closure import LIKELY, FoundEffect
from ..outcome.unexplained import Unexplained
from ..screening.candidates import Untestable
from ..screening.score_test import ScoreTest
from ..screening.screening import Screening
from ..weighing.rivals import impossible_sizes
from ..weighing.weighing import CERTAIN
from .state import State, without

_COVERAGE = 2.0
"""Expanded uncertainty in standard uncertainties that a found effect exceeds."""
_EXCLUDED = 9.0
"""Chi-square, in units of the noise, by which an effect must fit worse to be excluded by the
readings alone."""
_OUT = 3.0
"""Standard uncertainties by which a shape parameter would have to leave its grid to count as
outside."""


def doubted(
    found: FoundEffect, fit: Fit, rest: Unexplained | None, untestable: Iterable[Untestable]
) -> FoundEffect:
    """The effect as found in a fit, or the same as ambiguous where something makes its name
    uncertain.

    Such reasons are a larger unexplained residual that depends on the same covariate, a shape
    parameter outside its grid, an effect that could not be tested, an amplitude that is poorly
    determined, a size that is physically impossible, an effect no larger than what the model
    neglects of a far larger one, a wave that the positions do not resolve, and the probability that
    nothing more is missing.
    """
    if found.status != "named":
        return found
    place = next(i for i, e in enumerate(fit.model.effects) if e.alike(found.effect))
    why = (
        part_of_unexplained(fit, place, rest)
        or beyond_scan(fit, place)
        or untested_twin(fit, place, untestable)
        or poorly_determined(fit, place)
        or impossible_size(fit, place)
        or second_order(fit, place)
        or shapes_not_excluded(found, fit)
        or by_chance(found)
    )
    return replace(found, status="ambiguous", separation=why) if why else found


def hinted(found: FoundEffect, fit: Fit, rest: Unexplained | None) -> FoundEffect:
    """The effect as found in a fit, or the same as a hint: where it is no more likely than all its
    rivals together, that nothing more is missing among them, no amplitude exceeds its expanded
    uncertainty (k = 2), or it explains less than what is left unexplained.

    What is unexplained counts where it has no description, neither an empirical one nor noise that
    is correlated in time: small effects may then be parts of it.
    """
    place = next(i for i, e in enumerate(fit.model.effects) if e.alike(found.effect))
    amplitudes = {p.name for p in found.effect.amplitudes}
    values = [(abs(value), u) for name, value, _, u in found.parameters if name in amplitudes]
    why = ""
    if found.probability <= LIKELY:
        why = "its rivals together are as likely"
    elif found.perhaps_chance:
        why = f"with a probability of {100.0 * found.chance:.0f} % nothing more is missing"
    elif values and all(value <= _COVERAGE * u for value, u in values):
        why = "no value of it exceeds its expanded uncertainty (k = 2)"
    elif rest is not None and rest.empirical is None and not rest.words:
        mine = fit.places_of(place)[0]
        theta, covariance = fit.theta[mine], fit.planned_covariance[np.ix_(mine, mine)]
        if theta @ np.linalg.solve(covariance, theta) < declared_chi2(fit) - fit.dof:
            # Its name may be certain all the same.
            return replace(found, hint="it explains less than what is left unexplained")
    return replace(found, hint=why, status="ambiguous") if why else found


def odds_of_kinds(screening: Screening) -> float:
    """Sum of the prior odds of all kinds of effects in a screening (`Effect.odds`), without
    empirical descriptions: the prior odds of the present model against any one kind of odds 1.

    Beforehand, something of the catalogue is then missing with a probability of one half, whatever
    the number of kinds that it has.
    """
    effects = [kind.peaks[0].effect for kind in screening.kinds if kind.peaks]
    return math.fsum(e.odds for e in effects if not isinstance(e, Empirical))


def chance(log_odds: float, kinds: float) -> float:
    """Posterior probability that no further effect is missing, from the log odds of all names
    together (`Weighed.log_odds`) and the prior odds of all kinds (`odds_of_kinds`).
    """
    return float(expit(math.log(kinds) - log_odds))


def by_chance(found: FoundEffect) -> str:
    """Reason where the probability of the name falls below that of a certain one when it is shared
    with the present model, in which nothing more is missing.

    An effect that is significant at 1 % may still be only a few times as probable as that nothing
    is missing (Sellke, Bayarri and Berger 2001): many kinds were tried.
    """
    if found.probability * (1.0 - found.chance) >= CERTAIN:
        return ""
    return (
        f"with a probability of {100.0 * found.chance:.0f} % it is chance, and nothing more is "
        "missing: measure again where it would be large"
    )


def shapes_not_excluded(found: FoundEffect, fit: Fit) -> str:
    """Reason where an effect of which several shapes fit alike fits nearly as well as this one.

    A screw measured at positions in equal steps looks like a wave of another pitch, and a long one
    like a polynomial. Its many pitches share one prior probability, which then decides against it,
    and not the readings.
    """
    near = [one for one in found.alike if one.worse < _EXCLUDED]
    if not near:
        return ""
    other = min(near, key=lambda one: one.worse)
    p = other.effect.shapes[0]
    values = [shape[p.name] / p.si for shape in other.shapes]
    where = [file_column(name, fit.measurement.plan.axes)[0] for name in other.effect.indicators]
    than = "higher" if other.worse >= 0.0 else "lower"
    return (
        f"{other.effect.key} with a {p.name} of {some_values(values, p.unit)}, fits as well "
        f"within the noise (its chi-square is {than} by {abs(other.worse):.1f}): measure at values "
        f"of {' and '.join(where)} between those measured"
    )


def part_of_unexplained(fit: Fit, place: int, rest: Unexplained | None) -> str:
    """Reason where a larger residual is unexplained and depends on the same covariate: the effect
    may be a part of it. Only a residual with an empirical description counts, not scatter or many
    small errors.

    The effect explains theta' C^-1 theta of its amplitudes, the chi-square that it removes.
    """
    if rest is None or rest.empirical is None:
        return ""
    same = [n for n in rest.depends_on if n in fit.model.effects[place].indicators]
    if not same:
        return ""
    mine = fit.places_of(place)[0]
    theta, covariance = fit.theta[mine], fit.planned_covariance[np.ix_(mine, mine)]
    if theta @ np.linalg.solve(covariance, theta) >= declared_chi2(fit) - fit.dof:
        return ""
    column = file_column(same[0], fit.measurement.plan.axes)[0]
    return (
        f"the unexplained residual is larger than what the effect explains and depends on {column} "
        "too: find its cause first"
    )


def beyond_scan(fit: Fit, place: int) -> str:
    """Reason where a pitch or a speed is held at an end of its grid, and a step of the linearised
    fit beyond it would lower chi-square significantly. The true value is then elsewhere, and the
    effect may be another.
    """
    effect, (_, moving) = fit.model.effects[place], fit.places_of(place)
    if not len(moving):
        return ""
    grids = effect.scan(fit.measurement.plan)
    values = {p.name: value * p.si for _, p, value, _ in fit.values_of(place)}
    uphill = fit.jacobian.T @ fit.whitened.reshape(-1) - fit.precision * fit.theta
    step = fit.covariance @ uphill
    for p, k in zip((p for p in effect.shapes if p.moves), moving, strict=True):
        ends = sorted((float(grids[p.name].min()), float(grids[p.name].max())))
        held = len(grids[p.name]) > 1 and np.isclose(values[p.name], ends, rtol=1e-9).any()
        if held and step[k] ** 2 > _OUT**2 * fit.covariance[k, k]:
            low, high = (end / p.si for end in ends)
            return (
                f"its {p.name} would have to lie within the searched range, {low:.3g} to "
                f"{high:.3g} {p.unit}, and the readings require a value beyond it: declare the "
                "effect with its actual value, or look for another cause"
            )
    return ""


def untested_twin(fit: Fit, place: int, untestable: Iterable[Untestable]) -> str:
    """Reason where an effect of one data set's instrument follows a covariate that the data sets do
    not share: an effect of the machine that follows the same could look like it, and was not
    tested.
    """
    effect = fit.model.effects[place]
    if not isinstance(effect, OfDataSet):
        return ""
    own = {name.rpartition(":")[2] for name in effect.indicators}
    twins = [
        other
        for other in untestable
        if any(name in own for name, _ in other.missing)
        and not any(effect.data_set in lacking for _, lacking in other.missing)
    ]
    if not twins:
        return ""
    names = " or ".join(dict.fromkeys(other.effect for other in twins))
    reason = twins[0].reason
    if "t" in own and any(not lacking for _, lacking in twins[0].missing):
        reason += ": say when each began by its start_s"
    return f"{names} of the machine may look the same and could not be tested, because {reason}"


def poorly_determined(fit: Fit, place: int) -> str:
    """Reason where the readings determine none of its amplitudes. The fit then improved for another
    reason, such as a fit that had not converged before.
    """
    # The constant part of a free reference value alone makes no effect.
    own = len(with_known_reference(fit.model.effects[place]).amplitudes)
    if (fit.information[fit.places_of(place)[0][:own]] > POORLY_DETERMINED).any():
        return ""
    return "the readings poorly determine its size: measure where it would be larger"


def impossible_size(fit: Fit, place: int) -> str:
    """Reason where an amplitude exceeds what is physically possible (`impossible_sizes`)."""
    beyond = impossible_sizes(fit, place)
    if not beyond:
        return ""
    effect, (times, p) = fit.model.effects[place], beyond[0]
    columns = [file_column(name, fit.measurement.plan.axes)[0] for name in effect.indicators]
    return (
        f"its {p.name} is {times:.0f} times the expected {p.sigma:g} {p.unit}, larger than is "
        "physically possible: check the units, signs and scale factors of the readings and "
        f"positions, look for another cause that depends on {' and '.join(columns) or 'the same'}, "
        "or declare the effect with its size if it is real"
    )


def second_order(fit: Fit, place: int) -> str:
    """Reason where the effect changes the readings by no more than what the model may neglect of a
    far larger one.

    The response of an effect is that of the nominal machine. What it neglects is of second order:
    the product of the effect with a rotation that the machine really makes besides, such as a load
    at the pose that is reached. Its share of the larger effect is at most the largest sum of
    rotations (rad) of the identified machine. The changes are compared as norms of the whitened
    readings.
    """
    changes = [
        float(np.linalg.norm(fit.jacobian[:, mine] @ fit.theta[mine]))
        for mine in (fit.places_of(i)[0] for i in range(len(fit.model.effects)))
    ]
    # Geometric errors are composed exactly.
    linear = [
        i
        for i, e in enumerate(fit.model.effects)
        if e.kind == "systematic" and e.name != GeometricErrors.name and i != place
    ]
    larger = max(linear, key=lambda i: changes[i], default=place)
    if changes[place] > rotation_of_machine(fit) * changes[larger]:
        return ""
    return (
        f"it changes the readings by {changes[place] / changes[larger]:.1e} of what "
        f"{fit.model.effects[larger].key} does, and may be a product of that effect with a "
        "rotation of the machine, which the model neglects: correct the larger effect on the "
        "machine and measure again"
    )


def rotation_of_machine(fit: Fit) -> float:
    """The largest sum over the axes, at any row, of the rotations by which the identified machine
    differs from the nominal one, rad.
    """
    model, plan = fit.model, fit.measurement.plan
    terms, _ = machine_terms(fit, plan)
    ports = (
        terms.offset
        + (terms.values * fit.theta[terms.parameter]) @ np.eye(len(model.layout))[terms.port]
    )
    twists = ports[:, : 6 * len(model.chain.joints)].reshape(plan.rows, -1, 6)
    return float(np.linalg.norm(twists[..., 3:], axis=2).sum(1).max(initial=0.0))


def jump_time_uncertainty(state: State, place: int, room: int) -> dict[str, float]:
    """Standard uncertainty (SI) of those shape parameters of an effect that take discrete values,
    by name.

    `place` is the place of the effect in the model. The evidence of a step in every interval
    between two edges is computed from the model without it. The uncertainty is the root of the
    second moment of the posterior about the value found, including the width of the intervals. nan
    where the fit without the effect does not converge.
    """
    effect, shape = state.model.effects[place], state.fit.shapes.get(place, {})
    edges = effect.edges(state.fit.measurement.plan)
    free = {p.name for p in effect.shapes if not p.known}
    edges = {name: values for name, values in edges.items() if name in free and len(values) > 1}
    if not edges:
        return {}
    less = without(state, place, room)
    if not less.converged:
        return dict.fromkeys(edges, math.nan)
    screen, found = ScoreTest(less, 1, 0), {}
    for name, values in edges.items():
        middle, width = 0.5 * (values[1:] + values[:-1]), np.diff(values)
        grid = {n: np.full(len(middle), v) for n, v in shape.items()} | {name: middle}
        log_odds = screen.log_bayes(effect, grid) + np.log(width)
        odds = np.exp(log_odds - log_odds.max())
        squares = (middle - shape[name]) ** 2 + width**2 / 12.0
        found[name] = math.sqrt(float(odds @ squares / odds.sum()))
    return found
