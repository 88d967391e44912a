"""Model averaging: predictions and their variance where the identity of an effect is uncertain."""

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

    Where it is not certain which model is right, the average is predicted: the prediction moves by
    the sum of p d, and the variance about it is that of d, the sum of p d^2 less the square of that
    sum. By the triangle inequality its rms error is not above the largest one of the models.
    """

    found: Fit
    others: tuple[tuple[float, Fit], ...]
    """(probability, fit) of the other models. The probabilities leave out the penalty for a size
    beyond its prior, which counts only where models are ranked."""
    averaged: bool = False
    """Whether the average of the models is predicted instead of the chosen one."""


def model_average(
    alternatives: Sequence[Alternatives], of: Callable[[Fit], np.ndarray], none: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Change of the quantity `of(fit)` by averaging over the models, and its between-model
    variance, for independent alternatives. `none` is an array of zeros of its shape.
    """
    moved = variance = none
    for one in alternatives:
        named = of(one.found) if one.others else None
        mean = none
        for probability, other in one.others:
            change = of(other) - named
            mean = mean + probability * change
            variance = variance + probability * change**2
        if one.averaged:
            moved = moved + mean
            variance = np.maximum(variance - mean**2, 0.0)
    return moved, variance
