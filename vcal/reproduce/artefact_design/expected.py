"""Expected error after compensation, by theory: the family's own estimate, and plain least squares.

The machine's errors theta have mean zero and unit variance. An estimate that is linear in what was
observed leaves the error map e = (G_C P J - G_M) theta + G_C P n, whose expected mean square over
the grid is what counts. The linear estimate of least mean square error (LMMSE) is the Bayesian one
with the family's own functions; the publication fits Legendre polynomials to distances.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ...design import (
    ArrayPoses,
    Gram,
    Touches,
    array_curvature,
    balls_precision,
    expected_rms,
    inverse,
    pairs_precision,
    touches,
    volumetric_gram,
)
from ...effects.geometric import ErrorMotion, GeometricErrors
from ...instruments.ball_array import BallArray
from ...machine.error_functions import Legendre
from ...model.forward import Model
from ...numerics.arrays import Array
from .setting import PAIR_UM, PROBE_UM, TRAVEL, Family, Known, grid_points, machine

SUPPORTS = (0.2203, 0.7797)
"""Of the artefact, as shares of its length: Bessel's points."""
ORDERS = (1, 2, 3, 4, 5)
"""Of the polynomials of plain least squares."""
_MICRO = 1e-6
_RANK = 1e-9
"""Singular value, relative to the largest, below which plain least squares drops a combination."""


@dataclass(frozen=True)
class Task:
    """The machine, what its errors amount to on the grid, and compiled functions of designs."""

    model: Model
    gram: Gram
    polynomials: "_Polynomials"
    """For plain least squares."""
    seen: Callable[[ArrayPoses], Touches]
    """Derivatives of all touches, by the machine and then by the polynomials."""
    left: Callable[..., Float[Array, "2"]]
    """Expected rms, um, aligned and raw, from these, what is known of the balls, and whether they
    are fresh in every pose. Compiled apart from the derivatives, it serves all that is known.
    """


def task(family: Family | None = None) -> Task:
    """The publication's machine, or one of another family, with an instrument in place of any
    artefact.
    """
    chain, errors = machine(family)
    model = Model(chain, touched(np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 3))), (errors,))
    gram, polynomials = volumetric_gram(model, grid_points(chain)), _polynomials(model)

    # Machines are closed over: they are data, and the same for all designs.
    @jax.jit
    def seen(poses: ArrayPoses) -> Touches:
        return touches(polynomials.both, poses)

    @partial(jax.jit, static_argnames="fresh")
    def left(seen: Touches, K: Array, fresh: bool) -> Float[Array, "2"]:
        own = seen._replace(machine=seen.machine[:, :, : polynomials.truth])
        C = inverse(array_curvature(own, model, PROBE_UM * _MICRO, K, fresh=fresh))
        return jnp.stack([expected_rms(jnp.asarray(g), C) for g in gram]) / _MICRO

    return Task(model, gram, polynomials, seen, left)


def touched(
    balls: Float[np.ndarray, "N 3"], rotation: np.ndarray, origin: Float[np.ndarray, "m 3"]
) -> BallArray:
    """An artefact in its poses as an instrument."""
    return BallArray(
        centres=balls,
        numbers=np.arange(len(balls)),
        probe_sigma=PROBE_UM * _MICRO,
        position_sigma=0.0,
        supports=SUPPORTS,
        pose_numbers=np.arange(len(origin)),
        pose_rotation=rotation,
        pose_origin=origin,
    )


def precision_of(known: Known, balls: Float[Array, "N 3"]) -> Float[Array, "n n"]:
    """K of the ball errors."""
    if known == "B":
        return balls_precision(balls.shape[0], PAIR_UM * _MICRO / 2.0**0.5)
    return pairs_precision(balls, PAIR_UM * _MICRO)


def posterior(model: Model, poses: ArrayPoses, known: Known) -> Float[Array, "k k"]:
    """Covariance of the machine's amplitudes by the family's own estimate."""
    K = precision_of(known, poses.balls)
    seen = touches(model, poses)
    return inverse(array_curvature(seen, model, PROBE_UM * _MICRO, K, fresh=known == "P"))


def bayes_um(task: Task, poses: ArrayPoses, known: Known) -> tuple[float, float]:
    """Expected rms on the grid, aligned and raw, um: also the least of all linear estimates."""
    aligned, raw = task.left(
        task.seen(poses), precision_of(known, jnp.asarray(poses.balls)), fresh=known == "P"
    )
    return float(aligned), float(raw)


