"""Change of an effect with a recorded quantity: its size in parts of the readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from matplotlib.figure import Figure

from ..identification.fit import Fit
from ..instruments.conditions import in_file
from ..loop.empirical import Changing
from ..loop.residuals.dependence import bins
from ..loop.weighing.rivals import Rival
from .labels import column_label, pretty_unit
from .style import AFTER, BEFORE, INK, figure, grid, titled
from .views import column_of

_SEEN = 1e-6
"""Least sensitivity of a part of the readings to a parameter, relative to the largest one."""
_OPEN = 1e-10
"""Regularisation, relative to the information of one part."""


@dataclass(frozen=True)
class Sizes:
    """The size of an effect in parts of the readings, and by its empirical description."""

    parameter: str
    unit: str
    quantity: np.ndarray
    """Mean of the quantity in every part (k,)."""
    size: np.ndarray
    """(k,), from the readings of that part."""
    u: np.ndarray
    """(k,), standard uncertainties."""
    at: np.ndarray
    """Quantity along the line of the description."""
    line: np.ndarray
    """Size by the description, there."""
    overall: float
    """Size from all readings together."""


def changing_sizes(fit: Fit, best: Rival) -> Sizes | None:
    """Estimates of the amplitude that changes most, part by part: a linear fit at the minimum, with
    a separate size in every part.

    Parts whose standard uncertainty exceeds the size itself are left out. None for other
    descriptions, where the fit lacks the effect or its size is known, and where fewer than two
    parts remain.
    """
    effect, plan = best.effect, fit.measurement.plan
    if not isinstance(effect, Changing):
        return None
    effects = fit.model.effects
    places = [i for i, e in enumerate(effects) if e.alike(effect.effect)]
    if not places:
        return None
    last = len(best.fit.model.effects) - 1
    change = {p.name: (value, u) for _, p, value, u in best.fit.values_of(last) if not p.shape}
    own = effects[places[0]].amplitudes
    k = int(np.argmax([abs(change[p.name][0]) / change[p.name][1] for p in own]))
    parameter = own[k]
    if parameter.known:
        return None
    column = int(fit.places_of(places[0])[0][k])
    quantity = effect.quantities[int(best.fit.shapes[last]["which"])]
    x = plan.values(quantity.name)
    index = np.full(plan.rows, -1)
    index[fit.used] = bins(x[fit.used])
    line = np.linspace(x[fit.used].min(), x[fit.used].max(), 60)
    (_, _, overall, _), (_, _, base, _) = (
        one.values_of(place)[k] for one, place in ((fit, places[0]), (best.fit, places[0]))
    )
    described = base + change[parameter.name][0] * quantity.of(line)
    parts = np.unique(index[fit.used])
    sizes, u = _in_parts(fit, column, [index == part for part in parts])
    step = parameter.step / parameter.si
    sizes, u = sizes * step + parameter.mean, u * step
    known = u < max(abs(overall), np.abs(described).max())
    if known.sum() < 2:
        return None
    means = np.array([x[index == part].mean() for part in parts])
    return Sizes(
        parameter.name,
        parameter.unit,
        means[known],
        sizes[known],
        u[known],
        line,
        described,
        overall,
    )


def _in_parts(fit: Fit, column: int, parts: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Value and standard uncertainty (k,) of one parameter in each of these parts of the rows, in
    solver units, from the readings alone; infinite uncertainty where they are insensitive to it.
    """
    m = fit.residual.shape[1]
    g, own = fit.jacobian[:, column], np.delete(fit.jacobian, column, axis=1)
    split = np.column_stack([g * np.repeat(rows, m) for rows in parts])
    precision = np.delete(fit.precision, column)
    theta = np.delete(fit.theta, column)
    # The other parameters are eliminated together with their priors.
    root = np.sqrt(precision)
    whole = np.vstack([own, np.diag(root)])
    whole /= np.where((length := np.linalg.norm(whole, axis=0)) > 0.0, length, 1.0)
    basis = scipy.linalg.orth(whole)
    blank = np.zeros((len(root), len(parts)))
    columns, target = np.vstack([split, blank]), fit.whitened + g * fit.theta[column]
    target = np.concatenate([target, -root * theta])
    full = np.linalg.norm(columns, axis=0)
    columns, target = (z - basis @ (basis.T @ z) for z in (columns, target))
    length = np.linalg.norm(columns, axis=0)
    seen = length > _SEEN * np.max(full, initial=0.0)
    value, u = np.zeros(len(parts)), np.full(len(parts), np.inf)
    if seen.any():
        scaled = columns[:, seen] / length[seen]
        # What only all parts together leave undetermined gets a large variance, not an error.
        covariance = np.linalg.inv(scaled.T @ scaled + _OPEN * np.eye(seen.sum()))
        value[seen] = covariance @ (scaled.T @ target) / length[seen]
        u[seen] = np.sqrt(np.diag(covariance)) / length[seen]
    return value, u


def changing(fit: Fit, best: Rival) -> Figure | None:
    """The size of the effect over the quantity; None where `changing_sizes` is."""
    effect, sizes = best.effect, changing_sizes(fit, best)
    if sizes is None or not isinstance(effect, Changing):
        return None
    last = len(best.fit.model.effects) - 1
    name = effect.quantities[int(best.fit.shapes[last]["which"])].name
    plan, instrument = fit.measurement.plan, fit.model.instrument
    column = column_of(name, plan)[0]
    drawn = figure(6.4, 3.9)
    margins = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6}
    ax = grid(drawn, 1, 1, margins)[0, 0]
    ax.axhline(sizes.overall, color=INK, lw=0.9)
    ax.plot(in_file(name, sizes.at, plan, instrument), sizes.line, color=AFTER, lw=1.6)
    ax.errorbar(
        in_file(name, sizes.quantity, plan, instrument), sizes.size, yerr=2.0 * sizes.u,
        fmt="o", ms=5, color=BEFORE, capsize=3, lw=1.2,
    )  # fmt: skip
    unit = pretty_unit(sizes.unit)
    title = f"{effect.effect.key}: {sizes.parameter} by {column}"
    titled(ax, title, column_label(column), f"{sizes.parameter}, {unit}")
    return drawn
