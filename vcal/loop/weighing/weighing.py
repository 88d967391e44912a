"""Weighing refitted candidates against each other: which has a name, and how certain that is."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_solve

from ...identification.fit import Fit, declared_chi2
from ..screening.size_evidence import at_its_shape, leniency, over_scales, surprise
from .rivals import Rival

CERTAIN = 0.95
"""Posterior probability from which an effect is named rather than called ambiguous."""
_TOLD = 1.0
"""What one candidate must leave of the other, as chi-square in units of the noise, for the data to
tell the two apart."""
_SHAPE_TOLD = 0.02
"""Probability from which another shape of the same effect is told."""
_LEAST = 1e-4
"""Probability below which a rival is none."""
_FITS_AS_WELL = 10.0
"""Chi-square in units of the noise by which an empirical description must fit better than an effect
to be preferred to it ..."""
_LIKELIER = math.log(20.0)
"""... unless it has no fewer parameters, fits no worse and has log odds over it of so much, without
what the effect loses by being larger than expected."""


@dataclass(frozen=True)
class Weighed:
    """The candidates of one step, one entry per distinguishable explanation."""

    best: Rival
    probability: float
    """Of the best name (identifier with placement), among all rivals."""
    equivalent: list[str]
    """Names this data cannot tell from the best at all."""
    alternatives: list[tuple[str, str, float]]
    """(identifier, placement, probability) of the others."""
    other_shapes: list[tuple[dict[str, float], float]] = field(default_factory=list)
    """Other shapes (SI) that the best may have, with their probability."""
    instead: tuple[tuple[float, Rival], ...] = ()
    """(probability, rival) of what else it may be, under the same name or another, however certain
    that is; what others lose by being larger than expected apart.
    """

    @property
    def outweighed(self) -> bool:
        """Whether another name is likelier than the best."""
        return any(p > self.probability for *_, p in self.alternatives)


def preferred(ranked: Sequence[Rival], odds: Mapping[int, float]) -> list[Rival]:
    """Rivals (with their log odds as of `Names.ranked`, most probable first) in the order in which
    they are to be added: of names that do not exclude each other, one of a size that is expected
    goes before one whose size had to be forgiven.
    """
    if not ranked:
        return []
    least = odds[id(ranked[0])] + math.log(1.0 - CERTAIN)
    names = {r.effect.key for r in ranked if odds[id(r)] >= least}
    open_ = [r for r in ranked if r.effect.key in names]
    first = sorted(open_, key=lambda r: r.leniency - odds[id(r)])
    return [*first, *(r for r in ranked if r.effect.key not in names)]


def outdoes(description: Rival, names: Sequence[tuple[Rival, float]]) -> bool:
    """Whether an empirical description is preferred to effects (most probable name first, with its
    log odds): it is likelier than the first, the size of that apart, and fits better than each.
    What a physical effect describes as well needs no description of its own.
    """
    if not names:
        return True
    first, odds = names[0]
    likelier = description.log_weight > odds + first.forgiven
    return likelier and fits_better(description, [rival for rival, _ in names])


def fits_better(best: Rival, others: Sequence[Rival]) -> bool:
    """Whether a candidate fits clearly better than every one of the others, whatever number of
    parameters they have, or is clearly likelier and owes it to nothing but its form.
    """
    noise = max(1.0, best.fit.chi2 / best.fit.dof)

    def better(rival: Rival) -> bool:
        gained = rival.fit.chi2 - best.fit.chi2
        return gained > _FITS_AS_WELL * noise or (
            gained >= 0.0
            and len(best.effect.parameters) >= len(rival.effect.parameters)
            and best.log_weight > rival.log_weight_at_its_size + _LIKELIER
        )

    return all(map(better, others))


def likelier(
    fit: Fit,
    found: Sequence[tuple[int, Rival]],
    than: Fit,
    others: Sequence[tuple[int, Rival]],
) -> bool:
    """Whether effects (their places in the model of `fit`, and what spoke for each) fit better than
    others do in another fit and are clearly likelier together, their sizes apart. What neither
    names has no part in it.
    """
    noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
    gain = fit.log_evidence(noise) - than.log_evidence(noise)
    gain += math.fsum(_odds_in(fit, place, rival, noise) for place, rival in found)
    gain -= math.fsum(_odds_in(than, place, rival, noise) for place, rival in others)
    by = (declared_chi2(than) - declared_chi2(fit)) / noise**2
    return gain > _LIKELIER and by > _FITS_AS_WELL


def _odds_in(fit: Fit, place: int, rival: Rival, noise: float) -> float:
    """What the effect at that place of a fit adds to its log odds beyond the evidence of the fit
    (`Fit.log_evidence`), its size apart.
    """
    mine = fit.places_of(place)[0]
    more = over_scales(fit, mine, noise) + rival.log_shape + rival.log_prior
    return more + float(leniency(surprise(*at_its_shape(fit, mine, noise))))


def in_doubt(description: Rival, best: Rival) -> bool:
    """Whether an empirical description puts an effect in doubt: it fits better, by more than
    nothing that the data can tell, and the effect is not clearly likelier, its size apart. One that
    fits the same is no rival: what a physical effect describes as well needs no description.
    """
    noise = max(1.0, best.fit.chi2 / best.fit.dof)
    return (
        best.fit.chi2 - description.fit.chi2 > _TOLD * noise
        and best.log_weight_at_its_size < description.log_weight + _LIKELIER
    )


def _left(base: Fit, of: Rival, by: Rival) -> float:
    """Chi-square that a rival's fitted contribution leaves where the other one describes it, beside
    the declared model.
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
    """Whether two rivals of as many parameters fit alike and either would describe what the other
    one is found to be, to less than the data can tell.
    """
    if len(a.effect.parameters) != len(b.effect.parameters):
        return False
    noise = max(1.0, min(a.fit.chi2 / a.fit.dof, b.fit.chi2 / b.fit.dof))
    return (
        abs(a.fit.chi2 - b.fit.chi2) < _TOLD * noise
        and max(_left(base, a, b), _left(base, b, a)) < _TOLD * noise
    )


