"""The tables of a measurement and of check points: their columns, checked against the machine."""

import math
import re
from collections.abc import Iterator, Sequence

import numpy as np

from ..errors import StudyError
from ..instruments.base import Column, InstrumentSettings, TableInstrument
from ..instruments.conditions import (
    GROUPS,
    LINEAR,
    MAIN,
    PARALLEL,
    ROTARY,
    file_column,
    linear_plan,
    misnamed,
)
from ..loop.residuals.implausible import COLDEST_DEGC, WARMEST_DEGC, in_fahrenheit
from ..machine.chain import Chain
from ..model.measurement import CheckPoints
from ..numerics.spatial import best_rigid
from ..words import counted, plural
from .csv_table import Table
from .folder import Folder
from .messages import listed, refusal
from .optional_columns import condition
from .plugins.instruments import columns_of, instrument_class
from .table_checks import check_repeated, check_unread

_FEWEST_ROWS = 3
_FAR = "no machine is a kilometre long"
_TOOL_POINT = tuple(f"tcp_{c}_mm" for c in "xyz")
_MOST_OFF = 0.02
"""Share of the size of the work space; a larger deviation is no error of a machine."""
_ALONE, _NEAR = 2, 0.3
"""Most rows with an error of at least that share of the largest, where single rows are wrong."""
_ANY_ROW = 4.0
"""Multiple of it up to which many true points may be off where no sign, unit or order is wrong: a
machine that drifts by centimetres is to be found."""
_BETTER = 0.25
"""Share of the error that a change of the columns may leave where it is the cause."""
_STILL_MM = 0.02
"""Scatter of the read-back positions of an axis that stands still."""
_LEAST_SHARE = 0.002
"""Least share of the travel that a measurement covers."""
_LEAST_WIDTH = 1e-3
"""Least width of the check points as a share of their length."""
_JOINT_COLUMN = re.compile(r"q(\d+)_(cmd|read)_(deg|mm)")
_MOVES = re.compile(r"(dir|move)_(q|J)\d+(_deg|_mm)?")
"""Covariates that are computed from the commanded angles of an arm."""


def run_table(
    name: str,
    settings: InstrumentSettings,
    chain: Chain,
    folder: Folder,
    file: str,
    key: str,
) -> tuple[Table, bool]:
    """The checked table of a measurement, and whether it holds readings.

    Some readings may be blank. For an instrument that reads the positions of the linear axes, these
    may be blank, as for a ball that was not found. Raises `StudyError` where the table does not fit
    the instrument or the machine, and as `Folder.table` does.
    """
    kind = instrument_class(settings, folder)
    plain, full = columns_of(settings, kind, chain.axes)
    places = [] if kind.positioned else _positions(chain, plain)
    labels = kind.label_columns(settings, folder.written(name))
    header = folder.header(name, [*places, *full], condition, labels)
    reading_names = {c.name for c in full} - {c.name for c in plain}
    measured = not reading_names or any(column in reading_names for column in header)
    _check_machine(kind, chain, file, f"{key}instrument.kind")
    columns = [*places, *(full if measured else plain)]
    if kind.read_by:
        columns = [c for c in columns if c.name in header or c.name not in reading_names]
    if not measured:
        known = {*labels, *(c.name for c in columns)}
        further = [c for c in header if c not in known and not condition(c)]
        check_unread(name, kind.kind, further, reading_names, kind.read_otherwise)
    # An instrument without columns of its own reads the positions.
    linear = {file_column(axis, chain.axes)[0] for axis in chain.axes if axis in MAIN}
    read = reading_names or {c.name for c in places} & linear
    table = folder.table(
        name,
        columns,
        condition,
        labels=labels,
        readings=read if measured else (),
        read_by=kind.read_by,
    )
    complete = table.complete
    if complete.rows < _FEWEST_ROWS:
        raise refusal(
            name,
            f"{table.where(table.rows - 1)}, column {columns[0].name}",
            f"the end of the table after {counted(complete.rows, 'row')}"
            + ("" if complete is table else " without a blank reading"),
            f"at least {_FEWEST_ROWS} rows",
            "measure more points"
            + (
                f", or correct the column {kind.read_by}: rows of one index have the same readings"
                if kind.read_by and complete is not table
                else ""
            ),
        )
    _check_spelling(table, [c.name for c in columns])
    _check_names(table, chain, (*labels, *reading_names))
    # If positions are the readings, they are unknown in rows with a blank one.
    _check_conditions(table if reading_names else complete, chain)
    if measured:
        check_repeated(complete, reading_names or {c.name for c in places})
    return table, measured


