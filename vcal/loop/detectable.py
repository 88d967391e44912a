"""The smallest size of every effect that a measurement would have named.

That nothing was found says little where nothing could be found. For an effect of size a in one of
its amplitudes, the score vector of any candidate is normal: with the whitened columns C of the
candidate, the column c of that amplitude, and <U, V> = U'V - U'J H^-1 J'V (`screening.score_test`),
it has the expectation a <C, c> and the covariance <C, C>. Significance and log evidence of the
effect and of its nearest rivals follow from draws of these vectors, by the formulas of screening
and weighing, without a fit. The limit is the size from which the effect is named in 95 % of the
draws.

The model is linear in this, the noise is that of the fit, and the test on held-out readings is left
out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammainccinv

from ..effects.base import Effect
from ..effects.reference import with_known_reference
from ..identification.fit import Fit
from ..machine.parameters import Parameter
from .screening.candidates import candidates
from .screening.score_test import ScoreTest, Tested
from .screening.screening import Screening
from .screening.size_evidence import log_mixture
from .screening.spanned import Spanned, spanned
from .weighing.weighing import CERTAIN, DISTINGUISHABLE

PROBABILITY = 0.95
"""Probability with which an effect of the limit's size is named."""
_STEPS = 16
"""Most steps of a grid that are compared."""
_ROOM = 2**27
"""Most numbers in the columns of all candidates."""
_RIVALS, _ALIKE = 6, 0.3
"""Most rivals of an effect, and the least share of its chi-square that a rival explains."""
_FIRST, _LAST = 0.5, 64.0
"""Sizes that are searched, in units of that whose expected chi-square is the significant one."""
_HALVINGS = 5
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
    state = ScoreTest(fit, 1, seed)
    every = state.tests(tried)
    tested = [one for one in every if one is not None and one.effect.name in known]
    limits = smallest_sizes(state, screening, tested, alpha=alpha, seed=seed)
    return Detectable(limits, spanned(state, tried, every))


class _Step(NamedTuple):
    """One candidate at one step of its grid."""

    member: int
    """Its place among the candidates."""
    step: int
    """Its place in the grid."""
    columns: slice


def smallest_sizes(
    state: ScoreTest,
    screening: Screening,
    tested: Sequence[Tested],
    *,
    alpha: float,
    seed: int,
    draws: int = 100,
) -> list[SmallestSize]:
    """The smallest sizes of all candidates that the model does not span (`ScoreTest.tests`), one
    for each amplitude, in the order of `tested`.

    `screening` has the numbers of trials for which the p-value is corrected, of at most `alpha`.
    `draws` score vectors are drawn from `seed`, the same for every size.
    """
    columns = _Columns(state, tested)
    widest = max((len(one.effect.amplitudes) for one in tested), default=1)
    normal = np.random.default_rng(seed).standard_normal((widest * (_RIVALS + 1), draws))
    targets = [
        (step, k, amplitude)
        for one, step in zip(tested, columns.median, strict=True)
        if with_known_reference(one.effect) is one.effect
        for k, amplitude in enumerate(one.effect.amplitudes)
        if not amplitude.known and columns.root(step)[k].any()
    ]
    places = np.array([step.columns.start + k for step, k, _ in targets], int)
    across = columns.inner(slice(None), places)
    found = []
    for (step, _, amplitude), place, beside in zip(targets, places, across.T, strict=True):
        outcomes = _Outcomes(columns, screening, step, beside, float(beside[place]), alpha, normal)
        found.append(
            SmallestSize(
                effect=tested[step.member].effect,
                amplitude=amplitude,
                size=outcomes.smallest() * amplitude.step / amplitude.si,
                shape=columns.shape(step),
                rivals=outcomes.rivals,
            )
        )
    return found


