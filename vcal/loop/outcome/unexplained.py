"""Unexplained residual: the covariates it depends on, its place, direction and size."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...effects.base import Effect
from ...identification.fit import Fit, declared_chi2
from ..empirical import Empirical, Interval
from ..residuals.autocorrelation import Serial
from ..residuals.dependence import Dependence, dependence, displacements
from ..weighing.rivals import Rival

_CLEARLY = 1.2
"""Ratio of the variance shares of a covariate and of an empirical description from which the
covariate is reported first. The description has the advantage of saying where."""
_AS_NOISE = "noise that is correlated in time, or a drift"
_MOSTLY = 2.0
"""Ratio of the share of variance that persists from reading to reading to that of the best
covariate, from which no covariate is reported alone. Every covariate that changes slowly describes
some of such noise."""
_SPREAD = 25.0
"""Chi-square per degree of freedom, against the declared noise, from which something must be
missing even if it depends on no recorded quantity, unless all kinds of reading scatter by the same
factor, as with a wrong declaration of the noise."""
_BY_CHANCE = 0.01
"""Probability from which a residual that is large for another reason depends on no covariate. The
best of all covariates always describes a little."""
_LAST_LOOK = 0.25
"""Share of alpha that the final test of the remainder may use, in addition to the search."""
_BEYOND = "the part beyond the declared noise"
_BY_THE_BEST = "the part that the best column or product describes"
"""What size and share refer to, where no description was found."""


@dataclass(frozen=True)
class Unexplained:
    """A residual that no effect that was tried explains."""

    depends_on: list[str]
    """Covariates, most important first."""
    shares: list[float]
    """Share of the residual's variance that each of them describes alone, corrected for chance."""
    where: list[Interval]
    direction: str
    """``"X"``, ``"Y"``, ``"Z"`` at the tool point, or ``"mixed"``; ``"A"``, ``"B"``, ``"C"`` where
    only angles were read."""
    size_um: float
    share_of_variance: float
    p_value: float
    reason: str
    words: str = ""
    """The empirical description, or correlated noise, in words; empty where there is none."""
    empirical: Rival | None = None
    """The empirical description, where there is one."""
    products: tuple[tuple[str, str, float], ...] = ()
    """Pairs of covariates whose product describes some of it, with its share, largest first."""
    joint: bool = False
    """Whether it depends first of all on the product of two covariates."""
    size_is: str = ""
    """Definition of `size_um`, in words."""
    share_is: str = ""
    """What `share_of_variance` is a share of, in words."""


@dataclass(frozen=True)
class Refused:
    """An effect, or a description, that was significant in the last round and was rejected."""

    effect: Effect
    p_value: float
    """Corrected for the search."""
    reason: str

    @property
    def words(self) -> str:
        """Its name within a sentence."""
        return self.effect.words if isinstance(self.effect, Empirical) else self.effect.key


def main_direction(vectors: np.ndarray, ways: str) -> str:
    """The one of three directions with more than 60 % of the squared length, or ``"mixed"``."""
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
    """The residual described by the `best` empirical description, where that explains more than
    every effect that was tried.

    Where the description leaves a significant rest, and a covariate or a product of two describes
    clearly more, these are reported instead. `tested` is the fit with the noise to test by.
    """
    structure = dependence(tested, draws, seed)
    local = _from_empirical(fit, best, p_value, structure)
    spread = _from_dependence(fit, structure, chi2_per_dof, alpha)
    if spread is None or dependence(best.fit, draws, seed).p_value > alpha:
        return local
    without, beyond = _beyond_noise(fit, best.fit)
    by_it = local.share_of_variance * max(beyond / without, 0.0)
    return spread if _best(spread) > _CLEARLY * by_it else local


def _best(what: Unexplained) -> float:
    return max([*what.shares, *(share for *_, share in what.products)], default=0.0)


def _beyond_noise(fit: Fit, described: Fit) -> tuple[float, float]:
    """Chi-square of a fit, and the part of it beyond the noise.

    The noise is the declared one, or less where the description leaves less. The estimated noise of
    the fits may be as large as the whole residual.
    """
    without, left = declared_chi2(fit), declared_chi2(described)
    return without, without - fit.dof * min(1.0, left / described.dof)


