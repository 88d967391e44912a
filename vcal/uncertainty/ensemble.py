"""Results of a Monte Carlo campaign: moments, quantiles, coverage intervals and their precision."""

import difflib
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from .adaptive import Adaptive, Precision, Steps, step_size
from .intervals import Kind, check_coverage, coverage_interval
from .quantile_counts import Column, quantile_ranks
from .shapes import shape_of_counts, shape_of_values
from .summary import FieldSummary, Summary


@dataclass(frozen=True)
class FieldResult:
    """Statistics of a field, element by element."""

    name: str
    draws: int
    """Number of draws in which every element was finite; the others are left out."""
    failed: int
    """Number of draws with an element that was not finite."""
    mean: np.ndarray
    u: np.ndarray
    """Standard deviation; NaN for fewer than two draws."""
    minimum: np.ndarray
    maximum: np.ndarray
    quantiles: dict[float, np.ndarray]
    """Quantiles by probability."""
    bounds: dict[float, np.ndarray]
    """Bound of the error of each quantile against that of the draws; zero where it is exact."""


@dataclass(frozen=True)
class Ensemble:
    """Results of a Monte Carlo campaign with k scalar outputs and any number of fields.

    A draw in which an output is not finite is counted in `failed` and left out of all statistics of
    that output.
    """

    labels: tuple[str, ...]
    """Names of the scalar outputs: ``"V"``, ``"phi[1]"``."""
    draws: int
    """Number of draws, including failed ones."""
    mean: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"] = field(repr=False)
    """Covariance of the scalar outputs (JCGM 102, 7.6)."""
    minimum: Float[np.ndarray, " k"] = field(repr=False)
    maximum: Float[np.ndarray, " k"] = field(repr=False)
    failed: dict[str, int]
    """Number of draws that were not finite, by scalar output or field with any."""
    fields: dict[str, FieldResult] = field(repr=False)
    kept: Literal["exact", "sketch"]
    """Whether quantiles come from the values of all draws or from counts in fine bins."""
    values: Float[np.ndarray, "m k"] = field(repr=False)
    """Values of all draws, or of the first m of a campaign that is too large to keep all."""
    columns: tuple[Column, ...] = field(repr=False)
    """Counts in fine bins, one per scalar output; empty where quantiles are exact."""
    coverage: float
    """Coverage probability for which the campaign monitored its precision."""
    kind: Kind
    step: int
    """Draws of a sub-block (JCGM 101, 7.9.4 b) for that probability."""
    scatter: Precision = field(repr=False)
    """Precision for `coverage` and `kind`."""
    adaptive: Adaptive | None
    """End state of an adaptive campaign; None for a given number of draws."""
    interrupted: bool
    """Whether it was interrupted, with fewer draws than requested."""
    notes: tuple[str, ...] = ()
    """Remarks on the results."""

    @property
    def u(self) -> Float[np.ndarray, " k"]:
        """Standard uncertainty of every scalar output (JCGM 101, 7.6)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Float[np.ndarray, "k k"]:
        """Correlation of the scalar outputs; NaN where one does not vary."""
        u = np.where(self.u > 0.0, self.u, np.nan)
        return self.covariance / np.outer(u, u)

    @property
    def skewness(self) -> Float[np.ndarray, " k"]:
        """Skewness of every scalar output, zero for a symmetric one; computed on request.

        From the values of all draws, or, where not all were kept, from their counts in fine bins.
        NaN for an output that does not vary.
        """
        return self._shapes[:, 0]

    @property
    def excess_kurtosis(self) -> Float[np.ndarray, " k"]:
        """Kurtosis less that of a normal distribution, 3, of every scalar output; as `skewness`."""
        return self._shapes[:, 1]

    @property
    def _shapes(self) -> Float[np.ndarray, "k 2"]:
        if self.columns:
            return np.array([shape_of_counts(column) for column in self.columns])
        return np.array([shape_of_values(self._finite(at)) for at in range(len(self.labels))])

    def index(self, output: str) -> int:
        """Index of a scalar output; raises `ValueError` for an unknown name."""
        if output not in self.labels:
            close = difflib.get_close_matches(output, self.labels, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise ValueError(
                f"no scalar output is called {output!r}{hint}, expected one of "
                f"{', '.join(self.labels)}"
            )
        return self.labels.index(output)

    def interval(
        self, output: str, p: float = 0.95, kind: Kind = "symmetric"
    ) -> tuple[float, float]:
        """Coverage interval of a scalar output (JCGM 101, 7.7).

        `kind` is ``"symmetric"`` (probabilistically) or ``"shortest"``. Raises `ValueError` for
        too few draws, an unknown output or kind, or a probability outside (0, 1).
        """
        return self._interval(output, p, kind)[0]

    def interval_bound(self, output: str, p: float = 0.95, kind: Kind = "symmetric") -> float:
        """Bound of the error of the ends of `interval` against those of the values.

        Zero where all values were kept, otherwise the width of a bin there.
        """
        return self._interval(output, p, kind)[1]

    def quantile(self, output: str, probability: float) -> float:
        """Quantile of a scalar output: linear in (r - 1/2)/M between the ranked values y_(r)
        (JCGM 101, 7.5.1); NaN where every draw failed.
        """
        return self._quantile(output, probability)[0]

    def quantile_bound(self, output: str, probability: float) -> float:
        """Bound of the error of `quantile` against that of the values; zero where exact."""
        return self._quantile(output, probability)[1]

    def precision(self, p: float = 0.95, kind: Kind = "symmetric") -> Precision:
        """Standard deviations of y, u and of the ends of the coverage interval, per scalar output.

        They follow from the scatter between consecutive sub-blocks of draws (JCGM 101, 7.9.4),
        divided by the square root of their number. For a probability or kind other than the
        monitored one, and where not all values were kept, the scatter is that of the kept values.
        Infinite for fewer than two sub-blocks.
        """
        check_coverage(p)
        if (p, kind) == (self.coverage, self.kind):
            return self.scatter
        step = step_size(p)
        steps = Steps(len(self.labels), step, p, kind)
        steps.add(self.values)
        return steps.precision(self.draws // step)

    def _interval(self, output: str, p: float, kind: Kind) -> tuple[tuple[float, float], float]:
        at = self.index(output)
        if self.columns:
            return self.columns[at].interval(p, kind)
        return coverage_interval(self._finite(at), p, kind), 0.0

    def _quantile(self, output: str, probability: float) -> tuple[float, float]:
        if not 0.0 <= probability <= 1.0:
            raise ValueError(
                f"quantile: found probability {probability}, expected a number from 0 to 1"
            )
        at = self.index(output)
        if self.columns:
            return self.columns[at].quantile(probability)
        ordered = np.sort(self._finite(at))
        if not len(ordered):
            return np.nan, 0.0
        ranks, weights = quantile_ranks(len(ordered), probability)
        return float(weights @ ordered[ranks - 1]), 0.0

    def _finite(self, at: int) -> Float[np.ndarray, " n"]:
        """The finite values of a scalar output."""
        values = np.ascontiguousarray(self.values[:, at])
        return values[np.isfinite(values)] if self.failed.get(self.labels[at]) else values


def ensemble_of(
    summary: Summary, adaptive: Adaptive | None = None, interrupted: bool = False
) -> Ensemble:
    """The results of the draws in a summary."""
    labels, moments = summary.declared.labels, summary.moments
    count = np.diag(moments.count)
    finite = count > 0
    lost = dict(zip(labels, (summary.draws - count).tolist(), strict=True))
    lost |= {name: found.failed for name, found in summary.fields.items()}
    low = np.where(finite, moments.minimum, np.nan)
    high = np.where(finite, moments.maximum, np.nan)
    sketch, columns = summary.sketch, ()
    if sketch is not None:
        columns = tuple(sketch.column(low[k], high[k], k) for k in range(len(labels)))
    return Ensemble(
        labels=labels,
        draws=summary.draws,
        mean=moments.mean,
        covariance=moments.covariance,
        minimum=low,
        maximum=high,
        failed={name: number for name, number in lost.items() if number},
        fields={name: _field_result(found) for name, found in summary.fields.items()},
        kept="exact" if sketch is None else "sketch",
        values=summary.values,
        columns=columns,
        coverage=summary.declared.coverage,
        kind=summary.declared.kind,
        step=summary.declared.step,
        scatter=summary.steps.precision(),
        adaptive=adaptive,
        interrupted=interrupted,
    )


def _field_result(summary: FieldSummary) -> FieldResult:
    field, spread = summary.field, summary.spread
    some = spread.count > 0

    def shaped(values: np.ndarray, known: bool = some) -> np.ndarray:
        return (values if known else np.full_like(values, np.nan)).reshape(field.shape)

    dof = max(spread.count - 1, 1)
    found = summary.quantiles()
    return FieldResult(
        name=field.name,
        draws=spread.count,
        failed=summary.failed,
        mean=shaped(spread.mean),
        u=shaped(np.sqrt(spread.squares / dof), spread.count > 1),
        minimum=shaped(spread.minimum),
        maximum=shaped(spread.maximum),
        quantiles={q: shaped(v) for q, (v, _) in zip(field.quantiles, found, strict=True)},
        bounds={q: shaped(b) for q, (_, b) in zip(field.quantiles, found, strict=True)},
    )
