"""Poses of the stations of a laser tracker, and changes of its columns of readings."""

import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as Turn

from ..errors import KeyedError
from .stations import Pose
from .tracker_settings import CARTESIAN, COLUMNS, POLAR, Readings, StationSettings

_OTHER_PLACE, _OTHER_PLACE_M = 0.2, 0.3
"""Share of the distance from the measured region, and distance, from which the declared place of a
station is reported as another one."""
_OTHER_DEG = 5.0
"""The same for its declared rotation."""


def declared_pose(row: StationSettings) -> Pose | None:
    """The declared pose of a station; None without a place."""
    if row.station_mm is None:
        return None
    turn = Turn.from_euler("XYZ", row.euler_xyz_deg, degrees=True).as_matrix()
    return Pose(turn, 1e-3 * np.array(row.station_mm))


def composed(frame: Pose, inner: Pose) -> Pose:
    """A pose in a frame, in the frame of that frame."""
    return Pose(
        frame.orientation @ inner.orientation, frame.orientation @ inner.place + frame.place
    )


def in_other_frame(row: StationSettings, declared: Pose | None, frame: Pose, key: str) -> Pose:
    """Pose of a station in the frame of its coordinates, which is at `frame` in the workpiece's."""
    if declared is None and row.station_in_frame_mm is None:
        raise KeyedError(
            f"{key}.station_in_frame_mm",
            "nothing for coordinates in another frame than that of the tracker",
            "the place of the tracker in that frame, from where its noise is counted; or "
            "station_mm, its approximate place in the workpiece frame",
            "add one of them",
        )
    if declared is None:
        turn = np.eye(3)
    else:
        turn = frame.orientation.T @ declared.orientation
    if row.station_in_frame_mm is not None:
        return Pose(turn, 1e-3 * np.array(row.station_in_frame_mm))
    assert declared is not None
    return Pose(turn, frame.orientation.T @ (declared.place - frame.place))


def elsewhere(
    row: StationSettings,
    key: str,
    declared: Pose | None,
    found: Pose,
    nominal: Float[np.ndarray, "n 3"],
    turned: bool = True,
) -> list[str]:
    """What is wrong with a declared pose, in words."""
    if declared is None:
        return []
    said, middle = [], nominal.mean(0)
    apart = float(np.linalg.norm(found.place - declared.place))
    if apart > max(_OTHER_PLACE * np.linalg.norm(found.place - middle), _OTHER_PLACE_M):
        place = ", ".join(f"{1e3 * v:.0f}" for v in found.place)
        said.append(
            f"the readings place the station at [{place}] mm, {apart:.3g} m from {key}.station_mm "
            f"= [{', '.join(f'{v:g}' for v in row.station_mm or ())}]; the place from the readings "
            "is used: compare station_mm with where the tracker stood"
        )
    if turned and "euler_xyz_deg" in row.model_fields_set:
        angle = Turn.from_matrix(declared.orientation.T @ found.orientation).magnitude()
        if np.rad2deg(angle) > _OTHER_DEG:
            said.append(
                f"the readings turn the station by {np.rad2deg(angle):.3g} deg from "
                f"{key}.euler_xyz_deg; the rotation from the readings is used: compare the azimuth "
                "zero with euler_xyz_deg"
            )
    return said


def read_otherwise_of(
    reads: Readings, table: Mapping[str, np.ndarray]
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Single changes of the columns of readings: what is changed, and the columns after it."""
    columns = {name: np.asarray(table[name], float) for name in COLUMNS[reads]}
    lengths = [name for name in columns if name.endswith("_mm")]
    found: list[tuple[str, dict[str, np.ndarray]]] = []
    units = (("inches", 25.4), ("metres", 1e3), ("micrometres", 1e-3))
    for unit, factor in units:
        for names in ([name] for name in lengths):
            changed = {name: factor * columns[name] for name in names}
            found.append((f"{unit} turned into millimetres in {', '.join(names)}", changed))
        if len(lengths) > 1:
            changed = {name: factor * columns[name] for name in lengths}
            found.append((f"{unit} turned into millimetres in {', '.join(lengths)}", changed))
    if reads == "polar":
        angles = POLAR[1:]
        units = (
            ("degrees turned into radians", np.pi / 180.0),
            ("gon turned into radians", np.pi / 200.0),
            ("degrees instead of gon", 10.0 / 9.0),
            ("gon instead of degrees", 0.9),
        )
        for words, factor in units:
            for names in (angles, angles[:1], angles[1:]):
                changed = {name: factor * columns[name] for name in names}
                found.append((f"{words} in {', '.join(names)}", changed))
        zenith = {angles[1]: 0.5 * np.pi - columns[angles[1]]}
        found.append((f"elevations instead of zenith angles in {angles[1]}", zenith))
        swapped = {angles[0]: columns[angles[1]], angles[1]: columns[angles[0]]}
        found.append((f"{' and '.join(angles)} exchanged", swapped))
        for name in angles:
            found.append((f"the other sign in {name}", {name: -columns[name]}))
    if reads == "cartesian":
        for a, b in itertools.combinations(CARTESIAN, 2):
            found.append((f"{a} and {b} exchanged", {a: columns[b], b: columns[a]}))
        for name in CARTESIAN:
            found.append((f"the other sign in {name}", {name: -columns[name]}))
    return found
