"""How an effect changes with a recorded quantity: its size in parts of the readings."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ..fit import Fit
from ..loop.empirical import Changing
from ..loop.rivals import Rival
from ..loop.unexplained import bins
from .style import AFTER, BEFORE, INK, column_label, figure, grid, pretty_unit, titled
from .views import column_of


@dataclass(frozen=True)
class Sizes:
    """The size of an effect in parts of the readings, and as the description has it."""

    parameter: str
    unit: str
    quantity: np.ndarray
    """Mean of the quantity in every part (k,)."""
    size: np.ndarray
    """(k,), by the readings of that part."""
    u: np.ndarray
    """(k,), standard uncertainties."""
    at: np.ndarray
    """Quantity along the line of the description."""
    line: np.ndarray
    """Size by the description, there."""
    overall: float
    """That of all readings together."""


def changing_sizes(fit: Fit, best: Rival) -> Sizes | None:
    """What the readings say of the amplitude that changes most, part by part: a linear fit at the
    minimum, with a size of its own in every part. None for other
    descriptions, and where a fit has the effect no more or knows its size.
    """
    effect, plan = best.effect, fit.measurement.plan
    if not isinstance(effect, Changing):
        return None
    places = [i for i, e in enumerate(fit.model.effects) if e.key == effect.effect.key]
    if not places:
        return None
    last = len(best.fit.model.effects) - 1
    rows = best.fit.values_of(last)
    change = {p.name: (value, u) for _, p, value, u in rows if not p.shape}
    own = fit.model.effects[places[0]].amplitudes
    told = [abs(change[p.name][0]) / change[p.name][1] for p in own]
    k = int(np.argmax(told))
    parameter = own[k]
    if parameter.known:
        return None
    first = sum(len(e.amplitudes) for e in fit.model.effects[: places[0]])
    column = first + k
    which = int(best.fit.shapes[last]["which"])
    quantity = effect.quantities[which]
    x = plan.values(quantity.name)
    used, m = fit.used, fit.residual.shape[1]
    index = np.full(plan.rows, -1)
    index[used] = bins(x[used])
    parts = np.unique(index[used])
    g = fit.jacobian[:, column]
    split = np.column_stack([g * np.repeat(index == part, m) for part in parts])
    others = np.delete(fit.jacobian, column, axis=1)
    columns = np.hstack([split, others])
    prior = np.concatenate([np.zeros(len(parts)), np.delete(fit.precision, column)])
    h = columns.T @ columns + np.diag(prior)
    # At the minimum, what the readings and the prior ask of the others cancels.
    target = fit.whitened + g * fit.theta[column]
    pull = np.concatenate([np.zeros(len(parts)), np.delete(fit.precision * fit.theta, column)])
    covariance = np.linalg.pinv(h)
    found = covariance @ (columns.T @ target - pull)
    n, step = len(parts), parameter.step / parameter.si
    line = np.linspace(x[used].min(), x[used].max(), 60)
    u = (np.log(line) if quantity.logarithm else line) - quantity.middle
    overall = float(fit.theta[column]) * step
    base = float(best.fit.theta[column]) * step
    return Sizes(
        parameter.name,
        parameter.unit,
        np.array([x[index == part].mean() for part in parts]),
        found[:n] * step,
        np.sqrt(np.diag(covariance)[:n]) * step,
        line,
        base + change[parameter.name][0] * u / quantity.half,
        overall,
    )


def changing(fit: Fit, best: Rival) -> Figure | None:
    """The size of the effect over the quantity; None where `changing_sizes` is."""
    effect, sizes = best.effect, changing_sizes(fit, best)
    if sizes is None or not isinstance(effect, Changing):
        return None
    last = len(best.fit.model.effects) - 1
    name = effect.quantities[int(best.fit.shapes[last]["which"])].name
    column, factor = column_of(name, fit.measurement.plan)
    drawn = figure(6.4, 3.9)
    margins = {"left": 0.75, "right": 0.2, "top": 0.45, "bottom": 0.6}
    ax = grid(drawn, 1, 1, margins)[0, 0]
    ax.axhline(sizes.overall, color=INK, lw=0.9)
    ax.plot(sizes.at * factor, sizes.line, color=AFTER, lw=1.6)
    ax.errorbar(
        sizes.quantity * factor, sizes.size, yerr=2.0 * sizes.u,
        fmt="o", ms=5, color=BEFORE, capsize=3, lw=1.2,
    )  # fmt: skip
    unit = pretty_unit(sizes.unit)
    title = f"{effect.effect.key}: {sizes.parameter} by {column}"
    titled(ax, title, column_label(column), f"{sizes.parameter}, {unit}")
    return drawn
