"""The forward model: a chain, an instrument and effects as one differentiable function.

- `forward`: the function from parameters to readings, and its derivatives by the ports;
- `measurement`: a plan with readings, and check points;
- `declared_noise`, `prior`: the declared covariance of the readings, and draws of the parameters;
- `simulate`, `port_map`: simulated measurements, and their fast evaluation for many draws.

It uses `instruments`, `effects`, `machine` and the packages below them. It knows nothing of
identification, which stands on it, as do all packages above.
"""

from .forward import Model, Terms, predict

__all__ = ["Model", "Terms", "predict"]
