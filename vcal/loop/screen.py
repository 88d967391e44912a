"""Screening: how much every candidate would explain, without a refit, and what that is worth.

At the fit, with whitened residual r, Jacobian J, prior precision L and H = J'J + L, a candidate
with columns C has the score s = C'r and the information G = C'C - C'J H^-1 J'C; s'G^-1 s is the
drop of the cost if it were added. The same statistic is computed for residuals drawn under the
hypothesis that nothing is missing, r* = e - J H^-1 (J'e + L^(1/2) z): noise *and* parameters from
their prior.
The largest of each kind of effect is corrected within that kind first, then over the kinds.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, solve_triangular
from scipy.special import betainc, betaln, gammaincc, gammaln

from ..effects.base import Effect
from ..fit import Fit
from .scales import log_mixture

_RESOLVED = 1e-4
"""Share of a candidate's columns that must be independent of the model for it to count."""
_CHUNK = 512


@dataclass(frozen=True)
class Peak:
    """One candidate at one point of its scan."""

    effect: Effect
    shape: Mapping[str, float]
    amplitudes: np.ndarray
    """Linear estimate, in solver units."""
    statistic: float
    """Drop of the cost, in units of the noise variance found."""
    log_bayes: float
    """Linear estimate of the gain in log evidence over the present model, all steps of the scan
    taken together that lie closer to this peak than to another one.
    """
    rank: int
    log_share: float = 0.0
    """By how much that is more than that of the best shape alone: the share of the scan that
    explains the residual as well, so never above zero where the scan resolves the peak.
    """


@dataclass(frozen=True)
class KindResult:
    """The best of one kind of effect, corrected for the whole search within the kind."""

    kind: str
    peaks: list[Peak]
    instances: int
    """How many places and components were tried."""
    minus_log_p: float
    """Uncorrected."""
    trials: float
    """Effective number of independent trials in the search."""
    p_value: float
    """Corrected within the kind."""


@dataclass(frozen=True)
class Screening:
    """Everything a screening found."""

    kinds: list[KindResult]
    p_value: float
    """Of the best kind, corrected over all kinds."""
    trials: float
    noise_scale: float
    """Root of chi2 per degree of freedom, after the best candidate's share was taken out."""
    unseen: list[Effect]
    """Candidates whose columns the declared model already spans."""

    def corrected(self, kind: KindResult) -> float:
        """p-value of a kind's best candidate, corrected over all kinds too."""
        return float(corrected(_minus_log_corrected(kind), self.trials))

    def corrected_as(self, kind: str, minus_log_p: float) -> float:
        """p-value of any candidate of a kind, corrected within the kind and over all kinds."""
        it = next(found for found in self.kinds if found.kind == kind)
        within = float(corrected(minus_log_p, it.trials))
        return self.corrected(replace(it, minus_log_p=minus_log_p, p_value=within))

    @property
    def peaks(self) -> list[Peak]:
        """All peaks, best evidence first."""
        found = [peak for kind in self.kinds for peak in kind.peaks]
        return sorted(found, key=lambda peak: -peak.log_bayes)


def minus_log_chi2_tail(x: np.ndarray, dof: np.ndarray | float) -> np.ndarray:
    """-ln of the probability that chi-square with `dof` exceeds `x`, without underflow."""
    x, half = np.broadcast_arrays(np.asarray(x, float), 0.5 * np.asarray(dof, float))
    tail = gammaincc(half, 0.5 * x)
    y = np.maximum(0.5 * x, 1e-300)
    # Leading terms of the asymptotic series where the tail underflows.
    far = y - (half - 1.0) * np.log(y) + gammaln(half) - (half - 1.0) / y
    return np.where(tail > 1e-290, -np.log(np.maximum(tail, 1e-300)), far)


