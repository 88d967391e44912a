"""The formats, one per module. Importing this package registers all of them."""

from . import laser_tracker, robot_poses, urdf

__all__ = ["laser_tracker", "robot_poses", "urdf"]
