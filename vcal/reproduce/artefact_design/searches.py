"""Searches about many designs, and for several families at once, with few programs.

Compiling the criterion takes as long as a search with it. A program therefore takes as arguments
what differs from search to search: the design that it starts about, which of its poses are used,
how the families share the average, and which of the two ways to know one artefact (S, B) is meant.
There is one program per number of balls, number of places for poses, and per whether the balls have
new errors in every pose (P).

A design that is optimal for one declared family may be so by its waves and its sizes. `robust`
judges poses and balls with other families - larger rotations, other waves - and searches a design
for the average over them,

    J^2 = 1/f sum over families of tr(G_i C_i),

each family with its own prior, its own grid and an identification that knows it: what is left of a
machine drawn from any of them. An identification that assumes the wrong family is another matter.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...design import (
    ArrayPoses,
    ArraySpace,
    Found,
    array_curvature,
    expected_rms,
    inverse,
    search,
    spread,
    touches,
)
from ...numerics.arrays import Array
from .expected import Task, bayes_um, precision_of, task
from .setting import (
    NOMINAL,
    POSES,
    PROBE_UM,
    TABLE_ONE,
    TOOL,
    TRAVEL,
    WAVES,
    Family,
    Known,
    ball_line,
    placed,
)

_MICRO = 1e-6


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
class Polished:
    """Where searches from several starts ended."""

    poses: ArrayPoses
    """The best."""
    rms_um: float
    """Expected, aligned: root of the mean square over the families in their shares."""
    families_um: tuple[float, ...]
    """Expected, aligned, of every family."""
    found: tuple[Found, ...]
    """All starts, best first."""
    nominal_um: float = np.nan
    """Expected, aligned, of the design that the search began with, where it was asked for."""

    @property
    def gain(self) -> float:
        """Share by which the expected error fell."""
        return 1.0 - self.rms_um / self.nominal_um


class Searches:
    """Programs that search for the least expected error, averaged over families of machines.

    The average is the root of the mean over the families of the expected mean square, each with its
    own prior and its own grid: what is left of a machine that is drawn from any of them.
    """

    def __init__(self, tasks: Sequence[Task], freedom: Freedom) -> None:
        self._tasks, self._freedom = tuple(tasks), freedom
        self._kept: dict[bool, Callable[..., Any]] = {}
        self._judge = jax.jit(partial(expected_um, self._tasks), static_argnames="fresh")

    def judge(self, poses: ArrayPoses, known: Known) -> tuple[float, ...]:
        """Expected rms of every family, aligned, um."""
        often, exactly = jnp.ones(poses.rotation.shape[0]), jnp.asarray(float(known == "B"))
        found = self._judge(poses, often, exactly, fresh=known == "P")
        return tuple(np.asarray(found).tolist())

    def polish(
        self,
        nominal: ArrayPoses,
        known: Known,
        *,
        places: int | None = None,
        shares: Sequence[float] | None = None,
        starts: int = 2,
        seed: int = 0,
        steps: int = 300,
        tolerance: float = 1e-6,
    ) -> Polished:
        """Search from `nominal`, and from `starts` - 1 designs scattered about it.

        Designs with as many balls and `places` (at least the number of poses) share a program; its
        cost is that of `places` poses. `shares` of the families in the average are equal if they
        are not given. Raises `ValueError` for fewer places than poses, and `RuntimeError` where the
        best design stands out of the travel.
        """
        m = nominal.rotation.shape[0]
        whole = with_spare(nominal, (places or m) - m)
        space = self._space(whole)
        often = (jnp.arange(whole.rotation.shape[0]) < m).astype(float)
        part = np.ones(len(self._tasks)) if shares is None else np.asarray(shares, float)
        part = part / part.sum()
        given = whole, often, jnp.asarray(float(known == "B")), jnp.asarray(part)
        program = self._program(space, fresh=known == "P")

        def both(z: np.ndarray) -> tuple[Array, Array]:
            (value, _), slope = program(jnp.asarray(z), *given)
            return value, slope

        begin = spread(space, jax.random.key(seed), starts)
        found = search(
            both, begin, space.low, space.high, steps=steps, tolerance=tolerance, with_slope=True
        )
        (_, (families, poses)), _ = program(jnp.asarray(found[0].z), *given)
        best = ArrayPoses(poses.balls, poses.rotation[:m], poses.origin[:m])
        check_inside(best)
        each = tuple(np.asarray(families, float).tolist())
        return Polished(best, float(np.sqrt(part @ np.square(each))), each, tuple(found))

    def _space(self, nominal: ArrayPoses) -> ArraySpace:
        free = self._freedom
        return ArraySpace(
            nominal, TRAVEL, poses=free.poses, across=free.across, along=free.along, tool=TOOL
        )

    def _program(self, space: ArraySpace, *, fresh: bool) -> Callable[..., Any]:
        """Value with the rms of the families and the design, and gradient, by the numbers of the
        search; the space gives sizes and limits only.
        """
        if fresh not in self._kept:

            def criterion(
                z: Array, nominal: ArrayPoses, often: Array, exactly: Array, shares: Array
            ) -> tuple[Array, tuple[Array, ArrayPoses]]:
                made = space.candidate(z, nominal)
                families = expected_um(self._tasks, made.poses, often, exactly, fresh=fresh)
                return jnp.sqrt(shares @ families**2) * made.penalty, (families, made.poses)

            self._kept[fresh] = jax.jit(jax.value_and_grad(criterion, has_aux=True))
        return self._kept[fresh]


def expected_um(
    tasks: Sequence[Task], poses: ArrayPoses, often: Array, exactly: Array, *, fresh: bool
) -> Float[Array, " f"]:
    """Expected rms of every family, aligned, um; `often` as in `array_curvature`, `exactly` one
    where ball centres are known (B), zero where distances are (S, P).
    """
    centres, distances = (precision_of(known, poses.balls) for known in ("B", "S"))
    K = distances + exactly * (centres - distances)
    found = []
    for own in tasks:
        seen = touches(own.model, poses)
        H = array_curvature(seen, own.model, PROBE_UM * _MICRO, K, fresh=fresh, often=often)
        found.append(expected_rms(jnp.asarray(own.gram.aligned), inverse(H)) / _MICRO)
    return jnp.stack(found)


def with_spare(poses: ArrayPoses, more: int) -> ArrayPoses:
    """A design with further poses, along X in the middle of the travel, where any artefact fits.

    Raises `ValueError` where `more` is below zero.
    """
    if more < 0:
        raise ValueError(f"found {-more} poses more than places, expected at most as many")
    middle = np.array([np.mean(TRAVEL[c]) for c in "XYZ"]) + TOOL
    rotation = np.concatenate([poses.rotation, np.tile(np.eye(3), (more, 1, 1))])
    origin = np.concatenate([poses.origin, np.tile(middle, (more, 1))])
    return ArrayPoses(jnp.asarray(poses.balls), jnp.asarray(rotation), jnp.asarray(origin))


def check_inside(poses: ArrayPoses) -> None:
    """Raise `RuntimeError` where a ball is outside of the travel."""
    at = np.asarray(poses.centres) - TOOL
    low, high = (np.array([TRAVEL[c][i] for c in "XYZ"]) for i in (0, 1))
    if (at < low - 1e-9).any() or (at > high + 1e-9).any():
        raise RuntimeError("the best design found stands out of the travel; use more starts")


STARTS = 8
STEPS = 500
_ACCURACY = 1e-7


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
) -> Polished:
    """Search from the nominal design and from `starts` - 1 scattered around it.

    `searches` of the same task and freedom share what they have compiled. Raises `RuntimeError`
    where the best design stands out of the travel.
    """
    searches = searches or Searches([task], freedom)
    best = searches.polish(
        nominal, known, starts=starts, seed=seed, steps=steps, tolerance=_ACCURACY
    )
    reached, usual = (bayes_um(task, poses, known)[0] for poses in (best.poses, nominal))
    return replace(best, rms_um=reached, nominal_um=usual)


FAMILIES: Mapping[str, Family] = {
    "Table 1": Family(),
    "rotations x 2, translations / 2": Family(
        {
            name: tuple(v * (2.0 if name[1] in "ABC" else 0.5) for v in row)
            for name, row in TABLE_ONE.items()
        },
        squareness_urad=80.0,
    ),
    "other waves": Family(
        waves={axis: (0.75, 1.5 * second) for axis, (_, second) in WAVES.items()}
    ),
}
"""By name; the first is the publication's."""
FREEDOM = "poses, balls within 60 mm"
NOMINAL_DESIGN, AVERAGE = "nominal", "the average"


