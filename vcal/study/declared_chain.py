"""The kinematic chain of a study: from a string of axes, a table of joints or a URDF file."""

import math
import re
from collections.abc import Sequence

import numpy as np

from ..errors import StudyError
from ..machine.chain import Chain, chain_from_dh, chain_from_string
from ..registry import nearest
from .folder import Folder
from .messages import listed, refusal
from .settings import (
    MachineSettings,
)
from .urdf import chain_from_urdf

_SHORTEST_MM = 0.1
"""Least travel; a smaller number is in another unit."""
_MOST_TOOL, _LEAST_LONG_TOOL_MM = 2.0, 1000.0
"""Largest size of a tool offset as a multiple of the size of the machine: the diagonal of its
travel, or the length of all links of an arm. A tool of less than a metre may be on any machine.
"""
_LEAST_TOOL = 1e-3
"""Least share of the shortest travel; a tool offset that is smaller but not zero is in another
unit.
"""


def build_chain(machine: MachineSettings, file: str, folder: Folder) -> Chain:
    """The chain of a ``[machine]``, whose files are in `folder`; raises `StudyError` that names the
    key in `file`.
    """
    offset = [v * 1e-3 for v in machine.tool_offset_mm]
    if machine.urdf is not None:
        return _from_urdf(machine, machine.urdf, offset, file, folder)
    if machine.chain is None:
        rows = []
        for joint in machine.joint:
            factor = math.radians(1.0) if joint.type == "revolute" else 1e-3
            low, high = (bound * factor for bound in joint.bounds)
            rows.append(
                {
                    "type": joint.type,
                    "a": joint.a_mm * 1e-3,
                    "d": joint.d_mm * 1e-3,
                    "alpha": math.radians(joint.alpha_deg),
                    "theta": math.radians(joint.theta_deg),
                    "low": low,
                    "high": high,
                }
            )
        try:
            coupling = _coupling_si(machine, [joint.type == "revolute" for joint in machine.joint])
            arm = chain_from_dh(rows, offset, machine.up, machine.convention, coupling)
        except ValueError as error:
            raise _wrong_coupling(error, file) from error
        check_offset(machine.tool_offset_mm, arm, file, "machine.tool_offset_mm")
        return arm
    travel = {axis: (low * 1e-3, high * 1e-3) for axis, (low, high) in machine.travel_mm.items()}
    rotary = {}
    for axis, row in machine.rotary.items():
        rotary[axis] = [v * 1e-3 for v in row.at_mm]
        if row.travel_deg is not None:
            low, high = row.travel_deg
            travel[axis] = math.radians(low), math.radians(high)
    _check_rotary(machine, file)
    try:
        chain = chain_from_string(machine.chain, travel, offset, rotary, machine.up)
    except ValueError as error:
        found, _, expected = str(error).rpartition("expected ")
        raise refusal(
            file,
            "key machine.chain",
            f"an impossible {found.rstrip(';: ')}",
            expected,
            "correct the chain",
        ) from error
    linear = [joint.name for joint in chain.joints if not joint.turns]
    for axis, (low, high) in machine.travel_mm.items():
        if axis not in linear:
            raise refusal(
                file,
                f"key machine.travel_mm.{axis}",
                f"the unknown axis {axis!r}{nearest(axis, linear)}"
                if axis not in chain.axes
                else f"millimetres of travel of the rotary axis {axis}",
                f"one of {listed(linear)}, the linear axes of the chain {chain.text!r}"
                + (f"; travel_deg in [machine.rotary.{axis}]" if axis in chain.axes else ""),
                "correct or remove the key",
            )
        if not low < high:
            raise refusal(
                file,
                f"key machine.travel_mm.{axis}",
                f"[{low:g}, {high:g}]",
                "[lowest, highest] with the lowest below the highest",
                "exchange or correct them",
            )
        if high - low < _SHORTEST_MM:
            raise refusal(
                file,
                f"key machine.travel_mm.{axis}",
                f"[{low:g}, {high:g}]",
                f"at least {_SHORTEST_MM:g} mm of travel",
                "correct the unit",
            )
    check_offset(machine.tool_offset_mm, chain, file, "machine.tool_offset_mm")
    return chain