class _Columns:
    """Whitened columns of all candidates at some steps of their grids."""

    def __init__(self, state: ScoreTest, tested: Sequence[Tested]):
        self.state, self.tested = state, tested
        n = state.residual.size
        amplitudes = [len(one.effect.amplitudes) for one in tested]
        most = max(1, min(_STEPS, _ROOM // max(n * sum(amplitudes), 1)))
        self.steps: list[_Step] = []
        self.median: list[_Step] = []
        self.of: list[slice] = []
        """Places in `steps` of every candidate."""
        blocks, first = [np.zeros((n, 0))], 0
        for member, one in enumerate(tested):
            begin, chosen = len(self.steps), _by_sensitivity(one, most)
            for i in chosen:
                block = state.columns(one.effect, _shape(one, i))
                self.steps.append(_Step(member, i, slice(first, first + block.shape[1])))
                blocks.append(block)
                first += block.shape[1]
            self.of.append(slice(begin, len(self.steps)))
            self.median.append(self.steps[begin + len(chosen) // 2])
        self._columns = np.concatenate(blocks, 1)
        self._half = state.whitening.T @ (state.fit.jacobian.T @ self._columns)
        # Roots of all steps as one array, with zeros beyond the amplitudes and the rank of each.
        widest = max(amplitudes, default=1)
        self._roots = np.zeros((len(self.steps), widest, widest))
        self._places = np.zeros((len(self.steps), widest), int)
        for at, (step, root) in enumerate(zip(self.steps, map(self.root, self.steps), strict=True)):
            self._roots[at, : root.shape[0], : root.shape[1]] = root
            self._places[at, : root.shape[0]] = np.arange(step.columns.start, step.columns.stop)
        self.keys = np.array([tested[step.member].effect.key for step in self.steps])

    def inner(self, a: slice | np.ndarray, b: slice | np.ndarray) -> np.ndarray:
        """<A, B> of some columns."""
        return self._columns[:, a].T @ self._columns[:, b] - self._half[:, a].T @ self._half[:, b]

    def root(self, step: _Step) -> np.ndarray:
        """R (amplitudes, rank) with R R' the inverse of the information."""
        return _root(self.information(step))

    def information(self, step: _Step) -> np.ndarray:
        """<C, C>."""
        return self.tested[step.member].drops.information[step.step]

    def explained(self, across: np.ndarray) -> np.ndarray:
        """Chi-square of a column that every step explains; `across` is <C, c> of all columns."""
        scores = np.einsum("sar,sa->sr", self._roots, across[self._places])
        return np.einsum("sr,sr->s", scores, scores)

    def shape(self, step: _Step) -> dict[str, float]:
        """Shape parameters, SI."""
        return _shape(self.tested[step.member], step.step)

    def parameters(self, step: _Step) -> int:
        """Number of parameters without the constant part of a free reference value."""
        return len(with_known_reference(self.tested[step.member].effect).parameters)


class _Outcomes:
    """Draws of the scores of an effect and of its nearest rivals.

    `across` is <C, c> of all columns with that of the effect, and `whole` is <c, c>.
    """

    def __init__(
        self,
        columns: _Columns,
        screening: Screening,
        own: _Step,
        across: np.ndarray,
        whole: float,
        alpha: float,
        normal: np.ndarray,
    ):
        explained = columns.explained(across)
        self._whole = whole
        key = columns.tested[own.member].effect.key
        rivals = _nearest(columns.keys, explained / self._whole, key)
        self.rivals = tuple(str(columns.keys[at]) for at in rivals)
        steps = [own, *(columns.steps[at] for at in rivals)]
        every = np.concatenate([np.arange(s.columns.start, s.columns.stop) for s in steps])
        values, vectors = np.linalg.eigh(columns.inner(every, every))
        noise = (vectors * np.sqrt(np.maximum(values, 0.0))) @ normal[: len(every)]
        mean, first = across[every], 0
        self._each = []
        for step, at in zip(steps, [columns.steps.index(own), *rivals], strict=True):
            part = slice(first, first + step.columns.stop - step.columns.start)
            first = part.stop
            grid = explained[columns.of[step.member]] - explained[at]
            prior = _log_prior(columns.tested[step.member].effect, screening)
            alike = columns.parameters(step) == columns.parameters(own)
            left = self._whole - explained[at] if alike else math.inf
            self._each.append(
                _Explanation(mean[part], noise[part], columns.information(step),
                             columns.root(step), prior, grid, left)
            )  # fmt: skip
        self._needed = _significant(columns, own, screening, alpha)

    def smallest(self) -> float:
        """The smallest size, in solver units, that is named often enough; infinite where none is.

        The share that is named grows with the size, up to the scatter of the draws.
        """
        unit = math.sqrt(self._needed / self._whole)
        low, high = math.log(_FIRST * unit), math.log(_LAST * unit)
        if self.named(math.exp(high)) < PROBABILITY:
            return math.inf
        below, above = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            share = self.named(math.exp(middle))
            if share >= PROBABILITY:
                high, above = middle, share
            else:
                low, below = middle, share
        return math.exp(low + (high - low) * (PROBABILITY - below) / (above - below))

    def named(self, size: float) -> float:
        """Share of the draws in which an effect of that size, in solver units, is named."""
        own, *rivals = self._each
        weight, drop = own.weighed(size)
        others = []
        for rival in rivals:
            its, explained = rival.weighed(size)
            # A rival that the readings cannot distinguish is named with it.
            same = size**2 * rival.left < DISTINGUISHABLE
            close = same & (np.abs(explained - drop) < DISTINGUISHABLE)
            others.append(np.where(close, -np.inf, its))
        against = sum((np.exp(np.minimum(one - weight, 700.0)) for one in others), np.zeros(1))
        likely = against <= 1.0 / CERTAIN - 1.0
        return float(np.mean(likely & (drop >= self._needed) & (weight > own.prior)))


class _Explanation:
    """One candidate as an explanation of an effect: scores for a size of one, and their noise."""

    def __init__(
        self,
        mean: np.ndarray,
        noise: np.ndarray,
        information: np.ndarray,
        root: np.ndarray,
        prior: float,
        grid: np.ndarray,
        left: float,
    ):
        self.prior, self.left = prior, left
        """Log of the prior odds; chi-square that it leaves of the effect, infinite where it has
        another number of parameters."""
        self._grid = grid
        values, vectors = np.linalg.eigh(information)
        self._values = np.maximum(values, 0.0)[None, :]
        self._along = vectors.T @ mean, (vectors.T @ noise).T
        self._drops = root.T @ mean, (root.T @ noise).T

    def weighed(self, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Log of the odds (draws), and drop of chi-square, for an effect of that size."""
        drop = ((size * self._drops[0] + self._drops[1]) ** 2).sum(1)
        gain = log_mixture(self._values, size * self._along[0] + self._along[1])
        gains = 0.5 * size**2 * self._grid
        # The share of the grid that explains as much as this step.
        share = float(np.logaddexp.reduce(gains)) - math.log(len(gains))
        return np.minimum(gain, 0.5 * drop) + self.prior + share, drop


def _nearest(keys: np.ndarray, shares: np.ndarray, own: str) -> list[int]:
    """The steps that explain the largest shares, the best of every other effect, largest first."""
    found: dict[str, int] = {}
    for at in np.argsort(-shares, kind="stable"):
        if shares[at] < _ALIKE or len(found) == _RIVALS:
            break
        if keys[at] != own:
            found.setdefault(str(keys[at]), int(at))
    return list(found.values())


def _log_prior(effect: Effect, screening: Screening) -> float:
    kind = next(kind for kind in screening.kinds if kind.kind == effect.name)
    return math.log(effect.odds / kind.instances)


def _significant(columns: _Columns, step: _Step, screening: Screening, alpha: float) -> float:
    """The drop of chi-square whose p-value, corrected for the search, is alpha.

    The studentised drop is -n ln(1 - share), as `significance.minus_log_beta_tail` has it for many
    readings n.
    """
    effect = columns.tested[step.member].effect
    kind = next(kind for kind in screening.kinds if kind.kind == effect.name)
    over_kinds = -math.expm1(math.log1p(-alpha) / screening.trials)
    alone = -math.expm1(math.log1p(-over_kinds) / kind.trials)
    rank, dof = columns.root(step).shape[1], columns.state.dof
    return float(dof * math.expm1(2.0 * gammainccinv(0.5 * rank, alone) / dof))


def _by_sensitivity(one: Tested, most: int) -> list[int]:
    """At most so many steps of a grid that the readings show, evenly spread over their order by
    information.
    """
    seen = np.flatnonzero(one.drops.rank > 0)
    along = np.einsum("gaa->g", one.drops.information[seen])
    order = seen[np.argsort(along, kind="stable")]
    chosen = np.linspace(0, len(order) - 1, min(most, len(order))) if most > 1 else [len(order) / 2]
    return [int(order[int(i)]) for i in chosen]


def _shape(one: Tested, step: int) -> dict[str, float]:
    return {name: float(v) for name, v in zip(one.scan.names, one.scan.mesh[step], strict=True)}


def _root(information: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > _RESOLVED * max(float(values[-1]), 1e-300)
    return vectors[:, kept] / np.sqrt(values[kept]) / scale[:, None]
