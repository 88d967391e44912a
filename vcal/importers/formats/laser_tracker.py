"""Point lists of laser trackers, as metrology software exports them as text."""

import re
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ...numerics.spatial import best_rigid
from ..base import LIKELY, NO, POSSIBLE, DataSet, Format, Machine, Needs, Options, register
from ..columns import names_of
from ..export import Export, TextTable
from ..points import Points, read_points, stated_system
from ..positions import (
    columns_with,
    conditions,
    joint_columns,
    left_out,
    point_numbers,
    positions,
)

_WORDS = ("tracker", "spatialanalyzer", "reflector", "smr", "total station")
_STRAIGHT = 1e-3
"""Points on a line do not determine the pose of the tracker: least width as a share of the length.
"""
MACHINE = "--machine CHAIN", "the machine: a chain such as 'w X b Y Z t', or a file"
POSITIONS = "--positions FILE", "a table of the positions of the axes at every point"
"""What the reader needs of the user, with its meaning."""
NOISE = {
    "range_sigma_um": "noise of a range, one standard deviation, um",
    "angle_sigma_urad": "noise of an angle, one standard deviation, urad",
}

SIGMA = {"sigma_um": "noise of a coordinate, one standard deviation, um"}
"""What the readings of one reflector on an arm need."""


@register
class LaserTrackerPoints(Format):
    """Measured points, one per line: ``[collection] [group] name c1 c2 c3 [u1 u2 u3] [time]``.

    The coordinates are Cartesian, cylindrical (radius, azimuth, height) or spherical (range,
    azimuth, and elevation or zenith distance). Lines that begin with ``//``, ``#``, ``%`` or ``!``
    are comments, which may state the coordinate system and the units. A header names the columns,
    with units in brackets, behind the name or in a row of their own.

    The coordinates are taken to be in the tracker's own frame: the noise of a tracker is that of
    range and angles, which Cartesian ones are converted to. The place of the tracker is computed by
    the rigid best fit of the points to the nominal machine, and identified later.

    Of an arm, the points become positions of one reflector (`vcal.instruments.reflectors`).
    """

    name = "laser_tracker"
    summary = "point list of a laser tracker: Cartesian, cylindrical or spherical, as text"
    needs = (
        "--machine, --tool-offset, --positions (or columns of nominal positions), the noise as "
        "--set instrument.range_sigma_um=... and angle_sigma_urad=..., units the file lacks"
    )
    source = (
        "New River Kinematics, SpatialAnalyzer Users Manual: Exporting ASCII Formatted Points, "
        "Importing Predefined ASCII Formatted Files (kinematics.com)"
    )
    undocumented = (
        "the meaning of theta and phi (--angles), the coverage factor of the uncertainties (not "
        "used), the format of time stamps (ISO 8601 and usual ones, else --time-format), the unit "
        "(a comment or header, else --unit); binary jobs of the programs"
    )
    keys = NOISE
    levers = True

    def sniff(self, export: Export) -> float:
        table = export.attempted
        if table is None:
            return NO
        names = names_of(table)
        if not names:
            return _bare(table)
        if len(joint_columns(names)) >= 3:
            return NO
        roles = {name.role for name in names if name.kind != "nominal"}
        polar = roles & {"range", "radius"} and roles & {"azimuth", "theta", "phi"}
        polar = polar and (roles & {"elevation", "zenith", "vertical", "z"} or len(roles) > 2)
        if polar and ({"theta", "phi"} <= roles or roles & {"elevation", "zenith", "z"}):
            return LIKELY
        if not {"x", "y", "z"} <= roles:
            return NO
        told = {"time", "ux", "name", "group"} & roles or _mentions(table)
        told = told or any(name.kind for name in names)
        return LIKELY if told else POSSIBLE

    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        table = export.table
        points = read_points(table, options, needs)
        if machine is None:
            needs.add(*MACHINE)
            if options.positions is None and not any(n.kind == "nominal" for n in names_of(table)):
                needs.add(*POSITIONS)
            return []
        placed = positions(export, points.names, points.used, machine, options, needs)
        if placed is None:
            return []
        more, passed = conditions(table)
        own, taken = placed
        notes = [*points.notes, *left_out(table, points.used | taken | passed)]
        if points.u_mm is not None:
            rms = 1e3 * float(np.sqrt((points.u_mm**2).mean()))
            notes.append(
                f"the uncertainties of the coordinates (rms {rms:.3g} um) are not used, as their "
                "coverage factor is not documented"
            )
        if points.t_s is not None:
            more = {"t_s": points.t_s, **more}
        if machine.arm:
            return [arm_set(export, table, points, own, more, notes)]
        columns = columns_with(
            {"point": point_numbers(points.names, len(table.rows)), **own, **_labels(points)},
            more,
            dict(zip(("range_mm", "azimuth_rad", "elevation_rad"), points.polar.T, strict=True)),
        )
        if points.system == "cartesian":
            notes.append(
                "the coordinates were taken to be in the tracker's own frame, and converted to "
                "range and angles"
            )
        instrument = {"kind": "laser_tracker", **_pose(machine, own, points, needs)}
        name = export.path.stem
        return [DataSet(name, instrument, columns, NOISE, notes)]


