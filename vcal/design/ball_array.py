"""Artefacts of balls: what their poses and their shape leave uncertain of a machine.

A touch shows where the tool point is against the ball. Of a pose k with readings r_k

    r_k = J_k theta + A_k p_k + B_k e (+ probing),        p_k flat, e ~ (0, K^-1)

theta are the amplitudes of the machine, p_k the unknown pose and e the errors of the calibrated
ball centres, either the same in all poses (*shared*: one artefact) or *fresh* in every one (heat,
handling). Poses are eliminated one by one, then the ball errors, so that the cost grows with the
number of poses and not with its cube. Everything can be differentiated by balls and poses.

How well the artefact is known is said by its centres (`balls_precision`), or by the distances of
all pairs of balls (`pairs_precision`), which says nothing of its place, and across the line of a
straight artefact nothing of its shape.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Float

from ..arrays import Array
from ..chain import Chain
from ..model import Model, tool_points_with_jacobian
from ..plan import Plan
from ..spatial import skew
from .posterior import precision, slopes

_LOOSE_M = 1e-3
"""Standard deviation of a ball centre where nothing else is known of it."""


class ArrayPoses(eqx.Module):
    """An artefact of N balls in m poses; lengths in m."""

    balls: Float[Array, "N 3"]
    """Ball centres in the artefact's frame."""
    rotation: Float[Array, "m 3 3"]
    origin: Float[Array, "m 3"]
    """Where the artefact's frame is in that of the workpiece."""
    tool: Float[Array, "m N 3"] | None = None
    """Tool of every touch, from the last axis; without it, the chain's."""

    @property
    def centres(self) -> Float[Array, "m N 3"]:
        """Ball centres in the workpiece frame."""
        turned = jnp.einsum("mij,nj->mni", self.rotation, self.balls)
        return self.origin[:, None] + turned

    def position(self, chain: Chain) -> Float[Array, "m N 3"]:
        """Nominal positions of X, Y and Z at which the tool point is in the balls."""
        tool = jnp.asarray(chain.tool_offset) if self.tool is None else self.tool
        return self.centres - tool


class Touches(NamedTuple):
    """Derivatives of all touches, pose by pose, in m."""

    machine: Float[Array, "m n k"]
    """By the amplitudes in solver units; n = 3 N."""
    pose: Float[Array, "m n 6"]
    balls: Float[Array, "m n n"]


def touches(model: Model, poses: ArrayPoses) -> Touches:
    """Exact derivatives at the nominal machine, of tool point less ball centre.

    `model` gives the chain and the effects of the machine; its instrument is not looked at. The
    axes of the chain have to be X, Y and Z in any order.
    """
    m, n = poses.rotation.shape[0], poses.balls.shape[0]
    chain, layout = model.chain, model.layout
    place = jnp.asarray(poses.position(chain)).reshape(m * n, 3)
    order = ["XYZ".index(axis) for axis in chain.axes]
    number = {"pose": np.repeat(np.arange(m), n), "ball": np.tile(np.arange(n), m)}
    plan = Plan(chain.axes, place[:, np.array(order)], {}, number)
    ports = jnp.zeros((m * n, len(layout)))
    if poses.tool is not None:
        other = poses.tool.reshape(m * n, 3) - jnp.asarray(chain.tool_offset)
        ports = ports.at[:, layout.slice("tool").start + np.arange(3)].set(other)
    _, by_port = tool_points_with_jacobian(chain, jnp.asarray(plan.position), ports)
    # ball = origin + R exp(w) (b + e)
    turned = jax.vmap(lambda r: jax.vmap(lambda b: r @ skew(b))(poses.balls))(poses.rotation)
    still = jnp.broadcast_to(-jnp.eye(3), (m, n, 3, 3))
    by_ball = jnp.einsum("mab,nl->mnalb", -poses.rotation, jnp.eye(n))
    return Touches(
        slopes(model.effects, model, plan, by_port).reshape(m, 3 * n, -1),
        jnp.concatenate([still, turned], -1).reshape(m, 3 * n, 6),
        by_ball.reshape(m, 3 * n, 3 * n),
    )


