"""Comment lines that the files of all formats share: machine, date, sign, tool, conditions."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .base import Format
from .fields import Field
from .machine import IdentifiedMachine


def header(machine: IdentifiedMachine, form: type[Format[Any]], sign: str = "") -> list[str]:
    """Lines, without a comment sign, that state what a file is and how it is to be used."""
    tool = ", ".join(f"{1e3 * v:.6g}" for v in np.asarray(machine.chain.tool_offset))
    lines = [
        f"compensation by vcal, format {form.name}: {form.summary}",
        f"machine: {machine.name or 'without a name'}, {machine.chain.text}",
        f"date: {machine.date or 'not stated'}",
        f"sign: {sign or form.sign}; error = actual - nominal, in the frame of the workpiece",
        f"units: {form.units}",
        f"resolution: {form.resolution}",
        f"tool offset: {tool} mm (X, Y, Z from the frame of the last axis to the tool point); the "
        "corrections hold for this tool",
        *(f"travel of {axis}: {_span(machine, i)}" for i, axis in enumerate(machine.axes)),
    ]
    unknown = machine.unidentified
    lines.append(
        f"not identified by the measurement, and zero here: {', '.join(unknown)}"
        if unknown
        else "all declared errors are identified by the measurement"
    )
    return lines


def conditions_in_words(
    machine: IdentifiedMachine, field: Field | None, at: Mapping[str, float]
) -> list[str]:
    """Lines on the conditions: those that vary, with the value at which the base holds, and those
    for which the table is made.
    """
    lines = []
    slopes = {} if field is None else field.slopes
    zeros = {} if field is None else field.zeros
    for name in slopes:
        if name.startswith("dir_"):
            axis = name.removeprefix("dir_")
            lines.append(
                f"{name}: +1 where {axis} was approached in the positive direction, -1 in the "
                f"negative one; correction = base + {name} * per_{name}"
            )
        else:
            unit = "degC" if name.startswith("T_") else ""
            zero = outside(machine, name, zeros[name])
            lines.append(
                f"{name}: base holds at {zero:.6g} {unit}".rstrip()
                + f"; correction = base + ({name} - {zero:.6g}) * per_{name}"
            )
    for name in machine.ranges:
        if name not in slopes and _matters(machine, name):
            held = outside(machine, name, at.get(name, machine.at_rest(name)))
            unit = " degC" if name.startswith("T_") else " (SI)"
            lines.append(f"{name}: the table holds at {held:.6g}{unit}")
    if not any(name.startswith("T_") for name in machine.ranges):
        lines.append("temperature: no identified error depends on it; as during the measurement")
    return lines


def outside(machine: IdentifiedMachine, name: str, value: float) -> float:
    """A condition as it is read on the sensor."""
    return value + (machine.temperature_offset_K if name.startswith("T_") else 0.0)


def _matters(machine: IdentifiedMachine, name: str) -> bool:
    return any(name in part.needs for part in machine.parts if part.name in machine.shown)


def _span(machine: IdentifiedMachine, axis: int) -> str:
    low, high = machine.volume[axis]
    factor, unit = (57.29577951308232, "deg") if machine.chain.joints[axis].turns else (1e3, "mm")
    return f"{factor * low:.6g} to {factor * high:.6g} {unit}"
