"""Settings of a laser tracker, and the names of its stations and tools in a table."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from jaxtyping import Int
from pydantic import BaseModel, ConfigDict, model_validator

from ..bounds import Angle, Coordinate, Noise, PlaceSigma, Within
from ..effects.station import STATION
from ..errors import KeyedError, RowError
from .base import (
    Column,
    FileName,
    InstrumentSettings,
    Loader,
)

_Point = tuple[Coordinate, Coordinate, Coordinate]
Readings = Literal["polar", "cartesian", "range"]
POLAR = ("range_mm", "azimuth_rad", "elevation_rad")
CARTESIAN = ("meas_x_mm", "meas_y_mm", "meas_z_mm")
COLUMNS = {"polar": POLAR, "cartesian": CARTESIAN, "range": POLAR[:1]}
"""Columns of the readings."""
TOOL = "tool"
"""The column of the names of tools, and the group that holds their index in every row."""
_MOST_TOOLS = 100


class StationSettings(BaseModel):
    """One station of several: a row of ``[instrument.stations]``, named as in the column."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    station_mm: _Point | None = None
    """Approximate place of the tracker in the workpiece frame; it is identified."""
    euler_xyz_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Approximate rotation of the tracker, R = Rx Ry Rz; it is identified."""
    station_in_frame_mm: _Point | None = None
    """Place of the tracker in the frame of the coordinates, for ``coordinates = "other"``."""
    dead_path_mm: Coordinate = 0.0
    """Approximate dead path of ranges alone; it is identified."""


class LaserTrackerSettings(InstrumentSettings):
    """Keys of ``[instrument]`` for ``kind = "laser_tracker"``."""

    readings: Readings | None = None
    """Columns of the readings: "polar" (range_mm, azimuth_rad, elevation_rad), "cartesian"
    (meas_x_mm, meas_y_mm, meas_z_mm) or "range" (range_mm alone); by default "cartesian" where the
    table has meas_x_mm, else "polar"."""
    range_sigma_um: Noise
    """Noise of the range, one standard deviation: the part that does not depend on the range."""
    range_sigma_um_per_m: Annotated[
        float,
        Within(0.0, 500.0, "air is known to a few um/m; this is a hundred times that"),
    ] = 0.0
    """The part that grows with the range."""
    range_sigma_sum: Literal["linear", "quadrature"] | None = None
    """How the two parts add up; by default "quadrature" for ranges alone, else "linear"."""
    angle_sigma_urad: Noise | None = None
    """Noise of azimuth and elevation, one standard deviation; required unless ranges alone are
    read."""
    station_mm: _Point | None = None
    """Approximate place of the tracker in the workpiece frame; it is identified. Required for a
    plan without readings."""
    euler_xyz_deg: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Approximate rotation of the tracker, R = Rx Ry Rz; it is identified."""
    coordinates: Literal["tracker", "other"] = "tracker"
    """Frame of Cartesian readings: the tracker's own, or another one that was fitted elsewhere."""
    station_in_frame_mm: _Point | None = None
    """Place of the tracker in that other frame, from where range and angles are counted; by default
    it follows from `station_mm`."""
    dead_path_mm: Coordinate = 0.0
    """Approximate distance at which the range is zero, for ranges alone; it is identified."""
    dead_path_sigma_um: PlaceSigma | None = None
    """Prior standard deviation of the dead path of every station; 0 where it is known, as that of
    an absolute distance meter. By default it is free for ranges alone, and known otherwise."""
    stations: dict[str, StationSettings] | None = None
    """Approximate poses of several stations, by their names in the column `station`."""
    tools: dict[str, _Point] | None = None
    """Tool offsets by their names in the column `tool`: from the frame of the last axis to the
    reflector, as machine.tool_offset_mm."""
    tools_file: FileName | None = None
    """Table of the tool offsets in place of `tools`: columns tool, x_mm, y_mm, z_mm."""
    tools_sigma_um: PlaceSigma = 0.0
    """Standard uncertainty of every coordinate of the tool offsets relative to each other."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.tools is not None and self.tools_file is not None:
            raise ValueError("found both tools and tools_file, expected one of them; remove one")
        if self.tools is not None and not 0 < len(self.tools) <= _MOST_TOOLS:
            raise ValueError(
                f"found {len(self.tools)} tools, expected 1 to {_MOST_TOOLS}; correct tools"
            )
        single = {"station_mm", "euler_xyz_deg", "station_in_frame_mm", "dead_path_mm"}
        if self.stations is not None and (given := single & self.model_fields_set):
            raise ValueError(
                f"found both stations and {sorted(given)[0]}, expected the latter in the rows of "
                "stations; move it there"
            )
        if self.stations is not None and not self.stations:
            raise ValueError("found no stations, expected at least one row; add it")
        return self

    @property
    def columns_of(self) -> Readings:
        """Columns of the readings, "polar" by default."""
        return self.readings or "polar"


def indices(
    table: Mapping[str, np.ndarray], column: str, names: Sequence[str]
) -> Int[np.ndarray, " n"]:
    """Index of the name in a column in every row; zero where there are no names."""
    rows = len(next(iter(table.values()), ()))
    if not names:
        return np.zeros(rows, int)
    place = {name: i for i, name in enumerate(names)}
    return np.array([place[str(name)] for name in table[column]], int)


def _names(column: np.ndarray) -> tuple[str, ...]:
    """The names in a column of text, in the order of their first rows."""
    return tuple(dict.fromkeys(str(name) for name in column))


def _check_named(column: str, values: np.ndarray, names: Sequence[str], key: str) -> None:
    """Raise `RowError` for a row with another name, or none."""
    for row, name in enumerate(values):
        if str(name) not in names:
            raise RowError(
                row,
                f"column {column}",
                repr(str(name)) if str(name) else "an empty cell",
                f"one of {', '.join(names)} ({key})",
                f"correct the name, or add it to {key}",
            )


def station_names(
    settings: LaserTrackerSettings, table: Mapping[str, np.ndarray]
) -> tuple[str, ...]:
    """Names of several stations; empty where there is one."""
    if STATION not in table:
        return ()
    found = _names(table[STATION])
    if "" in found:
        _check_named(STATION, table[STATION], [n for n in found if n], "a name in every row")
    if settings.stations is None:
        return found if len(found) > 1 else ()
    _check_named(STATION, table[STATION], [*settings.stations], "instrument.stations")
    return tuple(name for name in settings.stations if name in found)


def station_settings(settings: LaserTrackerSettings, names: Sequence[str]) -> list[StationSettings]:
    """The settings of every station; those of the only one where there are no names."""
    if settings.stations is not None:
        return [settings.stations[name] for name in names]
    own = {name: getattr(settings, name) for name in StationSettings.model_fields}
    given = {name: own[name] for name in own if name in settings.model_fields_set}
    if not names:
        return [StationSettings(**given)]
    if any(name in given for name in ("station_mm", "station_in_frame_mm")):
        raise KeyedError(
            "instrument.station_mm" if "station_mm" in given else "instrument.station_in_frame_mm",
            f"one place for the {len(names)} stations {', '.join(names[:5])} of column station",
            "one for each in [instrument.stations], or none where the readings determine it",
            "write [instrument.stations] with a row per station, or remove the key",
        )
    return [StationSettings(**given) for _ in names]


def tool_offsets(
    settings: LaserTrackerSettings, table: Mapping[str, np.ndarray], load: Loader
) -> dict[str, Any]:
    """Offsets of the tools by their names, mm; empty where all rows have that of the machine."""
    tools: Mapping[str, Any] | None = settings.tools
    key = "instrument.tools"
    if settings.tools_file is not None:
        key = settings.tools_file
        file = load(
            settings.tools_file,
            [Column(name=f"{c}_mm", low=-200e3, high=200e3) for c in "xyz"],
            labels=(TOOL,),
        )
        tools = {
            str(name): (x, y, z)
            for name, x, y, z in zip(
                *(file[c] for c in (TOOL, "x_mm", "y_mm", "z_mm")), strict=True
            )
        }
        if len(tools) < len(file[TOOL]):
            raise KeyedError(
                "instrument.tools_file",
                f"a tool twice in {settings.tools_file}",
                "every tool once",
                "remove one of them",
            )
    if TOOL not in table:
        return {}
    found = _names(table[TOOL])
    if tools is None:
        if len(found) == 1:
            return {}
        raise KeyedError(
            "instrument.tools",
            f"no offsets for the {len(found)} tools {', '.join(found[:5])} of column tool",
            "the offset of each, from the frame of the last axis to the reflector",
            f"add tools = {{ {found[0]} = [x, y, z], ... }}, or tools_file",
        )
    _check_named(TOOL, table[TOOL], [*tools], key)
    return {name: offset for name, offset in tools.items() if name in found}
