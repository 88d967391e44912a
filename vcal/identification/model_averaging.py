"""Between-model variance: the uncertainty added where the identity of an effect is uncertain."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .fit import Fit


@dataclass(frozen=True)
class Alternatives:
    """The fits that compete with an added effect, or with a part of the data that no effect
    explains.

    The posterior of a fit says how well its parameters are known if its model is right. With
    probability p another model is right, and a prediction then differs by d, most where no reading
    separates the two. The mean square about the prediction of the chosen model is larger by the sum
    of p d^2 (law of total variance; Hoeting et al. 1999, Statist. Sci. 14, 382). What is
    unexplained is certainly there (p = 1): the declared parameters have absorbed a part of it, and
    d is the change of the prediction when an empirical description is added.
    """

    found: Fit
    others: tuple[tuple[float, Fit], ...]
    """(probability, fit) of the other models. The probabilities leave out the penalty for a size
    beyond its prior, which counts only where models are ranked."""


def between_model_variance(
    alternatives: Sequence[Alternatives], of: Callable[[Fit], np.ndarray], variance: np.ndarray
) -> np.ndarray:
    """`variance` of the quantity `of(fit)`, plus the sum of p d^2 over all alternatives."""
    for one in alternatives:
        named = of(one.found) if one.others else None
        for probability, other in one.others:
            variance = variance + probability * (of(other) - named) ** 2
    return variance
