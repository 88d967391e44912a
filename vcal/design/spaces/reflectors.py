"""The space of reflectors on an arm: its poses."""

from dataclasses import dataclass

from ..plan_space import register
from .arm_poses import ArmPoseSpace
from .points import PointsDesign


@register
@dataclass(frozen=True)
class ReflectorSpace(ArmPoseSpace):
    """Poses of the arm; every reflector is measured in each."""

    kind = "reflectors"
    Settings = PointsDesign
