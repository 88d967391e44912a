"""Tables of robot poses: joint positions and the points that were measured at them."""

import re
from collections.abc import Sequence

import numpy as np

from ..base import LIKELY, NO, DataSet, Format, Machine, Needs, Options, register
from ..columns import Name, names_of
from ..export import Export, TextTable
from ..points import Units, read_points
from ..positions import columns_with, conditions, joint_columns, left_out, positions
from .laser_tracker import SIGMA, arm_set

_SEVERAL = re.compile(r"(?:(?:smr|p|point|target|reflector) ?(\d+) ?([xyz])|([xyz]) ?(\d+))")


@register
class RobotPoses(Format):
    """One row per pose: joint positions ``q1``, ``joint 1``, ``J1``, ``A1`` ... in degrees, radians
    or another unit, and the coordinates of one or several points: ``x``, ``y``, ``z``, spherical
    ones, or ``x1``, ``y1``, ``z1``, ``x2``, ...

    Joints named as commanded (``q1 cmd``) and as read back (``q1 read``) may both be there; the
    read-back ones then position the model. Rows are in the order of time. A column of joint 0 is
    the first joint.
    """

    name = "robot_poses"
    summary = "joint positions of an arm and measured points, one pose per row"
    needs = (
        "--machine (a study file, or a URDF file), the noise as --set instrument.sigma_um=..., "
        "units the file lacks"
    )
    source = "no standard exists; column names as in public data sets and papers on arms"
    undocumented = (
        "the unit of the angles (a header or comment, else --angle-unit), and the zero and the "
        "sense of every joint, which have to be those of the declared machine"
    )
    keys = SIGMA

    def sniff(self, export: Export) -> float:
        table = export.attempted
        if table is None or len(joint_columns(names_of(table))) < 2:
            return NO
        names = names_of(table)
        roles = {name.role for name in names}
        there = {"x", "y", "z"} <= roles or "range" in roles or _several(names)
        return LIKELY if there else NO

    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        table = export.table
        names = names_of(table)
        several = _several(names)
        if machine is None:
            needs.add(
                "--machine FILE", "the arm: a study file with [[machine.joint]] rows, or a URDF"
            )
            if not several:
                read_points(table, options, needs)
            return []
        more, passed = conditions(table)
        if not several:
            points = read_points(table, options, needs)
            placed = positions(export, points.names, points.used, machine, options, needs)
            if placed is None:
                return []
            own, taken = placed
            if points.t_s is not None:
                more = {"t_s": points.t_s, **more}
            notes = [*points.notes, *left_out(table, points.used | taken | passed)]
            return [arm_set(export, table, points, own, more, notes)]
        placed = positions(export, None, frozenset(), machine, options, needs)
        if placed is None:
            return []
        own, taken = placed
        return [_many(export, table, names, several, own, taken | passed, more, options, needs)]


def _several(names: Sequence[Name]) -> dict[tuple[int, str], int]:
    """Columns of the coordinates of several points by number and axis; empty where one lacks."""
    found: dict[tuple[int, str], int] = {}
    for place, name in enumerate(names):
        if match := _SEVERAL.fullmatch(name.text):
            found.setdefault((int(match[1] or match[4]), match[2] or match[3]), place)
    points = sorted({number for number, _ in found})
    whole = all((number, c) in found for number in points for c in "xyz")
    return found if points and whole else {}


def _many(
    export: Export,
    table: TextTable,
    names: Sequence[Name],
    several: dict[tuple[int, str], int],
    own: dict[str, np.ndarray],
    taken: set[int],
    more: dict[str, np.ndarray],
    options: Options,
    needs: Needs,
) -> DataSet:
    units = Units(table, options, needs)
    numbers = sorted({number for number, _ in several})
    readings = {
        f"smr{k}_{c}_mm": table.numbers(several[number, c])
        * units.length_mm(names[several[number, c]])
        for k, number in enumerate(numbers, 1)
        for c in "xyz"
    }
    columns = columns_with({"pose": np.arange(len(table.rows)), **own}, more, readings)
    instrument = {"kind": "reflectors", "tool_reflectors": len(numbers)}
    if any(name.endswith(("_read_deg", "_read_mm")) for name in own):
        instrument["joints"] = "read"
    notes = left_out(table, taken | {*several.values()})
    return DataSet(export.path.stem, instrument, columns, SIGMA, notes)