def check_points(
    name: str,
    instrument: TableInstrument,
    settings: InstrumentSettings,
    chain: Chain,
    folder: Folder,
) -> CheckPoints:
    """The independent check points of a study, from the table `name`.

    Raises `StudyError` for a table that does not fit the machine, and for points on a line.
    """
    own = instrument.columns(settings, chain.axes, readings=False)
    tool = _is_tool(chain)
    columns = _positions(chain, own) if tool else list(own)
    columns += [Column(name=name, low=-1e6, high=1e6, why=_FAR) for name in _TOOL_POINT]
    table = folder.table(name, columns, condition)
    points = np.column_stack([table[name] for name in _TOOL_POINT]) * 1e-3
    arms = points - points.mean(0)
    _, width, length = np.linalg.eigvalsh(arms.T @ arms)
    if width <= _LEAST_WIDTH**2 * length:
        raise refusal(
            name,
            f"columns {listed(_TOOL_POINT)}",
            f"{counted(table.rows, 'check point')} on a line",
            "at least 3 that are not on a line, as the alignment determines six parameters",
            "add points off that line, or remove the file",
        )
    _check_spelling(table, [c.name for c in columns])
    _check_names(table, chain, _TOOL_POINT)
    _check_conditions(table, chain)
    if tool:
        _check_tool_points(table, chain)
    # Check points belong to the machine; they have no columns that an instrument derives.
    if tool:
        plan = linear_plan(chain, table, temperature_offset_K=instrument.temperature_offset_K)
    else:
        plan = instrument.plan(chain, table)
    return CheckPoints(plan, points)


def _is_tool(chain: Chain) -> bool:
    """Whether the chain is that of a machine tool, with positions in ``x_mm``, ``c_deg``, ..., and
    not of an arm.
    """
    return set(chain.axes) <= {*LINEAR, *ROTARY}


def _positions(chain: Chain, own: Sequence[Column]) -> list[Column]:
    """Position columns of the machine that are not among the instrument's own columns."""
    names = {column.name for column in own}
    places = [file_column(axis, chain.axes)[0] for axis in chain.axes] if _is_tool(chain) else []
    return [Column(name=name, low=-1e6, high=1e6, why=_FAR) for name in places if name not in names]


def _check_machine(kind: type[TableInstrument], chain: Chain, file: str, key: str) -> None:
    """Raise `StudyError` where the instrument does not fit the machine.

    An instrument that measures arms needs an arm, any other one the axes X, Y and Z.
    """
    if kind.arms:
        fits = not _is_tool(chain)
        expected = "an arm of [[machine.joint]] rows"
    else:
        others = {*(ROTARY if kind.rotary else ()), *(PARALLEL if kind.parallel else ())}
        fits = {*MAIN} <= {*chain.axes} <= {*MAIN, *others}
        expected = "a machine.chain with the axes X, Y and Z"
        if kind.parallel:
            expected += ", secondary axes U, V, W"
        expected += ", and rotary axes A, B, C where it has some" if kind.rotary else " alone"
    if not fits:
        raise refusal(
            file,
            f"key {key}",
            f"{kind.kind!r} on a machine with {chain.text!r}",
            f"{expected} for this instrument",
            "change the instrument or the machine",
        )


def _check_spelling(table: Table, asked: Sequence[str]) -> None:
    """Raise `StudyError` for a required column or an index that is repeated in other letters
    (``c_deg`` and ``C_deg``), as it would be taken for another quantity.
    """
    meant = {name.casefold(): name for name in (*GROUPS, *asked) if name in table}
    for name in table:
        column = meant.get(name.casefold(), name)
        if column != name:
            raise _twice(table.name, (column, name), column)


def _twice(file: str, columns: Sequence[str], meant: str) -> StudyError:
    return refusal(
        file,
        f"header, columns {' and '.join(columns)}",
        "two columns of one quantity",
        f"one, {meant}",
        "remove one of them, or rename it where it is another quantity",
    )


def _check_names(table: Table, chain: Chain, others: Sequence[str]) -> None:
    """Raise `StudyError` where a quantity has another name than its own, or two columns.

    `others` are columns that are no conditions.
    """
    for name in table:
        if _MOVES.fullmatch(name) and not _is_tool(chain):
            raise refusal(
                table.name,
                f"header, column {name}",
                "a column of joint moves, which vcal computes",
                "the commanded angles (q1_cmd_deg, ...) in the order of pose",
                "rename or remove the column",
            )
    wrong = misnamed([c for c in table if c not in others and c not in GROUPS], chain.axes)
    if wrong is None:
        return
    columns, meant = wrong
    if len(columns) > 1:
        raise _twice(table.name, columns, meant)
    raise refusal(
        table.name,
        f"header, column {''.join(columns)}",
        f"the internal name of the quantity in column {meant}",
        f"{meant}, or another name for another quantity",
        "rename or remove the column",
    )


