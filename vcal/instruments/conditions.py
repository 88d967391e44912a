"""Conditions of machine tools: columns of the data files to a plan, and back.

The name of a column ends in its unit: ``t_s``, ``T_x_degC``, ``since_x_mm``, ``c_deg``. The axis
in it may be in either case (``T_X_degC``). Names inside vcal (``t``, ``T_X``, ``a_X``) have no unit
and are not columns; every quantity has one column at most. `misnamed` finds columns that break
these rules.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ..machine.chain import Chain
from ..machine.plan import Plan, slides
from .base import Instrument

GROUPS = ("point", "pose", "ball", "run", "segment")

_COLUMNS = {
    "t": ("t_s", 1.0),
    "t_run": ("t_run_s", 1.0),
    "circle_angle": ("circle_angle_deg", math.degrees(1.0)),
    "range": ("range_mm", 1e3),
    "azimuth": ("azimuth_rad", 1.0),
    "elevation": ("elevation_rad", 1.0),
    "order": ("pose", 1.0),
}
"""Column and factor from SI of covariates whose names inside differ from those in the files."""
MAIN, PARALLEL, ROTARY = "XYZ", "UVW", "ABC"
"""Axes of machine tools: main linear axes, those parallel to them, and rotary axes."""
LINEAR = MAIN + PARALLEL
_DEG = math.degrees(1.0)
_POSITION = {**dict.fromkeys(LINEAR, ("_mm", 1e3)), **dict.fromkeys(ROTARY, ("_deg", _DEG))}
"""Unit at the end of a column of positions, and its factor from SI."""
_MOTION = {
    **{("dir", axis): ("", 1.0) for axis in _POSITION},
    **{("a", axis): ("_m_s2", 1.0) for axis in LINEAR},
    **{("v", axis): ("_m_s", 1.0) for axis in LINEAR},
    **{("a", axis): ("_rad_s2", 1.0) for axis in ROTARY},
    **{("v", axis): ("_rad_s", 1.0) for axis in ROTARY},
    **{("since", axis): unit for axis, unit in _POSITION.items()},
}
"""The same for a column of an axis's motion."""
_TEMPERATURE = "_degC"
_INSIDE = {_COLUMNS[name][0]: name for name in ("t", "order")}
"""Name inside vcal of a column of conditions; instruments derive or read the other columns."""
_JOINT_COLUMNS = {
    "commanded_": "q{}_cmd{}",
    "read_": "q{}_read{}",
    "move_": "move_q{}{}",
    "dir_": "dir_q{}",
}
_JOINT_UNITS = {False: ("_deg", math.degrees(1.0)), True: ("_mm", 1e3)}
"""Unit at the end of a column of a joint's position, and its factor from SI, by whether it slides.
"""


def linear_plan(
    chain: Chain,
    table: Mapping[str, np.ndarray],
    readings: Collection[str] = (),
    temperature_offset_K: float = 0.0,
    groups: Collection[str] = (),
) -> Plan:
    """Plan from ``x_mm``, ``dir_x``, ``t_s``, ``T_x_degC``, ``T_air_degC``, ...

    Temperatures and motions of axes are named after the axis (``"T_X"``, ``"dir_X"``), in SI. The
    index columns ``point``, ``pose``, ``ball``, ``run``, ``segment`` and those named in `groups`
    (a station, a set-up) become `Plan.groups`. Any further numeric column that is not one of the
    `readings` becomes a covariate with its own name and unit, for a user's own effects.
    `temperature_offset_K` is subtracted from temperatures (`Instrument.temperature_offset_K`).
    """
    axes = chain.axes
    columns = [file_column(axis, axes) for axis in axes]
    position = np.column_stack([table[name] / factor for name, factor in columns])
    covariates: dict[str, np.ndarray] = {}
    found: dict[str, np.ndarray] = {}
    used = {name for name, _ in columns}
    for name, values in table.items():
        if name in used or name in readings or name.startswith("tcp_"):
            continue
        if name in GROUPS or name in groups:
            found[name] = np.asarray(values, int)
            continue
        if values.dtype.kind not in "biuf":
            continue  # labels
        covariate = inside_name(name, axes)
        factor = 1.0 if covariate == name else file_column(covariate, axes)[1]
        covariates[covariate] = np.asarray(values, float) / factor
        if name.endswith(_TEMPERATURE):
            covariates[covariate] = covariates[covariate] - temperature_offset_K
    return Plan(axes, position, covariates, found)


