"""State of the loop: the model, its fits, the noise and the outliers."""

import dataclasses
import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import gammaincc

from ...identification.fit import Fit, declared_chi2, undetermined
from ...identification.identify import NEARLY, identify
from ...identification.rank import flat_rank
from ...identification.robust import identify_robust
from ...model.declared_noise import declared_whitener
from ...model.forward import Model
from ...model.measurement import Measurement
from ...numerics.least_squares import Status
from ..residuals.outliers import Outlier, displaced, outliers_apart, outlying_rows, scattered
from ..residuals.variance_components import Components, components
from ..screening.significance import LEAST_DOF, LEAST_NOISE
from ..weighing.cross_validation import folds_of, held_apart
from .initial_shapes import initial_shapes

_FEW = 5
"""Most parameters that a message lists."""
_EVEN = 1.3
"""Largest ratio of two factors on the declared noise that count as the same."""
_CHANCE = 1e-3
"""Probability by chance below which such factors differ."""
_SEARCHES = 4
"""Number of searches for outliers. Outliers mask others, so each search follows a fit without those
found before."""


@dataclass(frozen=True)
class State:
    """The present model with its fits."""

    model: Model
    fit: Fit
    """With the declared noise."""
    scored: Fit
    """With the estimated noise, for tests and evidence, where it differs from the declared noise in
    more than one factor: the covariance of clustered readings, or unequal variance components; also
    where it is smaller. Else the same as `fit`."""
    keep: np.ndarray
    outliers: list[Outlier]
    noise: Components | None
    """None for clustered readings."""

    @property
    def as_declared(self) -> bool:
        """Whether tests and evidence use the declared noise."""
        return self.scored is self.fit

    @property
    def remaining(self) -> Fit:
        """The fit whose residual is tested for unexplained structure: `scored`, or `fit` for
        clustered readings, where every reading of a row is tested by itself.
        """
        return self.fit if self.noise is None else self.scored


def fitted(model: Model, measurement: Measurement, start: Fit | None, room: int) -> State:
    """Fit a model without outliers, and again with the noise that the readings show.

    `start` gives initial values, `room` the number of parameters that the compiled solver allows.
    Raises `LinAlgError` where parameters without a proper prior are not determined.
    """
    measurement = dataclasses.replace(measurement, aside=None)
    _, apart = held_apart(model, measurement)
    whole_keep = keep = ~apart
    _, apart = folds_of(model, measurement)
    options: dict = {"keep": keep, "room": room}
    if start is not None:
        options |= {"theta": start.theta, "shapes": start.shapes}
    else:
        options["shapes"] = initial_shapes(model, measurement, keep, room)
    fit = whole = identify(model, measurement, **options)
    _check_determined(fit)
    outliers: list[Outlier] = []
    moved: set[int] = set()
    for _ in range(_SEARCHES):
        options |= {"theta": fit.theta, "shapes": fit.shapes}
        found = [s for s in _outliers(fit, options) if s.row not in moved]
        if not found:
            break
        outliers += found
        if not scattered(whole, [s.row for s in outliers]):
            # Outliers that were found in succession turn out to be systematic.
            outliers, fit, keep = [], whole, whole_keep
            options |= {"theta": fit.theta, "shapes": fit.shapes, "keep": keep}
            break
        options["keep"] = keep = keep.copy()
        keep[[s.row for s in found]] = False
        fit = identify(model, measurement, tolerance=NEARLY, **options)
        if more := displaced(fit, [s.row for s in outliers]):
            moved |= more
            outliers = [s for s in outliers if s.row not in more]
            options["keep"] = keep = keep.copy()
            keep[sorted(more)] = whole_keep[sorted(more)]
            fit = identify(model, measurement, tolerance=NEARLY, **options)
    if outliers or moved:
        fit = identify(model, measurement, **options | {"theta": fit.theta, "shapes": fit.shapes})
    if far := outliers_apart(fit, apart):
        outliers += far
        measurement = dataclasses.replace(measurement, aside=_rows(measurement, far))
        fit = dataclasses.replace(fit, measurement=measurement)
    scored, noise = fit, None
    if (fit.clusters >= 0).any():
        for _ in range(2):
            scored = identify(model, measurement, whitener=_clustered_whitener(scored), **options)
    else:
        noise = components(fit)
        if noise.uneven or _quieter(fit):
            scored = identify(model, measurement, whitener=_found_whitener(noise, noise), **options)
    return State(model, fit, scored, keep, sorted(outliers, key=lambda s: s.row), noise)


