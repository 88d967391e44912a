"""Virtual calibration of machine tools: simulate, identify, and close the loop with measured data.

A machine, an instrument and the effects that disturb them form one differentiable function from
commanded positions and conditions to readings of the instrument. The verbs of this package are uses
of that function.
"""

from .startup import importing as _importing

# These imports take most of the time that a command needs to start.
with _importing():
    import jax as _jax

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


def enable_float64() -> None:
    """Switch JAX to float64, which every computation of vcal requires, and keep compiled programs
    in the user's cache folder, so that the next process reads them.

    The environment variable ``VCAL_NO_CACHE`` switches the cache off; a compilation cache of JAX
    that is configured already is used instead.
    """
    from .numerics.program_cache import keep_programs

    _jax.config.update("jax_enable_x64", True)
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
    """The public names only: imported subpackages are reached by importing them."""
    return sorted([*__all__, "__version__"])
