"""Ball-bar records: radius or deviation against the angle on a circle, in both senses."""

import re
from collections.abc import Sequence

import numpy as np

from ...instruments.conditions import LINEAR, file_column
from ...study.messages import listed, refusal
from ..base import LIKELY, NO, DataSet, Format, Machine, Needs, Options, register
from ..columns import parsed
from ..export import Export
from ..headed import SNIFFED, Headed, direction, number_in, read_headed, still
from ..units import ANGLES_RAD, LENGTHS_MM, stated_units
from .laser_tracker import MACHINE

_ANGLE = ("angle", "theta", "θ", "polar angle", "position angle")
_READING = (
    *("deviation", "dev", "radial deviation", "error", "delta r", "dr", "δr", "radius", "r"),
    *("length", "measured radius", "bar length", "distance"),
)
_ABSOLUTE = ("radius", "r", "length", "measured radius", "bar length", "distance")
_WAY = ("direction", "dir", "sense", "run")
_OF_POINTS = ("x", "y", "z", "phi", "elevation", "zenith", "azimuth")
"""Columns of points in space."""
_FEWEST = 3
"""Least number of readings of a run."""
_LENGTH = "length_mm"
_KEYS = {
    _LENGTH: "distance of the balls at which the bar reads zero, mm",
    "sigma_um": "noise of a reading, one standard deviation, um",
}


@register
class BallBarRecord(Format):
    """Angle and radius, or deviation of the radius, along one circle or arc.

    - One reading per row in the order of travel: ``angle``, ``deviation`` or ``radius``, and
      optionally ``direction`` (``CCW`` or ``CW``); without it, the sense follows from the angles.
    - Or one angle per row and a column per run, titled ``CCW`` and ``CW`` (or by an arrow).

    The angle counts from the first axis of the plane to the second one (ISO 230-4: from X to Y in
    the plane XY), and the commanded positions are those of a circle about the centre. Comment lines
    may state the plane (``Plane: XY``), the nominal radius (``Radius: 150 mm``) and the feed
    (``Feed: 1000 mm/min``). One file is one set-up; several files become several set-ups.
    """

    name = "ball_bar"
    summary = "angle and radius or deviation on circles, runs in both senses (ISO 230-4)"
    needs = (
        "--machine, --tool-offset, --axis PLANE where the file names none, --at with the centre of "
        "the circle, --set instrument.length_mm=... where the file states no radius, "
        "instrument.sigma_um, --unit LENGTHS,DEVIATIONS where it states none"
    )
    source = "ISO 230-4:2022, circular tests (definitions of the deviations and senses)"
    undocumented = (
        "the records of ball-bar software (.b5r and others): export angle and deviation as text; "
        "the sign of the feed-in arcs, which have to be cut off"
    )
    keys = _KEYS
    joined = "double_ball_bar"
    levers = True

    def sniff(self, export: Export) -> float:
        if export.text is None:
            return NO
        try:
            table = read_headed(export, SNIFFED)
            _columns(table)
        except ValueError:
            return NO
        return LIKELY

    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        table = read_headed(export)
        angle_place, readings, way = _columns(table)
        names = [parsed(title) for title in table.titles]
        unit = names[angle_place].unit or options.angle_unit
        if unit is None:
            needs.add("--angle-unit", "unit of the angles, which the file does not state")
        angle = table.values[:, angle_place] * ANGLES_RAD[unit or "deg"]
        length = _length(table, options)
        absolute = any(names[place].text in _ABSOLUTE for place in readings)
        runs = []
        for place in readings:
            own = names[place].unit or (options.unit if absolute else options.deviation_unit)
            own = own or _stated(table, absolute)
            if own is None or own not in LENGTHS_MM:
                needs.add("--unit LENGTHS,DEVIATIONS", "unit of the readings, which the file lacks")
            value = table.values[:, place] * LENGTHS_MM.get(own or "mm", 1.0)
            sense = direction(table.titles[place])
            runs += _passes(table, angle, value, sense, _ways(table, way))
        keys = dict(_KEYS)
        if length is None:
            needs.add(f"--set instrument.{_LENGTH}=VALUE", _KEYS[_LENGTH])
            length = 1.0
        plane = _plane(table, options, needs)
        if machine is None:
            needs.add(*MACHINE)
            return []
        if missing := [axis for axis in plane if axis not in machine.chain.axes]:
            raise refusal(
                export.name,
                "plane",
                f"{plane}, and no axis {missing[0]}",
                f"axes of the machine, {listed(machine.chain.axes)}",
                "give --axis, or correct the machine",
            )
        why = "the centre of the circle and the other axes, mm or deg, which the file does not hold"
        centre = still(machine, (), dict(options.at_mm), needs, why)
        rows = [len(run[0]) for run in runs]
        turn = np.concatenate([run[0] for run in runs])
        value = np.concatenate([run[1] for run in runs])
        columns: dict[str, np.ndarray] = {
            "run": np.repeat(np.arange(len(runs)), rows),
            "setup": np.zeros(sum(rows), int),
        }
        for axis in machine.chain.axes:
            name, _ = file_column(axis, machine.chain.axes)
            columns[name] = np.full(len(turn), centre[axis])
        for axis, share in zip(plane, (np.cos(turn), np.sin(turn)), strict=True):
            name, _ = file_column(axis, machine.chain.axes)
            columns[name] = columns[name] + length * share
        if feed := number_in(table.comments, "feed(?:rate)?(?: rate)?"):
            if feed[1].casefold().strip("[]()") in ("mm/min", ""):
                columns["feed_mm_min"] = np.full(len(turn), feed[0])
        columns["deviation_um"] = 1e3 * (value - length if absolute else value)
        instrument: dict[str, object] = {"kind": "double_ball_bar"}
        if _LENGTH not in options.given:
            instrument[_LENGTH] = length
        notes = [f"{export.name} is {len(runs)} runs in the plane {plane}"]
        return [DataSet(export.path.stem, instrument, columns, keys, notes)]


