"""Dependence of a residual on covariates and products of two, against its null distribution."""

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincc

from ...identification.fit import Fit
from ...machine.plan import DATA_SET, Plan
from ..empirical.covariates import angles_around, distinct_covariates
from ..screening.score_test import ScoreTest
from ..screening.significance import SILENT, corrected, effective_trials

_BINS = 10
_FEWEST = 10.0
"""Degrees of freedom from which dependence is tested. A covariate has ten bins, and of dozens of
products one always describes a handful of numbers."""
_ROUNDING = 1e-9
"""Mean share of the variance over null draws below which a share is rounding."""
_SHOWN = 3
"""Products of two covariates that are reported."""


def displacements(fit: Fit, residuals: np.ndarray | None = None) -> np.ndarray:
    """The displacement of the tool point (n, 3), m, that corresponds to each row's residual.

    Least squares of the residual on the ports of the tool, in the tool's frame. For instruments
    that read only angles, these are rotations about X, Y and Z times a lever arm (`Fit.by_tool`).
    """
    weights = np.einsum("nij,njp->nip", fit.whitener, fit.by_tool)
    values = fit.residual if residuals is None else residuals
    whitened = np.einsum("nij,nj...->ni...", fit.whitener, values)
    return np.einsum("npi,ni...->np...", np.linalg.pinv(weights), whitened)


def bins(x: np.ndarray) -> np.ndarray:
    """Bin index of every value: one bin per value up to 12 distinct values, else ten quantiles."""
    values = np.unique(x)
    if len(values) <= 12:
        return np.searchsorted(values, x)
    edges = np.quantile(x, np.linspace(0, 1, _BINS + 1)[1:-1])
    return np.searchsorted(edges, x)


class Dependence(NamedTuple):
    """What the residual depends on."""

    single: list[tuple[str, float]]
    """Covariates, each with the share of the variance that it describes alone, corrected for
    chance; largest first."""
    products: list[tuple[str, str, float]]
    """The same for products of two, beyond the part that is linear in either."""
    joint: bool
    """Whether the best product is less probable by chance than the best covariate alone."""
    p_value: float
    """Of the best, corrected for the number of covariates and products."""


def dependence(fit: Fit, draws: int, seed: int) -> Dependence:
    """Shares of the tool point's residual variance that ten bins of each covariate, and products of
    two, describe.

    They are compared with `draws` null residuals. The result is empty where there are too few
    degrees of freedom.
    """
    if fit.dof < _FEWEST:
        return Dependence([], [], False, 1.0)
    moved = _moved(fit, draws, seed)
    total = (moved**2).sum((0, 1))
    if not total[1:].any():
        return Dependence([], [], False, 1.0)  # the readings do not depend on the tool's position
    total = np.maximum(total, SILENT * total[1:].mean())
    plan, used = fit.measurement.plan, fit.used
    known = {name: x[used] for name, x in distinct_covariates(plan).items()}
    known = {name: x for name, x in known.items() if np.unique(x[np.isfinite(x)]).size > 1}
    names, singles = _alone(known, moved, total)
    pairs, products = _multiplied(known, plan, moved, total)
    if not names and not pairs:
        return Dependence([], [], False, 1.0)
    rare = np.concatenate([_rarity(singles), _rarity(products)])
    best, best_null = rare[:, 0].max(), rare[:, 1:].max(0)
    exceeding = int((best_null >= best).sum())
    p_value = (1.0 + exceeding) / (draws + 1.0)
    if exceeding == 0:  # beyond the draws: corrected for the trials, as in the screening
        trials = effective_trials(math.log(10.0) * best_null)
        p_value = min(p_value, float(corrected(math.log(10.0) * best, trials)))
    usual = float(best_null.mean())
    count = len(names)
    beyond_chance = [(names[i], share) for i, share in _by_share(singles) if rare[i, 0] > usual]
    joined = [(*pairs[i], share) for i, share in _by_share(products) if rare[count + i, 0] > usual]
    # Both probabilities may underflow. The larger share then decides.
    rarest = [
        max(zip(part[:, 0], table[:, 0], strict=True), default=(0.0, 0.0))
        for part, table in ((rare[:count], singles), (rare[count:], products))
    ]
    joint = bool(joined) and rarest[1] > rarest[0]
    return Dependence(beyond_chance, joined[:_SHOWN], joint, p_value)


