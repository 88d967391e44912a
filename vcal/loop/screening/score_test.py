"""Score test: how much every candidate would explain, without a refit, and how significant that is.

At the fit, with whitened residual r, Jacobian J, prior precision L and H = J'J + L, a candidate
with columns C has the score s = C'r and the information G = C'C - C'J H^-1 J'C. The drop of the
cost if the candidate were added is s'G^-1 s. The null distribution comes from residuals drawn under
the hypothesis that nothing is missing, r* = e - J H^-1 (J'e + L^(1/2) z), which contain the noise e
*and* the parameters' standardised deviation z from their prior.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.ndimage import maximum_filter

from ...effects.base import Effect
from ...effects.forms import Tones, Wave
from ...identification.fit import Fit
from ...numerics.eigen import eigh
from .responses import Response, Responses, Scan, filled
from .significance import SILENT, minus_log_beta_tail
from .size_evidence import log_mixture, size_allowance, size_surplus
from .sums import Candidates, EveryRow, Moved, Moving, Rows, Sums

_RESOLVED = 1e-5
"""Least share of a candidate's columns that must be independent of the model. A smaller share may
be due to the model's own curvature. In a plan of a laser frame a cross term keeps a share of 2e-5,
which is many times the noise."""
_UNSEEN = 1e-6
"""Information on an amplitude beside the model, in units of that of its prior, below which no
reading shows it: a thousand standard deviations of its prior change all readings together by one of
their noise. Such a column may be the product of an effect and of an error that was fitted, and
follows the fit itself."""
_CANCELLED = 1e-24
"""Squared share of the displacements at the ports that reaches the readings, below which it is
rounding: the readings do not depend on the port, or its parts cancel."""
_AROUND = 3
"""Steps of the grid around its best step within which a parameter without a derivative, such as a
moment, is looked for: between two steps the statistic may be higher than at both."""
_CHUNK = 512
_MANY_ROWS = 2_000
"""Rows from which alike rows are summed together, and equally spaced frequencies by FFT."""
_FAINT_WAVE = 1e-8
"""Least squares of a wave, in units of the largest, that an FFT gives with enough digits."""
_DRAWN = 2**21
"""Null residuals that are drawn together."""
_FAINT, _ROUNDING = 1e-6, 1e-9
"""Precision of a free shape parameter: share of that of its scan, and of the information in the
readings. Both are negligible."""


@dataclass(frozen=True)
class Peak:
    """One candidate at one point of its grid."""

    effect: Effect
    shape: Mapping[str, float]
    amplitudes: np.ndarray
    """Linear estimate, in solver units."""
    statistic: float
    """Drop of the cost, in units of the estimated noise variance."""
    log_bayes: float
    """Linear estimate of the gain in log evidence over the present model, summed over all steps of
    the grid that lie closer to this peak than to any other."""
    rank: int
    log_share: float = 0.0
    """`log_bayes` less the log evidence at the best shape alone: log of the share of the grid that
    explains the residual equally well. Never positive where the grid resolves the peak."""
    size_allowance: float = 0.0
    """`size_evidence.size_allowance` of the amplitudes: added to `log_bayes` where rivals are
    weighed."""

    @property
    def log_bayes_at_its_size(self) -> float:
        """`log_bayes` with the size allowance, as rivals are weighed."""
        return self.log_bayes + self.size_allowance


def _free(fit: Fit) -> np.ndarray:
    """The prior precision (k,), with a negligible one for shape parameters. It keeps them
    determined and lets them leave their grids.
    """
    least = np.maximum(_FAINT * fit.within_scans, _ROUNDING * (fit.jacobian**2).sum(0))
    return np.where(np.arange(len(least)) < len(fit.model.entries), fit.precision, least)


@dataclass(frozen=True)
class _Batch:
    """Steps of candidates with the same number of amplitudes that are tested together."""

    amplitudes: int
    steps: list[tuple[int, slice]]
    """Of every candidate its index and the steps of its grid."""
    moving: list[Moving]
    """What each moves there."""

    @property
    def sizes(self) -> list[int]:
        """Number of steps of every candidate."""
        return [steps.stop - steps.start for _, steps in self.steps]

    @property
    def given(self) -> tuple[int, Candidates]:
        """As `Rows.sums_of` takes it."""
        return self.amplitudes, list(zip(self.sizes, self.moving, strict=True))


class ScoreTest:
    """A fit, prepared for the score test of candidates.

    `draws` null residuals are drawn from `seed`; `responses` is the cache of what candidates do on
    the plan.
    """

    def __init__(self, fit: Fit, draws: int, seed: int, responses: Responses | None = None):
        self.fit = fit
        self.responses = Responses(fit.measurement.plan, 0) if responses is None else responses
        n, m = fit.residual.shape
        self.factor = cho_factor(fit.normal + np.diag(_free(fit)))
        # A shape parameter at the end of its grid would move further. What that bound leaves in the
        # residual must not be attributed to a candidate.
        uphill = fit.jacobian.T @ fit.whitened - fit.precision * fit.theta
        further = cho_solve(self.factor, uphill)
        self.residual = (fit.whitened - fit.jacobian @ further).reshape(n, m)
        lower = np.tril(self.factor[0]) if self.factor[1] else np.triu(self.factor[0]).T
        # H^-1 = whitening whitening': J'C times it has the inner product of the projection.
        self.whitening = solve_triangular(lower, np.eye(len(lower)), lower=True).T
        # The same for the nuisances alone, which may absorb nearly all of a candidate's columns.
        self.flat = fit.precision == 0
        self.whitening_flat = np.linalg.pinv(np.linalg.qr(fit.jacobian[:, self.flat], mode="r"))
        self.dof = fit.dof
        self.chi2 = fit.chi2
        self.count = float(fit.counted.sum() - self.flat.sum())
        cost = self._cost(fit.chi2, float(fit.theta**2 @ fit.precision))
        self.cost = max(cost, SILENT * self.count)
        null, self.null_cost = self._null_residuals(draws, seed)
        self.null = null.reshape(n, m, draws)
        ports = np.einsum("nij,njp->nip", fit.whitener, fit.port_jacobian)
        self.rows = EveryRow(ports, self.residual, self.null, fit.jacobian.reshape(n, m, -1))

    def release_draws(self) -> None:
        """Forget the null residuals of a large plan: once its candidates are screened, what is
        asked for is found from the readings alone.
        """
        if len(self.rows.blocks()) > 1:
            self.null = np.empty((*self.null.shape[:2], 0), np.float32)
            self.rows = EveryRow(self.rows.ports, self.residual, self.null, self.rows.jacobian)

    def _cost(self, chi2, prior):
        """The total that a drop is a share of: squares of the readings and of the prior.

        The prior counts at least as much as the noise found, where that is not below the declared
        noise. Prior squares beyond their expectation, due to something missing, count once, as they
        do in a drop.
        """
        expected = np.minimum(prior, float(np.count_nonzero(self.fit.precision)))
        return chi2 + np.maximum(chi2 / self.dof, 1.0) * expected + (prior - expected)

    def _null_residuals(self, draws: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (readings, draws) of the fit where nothing is missing, and their costs (draws).

        They are kept in single precision; only those of some readings at a time are in double.
        """
        fit, used = self.fit, self.fit.counted.reshape(-1)
        size = max(1, _DRAWN // max(draws, 1))
        blocks = [slice(i, i + size) for i in range(0, len(used), size)]
        rng = np.random.default_rng(seed)
        null, onto = np.empty((len(used), draws), np.float32), np.zeros((len(fit.theta), draws))
        for block in blocks:
            noise = rng.standard_normal((len(used[block]), draws)) * used[block][:, None]
            onto += fit.jacobian[block].T @ noise
            null[block] = noise
        prior = rng.standard_normal((len(fit.theta), draws)) * np.sqrt(fit.precision)[:, None]
        moved = cho_solve(self.factor, onto + prior)
        beside = prior - fit.precision[:, None] * moved
        squares = np.zeros(draws)
        for block in blocks:
            residual = null[block] - fit.jacobian[block] @ moved
            squares += np.einsum("nd,nd->d", residual, residual)
            null[block] = residual
        return null, self._cost(squares, (beside**2).sum(0))

    def columns(self, effect: Effect, shape: Mapping[str, float]) -> np.ndarray:
        """Whitened columns C of a candidate (n m, amplitudes), in solver units."""
        n, m, _ = self.rows.ports.shape
        columns = np.zeros((n, m, len(effect.amplitudes)))
        grid = {k: np.array([v]) for k, v in shape.items()}
        for port, k, phi in self._ports(self.responses.of(effect, grid)):
            columns[:, :, k] += self.rows.ports[:, :, port, None] * phi[0].T[:, None, :]
        return columns.reshape(n * m, -1)

    def _ports(self, response: Response) -> Moved:
        layout = self.fit.model.layout
        return [(layout.index(port), amplitudes, phi) for port, amplitudes, phi in response]

    def information(self, columns: np.ndarray) -> np.ndarray:
        """G = C'C - C'J H^-1 J'C (c, c) for whitened columns (n m, c)."""
        projected = self.fit.jacobian.T @ columns
        return columns.T @ columns - projected.T @ cho_solve(self.factor, projected)

    def tests(self, effects: Sequence[Effect]) -> list["Tested | None"]:
        """Statistics of candidates, each over its whole grid; None where the model spans the
        candidate.

        The steps of all effects with the same number of amplitudes are tested in one batch.
        """
        scans = [Scan.of(effect, self.fit.measurement.plan) for effect in effects]
        alike: dict[int, list[int]] = {}
        for i, effect in enumerate(effects):
            alike.setdefault(len(effect.amplitudes), []).append(i)
        own: list[list[Drops]] = [[] for _ in effects]
        batches: dict[int, tuple[Rows, list[_Batch]]] = {}
        for amplitudes, members in alike.items():
            scanned: dict[int, tuple[Rows, Responses, list[tuple[int, Scan]]]] = {}
            for i in members:
                if (tones := self._tones(effects[i])) is not None:
                    own[i] += self._dropped([len(scans[i].mesh)], self._tone_sums(*tones))
                else:
                    over, responses = self._rows_of(effects[i])
                    scanned.setdefault(id(over), (over, responses, []))[2].append((i, scans[i]))
            for over, responses, some in scanned.values():
                moving = partial(self._scanned, responses)
                batches.setdefault(id(over), (over, []))[1].extend(
                    _Batch(amplitudes, together,
                           [moving(effects[i], scans[i], steps) for i, steps in together])
                    for together in filled(some, _CHUNK // amplitudes or 1)
                )  # fmt: skip
        for over, several in batches.values():
            given = [batch.given for batch in several]
            for part in over.together(given):
                for batch, sums in zip(several[part], over.sums_of(given[part]), strict=True):
                    drops = self._dropped(batch.sizes, sums)
                    for (i, _), found in zip(batch.steps, drops, strict=True):
                        own[i].append(found)
        self.rows.release()
        tested: list[Tested | None] = [None] * len(effects)
        for members in alike.values():
            whole = [Drops.joined(own[i]) for i in members]
            for i, drops, evidence in zip(members, whole, self._evidence(whole), strict=True):
                if drops.rank.max() > 0:
                    tested[i] = Tested(effects[i], scans[i], drops, *evidence)
        return tested

    def refine(self, peak: Peak, rounds: int = 3) -> Peak:
        """The peak moved to the best point between its neighbours in the grid, by the linear
        estimate (no refit).
        """
        grids = dict(effect_grids(peak.effect, self.fit))
        names = [p.name for p in peak.effect.shapes if p.smooth]
        # Parameters without a derivative: all distinct values around it.
        between = {}
        for name, edges in peak.effect.edges(self.fit.measurement.plan).items():
            every = 0.5 * (edges[1:] + edges[:-1])
            if len(every) > len(grids[name]):
                low, high = _neighbours(grids[name], peak.shape[name])
                between[name] = every[(every >= low) & (every <= high)]
                grids[name] = every
        if not names and not between:
            return peak
        shape = dict(peak.shape)
        width = {
            n: float(np.abs(np.gradient(grids[n]))[np.argmin(np.abs(grids[n] - shape[n]))])
            if len(grids[n]) > 1
            else 0.0
            for n in names
        }
        offset = math.log(math.prod(len(grid) for grid in grids.values()))
        best = peak
        for _ in range(rounds if names else 1):
            axes = [
                np.clip(shape[n] + width[n] * np.linspace(-1, 1, 9), grids[n].min(), grids[n].max())
                if n in names
                else between.get(n, np.array([shape[n]]))
                for n in shape
            ]
            mesh = np.array(list(itertools.product(*axes)))
            grid = {n: mesh[:, i] for i, n in enumerate(shape)}
            drops = self._at(peak.effect, grid)
            ((bayes, costs),) = self._evidence([drops])
            i = int(np.argmax(np.where(drops.rank > 0, bayes, -np.inf)))
            shape = {n: float(mesh[i, k]) for k, n in enumerate(shape)}
            width = {n: w / 4.0 for n, w in width.items()}
            together = max(peak.log_bayes, float(bayes[i]) - offset)
            at_size = max(peak.log_bayes_at_its_size, float(bayes[i] + costs[i]) - offset)
            best = Peak(
                peak.effect,
                shape,
                drops.amplitudes[i],
                float(drops.stat[i]),
                together,
                int(drops.rank[i]),
                together - float(bayes[i]),
                max(at_size - together, 0.0),
            )
        return best

    def statistics(self, effect: Effect, grid: Mapping[str, np.ndarray]) -> np.ndarray:
        """Drop of the cost (g,) at the values `grid` (g,) of the shape parameters, SI."""
        return self._at(effect, grid).stat

    def log_bayes(self, effect: Effect, grid: Mapping[str, np.ndarray]) -> np.ndarray:
        """Gain in log evidence (g,) at the values `grid` (g,) of the shape parameters, SI."""
        size = len(next(iter(grid.values())))
        pieces = [
            self._at(effect, {n: v[i : i + _CHUNK] for n, v in grid.items()})
            for i in range(0, size, _CHUNK)
        ]
        return self._evidence([Drops.joined(pieces)])[0][0]

    def _at(self, effect: Effect, grid: Mapping[str, np.ndarray]) -> "Drops":
        """Drops for the data alone, without the null residuals."""
        size = len(next(iter(grid.values())))
        sums = self.rows.sums(
            len(effect.amplitudes), [(size, self._moving(effect, grid))], null=False
        )
        return self._dropped([size], sums, null=False)[0]

    def _moving(self, effect: Effect, grid: Mapping[str, np.ndarray]) -> Moving:
        """What an effect moves at these values of its shape parameters."""
        return lambda rows: self._ports(self.responses.of_rows(rows).of(effect, grid))

    def _scanned(self, responses: Responses, effect: Effect, scan: Scan, steps: slice) -> Moving:
        """The same at some steps of its grid, by these responses."""
        return lambda rows: self._ports(responses.of_rows(rows).scanned(effect, scan, steps))

    def _rows_of(self, effect: Effect) -> tuple[Rows, Responses]:
        """What the scan of an effect is summed over, and the responses there: all rows, or groups
        of rows that respond alike.
        """
        plan = self.fit.measurement.plan
        columns = effect.decided_by(plan) if plan.rows >= _MANY_ROWS else ()
        if (groups := self.rows.alike(columns)) is None:
            return self.rows, self.responses
        members, over = groups
        return over, self.responses.at(members)

    def _tones(self, effect: Effect) -> tuple[Wave, Tones] | None:
        """A wave, and its scan as equally spaced frequencies, where that saves time."""
        plan = self.fit.measurement.plan
        if plan.rows < _MANY_ROWS or not isinstance(effect, Wave):
            return None
        tones = effect.tones(plan)
        return None if tones is None else (effect, tones)

    def _tone_sums(self, effect: Wave, tones: Tones) -> Sums:
        """Sums of a wave at all frequencies of its scan."""
        port = self.fit.model.layout.index(effect.port)
        sums = self.rows.tone_sums(port, tones, [wave.step for wave in effect.amplitudes])
        # A wave that is nearly zero at every position is rounding here.
        seen = np.stack([np.einsum("gaa->ga", sums.squares), sums.most], axis=2)
        faint = np.flatnonzero((seen < _FAINT_WAVE * seen.max((0, 1))).any((1, 2)))
        if len(faint):
            scan = Scan.of(effect, self.fit.measurement.plan)
            grid = {name: scan.mesh[faint, i] for i, name in enumerate(scan.names)}
            sums.replace(faint, self.rows.sums(2, [(len(faint), self._moving(effect, grid))]))
        return sums

    def _dropped(self, sizes: Sequence[int], sums: Sums, *, null: bool = True) -> list["Drops"]:
        """Drops of effects with these numbers of steps, from the sums over the rows."""
        s, cj, cc, s_null, moved = sums
        first = np.cumsum([0, *sizes])
        half = (cj.reshape(-1, cj.shape[2]) @ self.whitening).reshape(cj.shape)
        g = cc - half @ half.transpose(0, 2, 1)
        # Columns are scaled by what flat nuisances leave of them: a pose may absorb all but 1e-5 of
        # a column, and the rest still be many times the noise. A column is not seen where it is
        # zero on this plan (no point under a bump) or zero to rounding (a rotation about the
        # direction of a length), or where the nuisances absorb it entirely.
        whole = np.einsum("gaa->ga", cc)
        taken = cj.reshape(-1, cj.shape[2])[:, self.flat] @ self.whitening_flat
        left = whole - np.einsum("nk,nk->n", taken, taken).reshape(whole.shape)
        most = np.repeat(np.maximum.reduceat(whole.max(1), first[:-1]), sizes)
        least = np.maximum(1e-18 * np.maximum(most, 1e-60)[:, None], _CANCELLED * moved)
        seen = (whole > least) & (left > 1e-8 * whole)
        scale = np.where(seen, np.sqrt(np.maximum(left, 0.0)), 1.0)
        scaled = g / scale[:, :, None] / scale[:, None, :]
        values, vectors = eigh(scaled * seen[:, :, None] * seen[:, None, :])
        # Information along each direction, in units of that of the prior.
        along = values / np.square(vectors / scale[:, :, None]).sum(1)
        kept = (values > _RESOLVED) & (along > _UNSEEN)
        inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
        rank = kept.sum(1)
        root = vectors * np.sqrt(inverse)[:, None, :] / scale[:, :, None]
        t = np.einsum("gab,ga->gb", root, s)
        stat = np.einsum("gb,gb->g", t, t)
        amplitudes = np.einsum("gab,gb->ga", root, t)
        by_rank: list[dict[int, np.ndarray]] = [{} for _ in sizes]
        owner = np.repeat(np.arange(len(sizes)), sizes)
        # For a fixed rank -ln p increases with the drop, so only the largest drop of each draw is
        # needed.
        for r in np.unique(rank[rank > 0]).tolist() if null else ():
            rows = np.flatnonzero(rank == r)
            drawn = root[rows].astype(np.float32).transpose(0, 2, 1) @ s_null[rows]
            drop = np.einsum("gbd,gbd->gd", drawn, drawn)
            owners, begin = np.unique(owner[rows], return_index=True)
            for i, most in zip(owners, np.maximum.reduceat(drop, begin), strict=True):
                by_rank[i][r] = most
        return [
            Drops(stat[i:j], rank[i:j], amplitudes[i:j], g[i:j], s[i:j], most)
            for i, j, most in zip(first[:-1], first[1:], by_rank, strict=True)
        ]

    def _evidence(self, of: Sequence["Drops"]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Gain in log evidence and size allowance (`size_evidence.size_allowance`) at every step of
        each grid.

        Marginal likelihood of a linear model, at the noise that the best step of the grid leaves.
        """
        sizes = [len(drops.stat) for drops in of]
        noise = [self._noise(drops) for drops in of]
        every = np.repeat(noise, sizes)
        g = np.concatenate([drops.information for drops in of]) / every[:, None, None]
        s = np.concatenate([drops.scores for drops in of]) / every[:, None]
        values, vectors = eigh(g)
        model = np.maximum(values, 0.0), np.einsum("gab,ga->gb", vectors, s)
        ends = np.cumsum(sizes)[:-1]
        # Whatever its size, a candidate gains half its drop at most. One that the model nearly
        # spans has almost no drop, and the readings do not bound its size: a wide prior would
        # multiply what is rounding.
        most = 0.5 * np.concatenate([drops.stat for drops in of]) / every
        gains = np.minimum(log_mixture(*model), most)
        costs = np.minimum(size_allowance(size_surplus(*model)), most - gains)
        return list(zip(np.split(gains, ends), np.split(costs, ends), strict=True))

    def _noise(self, drops: "Drops") -> float:
        """Noise variance that the best step of a grid leaves, in units of that of the fit, at least
        one.
        """
        return max((self.chi2 - float(drops.stat.max())) / self.dof, 1.0)

    def rarest(self, drops: Mapping[int, np.ndarray], cost) -> np.ndarray:
        """-ln p of the least probable among the largest drops of each rank."""
        return np.max([self.minus_log_p(drop, cost, rank) for rank, drop in drops.items()], axis=0)

    def minus_log_p(self, stat, cost, rank) -> np.ndarray:
        """-ln p of a drop `stat` of a cost, studentised.

        Under the null hypothesis the share stat/cost has the distribution Beta(rank/2, (n -
        rank)/2), with n readings less the parameters with a flat prior. A wrong declared noise
        therefore has no influence.
        """
        return minus_log_beta_tail(stat / cost, self.count, rank)

    def rarity_of(self, peak: Peak) -> float:
        """-ln p of a single peak, without correction for the search."""
        return float(self.minus_log_p(peak.statistic, self.cost, peak.rank))


def _neighbours(grid: np.ndarray, value: float) -> tuple[float, float]:
    """The grid values `_AROUND` steps before and after the one nearest to a value."""
    order = np.sort(grid)
    i = int(np.argmin(np.abs(order - value)))
    return float(order[max(i - _AROUND, 0)]), float(order[min(i + _AROUND, len(order) - 1)])


def effect_grids(effect: Effect, fit: Fit) -> Mapping[str, np.ndarray]:
    """The grid of an effect on the plan of a fit."""
    return effect.scan(fit.measurement.plan)


@dataclass(frozen=True)
class Drops:
    """What an effect would explain at the steps of its grid (g)."""

    stat: np.ndarray
    """Drop of the cost (g)."""
    rank: np.ndarray
    """Number of amplitudes that the readings can determine (g)."""
    amplitudes: np.ndarray
    information: np.ndarray
    scores: np.ndarray
    null: Mapping[int, np.ndarray]
    """Largest drop of each null residual (draws), by rank."""

    @classmethod
    def joined(cls, parts: Sequence["Drops"]) -> "Drops":
        """The steps of all parts, concatenated."""
        if len(parts) == 1:
            return parts[0]
        fields = ("stat", "rank", "amplitudes", "information", "scores")
        rows = [np.concatenate([getattr(part, name) for part in parts]) for name in fields]
        return cls(*rows, null=largest(part.null for part in parts))


def largest(drops: Iterable[Mapping[int, np.ndarray]]) -> dict[int, np.ndarray]:
    """The largest drop of each rank."""
    found: dict[int, np.ndarray] = {}
    for each in drops:
        for rank, drop in each.items():
            found[rank] = np.maximum(found[rank], drop) if rank in found else drop
    return found


@dataclass(frozen=True)
class Tested:
    """A candidate that the model does not span, over its whole grid."""

    effect: Effect
    scan: Scan
    drops: Drops
    bayes: np.ndarray
    """Gain in log evidence at every step."""
    size_allowance: np.ndarray
    """Size allowance at every step."""

    def largest(self) -> dict[int, np.ndarray]:
        """The largest drop of each rank."""
        drops = self.drops
        ranks = np.unique(drops.rank[drops.rank > 0]).tolist()
        return {rank: drops.stat[drops.rank == rank].max() for rank in ranks}

    def peaks(self, most: int) -> list[Peak]:
        """The best local maxima of the statistic over the grid, at most `most`. A refit that starts
        on their slopes would converge to the same maxima.
        """
        drops, names = self.drops, self.scan.names
        grid = np.indices(self.scan.lengths).reshape(len(names), len(drops.stat)).T
        chosen: list[int] = []
        choice = any(p.choice for p in self.effect.shapes)
        apart = 0 if choice else 2
        left = drops.rank > 0
        if names and not choice:
            over = np.where(left, drops.stat, -np.inf).reshape(self.scan.lengths)
            left &= (over == maximum_filter(over, 3, mode="nearest")).reshape(-1)
        while left.any() and len(chosen) < most:
            i = int(np.argmax(np.where(left, drops.stat, -np.inf)))
            chosen.append(i)
            left &= (np.abs(grid - grid[i]) > apart).any(1)
        steps = math.log(len(self.scan.mesh))
        spreads = self._spreads(self.bayes, grid, chosen)
        # The sum with the allowance also covers all steps: sizes at the steps that carry the
        # evidence may be smaller.
        with_allowance = self._spreads(self.bayes + self.size_allowance, grid, chosen)
        return [
            Peak(
                effect=self.effect,
                shape={n: float(self.scan.mesh[i, k]) for k, n in enumerate(names)},
                amplitudes=drops.amplitudes[i],
                statistic=float(drops.stat[i]),
                log_bayes=float(self.bayes[i]) + spread - steps,
                rank=int(drops.rank[i]),
                log_share=spread - steps,
                size_allowance=max(float(self.size_allowance[i]) + more - spread, 0.0),
            )
            for i, spread, more in zip(chosen, spreads, with_allowance, strict=True)
        ]

    def _spreads(self, bayes: np.ndarray, grid: np.ndarray, chosen: list[int]) -> list[float]:
        """Log of the evidence summed over the steps around each peak, relative to that of the peak.

        A step that is better than the nearest peak lies on the slope of a higher peak and counts
        there.
        """
        if not self.scan.names or any(p.choice for p in self.effect.shapes):
            return [0.0] * len(chosen)
        away = np.abs(grid[:, None, :] - grid[chosen]).max(-1)
        away[bayes[:, None] > bayes[chosen]] += len(grid)
        nearest = away.argmin(1)
        over = np.where(self.drops.rank > 0, bayes - bayes[chosen][nearest], -np.inf)
        together = np.bincount(nearest, np.exp(np.minimum(over, 700.0)), minlength=len(chosen))
        return np.log(together).tolist()