def _check_conditions(table: Table, chain: Chain) -> None:
    """Raise `StudyError` for a direction other than +1 or -1, of an unknown axis, and for positions
    outside the travel or in another unit.
    """
    for name, values in table.items():
        axis = name.removeprefix("dir_").upper()
        if name.startswith("dir_") and _is_tool(chain):
            if axis not in chain.axes:
                raise refusal(
                    table.name,
                    f"header, column {name}",
                    f"a direction of the unknown axis {axis!r}",
                    f"one of {listed(f'dir_{a.lower()}' for a in chain.axes)}",
                    "rename or remove the column",
                )
            if (bad := np.abs(values) != 1.0).any():
                row = int(np.argmax(bad))
                found, expected = f"{values[row]:g}", "+1 or -1, the last direction of travel"
                raise table.refusal(row, name, found, expected, "correct the value")
        _check_travel(table, name, chain)
    if chain.coupling is not None:
        _check_coupled(table, chain)
    _check_extent(table, chain)
    _check_temperatures(table)


def _check_temperatures(table: Table) -> None:
    """Raise `StudyError` where all temperatures are those of a workshop in degF.

    Nobody measures a machine in air of 68 degC. One that is really that warm declares the unit.
    """
    sure = {one.column for one in table.assigned if one.in_unit}
    names = [n for n in table if n.startswith("T_") and n.endswith("_degC") and n not in sure]
    lows = [float(table[name].min()) for name in names]
    highs = [float(table[name].max()) for name in names]
    if not names or not all(map(in_fahrenheit, lows, highs)) or min(lows) <= WARMEST_DEGC:
        return
    column = names[0]
    stem, (low, high) = (
        column.removesuffix("degC"),
        ((v - 32) / 1.8 for v in (min(lows), max(highs))),
    )
    raise refusal(
        table.name,
        f"{plural(len(names), 'column')} {listed(names)}",
        f"temperatures that are all between {min(lows):.4g} and {max(highs):.4g} degC",
        f"temperatures of a machine, from {COLDEST_DEGC:g} to {WARMEST_DEGC:g} degC",
        f"in degF they would be {low:.3g} to {high:.3g} degC: name the columns {stem}degF and so "
        f'on, or declare {column} = {{ from = "{column}", unit = "degF" }} in [data.columns]; or '
        'declare unit = "degC" there if they are right',
    )


def _check_coupled(table: Table, chain: Chain) -> None:
    """Raise `StudyError` where commands lead a joint that is coupled to others out of its travel.

    The bounds of a joint are those of its position, not those of its command.
    """
    for kind in ("commanded", "read"):
        columns = [file_column(f"{kind}_{axis}", chain.axes) for axis in chain.axes]
        if any(name not in table for name, _ in columns):
            continue
        position = chain.positions(np.column_stack([table[n] / factor for n, factor in columns]))
        for i, (joint, (name, factor)) in enumerate(zip(chain.joints, columns, strict=True)):
            low, high = joint.travel
            slack = 1e-9 * max((abs(b) for b in (low, high) if math.isfinite(b)), default=0.0)
            bad = (position[:, i] < low - slack) | (position[:, i] > high + slack)
            if bad.any():
                row = int(np.argmax(bad))
                raise table.refusal(
                    row,
                    name,
                    f"{table[name][row]:.10g}, with machine.coupling a position of joint {i + 1} "
                    f"of {position[row, i] * factor:.10g}, outside the travel",
                    f"positions from {low * factor:.10g} to {high * factor:.10g} "
                    f"(machine.joint.{i})",
                    "correct the coupling, the position or the travel",
                )


def _check_extent(table: Table, chain: Chain) -> None:
    """Raise `StudyError` for positions that cover so little of the travel that they are not in mm.

    Positions that follow a point on a rotating axis may cover little of it.
    """
    turning = (file_column(axis, chain.axes)[0] for axis in chain.axes if axis in ROTARY)
    if any(np.ptp(table[name]) > 0.0 for name in turning if name in table):
        return
    columns = {
        f"{axis.lower()}_mm": j.travel * 1e3
        for axis, j in zip(chain.axes, chain.joints, strict=True)
        if axis in LINEAR
    }
    if not columns or not all(name in table for name in columns):
        return
    shares = [np.ptp(table[name]) / np.ptp(travel) for name, travel in columns.items()]
    if 0.0 < max(shares) < _LEAST_SHARE:
        low = min(table[name].min() for name in columns)
        high = max(table[name].max() for name in columns)
        raise refusal(
            table.name,
            f"columns {listed(columns)}",
            f"positions from {low:.4g} to {high:.4g}, at most {100 * max(shares):.2g} % of the "
            "travel",
            "millimetres over more of it",
            "correct the unit of the positions or of machine.travel_mm",
        )
    for name, travel in columns.items():
        _check_unit(table, name, np.asarray(travel))


