"""Interferometer runs: deviations at target positions, as the tables of ISO 230-2 print them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...instruments.conditions import LINEAR, file_column
from ...study.messages import listed, refusal
from ..base import LIKELY, NO, DataSet, Format, Machine, Needs, Options, register
from ..columns import parsed
from ..export import Export
from ..headed import SNIFFED, Headed, direction, number_in, read_headed, run_of, still
from ..units import ANGLES_RAD, LENGTHS_MM, stated_units, unit_of
from .laser_tracker import MACHINE

_TARGETS = (
    *("target", "target position", "targets", "position", "nominal", "nominal position", "pi"),
    *("p i", "pos", "soll", "commanded", "x", "y", "z", "u", "v", "w", "axis position"),
)
_INDEX = ("i", "no", "nr", "index", "point", "number", "#", "")
_DEVIATIONS = ("deviation", "error", "positional deviation", "dev", "xij", "x ij", "result")
_RUN, _WAY = ("run", "run no", "run number", "j", "cycle", "lap"), ("direction", "dir", "approach")
_STATISTIC = re.compile(r"\b(?:mean|average|avg|std|sigma|max|min|range|reversal)\b", re.I)
_AXIS = re.compile(r"\b(?i:axis)\b[\s:=]*([XYZUVW])\b|\b([XYZUVW])[ -](?i:axis)\b")
_MOTION = re.compile(r"\bE([XYZABC])([XYZUVW])\b")
_OTHER_KINDS = re.compile(r"\b(straightness|pitch|yaw|roll|angular|angle)\b", re.IGNORECASE)
_SAME = 0.5
"""Slope over the targets above which cells are measured positions, not deviations from them."""


@dataclass(frozen=True)
class _Runs:
    """Deviations of one line."""

    targets: np.ndarray
    """Per reading, in the unit of the file."""
    values: np.ndarray
    run: np.ndarray
    way: np.ndarray
    """+1, -1, or 0 where the file does not say."""
    target_unit: str | None
    value_unit: str | None


@register
class InterferometerRuns(Format):
    """Deviations of one axis at target positions, of several runs in one or both directions.

    - Targets in rows and runs in columns, whose titles name the run and the direction of approach:
      an arrow, ``+`` and ``-``, ``forward`` and ``reverse``. The titles may stand in two rows.
    - Or one reading per row, with the columns ``target``, ``run``, ``direction``, ``deviation``.

    Deviation is measured minus target position (ISO 230-2:2014, 3.6). Cells that follow the targets
    are measured positions; the targets are subtracted then. Rows below the table that begin with a
    word, such as means, are left out. A comment or title names the axis (``Axis: X``) or the error
    motion by ISO 230-1 (``EBX``); straightness and angles need the latter. Several files are
    several lines of one study.
    """

    name = "interferometer"
    summary = "deviations at targets, runs in both directions (ISO 230-2), straightness, angles"
    needs = (
        "--machine, --tool-offset, --at with the positions of the other axes, --axis where the "
        "file names none, --unit TARGETS,DEVIATIONS where it states none"
    )
    source = "ISO 230-2:2014, test results (clause 7): targets, approach directions and runs"
    undocumented = (
        "the files of laser software (.rtl, .pos and others): export a table of targets and runs; "
        "whether readings were compensated for the material is no part of the table: set "
        "instrument.expansion_um_per_m_K"
    )
    joined = "interferometer"
    levers = True

    def sniff(self, export: Export) -> float:
        if export.text is None:
            return NO
        try:
            table = read_headed(export, SNIFFED)
            _runs(table)
        except ValueError:
            return NO
        return LIKELY

    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        table = read_headed(export)
        runs = _runs(table)
        axis, component = _motion(table, options, needs)
        angular = component in "ABC"
        target_mm = runs.targets * _factor(runs.target_unit, options.unit, "--unit", needs)
        lengths = ANGLES_RAD if angular else LENGTHS_MM
        unit = runs.value_unit or options.deviation_unit
        if unit is None or unit not in lengths:
            needs.add(
                "--unit TARGETS,DEVIATIONS",
                f"unit of the deviations, {'urad, arcsec, ...' if angular else 'um, mm, ...'}; "
                f"the file states {'none' if unit is None else unit}",
            )
        deviation = runs.values * lengths.get(unit or "", 1.0) * (1e6 if angular else 1e3)
        if _follows(runs, table) and not angular:
            # Measured positions have the unit of the targets.
            same = _factor(runs.target_unit, options.unit, "--unit", needs)
            deviation = 1e3 * (runs.values * same - target_mm)
        if machine is None:
            needs.add(*MACHINE)
            return []
        if axis not in machine.chain.axes or axis not in LINEAR:
            raise refusal(
                export.name,
                "axis",
                f"{axis!r}",
                f"a linear axis of the machine, one of {listed(machine.chain.axes)}",
                "give --axis, or correct the machine",
            )
        why = "positions of the other axes along the line, mm or deg, which the file does not hold"
        others = still(machine, [axis], options.at_mm, needs, why)
        rows = len(target_mm)
        columns: dict[str, np.ndarray] = {"line": np.zeros(rows, int), "run": runs.run}
        for one in machine.chain.axes:
            name, _ = file_column(one, machine.chain.axes)
            columns[name] = target_mm if one == axis else np.full(rows, others[one])
        if runs.way.all():
            columns[f"dir_{axis.lower()}"] = runs.way
        for words, name in (("air", "T_air_degC"), ("material|scale|machine", "T_material_degC")):
            found = number_in(table.comments, f"(?:{words})[ _]temp(?:erature)?")
            if found and found[1].casefold().strip("°[]().,;") in ("c", "degc", ""):
                columns[name] = np.full(rows, found[0])
        columns[_column(component, axis)] = deviation
        notes = [f"{export.name} is {len(set(runs.run))} runs of E{component}{axis}"]
        return [DataSet(export.path.stem, {"kind": "interferometer"}, columns, {}, notes)]


def _runs(table: Headed) -> _Runs:
    """The readings of a table in the order in which they were taken. Raises `StudyError` where its
    columns are neither targets with runs nor one reading per row.
    """
    names = [parsed(title) for title in table.titles]
    texts = [_plain(title) for title in table.titles]
    target = next((i for i, t in enumerate(texts) if t in _TARGETS), None)
    if target is None:
        raise _no_runs(table, "a column of target positions")
    reading = next((i for i, t in enumerate(texts) if t in _DEVIATIONS), None)
    unit = names[target].unit
    if reading is not None:
        run = next((i for i, t in enumerate(texts) if t in _RUN), None)
        way = next((i for i, t in enumerate(texts) if t in _WAY), None)
        if run is None and way is None:
            raise _no_runs(table, "a column `run` or `direction` beside the deviations")
        rows = np.arange(len(table.lines))
        ways = np.zeros(len(rows), int)
        if way is not None:
            cells = [row[way] for row in table.texts]
            ways = np.array([direction(cell) or _sign(cell) for cell in cells])
        numbers = np.zeros(len(rows), int) if run is None else _whole(table, run)
        values = _finite(table, [reading])[:, 0]
        return _Runs(
            _finite(table, [target])[:, 0],
            values,
            numbers,
            ways,
            unit,
            names[reading].unit or _stated(table),
        )
    columns = [
        i
        for i, title in enumerate(table.titles)
        if i != target
        and texts[i] not in _INDEX
        and not _STATISTIC.search(title)
        and (direction(title) is not None or re.search(r"\brun\b|^r?\d+$", title, re.IGNORECASE))
    ]
    ways = [direction(table.titles[i]) or 0 for i in columns]
    if not columns or (len(columns) < 2 and not any(ways)):
        raise _no_runs(table, "columns of runs, with their directions of approach in the titles")
    values, targets = _finite(table, columns), _finite(table, [target])[:, 0]
    order = np.argsort(targets, kind="stable")
    parts = []
    counts = {1: 0, -1: 0, 0: 0}
    for k, way in enumerate(ways):
        said = run_of(table.titles[columns[k]])
        counts[way] += 1
        number = counts[way] if said is None else said
        rows = order[::-1] if way < 0 else order
        parts.append((number, -way, targets[rows], values[rows, k]))
    parts.sort(key=lambda part: part[:2])
    length = len(targets)
    unit_of_values = next((names[i].unit for i in columns if names[i].unit), None)
    return _Runs(
        np.concatenate([part[2] for part in parts]),
        np.concatenate([part[3] for part in parts]),
        np.repeat([part[0] for part in parts], length),
        np.repeat([-part[1] for part in parts], length),
        unit,
        unit_of_values or _stated(table),
    )


def _plain(title: str) -> str:
    """A title without its unit, in small letters."""
    text = re.sub(r"[\[(].*?[\])]", " ", title)
    text = re.sub(r"[_,.:]+", " ", text).casefold().strip()
    before, _, last = text.rpartition(" ")
    return re.sub(r"\s+", " ", before if before and unit_of(last) else text)


def _sign(cell: str) -> int:
    found = re.fullmatch(r"\s*([-+−]?)1(?:[.,]0*)?\s*", cell)
    return 0 if found is None else -1 if found[1] in ("-", "−") else 1


def _whole(table: Headed, place: int) -> np.ndarray:
    return np.array([run_of(row[place]) or 0 for row in table.texts])


def _finite(table: Headed, places: Sequence[int]) -> np.ndarray:
    """The numbers of columns; raises `StudyError` for a blank cell or a text."""
    values = table.values[:, list(places)]
    if not np.isfinite(values).all():
        row, k = (int(i[0]) for i in np.nonzero(~np.isfinite(values)))
        cell = table.texts[row][places[k]]
        raise refusal(
            table.name,
            f"line {table.lines[row]}, column {table.titles[places[k]]}",
            repr(cell) if cell else "an empty cell",
            "a number",
            "correct the value, or remove the row or the column",
        )
    return values


def _stated(table: Headed) -> str | None:
    """The unit of the deviations in a comment, such as ``Deviations in µm``."""
    length, angle = stated_units(table.comments, "deviations?|errors?|readings?")
    return length or angle


def _factor(own: str | None, given: str | None, option: str, needs: Needs) -> float:
    unit = own or given
    if unit is None or unit not in LENGTHS_MM:
        needs.add(f"{option} TARGETS,DEVIATIONS", "unit of the targets, which the file lacks")
        return 1.0
    return LENGTHS_MM[unit]


def _follows(runs: _Runs, table: Headed) -> bool:
    """Whether the cells are measured positions."""
    if any(word in " ".join(table.titles).casefold() for word in ("deviation", "error")):
        return False
    spread = runs.targets - runs.targets.mean()
    return float(spread @ runs.values) > _SAME * float(spread @ spread)


def _motion(table: Headed, options: Options, needs: Needs) -> tuple[str, str]:
    """The axis and the component of the error motion (``"X"``, ``"B"`` for EBX)."""
    texts = [*table.comments, *table.titles]
    for text in (options.axis or "", *texts):
        if found := _MOTION.search(text.strip().upper() if text is options.axis else text):
            return found[2], found[1]
    if options.axis and (axis := options.axis.strip().upper()) in LINEAR:
        return axis, axis
    other = next((found[0] for text in texts if (found := _OTHER_KINDS.search(text))), None)
    if other:
        needs.add(
            "--axis E..", f"the error motion by ISO 230-1, such as EBX, as the file says {other!r}"
        )
        return "X", "X"
    for text in texts:
        if found := _AXIS.search(text):
            axis = found[1] or found[2]
            return axis, axis
    for title in table.titles:
        if (name := _plain(title).upper()) in LINEAR and len(name) == 1:
            return name, name
    needs.add("--axis X", "the axis, or the error motion such as EBX, which the file does not name")
    return "X", "X"


def _column(component: str, axis: str) -> str:
    """Column of a reading of the instrument."""
    if component == axis:
        return "meas_position_um"
    small = component.lower()
    return f"meas_straight_{small}_um" if component in "XYZ" else f"meas_angle_{small}_urad"


def _no_runs(table: Headed, what: str) -> Exception:
    return refusal(
        table.name,
        "header",
        f"columns {listed(table.titles)}",
        what,
        "name the columns `target [mm]`, `1 + [um]`, `1 - [um]`, ...",
    )
