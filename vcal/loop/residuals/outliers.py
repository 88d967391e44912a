"""Outliers: single rows far outside the distribution of all others."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import gammainccinv

from ...identification.fit import Fit, normalised_residuals
from ...machine.plan import DATA_SET, Plan
from ...model.declared_noise import declared_whitener
from ...numerics.eigen import eigh
from ..empirical.covariates import distinct_covariates
from ..screening.significance import LEAST_NOISE, minus_log_chi2_tail
from .dependence import bins

_CHANCE = 1e-3
"""Probability that any row of a clean measurement is suspected; also that rows at random places
cluster as much as those that count as a structure."""
_FEW = 3
_MOST = 0.05
"""Largest share of suspected rows that may be outliers; more are a structure."""
_MOST_APART = 0.1
"""The same for rows that are only predicted, of which there are few."""
_LASTING = 2
"""Number of successive suspected rows that are no outliers where all are displaced alike. Two must
agree within their noise, because one pair of random vectors in ten agrees roughly."""
_BEYOND = 3.0
"""Ratio of the distances of successive rows from which a few are outliers even where a structure is
missing from the model."""
_FREE = 1e-6
"""Least share of a reading's variance that the fit leaves for the reading to be testable. The
position of three balls normal to their plane, for example, determines their pose alone."""
_ALIKE = 0.2
"""Rows are displaced alike where one displacement of the tool leaves less than this share of their
chi-square, both per degree of freedom."""


@dataclass(frozen=True)
class Outlier:
    """A suspected reading."""

    row: int
    distance: float
    """Mahalanobis distance of the row's residual, in robust standard deviations."""
    p_value: float


def outlying_rows(fit: Fit, robust: Callable[[], tuple[Fit, np.ndarray]]) -> list[Outlier]:
    """Rows whose own residual has a probability below 1e-3 / rows, given the robust scale of all.

    Several outliers are searched for in a robust fit: `robust` returns that fit and its weights
    (`vcal.identification.robust`). More than 5 % of the rows, or rows that cluster along a recorded
    quantity, are systematic. Only those far beyond them are then returned.
    """
    found = _outstanding(fit, np.ones(len(fit.used)))
    if len(found) <= 1:
        return found
    found = _outstanding(*robust())
    return found if scattered(fit, [s.row for s in found]) else _far_beyond(found)


def outliers_apart(fit: Fit, apart: np.ndarray) -> list[Outlier]:
    """Outliers among the rows `apart` (n,) that are only predicted: those far beyond the errors of
    the others.

    Effects that are missing from the model show in these rows too. The rows are therefore compared
    with their own scale, not with the noise, and only a few can be identified.
    """
    outliers: list[Outlier] = []
    whitened = np.einsum("nij,nj->ni", declared_whitener(fit.model, fit.measurement), fit.residual)
    present = fit.model.instrument.present(fit.measurement.plan)
    squares = np.where(present, whitened, 0.0) ** 2
    for inside in fit.measurement.plan.parts.values():
        rows = np.flatnonzero(apart & inside)
        if len(rows):
            readings = present[rows].sum(1)
            found = _improbable(rows, squares[rows].sum(1), readings, len(rows))
            outliers += _far_beyond(found, min(_FEW, int(_MOST_APART * len(rows))))
    return outliers


def _far_beyond(found: Sequence[Outlier], most: int = _FEW) -> list[Outlier]:
    """At most `most` of the improbable rows, where they are much further out than all others."""
    ordered = sorted(found, key=lambda s: -s.distance)
    ends = [s.distance for s in ordered] + [0.0]
    for k in range(min(most, len(ordered)), 0, -1):
        if ends[k - 1] > _BEYOND * ends[k]:
            return ordered[:k]
    return []


def scattered(fit: Fit, found: Sequence[int]) -> bool:
    """Whether these rows may be outliers: few, and not clustered along a recorded quantity."""
    rows = np.flatnonzero(fit.used)
    if len(found) > max(_FEW, _MOST * len(rows)):
        return False
    return len(found) <= _FEW or not _gathered(fit, rows, found)


def too_many(fit: Fit) -> list[Outlier]:
    """Outliers at random places, where there are more than may be left out; empty where they are
    fewer, or cluster along a recorded quantity.
    """
    found = _outstanding(fit, np.ones(len(fit.used)))
    rows = np.flatnonzero(fit.used)
    if len(found) <= max(_FEW, _MOST * len(rows)) or _gathered(fit, rows, [s.row for s in found]):
        return []
    return found


