"""ISO 230-2 evaluation of the lines of an interferometer, beside the identified machine."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..effects.thermal import REFERENCE_DEGC
from ..identification.fit import Fit
from ..instruments.interferometer import Interferometer
from ..instruments.line_setup import MATERIAL, POSITION
from ..machine.plan import Plan, of_set
from .compensated import compensated_points
from .error_motions import Spread
from .positioning import Contributors, Positioning, positioning, runs_at_targets, systematic

_SAME_M = 2e-4
"""Positions that are closer are one target."""
_FEWEST = 3
"""Least number of targets of a test."""


@dataclass(frozen=True)
class PositioningTest:
    """One line: what ISO 230-2 states of its readings, and what the identified machine would show.

    Deviations and their uncertainties are in um, target positions in m.
    """

    data_set: str
    """Name of its data set; empty for a single one."""
    line: int
    axis: str
    stated: Positioning
    """Evaluation of the readings, at the place of the reflector."""
    estimated: Mapping[str, tuple[float, float]]
    """Systematic quantities of the identified machine at the tool point, with their standard
    uncertainties: without the noise of the readings, the slope of the set-up and the Abbe error."""


def positioning_tests(fit: Fit) -> list[PositioningTest]:
    """The positioning tests (ISO 230-2:2014) in the data of a fit, line by line: lines of an
    interferometer with at least three targets. Empty for other instruments.

    Readings that the fit leaves out as outliers do not count. The machine is evaluated in the rows
    of the test, so that effects of direction, temperature and time are those of the test; its
    systematic quantities are linear in the mean deviations, with the extreme positions of the
    estimate (`vcal.geometry.positioning.systematic`).
    """
    model, plan = fit.model, fit.measurement.plan
    members = model.instrument.members or {"": model.instrument}
    found = []
    for name, instrument in members.items():
        if isinstance(instrument, Interferometer) and POSITION in instrument.names:
            found += _of_instrument(fit, name, instrument, plan)
    return found


def _of_instrument(
    fit: Fit, name: str, instrument: Interferometer, plan: Plan
) -> list[PositioningTest]:
    own = plan.of(name) if name else plan
    inside = plan.in_set(name) if name else np.ones(plan.rows, bool)
    column = instrument.names.index(POSITION)
    readings = 1e6 * np.asarray(fit.measurement.readings)[:, column]
    lines, chain = instrument.lines, instrument.chain
    points, jacobian = compensated_points(fit, plan)
    position = np.asarray(plan.position)
    spread, turn = Spread.of_fit(fit), chain.turn(position)
    away = points - fit.model.chain.tool_point(position)
    found = []
    for k in lines.with_position():
        axis = lines.axes[k]
        rows = np.flatnonzero(
            inside & fit.used & (np.asarray(own.groups["line"]) == lines.numbers[k])
        )
        direction = of_set(name, f"dir_{axis}") if name else f"dir_{axis}"
        if len(rows) < _FEWEST or not plan.has(direction):
            continue
        x, way = np.asarray(plan.x(axis))[rows], plan.values(direction)[rows]
        target, up, down = runs_at_targets(x, way, readings[rows], apart=_SAME_M)
        if len(target) < _FEWEST or (up is None and down is None):
            continue
        about = _contributors(instrument, own, rows)
        stated = positioning(target, up, down, about)
        along = turn[rows] @ lines.along[k]
        deviation = 1e6 * np.einsum("ni,ni->n", away[rows], along)
        deviation -= 1e6 * _compensation(instrument, own, rows, k)
        slopes = 1e6 * np.einsum("nik,ni->nk", jacobian[rows], along)
        means = _means(x, way, target, up is not None, down is not None)
        estimate = means @ deviation
        m = len(target)
        halves = [
            None if there is None else estimate[start : start + m]
            for there, start in ((up, 0), (down, m if up is not None else 0))
        ]
        estimated = {}
        for quantity, weights in systematic(*halves).items():
            u = float(spread.of((weights @ means @ slopes)[None])[0][0])
            estimated[quantity] = float(weights @ estimate), u
        found.append(PositioningTest(name, lines.numbers[k], axis, stated, estimated))
    return found


def _means(x: np.ndarray, way: np.ndarray, target: np.ndarray, up: bool, down: bool) -> np.ndarray:
    """Matrix of the means over the rows at every target: positive direction, then negative."""
    blocks = []
    for direction, there in ((1.0, up), (-1.0, down)):
        if there:
            mine = (np.abs(x - target[:, None]) <= _SAME_M) & (way == direction)
            blocks.append(mine / np.maximum(mine.sum(1, keepdims=True), 1))
    return np.concatenate(blocks)


def _compensation(instrument: Interferometer, plan: Plan, rows: np.ndarray, k: int) -> np.ndarray:
    """What the instrument subtracted from the positioning as expansion of the material, m."""
    alpha = instrument.settings.expansion_um_per_m_K
    if alpha is None:
        return np.zeros(len(rows))
    warm = np.asarray(plan.covariate(MATERIAL))[rows] - REFERENCE_DEGC
    s = np.asarray(plan.x(instrument.lines.axes[k]))[rows] - instrument.lines.centres[k]
    return 1e-6 * alpha * warm * s


def _contributors(instrument: Interferometer, plan: Plan, rows: np.ndarray) -> Contributors:
    """The declared uncertainties of the instrument, in um and m."""
    s = instrument.settings
    away = 0.0
    if s.expansion_um_per_m_K is not None:
        away = float(np.mean(np.asarray(plan.covariate(MATERIAL))[rows])) - REFERENCE_DEGC
    slope = s.slope_sigma_um_per_m
    return Contributors(
        device=s.laser_u_um_per_m,
        misalignment=0.0 if slope == "free" else slope,
        temperature=s.material_u_K,
        expansion=s.expansion_um_per_m_K or 0.0,
        expansion_u=s.expansion_u_um_per_m_K,
        away=away,
        environment=s.environment_um,
    )
