"""Twelve poses of eleven balls, better placed: by gradient, with one freedom after the other."""

from dataclasses import dataclass

from ...design import ArrayPoses, Found
from .expected import Task, bayes_um
from .searches import Freedom, Searches
from .setting import Known

STARTS = 8
STEPS = 500
_ACCURACY = 1e-7


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
    steps: int = STEPS,
    seed: int = 0,
    searches: Searches | None = None,
) -> Optimised:
    """Search from the nominal design and from `starts` - 1 scattered around it.

    `searches` of the same task and freedom share what they have compiled. Raises `RuntimeError`
    where the best design stands out of the travel.
    """
    searches = searches or Searches([task], freedom)
    best = searches.polish(
        nominal, known, starts=starts, seed=seed, steps=steps, tolerance=_ACCURACY
    )
    reached, usual = (bayes_um(task, poses, known)[0] for poses in (best.poses, nominal))
    return Optimised(best.poses, reached, usual, best.found)
