"""Two effects at once, where one alone fits badly: each may hide the other."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..fit import Fit
from .rivals import Rival, refit
from .screen import Peak

MOST = 6
"""Most names of which pairs are to be fitted."""


@dataclass(frozen=True)
class Pair:
    """Two rivals, and a fit with both."""

    first: Rival
    second: Rival
    fit: Fit


def best_pair(rivals: Sequence[Rival], keep: np.ndarray, room: int = 0) -> Pair | None:
    """The two rivals (one of every name, most probable first) whose fit beside each other has the
    highest evidence; None where no such fit ends in a minimum.

    What adds the best one after the other (forward selection) takes what describes a part of each
    of two for a third one; of two it takes all pairs of the most probable names.
    """
    found = []
    for first, second in itertools.combinations(rivals, 2):
        fit = refit(first.fit, _as_peak(second), keep, room, second.wider)
        if fit.converged and fit.determined and _regular(fit):
            found.append(Pair(first, second, fit))
    if not found:
        return None
    noise = max(1.0, min(pair.fit.chi2 / pair.fit.dof for pair in found)) ** 0.5

    def evidence(pair: Pair) -> float:
        return pair.fit.log_evidence(noise) + pair.first.log_prior + pair.second.log_prior

    return max(found, key=evidence)


def _regular(fit: Fit) -> bool:
    """Whether two effects that are the same on these readings are told apart by their priors."""
    try:
        return bool(np.isfinite(fit.factor[0]).all())
    except np.linalg.LinAlgError:
        return False


def _as_peak(rival: Rival) -> Peak:
    """Where the refit of a rival ended, to start another one from."""
    place = len(rival.fit.model.effects) - 1
    last = len(rival.fit.model.entries)
    amplitudes = rival.fit.theta[last - len(rival.effect.amplitudes) : last]
    shape = dict(rival.fit.shapes.get(place, {}))
    return Peak(rival.effect, shape, amplitudes * rival.wider, 0.0, 0.0, 0)