def _check_determined(fit: Fit) -> None:
    """Raise `LinAlgError` where parameters that neither the data nor a prior determine prevented
    convergence. Without a bound some diverge, to where the readings seem to determine them.
    """
    free = []
    if fit.status == Status.SINGULAR:
        free = undetermined(fit)
    elif not fit.converged:
        names = [f"{key} {p.name}" for key, p in fit.entries]
        free = [names[i] for i in flat_rank(fit.model, fit.measurement.plan).mixed]
    if free:
        more = f" and {len(free) - _FEW} more" if len(free) > _FEW else ""
        raise np.linalg.LinAlgError(
            f"the readings cannot distinguish {' and '.join(free[:_FEW])}{more} from the other "
            "parameters"
        )


def _outliers(fit: Fit, options: dict) -> list[Outlier]:
    """Outliers of a fit with these options of `identify`.

    The estimated noise is used where it is smaller than declared. The priors would otherwise push
    some rows further out than noise does.
    """
    model, measurement = fit.model, fit.measurement
    if not (fit.clusters >= 0).any() and _quieter(fit):
        options = options | {"whitener": components(fit).whitener_alike}
        fit = identify(model, measurement, tolerance=NEARLY, **options)
    return outlying_rows(fit, partial(identify_robust, model, measurement, **options))


def at_declared(fit: Fit, state: State, room: int) -> Fit:
    """A fit for tests and evidence, repeated with the declared noise."""
    if state.as_declared:
        return fit
    return identify(
        fit.model,
        fit.measurement,
        theta=fit.theta,
        shapes=fit.shapes,
        keep=state.keep,
        room=room,
        tolerance=NEARLY,
    )


def rescored(state: State, best: Fit, room: int) -> Fit:
    """The state's fit for tests and evidence, with the noise that a better model leaves.

    A missing effect makes variance components unequal and must not count as noise where rivals are
    weighed. The fit is unchanged where there are no components, or they are as declared.
    """
    if state.as_declared or state.noise is None:
        return state.scored
    return identify(
        state.model,
        best.measurement,
        theta=state.scored.theta,
        shapes=state.scored.shapes,
        whitener=_found_whitener(components(best), state.noise),
        keep=state.keep,
        room=room,
    )


def without(state: State, place: int, room: int) -> Fit:
    """The fit for tests and evidence without the effect at that place."""
    fit = state.scored
    kept = np.delete(np.arange(len(state.model.entries)), state.model.places[place])
    shapes = {i - (i > place): shape for i, shape in fit.shapes.items() if i != place}
    return identify(
        state.model.without(place),
        fit.measurement,
        theta=fit.theta[kept],
        shapes=shapes,
        whitener=fit.whitener,
        keep=state.keep,
        room=room,
        tolerance=NEARLY,
    )


def _rows(measurement: Measurement, outliers: list[Outlier]) -> np.ndarray:
    found = np.zeros(measurement.rows, bool)
    found[[s.row for s in outliers]] = True
    return found


def _quieter(fit: Fit) -> bool:
    """Whether the readings scatter significantly less than declared. With the declared noise, the
    priors then outweigh readings that are more precise, and the resulting residual is no error of
    the machine.
    """
    return noise_scale(fit, np.ones(fit.measurement.rows, bool)) < 1.0


def _found_whitener(noise: Components, of: Components) -> np.ndarray:
    """W of every row with that noise: by component, or with one factor where the components `of`
    are equal.
    """
    return noise.whitener if of.uneven else noise.whitener_alike


def _clustered_whitener(fit: Fit) -> np.ndarray:
    """W of every row from the covariance of the readings of one row, as seen in the residuals.

    For rows whose readings share unmodelled errors (`Instrument.clusters`): in units of the
    declared noise of every row, C = (1 - a) S + a f 1 with S = sum r r' / (rows - parameters per
    reading) and f the mean of its diagonal. The shrinkage a is the sampling variance of S over its
    distance from f 1. It depends on the number of rows, and keeps the declared form where nothing
    is shared (Ledoit, Wolf, J. Multivariate Anal. 88, 2004, 365). The parameters are shared evenly
    by all rows. Clusters with too few rows keep the declared covariance, and none is below the
    least noise.
    """
    used, clusters = fit.used, fit.clusters
    found = np.array(declared_whitener(fit.model, fit.measurement))
    for k in np.unique(clusters[clusters >= 0]):
        mine = clusters == k
        here = np.flatnonzero(mine & used)
        if not len(here):
            continue
        present = np.flatnonzero(fit.counted[here[0]])
        rows, m = len(here), len(present)
        if rows <= m or fit.chi2_and_dof(mine)[1] < LEAST_DOF:
            continue
        r = np.einsum("nij,nj->ni", found[np.ix_(here, present, present)],
                      fit.residual[np.ix_(here, present)])  # fmt: skip
        taken = len(fit.theta) * (rows / used.sum())
        r *= math.sqrt(rows / max(rows - taken / m, m + 1.0))
        s = r.T @ r / rows
        same = np.trace(s) / m * np.eye(m)
        chance = ((np.einsum("ni,nj->nij", r, r) - s) ** 2).sum() / rows**2
        share = min(chance / max(((s - same) ** 2).sum(), 1e-300), 1.0)
        c = (1.0 - share) * s + share * same
        c += max(LEAST_NOISE**2 - np.trace(c) / m, 0.0) * np.eye(m)
        block = np.ix_(np.flatnonzero(mine), present, present)
        found[block] = np.linalg.cholesky(np.linalg.inv(c)).T @ found[block]
    return found


