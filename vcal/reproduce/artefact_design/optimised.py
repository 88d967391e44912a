"""Twelve poses of eleven balls, better placed: by gradient, with one freedom after the other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from ...arrays import Array
from ...design import ArrayPoses, ArraySpace, Found, search, spread
from .expected import Task, bayes_um
from .setting import TOOL, TRAVEL, Known

STARTS = 8
_STEPS = 500
_ACCURACY = 1e-7
_EXCESS_M = 1e-3
"""Where the artefact stands out of the travel by this much, the criterion counts 10 % more."""


@dataclass(frozen=True)
class Freedom:
    """What the search may change."""

    across: tuple[float, float] = (0.0, 0.0)
    """Limits of the offsets in y and z of the artefact, m; zero: as they are."""
    along: bool = False
    poses: bool = True


FREEDOMS: Mapping[str, Freedom] = {
    "poses": Freedom(),
    "poses, offsets within 60 mm": Freedom((0.06, 0.06)),
    "poses, balls within 60 mm": Freedom((0.06, 0.06), along=True),
    "artefact, balls within 60 mm": Freedom((0.06, 0.06), along=True, poses=False),
    "poses, flat artefact within 250 mm": Freedom((0.25, 0.0), along=True),
    "poses, artefact within 250 mm": Freedom((0.25, 0.25), along=True),
}
"""By name; the number of balls and of poses, and the length of the artefact, stay."""


@dataclass(frozen=True)
class Optimised:
    """Where a search from several starts ended."""

    poses: ArrayPoses
    """The best."""
    rms_um: float
    """Expected, aligned."""
    nominal_um: float
    found: tuple[Found, ...]
    """All starts, best first."""

    @property
    def gain(self) -> float:
        """Share by which the expected error fell."""
        return 1.0 - self.rms_um / self.nominal_um


def optimise(
    task: Task,
    nominal: ArrayPoses,
    known: Known,
    freedom: Freedom,
    *,
    starts: int = STARTS,
    seed: int = 0,
) -> Optimised:
    """Search from the nominal design and from `starts` - 1 scattered around it.

    Raises `RuntimeError` where the best design stands out of the travel.
    """
    space = ArraySpace(
        nominal,
        TRAVEL,
        poses=freedom.poses,
        across=freedom.across,
        along=freedom.along,
        tool=TOOL,
    )
    rms = task.rms(known)

    def criterion(z: Float[Array, " d"]) -> Float[Array, ""]:
        made = space.candidate(z)
        return rms(made.poses)[0] * (1.0 + 0.1 * (made.excess / _EXCESS_M) ** 2)

    begin: Sequence[np.ndarray] = spread(space, jax.random.key(seed), starts)
    found = search(criterion, begin, space.low, space.high, steps=_STEPS, tolerance=_ACCURACY)
    best = space.candidate(found[0].z).poses
    at = np.asarray(best.position(task.model.chain))
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    if (at < low - 1e-9).any() or (at > high + 1e-9).any():
        raise RuntimeError("the best design found stands out of the travel; use more starts")
    reached, usual = (bayes_um(task, poses, known)[0] for poses in (best, nominal))
    return Optimised(best, reached, usual, tuple(found))
