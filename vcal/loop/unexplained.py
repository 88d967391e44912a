"""What remains and has no name: along which covariate, where, in which direction, how large."""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincc

from ..effects.base import Effect
from ..fit import Fit
from ..plan import DATA_SET
from .chance import SILENT, corrected, effective_trials
from .empirical import Empirical, Interval
from .recorded import angles_around, distinct_covariates
from .rivals import Rival
from .screen import Screen
from .serial import Serial
from .whitened import declared_chi2

_BINS = 10
_CLEARLY = 1.2
"""What a covariate must describe of the variance, over what an empirical effect does, to be told
first: that says where."""
_AS_NOISE = "noise that is correlated in time, or a drift"
_MOSTLY = 2.0
"""Share of the variance that persists from reading to reading, over what the best covariate
describes, from which no covariate is told alone: all that changes slowly describes some."""
_FEWEST = 10.0
"""Degrees of freedom from which it is asked what the residual depends on: a covariate has ten bins,
and of dozens of products one describes a handful of numbers whatever they are."""
_SPREAD = 25.0
"""chi2 per degree of freedom, against the declared noise, from which something must be missing even
if nothing that is recorded tells it; noise that is declared too small is no such thing.
"""
_BY_CHANCE = 0.01
"""Probability from which what is this large for another reason depends on no covariate: the best of
all that were recorded always describes a little."""
_LAST_LOOK = 0.25
"""Share of alpha that the last look at what remains may spend beside the search."""
_ROUNDING = 1e-9
"""Share of the variance, on average over null draws, that is nothing but rounding."""
_BEYOND = "what is beyond the declared noise"
_BY_THE_BEST = "what the column or product that tells most describes"
"""Of the residual, what is told in size and share where nothing describes it."""
_SHOWN = 3
"""Products of two covariates that are told."""


@dataclass(frozen=True)
class Unexplained:
    """A residual that no effect that was tried explains."""

    depends_on: list[str]
    """Covariates, most telling first."""
    shares: list[float]
    """Share of the residual's variance each of them describes alone, corrected for chance."""
    where: list[Interval]
    direction: str
    """``"X"``, ``"Y"``, ``"Z"`` at the tool point, or ``"mixed"``; ``"A"``, ``"B"``, ``"C"`` where
    only angles were read.
    """
    size_um: float
    share_of_variance: float
    p_value: float
    reason: str
    words: str = ""
    """What it is: the empirical description, or noise, where there is one."""
    empirical: Rival | None = None
    """The empirical description, where there is one."""
    products: tuple[tuple[str, str, float], ...] = ()
    """Pairs of covariates whose product describes some of it, with its share, largest first."""
    joint: bool = False
    """Whether it is the product of two that it depends on first of all."""
    size_is: str = ""
    """What `size_um` is, in words."""
    share_is: str = ""
    """What `share_of_variance` is a share of, in words."""


@dataclass(frozen=True)
class Refused:
    """An effect, or a description, that was significant in the last round, and did not hold."""

    effect: Effect
    p_value: float
    """Corrected for the search."""
    reason: str

    @property
    def words(self) -> str:
        """What it is."""
        return self.effect.words if isinstance(self.effect, Empirical) else self.effect.key


def displacements(fit: Fit, residuals: np.ndarray | None = None) -> np.ndarray:
    """The displacement of the tool point (n, 3), m, that would give each row's residual.

    Least squares of the residual on the ports of the tool, in the tool's own frame. What reads
    angles alone gives turns about X, Y and Z instead, times its lever arm (`Fit.by_tool`).
    """
    weights = np.einsum("nij,njp->nip", fit.whitener, fit.by_tool)
    values = fit.residual if residuals is None else residuals
    whitened = np.einsum("nij,nj...->ni...", fit.whitener, values)
    return np.einsum("npi,ni...->np...", np.linalg.pinv(weights), whitened)


def bins(x: np.ndarray) -> np.ndarray:
    """Bin index of every value: its own category up to 12 distinct values, else ten quantiles."""
    values = np.unique(x)
    if len(values) <= 12:
        return np.searchsorted(values, x)
    edges = np.quantile(x, np.linspace(0, 1, _BINS + 1)[1:-1])
    return np.searchsorted(edges, x)


class Dependence(NamedTuple):
    """What the residual depends on."""

    single: list[tuple[str, float]]
    """Covariates with the share of the variance that each describes alone, what chance gives taken
    off; best first."""
    products: list[tuple[str, str, float]]
    """The same of products of two, beyond what is linear in either."""
    joint: bool
    """Whether a product is less likely to be chance than every covariate alone."""
    p_value: float
    """Of the best, corrected for all of them."""


