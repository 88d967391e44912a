"""The space of a pose probe on an arm: its poses."""

from dataclasses import dataclass

from ..plan_space import register
from .arm_poses import ArmPoseSpace
from .points import PointsDesign


@register
@dataclass(frozen=True)
class PoseProbeSpace(ArmPoseSpace):
    """Poses of the arm; position and orientation of the probe are measured in each."""

    kind = "pose_probe"
    Settings = PointsDesign
