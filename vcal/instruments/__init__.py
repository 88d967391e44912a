"""Measuring instruments, one leaf file each; importing the package fills the registry."""

from . import ball_array, laser_frame, laser_tracker, r_test, reflectors
from .base import INSTRUMENTS, Column, Instrument

__all__ = [
    "INSTRUMENTS",
    "Column",
    "Instrument",
    "ball_array",
    "laser_frame",
    "laser_tracker",
    "r_test",
    "reflectors",
]
