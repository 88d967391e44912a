"""A model identified from a measurement: numbers, and what follows from them directly."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve

from ..machine.parameters import Parameter
from ..model.declared_noise import declared_whitener
from ..model.forward import Model, Shapes
from ..model.measurement import Measurement
from ..numerics.least_squares import Status

HARDLY_TOLD = 0.05
"""Share of information below which the data have said practically nothing."""
_UNSEEN = 1e-8
"""Information (per solver unit squared) that counts as none: a standard deviation of 1e4 units."""
_FAINT = 1e-6
"""Of a shape parameter, times the squared length of its scan: its whole scan explains the readings
alike."""

_ROUNDING = 1e-13
"""Share of the information that may be rounding."""
_LEFT = 0.05
"""Least share of the variance of a reading that counts as left beside the parameters: what is left
of less tells nothing of what it was."""
_LOST = 1e-9
"""Singular value, over the largest one, that counts as zero."""
_PART = 0.1
"""Part in a direction of unit length from which a parameter is told."""
_LITTLE = 0.01
"""Share of the information from the data below which they say next to nothing."""
_MOST_TOLD = 6
"""Directions that are told; the rest is counted."""


@dataclass(frozen=True)
class Fit:
    """A model identified from a measurement: numbers only.

    Whitened quantities have one line per reading, row by row; parameters are in solver units
    (prior sigma, or the declared scale where the prior is flat). `whitened` = W (y - h), and
    `jacobian` = W dh/dtheta, so that the linearised data equation is
    whitened(theta + d) = whitened - jacobian d.
    """

    model: Model
    measurement: Measurement
    theta: np.ndarray
    shapes: Shapes
    residual: np.ndarray = field(repr=False)
    """y - h, (n, m), SI."""
    whitener: np.ndarray = field(repr=False)
    """(n, m, m); zero for rows that were left out."""
    whitened: np.ndarray = field(repr=False)
    jacobian: np.ndarray = field(repr=False)
    port_jacobian: np.ndarray = field(repr=False)
    """dh/dports (n, m, p), not whitened."""
    precision: np.ndarray = field(repr=False)
    """Diagonal of the prior precision L in solver units."""
    status: Status
    """How the minimisation ended; `status.prose` says it in words."""
    steps: int
    rank: int
    """Of the Jacobian, the prior's rows included."""

    @cached_property
    def condition(self) -> float:
        """Of the same with columns of unit length; infinite where one is zero."""
        singular = np.linalg.svd(_unit_columns(self), compute_uv=False)
        return float(singular[0] / singular[-1]) if singular[-1] > 0.0 else math.inf

    @property
    def converged(self) -> bool:
        """Whether `theta` is a minimum."""
        return self.status == Status.CONVERGED

    @property
    def determined(self) -> bool:
        """Whether data and prior tell every parameter, shapes by their scan. They do not tell two
        effects apart that are the same and have no prior; nor is a bump told that lies between two
        readings, which see neither its place nor its size.
        """
        information = (self.jacobian**2).sum(0)
        seen = information + self.within_scans
        if not seen.min(initial=math.inf) > _UNSEEN:
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
        # What is left of a parameter's information beside those before it.
        return bool((pivots > _ROUNDING * seen).all())

    @cached_property
    def by_tool(self) -> np.ndarray:
        """Derivative of the readings by a displacement of the tool point (n, m, 3), in the tool's
        own frame, not whitened. In the `angular` rows, by the turn of the tool that moves the end
        of the reading's lever arm (`Instrument.lengths`) as far.
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
        """Rows of which no reading changes where the tool point is displaced (n,): a level's."""
        ports = self.port_jacobian[:, :, self.model.layout.slice("tool")]
        return np.asarray(~ports[:, :, :3].any((1, 2)))

    @property
    def ways(self) -> str:
        """What the components of `by_tool` are called: X, Y, Z, or the turns A, B, C about them
        where no row sees the tool point.
        """
        return "ABC" if self.angular.all() else "XYZ"

    @cached_property
    def factor(self) -> tuple[np.ndarray, bool]:
        """Cholesky factor of H = J'J + L, for `scipy.linalg.cho_solve`; L with what is known of
        shape parameters (`within_scans`): readings may tell nothing of the place of a kink between
        two poses, or of a knee that is at loads between theirs.

        Raises `LinAlgError`, with their names, where neither readings nor priors tell parameters.
        """
        try:
            return cho_factor(self.hessian())
        except np.linalg.LinAlgError as error:
            free = ", ".join(undetermined(self)[:6])
            raise np.linalg.LinAlgError(
                f"found no covariance, expected readings or priors that tell every parameter"
                f"{free and ', also of '}{free}; measure more, or leave out what is not seen"
            ) from error

    @cached_property
    def planned_covariance(self) -> np.ndarray:
        """H^-1 in solver units: what readings of the declared noise leave, whatever the residuals
        turned out to be. A shape parameter that they do not tell is somewhere in its scan, and no
        further off (`within_scans`).
        """
        return cho_solve(self.factor, np.eye(len(self.theta)))

    @cached_property
    def within_scans(self) -> np.ndarray:
        """The prior precision, with that of the shape parameters: of a uniform distribution over
        the steps of the scan, whose variance is steps^2 / 12.
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
        """Posterior covariance H^-1 in solver units (`planned_covariance`).

        Where the readings of a row share errors that the noise does not declare
        (`Instrument.clusters`): H^-1 (sum_i g_i g_i' + L) H^-1 with g_i = J_i'A_i r_i, which needs
        no model of what they share; other rows have J_i'J_i in place of g_i g_i'. The fit has taken
        a part of r_i, which A_i = (1 - J_i H^-1 J_i')^(-1/2) gives back (Bell, McCaffrey, Survey
        Methodology 28, 2002, 169).
        """
        inverse = self.planned_covariance
        shared = self.clusters >= 0
        if not shared.any():
            return inverse
        n, m = self.residual.shape
        jacobian, whitened = self.jacobian.reshape(n, m, -1), self.whitened.reshape(n, m)
        mine, left = jacobian[shared], whitened[shared]
        values, vectors = np.linalg.eigh(np.eye(m) - mine @ inverse @ mine.transpose(0, 2, 1))
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
        """Index per row of those whose covariance is estimated together, or -1
        (`Instrument.clusters`).
        """
        return self.model.instrument.clusters(self.measurement.plan)

    @property
    def used(self) -> np.ndarray:
        """Rows that took part in the fit (n,)."""
        return np.abs(self.whitener).sum((1, 2)) > 0

    @cached_property
    def counted(self) -> np.ndarray:
        """Readings that took part in the fit (n, m): of used rows, those that there are."""
        present = self.model.instrument.present(self.measurement.plan)
        return self.used[:, None] & present

    @property
    def chi2(self) -> float:
        """Sum of squared whitened data residuals."""
        return float(self.whitened @ self.whitened)

    @cached_property
    def dof(self) -> float:
        """Effective degrees of freedom: readings less tr(J H^-1 J')."""
        hat = np.trace(cho_solve(self.factor, self.jacobian.T @ self.jacobian))
        return float(self.counted.sum() - hat)

    def chi2_and_dof(self, rows: np.ndarray) -> tuple[float, float]:
        """The same two of some rows (n,): their squared residuals, and their readings less their
        part of tr(J H^-1 J').
        """
        n, m = self.residual.shape
        mine = self.used & rows
        jacobian = self.jacobian.reshape(n, m, -1)[mine].reshape(-1, self.jacobian.shape[1])
        hat = np.einsum("ik,ki->", jacobian, cho_solve(self.factor, jacobian.T))
        squares = (self.whitened.reshape(n, m)[mine] ** 2).sum()
        return float(squares), float(self.counted[mine].sum() - hat)

    @property
    def entries(self) -> tuple[tuple[str, Parameter], ...]:
        """(effect with placement, parameter) for every entry of `theta`: amplitudes, then the
        shape parameters in which the deviation is smooth.
        """
        return entries(self.model)

    @property
    def information(self) -> np.ndarray:
        """Share of each parameter's information that came from the data: 1 - posterior variance /
        prior variance; 1 for flat priors.
        """
        variance = np.diag(self.planned_covariance)
        return np.where(self.precision > 0, 1.0 - variance * self.precision, 1.0)

    @property
    def cost(self) -> float:
        """What identification minimises: chi2 + theta' L theta, L the prior's precision."""
        return self.chi2 + float(self.theta**2 @ self.precision)

    def log_evidence(self, noise_scale: float = 1.0) -> float:
        """Laplace's approximation of ln p(y | model), up to a constant of the data alone.

        -chi2/2 - theta'L theta/2 + ln det L/2 - ln det H/2 + ln det W, plus the prior density of
        the shape parameters: uniform over their scan, so one over its number of steps, and the
        share of the normal distribution that lies within it. Flat directions enter as a unit of
        their scale, the same in every model that is compared.
        `noise_scale` multiplies the declared noise; the minimum is then elsewhere (`step_at`).
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
        # What a row lacks to the widest one has a place of its own in W, which says nothing.
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
        """From theta to where the cost of the linearised problem is least if the noise is
        `noise_scale` times that of the fit, H^-1 (J'r / s^2 - L theta); shape parameters stay.
        """
        step, k = np.zeros(len(self.theta)), len(self.model.entries)
        if noise_scale != 1.0:
            jacobian, precision = self.jacobian[:, :k] / noise_scale, self.precision[:k]
            h = jacobian.T @ jacobian + np.diag(precision)
            uphill = jacobian.T @ self.whitened / noise_scale - precision * self.theta[:k]
            step[:k] = np.linalg.solve(h, uphill)
        return step

    def hessian(self, noise_scale: float = 1.0) -> np.ndarray:
        """H = J'J / s^2 + L, with what the scans say of shape parameters (`within_scans`)."""
        return self.jacobian.T @ self.jacobian / noise_scale**2 + np.diag(self.within_scans)

    def log_scan(self, place: int, h: np.ndarray) -> float:
        """What the shape parameters of the effect at `place` add to the log evidence with the
        Hessian `h`, beside its determinant: of each the share of its scan, n steps, that explains
        the readings, and no prior but that.

        The readings alone tell it to 1/sigma^2 = 1/(H^-1)_kk - 12/n^2; the share is the area within
        the scan of exp(-x^2 / 2 sigma^2), over n.
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
                told = max(1.0 / variance - 12.0 / steps**2, _FAINT / steps**2)
                u = math.sqrt(2.0 / told)
                # Half a step more on either side: the prior is shared out evenly over the steps.
                at = self.shapes[place][p.name]
                order = np.argsort(grids[p.name])
                below = 0.5 + float(np.interp(at, grids[p.name][order], np.arange(steps)[order]))
                inside = 0.5 * (math.erf(below / u) + math.erf((steps - below) / u))
                found += math.log(math.sqrt(math.pi) * u * inside) - 0.5 * math.log(variance)
                k += 1
        return found

    def parameter_values(self) -> list[tuple[str, Parameter, float, float]]:
        """(effect, parameter, value, standard uncertainty) of all entries, in edge units.

        Shape parameters without a derivative (the time of a jump) have uncertainty nan, known ones
        zero.
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
        """Places in `theta` of the amplitudes of the effect at `place` in the model, and of its
        shape parameters that move.
        """
        count = len(self.model.entries)
        moving = [sum(p.moves for p in e.shapes) for e in self.model.effects]
        start = count + sum(moving[:place])
        amplitudes = np.arange(count)[self.model.places[place]]
        return amplitudes, np.arange(start, start + moving[place])


def entries(model: Model) -> tuple[tuple[str, Parameter], ...]:
    """Amplitudes of all effects, then all smooth shape parameters."""
    amplitudes = [(entry.key, entry.parameter) for entry in model.entries]
    shapes = [(e.key, p) for e in model.effects for p in e.shapes if p.moves]
    return (*amplitudes, *shapes)


def shape_step(parameter: Parameter, value: float, grids: Mapping[str, np.ndarray]) -> float:
    """What the solver counts as one for a shape parameter: one step of its scan there (SI)."""
    grid, step = grids[parameter.name], 0.0
    if len(grid) > 1:
        step = float(np.abs(np.gradient(grid))[np.argmin(np.abs(grid - value))])
    # Of one value, or of the same one again, no scan has a step.
    return step or max(abs(value), parameter.si) * 0.1


def _unit_columns(fit: Fit) -> np.ndarray:
    """The Jacobian, the rows of the prior included, with columns of unit length or of zeros."""
    whole = np.concatenate([fit.jacobian, np.diag(np.sqrt(fit.precision))])
    length = np.linalg.norm(whole, axis=0)
    return whole / np.where(length > 0.0, length, 1.0)


def undetermined(fit: Fit) -> list[str]:
    """Parameters of which neither the data nor a prior tell a combination, by name.

    Those with a part in a right singular vector of the Jacobian (columns of unit length, the rows
    of the prior included) whose singular value is zero to rounding.
    """
    _, s, vt = np.linalg.svd(_unit_columns(fit), full_matrices=False)
    part = np.abs(vt[s <= _LOST * s[0]]).max(0, initial=0.0)
    names = [f"{key} {p.name}" for key, p in fit.entries]
    return [name for name, share in zip(names, part, strict=True) if share > _PART]


class Learnt(NamedTuple):
    """How much of the space of the parameters that have a prior is determined."""

    directions: int
    determined: int
    """Directions told to better than half their prior variance."""
    unseen: int
    """Directions of which next to nothing is told."""
    hardly: tuple[str, ...]
    """Parameters of which hardly anything is told."""

    @classmethod
    def of(
        cls,
        entries: Sequence[tuple[str, Parameter]],
        root_precision: Float[np.ndarray, " k"],
        covariance: Float[np.ndarray, "k k"],
    ) -> "Learnt":
        """From the square root of the prior precision and the posterior covariance.

        Directions are those of this covariance in units of the prior, so that each has the share
        of information 1 - variance.
        """
        proper = np.flatnonzero(root_precision > 0.0)
        if not len(proper):
            return cls(0, 0, 0, ())
        root = root_precision[proper]
        scaled = covariance[np.ix_(proper, proper)] * np.outer(root, root)
        told = 1.0 - np.linalg.eigvalsh(scaled)
        names = [f"{key}: {p.name}" for key, p in (entries[k] for k in proper.tolist())]
        hardly = [n for n, v in zip(names, np.diag(scaled), strict=True) if 1.0 - v < HARDLY_TOLD]
        return cls(len(proper), int((told > 0.5).sum()), int((told < _LITTLE).sum()), tuple(hardly))


def null_directions(fit: Fit) -> list[str]:
    """Combinations of parameters about which the data say next to nothing, in words.

    Directions in which less than a hundredth of the information comes from the data: right singular
    vectors of the Jacobian (solver units) with s^2 / (s^2 + 1) below it. Six are told, each by the
    parameters that make up nine tenths of it, and the others counted.
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
    """W (y - h) of every row, also of those that were left out."""
    whitener = declared_whitener(fit.model, fit.measurement)
    return np.einsum("nij,nj->ni", whitener, fit.residual)


def declared_chi2(fit: Fit, rows: Bool[np.ndarray, " n"] | None = None) -> float:
    """Sum of their squares over the rows that were used, or over these."""
    return float((normalised_residuals(fit)[fit.used if rows is None else rows] ** 2).sum())
