"""Which geometric errors the points can see at all, before anything is drawn."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...identification.batch import Batch, prepare_batch
from ...model.forward import Model
from .setting import Family, Setting, machine

_ZERO = 1e-9
"""Singular values and columns below this share of the largest are rounding errors."""


@dataclass(frozen=True)
class Seen:
    """One error motion or squareness, and what the points say of it."""

    name: str
    coefficients: int
    share: float
    """Least of the information on a coefficient that comes from the data, 0 to 1."""
    most: float
    """Most of it."""
    silent: int
    """Coefficients that change no reading."""


@dataclass(frozen=True)
class Rank:
    """Rank of the whitened Jacobian at the nominal machine."""

    parameters: int
    rank: int
    singular: Float[np.ndarray, " k"]
    """Singular values, in prior standard deviations of the machines per standard deviation of the
    readings.
    """
    motions: tuple[Seen, ...]

    @property
    def silent(self) -> int:
        """Coefficients that change no reading at all."""
        return sum(m.silent for m in self.motions)


def rank_of(setting: Setting, family: Family) -> Rank:
    """Rank, singular values and what is seen of every error motion."""
    model = machine(setting, family)
    batch = prepare_batch(model, setting.plan)
    jacobian = np.asarray(batch.jacobian)
    singular = np.linalg.svd(jacobian, compute_uv=False)
    rank = int((singular > _ZERO * singular[0]).sum())
    return Rank(jacobian.shape[1], rank, singular, _motions(model, batch))


def _motions(model: Model, batch: Batch) -> tuple[Seen, ...]:
    names = [e.parameter.name.split(".")[0] for e in model.entries]
    length = np.linalg.norm(np.asarray(batch.jacobian), axis=0)
    share = 1.0 - np.diag(np.asarray(batch.inverse))
    found = []
    for name in dict.fromkeys(names):
        own = np.array([n == name for n in names])
        silent = int((length[own] <= _ZERO * length.max()).sum())
        silent_all = silent == own.sum()
        least, most = (0.0, 0.0) if silent_all else (share[own].min(), share[own].max())
        found.append(Seen(name, int(own.sum()), float(least), float(most), silent))
    return tuple(found)