def _from_urdf(
    machine: MachineSettings, name: str, offset: Sequence[float], file: str, folder: Folder
) -> Chain:
    """The chain of a URDF file."""
    path = folder.path(name, "a URDF file")

    def read(coupling: np.ndarray | None) -> Chain:
        return chain_from_urdf(
            path,
            name,
            file,
            base_link=machine.base_link,
            tip_link=machine.tip_link,
            tool_offset_m=offset,
            up=machine.up,
            coupling=coupling,
        )

    chain = read(None)
    if machine.coupling is None:
        return chain
    try:
        return read(_coupling_si(machine, [joint.turns for joint in chain.joints]))
    except ValueError as error:
        raise _wrong_coupling(error, file) from error


def _wrong_coupling(error: ValueError, file: str) -> StudyError:
    found, _, expected = str(error).partition(", expected ")
    return refusal(
        file,
        "key machine.coupling",
        found.removeprefix("found "),
        expected.partition(";")[0],
        "correct the matrix",
    )


def _coupling_si(machine: MachineSettings, turning: Sequence[bool]) -> np.ndarray | None:
    """The matrix from commands to joint variables in SI, from that between the file's units; the
    joints are `turning` or slide.
    """
    if machine.coupling is None:
        return None
    count, rows = len(turning), {len(row) for row in machine.coupling}
    if rows != {count} or len(machine.coupling) != count:
        raise ValueError(
            f"found {len(machine.coupling)} rows of {listed(str(n) for n in sorted(rows))} "
            f"numbers, expected {count} rows of {count} numbers, one row and one column for every "
            "joint"
        )
    units = np.array([math.radians(1.0) if turns else 1e-3 for turns in turning])
    return units[:, None] * np.array(machine.coupling) / units


def check_offset(offset: Sequence[float], chain: Chain, file: str, key: str) -> None:
    """Raise `StudyError` for a tool offset that is probably in metres.

    Its levers are then a thousandth of the true ones, and no reading need contradict it.
    """
    travels = [np.ptp(j.travel) * 1e3 for j in chain.joints if not j.turns]
    large, size = largest_tool(chain), float(np.linalg.norm(offset))
    if size > large:
        raise refusal(
            file,
            f"key {key}",
            f"{[*offset]}, {size:.4g} mm in all",
            f"at most {large:.4g} mm, {_MOST_TOOL:g} times the size of the machine",
            "correct the offset or its unit, or the travel or the links of the machine: a tool is "
            "not larger than the machine that carries it",
        )
    reach = min((travel for travel in travels if math.isfinite(travel)), default=0.0)
    if chain.arm or not 0.0 < np.abs(offset).max() < _LEAST_TOOL * reach:
        return
    raise refusal(
        file,
        f"key {key}",
        f"{[*offset]}, less than a thousandth of the travel",
        "millimetres from the frame of the last axis to the tool point",
        "correct the unit, or write [0, 0, 0] if the tool point is the origin of that frame",
    )


def largest_tool(chain: Chain) -> float:
    """The largest plausible tool offset, mm; infinite where the size of the machine is unknown."""
    if chain.arm:
        links = [part[:3, 3] for joint in chain.joints for part in (joint.before, joint.after)]
        parts = [np.linalg.norm(link) for link in links]
        parts += [np.ptp(joint.travel) for joint in chain.joints if not joint.turns]
        size = 1e3 * float(np.sum(parts))
    else:
        parts = [np.ptp(joint.travel) for joint in chain.joints if not joint.turns]
        size = 1e3 * float(np.linalg.norm(parts))
    return max(_MOST_TOOL * size, _LEAST_LONG_TOOL_MM) if math.isfinite(size) else math.inf


def _check_rotary(machine: MachineSettings, file: str) -> None:
    """Raise `StudyError` unless every rotary axis of the chain has a table ``[machine.rotary.*]``,
    and every such table an axis in the chain.
    """
    in_chain = [axis for axis in re.findall(r"[A-Z]", machine.chain or "") if axis in "ABC"]
    for axis in in_chain:
        if axis not in machine.rotary:
            raise refusal(
                file,
                f"key machine.rotary.{axis}",
                "nothing",
                f"the position of the rotary axis {axis} of the chain, with all axes at zero",
                f"add [machine.rotary.{axis}] with at_mm = [x, y, z], a point on the axis, and "
                "travel_deg = [lowest, highest]",
            )
    for axis in machine.rotary:
        if axis not in in_chain:
            raise refusal(
                file,
                f"key machine.rotary.{axis}",
                f"a rotary axis that is not in the chain {machine.chain!r}",
                f"one of {listed(in_chain)}" if in_chain else "no rotary axis",
                "add it to the chain, or remove the table",
            )