def linear_plan_table(
    plan: Plan, derived: Collection[str] = (), temperature_offset_K: float = 0.0
) -> dict[str, np.ndarray]:
    """Columns in file units: the inverse of `linear_plan`.

    `derived` names the covariates that an instrument derives and that are in no file.
    """
    table: dict[str, np.ndarray] = {k: np.asarray(v) for k, v in plan.groups.items()}
    for axis in plan.axes:
        name, factor = file_column(axis, plan.axes)
        table[name] = np.asarray(plan.x(axis)) * factor
    for covariate, values in plan.covariates.items():
        if covariate in derived:
            continue
        name, factor = file_column(covariate, plan.axes)
        table[name] = np.asarray(values) * factor
        if name.endswith(_TEMPERATURE):
            table[name] = table[name] + temperature_offset_K
    return table


def in_file(
    name: str, values: np.ndarray | float, plan: Plan, instrument: Instrument
) -> np.ndarray | float:
    """Values of a covariate or axis of a plan (SI) as in the files of its instrument: in the unit
    of the column, temperatures with `Instrument.temperature_offset_K` added.
    """
    owner, _, plain = name.partition(":")
    of = instrument.members.get(owner)
    column, factor = file_column(name if of is None else plain, plan.axes)
    offset = (of or instrument).temperature_offset_K if column.endswith(_TEMPERATURE) else 0.0
    return values * factor + offset


def inside_name(column: str, axes: tuple[str, ...]) -> str:
    """Name inside vcal of a column of conditions: the inverse of `file_name`.

    Columns of positions and readings, and any further one, keep their names.
    """
    if match := re.fullmatch(r"(dir|a|v|since)_([^_]+)(_\w+)?", column):
        axis = match[2].upper()
        if axis in axes and (match[3] or "") == _MOTION.get((match[1], axis), ("?", 1.0))[0]:
            return f"{match[1]}_{axis}"
    if match := re.fullmatch(r"T_(\w+)_degC", column):
        name = match[1].upper()
        return f"T_{name}" if name in axes else f"T_{match[1]}"
    return _INSIDE.get(column, _joint(column, axes))


def _joint(column: str, axes: tuple[str, ...]) -> str:
    """The same for a column of a joint of an arm."""
    if found := re.search(r"q(\d+)", column):
        axis = f"J{found[1]}"
        for prefix, name in _JOINT_COLUMNS.items() if axis in axes else ():
            if column == name.format(found[1], _JOINT_UNITS[slides(axes, axis)][0]):
                return f"{prefix}{axis}"
    return column


def misnamed(columns: Collection[str], axes: tuple[str, ...]) -> tuple[tuple[str, ...], str] | None:
    """Misnamed columns, and the name that is meant; None where there are none.

    These are two columns of one quantity (``T_x_degC`` and ``T_X_degC``), or one with the name that
    a quantity has inside vcal and therefore without a unit (``t``).
    """
    first: dict[str, str] = {}
    for column in columns:
        name = inside_name(column, axes)
        meant = file_name(name, axes)
        # dir_X has no unit.
        if name == column and meant.lower() != column.lower():
            return (column,), meant
        if name in first:
            return (first[name], column), meant
        first[name] = column
    return None


def file_name(covariate: str, axes: tuple[str, ...]) -> str:
    """Name of the column of a covariate or axis in the files: ``"T_x_degC"``, ``"x_mm"``."""
    return file_column(covariate, axes)[0]


def file_column(covariate: str, axes: Sequence[str]) -> tuple[str, float]:
    """Name of a covariate or axis in the files, and the factor from SI to the unit in that name.

    Joints of an arm have columns by number (``"q2_cmd_deg"`` for commanded positions of a revolute
    joint, ``"q1_cmd_mm"`` of a prismatic one); derived covariates (``"dir_q2"``, ``"tilt"``) have
    names of their own.
    """
    if match := re.fullmatch(r"(commanded_|read_|dir_|move_)?(J(\d+))", covariate):
        name = _JOINT_COLUMNS[match[1] or "commanded_"]
        unit, factor = _JOINT_UNITS[slides(axes, match[2])]
        return name.format(match[3], unit), 1.0 if match[1] == "dir_" else factor
    if covariate in axes and covariate in _POSITION:
        unit, factor = _POSITION[covariate]
        return f"{covariate.lower()}{unit}", factor
    if match := re.fullmatch(r"(dir|a|v|since)_([A-CU-Z])", covariate):
        unit, factor = _MOTION[match[1], match[2]]
        return f"{match[1]}_{match[2].lower()}{unit}", factor
    # A column such as T_gradient_K_per_m is read and written without a conversion.
    if (match := re.fullmatch(r"T_(\w+)", covariate)) and not re.search(r"_K(_|$)", covariate):
        name = match[1].lower() if match[1] in axes else match[1]
        return f"T_{name}_degC", 1.0
    return _COLUMNS.get(covariate, (covariate, 1.0))
