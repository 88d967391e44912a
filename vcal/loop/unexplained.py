"""What remains and has no name: along which covariate, where, in which direction, how large."""

import math
from dataclasses import dataclass

import numpy as np

from ..fit import Fit
from .rivals import Rival
from .screen import Screen

_BINS = 10


@dataclass(frozen=True)
class Interval:
    """A stretch of a covariate, in SI."""

    covariate: str
    low: float
    high: float


@dataclass(frozen=True)
class Unexplained:
    """A residual that no effect of the catalogue explains."""

    depends_on: list[str]
    """Covariates, most telling first."""
    shares: list[float]
    """Share of the residual's variance each of them describes alone, corrected for chance."""
    where: list[Interval]
    direction: str
    """``"X"``, ``"Y"``, ``"Z"`` at the tool point, or ``"mixed"``."""
    size_um: float
    share_of_variance: float
    p_value: float
    reason: str
    bump: Rival | None = None
    """The local description, where there is one."""


def displacements(fit: Fit, residuals: np.ndarray | None = None) -> np.ndarray:
    """The displacement of the tool point (n, 3), m, that would give each row's residual.

    Least squares of the residual on the ports of the tool, in the tool's own frame.
    """
    ports = fit.port_jacobian[:, :, fit.model.layout.slice("tool")][:, :, :3]
    weights = np.einsum("nij,njp->nip", fit.whitener, ports)
    values = fit.residual if residuals is None else residuals
    whitened = np.einsum("nij,nj...->ni...", fit.whitener, values)
    return np.einsum("npi,ni...->np...", np.linalg.pinv(weights), whitened)


def covariates(fit: Fit) -> dict[str, np.ndarray]:
    """Everything the residual may depend on, by its name inside vcal; of columns that are the same
    but for scale and offset only the first.
    """
    plan = fit.measurement.plan
    found = {axis: np.asarray(plan.x(axis)) for axis in plan.axes}
    found |= {name: np.asarray(values) for name, values in plan.covariates.items()}
    found |= {
        name: np.asarray(values, float) for name, values in plan.groups.items() if name != "point"
    }
    distinct: dict[str, np.ndarray] = {}
    for name, x in found.items():
        if not np.isfinite(x).all() or np.ptp(x) == 0:
            continue
        if all(abs(np.corrcoef(x, other)[0, 1]) < 0.9999 for other in distinct.values()):
            distinct[name] = x
    return distinct


def bins(x: np.ndarray) -> np.ndarray:
    """Bin index of every value: its own category up to 12 distinct values, else ten quantiles."""
    values = np.unique(x)
    if len(values) <= 12:
        return np.searchsorted(values, x)
    edges = np.quantile(x, np.linspace(0, 1, _BINS + 1)[1:-1])
    return np.searchsorted(edges, x)


def dependence(fit: Fit, draws: int, seed: int) -> tuple[list[tuple[str, float]], float]:
    """Share of the tool point's residual variance described by ten bins of each covariate, with
    what chance gives taken off, best first; and the corrected p-value of the best.
    """
    state = Screen(fit, draws, seed)
    used = fit.used
    ports = fit.port_jacobian[used][:, :, fit.model.layout.slice("tool")][:, :, :3]
    inverse = np.linalg.pinv(np.einsum("nij,njp->nip", fit.whitener[used], ports))
    data = np.einsum("npi,ni->np", inverse, state.residual[used])
    null = np.einsum("npi,nid->npd", inverse.astype(np.float32), state.null[used])
    both = np.concatenate([data[:, :, None], null], axis=2)
    total = (both**2).sum((0, 1))
    names, shares = [], []
    for name, x in covariates(fit).items():
        index = bins(x[used])
        counts = np.bincount(index)
        sums = np.zeros((len(counts), *both.shape[1:]))
        np.add.at(sums, index, both)
        described = (sums**2 / np.maximum(counts, 1)[:, None, None]).sum((0, 1)) / total
        names.append(name)
        shares.append(described)
    table = np.array(shares)
    expected, spread = table[:, 1:].mean(1), table[:, 1:].std(1) + 1e-12
    score = (table - expected[:, None]) / spread[:, None]
    best, best_null = score[:, 0].max(), score[:, 1:].max(0)
    p_value = (1.0 + (best_null >= best).sum()) / (draws + 1.0)
    corrected = np.maximum((table[:, 0] - expected) / (1.0 - expected), 0.0)
    order = np.argsort(-corrected)
    telling = [(names[i], float(corrected[i])) for i in order if score[i, 0] > best_null.mean()]
    return telling, float(p_value)


