"""The signature of an effect: its deviations at the ports, against the covariate that shows it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ..effects.base import Effect, Setup
from ..machine.plan import Plan
from ..machine.ports import PortLayout
from ..model.forward import tool_points_with_jacobian
from .labels import column_label, pretty_unit
from .style import AFTER, FIELD, figure, grid, plain, titled
from .views import column_of, described, values_of

_MARGINS = {"left": 0.8, "right": 1.1, "top": 0.45, "bottom": 0.6, "wspace": 1.7, "hspace": 0.95}
_MOST = 6
_CLEAR = 0.95
"""Share of the variance above which one covariate is sufficient."""
_SIDES = 3
"""Covariates with at most this many values are spread a little, so that dots do not coincide."""


@dataclass(frozen=True)
class Signature:
    """One parameter of an effect on the rows of a plan."""

    parameter: str
    port: str
    x: np.ndarray
    x_label: str
    y: np.ndarray
    """Deviation of the port for one standard deviation of the parameter's prior."""
    unit: str
    tone: np.ndarray | None
    tone_label: str


def signatures(effect: Effect, setup: Setup) -> list[Signature]:
    """One for every amplitude, at most six, at the port through which it moves the tool most."""
    plan = setup.plan
    shape = {name: float(grid[len(grid) // 2]) for name, grid in effect.scan(plan).items()}
    found = []
    response = effect.response(plan, {k: np.asarray(v) for k, v in shape.items()})
    for parameter in effect.amplitudes[:_MOST]:
        sigma = parameter.step
        values = {
            port: sigma * np.broadcast_to(np.asarray(v, float), plan.rows)
            for (port, name), v in response.items()
            if name == parameter.name
        }
        port = _foremost(values, setup)
        turned = port[1] in "ABC" if port.startswith("E") else port.split(".")[-1] in _TURNED
        unit, factor = ("urad", 1e6) if turned else ("um", 1e6)
        y = factor * values[port]
        shown = np.flatnonzero(y) if any(n.startswith("since_") for n in effect.needs) else ...
        x, label, tone, tone_label = _against(effect, plan, shape, y)
        tone = None if tone is None else tone[shown]
        found.append(
            Signature(parameter.name, port, x[shown], label, y[shown], unit, tone, tone_label)
        )
    return found


def _foremost(values: Mapping[str, np.ndarray], setup: Setup) -> str:
    """The port whose deviations (n,), SI, move the tool point most over the rows; deviations of
    ports of the instrument count without a lever.
    """
    if len(values) == 1:
        return next(iter(values))
    plan, layout = setup.plan, setup.layout
    still = np.zeros((plan.rows, len(layout)))
    levers = np.asarray(tool_points_with_jacobian(setup.chain, plan.position, still)[1])

    def moved(port: str) -> float:
        tool = port in PortLayout.of(plan.axes, ())
        lever = levers[:, :, layout.index(port)] if tool else np.ones((plan.rows, 1))
        return float(np.linalg.norm(np.ptp(values[port][:, None] * lever, axis=0)))

    return max(values, key=moved)


_TURNED = ("A", "B", "C", "azimuth", "elevation")


def _against(effect: Effect, plan: Plan, shape: dict[str, float], y: np.ndarray):
    names = [n for n in dict.fromkeys((*effect.indicators, *effect.needs)) if plan.has(n)]
    names = [n for n in names if np.ptp(values_of(n, plan)) > 0.0]
    if not names:
        return np.arange(plan.rows, dtype=float), "row", None, ""
    for of in effect.shapes:
        if of.name in ("pitch", "period"):
            period, unit = shape[of.name], pretty_unit(of.unit)
            x = np.mod(values_of(names[0], plan), period) / of.si
            return x, f"{names[0]} modulo {period / of.si:.4g} {unit}, {unit}", None, ""
    first = max(names, key=lambda n: described(values_of(n, plan), y))
    others = [n for n in names if n != first]
    column, factor = column_of(first, plan)
    x = factor * values_of(first, plan)
    if described(values_of(first, plan), y) > _CLEAR or not others:
        return x, column_label(column), None, ""
    second = max(others, key=lambda n: described(values_of(n, plan), np.abs(y)))
    if len(np.unique(values_of(first, plan))) <= _SIDES:
        # A direction is unsuitable as an axis and suitable as a colour.
        first, second = second, first
        column, factor = column_of(first, plan)
        x = factor * values_of(first, plan)
    other, scale = column_of(second, plan)
    return x, column_label(column), scale * values_of(second, plan), column_label(other)


def signature(parts: Sequence[Signature]) -> Figure:
    """Small multiples, one per parameter."""
    columns = min(len(parts), 2)
    rows = -(-len(parts) // columns)
    drawn = figure(4.9 * columns, 2.6 * rows + 0.2)
    table = grid(drawn, rows, columns, _MARGINS).ravel()
    for ax in table[len(parts) :]:
        ax.set_visible(False)
    for ax, part in zip(table, parts, strict=False):
        x = part.x
        if len(np.unique(x)) <= _SIDES:
            x = x + 0.08 * np.linspace(-1.0, 1.0, len(x)) * max(float(np.ptp(x)), 1.0)
        colour = {"color": AFTER} if part.tone is None else {"c": part.tone, "cmap": FIELD}
        dots = ax.scatter(x, part.y, s=8, linewidths=0, **colour)
        plain(ax)
        titled(ax, f"{part.parameter}: {part.port}", part.x_label, pretty_unit(part.unit))
        if part.tone is not None:
            bar = drawn.colorbar(dots, ax=ax, pad=0.02)
            bar.set_label(part.tone_label, fontsize=8.5)
            bar.ax.tick_params(labelsize=8)
    return drawn
