"""The smallest size of every effect that a measurement would have named.

That nothing was found says little where nothing could be found. For an effect of size a in one of
its amplitudes, the score vector of any candidate is normal: with the whitened columns C of the
candidate, the column c of that amplitude, and <U, V> = U'V - U'J H^-1 J'V (`screening.score_test`),
it has the expectation a <C, c> and the covariance <C, C>. Significance and log evidence of the
effect and of its rivals follow from draws of these vectors, by the formulas of screening and
weighing, without a fit. The limit is the size from which the effect is named in 95 % of the draws.

Rivals are of three sorts. Those that explain a large share of the effect are evaluated at every
size. Those that explain a small share are evaluated once, at about the size of the limit. Others
gain by chance alone, and the best of them are weighed.

The model is linear in this, the noise is that of the fit, and the test on held-out readings is left
out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammainccinv

from ..effects.base import Effect
from ..effects.reference import with_known_reference
from ..identification.fit import Fit
from ..machine.parameters import Parameter
from ..numerics.eigen import eigh
from .screening.candidates import candidates
from .screening.score_test import ScoreTest, Tested
from .screening.screening import Screening
from .screening.size_evidence import mixture_terms
from .screening.spanned import Spanned, spanned
from .search.certainty import odds_of_kinds
from .weighing.weighing import CERTAIN, DISTINGUISHABLE

PROBABILITY = 0.95
"""Probability with which an effect of the limit's size is named."""
_OF_DRAWS = 0.98
"""Share of the draws in which it is named: the refits, the descriptions and the held-out readings
that they leave out cost some names."""
_STEPS = 16
"""Most steps of a grid that are compared, and their neighbours."""
_BESIDE = (1, 2, 4)
"""Distances, in steps of the grid, of the neighbours of the step at which the limit holds."""
_ROOM = 2**27
"""Most numbers in the columns of all candidates."""
_RIVALS, _ALIKE = 6, 0.3
"""Most rivals of an effect that are evaluated at every size, and the least share of its chi-square
that they explain ..."""
_FAINT_RIVALS, _FAINTLY = 40, 0.02
"""... and the same for those that are evaluated once."""
_DRAWS = 100
_WEIGHED = 10
"""Most names that are weighed because of what they gain by chance (`search.round.shortlist`)."""
_GROWTH, _LAST = 1.6, 64.0
"""Ratio of the sizes that are searched, and the largest, in units of that whose expected chi-square
is the significant one."""
_BEYOND = 2
"""Number of larger sizes that must be named too."""
_HALVINGS = 4
_CHUNK = 256
"""Steps that are evaluated together."""
_MOST_LOG = 600.0
"""Largest logarithm of odds that is distinguished."""
_RESOLVED = 1e-8
"""Least eigenvalue of an information matrix, in units of its largest."""


@dataclass(frozen=True)
class SmallestSize:
    """The smallest size of one amplitude of an effect that this measurement names."""

    effect: Effect
    amplitude: Parameter
    size: float
    """In the unit of the amplitude; infinite where no size is named, because rivals explain the
    same."""
    shape: Mapping[str, float]
    """Shape parameters (SI) at which it holds: those of median sensitivity."""
    rivals: tuple[str, ...]
    """Effects that explain a large share of the same, the largest first."""


@dataclass(frozen=True)
class Detectable:
    """What a measurement could have shown."""

    limits: list[SmallestSize]
    spanned: list[Spanned]
    """Effects of which no size can be seen on this plan."""


def detectable(
    fit: Fit, classes: Iterable[type[Effect]], screening: Screening, *, alpha: float, seed: int
) -> Detectable:
    """The smallest sizes of all effects of these classes beside the model of a fit.

    `screening` is that of the model of the fit, or of one with an effect less: it has the numbers
    of trials for which the p-value, of at most `alpha`, is corrected. Kinds of effects that it does
    not have are left out.
    """
    known = {kind.kind for kind in screening.kinds}
    tried, _ = candidates(fit.model, fit.measurement, classes, fit=fit)
    state = ScoreTest(fit, _DRAWS, seed)
    every = state.tests(tried)
    tested = [one for one in every if one is not None and one.effect.name in known]
    limits = _smallest_sizes(_Steps(state, tested, screening), screening, alpha)
    return Detectable(limits, spanned(state, tried, every))