def main_direction(vectors: np.ndarray) -> str:
    """The axis that carries more than 60 % of the squared length, or ``"mixed"``."""
    squares = (vectors**2).sum(0)
    if squares.sum() == 0:
        return "mixed"
    i = int(np.argmax(squares))
    return "XYZ"[i] if squares[i] > 0.6 * squares.sum() else "mixed"


def from_bump(fit: Fit, bump: Rival, p_value: float, draws: int, seed: int) -> Unexplained:
    """The description where a local bump explains more than every effect of the catalogue."""
    axis = bump.effect.placement
    place = len(fit.model.effects)
    shape = bump.fit.shapes[place]
    first = len(fit.model.entries)
    step = bump.fit.jacobian[:, first] * bump.fit.theta[first]
    n, m = fit.residual.shape
    moved = np.zeros((n, m))
    used = fit.used
    moved[used] = np.linalg.solve(fit.whitener[used], step.reshape(n, m)[used][:, :, None])[:, :, 0]
    vectors = displacements(fit, moved)[used]
    telling, _ = dependence(fit, draws, seed)
    others = [name for name, _ in telling if name != axis]
    shares = dict(telling)
    drop = (fit.chi2 - bump.fit.chi2) / max(fit.chi2 - fit.dof, bump.fit.chi2 / fit.dof)
    return Unexplained(
        depends_on=[axis, *others],
        shares=[shares.get(name, 0.0) for name in (axis, *others)],
        where=[
            Interval(
                axis,
                float(shape["centre"] - 2.0 * shape["width"]),
                float(shape["centre"] + 2.0 * shape["width"]),
            )
        ],
        direction=main_direction(vectors),
        size_um=float(np.linalg.norm(vectors, axis=1).max() * 1e6),
        share_of_variance=float(min(drop, 1.0)),
        p_value=p_value,
        reason="a local error describes the residual better than every effect of the catalogue",
        bump=bump,
    )


def from_structure(
    fit: Fit, chi2_per_dof: float, alpha: float, draws: int, seed: int
) -> Unexplained | None:
    """The description where the residual depends on covariates, or is far larger than declared."""
    telling, p_value = dependence(fit, draws, seed)
    spread = chi2_per_dof > 4.0
    if p_value > alpha and not spread:
        return None
    vectors = displacements(fit)[fit.used]
    excess = max(1.0 - 1.0 / chi2_per_dof, 0.0)
    size = math.sqrt((vectors**2).sum(1).mean() * (excess if spread else telling[0][1]))
    if spread and (not telling or telling[0][1] < 0.1):
        reason = (
            "the residual is far larger than the declared noise, and no single covariate "
            "describes a tenth of it: spread"
        )
    elif spread:
        reason = "the residual is far larger than the declared noise and depends on covariates"
    else:
        reason = "the residual depends on covariates in a way no effect of the catalogue has"
    return Unexplained(
        depends_on=[name for name, _ in telling],
        shares=[share for _, share in telling],
        where=[],
        direction=main_direction(vectors),
        size_um=size * 1e6,
        share_of_variance=excess if spread else float(telling[0][1]),
        p_value=p_value,
        reason=reason,
    )