def chi2_per_dof(fit: Fit) -> float:
    """Chi-square per degree of freedom against the declared noise."""
    return declared_chi2(fit) / fit.dof


def noise_scale(fit: Fit, rows: np.ndarray) -> float:
    """Root of chi-square per degree of freedom of these rows where it differs significantly from
    one (p < 1e-3), else one.
    """
    chi2, dof = (fit.chi2, fit.dof) if rows.all() else fit.chi2_and_dof(rows)
    if dof <= 0.0:
        return 1.0
    p = gammaincc(0.5 * dof, 0.5 * chi2)
    ratio = math.sqrt(chi2 / dof)
    return ratio if p < 1e-3 or p > 1.0 - 1e-3 else 1.0


def noise_scales(fit: Fit) -> dict[str, float]:
    """`noise_scale` of every data set, by its name."""
    return {name: noise_scale(fit, rows) for name, rows in fit.measurement.plan.parts.items()}


def reported_noise_scales(state: State) -> tuple[float, dict[str, float]]:
    """`noise_scale` of all readings and of every data set, as reported.

    Where readings are quieter than declared, a fit with the declared noise underestimates their
    residual, because the priors absorb more; the variance component is then given.
    """
    fit, noise = state.fit, state.noise
    whole, each = noise_scale(fit, np.ones(fit.measurement.rows, bool)), noise_scales(fit)
    if noise is None or noise.uneven or state.as_declared:
        return whole, each
    return noise.factor, {name: f if f >= 1.0 else noise.factor for name, f in each.items()}


def evenly_scattered(state: State) -> bool:
    """Whether all kinds of reading, and all data sets, scatter by the same factor of their declared
    noise. Errors of a machine, or of one device, seldom do.
    """
    fit = state.fit
    _, each = reported_noise_scales(state)
    same = max(each.values(), default=1.0) < _EVEN * min(each.values(), default=1.0)
    if state.noise is not None:
        return same and not state.noise.uneven
    # Readings of a row that share unmodelled errors: each kind by its own scatter.
    there = fit.used[:, None] & fit.model.instrument.present(fit.measurement.plan)
    counts = there.sum(0)
    r = np.einsum("nij,nj->ni", fit.whitener, fit.residual) * there
    known = counts > LEAST_DOF
    sizes = np.sqrt((r**2).sum(0)[known] / counts[known])
    if len(sizes) < 2 or not sizes.min() > 0.0:
        return same
    # ln of an estimated standard deviation from n readings has the variance 1 / 2n.
    apart = np.log(sizes) - np.log(sizes).mean()
    by_chance = gammaincc(0.5 * (len(sizes) - 1), float((counts[known] * apart**2).sum()))
    return same and (sizes.max() < _EVEN * sizes.min() or bool(by_chance > _CHANCE))


def at_noise_found(state: State, room: int) -> Fit:
    """The fit with the estimated noise where that is larger than declared, else with the declared
    noise.
    """
    fit = state.fit
    if state.noise is not None and state.noise.uneven:
        whitener = state.noise.whitener_at_least_declared
    else:
        scale = np.ones(len(fit.whitener))
        for name, found in noise_scales(fit).items():
            scale[fit.measurement.plan.parts[name]] = max(found, 1.0)
        if (scale == 1.0).all():
            return fit
        whitener = fit.whitener / scale[:, None, None]
    return identify(
        fit.model,
        fit.measurement,
        theta=fit.theta,
        shapes=fit.shapes,
        whitener=whitener,
        keep=state.keep,
        room=room,
    )
