"""What is left after compensation where reality has more to it than what is fitted, by theory.

    found = K (J_t t + n),      e = t - found

t are the amplitudes of the truth, J_t the derivative of the readings by them, n the noise, K the
linear estimate of what is fitted and e the error that is left: of an amplitude that is not fitted,
all of it. All t and n are independent, so that the mean square of the volumetric error, tr(G E E'),
is a sum over the effects of the truth and the noise of the readings.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ..model import Model
from ..plan import Plan
from ..uncertainty.campaign import virtual_pair
from ..uncertainty.linear import sources
from ..uncertainty.quantities import Pair
from .volume import Gram


@dataclass(frozen=True)
class Left:
    """Expected error after compensation, m."""

    aligned: Mapping[str, float]
    """Root mean square after the best rigid alignment, by effect of the truth and noise of the
    readings (`vcal.uncertainty.linear.sources`).
    """
    raw: Mapping[str, float]

    @property
    def rms(self) -> tuple[float, float]:
        """Of everything together: aligned and raw."""
        return _root_sum(self.aligned), _root_sum(self.raw)


def fitted_places(pair: Pair) -> Int[np.ndarray, " k"]:
    """Where the amplitudes of the truth are among those that are fitted; -1: they are not."""
    places = {(e.key, e.parameter.name): i for i, e in enumerate(pair.fit.entries)}
    return np.array([places.get((e.key, e.parameter.name), -1) for e in pair.truth.entries], int)


def expected_error(truth: Model, fit: Model, plan: Plan, gram: Gram) -> Left:
    """Expected volumetric error after `fit` was identified from `plan` and compensated, on a
    machine and with an instrument from `truth`, whose errors amount to `gram` (`volumetric_gram`).

    Both models have the same chain and instrument; the priors of what both know must have the same
    standard deviations. Random effects of the truth count as further noise. Raises as
    `vcal.uncertainty.virtual_pair` does, and `ValueError` for priors that differ.
    """
    pair = virtual_pair(truth, fit, plan)
    known, fitted = fitted_places(pair), fit.entries
    for entry, place in zip(truth.entries, known, strict=True):
        p = entry.parameter
        if place >= 0 and not np.isclose(p.step, fitted[place].parameter.step):
            raise ValueError(
                f"{entry.key}, {p.name}: found different standard deviations in truth and "
                "fit, expected the same prior where both know an amplitude"
            )
    # A row of zeros stands for what is not fitted.
    gain = np.asarray(pair.batch.gain)
    gain = np.concatenate([gain, np.zeros((1, gain.shape[1]))])[known]
    found: tuple[dict[str, float], dict[str, float]] = {}, {}
    for name, (amplitudes, readings) in sources(pair).items():
        e = (0.0 if amplitudes is None else amplitudes) - gain @ readings
        for parts, G in zip(found, gram, strict=True):
            parts[name] = max(float(np.einsum("ai,ab,bi->", e, G, e)), 0.0) ** 0.5
    return Left(*found)


def _root_sum(parts: Mapping[str, float]) -> float:
    return float(np.sqrt(sum(v**2 for v in parts.values())))
