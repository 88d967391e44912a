"""Everything that can disturb a measurement: machine, environment, instrument, artefact.

Each module holds the effects of one cause; importing the package imports all of them, and each
effect enters the catalogue by `register`. A new effect is one new module in this folder. The order
of the catalogue is that of the import: alphabetical by module, after the modules it imports itself.

It knows the machine and its ports, parameters and distributions, but no instrument and no model.
The instruments, the model and the loop stand on it.
"""

from importlib import import_module
from pkgutil import iter_modules

from .base import Effect, Reference, Setup
from .registry import CATALOGUE, effect_class, load_effects, register

for _module in sorted(module.name for module in iter_modules(__path__)):
    import_module(f".{_module}", __name__)

__all__ = ["CATALOGUE", "Effect", "Reference", "Setup", "effect_class", "load_effects", "register"]
