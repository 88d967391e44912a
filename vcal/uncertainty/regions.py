"""Coverage regions of several scalar outputs: from draws, and for normal ones (JCGM 102)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import fdtri, gamma, gammaincinv, ndtri, stdtrit

from ..numerics.eigen import eigh
from .ensemble import Ensemble
from .intervals import check_coverage


@dataclass(frozen=True)
class Ellipsoid:
    """Hyper-ellipsoid (eta - centre)' V^-1 (eta - centre) <= factor^2: an ellipse for two."""

    labels: tuple[str, ...]
    centre: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    """V."""
    factor: float
    """Coverage factor k_p."""
    coverage: float
    """Coverage probability p."""

    def contains(self, points: Float[np.ndarray, "n k"]) -> np.ndarray:
        """Whether each point lies in the region (n,)."""
        return _distance(points - self.centre, self.covariance) <= self.factor

    @property
    def axes(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Half-lengths of the principal axes, longest first, and their directions as columns.

        They are meaningful for outputs that share a unit.
        """
        squares, directions = eigh(self.covariance)
        return self.factor * np.sqrt(squares[::-1]), directions[:, ::-1]

    @property
    def volume(self) -> float:
        """Volume; the area of an ellipse."""
        k = len(self.centre)
        ball = math.pi ** (k / 2) / float(gamma(k / 2 + 1))
        return ball * self.factor**k * math.sqrt(float(np.linalg.det(self.covariance)))


@dataclass(frozen=True)
class Box:
    """Hyper-rectangle |eta_j - centre_j| <= factor u_j for every output j."""

    labels: tuple[str, ...]
    centre: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]
    factor: float
    """Coverage factor k_q."""
    coverage: float
    """Coverage probability p of the region as a whole."""

    @property
    def low(self) -> Float[np.ndarray, " k"]:
        """Lower ends of all sides."""
        return self.centre - self.factor * self.u

    @property
    def high(self) -> Float[np.ndarray, " k"]:
        """Upper ends of all sides."""
        return self.centre + self.factor * self.u

    def contains(self, points: Float[np.ndarray, "n k"]) -> np.ndarray:
        """Whether each point lies in the region (n,)."""
        return np.all(np.abs(points - self.centre) <= self.factor * self.u, axis=1)

    @property
    def volume(self) -> float:
        """Volume; the area of a rectangle."""
        return float(np.prod(2.0 * self.factor * self.u))


def coverage_ellipsoid(
    ensemble: Ensemble, outputs: Sequence[str] | None = None, p: float = 0.95
) -> Ellipsoid:
    """Elliptical coverage region from the draws themselves (JCGM 102, 7.7.2).

    Centre and shape are mean and covariance of the draws; k_p is the distance
    d^2 = (y - centre)' V^-1 (y - centre) that a share p of the draws does not exceed, whatever
    their distribution. Where not all values were kept, k_p is that of the kept draws.

    Raises `ValueError` for unknown outputs, too few draws, and linearly dependent outputs.
    """
    labels, centre, covariance, draws = _joint(ensemble, outputs, p)
    factor = _share(_distance(draws - centre, covariance), p)
    return Ellipsoid(labels, centre, covariance, factor, p)


def coverage_box(ensemble: Ensemble, outputs: Sequence[str] | None = None, p: float = 0.95) -> Box:
    """Rectangular coverage region from the draws themselves (JCGM 102, 7.7.3).

    k_q is the value of max_j |y_j - centre_j| / u_j that a share p of the draws does not exceed.
    Raises `ValueError` as `coverage_ellipsoid` does, and for an output that does not vary.
    """
    labels, centre, covariance, draws = _joint(ensemble, outputs, p)
    u = np.sqrt(np.diag(covariance))
    if not np.all(u > 0.0):
        fixed = labels[int(np.argmin(u))]
        raise ValueError(f"output {fixed!r} does not vary; leave it out of the region")
    factor = _share(np.max(np.abs(draws - centre) / u, axis=1), p)
    return Box(labels, centre, u, factor, p)


def normal_ellipsoid(
    labels: Sequence[str],
    estimate: Float[np.ndarray, " k"],
    covariance: Float[np.ndarray, "k k"],
    p: float = 0.95,
    dof: float = math.inf,
) -> Ellipsoid:
    """Elliptical coverage region of normal outputs (JCGM 102, 6.5.2 and 6.5.3).

    k_p^2 is the p-quantile of chi-squared with k degrees of freedom. A covariance that was
    estimated with `dof` degrees of freedom nu makes it k nu / (nu - k + 1) times that of
    F(k, nu - k + 1) (6.5.4, Hotelling).

    Raises `ValueError` where nu < k, or p is not above 0 and below 1.
    """
    check_coverage(p)
    k = len(estimate)
    if dof < k:
        raise ValueError(
            f"found {dof:g} degrees of freedom, expected at least {k} for a region of {k} outputs"
        )
    if math.isinf(dof):
        square = 2.0 * float(gammaincinv(0.5 * k, p))
    else:
        rest = dof - k + 1.0
        square = k * dof / rest * float(fdtri(k, rest, p))
    return Ellipsoid(tuple(labels), np.asarray(estimate), covariance, math.sqrt(square), p)


def normal_box(
    labels: Sequence[str],
    estimate: Float[np.ndarray, " k"],
    u: Float[np.ndarray, " k"],
    p: float = 0.95,
    dof: float = math.inf,
) -> Box:
    """Rectangular coverage region of normal outputs (JCGM 102, 6.5.2 and 6.5.3).

    Every side is a coverage interval for the probability q = p^(1/k). This is exact for
    uncorrelated outputs, and conservative for correlated ones (Sidak 1967, Journal of the American
    Statistical Association 62, 626). With degrees of freedom `dof`, Student's t replaces the normal
    distribution, which is conservative in any case.
    """
    check_coverage(p)
    tail = -0.5 * math.expm1(math.log(p) / len(estimate))  # (1 - q)/2
    factor = -float(ndtri(tail)) if math.isinf(dof) else -float(stdtrit(dof, tail))
    return Box(tuple(labels), np.asarray(estimate), np.asarray(u), factor, p)


def _joint(
    ensemble: Ensemble, outputs: Sequence[str] | None, p: float
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
    """Labels, mean, covariance and values of some outputs, for the draws without a failure."""
    check_coverage(p)
    labels = ensemble.labels if outputs is None else tuple(outputs)
    at = [ensemble.index(label) for label in labels]
    draws = ensemble.values[:, at]
    draws = draws[np.isfinite(draws).all(1)]
    if len(draws) * (1.0 - p) < 1.0:
        raise ValueError(
            f"found {len(draws)} draws without failure, expected at least {1.0 / (1.0 - p):.0f} "
            f"for a region of coverage probability {p}; draw more"
        )
    if len(draws) == ensemble.draws or ensemble.kept == "sketch" and not ensemble.failed:
        return labels, ensemble.mean[at], ensemble.covariance[np.ix_(at, at)], draws
    return labels, draws.mean(0), np.atleast_2d(np.cov(draws, rowvar=False)), draws


def _distance(
    apart: Float[np.ndarray, "n k"], covariance: Float[np.ndarray, "k k"]
) -> Float[np.ndarray, " n"]:
    """Mahalanobis distance; raises `ValueError` for a singular covariance."""
    u = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(np.where(u > 0.0, u, 1.0), np.where(u > 0.0, u, 1.0))
    rank = int(np.linalg.matrix_rank(scaled, hermitian=True))
    if rank < len(u):
        raise ValueError(
            f"found {rank} independent outputs among {len(u)}, so that the ellipsoid is flat; "
            "leave out those that do not vary or follow from others"
        )
    factor = np.linalg.cholesky(scaled)
    return np.sqrt(np.sum(np.linalg.solve(factor, (apart / u).T) ** 2, axis=0))


def _share(distances: Float[np.ndarray, " n"], p: float) -> float:
    """The distance that a share p of the draws does not exceed."""
    rank = math.floor(p * len(distances) + 0.5)  # as for intervals: JCGM 101, 7.7.2
    return float(np.partition(distances, rank - 1)[rank - 1])
