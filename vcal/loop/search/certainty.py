"""What keeps a name from being certain, however likely it is among those that were tried."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ...effects.data_set import OfDataSet
from ...identification.fit import HARDLY_TOLD, Fit, declared_chi2
from ...instruments.conditions import file_column
from ..outcome.closure import FoundEffect
from ..outcome.unexplained import Unexplained
from ..screening.candidates import Untestable
from ..screening.score_test import ScoreTest
from .state import State, without

_OUT = 3.0
"""By how many of its standard uncertainties a shape would have to leave its scan to be told."""


def doubted(
    found: FoundEffect, fit: Fit, rest: Unexplained | None, untestable: Iterable[Untestable]
) -> FoundEffect:
    """The effect as it was found in a fit, or not for certain where something speaks against that:
    what is unexplained beside it, a shape beyond what was looked for, an effect that could not be
    tested, or readings that do not tell its size.
    """
    if found.status != "named":
        return found
    place = next(i for i, e in enumerate(fit.model.effects) if e.alike(found.effect))
    why = (
        beside_the_rest(fit, place, rest)
        or beyond_its_scan(fit, place)
        or beside_the_untested(fit, place, untestable)
        or hardly_told(fit, place)
    )
    return replace(found, status="ambiguous", separation=why) if why else found


def beside_the_rest(fit: Fit, place: int, rest: Unexplained | None) -> str:
    """Where something that can be described is unexplained, more than the effect explains, and
    depends on the same: it may be a part of that. What only scatters, or what many small things
    leave, takes nothing from a name.

    The effect explains theta' C^-1 theta of its amplitudes, the chi-square that would be there
    without them.
    """
    if rest is None or rest.empirical is None:
        return ""
    same = [n for n in rest.depends_on if n in fit.model.effects[place].indicators]
    if not same:
        return ""
    mine = fit.places_of(place)[0]
    theta, covariance = fit.theta[mine], fit.covariance[np.ix_(mine, mine)]
    if theta @ np.linalg.solve(covariance, theta) >= declared_chi2(fit) - fit.dof:
        return ""
    column = file_column(same[0], fit.measurement.plan.axes)[0]
    return f"what is unexplained, more than it explains, depends on {column} too: find that first"


def beyond_its_scan(fit: Fit, place: int) -> str:
    """Where a pitch or a speed is held at an end of what is looked for, and a step of the
    linearised fit beyond it would lower chi-square by more than chance: the true one is somewhere
    else, and so may be the effect.
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
                f"its {p.name} would have to lie within what is looked for, {low:.3g} to "
                f"{high:.3g} {p.unit}, and the readings ask for more"
            )
    return ""


def beside_the_untested(fit: Fit, place: int, untestable: Iterable[Untestable]) -> str:
    """Where an effect of the instrument of one data set follows what the data sets do not share:
    one of the machine that follows the same could look like it, and was not tested.
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
    return f"{names} of the machine may look the same and could not be tested, as {reason}"


def hardly_told(fit: Fit, place: int) -> str:
    """Where the readings say next to nothing of any of its amplitudes: what got better with it is
    then something else, such as a fit that had not come to its end.
    """
    if (fit.information[fit.places_of(place)[0]] > HARDLY_TOLD).any():
        return ""
    return "the readings say next to nothing of its size: measure where it would be larger"


def jump_time_uncertainty(state: State, place: int, room: int) -> dict[str, float]:
    """Standard uncertainty (SI) of those of the effect at that position in the model, by name.

    Seen from the model without it, every interval between two of its edges has the evidence of a
    step there: about the value found, the second moment of the posterior, even within an interval.
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
