"""Conditions of machines with linear axes: columns of the data files to a plan, and back."""

import re
from collections.abc import Collection, Mapping

import numpy as np

from ..chain import Chain
from ..plan import Plan

GROUPS = ("point", "pose", "ball", "run", "segment")


def linear_plan(
    chain: Chain, table: Mapping[str, np.ndarray], readings: Collection[str] = ()
) -> Plan:
    """Plan from ``x_mm``, ``dir_x``, ``t_s``, ``T_x_degC``, ``T_air_degC``, group indices, ...

    Temperatures and directions of axes are named after the axis (``"T_X"``, ``"dir_X"``). Any
    further numeric column that is not one of the `readings` becomes a covariate under its own name,
    for effects of the user's own.
    """
    axes = chain.axes
    position = np.column_stack([table[f"{axis.lower()}_mm"] for axis in axes]) * 1e-3
    covariates: dict[str, np.ndarray] = {}
    groups: dict[str, np.ndarray] = {}
    used = {f"{axis.lower()}_mm" for axis in axes}
    for name, values in table.items():
        if name in used or name in readings or name.startswith("tcp_"):
            continue
        if name in GROUPS:
            groups[name] = np.asarray(values, int)
            continue
        covariates[_inside_name(name, axes)] = np.asarray(values, float)
    return Plan(axes, position, covariates, groups)


def linear_plan_table(plan: Plan) -> dict[str, np.ndarray]:
    """Columns in file units: the inverse of `linear_plan`."""
    table: dict[str, np.ndarray] = {k: np.asarray(v) for k, v in plan.groups.items()}
    for axis in plan.axes:
        table[f"{axis.lower()}_mm"] = np.asarray(plan.x(axis)) * 1e3
    for name, values in plan.covariates.items():
        table[file_name(name, plan.axes)] = np.asarray(values)
    return table


def _inside_name(column: str, axes: tuple[str, ...]) -> str:
    if match := re.fullmatch(r"dir_(\w+)", column):
        return f"dir_{match[1].upper()}" if match[1].upper() in axes else column
    if match := re.fullmatch(r"T_(\w+)_degC", column):
        name = match[1].upper()
        return f"T_{name}" if name in axes else f"T_{match[1]}"
    return "t" if column == "t_s" else column


def file_name(covariate: str, axes: tuple[str, ...]) -> str:
    """Name of a covariate or axis as users know it from their files: ``"T_x_degC"``, ``"x_mm"``."""
    if covariate in axes:
        return f"{covariate.lower()}_mm"
    if match := re.fullmatch(r"dir_(\w+)", covariate):
        return f"dir_{match[1].lower()}"
    if match := re.fullmatch(r"T_(\w+)", covariate):
        name = match[1].lower() if match[1] in axes else match[1]
        return f"T_{name}_degC"
    return "t_s" if covariate == "t" else covariate
