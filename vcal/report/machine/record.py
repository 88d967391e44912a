"""The declared machine for programs."""

from typing import Any

import numpy as np

from ...geometry.declared_machine import DeclaredMachine


def machine_record(machine: DeclaredMachine) -> dict[str, Any]:
    """Chain, axes, tool and instruments as plain values, in mm and degrees, at the zero pose in the
    frame of the workpiece (of an arm: of its base).

    ``direction`` is the direction in which a positive command moves what the axis ``moves``, or
    about which it turns it by the right-hand rule.
    """
    return {
        "chain": machine.text,
        "workpiece_side": list(machine.workpiece_side),
        "tool_side": list(machine.tool_side),
        "tool_point_mm": 1e3 * machine.tool_point,
        "axes": [
            {
                "name": axis.name,
                "turns": axis.turns,
                "moves": axis.moves,
                "direction": np.round(axis.direction, 12) + 0.0,
                "at_mm": 1e3 * axis.place if axis.turns else None,
                f"travel_{'deg' if axis.turns else 'mm'}": _in_file(axis.travel, axis.turns),
                f"measured_{'deg' if axis.turns else 'mm'}": _in_file(axis.covered, axis.turns),
            }
            for axis in machine.axes
        ],
        "data_sets": [
            {
                "name": one.name,
                "instrument": one.instrument,
                "rms_from_declared_mm": None if one.rms is None else 1e3 * one.rms,
                "station_by_readings_mm": None
                if one.station is None
                else 1e3 * one.station.places[0],
                "station_from_declared_mm": None if one.moved is None else 1e3 * one.moved,
            }
            for one in machine.seen
        ],
    }


def _in_file(ends: np.ndarray, turns: bool) -> np.ndarray:
    return np.rad2deg(ends) if turns else 1e3 * ends