def _columns(table: Headed) -> tuple[int, list[int], int | None]:
    """The column of the angle, those of the readings, and that of the sense; raises `StudyError`
    for other columns.
    """
    names = [parsed(title).text for title in table.titles]
    angle = next((i for i, name in enumerate(names) if name in _ANGLE), None)
    readings = [i for i, name in enumerate(names) if name in _READING]
    turns = [
        i
        for i, title in enumerate(table.titles)
        if re.search(r"\b(?:ccw|cw|clockwise|counter\w*)\b", title, re.IGNORECASE)
        and names[i] not in _WAY
    ]
    way = next((i for i, name in enumerate(names) if name in _WAY), None)
    point = any(name in _OF_POINTS for name in names)
    if angle is None or point or not (readings or turns):
        raise refusal(
            table.name,
            "header",
            f"columns {listed(table.titles)}",
            "an angle, and a deviation or radius, or columns CCW and CW",
            "name the columns `angle [deg]` and `deviation [um]`",
        )
    return angle, turns or readings[:1], way


def _passes(
    table: Headed, angle: np.ndarray, value: np.ndarray, sense: int | None, ways: np.ndarray | None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The runs of one column of readings, each in the order of travel: angles (rad) and values.

    With the sense of the column, the rows are put into the order of that sense. Otherwise a new run
    begins where the sense changes.
    """
    there = np.isfinite(angle) & np.isfinite(value)
    angle, value = angle[there], value[there]
    if sense is not None:
        falling = np.median(np.diff(angle)) < 0.0
        back = falling == (sense > 0)
        return [(angle[::-1], value[::-1]) if back else (angle, value)]
    # The angle may count from 0 to 360 once a turn.
    step = np.sign(np.angle(np.exp(1j * np.diff(angle))))
    # An angle that is read again where the sense changes is the first one of the next run.
    for k in reversed(range(len(step) - 1)):
        step[k] = step[k] or step[k + 1]
    sides = np.r_[step[:1], step] if ways is None else ways[there]
    ends = [0, *(np.flatnonzero(np.diff(sides)) + 1).tolist(), len(angle)]
    for i, j in zip(ends, ends[1:], strict=False):
        if j - i < _FEWEST:
            raise refusal(
                table.name,
                f"line {table.lines[int(np.flatnonzero(there)[i])]}",
                f"a run of {j - i} readings, as the sense of travel changes",
                f"runs of {_FEWEST} readings or more",
                "put the rows into the order of travel, or add a column `direction`",
            )
    return [(angle[i:j], value[i:j]) for i, j in zip(ends, ends[1:], strict=False)]


def _ways(table: Headed, place: int | None) -> np.ndarray | None:
    """A number per row that changes from run to run; None where the file has no such column."""
    if place is None:
        return None
    cells = [row[place].strip().casefold() for row in table.texts]
    known = {cell: k for k, cell in enumerate(dict.fromkeys(cells))}
    return np.array([known[cell] for cell in cells])


def _length(table: Headed, options: Options) -> float | None:
    """The nominal length in mm: of the option, or of a comment; None without both."""
    if _LENGTH in options.given:
        return float(options.given[_LENGTH])
    found = number_in(table.comments, "radius|bar length|nominal length|length")
    if found is None:
        return None
    unit = found[1].casefold().strip("[]()") or options.unit
    return found[0] * LENGTHS_MM[unit] if unit in LENGTHS_MM else None


def _stated(table: Headed, absolute: bool) -> str | None:
    """The unit of the readings in a comment, such as ``Deviations in µm``."""
    return stated_units(table.comments, "readings?" if absolute else "deviations?|readings?")[0]


def _plane(table: Headed, options: Options, needs: Needs) -> str:
    """The two axes of the circle, such as ``"XY"``."""
    texts = [options.axis or "", *table.comments]
    for text in texts:
        plain = text.strip().upper()
        found = re.fullmatch(r"E?([XYZUVW])([XYZUVW])", plain) if text is options.axis else None
        found = found or re.search(
            r"\bPLANE\b[\s:=]*([XYZ])[ \-/]?([XYZ])\b|\b([XYZ])([XYZ])[ -]PLANE\b", plain
        )
        if found:
            first, second = [letter for letter in found.groups() if letter][:2]
            if first != second and {first, second} <= {*LINEAR}:
                return first + second
    needs.add("--axis PLANE", "the plane of the circle, such as XY, which the file does not name")
    return "XY"