def dependence(fit: Fit, draws: int, seed: int) -> Dependence:
    """Shares of the tool point's residual variance that are described by ten bins of each
    covariate, and by products of two, against what chance gives in `draws` null residuals. Nothing
    where too few degrees of freedom are left to tell.
    """
    if fit.dof < _FEWEST:
        return Dependence([], [], False, 1.0)
    state = Screen(fit, draws, seed)
    used = fit.used
    inverse = np.linalg.pinv(np.einsum("nij,njp->nip", fit.whitener[used], fit.by_tool[used]))
    data = np.einsum("npi,ni->np", inverse, state.residual[used])
    null = np.einsum("npi,nid->npd", inverse.astype(np.float32), state.null[used])
    both = np.concatenate([data[:, :, None], null], axis=2)
    for rows in fit.measurement.plan.parts.values() if fit.measurement.plan.sets else ():
        # In units of its own scatter: a precise data set would be lost beside a coarse one.
        mine = rows[used]
        if not mine.any():
            continue
        scatter = np.sqrt(np.mean(both[mine][:, :, 1:] ** 2))
        if fit.chi2_and_dof(rows)[1] < 1.0 or scatter == 0.0:
            both[mine] = 0.0  # what its own parameters leave of it is rounding
        else:
            both[mine] /= scatter
    total = (both**2).sum((0, 1))
    if not total[1:].any():
        return Dependence([], [], False, 1.0)  # nothing that the tool does is seen
    total = np.maximum(total, SILENT * total[1:].mean())
    names, shares = [], []
    known = {name: x[used] for name, x in distinct_covariates(fit.measurement.plan).items()}
    known = {name: x for name, x in known.items() if np.unique(x[np.isfinite(x)]).size > 1}
    for name, x in known.items():
        there = np.isfinite(x)
        index = bins(x[there])
        counts = np.bincount(index)
        sums = np.tensordot(np.eye(len(counts))[:, index], both[there], 1)
        described = (sums**2 / np.maximum(counts, 1)[:, None, None]).sum((0, 1)) / total
        if described[1:].mean() < _ROUNDING:
            continue  # nuisances take all of it, such as the place of a sphere in every run
        names.append(name)
        shares.append(described)
    singles = np.array(shares).reshape(len(shares), draws + 1)
    plan = fit.measurement.plan
    # A group index is no quantity to multiply by, unless there are only two of a kind; nor is an
    # angle that begins anew somewhere.
    out = {*plan.groups, *angles_around(plan)}
    multiplied = {n for n in known if n not in out and np.isfinite(known[n]).all()}
    if len(plan.sets) == 2:
        multiplied.add(DATA_SET)
    pairs, columns = _products({n: x for n, x in known.items() if n in multiplied})
    moved = np.tensordot(columns, both, 1) if pairs else np.zeros((0, *both.shape[1:]))
    products = (moved**2).sum(1) / total
    told = products[:, 1:].mean(1) >= _ROUNDING
    products, pairs = products[told], [pair for pair, one in zip(pairs, told, strict=True) if one]
    if not names and not pairs:
        return Dependence([], [], False, 1.0)
    rare = np.concatenate([_rarity(singles), _rarity(products)])
    best, best_null = rare[:, 0].max(), rare[:, 1:].max(0)
    exceeding = int((best_null >= best).sum())
    p_value = (1.0 + exceeding) / (draws + 1.0)
    if exceeding == 0:  # beyond what draws can tell: as the screening corrects for its trials
        trials = effective_trials(math.log(10.0) * best_null)
        p_value = min(p_value, float(corrected(math.log(10.0) * best, trials)))
    usual = float(best_null.mean())
    count = len(names)
    telling = [(names[i], share) for i, share in _by_share(singles) if rare[i, 0] > usual]
    joined = [(*pairs[i], share) for i, share in _by_share(products) if rare[count + i, 0] > usual]
    # Both may be beyond what a probability can say: then the larger share decides.
    rarest = [
        max(zip(part[:, 0], table[:, 0], strict=True), default=(0.0, 0.0))
        for part, table in ((rare[:count], singles), (rare[count:], products))
    ]
    joint = bool(joined) and rarest[1] > rarest[0]
    return Dependence(telling, joined[:_SHOWN], joint, p_value)