def _moved(fit: Fit, draws: int, seed: int) -> np.ndarray:
    """Displacements of the tool point (used rows, 3, 1 + draws) by the residual, followed by those
    by null residuals; for several data sets in units of the scatter of each.
    """
    state = ScoreTest(fit, draws, seed)
    used = fit.used
    inverse = np.linalg.pinv(np.einsum("nij,njp->nip", fit.whitener[used], fit.by_tool[used]))
    data = np.einsum("npi,ni->np", inverse, state.residual[used])
    null = np.einsum("npi,nid->npd", inverse.astype(np.float32), state.null[used])
    both = np.concatenate([data[:, :, None], null], axis=2)
    for rows in fit.measurement.plan.parts.values() if fit.measurement.plan.sets else ():
        # In units of its own scatter: a precise data set would be masked by a coarse one.
        mine = rows[used]
        if not mine.any():
            continue
        scatter = np.sqrt(np.mean(both[mine][:, :, 1:] ** 2))
        if fit.chi2_and_dof(rows)[1] < 1.0 or scatter == 0.0:
            both[mine] = 0.0  # its own parameters leave nothing of it but rounding
        else:
            both[mine] /= scatter
    return both


def _alone(
    known: Mapping[str, np.ndarray], moved: np.ndarray, total: np.ndarray
) -> tuple[list[str], np.ndarray]:
    """Covariates, and the shares (covariates, 1 + draws) of the total that each describes."""
    names, shares = [], []
    for name, x in known.items():
        there = np.isfinite(x)
        index = bins(x[there])
        counts = np.bincount(index)
        sums = np.tensordot(np.eye(len(counts))[:, index], moved[there], 1)
        described = (sums**2 / np.maximum(counts, 1)[:, None, None]).sum((0, 1)) / total
        if described[1:].mean() < _ROUNDING:
            continue  # nuisances absorb all of it, such as the position of a sphere in every run
        names.append(name)
        shares.append(described)
    return names, np.array(shares).reshape(len(shares), len(total))


def _multiplied(
    known: Mapping[str, np.ndarray], plan: Plan, moved: np.ndarray, total: np.ndarray
) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Pairs of covariates, and the shares (pairs, 1 + draws) that the product of each describes."""
    # A group index is not a quantity to multiply by, unless there are only two groups. Nor is an
    # angle that wraps around.
    out = {*plan.groups, *angles_around(plan)}
    multiplied = {n for n in known if n not in out and np.isfinite(known[n]).all()}
    if len(plan.sets) == 2:
        multiplied.add(DATA_SET)
    pairs, columns = _products({n: x for n, x in known.items() if n in multiplied})
    along = np.tensordot(columns, moved, 1) if pairs else np.zeros((0, *moved.shape[1:]))
    shares = (along**2).sum(1) / total
    resolved = shares[:, 1:].mean(1) >= _ROUNDING
    return [pair for pair, one in zip(pairs, resolved, strict=True) if one], shares[resolved]


def _products(known: dict[str, np.ndarray]) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Pairs of covariates, and their products (pairs, n) without the part that is linear in either,
    of unit length.
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
    """-log10 of the probability of a share under the null hypothesis.

    Every row is compared with the gamma distribution that has the mean and variance of its null
    draws (columns from 1 on), so that rows with one and with thirty degrees of freedom are
    comparable. Each draw is compared with the others, without itself, as the data are compared with
    all draws.
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
    """Rows with their share corrected for chance, largest first."""
    if not len(table):
        return []
    expected = table[:, 1:].mean(1)
    corrected = np.maximum((table[:, 0] - expected) / np.maximum(1.0 - expected, 1e-9), 0.0)
    return [(int(i), float(corrected[i])) for i in np.argsort(-corrected)]