@dataclass(frozen=True)
class Robust:
    """Designs against families, for one way to know the artefact."""

    known: Known
    families: tuple[str, ...]
    designs: Mapping[str, ArrayPoses]
    """The nominal one, and one optimised for every family and for their average, by what it is
    optimised for.
    """
    rms_um: Mapping[str, tuple[float, ...]]
    """Expected, aligned, of every design with every family."""

    def average_um(self, design: str) -> float:
        """Root of the mean square over the families."""
        return float(np.sqrt(np.mean(np.square(self.rms_um[design]))))


def robust(
    known: Known,
    *,
    families: Mapping[str, Family] = FAMILIES,
    nominal: ArrayPoses | None = None,
    starts: int = 2,
    seed: int = 0,
    steps: int = 200,
    progress: Callable[[str], None] = lambda done: None,
) -> Robust:
    """Search designs for every family and for their average, and judge all with all.

    All searches are one program. Those for the average begin where the first family's ended too, so
    that no average is worse than that design's.
    """
    if nominal is None:
        nominal = placed(next(iter(POSES.values()))(), ball_line(*NOMINAL))
    names = tuple(families)
    searches = Searches([task(family) for family in families.values()], FREEDOMS[FREEDOM])

    def better(start: ArrayPoses, shares: Sequence[float], count: int) -> Polished:
        return searches.polish(
            start, known, shares=shares, starts=count, seed=seed, steps=steps, tolerance=1e-5
        )

    found: dict[str, Polished] = {}
    for i, name in enumerate(names):
        found[name] = better(nominal, np.eye(len(names))[i].tolist(), starts)
        progress(f"optimised for {name}: {found[name].rms_um:.3f} um")
    evenly = [1.0] * len(names)
    both = better(nominal, evenly, starts), better(found[names[0]].poses, evenly, 1)
    found[AVERAGE] = min(both, key=lambda p: p.rms_um)
    progress(f"optimised for {AVERAGE}: {found[AVERAGE].rms_um:.3f} um")
    rms = {NOMINAL_DESIGN: searches.judge(nominal, known)}
    rms |= {name: best.families_um for name, best in found.items()}
    designs = {NOMINAL_DESIGN: nominal} | {name: best.poses for name, best in found.items()}
    return Robust(known, names, designs, rms)
