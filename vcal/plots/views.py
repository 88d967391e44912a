"""In which direction, and against what, the residual shows an effect best: numbers for pictures."""

import re
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..effects.base import Effect
from ..identify import Fit
from ..instruments.conditions import file_column
from ..loop.unexplained import bins, displacements
from ..plan import Plan
from .style import column_label

_CLEAR = 0.5
"""Share of an effect's own pattern that a covariate must describe to be its axis in a picture."""
_PRODUCTS = {"T": 20.0}


@dataclass(frozen=True)
class View:
    """The residual seen along one direction against one quantity, rows that were fitted only."""

    x: np.ndarray
    """In the unit that `x_label` names."""
    x_label: str
    kind: str
    """``"sides"`` (a direction of travel), ``"scatter"``, or ``"step"`` at `event`."""
    along: str
    """The direction in words, such as ``"along Y"``."""
    without: np.ndarray
    """Residual of the model that lacks the effect, um."""
    with_: np.ndarray
    """Residual of the model that has it, um."""
    curve: tuple[np.ndarray, np.ndarray] | None = None
    """What the effect predicts, where that is a function of `x`: (x, um)."""
    event: float | None = None


def column_of(covariate: str, plan: Plan) -> tuple[str, float]:
    """Column of the data file that holds a covariate or axis, and the factor from SI to its unit.

    The axes of an arm are read back or commanded, whichever the plan takes as its positions.
    """
    read = plan.covariates.get(f"read_{covariate}")
    if covariate in plan.axes and read is not None:
        if np.array_equal(np.asarray(read), np.asarray(plan.x(covariate))):
            return file_column(f"read_{covariate}", plan.axes)
    return file_column(covariate, plan.axes)


def values_of(covariate: str, plan: Plan) -> np.ndarray:
    """Values (n,) of an axis, covariate or group index, SI."""
    if covariate in plan.axes:
        return np.asarray(plan.x(covariate), float)
    table = plan.covariates if covariate in plan.covariates else plan.groups
    return np.asarray(table[covariate], float)


def place_of(fit: Fit, effect: Effect) -> int:
    """Position of this very effect in the model of a fit."""
    for i, candidate in enumerate(fit.model.effects):
        if candidate is effect:
            return i
    return next(i for i, candidate in enumerate(fit.model.effects) if candidate.key == effect.key)


