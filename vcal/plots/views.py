"""Direction and abscissa that show an effect best in the residual: numbers for pictures."""

import re
from dataclasses import dataclass

import numpy as np

from ..effects.base import Effect
from ..effects.thermal import REFERENCE_DEGC
from ..identification.fit import Fit
from ..instruments.conditions import file_column, in_file
from ..loop.outcome.unexplained import way
from ..loop.residuals.dependence import bins, displacements
from ..machine.plan import Plan
from .labels import column_label, pretty_unit

_CLEAR = 0.5
"""Least share of an effect's pattern that a covariate must describe to be the abscissa."""


@dataclass(frozen=True)
class View:
    """The residual along one direction against one quantity, for the fitted rows."""

    x: np.ndarray
    """In the unit that `x_label` names."""
    x_label: str
    kind: str
    """``"sides"`` (a direction of travel), ``"scatter"``, ``"step"`` at `event`, or ``"visible"``
    where `x` is the visible part of the effect."""
    along: str
    """The direction in words, such as ``"along Y"``."""
    without: np.ndarray
    """Residual of the model that lacks the effect, um."""
    with_: np.ndarray
    """Residual of the model that has it, um."""
    event: float | None = None
    tone: np.ndarray | None = None
    """Where `x` is the visible part of the effect: the covariate that describes it best."""
    tone_label: str = ""

    @property
    def visible(self) -> np.ndarray:
        """Change of the residual by the effect, um: its displacement minus the part that the other
        parameters absorb.
        """
        return self.without - self.with_


def column_of(covariate: str, plan: Plan) -> tuple[str, float]:
    """Column of the data file that holds a covariate or axis, and the factor from SI to its unit.

    The axes of an arm are read back or commanded, whichever the plan uses as its positions. A
    column of one data set has the name of that data set in front.
    """
    owner, _, plain = covariate.partition(":")
    if owner in plan.sets:
        name, factor = file_column(plain, plan.axes)
        return f"{owner}: {name}", factor
    read = plan.covariates.get(f"read_{covariate}")
    if covariate in plan.axes and read is not None:
        if np.array_equal(np.asarray(read), np.asarray(plan.x(covariate))):
            return file_column(f"read_{covariate}", plan.axes)
    return file_column(covariate, plan.axes)


def values_of(covariate: str, plan: Plan) -> np.ndarray:
    """Values (n,) of an axis, covariate or group index, SI; nan in rows of data sets without it."""
    return plan.values(covariate)


def place_of(fit: Fit, effect: Effect) -> int:
    """Position of this effect, or of an equal one, in the model of a fit."""
    for i, candidate in enumerate(fit.model.effects):
        if candidate is effect:
            return i
    return next(i for i, candidate in enumerate(fit.model.effects) if candidate.alike(effect))


def _unwhitened(fit: Fit, whitened: np.ndarray) -> np.ndarray:
    n, m = fit.residual.shape
    found, used = np.zeros((n, m)), fit.used
    rows = whitened.reshape(n, m)[used]
    found[used] = np.linalg.solve(fit.whitener[used], rows[:, :, None])[:, :, 0]
    return found


def contribution(fit: Fit, place: int) -> np.ndarray:
    """Displacement of the tool point (n, 3), m, by one effect of the fit."""
    amplitudes, _ = fit.places_of(place)
    step = fit.jacobian[:, amplitudes] @ fit.theta[amplitudes]
    return displacements(fit, _unwhitened(fit, step))


def residual_without(fit: Fit, place: int) -> np.ndarray:
    """Residual (n, m), SI, of the model without one effect, all other parameters refitted.

    Exact for the linearised problem: removing the effect adds its contribution C a to the residual,
    of which the other parameters absorb J (J'J + L)^-1 J' C a. That inverse follows from the
    inverse of the whole model by eliminating the block of the effect.
    """
    amplitudes, shapes = fit.places_of(place)
    step = fit.jacobian[:, amplitudes] @ fit.theta[amplitudes]
    own = np.concatenate([amplitudes, shapes])
    inverse = fit.planned_covariance
    shared = inverse[:, own]
    inverse = inverse - shared @ np.linalg.solve(inverse[np.ix_(own, own)], shared.T)
    return _unwhitened(
        fit, fit.whitened + step - fit.jacobian @ (inverse @ (fit.jacobian.T @ step))
    )


