"""Error against measuring time: how many balls in how many poses, and which.

A pose costs a set-up of the artefact, a ball its touches. For every number of balls and of poses
the poses are first chosen out of many by exchange, which theory bounds from below, and the gradient
then moves poses and balls. The front gives the error per
measuring time; its cheapest design that is as good as the nominal one gives the time that the
nominal one wastes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from ...design import (
    ArrayPoses,
    PoseInformation,
    Touches,
    exchange,
    pose_information,
    touches,
    weigh_average,
)
from ...numerics.arrays import Array
from ...numerics.spatial import rotation
from .expected import Task, bayes_um, precision_of
from .searches import FREEDOMS, Searches
from .setting import KNOWN, NOMINAL, POSES, PROBE_UM, TOOL, TRAVEL, Known, ball_line, placed

SETUP_S = 300.0
"""To put the artefact up in a pose and to find it there."""
BALL_S = 20.0
"""To touch a ball as often as its centre takes."""
NOMINAL_POSES = 12
SHAPES: Mapping[int, tuple[int, ...]] = {
    5: (5, 7, 8),
    7: (4, 6, 7, 9),
    9: (4, 5, 6, 7),
    11: (4, 5, 6),
}
"""Numbers of poses, by number of balls."""
SCATTERED = 84
"""Candidates in addition to the named sets of poses."""
FREEDOM = "poses, balls within 60 mm"

_MICRO = 1e-6
_GAP = 5e-3


def seconds(balls: int, poses: int) -> float:
    """Time to measure some balls in some poses."""
    return poses * (SETUP_S + balls * BALL_S)


NOMINAL_S = seconds(NOMINAL[0], NOMINAL_POSES)


@dataclass(frozen=True)
class Chosen:
    """Poses of the nominal artefact with some number of balls, chosen among candidates."""

    poses: ArrayPoses
    rms_um: float
    bound_um: float
    """What no choice among these candidates goes below."""


@dataclass(frozen=True)
class Design:
    """The best found with some number of balls and of poses."""

    balls: int
    count: int
    """Poses."""
    freedom: str
    chosen: Chosen
    rms_um: float
    """Expected, aligned, after the gradient moved poses and balls."""
    poses: ArrayPoses

    @property
    def seconds(self) -> float:
        """To measure it."""
        return seconds(self.balls, self.count)


@dataclass(frozen=True)
class Trade:
    """Error against time, for one way to know the artefact."""

    known: Known
    nominal_um: float
    designs: tuple[Design, ...]
    """By time."""

    @property
    def front(self) -> tuple[Design, ...]:
        """Designs that no other beats in both, by time."""
        return tuple(
            d
            for i, d in enumerate(self.designs)
            if all(other.rms_um > d.rms_um for other in self.designs[:i])
        )

    def cheapest(self, rms_um: float | None = None) -> Design | None:
        """The design of least time that reaches an error, the nominal one if none is given."""
        target = self.nominal_um if rms_um is None else rms_um
        return next((d for d in self.designs if d.rms_um <= target), None)

    @property
    def share(self) -> float | None:
        """Of the nominal time, what the cheapest takes that is as good as the nominal design."""
        found = self.cheapest()
        return None if found is None else found.seconds / NOMINAL_S


def scattered(key: jax.Array, balls: np.ndarray, count: int) -> ArrayPoses:
    """Feasible poses at random: any direction that the travel allows, more often near its ends."""
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    rotations, origins = [], []
    while len(rotations) < count:
        # Quaternions of equal distribution give directions of equal distribution.
        w, *v = (q := rng.standard_normal(4)) / np.linalg.norm(q)
        angle = 2.0 * np.arctan2(np.linalg.norm(v), w)
        R = np.asarray(rotation(jnp.asarray(angle * np.array(v) / np.linalg.norm(v))))
        reached = balls @ R.T
        room = (high - low) - np.ptp(reached, axis=0)
        if (room >= 0.0).all():
            share = np.sin(0.5 * np.pi * rng.uniform(size=3)) ** 2
            rotations.append(R)
            origins.append(low - reached.min(0) + share * room + TOOL)
    return ArrayPoses(*map(jnp.asarray, (balls, np.stack(rotations), np.stack(origins))))


def candidates(balls: int, *, scatter: int = SCATTERED, seed: int = 0) -> ArrayPoses:
    """The nominal artefact with some number of balls in all named poses, and in scattered ones."""
    line = ball_line(balls, *NOMINAL[1:])
    named = placed([pose for make in POSES.values() for pose in make()], line)
    if not scatter:
        return named
    more = scattered(jax.random.key(seed), line, scatter)
    return ArrayPoses(
        named.balls,
        jnp.concatenate([named.rotation, more.rotation]),
        jnp.concatenate([named.origin, more.origin]),
    )


class Chooser:
    """Poses chosen among candidates, whose derivatives are computed once per number of balls."""

    def __init__(self, task: Task, *, scatter: int = SCATTERED, seed: int = 0) -> None:
        self._task, self._scatter, self._seed = task, scatter, seed
        self._seen: dict[int, tuple[ArrayPoses, Touches]] = {}
        self._touches = jax.jit(lambda poses: touches(task.model, poses))

        def alone(seen: Touches, K: Array, fresh: bool) -> PoseInformation:
            return pose_information(seen, task.model, PROBE_UM * _MICRO, K, fresh=fresh)

        self._alone = jax.jit(alone, static_argnames="fresh")

    def choose(self, balls: int, counts: Sequence[int], known: Known) -> list[Chosen]:
        """The best choice and its bound, for some numbers of poses."""
        if balls not in self._seen:
            offered = candidates(balls, scatter=self._scatter, seed=self._seed)
            self._seen[balls] = offered, self._touches(offered)
        offered, seen = self._seen[balls]
        K = precision_of(known, offered.balls)
        own = self._alone(seen, K, fresh=known == "P")
        F, L = np.asarray(own.information), np.asarray(own.precision)
        G = np.asarray(own.padded(self._task.gram.aligned))
        found = []
        for count in counts:
            choice = exchange(F, L, G, count, starts=2, seed=self._seed)
            bound = weigh_average(F, L, G, count, most=1, gap=_GAP).bound
            at = choice.chosen
            poses = ArrayPoses(offered.balls, offered.rotation[at], offered.origin[at])
            found.append(Chosen(poses, choice.value / _MICRO, bound / _MICRO))
        return found


def trade(
    task: Task,
    *,
    knowns: Sequence[Known] = KNOWN,
    shapes: Mapping[int, Sequence[int]] = SHAPES,
    freedom: str = FREEDOM,
    scatter: int = SCATTERED,
    starts: int = 2,
    seed: int = 0,
    progress: Callable[[str], None] = lambda done: None,
) -> dict[Known, Trade]:
    """Search the best design of every shape and every way to know the artefact.

    One start is what the exchange chose, the others are scattered about it. Designs with the same
    number of balls share what they compile.
    """
    nominal = placed(next(iter(POSES.values()))(), ball_line(*NOMINAL))
    chooser = Chooser(task, scatter=scatter, seed=seed)
    found: dict[Known, list[Design]] = {known: [] for known in knowns}
    for balls, counts in shapes.items():
        searches = Searches([task], FREEDOMS[freedom])
        for known in knowns:
            for count, chosen in zip(counts, chooser.choose(balls, counts, known), strict=True):
                best = searches.polish(
                    chosen.poses, known, places=max(counts), starts=starts, seed=seed
                )
                found[known].append(Design(balls, count, freedom, chosen, best.rms_um, best.poses))
                progress(f"{known}: {balls} balls in {count} poses, {best.rms_um:.3f} um")
    return {
        known: Trade(known, bayes_um(task, nominal, known)[0], _by_time(designs))
        for known, designs in found.items()
    }


def joined(first: Trade, other: Trade) -> Trade:
    """Both families of designs as one."""
    return replace(first, designs=_by_time([*first.designs, *other.designs]))


def _by_time(designs: Sequence[Design]) -> tuple[Design, ...]:
    return tuple(sorted(designs, key=lambda d: (d.seconds, d.rms_um)))
