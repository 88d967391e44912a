"""Positions of the axes or joints at the points of an export, from it or from a second table."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..instruments.conditions import LINEAR, file_column
from ..study.messages import listed, refusal
from .base import Columns, Machine, Needs, Options
from .columns import Name, names_of, places
from .export import Export, TextTable
from .points import Units
from .units import LENGTHS_MM

_JOINT = re.compile(r"(?:q|j|a|joint|axis|th|theta|θ)[ _]?(\d{1,2})")
_PASSED = re.compile(
    r"dir_[a-cu-z]|T_\w+_degC|payload_kg|speed_rpm|approach_rad|run|segment|since_\w+|"
    r"[va]_\w+_m_s2?|[va]_[a-c]_rad_s2?"
)
"""Columns of conditions that already have vcal's own names."""


def joint_columns(names: Sequence[Name], kind: str | None = None) -> list[int]:
    """Columns of joint positions in the order of the joints, of one kind where it is given; empty
    where joints are missing.
    """
    found: dict[int, int] = {}
    for place, name in enumerate(names):
        match = _JOINT.fullmatch(name.text)
        if match and (kind is None or name.kind == kind or (kind == "nominal" and not name.kind)):
            found.setdefault(int(match[1]), place)
    if sorted(found) not in (list(range(len(found))), list(range(1, len(found) + 1))):
        return []
    return [found[joint] for joint in sorted(found)]


def conditions(table: TextTable) -> tuple[dict[str, np.ndarray], set[int]]:
    """Columns of conditions that have vcal's own names (``dir_x``), and their places."""
    found = {n: p for p, n in enumerate(table.header) if _PASSED.fullmatch(n)}
    return {name: table.numbers(place) for name, place in found.items()}, {*found.values()}


def positions(
    export: Export,
    names_of_points: Sequence[str] | None,
    used: Sequence[int] | frozenset[int],
    machine: Machine,
    options: Options,
    needs: Needs,
) -> tuple[dict[str, np.ndarray], set[int]] | None:
    """Position columns of the study, and the columns of the export that they were taken from.

    They come from the table ``--positions``, whose rows belong to those of the export by the names
    of the points or, without names, by their order; without that table from columns of the export
    (``nominal x``, ``q1``). None where there are none; `needs` then has the option.
    """
    if options.positions is not None:
        other = Export(options.positions)
        table = other.table
        found = _found(table, (), machine, options, needs)
        if found is None:
            raise refusal(
                other.name,
                "header",
                f"columns {listed(table.header)}",
                f"the positions of {listed(machine.chain.axes)}",
                "name the columns after the axes, such as x_mm, or q1_deg for a joint",
            )
        rows = _rows(table, export, names_of_points)
        return {name: values[rows] for name, values in found[0].items()}, set()
    found = _found(export.table, used, machine, options, needs)
    if found is None:
        needs.add(
            "--positions FILE",
            f"a table of the positions of {listed(machine.chain.axes)} at every point, with the "
            "names of the points or in their order",
        )
    return found


def _found(
    table: TextTable,
    used: Sequence[int] | frozenset[int],
    machine: Machine,
    options: Options,
    needs: Needs,
) -> tuple[dict[str, np.ndarray], set[int]] | None:
    names = names_of(table)
    if not names:
        return None
    units = Units(table, options, needs)
    axes = machine.chain.axes
    if machine.arm:
        return _joints(table, names, units, axes, machine)
    nominal, plain = places(names, "nominal"), places(names)
    columns: dict[str, np.ndarray] = {}
    taken: set[int] = set()
    for axis in axes:
        place = nominal.get(axis.lower(), plain.get(axis.lower()))
        if place is None or place in used:
            return None
        name, _ = file_column(axis, axes)
        if axis in LINEAR:
            columns[name] = table.numbers(place) * units.length_mm(names[place])
        else:
            columns[name] = np.rad2deg(table.numbers(place) * units.angle_rad(names[place]))
        taken.add(place)
    return columns, taken


def _joints(
    table: TextTable, names: Sequence[Name], units: Units, axes: Sequence[str], machine: Machine
) -> tuple[dict[str, np.ndarray], set[int]] | None:
    commanded, read = joint_columns(names, "nominal"), joint_columns(names, "measured")
    if not commanded:
        commanded, read = read, []
    if not commanded:
        return None
    for found in (commanded, read):
        if found and len(found) != len(axes):
            raise refusal(
                table.name,
                "header",
                f"{len(found)} joints ({listed(table.header[p] for p in found)})",
                f"{len(axes)}, as the machine has",
                "add or remove columns, or declare the machine of the file",
            )
    columns: dict[str, np.ndarray] = {}
    for kind, found in (("commanded", commanded), ("read", read)):
        for axis, joint, place in zip(axes, machine.chain.joints, found or (), strict=False):
            name, _ = file_column(f"{kind}_{axis}", axes)
            values, own = table.numbers(place), names[place]
            if joint.turns:
                if own.unit in LENGTHS_MM:
                    raise _wrong_kind(table, place, "a length", "an angle, as the joint turns")
                columns[name] = _degrees(values, own, units)
            else:
                columns[name] = values * units.length_mm(own)
    return columns, {*commanded, *read}


def _degrees(values: np.ndarray, own: Name, units: Units) -> np.ndarray:
    """Angles in degrees; those in degrees stay the same numbers."""
    factor = units.angle_rad(own)
    return values if factor == np.pi / 180.0 else np.rad2deg(values * factor)


def _wrong_kind(table: TextTable, place: int, found: str, expected: str) -> Exception:
    return refusal(
        table.name, f"column {table.column(place)}", found, expected, "correct the header"
    )


def _rows(table: TextTable, export: Export, names: Sequence[str] | None) -> np.ndarray:
    """The row of the positions for every point of the export."""
    place = places(names_of(table)).get("name")
    if names is not None and place is not None:
        own = table.cells(place)
        row = {name: i for i, name in reversed([*enumerate(own)])}
        if len(row) == len(own):
            missing = [name for name in names if name not in row]
            if not missing:
                return np.array([row[name] for name in names])
            if len(missing) < len(names) or len(own) != len(names):
                raise refusal(
                    table.name,
                    f"column {table.column(place)}",
                    f"no point named {listed(dict.fromkeys(missing), 5)}",
                    f"the names of the points in {export.name}",
                    "add the rows, or remove the names so that rows belong together by their order",
                )
    if len(table.rows) != len(export.table.rows):
        raise refusal(
            table.name,
            "rows",
            f"{len(table.rows)}, and {len(export.table.rows)} in {export.name}",
            "one position per point, or names of the points in both files",
            "add what is missing",
        )
    return np.arange(len(table.rows))


def point_numbers(names: Sequence[str] | None, rows: int) -> np.ndarray:
    """The number of each point: that in its name where all names are numbers, or the order in which
    names occur first; readings of one point have the same number.
    """
    if names is None:
        return np.arange(rows)
    if all(re.fullmatch(r"\d{1,9}", name) for name in names):
        return np.array([int(name) for name in names])
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return np.array([order[name] for name in names])


def left_out(table: TextTable, used: Sequence[int] | set[int] | frozenset[int]) -> list[str]:
    """A note on the columns that were not read."""
    rest = [table.header[p] for p in range(len(table.header)) if p not in used and table.header[p]]
    return [f"columns left out: {listed(rest)}"] if rest else []


def columns_with(*groups: Columns) -> dict[str, Any]:
    """Several groups of columns in one table, in their order."""
    return {name: values for group in groups for name, values in group.items()}
