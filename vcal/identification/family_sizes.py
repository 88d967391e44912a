"""Prior sizes of a declared family of error motions, estimated from the data by empirical Bayes.

The estimate is made on request only, and not while effects are screened: sizes that adapt to the
data would absorb an effect.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable

import equinox as eqx
import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ..effects.geometric import GeometricErrors
from ..model.forward import Model
from .fit import Fit

_ROUNDS = 2000
_SETTLED = 1e-3
"""Change of the logarithm of a factor below which the iteration has converged."""
_WIDE = np.log(3.0)
"""Prior standard deviation of the logarithm of a factor. A factor that the data do not determine
stays near one; without a prior it would drift as long as the iteration runs."""


def declared_kind(name: str) -> str:
    """Which declared size an error has, by its ISO 230-1 name: that of translations, of rotations,
    of squareness and direction, or of positions of axes.
    """
    turns = name[1] in "ABC"
    if name[2:].startswith("0"):
        return "squareness" if turns else "location"
    return "rotation" if turns else "translation"


def _own_name(name: str) -> str:
    return name


def learned_sizes(fit: Fit, group: Callable[[str], str] = _own_name) -> dict[str, float]:
    """Factor on the prior size of every error motion and location error, by its ISO 230-1 name.

    `group` gives the group of an error that shares a factor; by default every error has its own.

    The factors maximise the marginal likelihood of the linearised fit by expectation maximisation,
    with a normal prior on every ln f of the standard deviation s = ln 3. For n coefficients with
    the mean square q = f^2 mean(theta^2 + var theta), in units of the declared prior, f solves
    n (q / f^2 - 1) = ln f / s^2. Errors that are declared themselves (`given`, `priors`) have no
    factor.

    Raises `RuntimeError` where the iteration does not converge.
    """
    groups: dict[str, list[int]] = {}
    names: dict[str, str] = {}
    k = 0
    for effect in fit.model.effects:
        own = {
            *(name for name, *_ in effect.given),
            *(name for p in effect.priors for name in p.names),
        }
        for p in effect.amplitudes:
            if isinstance(effect, GeometricErrors) and p.name not in own:
                name = p.name.split(".")[0]
                names[name] = group(name)
                groups.setdefault(names[name], []).append(k)
            k += 1
    target = fit.whitened + fit.jacobian @ fit.theta
    normal, pull = fit.normal, fit.jacobian.T @ target
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
        raise RuntimeError(f"sizes of the family: no convergence after {_ROUNDS} iterations")
    return {name: float(factors[groups[its][0]]) for name, its in names.items()}


def log_prior_of_factors(factors: Iterable[float]) -> float:
    """Log prior density of factors, one of each group, relative to that of factors of one:
    -sum of (ln f)^2 / (2 s^2), with s = ln 3.
    """
    return -sum((math.log(f) / float(_WIDE)) ** 2 / 2.0 for f in factors)


def _factor(n: int, square: float) -> float:
    """The most likely factor of a group of n coefficients with this mean square."""

    def slope(log_f: float) -> float:
        return n * (square * math.exp(-2.0 * log_f) - 1.0) - log_f / _WIDE**2

    # Imported here, as the import takes long and only families whose size is learned need it.
    from scipy.optimize import root_scalar

    # The root lies between one, where the prior has its maximum, and the root mean square.
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
