"""The best candidates, refitted."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit
from ...identification.identify import NEARLY, identify
from ..screening.score_test import Peak
from ..screening.size_evidence import (
    at_its_shape,
    leniency,
    log_gain,
    log_mixture,
    over_scales,
    size_told,
    surprise,
)

_SAME_SHAPE = 2.0
"""Standard uncertainties within which two shapes are the same."""
WIDENINGS, WIDER = 4, 4.0
"""How often, and by how much, the prior of an effect grows that is larger than expected."""
_WIDEST = WIDER**WIDENINGS
"""Prior standard deviations from which a size is that of readings that do not tell it: no prior is
that wrong. Nothing of it is forgiven."""


@dataclass(frozen=True)
class Rival:
    """A candidate after its non-linear refit."""

    peak: Peak
    """What it was refitted from."""
    fit: Fit
    log_bayes: float
    """Gain in log evidence over the model without it."""
    log_prior: float
    """Log of the prior odds: those of its kind (`Effect.odds`), shared evenly by the places and
    components of that kind that were tried."""
    delta_bic: float
    """Change of the Bayesian information criterion; negative is better."""
    log_shape: float = 0.0
    """What is known of its shape beyond the fit: a share of `log_bayes`."""
    surprise: float = 0.0
    """What its size being larger than expected costs `log_bayes`."""
    wider: float = 1.0
    """By how much the prior of its amplitudes is wider in `fit` than in `effect`, by which it is
    weighed.
    """

    @property
    def effect(self) -> Effect:
        return self.peak.effect

    @property
    def leniency(self) -> float:
        """What that costs beyond what it may."""
        return float(leniency(np.asarray(self.surprise)))

    @property
    def log_weight(self) -> float:
        """Log of the posterior odds among rivals."""
        return self.log_bayes + self.log_prior + self.leniency

    @property
    def forgiven(self) -> float:
        """What its size still costs, which it does not against descriptions: those have any."""
        return self.surprise - self.leniency

    @property
    def log_weight_at_its_size(self) -> float:
        """Log of the posterior odds were its size as expected."""
        return self.log_weight + self.forgiven


def refit(base: Fit, peak: Peak, keep: np.ndarray, room: int = 0, wider: float = 1.0) -> Fit:
    """The model with one more effect, from the linear estimate of its amplitudes; with so many
    times their prior standard deviations.
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
    """The effect with so many times the prior standard deviations of its free amplitudes."""
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
    """The refit with a prior as wide as its size asks for, and by how much. What is expected would
    else pull an effect that is far larger off the readings, the more the less they are trusted
    while it is missing; it would then fit worse than what it is not.
    """
    wider, fit = 1.0, refit(base, peak, keep, room)
    added = fit.model.places[-1]
    for _ in range(WIDENINGS):
        if not fit.determined:
            break  # no reading tells the place of it, and so none its size
        if fit.converged:
            noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
            information, scores = at_its_shape(fit, added, noise)
            if leniency(surprise(information, scores)) == 0.0:
                break
            size = size_told(information, scores)
        elif wider == 1.0 and peak.leniency > 0.0:
            size = float(np.linalg.norm(peak.amplitudes))
        else:
            break
        if not 1.0 < wider * size <= _WIDEST:
            break
        more = wider * WIDER ** math.ceil(math.log(size, WIDER))
        grown = refit(base, peak, keep, room, more)
        # Its own share of the prior falls: what is more all the same is another minimum.
        worse = fit.converged and grown.cost > fit.cost
        if not grown.converged or worse or _at_an_end(grown):
            break
        wider, fit = more, grown
    return fit, wider


def _at_an_end(fit: Fit) -> bool:
    """Whether a shape of the last effect is at an end of its scan, where it trades with the size: a
    drift is a warming-up of any time constant that is long enough.
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
    """Refits of the given peaks, most probable first, at the noise the best of them leaves.

    `instances` tells how many places and components of each kind were tried. Fits that do not
    converge, or that leave a parameter undetermined, are left out.
    """
    sized = [(peak, *_at_its_size(base, peak, keep, room)) for peak in peaks]
    sized = [item for item in sized if item[1].converged and item[1].determined]
    widths = {id(fit): wider for _, fit, wider in sized}
    fits = _distinct([(peak, fit) for peak, fit, _ in sized])
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
        lost = float(surprise(*declared)) if size_told(*declared) <= _WIDEST else 0.0
        rivals.append(Rival(peak, fit, gain + shape, odds, bic, shape, lost, wider))
    return sorted(rivals, key=lambda rival: -rival.log_weight)


def _over_the_scan(peak: Peak, fit: Fit, noise: float) -> float:
    """What the scan says more of the share of shapes that explain the data than the curvature at
    the best one does. The scan is believed where it resolves the peak: seen from one moment or one
    time constant, others look as good that are not.
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
    found = [row for row in fit.values_of(len(fit.model.effects) - 1) if row[1].shape]
    if not found:
        return 0.0
    values = {p.name: value * p.si for _, p, value, _ in found}
    uncertainties = {p.name: u * p.si for _, p, _, u in found}
    return math.log(effect.shape_odds(fit.measurement.plan, values, uncertainties))


def _distinct(fits: list[tuple[Peak, Fit]]) -> list[tuple[Peak, Fit]]:
    """The fits less those whose peak ran to the optimum of a better one of the same effect: the
    same fit at the same shape, as two pitches may fit equally well on a grid of positions. With
    every one the highest of the peaks that ran to it, whose share of the scan it has.
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