def _from_empirical(fit: Fit, best: Rival, p_value: float, structure: Dependence) -> Unexplained:
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
    shares = dict(structure.single)
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
        products=tuple(structure.products),
        joint=effect.joint,
        size_is="largest displacement of the tool point by the description",
        share_is="of χ² beyond the noise, the part that the description explains",
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
    as_noise: bool = False,
) -> Unexplained | None:
    """The unexplained residual of a final fit; None where there is none.

    There is one where the residual depends on covariates, is correlated in time, or is far larger
    than declared; or where an effect was significant and was `refused`. `full`: the search ended
    because no more effects may be added. `as_noise`: the kinds of reading scatter in the declared
    ratios (`vcal.loop.search.state.evenly_scattered`), so that a residual that is only larger than
    declared is noise whose declaration is wrong.
    """
    structure = dependence(fit, draws, seed)
    if as_noise:
        chi2_per_dof = min(chi2_per_dof, _SPREAD)
    return _from_dependence(fit, structure, chi2_per_dof, alpha, correlated, refused, full)


def _from_dependence(
    fit: Fit,
    structure: Dependence,
    chi2_per_dof: float,
    alpha: float,
    correlated: Serial | None = None,
    refused: Refused | None = None,
    full: bool = False,
) -> Unexplained | None:
    spread = chi2_per_dof > _SPREAD
    if spread and structure.p_value > _BY_CHANCE:
        structure = Dependence([], [], False, structure.p_value)
    quiet = structure.p_value > _LAST_LOOK * alpha and not spread and correlated is None
    if quiet and refused is None:
        return None
    shares = dict(structure.single)
    if structure.joint and not quiet:
        # A product shows in neither covariate alone, so both are listed first.
        first, second, _ = structure.products[0]
        shares = _ahead(shares, (first, second))
    if correlated is not None and not shares and fit.measurement.plan.has("t"):
        shares = {"t": 0.0}
    only = refused if quiet else None
    if only is not None:
        # Nothing else is significant: neither a product nor a single column.
        shares = _ahead(shares, only.effect.indicators)
    best = max([*shares.values(), *(share for *_, share in structure.products)], default=0.0)
    vectors = displacements(fit)[fit.used]
    excess = max(1.0 - 1.0 / chi2_per_dof, 0.0)
    size = math.sqrt((vectors**2).sum(1).mean() * (excess if spread else best))
    words = ""
    if correlated is not None and correlated.share > _MOSTLY * best:
        words = _AS_NOISE
    elif only is not None:
        words = f"what looks like {only.words}, which is not certain"
    if full and refused is not None:
        reason = f"{refused.words} is significant, but no more effects may be added (max_effects)"
    elif full:
        reason = "no more effects may be added (max_effects), and none is significant in the rest"
    else:
        reason = _reason(spread, best, correlated, only)
    return Unexplained(
        depends_on=list(shares),
        shares=list(shares.values()),
        where=[],
        direction=main_direction(vectors, fit.ways),
        size_um=size * 1e6,
        share_of_variance=excess if spread else best,
        p_value=only.p_value if only is not None else structure.p_value,
        reason=reason,
        words=words,
        products=tuple(structure.products),
        joint=structure.joint and not quiet,
        size_is=f"rms displacement of the tool point, {_BEYOND if spread else _BY_THE_BEST}",
        share_is=f"of the variance of the residual, {_BEYOND if spread else _BY_THE_BEST}",
    )


def _ahead(shares: dict[str, float], names: Iterable[str]) -> dict[str, float]:
    """The shares, with those of the given covariates first."""
    ahead = {name: shares.get(name, 0.0) for name in names}
    return ahead | {name: s for name, s in shares.items() if name not in ahead}


def _reason(spread: bool, best: float, correlated: Serial | None, only: Refused | None) -> str:
    """Why something is unexplained, where further effects may be added. `only`: an effect that was
    refused where nothing else is significant.
    """
    if correlated is not None:
        return (
            f"successive readings are correlated: {100 * correlated.share:.0f} % of the scatter "
            f"persists over about {correlated.length:.0f} readings, as with noise that is "
            "correlated in time, or with a drift that none of the effects tried describes"
        )
    if only is not None:
        return f"{only.words} is significant, but {only.reason}"
    if spread and best < 0.1:
        return (
            "the residual is far larger than the declared noise, and no single covariate "
            "describes a tenth of it"
        )
    if spread:
        return "the residual is far larger than the declared noise and depends on covariates"
    return "the residual depends on covariates in a way that none of the effects tried describes"