def described(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of `y` (n,) or (n, k) that the bins of `x` describe."""
    index = bins(x)
    centred = y - y.mean(0)
    sums = np.zeros((index.max() + 1, *centred.shape[1:]))
    np.add.at(sums, index, centred)
    counts = np.maximum(np.bincount(index), 1).reshape(-1, *[1] * (y.ndim - 1))
    return float((sums**2 / counts).sum() / max((centred**2).sum(), 1e-300))


def effect_view(fit: Fit, effect: Effect, rows: np.ndarray | bool = True) -> View:
    """Direction and abscissa that show an effect of the fit in the residual of some rows (n,).

    Direction: that in which its only port moves the tool point, row by row; for effects with
    several ports, the main direction of their displacement. Abscissa: the indicating covariate that
    describes the visible part of the effect best; if none describes it, that part itself.
    """
    place = place_of(fit, effect)
    used = fit.used & effect.rows(fit.measurement.plan) & rows
    shape = fit.shapes.get(place, {})
    direction, along = _direction(fit, effect, shape, contribution(fit, place), used)
    without, with_ = (
        (displacements(fit, residual) * direction).sum(1)[used] * 1e6
        for residual in (residual_without(fit, place), fit.residual)
    )
    x, label, kind, event = _abscissa(fit, effect, shape, without - with_, used)
    visible = without - with_
    tone, tone_label = _tone(fit, effect, visible, used) if kind == "visible" else (None, "")
    return View(x, label, kind, along, without, with_, event, tone, tone_label)


def _direction(
    fit: Fit, effect: Effect, shape, moved: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, str]:
    response = effect.response(fit.measurement.plan, shape)
    ports = list(dict.fromkeys(port for port, _ in response))
    frame = " of the tool" if fit.model.chain.arm else ""
    if len(ports) == 1:
        column = fit.port_jacobian[:, :, fit.model.layout.index(ports[0])]
        lever = displacements(fit, column)
        length = np.linalg.norm(lever, axis=1, keepdims=True)
        direction = lever / np.where(length > 0, length, 1.0)
        mean = direction[used].mean(0)
        if np.abs(mean).max() > 0.99:
            return direction, f"{way(fit.ways[int(np.argmax(np.abs(mean)))])}{frame}"
        moves = "moves" if effect.where == "machine" else "seems to move"
        return direction, f"in the direction in which the effect {moves} it"
    _, s, vt = np.linalg.svd(moved, full_matrices=False)
    main = vt[0] * np.sign(vt[0][np.argmax(np.abs(vt[0]))])
    if s[0] ** 2 > 0.8 * (s**2).sum():
        words = (
            f"{way(fit.ways[int(np.argmax(main))])}{frame}"
            if main.max() > 0.9
            else "along its main direction"
        )
        return np.broadcast_to(main, moved.shape), words
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    # For rows that the effect does not move, its main direction.
    touched = length > 1e-9 * length.max()
    direction = np.where(touched, moved / np.where(touched, length, 1.0), main)
    return direction, "along the displacement that the effect causes"


def _abscissa(fit: Fit, effect: Effect, shape, visible: np.ndarray, used: np.ndarray):
    plan, instrument = fit.measurement.plan, fit.model.instrument
    named = [n for n in effect.indicators if plan.has(n)]
    if "pitch" in shape and effect.placement in plan.axes:
        (of,) = (p for p in effect.shapes if p.name == "pitch")
        pitch, unit = float(shape["pitch"]) / of.si, pretty_unit(of.unit)
        x = np.mod(values_of(effect.placement, plan)[used] / of.si, pitch)
        label = f"{effect.placement} position modulo the pitch of {pitch:.4g} {unit}, {unit}"
        return x, label, "scatter", None
    steps = [p.name for p in effect.shapes if not p.smooth]
    if steps and named:
        column, at = column_of(named[0], plan)[0], float(shape[steps[0]])
        x, at = (in_file(named[0], v, plan, instrument) for v in (values_of(named[0], plan), at))
        return np.asarray(x)[used], column_label(column), "step", float(at)
    shares = [described(values_of(n, plan)[used], visible) for n in named]
    if shares and max(shares) > _CLEAR:
        name = named[int(np.argmax(shares))]
        column = column_of(name, plan)[0]
        x = np.asarray(in_file(name, values_of(name, plan), plan, instrument))[used]
        kind = "sides" if set(np.unique(x)) <= {-1.0, 0.0, 1.0} else "scatter"
        return x, column_label(column), kind, None
    axes = [n for n in named if n in plan.axes]
    warm = [n for n in named if re.fullmatch(r"T_\w+", n)]
    if axes and warm:
        excess = values_of(warm[0], plan) - REFERENCE_DEGC
        x = excess[used] * values_of(axes[0], plan)[used]
        if described(x, visible) > _CLEAR:
            zero = f"{REFERENCE_DEGC + instrument.temperature_offset_K:g} °C"
            label = f"(temperature of {axes[0]} − {zero}) × its position, K m"
            return x, label, "scatter", None
    return visible, "visible part of the effect, µm", "visible", None


def _tone(
    fit: Fit, effect: Effect, visible: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray | None, str]:
    """The covariate that describes the visible part best, as ranks from 0 to 1."""
    plan = fit.measurement.plan
    table = {n: values_of(n, plan)[used] for n in effect.indicators if plan.has(n)}
    table = {n: x for n, x in table.items() if np.ptp(x) > 0}
    if not table:
        return None, ""
    name = max(table, key=lambda n: described(table[n], visible))
    x = table[name]
    ranks = np.searchsorted(np.unique(x), x) / (len(np.unique(x)) - 1)
    column, instrument = column_of(name, plan)[0], fit.model.instrument
    low, high = (in_file(name, v, plan, instrument) for v in (x.min(), x.max()))
    ends = f"{low:.4g} (dark) to {high:.4g} (bright)".replace("-", "−")
    return ranks, f"dots: {column_label(column)}, {ends}"