def parameter_places(fit: Fit, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Places in theta of an effect's amplitudes, and of its smooth shape parameters."""
    effects = fit.model.effects
    first = sum(len(e.amplitudes) for e in effects[:place])
    amplitudes = np.arange(first, first + len(effects[place].amplitudes))
    smooth = [sum(p.smooth for p in e.shapes) for e in effects]
    start = sum(len(e.amplitudes) for e in effects) + sum(smooth[:place])
    return amplitudes, np.arange(start, start + smooth[place])


def _unwhitened(fit: Fit, whitened: np.ndarray) -> np.ndarray:
    n, m = fit.residual.shape
    found, used = np.zeros((n, m)), fit.used
    rows = whitened.reshape(n, m)[used]
    found[used] = np.linalg.solve(fit.whitener[used], rows[:, :, None])[:, :, 0]
    return found


def contribution(fit: Fit, place: int) -> np.ndarray:
    """Displacement of the tool point (n, 3), m, that one effect of the fit accounts for."""
    amplitudes, _ = parameter_places(fit, place)
    step = fit.jacobian[:, amplitudes] @ fit.theta[amplitudes]
    return displacements(fit, _unwhitened(fit, step))


def residual_without(fit: Fit, place: int) -> np.ndarray:
    """Residual (n, m), SI, of the model less one effect, all other parameters fitted anew.

    Exact for the linearised problem: taking the effect out adds its share C a to the residual, of
    which the others take up J (J'J + L)^-1 J' C a.
    """
    amplitudes, shapes = parameter_places(fit, place)
    step = fit.jacobian[:, amplitudes] @ fit.theta[amplitudes]
    others = np.setdiff1d(np.arange(len(fit.theta)), np.concatenate([amplitudes, shapes]))
    j = fit.jacobian[:, others]
    factor = cho_factor(j.T @ j + np.diag(fit.precision[others]))
    return _unwhitened(fit, fit.whitened + step - j @ cho_solve(factor, j.T @ step))


def described(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of `y` (n,) or (n, k) that the bins of `x` describe."""
    index = bins(x)
    centred = y - y.mean(0)
    sums = np.zeros((index.max() + 1, *centred.shape[1:]))
    np.add.at(sums, index, centred)
    counts = np.maximum(np.bincount(index), 1).reshape(-1, *[1] * (y.ndim - 1))
    return float((sums**2 / counts).sum() / max((centred**2).sum(), 1e-300))


def effect_view(fit: Fit, effect: Effect) -> View:
    """Where the residual shows an effect of the fit.

    Direction: that in which its one port moves the tool point, row by row; of effects with several
    ports the main direction of what they displace. Abscissa: of the covariates that betray it the
    one that describes its pattern best; where none does, the displacement it predicts.
    """
    place = place_of(fit, effect)
    plan, used = fit.measurement.plan, fit.used
    shape = fit.shapes.get(place, {})
    moved = contribution(fit, place)
    direction, along = _direction(fit, effect, shape, moved)
    predicted = (moved * direction).sum(1)[used] * 1e6
    without = (displacements(fit, residual_without(fit, place)) * direction).sum(1)[used] * 1e6
    with_ = (displacements(fit) * direction).sum(1)[used] * 1e6
    x, label, kind, event = _abscissa(plan, effect, shape, predicted, used)
    curve = None
    if described(x, predicted) > 0.9 or "modulo" in label:
        order = np.argsort(x, kind="stable")
        curve = (x[order], predicted[order])
    if len(np.unique(x)) <= 12 and curve is not None:
        levels = np.unique(x)
        curve = (levels, np.array([predicted[x == level].mean() for level in levels]))
    return View(x, label, kind, along, without, with_, curve, event)


def _direction(fit: Fit, effect: Effect, shape, moved: np.ndarray) -> tuple[np.ndarray, str]:
    response = effect.response(fit.measurement.plan, shape)
    ports = list(dict.fromkeys(port for port, _ in response))
    frame = "" if set(fit.model.chain.axes) <= set("XYZ") else " of the tool"
    if len(ports) == 1:
        column = fit.port_jacobian[:, :, fit.model.layout.index(ports[0])]
        lever = displacements(fit, column)
        length = np.linalg.norm(lever, axis=1, keepdims=True)
        direction = lever / np.where(length > 0, length, 1.0)
        mean = direction[fit.used].mean(0)
        if np.abs(mean).max() > 0.99:
            return direction, f"along {'XYZ'[int(np.argmax(np.abs(mean)))]}{frame}"
        return direction, f"in the direction in which {ports[0]} moves the tool point"
    _, s, vt = np.linalg.svd(moved, full_matrices=False)
    if s[0] ** 2 > 0.8 * (s**2).sum():
        main = vt[0] * np.sign(vt[0][np.argmax(np.abs(vt[0]))])
        name = "XYZ"[int(np.argmax(main))]
        words = f"along {name}{frame}" if main.max() > 0.9 else "along its main direction"
        return np.broadcast_to(main, moved.shape), words
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    return moved / np.where(length > 0, length, 1.0), "along the displacement it causes"


def _abscissa(plan: Plan, effect: Effect, shape, predicted: np.ndarray, used: np.ndarray):
    named = [n for n in effect.betrayed_by if plan.has(n)]
    if "pitch" in shape and effect.placement in plan.axes:
        pitch = float(shape["pitch"]) * 1e3
        x = np.mod(values_of(effect.placement, plan)[used] * 1e3, pitch)
        label = f"{effect.placement} position modulo the pitch of {pitch:.4g} mm, mm"
        return x, label, "scatter", None
    steps = [p.name for p in effect.shapes if not p.smooth]
    if steps and named:
        column, factor = column_of(named[0], plan)
        x = values_of(named[0], plan)[used] * factor
        return x, column_label(column), "step", float(shape[steps[0]]) * factor
    shares = [described(values_of(n, plan)[used], predicted) for n in named]
    if shares and max(shares) > _CLEAR:
        name = named[int(np.argmax(shares))]
        column, factor = column_of(name, plan)
        x = values_of(name, plan)[used] * factor
        kind = "sides" if set(np.unique(x)) <= {-1.0, 0.0, 1.0} else "scatter"
        return x, column_label(column), kind, None
    axes = [n for n in named if n in plan.axes]
    warm = [n for n in named if re.fullmatch(r"T_\w+", n)]
    if axes and warm:
        x = (values_of(warm[0], plan) - 20.0) * values_of(axes[0], plan)
        if described(x[used], predicted) > _CLEAR:
            return x[used], f"({warm[0]} - 20 °C) × position of {axes[0]}, K m", "scatter", None
    return predicted, f"displacement that {effect.key} predicts, µm", "scatter", None
