"""Everything that can disturb a measurement, one leaf file per family; importing the package fills
the catalogue.
"""

from . import (
    acceleration,
    arm,
    artefact,
    coupling,
    cyclic,
    events,
    geometric,
    laser_frame,
    motion,
    probe,
    r_test,
    random,
    reversal,
    sag,
    spindle,
    thermal,
    tracker,
    wind_up,
)
from .base import Effect, Setup
from .registry import CATALOGUE, effect_class, load_effects, register

__all__ = [
    "CATALOGUE",
    "Effect",
    "Setup",
    "acceleration",
    "arm",
    "artefact",
    "coupling",
    "cyclic",
    "effect_class",
    "events",
    "geometric",
    "laser_frame",
    "load_effects",
    "motion",
    "probe",
    "r_test",
    "random",
    "register",
    "reversal",
    "sag",
    "spindle",
    "thermal",
    "tracker",
    "wind_up",
]
