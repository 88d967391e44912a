"""Virtual calibration of machine tools: simulate, identify, and close the loop with measured data.

A machine, an instrument and the effects that disturb them form one differentiable function from
commanded positions and conditions to readings of the instrument. The verbs of this package are uses
of that function.
"""

from importlib import import_module as _import_module
from importlib.util import find_spec as _find_spec
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from .startup import importing as _importing

if _TYPE_CHECKING:
    from .compensation import IdentifiedMachine, compensate
    from .effects import CATALOGUE, Effect, register
    from .errors import StudyError
    from .identification.fit import Fit
    from .identification.identify import identify
    from .loop.close_loop import close_loop
    from .loop.outcome.closure import Closure
    from .machine.parameters import Parameter, Prior
    from .machine.plan import Plan
    from .model.forward import Model, predict
    from .model.measurement import CheckPoints, Measurement
    from .study import Study, load_study
    from .study.identified_machine import load_machine

__version__ = "0.1.0"

_MODULES = {
    "CATALOGUE": "effects",
    "CheckPoints": "model.measurement",
    "Closure": "loop.outcome.closure",
    "Effect": "effects",
    "Fit": "identification.fit",
    "IdentifiedMachine": "compensation",
    "Measurement": "model.measurement",
    "Model": "model.forward",
    "Parameter": "machine.parameters",
    "Plan": "machine.plan",
    "Prior": "machine.parameters",
    "Study": "study",
    "StudyError": "errors",
    "close_loop": "loop.close_loop",
    "compensate": "compensation",
    "identify": "identification.identify",
    "load_machine": "study.identified_machine",
    "load_study": "study",
    "predict": "model.forward",
    "register": "effects",
}
"""Module of every public name. JAX takes over a second to import, so a name is imported when it is
used for the first time."""


def __getattr__(name: str) -> _Any:
    """A public name or a subpackage, imported when it is used for the first time."""
    if name in _MODULES:
        with _importing():
            value = getattr(_import_module(f".{_MODULES[name]}", __name__), name)
        globals()[name] = value
        return value
    if not name.startswith("_") and _find_spec(f"{__name__}.{name}") is not None:
        with _importing():
            return _import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def enable_float64() -> None:
    """Switch JAX to float64, which every computation of vcal requires, and keep compiled programs
    in the user's cache folder, so that the next process reads them.

    The environment variable ``VCAL_NO_CACHE`` switches the cache off; a compilation cache of JAX
    that is configured already is used instead.
    """
    with _importing():
        import jax

        from .numerics.program_cache import keep_programs

    jax.config.update("jax_enable_x64", True)
    keep_programs()


__all__ = [
    "CATALOGUE",
    "CheckPoints",
    "Closure",
    "Effect",
    "Fit",
    "IdentifiedMachine",
    "Measurement",
    "Model",
    "Parameter",
    "Plan",
    "Prior",
    "Study",
    "StudyError",
    "close_loop",
    "compensate",
    "enable_float64",
    "identify",
    "load_machine",
    "load_study",
    "predict",
    "register",
]


def __dir__() -> list[str]:
    """The public names only: subpackages are reached by their names."""
    return sorted([*__all__, "__version__"])