def arm_set(
    export: Export,
    table: TextTable,
    points: Points,
    joints: dict[str, np.ndarray],
    more: dict[str, np.ndarray],
    notes: Sequence[str],
) -> DataSet:
    """The data set of one reflector on an arm."""
    columns = columns_with(
        {"pose": np.arange(len(table.rows)), **joints},
        more,
        {f"smr1_{c}_mm": values for c, values in zip("xyz", points.cartesian_mm.T, strict=True)},
    )
    instrument = {"kind": "reflectors", "tool_reflectors": 1}
    if any(name.endswith(("_read_deg", "_read_mm")) for name in joints):
        instrument["joints"] = "read"
    return DataSet(export.path.stem, instrument, columns, SIGMA, notes)


def _labels(points: Points) -> dict[str, Sequence[str]]:
    """A column of the names of the points, where they are more than their numbers."""
    if points.names is None or any(re.match(r"[\d+\-.]", name) for name in points.names):
        return {}
    return {"point_name": points.names}


def _bare(table: TextTable) -> float:
    """A table without a header: three coordinates behind names, or alone."""
    numeric = sum(table.is_numeric(place) for place in range(table.width))
    if _mentions(table) or stated_system(table) != "cartesian":
        return LIKELY if numeric in (3, 4) else NO
    if numeric not in (3, 4):
        return NO
    return LIKELY if table.width > numeric else POSSIBLE


def _mentions(table: TextTable) -> bool:
    return any(word in text.casefold() for text in table.comments for word in _WORDS)


def _pose(
    machine: Machine, own: dict[str, np.ndarray], points: Points, needs: Needs
) -> dict[str, list[float]]:
    """Place and rotation of the tracker by the rigid best fit to the nominal machine."""
    chain = machine.chain
    factors = [
        np.pi / 180.0 if joint.turns else 1e-3 for joint in chain.joints
    ]  # columns are in the order of the axes
    position = np.column_stack([v * f for v, f in zip(own.values(), factors, strict=True)])
    nominal = 1e3 * np.asarray(chain.tool_point(position))
    arms = nominal - nominal.mean(0)
    _, width, length = np.linalg.eigvalsh(arms.T @ arms)
    if width <= _STRAIGHT**2 * length:
        for key in ("station_mm", "euler_xyz_deg"):
            needs.add(
                f"--set instrument.{key}=[x,y,z]",
                "the place and rotation of the tracker, as points on a line do not determine them",
            )
        return {}
    turn, station = best_rigid(points.cartesian_mm, nominal)
    euler = Rotation.from_matrix(turn).as_euler("XYZ", degrees=True)
    return {
        "station_mm": [round(float(v), 3) for v in station],
        "euler_xyz_deg": [round(float(v), 6) for v in euler],
    }
