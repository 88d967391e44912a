"""Searches about many designs, and for several families at once, with few programs.

To compile the criterion takes as long as a search with it. So a program takes what differs from
search to search as arguments: the design that it starts about, which of its poses are used, how the
families share the average, and which of the two ways to know one artefact (S, B) is meant. What is
left is one program per number of balls, number of places for poses, and per whether the balls are
fresh in every pose (P).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from .expected import Task, precision_of
from .setting import PROBE_UM, TOOL, TRAVEL, Known

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
            nominal,
            TRAVEL,
            poses=free.poses,
            across=free.across,
            along=free.along,
            tool=TOOL,
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
    for task in tasks:
        seen = touches(task.model, poses)
        H = array_curvature(seen, task.model, PROBE_UM * _MICRO, K, fresh=fresh, often=often)
        found.append(expected_rms(jnp.asarray(task.gram.aligned), inverse(H)) / _MICRO)
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
