"""Information of ball artefacts: the effect of poses and shape on the uncertainty of a machine.

A touch measures the tool point relative to the ball. For a pose k with readings r_k

    r_k = J_k theta + A_k p_k + B_k e (+ probing),        p_k flat, e ~ (0, K^-1)

theta are the amplitudes of the machine, p_k the unknown pose and e the errors of the calibrated
ball centres, either *shared* by all poses (one artefact) or *fresh* in every pose (heat, handling).
Poses are eliminated one by one, then the ball errors, so that the cost grows linearly with the
number of poses and not with its cube. Everything is differentiable by balls and poses.

The calibration of the artefact is given by its centres (`balls_precision`), or by the distances of
all pairs of balls (`pairs_precision`). The latter contain no information about the position of the
artefact and, for a straight artefact, about its shape across its line.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Float

from ...identification.posterior import by_root, eliminated, fresh_scatter, precision, slopes
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...model.forward import Model, tool_points_with_jacobian
from ...numerics.arrays import Array
from ...numerics.spatial import skew

LOOSE_M = 1e-3
"""Standard deviation of a ball centre without any other knowledge."""
_OPEN = 1e-10
"""Share of the largest information of a pose below which a direction counts as unobserved."""

DERIVED = (
    *(f"gravity_{c}" for c in "xyz"),
    *(f"ball_{c}" for c in "xyz"),
    "tilt",
    "along_beam",
)
"""Covariates that follow from the poses and the artefact (`derived`)."""


class ArrayPoses(eqx.Module):
    """An artefact of N balls in m poses; lengths in m."""

    balls: Float[Array, "N 3"]
    """Ball centres in the artefact's frame."""
    rotation: Float[Array, "m 3 3"]
    origin: Float[Array, "m 3"]
    """Origin of the artefact's frame in the workpiece frame."""
    tool: Float[Array, "m N 3"] | None = None
    """Tool of every touch, from the last axis; that of the chain by default."""

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


class Conditions(NamedTuple):
    """The conditions of the touches, and the numbers of their poses and balls."""

    pose: tuple[int, ...]
    ball: tuple[int, ...]
    covariates: Mapping[str, Float[Array, "m N"]]
    """SI, as in a plan."""

    @classmethod
    def none(cls, poses: ArrayPoses) -> "Conditions":
        """No conditions; poses and balls are counted from zero."""
        m, n = poses.rotation.shape[0], poses.balls.shape[0]
        return cls(tuple(range(m)), tuple(range(n)), {})


def derived(
    poses: ArrayPoses, beam: Float[np.ndarray, "3"], up: Sequence[float]
) -> dict[str, Float[Array, "m N"]]:
    """Covariates that follow from the poses and the artefact.

    These are the direction of gravity, opposite to `up` in the machine frame, the positions of the
    balls in the artefact's frame, and the positions along `beam`, the direction of its long axis.
    """
    m, n = poses.rotation.shape[0], poses.balls.shape[0]
    down = -jnp.einsum("i,mij->mj", jnp.asarray(up), poses.rotation)
    arm = poses.balls - poses.balls.mean(0)
    along = arm @ beam
    along = (along - along.min()) / (along.max() - along.min())
    found: dict[str, Array] = {f"gravity_{c}": down[:, i, None] for i, c in enumerate("xyz")}
    found["tilt"] = jnp.arcsin(jnp.clip(-down @ beam, -1.0, 1.0))[:, None]
    found["along_beam"] = along[None]
    found |= {f"ball_{c}": poses.balls[None, :, i] for i, c in enumerate("xyz")}
    return {name: jnp.broadcast_to(values, (m, n)) for name, values in found.items()}


def touches(model: Model, poses: ArrayPoses, conditions: Conditions | None = None) -> Touches:
    """Exact derivatives of tool point minus ball centre at the nominal machine.

    `model` provides the chain and the effects of machine and artefact; of its instrument only the
    ports are used. The axes of the chain have to be X, Y and Z in any order. Raises `KeyError` for
    an effect with a covariate that the `conditions` lack.
    """
    return _touched(model, poses, conditions or Conditions.none(poses))[0]


def probed(
    model: Model, poses: ArrayPoses, probe_m: float, conditions: Conditions | None = None
) -> Touches:
    """`touches` in standard deviations of a touch, including random effects: the covariance of a
    touch is probe^2 I plus that of the random effects of the model.
    """
    seen, scatter = _touched(model, poses, conditions or Conditions.none(poses))
    if not model.random:
        return Touches(*(part / probe_m for part in seen))
    m, n = poses.rotation.shape[0], poses.balls.shape[0]
    noise = jnp.broadcast_to(probe_m**2 * jnp.eye(3), (m * n, 3, 3))
    whole = jnp.concatenate([part.reshape(m * n, 3, -1) for part in seen], -1)
    whole = by_root(noise, scatter, whole).reshape(m, 3 * n, -1)
    ends = np.cumsum([part.shape[-1] for part in seen])[:-1]
    return Touches(*jnp.split(whole, ends, axis=-1))


def without_poses(whitened: Touches) -> Float[Array, "m n k+n"]:
    """Derivatives by the amplitudes, then by the balls, with the unknown poses projected out.

    Balls on a line leave the rotation about it undetermined in any frame. It moves no ball, so that
    nothing is projected out for it.
    """
    J, A, B = whitened
    # Metres and radians of a pose are scaled alike in all directions before the projection, so that
    # the undetermined direction does not depend on the frame.
    square = (A**2).sum(1).reshape(-1, 2, 3).sum(-1)
    A = A / jnp.sqrt(jnp.repeat(jnp.where(square > 0.0, square, 1.0), 3, axis=1))[:, None]
    both = jnp.concatenate([J, B], -1)
    own = A.swapaxes(1, 2) @ A + _OPEN * jnp.eye(A.shape[-1])
    return both - A @ jnp.linalg.solve(own, A.swapaxes(1, 2) @ both)