def array_curvature(
    seen: Touches,
    model: Model,
    probe_m: float,
    known: Float[Array, "n n"],
    *,
    fresh: bool = False,
    often: Float[Array, " m"] | None = None,
) -> Float[Array, "k k"]:
    """H of the machine's amplitudes: poses and ball errors eliminated.

    `probe_m` is the standard deviation of a touch in every direction, `known` the precision K of
    the ball errors (1/m^2), `fresh` whether they are drawn anew in every pose, `often` how often
    the artefact is put up in each pose (once): zero leaves a pose out.
    """
    J, B = _without_poses(seen, probe_m)
    K = known + jnp.eye(known.shape[0]) / _LOOSE_M**2
    times = jnp.ones(J.shape[0]) if often is None else often
    H = jnp.einsum("m,mnk,mnl->kl", times, J, J) + precision(model)
    if fresh:
        return H - jnp.einsum("m,mkl->kl", times, _explained(J.swapaxes(1, 2) @ B, _square(B), K))
    by_both, by_balls = (jnp.einsum("m,mnk,mnl->kl", times, part, B)[None] for part in (J, B))
    return H - _explained(by_both, by_balls, K)[0]


class PoseInformation(NamedTuple):
    """What every pose of an artefact says by itself, its own unknown place eliminated: matrices to
    choose poses by. The information of a set of poses is the sum of theirs, and the prior.

    The last of the `c` unknowns are the errors of the ball centres, in mm, where all poses share
    them; the first are the machine's amplitudes in solver units.
    """

    information: Float[Array, "m c c"]
    precision: Float[Array, "c c"]

    def padded(self, gram: Float[Array, "k k"]) -> Float[Array, "c c"]:
        """A quadratic form of the amplitudes, with zeros for what does not count."""
        more = self.precision.shape[0] - gram.shape[0]
        return jnp.pad(jnp.asarray(gram), (0, more))


def pose_information(
    seen: Touches,
    model: Model,
    probe_m: float,
    known: Float[Array, "n n"],
    *,
    fresh: bool = False,
) -> PoseInformation:
    """Information of every pose; arguments as those of `array_curvature`.

    Ball errors that are fresh in every pose are eliminated with it. Those of one artefact stay: to
    eliminate them would tie the poses together.
    """
    J, B = _without_poses(seen, probe_m)
    K = known + jnp.eye(known.shape[0]) / _LOOSE_M**2
    L = jnp.asarray(precision(model))
    if fresh:
        own = _explained(J.swapaxes(1, 2) @ B, _square(B), K)
        return PoseInformation(_square(J) - own, L)
    rows = jnp.concatenate([J, B * _LOOSE_M], -1)
    return PoseInformation(_square(rows), block_diag(L, K * _LOOSE_M**2))


def _without_poses(
    seen: Touches, probe_m: float
) -> tuple[Float[Array, "m n k"], Float[Array, "m n n"]]:
    """Whitened derivatives by machine and balls, less what the place of every pose explains."""
    J, A, B = (part / probe_m for part in seen)
    # Metres and radians of a pose are made alike before they are projected out.
    A = A / jnp.linalg.norm(A, axis=1, keepdims=True)
    q, _ = jnp.linalg.qr(A)

    def left(part: Float[Array, "m n c"]) -> Float[Array, "m n c"]:
        return part - q @ (q.swapaxes(1, 2) @ part)

    return left(J), left(B)


def _square(rows: Float[Array, "m n c"]) -> Float[Array, "m c c"]:
    return rows.swapaxes(1, 2) @ rows


def _explained(
    by_both: Float[Array, "m k n"], by_balls: Float[Array, "m n n"], K: Float[Array, "n n"]
) -> Float[Array, "m k k"]:
    """J'B (K + B'B)^-1 B'J, what could as well be the errors of the balls."""
    # In units of the loosest, as the smallest and the largest precision are many decades apart.
    scale = 1.0 / jnp.sqrt(jnp.diagonal(K + by_balls, axis1=1, axis2=2))
    inner = scale[:, :, None] * (K + by_balls) * scale[:, None]
    reach = by_both * scale[:, None]
    return reach @ jnp.linalg.solve(inner, reach.swapaxes(1, 2))


def balls_precision(count: int, u_m: float) -> Float[Array, "n n"]:
    """K of ball centres with independent standard uncertainties `u_m` of their coordinates."""
    return jnp.eye(3 * count) / u_m**2


def pairs_precision(balls: Float[Array, "N 3"], u_m: float) -> Float[Array, "n n"]:
    """K where the distance of every pair is known, with independent standard uncertainties `u_m`:
    sum over pairs of w w' / u^2, w the direction of the pair at one ball, less at the other.
    """
    n = balls.shape[0]
    apart = balls[:, None] - balls[None]
    length2 = (apart**2).sum(-1) + jnp.eye(n)
    along = apart[..., :, None] * apart[..., None, :] / length2[..., None, None]
    own = jnp.einsum("ijab,ik->iakb", along, jnp.eye(n))
    other = jnp.einsum("ijab->iajb", along)
    return ((own - other) / u_m**2).reshape(3 * n, 3 * n)
