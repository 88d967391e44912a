"""Effects of articulated arms: compliance under gravity, a read-back that lags."""

from collections.abc import Iterable, Mapping
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation as Turn

from ..arrays import Array
from ..chain import Chain
from ..parameters import Parameter
from ..plan import Plan
from ..record import Record
from .base import Effect, Response, Setup
from .registry import register

_KEPT = 0.03
"""Patterns of load below this share of the strongest one are left out."""
_OFF_AXIS_M = 0.05
"""How far from the axis of the last joint the centre of mass of a tool is expected."""


def gravity_moments(chain: Chain, position: np.ndarray, joint: str) -> np.ndarray:
    """Moment at a joint per unit weight at each place behind it: (n, places, 3), in m, in the
    frame of the joint after its motion.

    (c - o_j) x g with g the unit vector of gravity, for c the origins of the frames after joint j,
    the flange, and what a tool adds whose centre of mass lies 50 mm off the flange along its X and
    its Y.
    """
    j = chain.axes.index(joint)
    rotations, origins, turned, flange = (np.asarray(v) for v in _geometry(chain, position))
    points = np.concatenate([origins[:, j + 1 :], flange[:, None]], axis=1)
    off = _OFF_AXIS_M * np.swapaxes(turned[:, :, :2], 1, 2)
    arms = np.concatenate([points - origins[:, j, None], off], axis=1)
    moments = np.einsum("nab,nka->nkb", rotations[:, j], np.cross(arms, -np.array(chain.up)))
    about = np.asarray(chain.joints[j].direction)
    back = Turn.from_rotvec(-position[:, j, None] * chain.joints[j].sign * about)
    return np.einsum("nab,nkb->nka", back.as_matrix(), moments)


def gravity_levers(chain: Chain, position: np.ndarray, joint: str) -> np.ndarray:
    """Torque about a joint per unit weight at each place behind it: (n, places), in m; that part
    of `gravity_moments` which its drive holds.
    """
    about = np.asarray(chain.joints[chain.axes.index(joint)].direction)
    return gravity_moments(chain, position, joint) @ about


@eqx.filter_jit
def _geometry(chain: Chain, position: Array) -> tuple[Array, Array, Array, Array]:
    """Nominal joint frames (n, joints, 3, 3), origins (n, joints, 3), flange (n, 3, 3), (n, 3)."""
    zero = jnp.zeros((len(chain.joints), 6))
    return jax.vmap(lambda q: (*chain.frames(q), *chain.pose_as_arrays(q, zero)))(position)


class _Patterns(Record):
    """Independent patterns of the load of one joint: moments @ weights, fixed by the plan they are
    derived from, so that other plans use the same parameters.
    """

    weights: np.ndarray
    shares: tuple[float, ...] = eqx.field(static=True)
    """How strong each is, of the strongest one, where all masses are alike."""

    @property
    def count(self) -> int:
        return len(self.shares)

    @classmethod
    def of(cls, moments: np.ndarray) -> Self | None:
        """Those of moments (n, places, components) that change; None where none does.

        What does not change is a constant error of the link, which is fitted anyway.
        """
        n, places, _ = moments.shape
        changing = np.swapaxes(moments - moments.mean(0), 1, 2).reshape(-1, places)
        _, s, vt = np.linalg.svd(changing, full_matrices=False)
        if s[0] < 1e-6 * np.sqrt(n):
            return None
        kept = int((s > _KEPT * s[0]).sum())
        # The sign of a singular vector is anyone's: the place that counts most pulls down.
        strongest = vt[np.arange(kept), np.abs(vt[:kept]).argmax(1)]
        weights = vt[:kept].T * np.sign(strongest) / s[:kept] * np.sqrt(n)
        return cls(weights, tuple((s[:kept] / s[0]).tolist()))


class _Yielding(Effect):
    """A joint that yields to what it carries: a rotation in proportion to the moment of gravity.

    The moment is a sum over the unknown masses behind the joint (`gravity_moments`); the patterns
    these give on the plan are reduced by singular value decomposition to independent ones of unit
    rms, so that a parameter is the rms rotation due to its pattern, positive where the place that
    counts most in it carries a weight. Each is expected as large as masses make it that are alike
    wherever they are.
    """

    _about: ClassVar[str]
    """The axes of the joint's frame about which it yields."""
    _usual: ClassVar[float]
    """Size that is expected, urad."""
    chain: Chain
    levers: _Patterns

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"pattern{i}", "urad", sigma=self._usual * share)
            for i, share in enumerate(self.levers.shares, start=1)
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return self.chain.axes

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        own = self.chain.axes.index(self.placement)
        return (*self.chain.axes[own : own + 2],)

    @classmethod
    def _moments(cls, chain: Chain, position: np.ndarray, joint: str) -> np.ndarray:
        about = ["ABC".index(axis) for axis in cls._about]
        return gravity_moments(chain, position, joint)[:, :, about]

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        moments = self._moments(self.chain, np.asarray(plan.position), self.placement)
        patterns = np.einsum("nkc,kp->ncp", moments, self.levers.weights)
        return {
            (f"E{axis}{self.placement}", f"pattern{p + 1}"): patterns[:, c, p]
            for c, axis in enumerate(self._about)
            for p in range(self.levers.count)
        }

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind != "revolute":
                continue
            position = np.asarray(setup.plan.position)
            levers = _Patterns.of(cls._moments(setup.chain, position, joint.name))
            if levers is not None:
                yield cls(chain=setup.chain, levers=levers, placement=joint.name)


@register
class JointCompliance(_Yielding):
    """A joint whose drive yields to gravity: rotation = torque / stiffness about its axis.

    The masses behind the joint are unknown, and where they are; patterns of the torque they give,
    z_j . ((c - o_j) x g), are the parameters, each the rms rotation of the joint due to it.
    """

    name = "joint_compliance"
    summary = "rotation of a joint under the torque of gravity"
    _about = "C"
    _usual = 500.0


@register
class BearingCompliance(_Yielding):
    """A joint whose bearing, or the link behind it, yields to gravity: it tilts about the axes
    across its own, in the direction of the moment, by moment / stiffness.

    The stiffness is the same in all directions across the axis. As with `joint_compliance`, the
    parameters are patterns of the moment, each the rms tilt of the joint due to it.
    """

    name = "bearing_compliance"
    summary = "tilt of a joint across its axis under the moment of gravity"
    _about = "AB"
    _usual = 200.0


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
