"""The formats, one per module. Importing this package registers all of them."""

from . import ball_bar, interferometer, laser_tracker, probe_log, robot_poses, urdf

__all__ = ["ball_bar", "interferometer", "laser_tracker", "probe_log", "robot_poses", "urdf"]
