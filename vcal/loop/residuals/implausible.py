"""Numbers in the input that hardly any machine or instrument has: a unit, or a column, is wrong."""

import math

import numpy as np

from ...instruments.base import Instrument, TableInstrument
from ...instruments.conditions import LINEAR, file_column, in_file
from ...machine.chain import Chain
from ...machine.plan import Plan, of_set
from ...words import plural

COLDEST_DEGC, WARMEST_DEGC = -20.0, 60.0
"""Temperatures between which machines are measured."""
_FASTEST_M_S, _FASTEST_RAD_S = 4.0, 12.0
"""Speeds that no linear axis (240 m/min) and no joint (690 deg/s) exceeds in half of its moves."""
_LONGEST_S = 86400.0
"""Longest median time from row to row."""
_LITTLE = 0.1
"""Share of a travel below which a measurement covers hardly any of it."""
_LEAST_NOISE_UM = 0.01
_UNITS_OF_TIME = (("ms", 1e-3), ("min", 60.0), ("h", 3600.0), ("days", 86400.0))
_MOVED = 1e-6
"""Least move of an axis, m or rad."""
_FEWEST_IN_TURN = 10
"""Least number of rows in which two values in turn are no chance."""
_LONG_TOOL_M = 0.5
"""Longest tool that may be on any machine."""
_FEWEST = 5
"""Least number of moves that are judged."""


def implausible(
    chain: Chain, plan: Plan, instrument: Instrument, readings: np.ndarray | None
) -> list[str]:
    """A sentence for everything implausible: temperatures, times, travel, directions, noise."""
    return [
        *_temperatures(plan, instrument),
        *_times(plan),
        *_travels(chain, plan, instrument),
        *_directions(plan),
        *_alternating(plan),
        *_tool(chain),
        *([] if readings is None else _noise(plan, instrument, readings)),
    ]


def in_fahrenheit(low: float, high: float) -> bool:
    """Whether temperatures would be those of a workshop in degF."""
    return low >= 50.0 and high <= 110.0 and high > WARMEST_DEGC


def _temperatures(plan: Plan, instrument: Instrument) -> list[str]:
    said = []
    for name in plan.covariates:
        column = file_column(name.rpartition(":")[2], plan.axes)[0]
        if not column.endswith("_degC"):
            continue
        values = np.asarray(in_file(name, plan.values(name), plan, instrument))
        values = values[np.isfinite(values)]
        if not len(values):
            continue
        low, high = float(values.min()), float(values.max())
        if COLDEST_DEGC <= low and high <= WARMEST_DEGC:
            continue
        stem = column.removesuffix("degC")
        cause = "correct the column or its unit"
        if in_fahrenheit(low, high):
            cause = (
                f"in degF they would be {(low - 32) / 1.8:.3g} to {(high - 32) / 1.8:.3g} degC: "
                f'name the column {stem}degF, or declare unit = "degF" in [data.columns]'
            )
        said.append(
            f"{column} goes from {low:.4g} to {high:.4g} degC, beyond {COLDEST_DEGC:g} to "
            f"{WARMEST_DEGC:g} degC, between which machines are measured; {cause}"
        )
    return said


def _times(plan: Plan) -> list[str]:
    said = []
    for name, inside in plan.parts.items():
        time, run = (of_set(name, key) if name else key for key in ("t", "run"))
        if not plan.has(time):
            continue
        rows = np.flatnonzero(inside)
        t = plan.values(time)[rows]
        runs = plan.values(run)[rows] if plan.has(run) else np.zeros(len(rows))
        position = np.asarray(plan.position)[rows]
        position = np.where(np.isfinite(position), position, 0.0)
        order = np.lexsort((t, runs))
        dt, same = np.diff(t[order]), np.diff(runs[order]) == 0.0
        moves = np.abs(np.diff(position[order], axis=0))
        of = f" of {name}" if name else ""
        later = dt[same & (dt > 0.0)]
        if len(later) < _FEWEST:
            continue
        if (typical := float(np.median(later))) > _LONGEST_S:
            said.append(
                f"t_s{of} passes {typical / 86400.0:.3g} days from row to row; "
                + _declare([u for u, f in _UNITS_OF_TIME if f < 1.0])
            )
        linear = np.array([axis in LINEAR for axis in plan.axes])
        for which, most, factor, unit in (
            (linear, _FASTEST_M_S, 60.0, "m/min"),
            (~linear, _FASTEST_RAD_S, math.degrees(1.0), "deg/s"),
        ):
            far = moves[:, which].max(axis=1, initial=0.0)
            used = same & (dt > 0.0) & (far > _MOVED)
            if used.sum() < _FEWEST:
                continue
            speed = float(np.median(far[used] / dt[used]))
            if speed > most:
                units = [u for u, f in _UNITS_OF_TIME if f > 1.0 and speed / f <= most]
                said.append(
                    f"t_s{of} implies that the axes move at {factor * speed:.3g} {unit} in half of "
                    f"the moves, where no machine exceeds {factor * most:.3g} {unit}; "
                    + _declare(units)
                )
                break
    return said