@dataclass(frozen=True)
class Plain:
    """Plain least squares of one order."""

    order: int
    columns: int
    rank: int
    aligned_um: float
    raw_um: float


def plain_least_squares(
    task: Task, poses: ArrayPoses, known: Known, orders: Sequence[int] = ORDERS
) -> list[Plain]:
    """Legendre polynomials up to an order for all error motions, and squarenesses, fitted to the
    distances of all pairs in every pose, unweighted, of least norm where the rank falls short.
    """
    polynomials, k = task.polynomials, task.polynomials.truth
    seen = np.asarray(task.seen(poses).machine)
    balls = np.asarray(poses.balls)
    U = _directions(balls)
    turned = [U @ np.kron(np.eye(len(balls)), r.T) for r in np.asarray(poses.rotation)]
    D = np.concatenate([w @ j for w, j in zip(turned, seen, strict=True)])
    m, pairs = len(turned), len(U)
    probing = (PROBE_UM * _MICRO) ** 2 * U @ U.T
    own = (PAIR_UM * _MICRO) ** 2 * (0.5 * U @ U.T if known == "B" else np.eye(pairs))
    found = []
    for order in orders:
        L = D[:, polynomials.columns(order)]
        # The orthogonal part first: the singular values are then those of a small matrix.
        q, r = np.linalg.qr(L)
        u, s, vt = np.linalg.svd(r)
        kept = s > _RANK * s[0]
        P = (vt[kept].T / s[kept]) @ (q @ u[:, kept]).T
        estimate = np.concatenate([np.eye(k), -P @ D[:, :k]])
        by_pose = P.reshape(-1, m, pairs)
        scatter = np.einsum("amp,pq,bmq->ab", by_pose, probing, by_pose, optimize=True)
        reach = by_pose if known == "P" else by_pose.sum(1)[:, None]
        scatter += np.einsum("amp,pq,bmq->ab", reach, own, reach, optimize=True)
        both = np.concatenate([np.arange(k), polynomials.columns(order)])
        values = []
        for G in polynomials.gram:
            G = G[np.ix_(both, both)]
            mean = np.einsum("ak,ab,bk->", estimate, G, estimate, optimize=True)
            values.append(np.sqrt(mean + np.einsum("ab,ab->", G[k:, k:], scatter)) / _MICRO)
        found.append(Plain(order, L.shape[1], int(kept.sum()), *map(float, values)))
    return found


def best_plain(task: Task, poses: ArrayPoses, known: Known) -> Plain:
    """The order with the smallest expected error."""
    return min(plain_least_squares(task, poses, known), key=lambda plain: plain.aligned_um)


@dataclass(frozen=True)
class _Polynomials:
    """Truth and polynomials of the highest order side by side."""

    both: Model
    gram: Gram
    truth: int
    motions: int

    def columns(self, order: int) -> Int[np.ndarray, " l"]:
        """Places of the polynomials up to an order, and of the squarenesses."""
        count = max(ORDERS) + 1
        motions = np.arange(self.motions * count).reshape(self.motions, count)
        rest = np.arange(motions.size, len(self.both.entries) - self.truth)
        return self.truth + np.concatenate([motions[:, : order + 1].ravel(), rest])


def _polynomials(model: Model) -> _Polynomials:
    wanted, degrees = model.effects[0], tuple(range(max(ORDERS) + 1))
    assert isinstance(wanted, GeometricErrors)
    fitted = GeometricErrors(
        motions=tuple(
            ErrorMotion(m.name, m.axis, Legendre(TRAVEL[m.axis], degrees, 1e-5))
            for m in wanted.motions
        ),
        locations=wanted.locations,
    )
    both = Model(model.chain, model.instrument, (wanted, fitted))
    gram = volumetric_gram(both, grid_points(model.chain, _COARSE))
    return _Polynomials(both, gram, len(model.entries), len(wanted.motions))


_COARSE = (30, 10, 10)
"""Of the publication's grid, enough for polynomials of a low order."""


def _directions(balls: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "p n"]:
    """Derivative of the distance of every pair by all ball centres."""
    rows = []
    for i, j in itertools.combinations(range(len(balls)), 2):
        row = np.zeros(3 * len(balls))
        u = (balls[i] - balls[j]) / np.linalg.norm(balls[i] - balls[j])
        row[3 * i : 3 * i + 3], row[3 * j : 3 * j + 3] = u, -u
        rows.append(row)
    return np.array(rows)
