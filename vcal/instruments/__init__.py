"""Measuring instruments: what each reads of the tool point, and what disturbs the readings.

Each module with an instrument registers its `kind`; importing the package imports all modules. The
base class says what an instrument has to define; an instrument of a user's own is a Python file
that imports from here, and a study names it.

It knows the machine, its ports and the effects, but neither models nor studies. The model, the
identification and the readers of studies stand on it.
"""

from importlib import import_module
from pkgutil import iter_modules

from ..machine.ports import group
from ..numerics.rigid import Vector
from .base import INSTRUMENTS, Column, Instrument, InstrumentSettings, TableInstrument
from .conditions import linear_plan, linear_plan_table

for _module in sorted(module.name for module in iter_modules(__path__)):
    import_module(f".{_module}", __name__)

__all__ = [
    "INSTRUMENTS",
    "Column",
    "Instrument",
    "InstrumentSettings",
    "TableInstrument",
    "Vector",
    "group",
    "linear_plan",
    "linear_plan_table",
]
