"""Two-level Monte Carlo of a virtual calibration: many linear draws, and few exact ones.

Near its nominal machine, an identification is nearly linear in the true parameters and the noise:

    found = found0 + G theta + C z,      G = H^-1 J' W' W J_true,   C C' = cov(H^-1 J' W' W noise)

A linear draw needs as many random numbers for the noise as there are parameters, and no forward
model. The quantities are computed from it as from an exact draw. With L such a result and Y the
exact one of the same machine and noise,

    mean(Y) = mean over N linear draws (L) + mean over n pairs (Y - L),

and in the same way for the variance and for the distribution function, of which the quantiles are
the inverse (M. B. Giles, Acta Numerica 24, 2015, 259, with two levels). The result has no bias from
the linearisation; the pairs correct it, and a few suffice because they differ little.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.special import expit, logit

from ..errors import StudyError
from ..labelled import labelling
from ..machine.plan import Plan
from ..model.forward import Model, Shapes
from ..model.simulate import Simulator, draw_scatter
from ..numerics.arrays import Array
from ..numerics.eigen import eigh
from ..numerics.normal_draws import standard_normal
from ..numerics.processes import cores
from .campaign import PairEvaluate, virtual_pair
from .ensemble import Ensemble
from .intervals import check_coverage
from .linear import linear_parts
from .outputs import Output
from .programs import Programs
from .quantities import Measure, Pair, ParameterErrors, Quantity, State, scalars
from .streaming import Progress, stream

EXPLAINED = 0.99
"""Least share of the variance of every output that the linear draws must explain."""
_COST = 10.0
"""Cost of a pair in linear draws, for the sample sizes. It is a constant, so that results depend on
the seed alone and not on the speed of a machine; the optimum is flat."""
_PILOT = 2000
"""Pairs from which the sample sizes are derived, and least number of them."""
_TOGETHER, _BLOCK = 1000, 4000
"""Linear draws that a thread computes together, and those of a block."""
_LINEAR_KEY = 2**32 - 1
"""`fold_in` index of the key of the linear draws: pairs use those of `monte_carlo`, from zero."""
_SPARE = 1.2
"""Factor on the number of pairs that the pilot asks for, which is an estimate."""
_SHARES, _REACH = 129, 2.5
"""Quantiles of the linear draws around an end, between which it is interpolated, and how far they
reach in the logarithm of the odds of their shares."""
_COUNTED = 6
"""Least number of pairs from which a share is counted."""
_SHOWN = 8
"""Most quantities that a result lists as text."""


class LinearDraws(eqx.Module):
    """Identified parameters as a linear function of true parameters and noise."""

    at_nominal: Float[Array, " k"]
    """Identified parameters of the nominal truth without noise."""
    by_true: Float[Array, "k l"]
    """G: derivatives by the true amplitudes, in solver units."""
    by_noise: Float[Array, "k nm"]
    """Derivatives by the standardised noise of every reading."""
    by_scatter: Float[Array, "k ns"]
    """The same by the standardised random effects of every row."""
    root: Float[Array, "k r"]
    """C: root of the covariance that both of them give."""

    @classmethod
    def of(cls, pair: Pair) -> "LinearDraws":
        """The linearisation at the nominal machine."""
        parts = linear_parts(pair)
        covariance = parts.by_noise @ parts.by_noise.T + parts.by_scatter @ parts.by_scatter.T
        values, vectors = eigh(covariance)
        kept = values > 1e-14 * values.max(initial=0.0)
        root = vectors[:, kept] * np.sqrt(values[kept])
        return cls(*(jnp.asarray(part) for part in (*parts, root)))

    def beside(self, simulator: Simulator, theta: Array, key: PRNGKeyArray) -> Array:
        """Identified parameters (k,) of the draw that `model.simulate.draw` makes of a key, whose
        true amplitudes are `theta`.
        """
        _, noise, fresh = jax.random.split(key, 3)
        found = self.at_nominal + self.by_true @ theta
        found = found + self.by_noise @ standard_normal(noise, simulator.sigma.shape).reshape(-1)
        if self.by_scatter.shape[1]:
            found = found + self.by_scatter @ draw_scatter(simulator, fresh).reshape(-1)
        return found

    def drawn(self, theta: Array, noise: Array) -> Array:
        """Identified parameters (k,) of a linear draw with this standardised noise (r,)."""
        return self.at_nominal + self.by_true @ theta + self.root @ noise


@dataclass(frozen=True)
class TwoLevel:
    """Results of a two-level Monte Carlo: one entry per scalar output, in the order of `labels`."""

    labels: tuple[str, ...]
    mean: Float[np.ndarray, " q"] = field(repr=False)
    u: Float[np.ndarray, " q"] = field(repr=False)
    """Standard uncertainty: the standard deviation."""
    low: Float[np.ndarray, " q"] = field(repr=False)
    high: Float[np.ndarray, " q"] = field(repr=False)
    """Ends of the probabilistically symmetric coverage interval."""
    error_of_mean: Float[np.ndarray, " q"] = field(repr=False)
    """Standard error of `mean` by the finite number of draws; and so on."""
    error_of_u: Float[np.ndarray, " q"] = field(repr=False)
    error_of_low: Float[np.ndarray, " q"] = field(repr=False)
    error_of_high: Float[np.ndarray, " q"] = field(repr=False)
    explained: Float[np.ndarray, " q"] = field(repr=False)
    """Share of the variance that the linear draws explain; one where nothing varies."""
    coverage: float
    linear: int
    """Number of linear draws."""
    exact: int
    """Number of exact draws, each with its linear one."""
    failed: int
    """Exact draws without an identification, which are left out."""
    seed: int

    def __repr__(self) -> str:
        rows = [
            f"  {name} = {self.mean[i]:.4g} ± {self.u[i]:.2g}"
            for i, name in enumerate(self.labels[:_SHOWN])
        ]
        more = len(self.labels) - _SHOWN
        rows += [f"  and {more} more"] if more > 0 else []
        head = f"Two-level Monte Carlo of {self.linear} linear and {self.exact} exact draws, "
        return "\n".join([f"{head}seed {self.seed}", *rows])

    def index(self, output: str) -> int:
        """Index of a scalar output; raises `ValueError` for an unknown name."""
        if output not in self.labels:
            raise ValueError(
                f"no scalar output is called {output!r}, expected one of {', '.join(self.labels)}"
            )
        return self.labels.index(output)

    def interval(self, output: str) -> tuple[float, float]:
        """Coverage interval of a scalar output; raises `ValueError` for an unknown name."""
        i = self.index(output)
        return float(self.low[i]), float(self.high[i])

    def to_pandas(self) -> Any:
        """All values with their standard errors as a `pandas.DataFrame`.

        Raises `ImportError` where pandas is not installed.
        """
        names = {
            "mean": "mean", "standard_uncertainty": "u", "low": "low", "high": "high",
            "error_of_mean": "error_of_mean", "error_of_u": "error_of_u",
            "error_of_low": "error_of_low", "error_of_high": "error_of_high",
            "explained": "explained",
        }  # fmt: skip
        columns = {column: getattr(self, name) for column, name in names.items()}
        return labelling("pandas").DataFrame(columns, index=list(self.labels))


def two_level(
    truth: Model,
    fit: Model,
    plan: Plan,
    *,
    draws: int = 1_000_000,
    seed: int = 0,
    quantities: Sequence[Quantity] = (ParameterErrors(),),
    shapes: Shapes | None = None,
    noise_factor: float = 1.0,
    tolerance: float = 1e-3,
    coverage: float = 0.95,
    progress: Progress = lambda done, total: None,
    programs: Programs | None = None,
) -> TwoLevel:
    """The scalar outputs of `monte_carlo` by many linear and few exact draws.

    `draws` states the precision: u and both ends of the coverage interval of every output have the
    standard errors, or smaller ones, that so many exact draws would give. The numbers of linear and
    of exact draws follow from a pilot of exact ones. With V the variance of an exact draw's
    contribution to a result, and rho V that of a pair's, N linear draws and n pairs have the
    variance V/N + rho V/n; for the largest rho of all results, N = M (1 + sqrt(rho c)) and
    n = M (rho + sqrt(rho/c)) reach V/M with the least work, c being the cost of a pair in linear
    draws. Fields are left out.

    Results depend on the seed alone. The other arguments, and the errors raised, are those of
    `monte_carlo`. Raises `StudyError` where the linear draws explain less than 99 % of the variance
    of an output: `monte_carlo` is then to be used.
    """
    if draws < _PILOT:
        raise ValueError(f"draws: found {draws}, expected at least {_PILOT}")
    check_coverage(coverage)
    pair = virtual_pair(truth, fit, plan, shapes=shapes, noise_factor=noise_factor)
    measures = tuple(q.measure(pair) for q in quantities)
    outputs = [o for m in measures for o in m.outputs if isinstance(o, Output)]
    linear = LinearDraws.of(pair)
    pairs = PairEvaluate(pair, measures, seed, tolerance, linear, programs)
    exact, beside = _pairs(pairs, outputs, 0, _PILOT)
    labels = tuple(label for o in outputs for label in o.labels)
    pilot = _Statistics.of(exact, beside, coverage)
    _check_explained(labels, pilot.explained)
    rho = pilot.largest_ratio
    sizes = [
        draws * (1.0 + math.sqrt(rho * _COST)),
        _SPARE * draws * (rho + math.sqrt(rho / _COST)),
    ]
    many, few = math.ceil(sizes[0]), max(_PILOT, math.ceil(sizes[1]))
    if few > _PILOT:
        more = _pairs(pairs, outputs, _PILOT, few - _PILOT)
        exact, beside = (np.concatenate(both) for both in zip((exact, beside), more, strict=True))
    ensemble = stream(
        _LinearEvaluate(pair, measures, linear, seed),
        many,
        outputs,
        block=_BLOCK,
        progress=progress,
        coverage=coverage,
    )
    found = _Statistics.of(exact, beside, coverage).corrected(ensemble, labels)
    failed = int((~np.isfinite(exact).all(1)).sum())
    return TwoLevel(
        labels=labels,
        **found,
        coverage=coverage,
        linear=ensemble.draws,
        exact=len(exact),
        failed=failed,
        seed=seed,
    )


def _check_explained(labels: Sequence[str], explained: np.ndarray) -> None:
    poor = np.flatnonzero(~(explained >= EXPLAINED))
    if not len(poor):
        return
    worst = int(poor[np.nanargmin(np.nan_to_num(explained[poor], nan=-1.0))])
    raise StudyError(
        f"two-level Monte Carlo: found that linear draws explain {100 * explained[worst]:.1f} % of "
        f"the variance of {labels[worst]}, and too little of {len(poor)} of {len(labels)} outputs, "
        f"expected at least {100 * EXPLAINED:.0f} %; use exact draws (monte_carlo)"
    )


def _pairs(
    evaluate: PairEvaluate, outputs: Sequence[Output], first: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Exact and linear outputs (count, q) of the same draws."""
    values = evaluate(first, count)
    return tuple(  # type: ignore[return-value]
        np.concatenate([values[of(o.name)].reshape(count, -1) for o in outputs], axis=1)
        for of in (str, evaluate.linear_name)
    )