def displaced(fit: Fit, found: Sequence[int]) -> set[int]:
    """Those of these rows, left out of the fit, that a displacement of the tool explains: two or
    more at the end or at the beginning of a pose, a run or a data set, all displaced alike.

    Something moved there and stayed. An outlier is single, or followed by good readings of the same
    pose.
    """
    plan = fit.measurement.plan
    suspected = np.isin(np.arange(plan.rows), found)
    whitener = declared_whitener(fit.model, fit.measurement)
    present = fit.model.instrument.present(plan)
    residual = normalised_residuals(fit)
    ports = np.einsum("nij,njp->nip", whitener, fit.by_tool)

    def alike(rows: np.ndarray) -> bool:
        columns, data = ports[rows].reshape(-1, 3), residual[rows].ravel()
        moved, _, rank, _ = np.linalg.lstsq(columns, data)
        left = float(((data - columns @ moved) ** 2).sum())
        n = int(present[rows].sum())
        if n <= rank or left * n >= _ALIKE * (data @ data) * (n - rank):
            return False
        return len(rows) > 2 or left < 2.0 * gammainccinv(0.5 * (n - rank), _CHANCE)

    lasting: set[int] = set()
    for _, mine in _together(plan, fit.used | suspected):
        good = np.flatnonzero(~suspected[mine])
        first, last = (good[0], good[-1] + 1) if len(good) else (0, 0)
        # Good readings next to the step may be suspected too, so that any part may be the step.
        for side in (mine[:first], mine[last:][::-1]):
            if any(alike(side[:k]) for k in range(_LASTING, len(side) + 1)):
                lasting |= set(side.tolist())
    return lasting


def at_an_end(fit: Fit, found: Sequence[int]) -> dict[int, str]:
    """Those of these rows that are the first or the last of a pose, a run or a data set, with their
    place in words. A displacement at that moment would look the same.
    """
    suspected = np.isin(np.arange(fit.measurement.plan.rows), found)
    ends: dict[int, str] = {}
    for group, mine in _together(fit.measurement.plan, fit.used | suspected):
        if len(mine) > _FEW:
            for row, way in ((mine[0], "first"), (mine[-1], "last")):
                if suspected[row]:
                    # A group that only one data set has is named with the data set.
                    common = group.rpartition(":")[2] or DATA_SET
                    ends[int(row)] = f"the {way} of its {common.replace('_', ' ')}"
    return ends


def _together(plan: Plan, taken: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """The rows that were taken, in time order, of each data set and of each of its poses, runs and
    other groups, with the name of the group (empty for a data set).
    """
    for inside in plan.parts.values():
        rows = plan.in_time(np.flatnonzero(taken & inside))
        yield "", rows
        for group, index in plan.groups.items():
            changes = np.flatnonzero(np.diff(np.asarray(index)[rows])) + 1
            yield from ((group, mine) for mine in np.split(rows, changes))


def _outstanding(fit: Fit, weights: np.ndarray) -> list[Outlier]:
    """Rows too far out, by residuals with the covariance I - J_i H^-1 J_i' of the fit, and by the
    scale of their data set.
    """
    n, m = fit.residual.shape
    jacobian = fit.jacobian.reshape(n, m, -1)
    whitened = fit.whitened.reshape(n, m)
    solved = cho_solve(fit.factor, fit.jacobian.T).T.reshape(n, m, -1)
    own = np.eye(m) - np.einsum("nik,njk->nij", jacobian, solved)
    outliers = []
    for inside in fit.measurement.plan.parts.values():
        rows = np.flatnonzero(fit.used & inside)
        if not len(rows):
            continue
        values, vectors = eigh(own[rows])
        along = np.einsum("nij,ni->nj", vectors, whitened[rows])
        free = values > _FREE
        distance = np.where(free, along**2 / np.where(free, values, 1.0), 0.0).sum(1)
        # An absent reading is not a constraint of the fit and must not count.
        readings = free.sum(1) - (own.shape[1] - fit.counted[rows].sum(1))
        seen = readings > 0
        outliers += _improbable(
            rows[seen], (distance / weights[rows])[seen], readings[seen], int(fit.used.sum())
        )
    return outliers


def _improbable(
    rows: np.ndarray, squares: np.ndarray, readings: np.ndarray | int, count: int
) -> list[Outlier]:
    """Those of the rows whose squared distance, of so many `readings`, is too improbable for one of
    `count`, given the robust scale of all of them.
    """
    if not len(rows):
        return []
    median = 2.0 * gammainccinv(0.5 * np.asarray(readings, float), 0.5)
    scaled = squares / max(float(np.median(squares / median)), LEAST_NOISE**2)
    minus_log_p = minus_log_chi2_tail(scaled, readings)
    return [
        Outlier(int(rows[i]), float(np.sqrt(scaled[i])), float(np.exp(-minus_log_p[i])))
        for i in np.flatnonzero(minus_log_p > -np.log(_CHANCE / count))
    ]


def _gathered(fit: Fit, rows: np.ndarray, found: Sequence[int]) -> bool:
    """Whether more of the found rows share a bin of some covariate than rows at random would."""
    # Imported here because the import takes half as long as that of jax, and few data need it.
    from scipy.stats import hypergeom

    among = np.isin(rows, found)
    least, tried = 1.0, 0
    for x in distinct_covariates(fit.measurement.plan).values():
        there = np.isfinite(x[rows])
        index = bins(x[rows][there])
        size = np.bincount(index)
        inside = np.bincount(index[among[there]], minlength=len(size))
        p = hypergeom.sf(inside - 1, len(rows), size, len(found))
        least, tried = min(least, float(p.min())), tried + len(size)
    return least * tried < _CHANCE
