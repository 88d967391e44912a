"""URDF files: the kinematics of a robot as the machine of a study."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...instruments.conditions import file_column
from ...study.messages import refusal
from ..base import NO, SURE, DataSet, Format, Machine, Needs, Options, register
from ..export import Export
from .laser_tracker import SIGMA

_POSES = 60
"""Poses of the plan of a study of a URDF file alone."""
_TURN_DEG = 180.0
"""Bound of the plan for a joint without limits."""


@register
class Urdf(Format):
    """The Unified Robot Description Format: links and joints with their origins, axes and limits.

    The file is copied to the study, and ``[machine] urdf`` names it: frames, limits and the order
    of the joints are exactly those of the file (`vcal.study.urdf`). Together with a table of poses
    it is the machine of that table. Alone, it becomes a study of a plan: poses spread evenly over
    the limits of the joints, for one reflector on the tool, without readings.
    """

    name = "urdf"
    summary = "kinematics of a robot: the machine of a table of poses, or of a plan"
    needs = (
        "--set machine.base_link=... and tip_link=... where several links may be the ends; alone, "
        "the noise as --set instrument.sigma_um=..."
    )
    source = "ROS, URDF XML specification (wiki.ros.org/urdf/XML)"
    undocumented = (
        "the place of the tool: --tool-offset in the frame of the tip; xacro files have to be "
        "converted by the program xacro first"
    )

    def sniff(self, export: Export) -> float:
        text = export.text
        return SURE if text is not None and re.search(r"<robot[\s>]", text) else NO

    def machine(self, export: Export) -> Mapping[str, Any]:
        if "xacro:" in (export.text or ""):
            raise refusal(
                export.name,
                "file",
                "a xacro file, which is a program that writes a URDF file",
                "a URDF file",
                f"convert it first: xacro {export.name} > robot.urdf",
            )
        return {"urdf": export.name}

    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        del options, needs
        if machine is None:
            return []
        axes = machine.chain.axes
        spread = _spread(_POSES, len(axes))
        columns: dict[str, np.ndarray] = {"pose": np.arange(_POSES)}
        for i, (axis, joint) in enumerate(zip(axes, machine.chain.joints, strict=True)):
            name, factor = file_column(f"commanded_{axis}", axes)
            low, high = (float(bound) * factor for bound in joint.travel)
            if not np.isfinite([low, high]).all():
                if not joint.turns:
                    raise refusal(
                        export.name,
                        f"joint {i + 1}",
                        "a prismatic joint without limits",
                        "its lowest and highest position",
                        "add <limit lower=... upper=...>",
                    )
                low, high = -_TURN_DEG, _TURN_DEG
            columns[name] = np.round(low + (high - low) * spread[:, i], 3).clip(low, high)
        instrument = {"kind": "reflectors", "tool_reflectors": 1}
        notes = [f"{_POSES} poses spread over the limits of the joints: a plan without readings"]
        return [DataSet(export.path.stem, instrument, columns, SIGMA, notes)]


def _spread(rows: int, columns: int) -> np.ndarray:
    """Points (rows, columns) that fill the unit cube evenly: the additive recurrence of the
    generalised golden ratio.
    """
    ratio = 2.0
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (columns + 1))
    steps = ratio ** -np.arange(1.0, columns + 1.0)
    return np.mod(0.5 + np.arange(1, rows + 1)[:, None] * steps, 1.0)
