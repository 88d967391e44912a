"""What a doubt about a name adds to uncertainties: other names foretell something else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .fit import Fit


@dataclass(frozen=True)
class Doubt:
    """What an added effect may be instead, or what nothing has a name for: fits of the same
    readings, at a round of the search.

    The posterior of a fit says how well its parameters are known if its name is right. With
    probability p it has another one, and then what is foretold differs by d, most where no reading
    told the names apart: its mean square about what the chosen name foretells is larger by the sum
    of p d^2 (law of total variance). What is unexplained is there (p = 1), in whatever words: the
    declared parameters have taken a part of it, and d is what they and the machine are with a
    description of it.
    """

    found: Fit
    others: tuple[tuple[float, Fit], ...]
    """(probability, fit) of the others; what they lose by being larger than expected has no part in
    it, as it has in what they are worth as names."""


def of_doubts(
    doubts: Sequence[Doubt], of: Callable[[Fit], np.ndarray], variance: np.ndarray
) -> np.ndarray:
    """A variance of what `of` says of a fit, with what the doubts add to it."""
    for doubt in doubts:
        named = of(doubt.found) if doubt.others else None
        for probability, other in doubt.others:
            variance = variance + probability * (of(other) - named) ** 2
    return variance
