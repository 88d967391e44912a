"""Learning the sizes of a declared family from the data, by marginal likelihood.

For use on request, and not while effects are screened: sizes that adapt would swallow an effect.
"""

import equinox as eqx
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .effects.geometric import GeometricErrors
from .fit import Fit
from .model import Model

_ROUNDS = 50


def learned_sizes(fit: Fit) -> dict[str, float]:
    """Factor on the prior size of every error motion and location error, by its ISO 230-1 name.

    Expectation maximisation of the marginal likelihood of the linearised fit: the factor of a group
    is the root mean square of its coefficients in units of their prior, posterior variance
    included, f^2 = mean(theta^2 + var theta), repeated until it settles.
    """
    groups: dict[str, list[int]] = {}
    k = 0
    for effect in fit.model.effects:
        for p in effect.amplitudes:
            if isinstance(effect, GeometricErrors):
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
            grown = np.sqrt(np.mean(theta[members] ** 2 + variance[members]))
            factors[members] = np.clip(factors[members] * grown, 1e-3, 1e3)
        if np.abs(np.log(factors / previous)).max() < 1e-3:
            break
    return {name: float(factors[members[0]]) for name, members in groups.items()}


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
            effect = GeometricErrors(motions=motions, locations=locations, given=effect.given)
        effects.append(effect)
    return Model(model.chain, model.instrument, (*effects, *model.random))
