"""Artefacts and poses as numbers within bounds, for a search.

A pose is a rotation from its nominal orientation, and a position as a share of the room that the
travel leaves for the rotated artefact, so that balls are inside the travel by construction. Balls
along the artefact are represented by gaps of at least the spacing that add up to its length; across
it they lie within limits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...numerics.arrays import Array
from ...numerics.spatial import rotation
from .ball_information import ArrayPoses

_SIDES = "XYZ"
_TINY = 1e-18
_SMOOTH_M = 2e-3
"""Approximate distance of balls from the ends of the travel, larger where many balls are near."""


class Candidate(NamedTuple):
    """An artefact in its poses, with the amount by which it exceeds the travel."""

    poses: ArrayPoses
    excess: Float[Array, ""]
    """Root sum of squares, over poses and axes, of the length by which the rotated artefact exceeds
    the travel, m.
    """
    crowding: Float[Array, ""]
    """Root sum of squares of the missing clearance, in units of `ArraySpace.clear`. A search that
    is penalised before the end of the travel does not stop there.
    """

    @property
    def penalty(self) -> Float[Array, ""]:
        """Factor on a criterion."""
        return 1.0 + 0.1 * self.crowding**2


@dataclass(frozen=True)
class ArraySpace:
    """The variations of a nominal artefact and its nominal poses; lengths in m."""

    nominal: ArrayPoses
    travel: Mapping[str, tuple[float, float]]
    """Allowed positions of X, Y and Z; the tool offset is taken into account."""
    poses: bool = True
    """Whether orientations and places vary."""
    across: tuple[float, float] = (0.0, 0.0)
    """Largest distance of balls from the axis of the artefact, in y and z of its frame; zero keeps
    the nominal balls.
    """
    along: bool = False
    """Whether the positions of the balls along the artefact vary, at a fixed length."""
    spacing: float = 0.05
    """Least distance of neighbouring balls along the artefact."""
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Tool of the chain, from the last axis."""
    styli: tuple[tuple[int, ...], ...] = ()
    """The stylus of a star for every touch (m, N), where the directions of the styli vary about
    those of `nominal.tool`.
    """
    reach: float = 0.0
    """Largest distance of a stylus tip from its nominal position, in every direction."""
    clear: float = 0.02
    """Desired clearance between the rotated artefact and the travel (`Candidate.crowding`)."""

    def __post_init__(self):
        x = np.asarray(self.nominal.balls)[:, 0]
        if len(x) > 1 and (np.diff(x) < self.spacing - 1e-9).any():
            raise ValueError(
                f"nominal balls: found neighbours {1e3 * np.diff(x).min():.4g} mm apart along the "
                f"artefact, expected at least {1e3 * self.spacing:.4g} mm in ascending order; move "
                "them apart, or reduce the spacing"
            )

    @property
    def low(self) -> Float[np.ndarray, " d"]:
        """Lower bounds."""
        return self._bounds()[0]

    @property
    def high(self) -> Float[np.ndarray, " d"]:
        """Upper bounds."""
        return self._bounds()[1]

    @property
    def start(self) -> Float[np.ndarray, " d"]:
        """The nominal design."""
        parts = []
        if self.poses:
            low, room = self._room(self.nominal.rotation, self.nominal.balls, self.nominal.tool)
            at = np.asarray(self.nominal.origin) - np.asarray(low)
            room = np.asarray(room)
            shares = np.where(room > 1e-9, at / np.where(room > 1e-9, room, 1.0), 0.5)
            turns = np.zeros_like(shares)
            parts.append(np.concatenate([turns, np.clip(shares, 0.0, 1.0)], 1).ravel())
        balls = np.asarray(self.nominal.balls)
        for column, limit in zip((1, 2), self.across, strict=True):
            if limit:
                parts.append(np.clip(balls[:, column] / limit, -1.0, 1.0))
        if self.along:
            free = np.diff(balls[:, 0]) - self.spacing
            parts.append(np.log(np.maximum(free, 1e-4)))
        parts.append(np.zeros(3 * self._styli))
        return np.concatenate(parts) if parts else np.zeros(0)

    def scattered(self, key: Array, turn: float = 0.3, share: float = 0.2) -> np.ndarray:
        """A random start near the nominal design: orientations rotated by about `turn` (rad), all
        other numbers moved by about `share` of their range.
        """
        drawn = np.array(jax.random.normal(key, (len(self.start),)))
        scale = np.full(len(drawn), share)
        if self.poses:
            m = self.nominal.rotation.shape[0]
            scale[: 6 * m] = np.tile([turn] * 3 + [share] * 3, m)
        return np.clip(self.start + scale * drawn, self.low, self.high)

    def candidate(self, z: Float[Array, " d"], nominal: ArrayPoses | None = None) -> Candidate:
        """The design of a vector z, about another `nominal` design of the same size if given.

        It may be traced, so that searches about many designs share one program.
        """
        nominal = self.nominal if nominal is None else nominal
        m, n = nominal.rotation.shape[0], nominal.balls.shape[0]
        used = 6 * m if self.poses else 0
        balls = jnp.asarray(nominal.balls)
        for column, limit in zip((1, 2), self.across, strict=True):
            if limit:
                balls = balls.at[:, column].set(limit * z[used : used + n])
                used += n
        if self.along:
            whole = balls[-1, 0] - balls[0, 0] - (n - 1) * self.spacing
            gaps = self.spacing + whole * jax.nn.softmax(z[used : used + n - 1])
            balls = balls.at[1:, 0].set(balls[0, 0] + jnp.cumsum(gaps))
            used += n - 1
        tool = nominal.tool
        if self._styli:
            assert tool is not None
            moved = self.reach * z[used:].reshape(self._styli, 3)
            tool = tool + moved[np.array(self.styli)]
        turned, origin = jnp.asarray(nominal.rotation), jnp.asarray(nominal.origin)
        shares = None
        if self.poses:
            moved = z[: 6 * m].reshape(m, 6)
            turned = turned @ jax.vmap(rotation)(moved[:, :3])
            shares = moved[:, 3:]
        low, room = self._room(turned, balls, tool)
        if shares is not None:
            origin = low + shares * jnp.maximum(room, 0.0)
        excess, crowding = (
            jnp.sqrt((jnp.maximum(least - room, 0.0) ** 2).sum() + _TINY) - _TINY**0.5
            for least in (0.0, self.clear)
        )
        return Candidate(ArrayPoses(balls, turned, origin, tool), excess, crowding / self.clear)

    @property
    def _styli(self) -> int:
        """Number of styli with variable directions."""
        return 1 + max((i for row in self.styli for i in row), default=-1) if self.reach else 0

    def _room(self, turned: Array, balls: Array, tool: Array | None) -> tuple[Array, Array]:
        """Lowest origin (m, 3) with all balls inside, and the range of its movement."""
        placed = jnp.einsum("mij,nj->mni", turned, balls)
        reached = placed - (jnp.asarray(self.tool) if tool is None else tool)
        low, high = (jnp.array([self.travel[c][i] for c in _SIDES]) for i in (0, 1))
        # Smooth bounds slightly outside the outermost balls: the gradient has no kink where another
        # ball becomes the outermost one.
        lowest = -_SMOOTH_M * jax.nn.logsumexp(-reached / _SMOOTH_M, axis=1)
        highest = _SMOOTH_M * jax.nn.logsumexp(reached / _SMOOTH_M, axis=1)
        first = low - lowest
        return first, high - highest - first

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        m, n = self.nominal.rotation.shape[0], self.nominal.balls.shape[0]
        low: list[float] = []
        high: list[float] = []
        if self.poses:
            low += ([-np.pi] * 3 + [0.0] * 3) * m
            high += ([np.pi] * 3 + [1.0] * 3) * m
        for limit in self.across:
            if limit:
                low += [-1.0] * n
                high += [1.0] * n
        if self.along:
            low += [-8.0] * (n - 1)
            high += [8.0] * (n - 1)
        low += [-1.0] * 3 * self._styli
        high += [1.0] * 3 * self._styli
        return np.array(low), np.array(high)


def spread(space: ArraySpace, key: Array, count: int) -> Sequence[np.ndarray]:
    """The nominal design and `count` - 1 random starts around it."""
    keys = jax.random.split(key, max(count - 1, 1))
    return [space.start, *(space.scattered(k) for k in keys[: count - 1])]