def _products(known: dict[str, np.ndarray]) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Pairs of covariates and (pairs, n) their products, without what is linear in either, of unit
    length.
    """
    pairs, rows = [], []
    for (first, x), (second, y) in itertools.combinations(known.items(), 2):
        u, v = ((z - z.mean()) / z.std() for z in (x, y))
        linear = np.linalg.qr(np.column_stack([np.ones_like(u), u, v]))[0]
        both = u * v
        left = both - linear @ (linear.T @ both)
        if np.linalg.norm(left) > 1e-3 * np.linalg.norm(both):
            pairs.append((first, second))
            rows.append(left / np.linalg.norm(left))
    return pairs, np.array(rows)


def _rarity(table: np.ndarray) -> np.ndarray:
    """-log10 of the probability of a share by chance, every row against the gamma distribution with
    the mean and variance of its null draws (columns from 1 on): what has one degree of freedom and
    what has thirty is then alike. A draw is judged by the others, as the data are by all: with
    itself among them it would look commoner than it is.
    """
    if not len(table):
        return table
    null = table[:, 1:]
    count = null.shape[1]
    sums, squares = null.sum(1, keepdims=True), (null**2).sum(1, keepdims=True)
    mean = np.hstack([sums / count, (sums - null) / (count - 1)])
    square = np.hstack([squares / count, (squares - null**2) / (count - 1)])
    variance = np.maximum(square - mean**2, 0.0) + 1e-24
    p = gammaincc(mean**2 / variance, table * mean / variance)
    return -np.log10(np.maximum(p, 1e-300))


def _by_share(table: np.ndarray) -> list[tuple[int, float]]:
    """Rows with their share beyond chance, largest first."""
    if not len(table):
        return []
    expected = table[:, 1:].mean(1)
    corrected = np.maximum((table[:, 0] - expected) / np.maximum(1.0 - expected, 1e-9), 0.0)
    return [(int(i), float(corrected[i])) for i in np.argsort(-corrected)]


def main_direction(vectors: np.ndarray, ways: str) -> str:
    """The one of three ways that carries more than 60 % of the squared length, or ``"mixed"``."""
    squares = (vectors**2).sum(0)
    if squares.sum() == 0:
        return "mixed"
    i = int(np.argmax(squares))
    return ways[i] if squares[i] > 0.6 * squares.sum() else "mixed"


def way(letter: str) -> str:
    """One of `Fit.ways` in words: ``"along X"``, ``"about X"``."""
    turn = "ABC".find(letter)
    return f"along {letter}" if turn < 0 else f"about {'XYZ'[turn]}"


def described(
    fit: Fit,
    tested: Fit,
    best: Rival,
    p_value: float,
    chi2_per_dof: float,
    alpha: float,
    draws: int,
    seed: int,
) -> Unexplained:
    """The description where the `best` empirical one explains more than every effect that was
    tried: by that or, where it leaves something and they describe clearly more, by a covariate
    or a product of two. `tested` is the fit with the noise to test by.
    """
    told = dependence(tested, draws, seed)
    local = _from_empirical(fit, best, p_value, told)
    spread = _from_dependence(fit, told, chi2_per_dof, alpha)
    if spread is None or dependence(best.fit, draws, seed).p_value > alpha:
        return local
    without, beyond = _beyond_noise(fit, best.fit)
    by_it = local.share_of_variance * max(beyond / without, 0.0)
    return spread if _best(spread) > _CLEARLY * by_it else local


def _best(what: Unexplained) -> float:
    return max([*what.shares, *(share for *_, share in what.products)], default=0.0)


def _beyond_noise(fit: Fit, described: Fit) -> tuple[float, float]:
    """Chi-square of a fit, and how much of it is beyond the noise: as declared, or as little as a
    description leaves. That of the fits themselves may be as large as all that is left.
    """
    without, left = declared_chi2(fit), declared_chi2(described)
    return without, without - fit.dof * min(1.0, left / described.dof)


def _from_empirical(fit: Fit, best: Rival, p_value: float, told: Dependence) -> Unexplained:
    effect = best.effect
    assert isinstance(effect, Empirical)
    plan, shape = fit.measurement.plan, best.fit.shapes.get(len(fit.model.effects), {})
    added = best.fit.model.places[-1]
    step = best.fit.jacobian[:, added] @ best.fit.theta[added]
    n, m = fit.residual.shape
    moved = np.zeros((n, m))
    used = fit.used
    moved[used] = np.linalg.solve(fit.whitener[used], step.reshape(n, m)[used][:, :, None])[:, :, 0]
    vectors = displacements(fit, moved)[used]
    words = effect.said(shape)
    shares = dict(told.single)
    depends_on = list(dict.fromkeys([*effect.depends_on(plan, shape), *shares]))
    without, beyond = _beyond_noise(fit, best.fit)
    drop = (without - declared_chi2(best.fit)) / max(beyond, without / fit.dof)
    return Unexplained(
        depends_on=depends_on,
        shares=[shares.get(name, 0.0) for name in depends_on],
        where=list(effect.intervals(plan, shape)),
        direction=main_direction(vectors, fit.ways),
        size_um=float(np.linalg.norm(vectors, axis=1).max() * 1e6),
        share_of_variance=float(min(drop, 1.0)),
        p_value=p_value,
        reason=f"{words} describes the residual better than every effect that was tried",
        words=words,
        empirical=best,
        products=tuple(told.products),
        joint=effect.joint,
        size_is="largest displacement of the tool point by the description",
        share_is="of χ² beyond the noise, what the description takes",
    )


def from_structure(
    fit: Fit,
    chi2_per_dof: float,
    alpha: float,
    draws: int,
    seed: int,
    correlated: Serial | None = None,
    refused: Refused | None = None,
    full: bool = False,
) -> Unexplained | None:
    """The description where the residual depends on covariates, is correlated in time, or is far
    larger than declared; or where an effect was significant and was `refused`. `full`: the search
    ended because no more effects may be added.
    """
    told = dependence(fit, draws, seed)
    return _from_dependence(fit, told, chi2_per_dof, alpha, correlated, refused, full)


def _from_dependence(
    fit: Fit,
    told: Dependence,
    chi2_per_dof: float,
    alpha: float,
    correlated: Serial | None = None,
    refused: Refused | None = None,
    full: bool = False,
) -> Unexplained | None:
    spread = chi2_per_dof > _SPREAD
    if spread and told.p_value > _BY_CHANCE:
        told = Dependence([], [], False, told.p_value)
    quiet = told.p_value > _LAST_LOOK * alpha and not spread and correlated is None
    if quiet and refused is None:
        return None
    shares = dict(told.single)
    if told.joint and not quiet:
        # A product shows in neither alone: both of it come first.
        first, second, _ = told.products[0]
        ahead = {name: shares.get(name, 0.0) for name in (first, second)}
        shares = ahead | {name: s for name, s in shares.items() if name not in ahead}
    if correlated is not None and not shares and fit.measurement.plan.has("t"):
        shares = {"t": 0.0}
    if quiet and refused is not None:
        # Nothing else is significant: neither a product nor what a column tells by itself.
        alone = {name: shares.get(name, 0.0) for name in refused.effect.betrayed_by}
        shares = alone | {name: s for name, s in shares.items() if name not in alone}
    best = max([*shares.values(), *(share for *_, share in told.products)], default=0.0)
    vectors = displacements(fit)[fit.used]
    excess = max(1.0 - 1.0 / chi2_per_dof, 0.0)
    size = math.sqrt((vectors**2).sum(1).mean() * (excess if spread else best))
    if correlated is not None:
        reason = (
            f"readings that follow each other are alike: {100 * correlated.share:.0f} % of the "
            f"scatter persists over some {correlated.length:.0f} readings, as noise that is "
            "correlated in time does, or a drift that no effect that was tried has"
        )
    elif quiet and refused is not None:
        reason = f"{refused.words} is significant, but {refused.reason}"
    elif spread and best < 0.1:
        reason = (
            "the residual is far larger than the declared noise, and no single covariate "
            "describes a tenth of it: spread"
        )
    elif spread:
        reason = "the residual is far larger than the declared noise and depends on covariates"
    else:
        reason = "the residual depends on covariates in a way that no effect that was tried has"
    words = ""
    if correlated is not None and correlated.share > _MOSTLY * best:
        words = _AS_NOISE
    elif quiet and refused is not None:
        words = f"what looks like {refused.words}, which is not certain"
    if full and refused is not None:
        reason = f"{refused.words} is significant, but no more effects may be added (max_effects)"
    elif full:
        reason = "no more effects may be added (max_effects), and none is significant in the rest"
    return Unexplained(
        depends_on=list(shares),
        shares=list(shares.values()),
        where=[],
        direction=main_direction(vectors, fit.ways),
        size_um=size * 1e6,
        share_of_variance=excess if spread else best,
        p_value=refused.p_value if quiet and refused is not None else told.p_value,
        reason=reason,
        words=words,
        products=tuple(told.products),
        joint=told.joint and not quiet,
        size_is=f"rms displacement of the tool point, {_BEYOND if spread else _BY_THE_BEST}",
        share_is=f"of the variance of the residual, {_BEYOND if spread else _BY_THE_BEST}",
    )
