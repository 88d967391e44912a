"""A model identified from a measurement, and the quantities that follow from it directly."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from ..labelled import html_table
from ..machine.parameters import Parameter
from ..model.declared_noise import declared_whitener
from ..model.forward import Model, Shapes
from ..model.measurement import Measurement
from ..numerics.eigen import eigh
from ..numerics.least_squares import Status
from ..words import counted
from .labelled_fit import fit_dataset, fit_frame

POORLY_DETERMINED = 0.05
"""Share of information below which the data contain practically nothing about a parameter."""
_UNSEEN = 1e-8
"""Information (per solver unit squared) that counts as none: a standard deviation of 1e4 units."""
_FAINT = 1e-6
"""Information about a shape parameter, times the squared length of its scan, that counts as none:
the whole scan explains the readings equally well."""

_ROUNDING = 1e-13
"""Share of the information that may be rounding."""
_LEFT = 0.05
"""Least share of a reading's variance that is taken to remain after the fit of the parameters: with
less, the residual contains no information about the reading's error."""
_LOST = 1e-9
"""Singular value, relative to the largest, that counts as zero."""
_PART = 0.1
"""Component in a direction of unit length from which a parameter is listed."""
_LITTLE = 0.01
"""Share of the information from the data below which they contain almost nothing."""
_MOST_TOLD = 6
"""Number of directions that are listed; the others are counted."""