def minus_log_beta_tail(
    share: np.ndarray | float, dof: float, rank: np.ndarray | float
) -> np.ndarray:
    """-ln of the probability that a share of the squares of `dof` normal numbers, that which lies
    in a space of `rank` dimensions, exceeds `share`; without underflow. Zero where there are no
    more numbers than dimensions.
    """
    share, b = np.broadcast_arrays(np.clip(share, 0.0, 1.0 - 1e-12), 0.5 * np.asarray(rank, float))
    a = np.maximum(0.5 * dof - b, 1e-6)
    tail = betainc(a, b, 1.0 - share)
    # Leading term of the series where the tail underflows.
    far = np.log(a) + betaln(a, b) - a * np.log1p(-share) - (b - 1.0) * np.log(share + 1e-300)
    found = np.where(tail > 1e-290, -np.log(np.maximum(tail, 1e-300)), far)
    return np.where(0.5 * dof > b, found, 0.0)


class Screen:
    """The fit in the form in which candidates are tested against it."""

    def __init__(self, fit: Fit, draws: int, seed: int):
        self.fit = fit
        n, m = fit.residual.shape
        self.ports = np.einsum("nij,njp->nip", fit.whitener, fit.port_jacobian)
        self.jacobian = fit.jacobian.reshape(n, m, -1)
        self.factor = fit.factor
        # A shape parameter at the end of its scan would go further: what that leaves unexplained is
        # nothing that a candidate could explain.
        uphill = fit.jacobian.T @ fit.whitened - fit.precision * fit.theta
        further = cho_solve(self.factor, uphill)
        self.residual = (fit.whitened - fit.jacobian @ further).reshape(n, m)
        lower = np.tril(self.factor[0]) if self.factor[1] else np.triu(self.factor[0]).T
        # H^-1 = whitening whitening', so that J'C times it has the projection's inner product.
        self.whitening = solve_triangular(lower, np.eye(len(lower)), lower=True).T
        # The same for the nuisances alone, which may take up nearly all of a candidate's columns.
        self.flat = fit.precision == 0
        self.whitening_flat = np.linalg.pinv(np.linalg.qr(fit.jacobian[:, self.flat], mode="r"))
        self.dof = fit.dof
        self.chi2 = fit.chi2
        self.count = float(fit.counted.sum() - self.flat.sum())
        self.cost = self._cost(fit.chi2, float(fit.theta**2 @ fit.precision))
        used = fit.counted.reshape(-1)
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal((n * m, draws)) * used[:, None]
        prior = rng.standard_normal((len(fit.theta), draws)) * np.sqrt(fit.precision)[:, None]
        moved = cho_solve(self.factor, fit.jacobian.T @ noise + prior)
        null = noise - fit.jacobian @ moved
        beside = prior - fit.precision[:, None] * moved
        self.null_cost = self._cost((null**2).sum(0), (beside**2).sum(0))
        self.null = null.reshape(n, m, draws).astype(np.float32)
        self._contracted: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def _cost(self, chi2, prior):
        """What a drop is a share of: squares of readings and of the prior, which counts as much as
        the noise that was found, if not less than declared.
        """
        return chi2 + np.maximum(chi2 / self.dof, 1.0) * prior

    def contract(self, port: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual (n), null residuals (n, draws) and Jacobian (n, k) seen through one port."""
        if port not in self._contracted:
            g = self.ports[:, :, port]
            self._contracted[port] = (
                np.einsum("nm,nm->n", g, self.residual),
                np.einsum("nm,nmd->nd", g.astype(np.float32), self.null, optimize=True),
                np.einsum("nm,nmk->nk", g, self.jacobian, optimize=True),
            )
        return self._contracted[port]

    def columns(self, effect: Effect, shape: Mapping[str, float]) -> np.ndarray:
        """Whitened columns C of a candidate in solver units: (n m, amplitudes)."""
        n, m, _ = self.ports.shape
        columns = np.zeros((n, m, len(effect.amplitudes)))
        for port, k, phi in self._responses(effect, {k: np.array([v]) for k, v in shape.items()}):
            columns[:, :, k] += self.ports[:, :, port] * phi[0][:, None]
        return columns.reshape(n * m, -1)

    def _responses(self, effect: Effect, grid: Mapping[str, np.ndarray]):
        plan, layout = self.fit.measurement.plan, self.fit.model.layout
        amplitudes = {p.name: (k, p.step) for k, p in enumerate(effect.amplitudes)}
        shape = {name: values[:, None] for name, values in grid.items()}
        size = len(next(iter(grid.values()))) if grid else 1
        for (port, name), phi in effect.response(plan, shape).items():
            k, step = amplitudes[name]
            values = np.broadcast_to(np.asarray(phi, float), (size, plan.rows)) * step
            yield layout.index(port), k, values

    def information(self, columns: np.ndarray) -> np.ndarray:
        """G = C'C - C'J H^-1 J'C for whitened columns (n m, c)."""
        projected = self.fit.jacobian.T @ columns
        return columns.T @ columns - projected.T @ cho_solve(self.factor, projected)

    def test(self, effect: Effect) -> "_Tested | None":
        """Statistics of a candidate over its whole scan; None where the model spans it."""
        grids = effect.scan(self.fit.measurement.plan)
        names = list(grids)
        mesh = np.array(list(itertools.product(*grids.values()))) if names else np.zeros((1, 0))
        pieces = []
        for start in range(0, len(mesh), _CHUNK):
            part = mesh[start : start + _CHUNK]
            piece = self._test_chunk(effect, {n: part[:, i] for i, n in enumerate(names)})
            if piece is None:
                return None
            pieces.append(piece)
        stat, rank, amplitudes, g, s = (np.concatenate([p[i] for p in pieces]) for i in range(5))
        null = np.max([p[5] for p in pieces], axis=0)
        if rank.max() == 0:
            return None
        bayes = self._log_bayes(stat, g, s)
        lengths = tuple(len(grid) for grid in grids.values())
        return _Tested(effect, names, mesh, lengths, stat, rank, bayes, amplitudes, null)

    def refine(self, peak: Peak, rounds: int = 3) -> Peak:
        """The peak moved to the best point between its neighbours in the scan (no refit)."""
        grids = dict(effect_grids(peak.effect, self.fit))
        names = [p.name for p in peak.effect.shapes if p.smooth]
        # Without a derivative: all values there are between the neighbours.
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
            piece = self._test_chunk(peak.effect, grid, null=False)
            if piece is None:
                return best
            stat, rank, amplitudes, g, s, _ = piece
            bayes = self._log_bayes(stat, g, s)
            i = int(np.argmax(np.where(rank > 0, bayes, -np.inf)))
            shape = {n: float(mesh[i, k]) for k, n in enumerate(shape)}
            width = {n: w / 4.0 for n, w in width.items()}
            together = max(peak.log_bayes, float(bayes[i]) - offset)
            best = Peak(
                peak.effect,
                shape,
                amplitudes[i],
                float(stat[i]),
                together,
                int(rank[i]),
                together - float(bayes[i]),
            )
        return best

    def log_bayes(self, effect: Effect, grid: Mapping[str, np.ndarray]) -> np.ndarray:
        """Gain in log evidence with these values of its shape parameters (g,) each."""
        size = len(next(iter(grid.values())))
        pieces = [
            self._test_chunk(
                effect, {n: v[start : start + _CHUNK] for n, v in grid.items()}, null=False
            )
            for start in range(0, size, _CHUNK)
        ]
        stat, g, s = (np.concatenate([p[i] for p in pieces if p is not None]) for i in (0, 3, 4))
        return self._log_bayes(stat, g, s)

    def _test_chunk(self, effect: Effect, grid: Mapping[str, np.ndarray], null: bool = True):
        c = len(effect.amplitudes)
        terms = list(self._responses(effect, grid))
        if not terms:
            return None
        size = terms[0][2].shape[0]
        draws, k = self.null.shape[2], self.jacobian.shape[2]
        s = np.zeros((size, c))
        s_null = np.zeros((c, size, draws if null else 0), np.float32)
        cj = np.zeros((size, c, k))
        for port, a, phi in terms:
            r, drawn, j = self.contract(port)
            s[:, a] += phi @ r
            if null:
                s_null[a] += phi.astype(np.float32) @ drawn
            cj[:, a] += phi @ j
        cc = np.zeros((size, c, c))
        for (pa, a, fa), (pb, b, fb) in itertools.product(terms, terms):
            if b >= a:
                gg = np.einsum("nm,nm->n", self.ports[:, :, pa], self.ports[:, :, pb])
                value = (fa * fb) @ gg
                cc[:, a, b] += value
                if b > a:
                    cc[:, b, a] += value
        half = (cj.reshape(size * c, k) @ self.whitening).reshape(size, c, k)
        g = cc - np.einsum("gak,gbk->gab", half, half)
        # Scaled by what flat nuisances leave: a pose may take up all but 1e-5 of a column, and the
        # rest still be many times the noise. A column that is zero on this plan (no point under a
        # bump), or that they take up entirely, is not seen.
        whole = np.einsum("gaa->ga", cc)
        taken = cj[:, :, self.flat] @ self.whitening_flat
        left = whole - np.einsum("gak,gak->ga", taken, taken)
        seen = (whole > 1e-18 * max(float(whole.max()), 1e-60)) & (left > 1e-8 * whole)
        scale = np.sqrt(np.maximum(left, 0.0))
        scale = np.where(seen, scale, 1.0)
        scaled = g / scale[:, :, None] / scale[:, None, :]
        values, vectors = np.linalg.eigh(scaled * seen[:, :, None] * seen[:, None, :])
        kept = values > _RESOLVED
        inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
        rank = kept.sum(1)
        root = vectors * np.sqrt(inverse)[:, None, :] / scale[:, :, None]
        t = np.einsum("gab,ga->gb", root, s)
        stat = np.einsum("gb,gb->g", t, t)
        amplitudes = np.einsum("gab,gb->ga", root, t)
        largest_null = np.zeros(draws)
        for r in np.unique(rank[rank > 0]) if null else ():
            # For one rank, -ln p grows with the drop: only the largest drop of a draw is needed.
            rows = np.flatnonzero(rank == r)
            weights = root[rows].astype(np.float32)
            projected = np.einsum("gab,agd->bgd", weights, s_null[:, rows], optimize=True)
            largest = np.einsum("bgd,bgd->gd", projected, projected).max(0)
            score = self.minus_log_p(largest, self.null_cost, r)
            largest_null = np.maximum(largest_null, score)
        return stat, rank, amplitudes, g, s, largest_null

    def _log_bayes(self, stat: np.ndarray, g: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Gain in log evidence at every step of a scan: marginal likelihood of a linear model, at
        the noise that the best of them leaves.
        """
        noise = max((self.chi2 - stat.max()) / self.dof, 1.0)
        values, vectors = np.linalg.eigh(g / noise)
        scores = np.einsum("gab,ga->gb", vectors, s / noise)
        return log_mixture(np.maximum(values, 0.0), scores)

    def minus_log_p(self, stat, cost, rank) -> np.ndarray:
        """-ln p of a drop `stat` of a cost, studentised: of chance, its share is distributed as
        Beta(rank/2, (n - rank)/2), with n readings less the parameters of flat prior. Noise
        declared too small or too large then changes nothing.
        """
        return minus_log_beta_tail(stat / cost, self.count, rank)


def _neighbours(grid: np.ndarray, value: float) -> tuple[float, float]:
    """The steps of a scan before and after the one nearest to a value."""
    order = np.sort(grid)
    i = int(np.argmin(np.abs(order - value)))
    return float(order[max(i - 1, 0)]), float(order[min(i + 1, len(order) - 1)])


def effect_grids(effect: Effect, fit: Fit) -> Mapping[str, np.ndarray]:
    """The scan of an effect on the plan of a fit."""
    return effect.scan(fit.measurement.plan)


@dataclass(frozen=True)
class _Tested:
    effect: Effect
    names: list[str]
    mesh: np.ndarray
    lengths: tuple[int, ...]
    stat: np.ndarray
    rank: np.ndarray
    bayes: np.ndarray
    amplitudes: np.ndarray
    null: np.ndarray

    def peaks(self, most: int) -> list[Peak]:
        """The best local maxima of the statistic over the scan."""
        order = np.argsort(-self.stat)
        grid = np.array(list(np.ndindex(*self.lengths))) if self.names else np.zeros((1, 0), int)
        chosen: list[int] = []
        apart = 0 if any(p.choice for p in self.effect.shapes) else 2
        for i in order:
            if self.rank[i] == 0:
                continue
            if all(np.abs(grid[i] - grid[j]).max() > apart for j in chosen) or not self.names:
                chosen.append(int(i))
            if len(chosen) == (most if self.names else 1):
                break
        steps = math.log(len(self.mesh))
        spreads = self._spreads(grid, chosen)
        return [
            Peak(
                effect=self.effect,
                shape={n: float(self.mesh[i, k]) for k, n in enumerate(self.names)},
                amplitudes=self.amplitudes[i],
                statistic=float(self.stat[i]),
                log_bayes=float(self.bayes[i]) + spread - steps,
                rank=int(self.rank[i]),
                log_share=spread - steps,
            )
            for i, spread in zip(chosen, spreads, strict=True)
        ]

    def _spreads(self, grid: np.ndarray, chosen: list[int]) -> list[float]:
        """How much more log evidence the steps about each peak have than the peak."""
        if not self.names or any(p.choice for p in self.effect.shapes):
            return [0.0] * len(chosen)
        away = np.abs(grid[:, None, :] - grid[chosen]).max(-1)
        nearest = away.argmin(1)
        over = np.where(self.rank > 0, self.bayes - self.bayes[chosen][nearest], -np.inf)
        together = np.bincount(nearest, np.exp(np.minimum(over, 700.0)), minlength=len(chosen))
        return np.log(together).tolist()


def effective_trials(null: np.ndarray) -> float:
    """Effective number of independent trials whose largest -ln p is distributed as `null`."""
    tail = np.clip(np.exp(-null), 1e-15, 1.0 - 1e-15)
    return float(-len(null) / np.log1p(-tail).sum())


def corrected(minus_log_p: np.ndarray | float, trials: float) -> np.ndarray:
    """Probability that the best of `trials` is as good: 1 - (1 - p)^trials."""
    p = np.exp(-np.asarray(minus_log_p, float))
    return -np.expm1(trials * np.log1p(-np.minimum(p, 1.0 - 1e-15)))


def screen(state: Screen, effects: Sequence[Effect], *, peaks: int = 10) -> Screening:
    """Test all candidates against a fit; see the module's description for the method.

    `peaks` is how many maxima of a scan are kept.
    """
    groups: dict[str, list[_Tested]] = {}
    unseen = []
    for effect in effects:
        tested = state.test(effect)
        if tested is None:
            unseen.append(effect)
        else:
            groups.setdefault(effect.name, []).append(tested)
    kinds, null, best_drop = [], [], 0.0
    for kind, members in groups.items():
        kind_null = np.max([t.null for t in members], axis=0)
        trials = effective_trials(kind_null)
        scores = [state.minus_log_p(t.stat, state.cost, np.maximum(t.rank, 1)) for t in members]
        seen = zip(members, scores, strict=True)
        best = max(float(np.max(np.where(t.rank > 0, score, 0))) for t, score in seen)
        found = sorted(
            (peak for t in members for peak in t.peaks(peaks)), key=lambda peak: -peak.log_bayes
        )
        best_drop = max(best_drop, *(peak.statistic for peak in found))
        kinds.append(
            KindResult(kind, found, len(members), best, trials, float(corrected(best, trials)))
        )
        null.append(-np.log(np.maximum(corrected(kind_null, trials), 1e-300)))
    if not kinds:
        return Screening([], 1.0, 0.0, math.sqrt(state.chi2 / state.dof), unseen)
    over_kinds = np.max(null, axis=0)
    trials = effective_trials(over_kinds)
    best = max(_minus_log_corrected(kind) for kind in kinds)
    return Screening(
        kinds=sorted(kinds, key=lambda kind: -_minus_log_corrected(kind)),
        p_value=float(corrected(best, trials)),
        trials=trials,
        noise_scale=math.sqrt(max(state.chi2 - best_drop, 0.0) / state.dof),
        unseen=unseen,
    )


def _minus_log_corrected(kind: KindResult) -> float:
    """-ln of the corrected p-value, also where that underflows."""
    if kind.p_value > 1e-290:
        return -math.log(kind.p_value)
    return kind.minus_log_p - math.log(kind.trials)
