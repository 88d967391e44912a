"""Effects of articulated arms: compliance under gravity, a read-back that lags."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..arrays import Array
from ..chain import Chain
from ..parameters import Parameter
from ..plan import Plan
from ..record import Record
from .base import Effect, Response, Setup
from .registry import register

_KEPT = 1e-2
"""Torque patterns below this share of the strongest one are left out."""


def gravity_levers(chain: Chain, position: np.ndarray, joint: str) -> np.ndarray:
    """Torque about a joint per unit weight at each later frame's origin: (n, later), in m.

    z_j . ((o_k - o_j) x g) with g the unit vector of gravity, for the origins o_k of the frames
    after joint j and of the tool flange.
    """
    j = chain.axes.index(joint)
    rotations, origins, flange = (np.asarray(v) for v in _geometry(chain, position))
    z = rotations[:, j] @ np.asarray(chain.joints[j].direction)
    points = np.concatenate([origins[:, j + 1 :], flange[:, None]], axis=1)
    arms = points - origins[:, j, None]
    return np.einsum("ni,nki->nk", z, np.cross(arms, -np.array(chain.up)))


@eqx.filter_jit
def _geometry(chain: Chain, position: Array) -> tuple[Array, Array, Array]:
    """Nominal joint frames (n, joints, 3, 3), origins (n, joints, 3), flange (n, 3)."""
    zero = jnp.zeros((len(chain.joints), 6))

    def one(q):
        rotations, origins = chain.frames(q)
        return rotations, origins, chain.pose_as_arrays(q, zero)[1]

    return jax.vmap(one)(position)


class _Levers(Record):
    """Independent torque patterns of one joint: levers @ weights, fixed by the plan they are
    derived from, so that other plans use the same parameters.
    """

    weights: np.ndarray
    count: int = eqx.field(static=True)


@register
class JointCompliance(Effect):
    """A joint that yields to gravity: rotation = torque / stiffness about its axis.

    The torque is a sum over the unknown masses behind the joint, z_j . ((o_k - o_j) x g); the
    patterns these give on the plan are reduced by singular value decomposition to independent
    ones of unit rms, so that a parameter is the rms rotation of the joint due to its pattern,
    positive where the place that counts most in it carries a weight.
    """

    name = "joint_compliance"
    summary = "rotation of a joint under the torque of gravity"
    chain: Chain
    levers: _Levers

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"pattern{i + 1}", "urad", sigma=500.0) for i in range(self.levers.count)
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return self.chain.axes

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        own = self.chain.axes.index(self.placement)
        return (*self.chain.axes[own : own + 2],)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        levers = gravity_levers(self.chain, np.asarray(plan.position), self.placement)
        patterns = levers @ self.levers.weights
        return {
            (f"EC{self.placement}", f"pattern{i + 1}"): patterns[:, i]
            for i in range(self.levers.count)
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind != "revolute":
                continue
            levers = gravity_levers(setup.chain, np.asarray(setup.plan.position), joint.name)
            _, s, vt = np.linalg.svd(levers - levers.mean(0), full_matrices=False)
            if s[0] < 1e-6 * np.sqrt(len(levers)):
                continue  # gravity has no changing torque about this joint
            kept = int((s > _KEPT * s[0]).sum())
            # The sign of a singular vector is anyone's: the place that counts most pulls down.
            strongest = vt[np.arange(kept), np.abs(vt[:kept]).argmax(1)]
            weights = vt[:kept].T * np.sign(strongest) / s[:kept] * np.sqrt(len(levers))
            yield cls(chain=setup.chain, levers=_Levers(weights, kept), placement=joint.name)


@register
class ReadbackLag(Effect):
    """Read-back angles taken before the arm had settled: true = read + k (commanded - read).

    One share k for all joints; k = 1 where the arm does end at the command.
    """

    name = "readback_lag"
    summary = "read-back joint angles lag behind the true ones"
    joints: tuple[str, ...] = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("share", "1", sigma=1.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(f"{kind}_{j}" for j in self.joints for kind in ("read", "commanded"))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {
            (f"EC{j}", "share"): plan.covariate(f"commanded_{j}") - plan.x(j) for j in self.joints
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        revolute = tuple(j.name for j in setup.chain.joints if j.kind == "revolute")
        if revolute:
            yield cls(joints=revolute)
