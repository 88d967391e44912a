"""Posterior odds of refitted candidates: which one is named, and with which probability."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_solve

from ...effects.base import Effect
from ...effects.reference import same_effect, with_known_reference
from ...identification.fit import Fit, declared_chi2
from ..screening.size_evidence import at_its_shape, over_scales, size_allowance, size_surplus
from .rivals import Rival

CERTAIN = 0.95
"""Posterior probability from which an effect is named rather than called ambiguous."""
DISTINGUISHABLE = 1.0
"""Least chi-square, in units of the noise, that one candidate must leave of the other for the data
to distinguish the two."""
_SHAPE_LISTED = 0.02
"""Least probability of another shape of the same effect that is listed."""
_LEAST = 1e-4
"""Least probability of a rival, or of its name ..."""
_PART = 0.01
"""... of which it is then at least this part."""
_FITS_AS_WELL = 10.0
"""Chi-square in units of the noise by which an empirical description must fit better than an effect
to be preferred to it ..."""
_LIKELIER = math.log(20.0)
"""... unless it has no fewer parameters, fits no worse and has log odds over it of so much, without
the cost of a size that is larger than expected."""


@dataclass(frozen=True)
class AlikeShapes:
    """Shapes of another effect that the readings cannot distinguish, such as the pitches of a screw
    on positions in equal steps.
    """

    effect: Effect
    shapes: tuple[Mapping[str, float], ...]
    """SI; the most probable one first."""
    worse: float
    """Chi-square, in units of the noise, by which they fit worse than the best name."""


@dataclass(frozen=True)
class Weighed:
    """The candidates of one step, one entry per distinguishable explanation."""

    best: Rival
    probability: float
    """Of the best name (identifier with placement), among all rivals."""
    equivalent: list[str]
    """Names that cannot be distinguished from the best with these data."""
    alternatives: list[tuple[str, str, float]]
    """(identifier, placement, probability) of the others."""
    log_odds: float
    """Log of the posterior odds of all names together against the model without any of them, where
    every kind has prior odds of one against that model."""
    other_shapes: list[tuple[dict[str, float], float]] = field(default_factory=list)
    """Other shapes (SI) that the best may have, with their probability."""
    instead: tuple[tuple[float, Rival], ...] = ()
    """(probability, rival) of what the effect may be instead, under the same name or another,
    however certain the name is. The size costs of the others are left out."""
    alike: tuple[AlikeShapes, ...] = ()
    """Other names of which several shapes fit alike."""

    @property
    def outweighed(self) -> bool:
        """Whether another name is more probable than the best."""
        return any(p > self.probability for *_, p in self.alternatives)


def preferred(ranked: Sequence[Rival], odds: Mapping[int, float]) -> list[Rival]:
    """Rivals in the order in which they are tried for addition.

    `ranked` are rivals, most probable first, with their log odds as of `Names.ranked`. Among names
    that do not exclude each other, an effect of an expected size precedes one that needs a size
    allowance.
    """
    if not ranked:
        return []
    least = odds[id(ranked[0])] + math.log(1.0 - CERTAIN)
    names = {r.effect.key for r in ranked if odds[id(r)] >= least}
    open_ = [r for r in ranked if r.effect.key in names]
    first = sorted(open_, key=lambda r: r.size_allowance - odds[id(r)])
    return [*first, *(r for r in ranked if r.effect.key not in names)]


def outdoes(description: Rival, names: Sequence[tuple[Rival, float]]) -> bool:
    """Whether an empirical description is preferred to effects (most probable name first, with its
    log odds).

    It must be more probable than the first, without the cost of that one's size, and fit better
    than each. What a physical effect describes equally well needs no empirical description.
    """
    if not names:
        return True
    first, odds = names[0]
    likelier = description.log_weight > odds + first.size_cost
    return likelier and fits_better(description, names)


def fits_better(best: Rival, others: Sequence[tuple[Rival, float]]) -> bool:
    """Whether a candidate fits clearly better than each of the others (with the log odds of their
    names), whatever number of parameters they have; or is clearly more probable because of its form
    alone.
    """
    noise = max(1.0, best.fit.chi2 / best.fit.dof)

    def better(rival: Rival, odds: float) -> bool:
        gained = rival.fit.chi2 - best.fit.chi2
        return gained > _FITS_AS_WELL * noise or (
            gained >= 0.0
            and len(best.effect.parameters) >= len(rival.effect.parameters)
            and best.log_weight > odds + rival.size_cost + _LIKELIER
        )

    return all(better(rival, odds) for rival, odds in others)


def likelier(
    fit: Fit,
    found: Sequence[tuple[int, Rival]],
    than: Fit,
    others: Sequence[tuple[int, Rival]],
) -> bool:
    """Whether the effects `found` in `fit` are clearly more probable together, and fit better, than
    `others` in the fit `than`.

    Both are pairs of place in the model and rival. Size costs, and effects that are in neither
    list, are left out.
    """
    noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
    gain = fit.log_evidence(noise) - than.log_evidence(noise)
    gain += math.fsum(_odds_in(fit, place, rival, noise) for place, rival in found)
    gain -= math.fsum(_odds_in(than, place, rival, noise) for place, rival in others)
    by = (declared_chi2(than) - declared_chi2(fit)) / noise**2
    return gain > _LIKELIER and by > _FITS_AS_WELL


def _odds_in(fit: Fit, place: int, rival: Rival, noise: float) -> float:
    """What the effect at that place of a fit adds to its log odds beyond the evidence of the fit
    (`Fit.log_evidence`), without the cost of its size beyond ln 20.
    """
    mine = fit.places_of(place)[0]
    more = over_scales(fit, mine, noise) + rival.log_shape + rival.log_prior
    return more + float(size_allowance(size_surplus(*at_its_shape(fit, mine, noise))))


def in_doubt(description: Rival, best: Rival, odds: float) -> bool:
    """Whether an empirical description makes an effect, with the log odds of its name, uncertain.

    The description fits better by more than the data can distinguish, and the effect is not clearly
    more probable, its size left out. A description that fits equally well is no rival: a physical
    effect that describes the same takes precedence.
    """
    noise = max(1.0, best.fit.chi2 / best.fit.dof)
    return (
        best.fit.chi2 - description.fit.chi2 > DISTINGUISHABLE * noise
        and odds + best.size_cost < description.log_weight + _LIKELIER
    )


def _left(base: Fit, of: Rival, by: Rival) -> float:
    """Chi-square that a rival's fitted contribution leaves when the other rival is fitted to it,
    with the declared model eliminated.
    """

    def columns(rival: Rival) -> np.ndarray:
        return rival.fit.jacobian[:, rival.fit.model.places[-1]]

    def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a.T @ b - (base.jacobian.T @ a).T @ cho_solve(base.factor, base.jacobian.T @ b)

    moved = columns(of) @ of.fit.theta[of.fit.model.places[-1]]
    other = columns(by)
    across = inner(other, moved[:, None])[:, 0]
    described = across @ np.linalg.pinv(inner(other, other), rcond=1e-8, hermitian=True) @ across
    return float(inner(moved[:, None], moved[:, None])[0, 0] - described)


def same_for_these_data(base: Fit, a: Rival, b: Rival) -> bool:
    """Whether the data cannot distinguish two rivals: they have as many parameters, fit alike, and
    either describes what the other one is fitted to.

    Fewer parameters make a rival more probable by the width of the priors. Where the readings
    require a size far beyond its prior (`Rival.size_allowance`), that width is unknown, and the
    number of parameters does not count.
    """
    # A constant part of a free reference value that the model takes up anyway does not count.
    counts = {len(with_known_reference(r.effect).parameters) for r in (a, b)}
    if len(counts) > 1 and max(a.size_allowance, b.size_allowance) == 0.0:
        return False
    noise = max(1.0, min(a.fit.chi2 / a.fit.dof, b.fit.chi2 / b.fit.dof))
    return (
        abs(a.fit.chi2 - b.fit.chi2) < DISTINGUISHABLE * noise
        and max(_left(base, a, b), _left(base, b, a)) < DISTINGUISHABLE * noise
    )


@dataclass(frozen=True)
class Names:
    """Rivals by name.

    Rivals that the data cannot distinguish form one class with one name. Shapes and components of
    one name add up, and so do equivalent places, because the prior odds of a kind are shared among
    them, and the prior of an effect by the steps of its scan. Variants of one effect count once.
    """

    weights: dict[str, float]
    """Posterior odds of every name, relative to the most probable rival."""
    members: dict[str, list[Rival]]
    """Most probable first."""

    @classmethod
    def of(cls, classes: Sequence[Sequence[Rival]], best: Rival | None = None) -> "Names":
        """Names of the classes of `classes_of`; the class of `best` (the most probable rival) has
        its name.

        Another class that contains a namesake of the best and some other effect is named after that
        other effect, because it does not make the best more certain.
        """
        top = max(rival.log_weight for members in classes for rival in members)
        best = classes[0][0] if best is None else best
        weights: dict[str, float] = {}
        found: dict[str, list[Rival]] = {}
        for members in classes:
            others = [r for r in members if r.effect.key != best.effect.key]
            mine = not others or any(r is best for r in members)
            key = best.effect.key if mine else others[0].effect.key
            weights[key] = weights.get(key, 0.0) + _together(members, top)
            found.setdefault(key, []).extend(members)
        return cls(weights, found)

    def log_odds(self, key: str) -> float:
        """Log of the posterior odds of a name."""
        top = max(rival.log_weight for members in self.members.values() for rival in members)
        # The odds of a very improbable name may underflow to zero.
        return top + math.log(max(self.weights[key], 1e-300))

    def ranked(self) -> list[tuple[Rival, float]]:
        """All rivals, the most probable name first, each with log odds.

        They are the log odds of the name, less the difference of the rival's own log odds from the
        most probable one of that name: a pitch or component that does not fit gains nothing from
        its name.
        """
        order = sorted(self.weights, key=lambda key: -self.weights[key])
        found = []
        for key in order:
            most = max(rival.log_weight for rival in self.members[key])
            odds = self.log_odds(key)
            found += [(rival, odds + rival.log_weight - most) for rival in self.members[key]]
        return found


def _together(members: Sequence[Rival], top: float) -> float:
    """Posterior odds of a class, relative to exp(top): the sum over the shapes of each effect, of
    variants of one effect (`same_effect`) the largest.
    """
    by_effect: dict[int, float] = {}
    for rival in members:
        at = id(rival.effect)
        by_effect[at] = by_effect.get(at, 0.0) + math.exp(rival.log_weight - top)
    distinct: dict[object, float] = {}
    for rival in members:
        same = same_effect(rival.effect)
        distinct[same] = max(distinct.get(same, 0.0), by_effect[id(rival.effect)])
    return sum(distinct.values())


def classes_of(base: Fit, rivals: Sequence[Rival]) -> list[list[Rival]]:
    """Classes of rivals that the data cannot distinguish; most probable first."""
    classes: list[list[Rival]] = []
    for rival in sorted(rivals, key=lambda r: -r.log_weight):
        for members in classes:
            if same_for_these_data(base, members[0], rival):
                members.append(rival)
                break
        else:
            classes.append([rival])
    return classes


def weigh(
    classes: Sequence[Sequence[Rival]], best: Rival, described: Rival | None = None
) -> Weighed:
    """Posterior probabilities of the rivals (`classes_of`) from the viewpoint of `best`. An
    empirical description is among them where it makes the best uncertain (`in_doubt`).
    """
    names = Names.of(classes, best)
    if described is not None and in_doubt(described, best, names.log_odds(best.effect.key)):
        classes = [*classes, [described]]
        names = Names.of(classes, best)
    weights, members_of = names.weights, names.members
    top = max(rival.log_weight for members in classes for rival in members)
    total = sum(weights.values())
    key = best.effect.key
    same = next((members for members in classes if any(r is best for r in members)), [])
    equivalent = sorted({r.effect.key for r in same} - {key})
    probability = weights[key] / total
    # Variants of an effect count once in the name, and share its probability.
    each = {id(rival): math.exp(rival.log_weight - top) for rival in members_of[key]}
    per_weight = probability / max(sum(each.values()), 1e-300)
    others = sorted(((w / total, k) for k, w in weights.items() if k != key), reverse=True)
    return Weighed(
        best=best,
        probability=probability,
        equivalent=equivalent,
        alternatives=[
            (lead.name, lead.placement, p)
            for p, k in others
            if p > _LEAST
            for lead in [next(r.effect for r in members_of[k] if r.effect.key == k)]
        ],
        log_odds=top + math.log(total),
        other_shapes=[
            (dict(rival.fit.shapes[len(rival.fit.model.effects) - 1]), share)
            for rival in members_of[key]
            if rival is not best
            and rival.effect is best.effect
            and (share := each[id(rival)] * per_weight) > _SHAPE_LISTED
        ],
        instead=_instead(best, members_of.values()),
        alike=tuple(_alike_shapes(best, classes)),
    )


def _alike_shapes(best: Rival, classes: Iterable[Sequence[Rival]]) -> Iterable[AlikeShapes]:
    """Other effects of which several shapes are in one class."""
    noise = max(1.0, best.fit.chi2 / best.fit.dof)
    for members in classes:
        if any(r.effect.key == best.effect.key for r in members):
            continue
        for effect in {id(r.effect): r.effect for r in members}.values():
            its = [r for r in members if r.effect is effect]
            if its[1:] and all(p.moves for p in effect.shapes):
                shapes = tuple(dict(r.fit.shapes[len(r.fit.model.effects) - 1]) for r in its)
                chi2 = min(r.fit.chi2 for r in its)
                yield AlikeShapes(effect, shapes, (chi2 - best.fit.chi2) / noise)


def _instead(best: Rival, names: Iterable[Sequence[Rival]]) -> tuple[tuple[float, Rival], ...]:
    """The members of these names other than the best, with their shares in all of them.

    The size costs of the others are left out: the best may owe its odds to them, and predictions
    must not look more certain for that reason.
    """
    members = [rival for its in names for rival in its]
    logs = np.array([r.log_weight if r is best else r.log_weight_at_its_size for r in members])
    weights = np.exp(logs - logs.max())
    shares = weights / weights.sum()
    every = [(float(share), rival) for share, rival in zip(shares, members, strict=True)]
    return tuple(pair for pair in probable(every, _LEAST) if pair[1] is not best)


def probable(rivals: Sequence[tuple[float, Rival]], least: float) -> list[tuple[float, Rival]]:
    """Those of (share, rival) with a share above `least`, alone or as a part of their name: the
    share of a name may be spread evenly over the many shapes that it may have.
    """
    of_name: dict[str, float] = {}
    for share, rival in rivals:
        of_name[rival.effect.key] = of_name.get(rival.effect.key, 0.0) + share

    def enough(share: float, rival: Rival) -> bool:
        whole = of_name[rival.effect.key]
        return share > least or (whole > least and share > _PART * whole)

    return [pair for pair in rivals if enough(*pair)]