@dataclass(frozen=True)
class Fit:
    """A model identified from a measurement: numbers only.

    Whitened quantities have one row per reading, in the order of the rows of the plan. Parameters
    are in solver units (prior sigma, or the declared scale where the prior is flat). The linearised
    data equation is whitened(theta + d) = whitened - jacobian d.
    """

    model: Model
    measurement: Measurement
    theta: np.ndarray
    """Amplitudes, then zeros for the shape parameters that move (k,), solver units."""
    shapes: Shapes
    """Shape parameters (SI) by position of the effect in the model."""
    residual: np.ndarray = field(repr=False)
    """y - h, (n, m), SI."""
    whitener: np.ndarray = field(repr=False)
    """W (n, m, m); zero for rows that were left out."""
    whitened: np.ndarray = field(repr=False)
    """W (y - h), (n m,)."""
    jacobian: np.ndarray = field(repr=False)
    """W dh/dtheta, (n m, k)."""
    port_jacobian: np.ndarray = field(repr=False)
    """dh/dports (n, m, p), not whitened."""
    precision: np.ndarray = field(repr=False)
    """Diagonal of the prior precision L (k,), in solver units."""
    status: Status
    """Result of the minimisation; `status.prose` explains it."""
    steps: int
    """Number of steps of the minimisation."""
    rank: int
    """Rank of the Jacobian, including the rows of the prior."""

    @cached_property
    def condition(self) -> float:
        """Condition number of the Jacobian with the rows of the prior and columns of unit length;
        infinite where a column is zero.
        """
        singular = np.linalg.svd(_unit_columns(self), compute_uv=False)
        return float(singular[0] / singular[-1]) if singular[-1] > 0.0 else math.inf

    @property
    def converged(self) -> bool:
        """Whether `theta` is a minimum, with finite residuals and derivatives."""
        return self.status == Status.CONVERGED and self.finite

    @cached_property
    def finite(self) -> bool:
        """Whether parameters, residuals and derivatives are finite."""
        numbers = (self.theta, self.whitened, self.jacobian)
        return all(bool(np.isfinite(values).all()) for values in numbers)

    @property
    def determined(self) -> bool:
        """Whether data and prior determine every parameter, shape parameters within their scan.

        Two equal effects without a prior are not determined, nor is a bump between two readings,
        which contain no information about its position and size.
        """
        if not self.finite:
            return False
        information = (self.jacobian**2).sum(0)
        total = information + self.within_scans
        if not total.min(initial=math.inf) > _UNSEEN:
            return False
        for place, effect in enumerate(self.model.effects):
            if any(p.moves for p in effect.shapes):
                amplitudes, _ = self.places_of(place)
                if not information[amplitudes].max(initial=0.0) > _UNSEEN:
                    return False
        try:
            pivots = np.diag(self.factor[0]) ** 2
        except np.linalg.LinAlgError:
            return False
        # The information about a parameter that remains when the parameters before it are unknown.
        return bool((pivots > _ROUNDING * total).all())

    @cached_property
    def by_tool(self) -> np.ndarray:
        """Derivative of the readings by a displacement of the tool point (n, m, 3), in the frame of
        the tool, not whitened.

        In the `angular` rows, it is the derivative by the rotation of the tool that moves the end
        of the reading's lever arm (`Instrument.lengths`) by the same distance.
        """
        ports = self.port_jacobian[:, :, self.model.layout.slice("tool")]
        moved, turned = ports[:, :, :3], ports[:, :, 3:]
        if not self.angular.any():
            return moved
        given = self.measurement
        arms = self.model.instrument.lengths(given.plan, given.readings)[:, :, None]
        turned = np.divide(turned, arms, out=np.zeros_like(turned), where=arms > 0.0)
        return np.where(self.angular[:, None, None], turned, moved)

    @cached_property
    def angular(self) -> np.ndarray:
        """Rows (n,) of which no reading depends on the position of the tool point, such as those of
        a level.
        """
        ports = self.port_jacobian[:, :, self.model.layout.slice("tool")]
        return np.asarray(~ports[:, :, :3].any((1, 2)))

    @property
    def ways(self) -> str:
        """Names of the components of `by_tool`: X, Y, Z, or the rotations A, B, C about them where
        no reading depends on the position of the tool point.
        """
        return "ABC" if self.angular.all() else "XYZ"

    @cached_property
    def factor(self) -> tuple[np.ndarray, bool]:
        """Cholesky factor of H = J'J + L, for `scipy.linalg.cho_solve`.

        L includes the precision of shape parameters (`within_scans`): the readings may contain no
        information about the position of a kink between two poses, or about a knee at a load
        between the measured ones.

        Raises `LinAlgError` that names the parameters that neither readings nor priors determine.
        """
        if not self.finite:
            raise np.linalg.LinAlgError(
                "found no covariance, because the fit led to numbers that are not finite; expected "
                "readings, positions and declared sizes in the units of their names"
            )
        try:
            return cho_factor(self.hessian())
        except np.linalg.LinAlgError as error:
            free = ", ".join(undetermined(self)[:5])
            raise np.linalg.LinAlgError(
                f"found no covariance, expected readings or priors that determine every parameter"
                f"{free and ', also '}{free}; measure more, or leave out what is not determined"
            ) from error

    @cached_property
    def planned_covariance(self) -> np.ndarray:
        """H^-1 (k, k) in solver units: the covariance for readings with the declared noise,
        whatever the residuals are.

        A shape parameter that the readings do not determine lies within its scan (`within_scans`).
        """
        return cho_solve(self.factor, np.eye(len(self.theta)))

    @cached_property
    def within_scans(self) -> np.ndarray:
        """The prior precision (k,), with that of the shape parameters.

        A shape parameter has the variance of a uniform distribution over its scan, steps^2 / 12.
        """
        found, k = np.array(self.precision, float), len(self.model.entries)
        for effect in self.model.effects:
            moving = [p for p in effect.shapes if p.moves]
            grids = effect.scan(self.measurement.plan) if moving else {}
            for p in moving:
                found[k] = 12.0 / len(grids[p.name]) ** 2
                k += 1
        return found

    @cached_property
    def covariance(self) -> np.ndarray:
        """Posterior covariance (k, k), solver units: H^-1 (`planned_covariance`), or a robust one.

        Where the readings of a row share errors that the noise does not declare
        (`Instrument.clusters`), it is H^-1 (sum_i g_i g_i' + L) H^-1 with g_i = J_i'A_i r_i, which
        needs no model of the shared errors. Other rows have J_i'J_i in place of g_i g_i'. The fit
        has absorbed a part of r_i; the factor A_i = (1 - J_i H^-1 J_i')^(-1/2) restores it (Bell,
        McCaffrey, Survey Methodology 28, 2002, 169).
        """
        inverse = self.planned_covariance
        shared = self.clusters >= 0
        if not shared.any():
            return inverse
        n, m = self.residual.shape
        jacobian, whitened = self.jacobian.reshape(n, m, -1), self.whitened.reshape(n, m)
        mine, left = jacobian[shared], whitened[shared]
        values, vectors = eigh(np.eye(m) - mine @ inverse @ mine.transpose(0, 2, 1))
        turned = np.einsum("nij,ni->nj", vectors, left) / np.sqrt(np.maximum(values, _LEFT))
        left = np.einsum("nij,nj->ni", vectors, turned)
        scores = np.einsum("nik,ni->nk", mine, left)
        middle = scores.T @ scores + np.diag(self.within_scans)
        if not shared.all():
            others = jacobian[~shared].reshape(-1, jacobian.shape[2])
            middle += others.T @ others
        return inverse @ middle @ inverse

    @property
    def clusters(self) -> np.ndarray:
        """Cluster of shared errors of every row (n,), or -1 (`Instrument.clusters`)."""
        return self.model.instrument.clusters(self.measurement.plan)

    @property
    def used(self) -> np.ndarray:
        """Rows that took part in the fit (n,)."""
        return np.abs(self.whitener).sum((1, 2)) > 0

    @cached_property
    def counted(self) -> np.ndarray:
        """Readings that took part in the fit (n, m): those present in the used rows."""
        present = self.model.instrument.present(self.measurement.plan)
        return self.used[:, None] & present

    @property
    def chi2(self) -> float:
        """Sum of squared whitened data residuals."""
        return float(self.whitened @ self.whitened)

    @cached_property
    def normal(self) -> np.ndarray:
        """J'J (k, k), the matrix of the normal equations without the prior."""
        return self.jacobian.T @ self.jacobian

    @cached_property
    def dof(self) -> float:
        """Effective degrees of freedom: number of readings minus tr(J H^-1 J')."""
        hat = np.trace(cho_solve(self.factor, self.normal))
        return float(self.counted.sum() - hat)

    def chi2_and_dof(self, rows: np.ndarray) -> tuple[float, float]:
        """chi2 and degrees of freedom of some rows (n,): the sum of their squared whitened
        residuals, and the number of their readings minus their part of tr(J H^-1 J').
        """
        n, m = self.residual.shape
        mine = self.used & rows
        jacobian = self.jacobian.reshape(n, m, -1)[mine].reshape(-1, self.jacobian.shape[1])
        hat = np.einsum("ik,ki->", jacobian, cho_solve(self.factor, jacobian.T))
        squares = (self.whitened.reshape(n, m)[mine] ** 2).sum()
        return float(squares), float(self.counted[mine].sum() - hat)

    @property
    def entries(self) -> tuple[tuple[str, Parameter], ...]:
        """(effect with placement, parameter) of every entry of `theta`: the amplitudes, then the
        shape parameters that move.
        """
        return entries(self.model)

    def __repr__(self) -> str:
        state = "converged" if self.converged else self.status.prose
        return (
            f"Fit({counted(len(self.theta), 'parameter')} from "
            f"{counted(int(self.counted.sum()), 'reading')}, chi2 per degree of freedom "
            f"{self.chi2 / self.dof:.3g}, {state})"
        )

    def _repr_html_(self) -> str:
        rows = [
            (key, p.name, f"{value:.4g}", f"{u:.2g}", p.unit)
            for key, p, value, u in self.parameter_values()
        ]
        header = ("effect", "parameter", "value", "standard uncertainty", "unit")
        return html_table(repr(self), header, rows)

    def to_pandas(self) -> Any:
        """All parameters as a `pandas.DataFrame` (`labelled_fit.fit_frame`).

        Raises `ImportError` where pandas is not installed.
        """
        return fit_frame(self)

    def to_xarray(self) -> Any:
        """The estimated parameters with their covariance as an `xarray.Dataset` in SI units
        (`labelled_fit.fit_dataset`).

        Raises `ImportError` where xarray is not installed.
        """
        return fit_dataset(self)

    @property
    def information(self) -> np.ndarray:
        """Share of information from the data for each parameter (k,): 1 - posterior variance /
        prior variance; one for flat priors.
        """
        variance = np.diag(self.planned_covariance)
        return np.where(self.precision > 0, 1.0 - variance * self.precision, 1.0)

    @property
    def cost(self) -> float:
        """The minimised cost: chi2 + theta' L theta, with L the precision of the prior."""
        return self.chi2 + float(self.theta**2 @ self.precision)

    def log_evidence(self, noise_scale: float = 1.0) -> float:
        """Laplace's approximation of ln p(y | model), up to a constant of the data alone:

            -chi2/2 - theta'L theta/2 + ln det L/2 - ln det H/2 + ln det W + ln p(shapes).

        The prior of a shape parameter is uniform over its scan: its density is one over the number
        of steps, and only the part of the normal distribution within the scan counts (`log_scan`).
        Parameters with a flat prior enter with a unit of their scale, the same in all models that
        are compared. `noise_scale` multiplies the declared noise; the minimum then moves
        (`step_at`).
        """
        s2 = noise_scale**2
        proper = self.precision > 0
        h = self.hessian(noise_scale)
        log_h = np.linalg.slogdet(h)[1]
        step = self.step_at(noise_scale)
        theta = self.theta + step
        prior = theta[proper] ** 2 @ self.precision[proper]
        left = self.whitened - self.jacobian @ step
        noise = np.linalg.slogdet(self.whitener[self.used])[1].sum()
        # A reading that a row does not have is a diagonal element of W, without meaning.
        diagonal = np.einsum("nii->ni", self.whitener)
        noise -= np.log(diagonal[self.used[:, None] & ~self.counted]).sum()
        readings = self.counted.sum()
        return float(
            -0.5 * (float(left @ left) / s2 + prior + log_h)
            + 0.5 * np.log(self.precision[proper]).sum()
            + noise
            - readings * math.log(noise_scale)
            + sum(self.log_scan(i, h) for i in range(len(self.model.effects)))
        )

    def step_at(self, noise_scale: float) -> np.ndarray:
        """The step (k,) from theta to the minimum of the linearised problem for a noise of
        `noise_scale` times that of the fit: H^-1 (J'r / s^2 - L theta), at fixed shape parameters.
        """
        step, k = np.zeros(len(self.theta)), len(self.model.entries)
        if noise_scale != 1.0:
            s2, precision = noise_scale**2, self.precision[:k]
            h = self.normal[:k, :k] / s2 + np.diag(precision)
            uphill = self.jacobian[:, :k].T @ self.whitened / s2 - precision * self.theta[:k]
            step[:k] = np.linalg.solve(h, uphill)
        return step

    def hessian(self, noise_scale: float = 1.0) -> np.ndarray:
        """H = J'J / s^2 + L (k, k), with L from `within_scans`."""
        return self.normal / noise_scale**2 + np.diag(self.within_scans)

    def log_scan(self, place: int, h: np.ndarray) -> float:
        """Contribution of the shape parameters of the effect at `place` to the log evidence with
        the Hessian `h`, in addition to the determinant of `h`.

        For each parameter it is the logarithm of the share of its scan (n steps) that explains the
        readings, with no other prior. The readings alone determine the parameter with the precision
        1/sigma^2 = 1/(H^-1)_kk - 12/n^2. The share is the integral of exp(-x^2 / 2 sigma^2) over
        the scan, divided by n.
        """
        effect = self.model.effects[place]
        before = self.model.effects[:place]
        k = len(self.model.entries) + sum(p.moves for e in before for p in e.shapes)
        grids, found = effect.scan(self.measurement.plan), 0.0
        for p in (p for p in effect.shapes if not p.known):
            steps = len(grids[p.name])
            found -= math.log(steps)
            if p.moves:
                unit = np.zeros(len(h))
                unit[k] = 1.0
                variance = float(np.linalg.solve(h, unit)[k])
                precision = max(1.0 / variance - 12.0 / steps**2, _FAINT / steps**2)
                u = math.sqrt(2.0 / precision)
                # Half a step more at either end: the prior is spread evenly over the steps.
                at = self.shapes[place][p.name]
                order = np.argsort(grids[p.name])
                below = 0.5 + float(np.interp(at, grids[p.name][order], np.arange(steps)[order]))
                inside = 0.5 * (math.erf(below / u) + math.erf((steps - below) / u))
                found += math.log(math.sqrt(math.pi) * u * inside) - 0.5 * math.log(variance)
                k += 1
        return found

    def parameter_values(self) -> list[tuple[str, Parameter, float, float]]:
        """(effect, parameter, value, standard uncertainty) of all parameters, in the units of the
        parameters.

        The uncertainty of a shape parameter without a derivative (the time of a jump) is nan, that
        of a known one is zero.
        """
        sigma = np.sqrt(np.diag(self.covariance))
        found, k = [], 0
        for entry in self.model.entries:
            p = entry.parameter
            found.append(
                (entry.key, p, p.mean + self.theta[k] * p.step / p.si, sigma[k] * p.step / p.si)
            )
            k += 1
        for i, effect in enumerate(self.model.effects):
            for p in effect.shapes:
                value = float(self.shapes[i][p.name])
                if p.moves:
                    step = shape_step(p, value, effect.scan(self.measurement.plan))
                    found.append((effect.key, p, value / p.si, sigma[k] * step / p.si))
                    k += 1
                else:
                    u = 0.0 if p.known else math.nan
                    found.append((effect.key, p, value / p.si, u))
        return found

    def values_of(self, place: int) -> list[tuple[str, Parameter, float, float]]:
        """`parameter_values` of the effect at `place` in the model, amplitudes first."""
        values, effects = self.parameter_values(), self.model.effects
        shapes = len(self.model.entries) + sum(len(e.shapes) for e in effects[:place])
        return [
            *values[self.model.places[place]],
            *values[shapes : shapes + len(effects[place].shapes)],
        ]

    def places_of(self, place: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions in `theta` of the amplitudes of the effect at `place` in the model, and of its
        shape parameters that move.
        """
        count = len(self.model.entries)
        moving = [sum(p.moves for p in e.shapes) for e in self.model.effects]
        start = count + sum(moving[:place])
        amplitudes = np.arange(count)[self.model.places[place]]
        return amplitudes, np.arange(start, start + moving[place])


def entries(model: Model) -> tuple[tuple[str, Parameter], ...]:
    """(effect with placement, parameter): the amplitudes of all effects, then all shape parameters
    that move.
    """
    amplitudes = [(entry.key, entry.parameter) for entry in model.entries]
    shapes = [(e.key, p) for e in model.effects for p in e.shapes if p.moves]
    return (*amplitudes, *shapes)


def shape_step(parameter: Parameter, value: float, grids: Mapping[str, np.ndarray]) -> float:
    """The solver unit of a shape parameter: the step of its scan at `value` (SI)."""
    grid, step = grids[parameter.name], 0.0
    if len(grid) > 1:
        step = float(np.abs(np.gradient(grid))[np.argmin(np.abs(grid - value))])
    # A scan of one value, or of equal values, has no step.
    return step or max(abs(value), parameter.si) * 0.1


def _unit_columns(fit: Fit) -> np.ndarray:
    """The Jacobian with the rows of the prior and with columns of unit length (or zero)."""
    whole = np.concatenate([fit.jacobian, np.diag(np.sqrt(fit.precision))])
    length = np.linalg.norm(whole, axis=0)
    return whole / np.where(length > 0.0, length, 1.0)


def undetermined(fit: Fit) -> list[str]:
    """Names of the parameters in combinations that neither the data nor a prior determine.

    These have a component in a right singular vector of the Jacobian (columns of unit length,
    including the rows of the prior) whose singular value is zero to rounding.
    """
    _, s, vt = np.linalg.svd(_unit_columns(fit), full_matrices=False)
    part = np.abs(vt[s <= _LOST * s[0]]).max(0, initial=0.0)
    names = [f"{key} {p.name}" for key, p in fit.entries]
    return [name for name, share in zip(names, part, strict=True) if share > _PART]


class Learnt(NamedTuple):
    """How much of the space of the parameters with a proper prior the data determine."""

    directions: int
    """Dimension of the space."""
    determined: int
    """Number of directions whose posterior variance is below half the prior variance."""
    unseen: int
    """Number of directions about which the data contain almost no information."""
    hardly: tuple[str, ...]
    """Parameters with a share of information below `POORLY_DETERMINED`."""

    @classmethod
    def of(
        cls,
        entries: Sequence[tuple[str, Parameter]],
        root_precision: Float[np.ndarray, " k"],
        covariance: Float[np.ndarray, "k k"],
    ) -> "Learnt":
        """From the square root of the prior precision and the posterior covariance.

        The directions are the eigenvectors of this covariance in units of the prior. The share of
        information of a direction is 1 - variance.
        """
        proper = np.flatnonzero(root_precision > 0.0)
        if not len(proper):
            return cls(0, 0, 0, ())
        root = root_precision[proper]
        scaled = covariance[np.ix_(proper, proper)] * np.outer(root, root)
        shares = 1.0 - np.linalg.eigvalsh(scaled)
        names = [f"{key}: {p.name}" for key, p in (entries[k] for k in proper.tolist())]
        hardly = [
            n for n, v in zip(names, np.diag(scaled), strict=True) if 1.0 - v < POORLY_DETERMINED
        ]
        determined, unseen = int((shares > 0.5).sum()), int((shares < _LITTLE).sum())
        return cls(len(proper), determined, unseen, tuple(hardly))


def null_directions(fit: Fit) -> list[str]:
    """Combinations of parameters about which the data contain almost no information, as texts.

    These are the directions in which less than a hundredth of the information comes from the data:
    right singular vectors of the Jacobian (solver units) with s^2 / (s^2 + 1) < 0.01. Six are
    listed, each by the parameters that make up nine tenths of its square, and the others counted.
    """
    systematic = np.array([p.informed and not p.known for _, p in fit.entries])
    nuisance = fit.precision == 0
    jacobian = fit.jacobian[:, systematic]
    if nuisance.any():
        q, _ = np.linalg.qr(fit.jacobian[:, nuisance])
        jacobian = jacobian - q @ (q.T @ jacobian)
    _, s, vt = np.linalg.svd(jacobian, full_matrices=len(jacobian) < jacobian.shape[1])
    s = np.pad(s, (0, len(vt) - len(s)))
    names = [p.name for (_, p), kept in zip(fit.entries, systematic, strict=True) if kept]
    unseen = [v for v, size in zip(vt, s, strict=True) if size**2 / (size**2 + 1.0) < _LITTLE]
    found = []
    for v in unseen[::-1][:_MOST_TOLD]:
        order = np.argsort(-np.abs(v))
        count = int(np.searchsorted(np.cumsum(v[order] ** 2), 0.9)) + 1
        parts = [f"{v[i]:+.2f} {names[i]}" for i in order[: min(count, 5)]]
        more = f" and {count - 5} more" if count > 5 else ""
        found.append(" ".join(parts) + more)
    if len(unseen) > _MOST_TOLD:
        found.append(f"and {len(unseen) - _MOST_TOLD} further directions")
    return found


def normalised_residuals(fit: Fit) -> Float[np.ndarray, "n m"]:
    """W (y - h) of every row with the declared noise, also of rows that were left out."""
    whitener = declared_whitener(fit.model, fit.measurement)
    return np.einsum("nij,nj->ni", whitener, fit.residual)


def declared_chi2(fit: Fit, rows: Bool[np.ndarray, " n"] | None = None) -> float:
    """Sum of the squared `normalised_residuals` over the used rows, or over `rows` (n,)."""
    return float((normalised_residuals(fit)[fit.used if rows is None else rows] ** 2).sum())