class _LinearEvaluate:
    """The outputs of a range of linear draws.

    Their random numbers come from one generator for every `_TOGETHER` of them, with a counter
    (Philox): it takes an eighth of the time of a key for every draw.
    """

    def __init__(self, pair: Pair, measures: Sequence[Measure], linear: LinearDraws, seed: int):
        self.seed = seed
        simulator, batch = pair.simulator, pair.batch
        self.sizes = sum(simulator.amplitudes.counts), linear.root.shape[1]
        key = jax.random.fold_in(jax.random.key(seed), np.uint32(_LINEAR_KEY))

        def one(index: Array, score: Array, noise: Array) -> dict[str, Array]:
            machine = jax.random.fold_in(key, index)
            theta = simulator.amplitudes.of_scores(score, machine)
            true_shapes: dict[int, dict[str, Any]] = {}
            for item in simulator.shapes:
                true_shapes.setdefault(item.effect, {})[item.name] = item.sample(machine)
            found = linear.drawn(theta, noise)
            state = State(theta, true_shapes, found, batch.shape_values(found))
            return scalars(measures, state)

        self._function = jax.jit(jax.vmap(one))

    def __call__(self, first: int, count: int) -> dict[str, np.ndarray]:
        with ThreadPoolExecutor(cores()) as pool:
            found = list(pool.map(self._part, range(first, first + count, _TOGETHER)))
        return {name: np.concatenate([part[name] for part in found]) for name in found[0]}

    def _part(self, first: int) -> dict[str, np.ndarray]:
        sequence = np.random.SeedSequence([self.seed, first])
        random = np.random.Generator(np.random.Philox(sequence))
        scores, noise = (random.standard_normal((_TOGETHER, size)) for size in self.sizes)
        index = np.arange(first, first + _TOGETHER, dtype=np.uint32)
        values = self._function(index, scores, noise)
        return {name: np.asarray(value) for name, value in values.items()}