def _declare(units: list[str]) -> str:
    if not units:
        return "correct the times"
    return (
        f"if they are in {' or '.join(units)}, declare the unit in [data.columns], such as t_s = "
        f'{{ from = "t_s", unit = "{units[0]}" }}; days of a spreadsheet have format = "excel"'
    )


def _travels(chain: Chain, plan: Plan, instrument: Instrument) -> list[str]:
    members = instrument.members or {"": instrument}
    inside = np.zeros(plan.rows, bool)
    for name, one in members.items():
        if isinstance(one, TableInstrument) and not (one.positioned or one.arms):
            inside |= plan.in_set(name) if name else True
    if not inside.any() or chain.arm:
        return []
    position = np.asarray(plan.position)[inside]
    extent = np.ptp(position, axis=0)
    turning = [j.turns for j in chain.joints]
    if any(e > 0.0 for e, turns in zip(extent, turning, strict=True) if turns):
        return []  # linear axes that follow a rotary one move as far as they have to
    shares = {
        joint.name: share
        for joint, e in zip(chain.joints, extent, strict=True)
        if not joint.turns and np.isfinite(joint.travel).all()
        for share in [float(e / np.ptp(joint.travel))]
        if 0.0 < share < _LITTLE
    }
    if not shares:
        return []
    named = ", ".join(f"{100 * share:.2g} % of {axis}" for axis, share in shares.items())
    return [
        f"the positions cover only {named}: what is found holds there, and errors of the rest of "
        "the travel are not seen; correct the unit of the positions (inches?) or "
        "machine.travel_mm, or measure over more of it"
    ]


def _directions(plan: Plan) -> list[str]:
    still = []
    for axis in plan.axes:
        name = f"dir_{axis}"
        if name not in plan.covariates:
            continue
        values, x = plan.values(name), plan.values(axis)
        steps = np.diff(x[np.isfinite(x)])
        both = (steps > _MOVED).sum() >= _FEWEST and (steps < -_MOVED).sum() >= _FEWEST
        if both and np.nanmax(values) == np.nanmin(values):
            still.append(file_column(name, plan.axes)[0])
    if not still:
        return []
    return [
        f"{plural(len(still), 'the direction', 'the directions')} {', '.join(still)} never "
        f"{plural(len(still), 'changes', 'change')}, although the axes move both ways from row to "
        "row: if every position was approached from one side, backlash cannot be seen; otherwise "
        "record the direction of the last move, or remove the column"
    ]


def _alternating(plan: Plan) -> list[str]:
    """Temperatures and times that take two values in turn."""
    said = []
    for name in plan.covariates:
        column = file_column(name.rpartition(":")[2], plan.axes)[0]
        values = plan.values(name)
        values = values[np.isfinite(values)]
        if not column.endswith(("_degC", "t_s")) or len(values) < _FEWEST_IN_TURN:
            continue
        if values[0] != values[1] and (values[2:] == values[:-2]).all():
            said.append(
                f"{column} alternates between two values from row to row, as no machine does: two "
                "sensors in one column, or a converter that is not settled; correct the column"
            )
    return said


def _tool(chain: Chain) -> list[str]:
    travels = [np.ptp(joint.travel) for joint in chain.joints if not joint.turns]
    size, tool = float(np.linalg.norm(travels)), float(np.linalg.norm(chain.tool_offset))
    if chain.arm or not math.isfinite(size) or tool <= max(size, _LONG_TOOL_M):
        return []
    return [
        f"the tool offset of {1e3 * tool:.4g} mm is longer than the diagonal of the travel, "
        f"{1e3 * size:.4g} mm; correct its unit, if the frame of the last axis is not that far "
        "from the tool point"
    ]


def _noise(plan: Plan, instrument: Instrument, readings: np.ndarray) -> list[str]:
    noise = np.asarray(instrument.noise(plan, readings))
    lengths, present = np.asarray(instrument.lengths(plan, readings)), instrument.present(plan)
    small = {}
    for i, name in enumerate(instrument.readings):
        sigma = 1e6 * (noise * lengths)[present[:, i], i]
        if len(sigma) and (typical := float(np.median(sigma))) < _LEAST_NOISE_UM:
            small[name] = typical
    if not small:
        return []
    least = min(small.values())
    return [
        f"the declared noise of {', '.join(small)} is {least:.2g} µm at the measured points, below "
        f"{_LEAST_NOISE_UM:g} µm, which no instrument in a workshop reaches: every deviation "
        "becomes significant; correct the unit of the *_sigma keys in [instrument]"
    ]
