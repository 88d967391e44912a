"""Virtual calibration of machine tools: simulate, identify, and close the loop with measured data.

A machine, an instrument and everything that can disturb them form one differentiable function from
what was commanded, and under which conditions, to what the instrument read. The verbs of this
package are uses of that one function.
"""

from .startup import importing

# Most of the time that a command takes to start.
with importing():
    import jax

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

__version__ = "0.1.0"


def enable_float64() -> None:
    """Switch JAX to float64, which every computation of vcal requires."""
    jax.config.update("jax_enable_x64", True)


__all__ = [
    "CATALOGUE",
    "CheckPoints",
    "Closure",
    "Effect",
    "Fit",
    "Measurement",
    "Model",
    "Parameter",
    "Plan",
    "Prior",
    "Study",
    "StudyError",
    "close_loop",
    "enable_float64",
    "identify",
    "load_study",
    "predict",
    "register",
]