def _smallest_sizes(steps: "_Steps", screening: Screening, alpha: float) -> list[SmallestSize]:
    """The smallest sizes of all candidates, one for each amplitude."""
    targets = [
        (at, k, amplitude)
        for at in steps.median
        if with_known_reference(effect := steps.effect(at)) is effect
        for k, amplitude in enumerate(effect.amplitudes)
        if not amplitude.known and steps.roots[at, k].any()
    ]
    across = steps.inner(slice(None), [steps.places[at, k] for at, k, _ in targets])
    found = []
    for (at, k, amplitude), beside in zip(targets, across.T, strict=True):
        needed = _significant(steps, at, screening, alpha)
        outcomes = _Outcomes(steps, at, k, beside, needed)
        found.append(
            SmallestSize(
                effect=steps.effect(at),
                amplitude=amplitude,
                size=outcomes.smallest() * amplitude.step / amplitude.si,
                shape=steps.shape(at),
                rivals=outcomes.rivals,
            )
        )
    return found


class _Steps:
    """Whitened columns of all candidates at some steps of their grids, and what each step gains by
    chance.

    Arrays have one row per step, and zeros beyond the amplitudes and the rank of each.
    """

    def __init__(self, state: ScoreTest, tested: Sequence[Tested], screening: Screening):
        self.dof, self._tested = state.dof, tested
        n = state.residual.size
        amplitudes = [len(one.effect.amplitudes) for one in tested]
        most = max(1, min(_STEPS, _ROOM // max(n * sum(amplitudes), 1)))
        self.median: list[int] = []
        """The step of every candidate at which its limit holds."""
        self._at: list[int] = []
        self._member: list[int] = []
        weights, blocks = [], []
        for member, one in enumerate(tested):
            middle, chosen = _by_sensitivity(one, most)
            self.median.append(len(self._at) + list(chosen).index(middle))
            for i, weight in chosen.items():
                self._at.append(i)
                self._member.append(member)
                weights.append(math.log(weight / len(one.scan.mesh)))
                blocks.append(state.columns(one.effect, _shape(one, i)))
        self.log_weights = np.array(weights)
        """Log of the share of its grid that a step stands for."""
        self.member = np.array(self._member, int)
        counts = np.bincount(self.member, minlength=len(tested))
        ends = np.cumsum(counts)
        place = np.arange(counts.max(initial=0))
        self.along_grid = np.minimum((ends - counts)[:, None] + place, ends[:, None] - 1)
        """The steps of every candidate, the last one repeated (candidates, steps)."""
        self.repeated = place >= counts[:, None]
        self.keys = np.array([tested[member].effect.key for member in self._member])
        self.nothing = odds_of_kinds(screening)
        """Prior odds that nothing more is missing."""
        self.log_prior = np.array([_log_prior(one.effect, screening) for one in tested])
        self.parameters = np.array(
            [len(with_known_reference(one.effect).parameters) for one in tested]
        )
        """Number of parameters of every candidate, without the constant part of a free reference
        value."""
        self._columns = np.concatenate([np.zeros((n, 0)), *blocks], 1)
        self._half = state.whitening.T @ (state.fit.jacobian.T @ self._columns)
        count, widest = len(self._at), max(amplitudes, default=1)
        self.places = np.zeros((count, widest), int)
        self.roots, self._vectors = np.zeros((2, count, widest, widest))
        eigenvalues = np.zeros((count, widest))
        self._used = np.zeros((count, widest), bool)
        first = 0
        for at, (i, member) in enumerate(zip(self._at, self._member, strict=True)):
            information, c = tested[member].drops.information[i], amplitudes[member]
            root = _root(information)
            values, vectors = eigh(information)
            self.roots[at, :c, : root.shape[1]] = root
            eigenvalues[at, :c], self._vectors[at, :c, :c] = np.maximum(values, 0.0), vectors
            self.places[at, :c] = np.arange(first, first + c)
            self._used[at, :c] = True
            first += c
        self._factors, self._constants = mixture_terms(eigenvalues)
        noise = self._columns.T @ state.null.reshape(n, -1)
        self.noise_along = self._turned(self._vectors, noise)
        self.noise_drops = self._turned(self.roots, noise)
        gains = np.concatenate(
            [
                self._gain(slice(i, i + _CHUNK), self.noise_along[i : i + _CHUNK],
                           self.noise_drops[i : i + _CHUNK])
                for i in range(0, count, _CHUNK)
            ] or [np.zeros((0, noise.shape[1]))]
        )  # fmt: skip
        gains += (self.log_weights + self.log_prior[self.member])[:, None]
        self.names, of = np.unique(self.keys, return_inverse=True)
        self.by_chance = np.zeros((len(self.names), noise.shape[1]))
        """Odds of every name where nothing is missing (names, draws)."""
        np.add.at(self.by_chance, of, np.exp(np.minimum(gains, _MOST_LOG)))

    def _turned(self, by: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """B'v at every step, for v of all columns (columns, draws), as (steps, draws, b)."""
        return np.einsum("sab,sad->sdb", by, columns[self.places] * self._used[:, :, None])

    def turned(self, at: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scores of some steps along the directions of their information, and in units of their
        noise, for numbers of all columns, as (steps, b) each.
        """
        mean = across[self.places[at]] * self._used[at]
        return (
            np.einsum("sab,sa->sb", self._vectors[at], mean),
            np.einsum("sab,sa->sb", self.roots[at], mean),
        )

    def inner(self, a, b) -> np.ndarray:
        """<A, B> of some columns."""
        return self._columns[:, a].T @ self._columns[:, b] - self._half[:, a].T @ self._half[:, b]

    def _gain(self, at, along: np.ndarray, drops: np.ndarray) -> np.ndarray:
        """Gain in log evidence (steps, draws); half the drop of chi-square at most."""
        each = along**2 @ self._factors[at] + self._constants[at, None, :]
        most = each.max(-1)
        gain = most + np.log(np.exp(each - most[..., None]).sum(-1))
        return np.minimum(gain, 0.5 * np.einsum("sdb,sdb->sd", drops, drops))

    def gain(
        self, at: np.ndarray, size: float, mean: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gain in log evidence and drop of chi-square at some steps (steps, draws), for an effect
        of that size; `mean` is `turned` for a size of one.
        """
        along = size * mean[0][:, None, :] + self.noise_along[at]
        drops = size * mean[1][:, None, :] + self.noise_drops[at]
        return self._gain(at, along, drops), np.einsum("sdb,sdb->sd", drops, drops)

    def explained(self, across: np.ndarray) -> np.ndarray:
        """Chi-square of a column that every step explains; `across` is <C, c> of all columns."""
        _, scores = self.turned(np.arange(len(self._at)), across)
        return np.einsum("sr,sr->s", scores, scores)

    def effect(self, at: int) -> Effect:
        """The effect of a step."""
        return self._tested[self._member[at]].effect

    def shape(self, at: int) -> dict[str, float]:
        """Shape parameters of a step, SI."""
        return _shape(self._tested[self._member[at]], self._at[at])


class _Outcomes:
    """Draws of the scores of an effect and of its rivals.

    The effect is amplitude `k` of the step `own`, `across` is <C, c> of all columns with its own,
    and `needed` is the drop of chi-square that is significant.
    """

    def __init__(self, steps: _Steps, own: int, k: int, across: np.ndarray, needed: float):
        self._steps, self._needed, self._across = steps, needed, across
        self._whole = float(across[steps.places[own, k]])
        self._explained = steps.explained(across)
        strong, faint = self._nearest(steps.keys[own])
        self.rivals = tuple(str(steps.keys[at]) for at in strong)
        self._strong = np.array([own, *strong])
        self._faint = np.array(faint, int)
        self._mean = steps.turned(self._strong, across)
        alike = steps.parameters[steps.member]
        self._left = np.where(
            alike[self._strong] == alike[own], self._whole - self._explained[self._strong], math.inf
        )
        apart = np.isin(steps.names, steps.keys[[*self._strong, *faint]])
        by_chance = np.sort(steps.by_chance[~apart], axis=0)
        self._others = by_chance[-_WEIGHED:].sum(0) + steps.nothing
        """Odds of those that are evaluated once, or by chance, and of no further effect (draws)."""

    def _nearest(self, own: str) -> tuple[list[int], list[int]]:
        """The steps that explain most, the best of every other name: those that are evaluated at
        every size, and those that are evaluated once.
        """
        strong: dict[str, int] = {}
        faint: dict[str, int] = {}
        shares = self._explained / self._whole
        for at in np.argsort(-shares, kind="stable"):
            key = str(self._steps.keys[at])
            if shares[at] < _FAINTLY or len(faint) == _FAINT_RIVALS:
                break
            if key == own or key in strong or key in faint:
                continue
            some = shares[at] >= _ALIKE and len(strong) < _RIVALS
            (strong if some else faint)[key] = int(at)
        return list(strong.values()), list(faint.values())

    def smallest(self) -> float:
        """The smallest size, in solver units, that is named often enough; infinite without one."""
        size = self._search(math.sqrt(self._needed / self._whole))
        if math.isinf(size) or not len(self._faint):
            return size
        odds, _ = self._odds(self._faint, size, self._steps.turned(self._faint, self._across))
        self._others = self._others + np.exp(np.minimum(odds, _MOST_LOG)).sum(0)
        return size if self._named(size) >= _OF_DRAWS else self._search(size)

    def _search(self, first: float) -> float:
        """The smallest size from `first` on from which the share that is named stays large enough.

        A rival that the readings cannot distinguish is named with the effect. Where they begin to
        distinguish it, a larger size may have no certain name.
        """
        beyond = _BEYOND if np.isfinite(self._left[1:]).any() else 0
        found: list[tuple[float, float]] = []
        low, below = 0.0, 0.0
        for size in first * _GROWTH ** np.arange(math.ceil(math.log(_LAST, _GROWTH)) + beyond):
            share = self._named(size)
            if share >= _OF_DRAWS:
                found.append((size, share))
            else:
                found, low, below = [], size, share
            if len(found) > beyond:
                break
        if len(found) <= beyond:
            return math.inf
        high, above = found[0]
        if low == 0.0:
            return high
        low, high = math.log(low), math.log(high)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            share = self._named(math.exp(middle))
            if share >= _OF_DRAWS:
                high, above = middle, share
            else:
                low, below = middle, share
        return math.exp(low + (high - low) * (_OF_DRAWS - below) / (above - below))

    def _named(self, size: float) -> float:
        """Share of the draws in which an effect of that size, in solver units, is named."""
        odds, drops = self._odds(self._strong, size, self._mean)
        # A rival that the readings cannot distinguish is named with it.
        close = np.abs(drops[1:] - drops[0]) < DISTINGUISHABLE
        close &= (size**2 * self._left[1:] < DISTINGUISHABLE)[:, None]
        rivals = np.where(close, -np.inf, odds[1:])
        against = np.exp(np.minimum(rivals - odds[0], _MOST_LOG)).sum(0)
        against += self._others * np.exp(np.minimum(-odds[0], _MOST_LOG))
        likely = against <= 1.0 / CERTAIN - 1.0
        gained = odds[0] > self._steps.log_prior[self._steps.member[self._strong[0]]]
        return float(np.mean(likely & (drops[0] >= self._needed) & gained))

    def _odds(
        self, at: np.ndarray, size: float, mean: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log of the odds, and drop of chi-square (steps, draws), for an effect of that size."""
        gain, drop = self._steps.gain(at, size, mean)
        member = self._steps.member[at]
        # The share of the grid that explains as much as each of these steps.
        grid = self._steps.along_grid[member]
        more = 0.5 * size**2 * (self._explained[grid] - self._explained[at][:, None])
        more = np.where(self._steps.repeated[member], -np.inf, more + self._steps.log_weights[grid])
        share = np.logaddexp.reduce(more, axis=1) + self._steps.log_prior[member]
        return gain + share[:, None], drop


def _log_prior(effect: Effect, screening: Screening) -> float:
    kind = next(kind for kind in screening.kinds if kind.kind == effect.name)
    return math.log(effect.odds / kind.instances)


def _significant(steps: _Steps, at: int, screening: Screening, alpha: float) -> float:
    """The drop of chi-square whose p-value, corrected for the search, is alpha.

    The studentised drop is -n ln(1 - share), as `significance.minus_log_beta_tail` has it for many
    readings n.
    """
    kind = next(kind for kind in screening.kinds if kind.kind == steps.effect(at).name)
    over_kinds = -math.expm1(math.log1p(-alpha) / screening.trials)
    alone = -math.expm1(math.log1p(-over_kinds) / kind.trials)
    rank = np.count_nonzero(steps.roots[at].any(0))
    return float(steps.dof * math.expm1(2.0 * gammainccinv(0.5 * rank, alone) / steps.dof))


def _by_sensitivity(one: Tested, most: int) -> tuple[int, dict[int, float]]:
    """The step of median sensitivity, and the steps that are compared with the number of steps for
    which each stands: at most `most` that the readings show, evenly spread over their order by
    information, and the neighbours of the median in the grid.
    """
    seen = np.flatnonzero(one.drops.rank > 0)
    along = np.einsum("gaa->g", one.drops.information[seen])
    order = seen[np.argsort(along, kind="stable")]
    middle = int(order[len(order) // 2])
    count = min(most, len(order))
    spread = {int(order[int(i)]) for i in np.linspace(0, len(order) - 1, count)}
    near = {middle} | (_neighbours(one, middle) if count > 1 else set()) & set(seen.tolist())
    far = spread - near
    if not far and len(order) > len(near):
        return middle, dict.fromkeys(near, len(order) / len(near))
    weight = (len(order) - len(near)) / max(len(far), 1)
    return middle, dict.fromkeys(near, 1.0) | dict.fromkeys(far, weight)


def _neighbours(one: Tested, step: int) -> set[int]:
    """Steps beside one, along every shape parameter of a grid."""
    lengths = one.scan.lengths
    place = np.unravel_index(step, lengths)
    found = set()
    for axis, length in enumerate(lengths):
        for by in (sign * away for away in _BESIDE for sign in (-1, 1)):
            at = list(place)
            at[axis] += by
            if 0 <= at[axis] < length:
                found.add(int(np.ravel_multi_index(at, lengths)))
    return found


def _shape(one: Tested, step: int) -> dict[str, float]:
    return {name: float(v) for name, v in zip(one.scan.names, one.scan.mesh[step], strict=True)}


def _root(information: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = eigh(information / np.outer(scale, scale))
    kept = values > _RESOLVED * max(float(values[-1]), 1e-300)
    return vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