def _check_unit(table: Table, name: str, travel: np.ndarray) -> None:
    """Raise `StudyError` for a single axis in metres: it moves, but within a thousandth of its
    travel.
    """
    values, reach = table[name], np.abs(travel).max()
    moved, farthest = np.ptp(values), np.abs(values).max()
    if not math.isfinite(reach) or moved <= _STILL_MM:
        return
    if moved < _LEAST_SHARE * np.ptp(travel) and farthest <= 1.001e-3 * reach:
        key = f"machine.travel_mm.{name.removesuffix('_mm').upper()}"
        raise refusal(
            table.name,
            f"column {name}",
            f"positions from {values.min():.4g} to {values.max():.4g}, a thousandth of the travel "
            f"of {travel[0]:.7g} to {travel[1]:.7g}",
            "millimetres, as in the travel",
            f"correct the unit of the positions or of {key}",
        )


def _check_tool_points(table: Table, chain: Chain) -> None:
    """Raise `StudyError` where true tool points do not follow the commanded positions.

    They agree up to the errors of the machine and a rigid motion, which includes the tool offset.
    """
    columns = [file_column(axis, chain.axes) for axis in chain.axes]
    position = np.column_stack([table[name] / factor for name, factor in columns])
    commanded = 1e3 * chain.tool_point(position)
    found = np.column_stack([table[name] for name in _TOOL_POINT])

    def left(points: np.ndarray) -> np.ndarray:
        turn, place = best_rigid(points, commanded)
        return np.linalg.norm(points @ turn.T + place - commanded, axis=1)

    off = left(found)
    size = np.linalg.norm(commanded - commanded.mean(0), axis=1).max()
    row = int(np.argmax(off))
    columns_wrong = any(left(other).max() < _BETTER * off[row] for other in _otherwise(found))
    plain = columns_wrong or np.count_nonzero(off > _NEAR * off[row]) <= _ALONE
    if off[row] > (1.0 if plain else _ANY_ROW) * _MOST_OFF * size:
        raise refusal(
            table.name,
            f"{table.where(row)}, columns {listed(_TOOL_POINT)}",
            f"a tool point that is {off[row]:.4g} mm off after the best rigid alignment of all "
            "points with the positions",
            f"one that follows the positions to {_MOST_OFF * size:.4g} mm, all in millimetres",
            "correct the unit, sign and order of these columns, or the row",
        )


def _otherwise(points: np.ndarray) -> Iterator[np.ndarray]:
    """Points (n, 3) after single changes of their columns: a sign or the order, which a rotation
    brings to the same mirror image; a unit.
    """
    yield points * [-1.0, 1.0, 1.0]
    for factor in (25.4, 1.0 / 25.4, 1e3, 1e-3):
        yield factor * points
        for column in range(3):
            yield points * np.where(np.arange(3) == column, factor, 1.0)


def _check_travel(table: Table, name: str, chain: Chain) -> None:
    if match := _JOINT_COLUMN.fullmatch(name):
        if chain.coupling is not None:
            return
        place, unit = int(match[1]) - 1, math.radians(1.0) if match[3] == "deg" else 1e-3
        key = f"machine.joint.{place}"
    else:
        columns = {file_column(axis, chain.axes)[0]: axis for axis in chain.axes}
        axis = columns.get(name)
        if axis is None:
            return
        place, unit = chain.axes.index(axis), 1.0 / file_column(axis, chain.axes)[1]
        key = f"machine.travel_mm.{axis}" if axis in LINEAR else f"machine.rotary.{axis}.travel_deg"
    if not 0 <= place < len(chain.joints):
        return
    low, high = chain.joints[place].travel / unit
    # A file with ten digits may round a position at the end of the travel to just beyond it.
    slack = 1e-9 * max((abs(b) for b in (low, high) if math.isfinite(b)), default=0.0)
    bad = (table[name] < low - slack) | (table[name] > high + slack)
    if bad.any():
        row = int(np.argmax(bad))
        raise table.refusal(
            row,
            name,
            f"{table[name][row]:.10g}, outside the travel",
            f"{low:.10g} to {high:.10g} ({key})",
            "correct the position or the travel",
        )
