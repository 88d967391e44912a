"""Refits of the best candidates, and their evidence."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit
from ...identification.identify import NEARLY, identify
from ...machine.parameters import Parameter
from ..screening.score_test import Peak
from ..screening.size_evidence import (
    at_its_shape,
    log_gain,
    log_mixture,
    observed_size,
    over_scales,
    prior_pull,
    size_allowance,
    size_surplus,
)

_SAME_SHAPE = 2.0
"""Standard uncertainties within which two shapes are the same."""
WIDENINGS, WIDER = 7, 4.0
"""How often, and by which factor, the prior of an effect that is larger than expected is widened.
"""
_PULLED = math.log(20.0)
"""Half of the chi-square that the prior of an effect may add to the fit before it is widened."""
_WIDEST = WIDER**WIDENINGS
"""Prior standard deviations beyond which a size means that the readings do not determine it,
because no prior is that wrong. There is no size allowance beyond it."""
_IMPOSSIBLE = math.log(1e-4)
"""Log of the prior odds of a size that is physically impossible."""


@dataclass(frozen=True)
class Rival:
    """A candidate after its non-linear refit."""

    peak: Peak
    """The peak that it was refitted from."""
    fit: Fit
    log_bayes: float
    """Gain in log evidence over the model without it."""
    log_prior: float
    """Log of the prior odds: those of its kind (`Effect.odds`), shared evenly by the places and
    components of that kind that were tried."""
    delta_bic: float
    """Change of the Bayesian information criterion; negative is better."""
    log_shape: float = 0.0
    """Prior information on its shape beyond the fit; it is included in `log_bayes`."""
    size_surplus: float = 0.0
    """Cost of a size larger than expected, included in `log_bayes` (`size_evidence.size_surplus`).
    """
    wider: float = 1.0
    """Factor by which the prior of its amplitudes is wider in `fit` than in `effect`. It is weighed
    with the prior of `effect`."""

    @property
    def effect(self) -> Effect:
        return self.peak.effect

    @property
    def size_allowance(self) -> float:
        """The part of the size surplus beyond ln 20, which is credited
        (`size_evidence.size_allowance`).
        """
        return float(size_allowance(np.asarray(self.size_surplus)))

    @property
    def log_weight(self) -> float:
        """Log of the posterior odds among rivals."""
        return self.log_bayes + self.log_prior + self.size_allowance

    @property
    def size_cost(self) -> float:
        """Remaining cost of its size. It is disregarded against descriptions, which have no
        expected size.
        """
        return self.size_surplus - self.size_allowance

    @property
    def log_weight_at_its_size(self) -> float:
        """Log of the posterior odds if its size were as expected."""
        return self.log_weight + self.size_cost


def refit(base: Fit, peak: Peak, keep: np.ndarray, room: int = 0, wider: float = 1.0) -> Fit:
    """The model with one more effect, from the linear estimate of its amplitudes, with their prior
    standard deviations multiplied by `wider`.
    """
    model = base.model.with_effects(widened(peak.effect, wider))
    place = len(base.model.effects)
    amplitudes = len(base.model.entries)
    theta = np.concatenate([base.theta[:amplitudes], np.asarray(peak.amplitudes) / wider])
    shapes = {**base.shapes, **({place: dict(peak.shape)} if peak.shape else {})}
    return identify(
        model,
        base.measurement,
        theta=theta,
        shapes=shapes,
        whitener=base.whitener,
        keep=keep,
        room=room,
        tolerance=NEARLY,
    )


def widened(effect: Effect, wider: float) -> Effect:
    """The effect with the prior standard deviations of its free amplitudes times `wider`."""
    rows = {
        p.name: (p.name, p.mean, wider * p.sigma)
        for p in effect.amplitudes
        if p.informed and not p.known
    }
    if wider == 1.0 or not rows:
        return effect
    given = tuple(row for row in effect.given if row[0] not in rows)
    priors = tuple(p for p in effect.priors if not rows.keys() & set(p.names))
    return dataclasses.replace(effect, given=(*given, *rows.values()), priors=priors)


def _at_its_size(base: Fit, peak: Peak, keep: np.ndarray, room: int) -> tuple[Fit, float]:
    """The refit with a prior as wide as its size requires, and the factor.

    The declared prior would pull a much larger effect away from the readings, the more so the
    larger the noise is taken to be while the effect is missing. The true effect would then fit
    worse than a wrong one.
    """
    wider, fit = 1.0, refit(base, peak, keep, room)
    added = fit.model.places[-1]
    for _ in range(WIDENINGS):
        if not fit.determined:
            break  # the readings do not determine its place, hence not its size
        if fit.converged:
            noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
            information, scores = at_its_shape(fit, added, noise)
            if prior_pull(information, scores) <= _PULLED:
                break
            size = observed_size(information, scores)
        elif wider == 1.0 and peak.size_allowance > 0.0:
            size = float(np.linalg.norm(peak.amplitudes))
        else:
            break
        if not 1.0 < wider * size <= _WIDEST:
            break
        more = wider * WIDER ** math.ceil(math.log(size, WIDER))
        grown = refit(base, peak, keep, room, more)
        # The cost of the wider prior is lower. A higher total cost means another minimum.
        worse = fit.converged and grown.cost > fit.cost
        if not grown.converged or worse or _at_an_end(grown):
            break
        wider, fit = more, grown
    return fit, wider


def impossible_sizes(fit: Fit, place: int) -> list[tuple[float, Parameter]]:
    """Amplitudes of the effect at that place that exceed what is physically possible
    (`Parameter.largest`) by more than their expanded uncertainty (k = 2): size in standard
    deviations of the default prior, and parameter; largest first.
    """
    effect = fit.model.effects[place]
    expected = {p.name: p for p in effect.parameters if not p.shape and p.informed}
    found = [
        (abs(value) / expected[p.name].sigma, expected[p.name])
        for _, p, value, u in fit.values_of(place)
        if p.name in expected
        and abs(value) - 2.0 * u > expected[p.name].largest * expected[p.name].sigma
    ]
    return sorted(found, key=lambda pair: -pair[0])


def _at_an_end(fit: Fit) -> bool:
    """Whether a shape parameter of the last effect is at an end of its grid, where it is correlated
    with the size: a drift equals a warm-up with any sufficiently long time constant.
    """
    last = len(fit.model.effects) - 1
    scan = fit.model.effects[last].scan(fit.measurement.plan)
    return any(
        p.moves and fit.shapes[last][p.name] in (scan[p.name].min(), scan[p.name].max())
        for p in fit.model.effects[last].shapes
    )


def refit_all(
    base: Fit,
    peaks: Sequence[Peak],
    instances: Mapping[str, int],
    keep: np.ndarray,
    room: int = 0,
) -> list[Rival]:
    """Refits of the given peaks, most probable first, at the noise that the best of them leaves.

    `instances` is the number of places and components of each kind that were tried. Fits that do
    not converge, or that leave a parameter undetermined, are left out.
    """
    sized = []
    for peak in peaks:
        # A candidate whose equations have no solution is none.
        with suppress(np.linalg.LinAlgError):
            sized.append((peak, *_at_its_size(base, peak, keep, room)))
    sized = [item for item in sized if item[1].converged and item[1].determined]
    widths = {id(fit): wider for _, fit, wider in sized}
    fits = _distinct([(peak, fit) for peak, fit, _ in sized])
    fits = [(peak, fit) for peak, fit in fits if _solvable(fit)]
    if not fits:
        return []
    noise = math.sqrt(max(1.0, min(fit.chi2 / fit.dof for _, fit in fits)))
    reference = base.log_evidence(noise)
    rows = int(base.used.sum())
    rivals = []
    for peak, fit in fits:
        k = len(peak.effect.parameters)
        bic = (fit.chi2 - base.chi2) / noise**2 + k * math.log(rows)
        odds = math.log(peak.effect.odds / instances[peak.effect.name])
        if impossible_sizes(fit, len(fit.model.effects) - 1):
            odds += _IMPOSSIBLE
        added = fit.model.places[-1]
        wider = widths[id(fit)]
        own = at_its_shape(fit, added, noise)
        declared = own[0] / wider**2, own[1] / wider
        if wider > 1.0:
            more = float(log_mixture(*declared) - log_gain(*own, np.ones(1))[0])
        else:
            more = over_scales(fit, added, noise)
        gain = fit.log_evidence(noise) + more - reference
        shape = _log_shape_odds(fit) + _over_the_scan(peak, fit, noise)
        lost = float(size_surplus(*declared)) if observed_size(*declared) <= _WIDEST else 0.0
        rivals.append(Rival(peak, fit, gain + shape, odds, bic, shape, lost, wider))
    return sorted(rivals, key=lambda rival: -rival.log_weight)


def _solvable(fit: Fit) -> bool:
    """Whether the amplitudes of the last effect can be separated from all others."""
    try:
        at_its_shape(fit, fit.model.places[-1])
    except np.linalg.LinAlgError:
        return False
    return True


def _over_the_scan(peak: Peak, fit: Fit, noise: float) -> float:
    """Difference of the log share of shapes that explain the data: grid less curvature at the best
    shape.

    The grid is used where it resolves the peak. From a single moment or time constant, linear
    estimates elsewhere may look equally good without being so.
    """
    place, moving = len(fit.model.effects) - 1, sum(p.moves for p in peak.effect.shapes)
    if not peak.effect.shapes:
        return 0.0
    h = fit.hessian(noise)
    covariance = np.linalg.inv(h)[len(h) - moving :, len(h) - moving :]
    if (np.diag(covariance) < 1.0).any():
        return 0.0
    return float(peak.log_share - fit.log_scan(place, h) - 0.5 * np.linalg.slogdet(covariance)[1])


def _log_shape_odds(fit: Fit) -> float:
    effect = fit.model.effects[-1]
    found = fit.values_of(len(fit.model.effects) - 1)
    values = {p.name: value * p.si for _, p, value, _ in found}
    uncertainties = {p.name: u * p.si for _, p, _, u in found}
    # The odds may underflow where the values are out of the question.
    return math.log(max(1e-300, effect.shape_odds(fit.measurement.plan, values, uncertainties)))


def _distinct(fits: list[tuple[Peak, Fit]]) -> list[tuple[Peak, Fit]]:
    """The fits without duplicates: those that converged to the optimum of a better fit of the same
    effect.

    Duplicates have the same chi-square at the same shape. Two pitches that fit equally well on a
    grid of positions are not duplicates. Each fit keeps the highest of the peaks that converged to
    it, with that peak's share of the grid.
    """
    kept: list[tuple[Peak, Fit]] = []
    for peak, fit in sorted(fits, key=lambda pair: pair[1].chi2):
        for i, (highest, other) in enumerate(kept):
            same = highest.effect is peak.effect and _same_shape(other, fit)
            if same and abs(other.chi2 - fit.chi2) < 0.5:
                kept[i] = max(highest, peak, key=lambda p: p.statistic), other
                break
        else:
            kept.append((peak, fit))
    return kept


def _same_shape(a: Fit, b: Fit) -> bool:
    """Whether the last effects of two fits have the same shape within its uncertainty."""
    last = len(a.model.effects) - 1
    return all(
        abs(a.shapes[last][p.name] - b.shapes[last][p.name])
        <= (_SAME_SHAPE * u * p.si if p.moves else 0.0)
        for _, p, _, u in a.values_of(last)
        if p.shape
    )