@dataclass(frozen=True)
class Names:
    """Rivals by name. Those the data cannot tell apart are one class with one name; peaks and
    components of one name add up, and so do places that are the same: the prior of a kind is shared
    out to them.
    """

    weights: dict[str, float]
    """Posterior odds of every name, those of the most probable rival being one."""
    members: dict[str, list[Rival]]
    """Most probable first."""

    @classmethod
    def of(cls, classes: Sequence[Sequence[Rival]], best: Rival | None = None) -> "Names":
        """The classes of `classes_of`, that of `best` (the most probable one) with its name.

        Another class in which something else is the same as a namesake of the best has the name of
        that: it makes the best no more certain.
        """
        top = max(rival.log_weight for members in classes for rival in members)
        best = classes[0][0] if best is None else best
        weights: dict[str, float] = {}
        found: dict[str, list[Rival]] = {}
        for members in classes:
            others = [r for r in members if r.effect.key != best.effect.key]
            mine = not others or any(r is best for r in members)
            key = best.effect.key if mine else others[0].effect.key
            distinct = {id(r.effect): math.exp(r.log_weight - top) for r in reversed(members)}
            weights[key] = weights.get(key, 0.0) + sum(distinct.values())
            found.setdefault(key, []).extend(members)
        return cls(weights, found)

    def ranked(self) -> list[tuple[Rival, float]]:
        """All rivals, the most probable name first, with the log odds of their name, less what they
        are themselves less likely than the most probable one of it: another pitch or component that
        does not fit has no part in what its name is worth.
        """
        top = max(rival.log_weight for members in self.members.values() for rival in members)
        order = sorted(self.weights, key=lambda key: -self.weights[key])
        found = []
        for key in order:
            most = max(rival.log_weight for rival in self.members[key])
            # A name may be so unlikely that its odds are zero in floating point.
            odds = top + math.log(max(self.weights[key], 1e-300))
            found += [(rival, odds + rival.log_weight - most) for rival in self.members[key]]
        return found


def classes_of(base: Fit, rivals: Sequence[Rival]) -> list[list[Rival]]:
    """Rivals that the data cannot tell apart, together; most probable first."""
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
    """Posterior probabilities of the rivals (`classes_of`), seen from one of them; among them an
    empirical description, where it puts the best in doubt.
    """
    if described is not None and in_doubt(described, best):
        classes = [*classes, [described]]
    names = Names.of(classes, best)
    weights, members_of = names.weights, names.members
    top = max(rival.log_weight for members in classes for rival in members)
    total = sum(weights.values())
    key = best.effect.key
    same = next((members for members in classes if any(r is best for r in members)), [])
    equivalent = sorted({r.effect.key for r in same} - {key})
    probability = weights[key] / total
    # Shapes that the data cannot tell apart weigh as one in the name, and share its probability.
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
        other_shapes=[
            (dict(rival.fit.shapes[len(rival.fit.model.effects) - 1]), share)
            for rival in members_of[key]
            if rival is not best
            and rival.effect is best.effect
            and (share := each[id(rival)] * per_weight) > _SHAPE_TOLD
        ],
        instead=_instead(best, members_of.values()),
    )


def _instead(best: Rival, names: Iterable[Sequence[Rival]]) -> tuple[tuple[float, Rival], ...]:
    """The members of these names other than the best, with their shares in all of them. The best
    may owe something to the size that is expected of others; what is foretold is not to be surer
    for that.
    """
    members = [rival for its in names for rival in its]
    logs = np.array([r.log_weight if r is best else r.log_weight_at_its_size for r in members])
    weights = np.exp(logs - logs.max())
    shares = weights / weights.sum()
    return tuple(
        (float(share), rival)
        for share, rival in zip(shares, members, strict=True)
        if rival is not best and share > _LEAST
    )