@dataclass(frozen=True)
class _Statistics:
    """What pairs say about the difference between exact and linear draws."""

    exact: np.ndarray
    """(n, q)."""
    beside: np.ndarray
    coverage: float

    @classmethod
    def of(cls, exact: np.ndarray, beside: np.ndarray, coverage: float) -> "_Statistics":
        """From pairs, without those that failed."""
        whole = np.isfinite(exact).all(1) & np.isfinite(beside).all(1)
        if whole.sum() < 2:
            raise StudyError(
                "two-level Monte Carlo: found no draw with an identification, expected most of "
                "them; check the declared sizes and the plan with vcal check"
            )
        return cls(exact[whole], beside[whole], coverage)

    @property
    def explained(self) -> np.ndarray:
        """Share (q,) of the variance that the linear draws explain."""
        whole, left = self.exact.var(0), (self.exact - self.beside).var(0)
        return np.where(whole > 0.0, 1.0 - left / np.where(whole > 0.0, whole, 1.0), left == 0.0)

    @property
    def squares(self) -> np.ndarray:
        """(n, q): contribution of every pair to the difference of the variances."""
        both = (self.exact, self.beside)
        return np.subtract(*((values - values.mean(0)) ** 2 for values in both))

    @property
    def largest_ratio(self) -> float:
        """Largest ratio rho of the variance of a pair to that of an exact draw, of all outputs, for
        u and both ends of the interval.
        """
        varies = self.exact.std(0) > 0.0
        whole = ((self.exact - self.exact.mean(0)) ** 2).var(0)
        ratios = [self.squares.var(0)[varies] / whole[varies]]
        for p in self._ends:
            step = 0.25 * min(p, 1.0 - p)
            low, end, high = np.quantile(self.exact, [p - step, p, p + step], axis=0)
            share = self._between(end, (high - low) / (2.0 * step))
            ratios.append(share[varies] / (p * (1.0 - p)))
        return float(max((ratio.max(initial=0.0) for ratio in ratios), default=0.0))

    @property
    def _ends(self) -> tuple[float, float]:
        return 0.5 * (1.0 - self.coverage), 0.5 * (1.0 + self.coverage)

    def _below(self, ends: np.ndarray) -> np.ndarray:
        """(n, q): 1[Y <= end] - 1[L <= end]."""
        return (self.exact <= ends).astype(np.int8) - (self.beside <= ends).astype(np.int8)

    def _between(self, end: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Share (q,) of the pairs of which one result is below an end and the other above it.

        It is counted or, where fewer than `_COUNTED` pairs lie there, the mean of |Y - L| times the
        density 1/slope.
        """
        density = np.where(slope > 0.0, 1.0 / np.where(slope > 0.0, slope, 1.0), 0.0)
        expected = np.abs(self.exact - self.beside).mean(0) * density
        counted = np.abs(self._below(end)).sum(0)
        return np.where(counted < _COUNTED, expected, counted / len(self.exact))

    def corrected(self, many: Ensemble, labels: Sequence[str]) -> dict[str, np.ndarray]:
        """Mean, u and interval of the exact outputs with their standard errors, as the fields of
        `TwoLevel`, from linear draws and these pairs.
        """
        n, big = len(self.exact), many.draws
        apart = self.exact - self.beside
        mean = many.mean[: len(labels)] + apart.mean(0)
        variance = np.diag(many.covariance)[: len(labels)]
        both = variance + self.squares.sum(0) / (n - 1)
        u = np.sqrt(np.maximum(both, 0.0))
        error_of_mean = np.sqrt(variance / big + apart.var(0) / n)
        fourth = ((self.beside - self.beside.mean(0)) ** 2).var(0)
        spread = np.sqrt(fourth / big + self.squares.var(0) / n)
        error_of_u = spread / np.where(u > 0.0, 2.0 * u, 1.0)
        (low, error_of_low), (high, error_of_high) = (
            self._end(many, labels, p) for p in self._ends
        )
        return {
            "mean": mean, "u": u, "low": low, "high": high, "error_of_mean": error_of_mean,
            "error_of_u": error_of_u, "error_of_low": error_of_low, "error_of_high": error_of_high,
            "explained": self.explained,
        }  # fmt: skip

    def _end(
        self, many: Ensemble, labels: Sequence[str], p: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Quantile of every output and its standard error: where F_N(q) + mean(1[Y<=q] - 1[L<=q])
        is p.
        """
        shares = expit(logit(p) + np.linspace(-_REACH, _REACH, _SHARES))
        table = _quantiles(many, labels, shares)
        # Shares of the exact draws below each entry; they increase but for the chance of the pairs.
        below = np.array([self._below(ends).mean(0) for ends in table])
        of_exact = np.maximum.accumulate(shares[:, None] + below, axis=0)
        at = np.array([np.interp(p, *one) for one in zip(of_exact.T, table.T, strict=True)])
        near = _SHARES // 8
        middle = _SHARES // 2
        slope = (table[middle + near] - table[middle - near]) / (
            shares[middle + near] - shares[middle - near]
        )  # 1 / density
        variance = p * (1.0 - p) / many.draws + self._between(at, slope) / len(self.exact)
        return at, slope * np.sqrt(variance)


def _quantiles(many: Ensemble, labels: Sequence[str], shares: np.ndarray) -> np.ndarray:
    """Quantiles (shares, q) of the linear draws."""
    if many.kept == "exact":
        return np.quantile(many.values[:, : len(labels)], shares, axis=0, method="hazen")
    return np.array([[many.quantile(label, float(p)) for label in labels] for p in shares])
