"""Learning the sizes of a declared family from the data, by marginal likelihood.

For use on request, and not while effects are screened: sizes that adapt would swallow an effect.
"""

import dataclasses
import math

import equinox as eqx
import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import root_scalar

from ..effects.geometric import GeometricErrors
from ..model.forward import Model
from .fit import Fit

_ROUNDS = 2000
_SETTLED = 1e-3
_WIDE = np.log(3.0)
"""Standard deviation of the logarithm of a factor, before the data: what they do not tell stays as
declared, rather than wherever rounds without end would take it."""


def learned_sizes(fit: Fit) -> dict[str, float]:
    """Factor on the prior size of every error motion and location error, by its ISO 230-1 name.

    Expectation maximisation of the marginal likelihood of the linearised fit, with a prior of
    `_WIDE` on every ln f: of n coefficients with the mean square q = f^2 mean(theta^2 + var theta),
    in units of the prior as declared, f is the root of n (q / f^2 - 1) = ln f / `_WIDE`^2; repeated
    until it settles. Errors that are declared themselves (`given`, `priors`) have no factor. Raises
    `RuntimeError` where it does not settle.
    """
    groups: dict[str, list[int]] = {}
    k = 0
    for effect in fit.model.effects:
        own = {
            *(name for name, *_ in effect.given),
            *(name for p in effect.priors for name in p.names),
        }
        for p in effect.amplitudes:
            if isinstance(effect, GeometricErrors) and p.name not in own:
                groups.setdefault(p.name.split(".")[0], []).append(k)
            k += 1
    target = fit.whitened + fit.jacobian @ fit.theta
    normal, pull = fit.jacobian.T @ fit.jacobian, fit.jacobian.T @ target
    factors = np.ones(len(fit.theta))
    for _ in range(_ROUNDS):
        h = normal * factors[:, None] * factors + np.diag(fit.precision)
        factor = cho_factor(h)
        theta = cho_solve(factor, factors * pull)
        variance = np.diag(cho_solve(factor, np.eye(len(h))))
        previous = factors.copy()
        for members in groups.values():
            square = factors[members] ** 2 * (theta[members] ** 2 + variance[members])
            factors[members] = _factor(len(members), float(square.mean()))
        if np.abs(np.log(factors / previous)).max() < _SETTLED:
            break
    else:
        raise RuntimeError(f"sizes of the family: not settled after {_ROUNDS} rounds")
    return {name: float(factors[members[0]]) for name, members in groups.items()}


def _factor(n: int, square: float) -> float:
    """The most likely factor of a group of n coefficients with this mean square."""

    def slope(log_f: float) -> float:
        return n * (square * math.exp(-2.0 * log_f) - 1.0) - log_f / _WIDE**2

    # Between no factor, where the prior has its maximum, and the root mean square.
    low, high = sorted((0.0, 0.5 * math.log(square)))
    return math.exp(root_scalar(slope, bracket=(low, high)).root) if high > low else 1.0


def with_sizes(model: Model, factors: dict[str, float]) -> Model:
    """The model with the prior sizes of its geometric errors multiplied by `factors`."""
    effects = []
    for effect in model.effects:
        if isinstance(effect, GeometricErrors):
            motions = tuple(
                eqx.tree_at(lambda m: m.basis.sigma, m, m.basis.sigma * factors.get(m.name, 1.0))
                for m in effect.motions
            )
            locations = tuple(
                eqx.tree_at(lambda e: e.sigma, e, e.sigma * factors.get(e.name, 1.0))
                for e in effect.locations
            )
            effect = dataclasses.replace(effect, motions=motions, locations=locations)
        effects.append(effect)
    return Model(model.chain, model.instrument, (*effects, *model.random))
