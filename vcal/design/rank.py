"""What a plan tells apart without any prior, and what it does not."""

from typing import NamedTuple

import numpy as np

from ..model import Model
from ..plan import Plan
from .posterior import jacobian

FREE = 1e-8
"""Singular value of columns of unit length below which a combination is not seen."""
_PART = 1e-3
"""Share in an unseen combination from which a parameter counts as part of it."""


class Rank(NamedTuple):
    """Rank of the derivative of all readings by all amplitudes."""

    columns: int
    rank: int
    mixed: tuple[int, ...]
    """Places of the amplitudes (`Model.entries`) that are part of what no reading shows."""


def rank_of(model: Model, plan: Plan) -> Rank:
    """Rank at the nominal machine. Raises as `jacobian` does."""
    J = np.asarray(jacobian(model, plan))
    J = J.reshape(-1, J.shape[-1])
    norms = np.linalg.norm(J, axis=0)
    J = J / np.where(norms > 0.0, norms, 1.0)
    _, sizes, vt = np.linalg.svd(J, full_matrices=True)
    rank = int((sizes > FREE).sum())
    parts = np.abs(vt[rank:]).max(0, initial=0.0)
    return Rank(J.shape[1], rank, tuple(np.flatnonzero(parts > _PART).tolist()))
