"""Spaces of plans, one leaf file per kind of instrument; importing the package registers them."""

from ..plan_space import SPACES, DesignSettings
from . import (
    ball_array,
    double_ball_bar,
    interferometer,
    laser_tracker,
    pose_probe,
    reflectors,
    static_r_test,
    touch_probe,
)

__all__ = [
    "SPACES",
    "ball_array",
    "double_ball_bar",
    "interferometer",
    "laser_tracker",
    "pose_probe",
    "reflectors",
    "settings_of",
    "static_r_test",
    "touch_probe",
]


def settings_of(kind: str) -> type[DesignSettings]:
    """The class of the ``[design]`` table of an instrument; the common keys without a space."""
    return SPACES[kind].Settings if kind in SPACES else DesignSettings
