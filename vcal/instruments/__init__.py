"""Measuring instruments, one leaf file each; importing the package fills the registry."""

from . import ball_array, laser_frame, laser_tracker, r_test, reflectors, static_r_test
from .base import INSTRUMENTS, Column, Instrument, InstrumentSettings, TableInstrument
from .conditions import linear_plan, linear_plan_table

__all__ = [
    "INSTRUMENTS",
    "Column",
    "Instrument",
    "InstrumentSettings",
    "TableInstrument",
    "ball_array",
    "laser_frame",
    "laser_tracker",
    "linear_plan",
    "linear_plan_table",
    "r_test",
    "reflectors",
    "static_r_test",
]