def _touched(
    model: Model, poses: ArrayPoses, conditions: Conditions
) -> tuple[Touches, Float[Array, "rows 3 r"]]:
    """`touches`, and the change of each touch by one standard deviation of every random effect."""
    m, n = poses.rotation.shape[0], poses.balls.shape[0]
    chain, layout = model.chain, model.layout
    place = jnp.asarray(poses.position(chain)).reshape(m * n, 3)
    order = ["XYZ".index(axis) for axis in chain.axes]
    number = {"pose": np.repeat(conditions.pose, n), "ball": np.tile(conditions.ball, m)}
    known = {name: jnp.reshape(values, m * n) for name, values in conditions.covariates.items()}
    plan = Plan(chain.axes, place[:, np.array(order)], known, number)
    ports = jnp.zeros((m * n, len(layout)))
    if poses.tool is not None:
        other = poses.tool.reshape(m * n, 3) - jnp.asarray(chain.tool_offset)
        ports = ports.at[:, layout.slice("tool").start + np.arange(3)].set(other)
    _, by_port = tool_points_with_jacobian(chain, jnp.asarray(plan.position), ports)
    # ball = origin + R exp(w) (b + e)
    turned = jax.vmap(lambda r: jax.vmap(lambda b: r @ skew(b))(poses.balls))(poses.rotation)
    still = jnp.broadcast_to(-jnp.eye(3), (m, n, 3, 3))
    by_ball = jnp.einsum("mab,nl->mnalb", -poses.rotation, jnp.eye(n))
    by_pose = jnp.concatenate([still, turned], -1)
    own = {"target": by_pose.reshape(m * n, 3, 6), "read": jnp.eye(3)}
    own["ball"] = jnp.repeat(-poses.rotation, n, axis=0)
    for group, slope in own.items():
        if any(name.startswith(f"{group}.") for name in layout.names):
            by_port = jnp.asarray(by_port).at[:, :, layout.slice(group)].set(slope)
    seen = Touches(
        slopes(model.effects, model, plan, by_port).reshape(m, 3 * n, -1),
        by_pose.reshape(m, 3 * n, 6),
        by_ball.reshape(m, 3 * n, 3 * n),
    )
    return seen, fresh_scatter(model, plan, by_port)


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

    `probe_m` is the standard deviation of a touch in every direction, m; `known` the precision K of
    the ball errors, 1/m^2; `fresh` whether every pose has its own ball errors; `often` the number
    of set-ups in each pose (one by default), where zero leaves a pose out.
    """
    own, known = precision(model), loosened(known)
    both = without_poses(Touches(*(part / probe_m for part in seen)))
    times = jnp.ones(len(both)) if often is None else often
    if not fresh:
        return eliminated(jnp.einsum("m,mni,mnj->ij", times, both, both), own, known)
    left = _each_without_balls(both, own, known)
    return jnp.einsum("m,mkl->kl", times, left) + own


class PoseInformation(NamedTuple):
    """The information of every single pose of an artefact, with its unknown pose eliminated.

    The information of a set of poses is the sum of their matrices and the prior. The first of the
    `c` unknowns are the machine's amplitudes in solver units; the last are the errors of the ball
    centres, in mm, where all poses share them.
    """

    information: Float[Array, "m c c"]
    precision: Float[Array, "c c"]

    def padded(self, gram: Float[Array, "k k"]) -> Float[Array, "c c"]:
        """A quadratic form of the amplitudes, extended by zeros for the ball errors."""
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

    Ball errors that are fresh in every pose are eliminated with it. Shared ones stay, as their
    elimination would couple the poses.
    """
    own, known = jnp.asarray(precision(model)), loosened(known)
    both = without_poses(Touches(*(part / probe_m for part in seen)))
    if fresh:
        return PoseInformation(_each_without_balls(both, own, known), own)
    unit = jnp.concatenate([jnp.ones(len(own)), jnp.full(len(known), LOOSE_M)])
    rows = both * unit
    return PoseInformation(rows.swapaxes(1, 2) @ rows, block_diag(own, known * LOOSE_M**2))


def _each_without_balls(
    both: Float[Array, "m n c"], own: Float[Array, "k k"], known: Float[Array, "n n"]
) -> Float[Array, "m k k"]:
    """Information of every pose, with its own ball errors eliminated."""
    each = both.swapaxes(1, 2) @ both
    return jax.vmap(lambda joint: eliminated(joint, jnp.zeros_like(own), known))(each)


def loosened(known: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A precision of ball errors with the minimal knowledge that every ball is within about a
    millimetre of its position.
    """
    return known + jnp.eye(known.shape[0]) / LOOSE_M**2


def balls_precision(count: int, u_m: float) -> Float[Array, "n n"]:
    """K of ball centres with independent standard uncertainties `u_m` of their coordinates."""
    return jnp.eye(3 * count) / u_m**2


def pairs_precision(balls: Float[Array, "N 3"], u_m: float) -> Float[Array, "n n"]:
    """K of calibrated distances of all pairs, with independent standard uncertainties `u_m`:
    sum over pairs of w w' / u^2, with w the direction of the pair at one ball and its negative at
    the other.
    """
    n = balls.shape[0]
    apart = balls[:, None] - balls[None]
    length2 = (apart**2).sum(-1) + jnp.eye(n)
    along = apart[..., :, None] * apart[..., None, :] / length2[..., None, None]
    own = jnp.einsum("ijab,ik->iakb", along, jnp.eye(n))
    other = jnp.einsum("ijab->iajb", along)
    return ((own - other) / u_m**2).reshape(3 * n, 3 * n)
