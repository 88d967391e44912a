"""The forward model: a chain, an instrument and effects as one differentiable function.

Holds also what is declared about a measurement (prior, noise) and simulated measurements. Uses
`effects`, `instruments` and `machine`; knows nothing of fits. `identification` and every verb above
stand on it.
"""

from .forward import Model, Terms, predict

__all__ = ["Model", "Terms", "predict"]
