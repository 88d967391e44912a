"""Effects of articulated arms: compliance under gravity, error motions of joints, a lag of the
read-back.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, Self

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array, namespace
from ..numerics.identity_cache import IdentityCache
from ..numerics.record import Record
from .base import Effect, Response, Setup
from .registry import register

_KEPT = 0.03
"""Patterns of load below this share of the strongest one are left out."""
_OFF_AXIS_M = 0.05
"""Assumed distance of a tool's centre of mass from the axis of the last joint."""
Load = Literal["arm", "tool"]
"""Where the weight that a joint carries acts: on all links behind it, or at the flange."""
_MOMENTS: IdentityCache[np.ndarray] = IdentityCache(32)
"""Moments of the joints of the latest plans."""


def gravity_moments(chain: Chain, position: np.ndarray, joint: str) -> np.ndarray:
    """Moment at a joint per unit weight at each place behind it: (n, places, 3), in m, in the
    frame of the joint after its motion.

    The moment is (c - o_j) x g with g the unit vector of gravity, for c the origins of the frames
    after joint j, the flange, and the contributions of a tool whose centre of mass lies 50 mm off
    the flange along its X and its Y. The third component is the torque about the axis of the joint,
    which its drive holds.
    """
    # Imported here, as the import takes long and only arms need it.
    from scipy.spatial.transform import Rotation as Turn

    j = chain.axes.index(joint)
    rotations, origins = chain.frames(position)
    turned, flange = chain.flange_frame(position)
    points = np.concatenate([origins[:, j + 1 :], flange[:, None]], axis=1)
    off = _OFF_AXIS_M * np.swapaxes(turned[:, :, :2], 1, 2)
    arms = np.concatenate([points - origins[:, j, None], off], axis=1)
    moments = np.einsum("nab,nka->nkb", rotations[:, j], np.cross(arms, -np.array(chain.up)))
    about = np.asarray(chain.joints[j].direction)
    back = Turn.from_rotvec(-position[:, j, None] * chain.joints[j].sign * about)
    return np.einsum("nab,nkb->nka", back.as_matrix(), moments)


def _moments(chain: Chain, plan: Plan, joint: str) -> np.ndarray:
    """`gravity_moments` on a plan, cached since every round of a search asks for them."""
    return _MOMENTS.of(
        (chain, plan, joint), lambda: gravity_moments(chain, np.asarray(plan.position), joint)
    )


def gravity_arms(chain: Chain, plan: Plan, joint: str, load: Load) -> Float[np.ndarray, " n"]:
    """Lever arm, m, of the weight that a joint carries about its axis: torque per unit weight of
    equal masses at the origins behind it and at the flange, or of one at the flange alone.
    """
    arms = _moments(chain, plan, joint)[:, :-2, 2]
    return arms[:, -1] if load == "tool" else arms.mean(1)


def stretched(chain: Chain, plan: Plan, joint: str, load: Load) -> float:
    """The largest possible `gravity_arms`, with all links behind the joint in one line across its
    axis, m. The part of its own link along the axis is no lever: the roll joint of a forearm
    carries no torque from the 300 mm to the wrist. Rounded to a micrometre, so that it is the same
    on every plan.
    """
    j, position = chain.axes.index(joint), np.asarray(plan.position)
    rotations, origins = chain.frames(position)
    _, flange = chain.flange_frame(position)
    links = np.diff(np.concatenate([origins[:, j:], flange[:, None]], axis=1), axis=1)
    axis = rotations[:, j] @ np.asarray(chain.joints[j].direction)
    links[:, 0] -= np.sum(links[:, 0] * axis, axis=1)[:, None] * axis
    away = np.linalg.norm(links, axis=2).max(0).cumsum()
    return round(float(away[-1] if load == "tool" else away.mean()), 6)


class _Patterns(Record):
    """Independent patterns of the load of one joint: moments @ weights.

    The weights are derived from one plan, so that other plans use the same parameters.
    """

    weights: np.ndarray
    shares: tuple[float, ...] = eqx.field(static=True)
    """Strength of each, as a share of the strongest one, with equal masses."""

    @classmethod
    def of(cls, moments: np.ndarray) -> Self | None:
        """Patterns of the varying part of moments (n, places, components); None where it is zero.

        The constant part is a constant error of the link, which is fitted anyway.
        """
        n, places, _ = moments.shape
        changing = np.swapaxes(moments - moments.mean(0), 1, 2).reshape(-1, places)
        _, s, vt = np.linalg.svd(changing, full_matrices=False)
        if s[0] < 1e-6 * np.sqrt(n):
            return None
        kept = int((s > _KEPT * s[0]).sum())
        # The sign of a singular vector is arbitrary: the place with the largest weight pulls down.
        strongest = vt[np.arange(kept), np.abs(vt[:kept]).argmax(1)]
        weights = vt[:kept].T * np.sign(strongest) / s[:kept] * np.sqrt(n)
        return cls(weights, tuple((s[:kept] / s[0]).tolist()))


class _Yielding(Effect):
    """Base class of the compliance of a joint: a rotation in proportion to the moment of gravity.

    The moment is a sum over the unknown masses behind the joint (`gravity_moments`). A singular
    value decomposition reduces the patterns of this sum on the plan to independent ones of unit
    rms, so that a parameter is the rms rotation due to its pattern, positive where the place with
    the largest weight in it carries a mass. The prior standard deviation of each is its size with
    equal masses in all places.

    Patterns belong to the plan from which they were derived. Independent of the plan are the
    products of the moment per unit weight (`gravity_moments`) and one number for every place that
    may carry a weight, in urad/m: ``torsion_flange``, for example; those that end in ``off_x`` and
    ``off_y`` are the contributions of a tool.
    """

    chain: Chain
    torsion: _Patterns | None
    """Patterns of the torque about the axis; None where the drive is stiff."""
    tilt: _Patterns | None
    """Patterns of the moment across it; None where the bearing is stiff."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"{name}{i}", "urad", sigma=usual * share)
            for name, _, patterns, usual in self._parts
            for i, share in enumerate(patterns.shares, start=1)
        )

    @property
    def needs(self) -> tuple[str, ...]:
        return self.chain.axes

    @property
    def amounts_to(self) -> Sequence[tuple[str, str, Mapping[str, float]]]:
        behind = self.chain.axes[self.chain.axes.index(self.placement) + 1 :]
        places = (*behind, "flange", "off_x", "off_y")
        return tuple(
            (
                f"{'torsion' if about == 'C' else 'tilt'}_{place}",
                "urad/m",
                {f"{name}{i}": float(w) for i, w in enumerate(row, start=1)},
            )
            for name, about, patterns, _ in self._parts
            for place, row in zip(places, patterns.weights, strict=True)
        )

    @property
    def indicators(self) -> tuple[str, ...]:
        own = self.chain.axes.index(self.placement)
        return (*self.chain.axes[own : own + 2],)

    @property
    def _parts(self) -> list[tuple[str, str, _Patterns, float]]:
        """Name of the parameters, axes of the rotation, patterns, and prior size of the first."""
        found = []
        if self.torsion is not None:
            found.append(("pattern", "C", self.torsion, 500.0))
        if self.tilt is not None:
            found.append(("tilt", "AB", self.tilt, 200.0))
        return found

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        moments = _moments(self.chain, plan, self.placement)
        found = {}
        for name, about, patterns, _ in self._parts:
            for axis in about:
                turned = moments[:, :, "ABC".index(axis)] @ patterns.weights
                for p, column in enumerate(turned.T, start=1):
                    found[f"E{axis}{self.placement}", f"{name}{p}"] = column
        return found


def _loaded(setup: Setup) -> Iterable[tuple[str, _Patterns | None, _Patterns | None]]:
    """The joints of an arm, with the patterns of their torque and of the moment across them."""
    for joint in setup.chain.joints:
        if joint.kind == "revolute":
            moments = _moments(setup.chain, setup.plan, joint.name)
            yield joint.name, _Patterns.of(moments[:, :, 2:]), _Patterns.of(moments[:, :, :2])


@register
class JointCompliance(_Yielding):
    """A joint whose drive yields to gravity: rotation = torque / stiffness about its axis. Its
    bearing may yield too, as in `bearing_compliance` (parameters tilt1, ...).

    The masses behind the joint and their positions are unknown; the parameters (pattern1, ...)
    belong to patterns of their torque z_j . ((c - o_j) x g), each the rms rotation of the joint due
    to its pattern.
    """

    name = "joint_compliance"
    summary = "rotation of a joint under the torque of gravity"
    remedy = (
        "Check the gear and the balancer of the joint, and the declared mass and centre of mass "
        "of tool and payload; compensate by the control's gravity model."
    )

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        # Where the drive is in the model already, the bearing is a candidate of its own.
        known = {e.placement for e in setup.declared if isinstance(e, _Yielding)}
        for joint, torsion, tilt in _loaded(setup):
            if torsion is None:
                continue
            yield cls(chain=setup.chain, torsion=torsion, tilt=None, placement=joint)
            if tilt is not None and joint not in known:
                yield cls(chain=setup.chain, torsion=torsion, tilt=tilt, placement=joint)


@register
class BearingCompliance(_Yielding):
    """A joint whose bearing, or the link behind it, yields to gravity: it tilts about the axes
    across its own, in the direction of the moment, by moment / stiffness.

    The stiffness is the same in all directions across the axis. As with `joint_compliance`, the
    parameters belong to patterns of the moment, each the rms tilt of the joint due to its pattern.
    """

    name = "bearing_compliance"
    summary = "tilt of a joint across its axis under the moment of gravity"
    remedy = (
        "Check preload, wear and tightening torque of the bearing of the joint; compensate by the "
        "control's gravity model where it has tilts."
    )

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint, _, tilt in _loaded(setup):
            if tilt is not None:
                yield cls(chain=setup.chain, torsion=None, tilt=tilt, placement=joint)


@register
class JointErrorMotion(Effect):
    """Error motion of the axis of rotation of a revolute joint, periodic in its angle (ISO 230-7):
    the radial error motion (EX, EY) and the tilt error motion (EA, EB) as vectors that turn with
    n q in the frame of the joint, the axial error motion (EZ) as a wave, n = 1 or 2.

    Each radial or tilt vector is c (cos n q, sin n q) + s (-sin n q, cos n q); for n = 2 there is
    also one that turns backwards. For n = 1, a backwards vector is a constant error of the link
    before the joint, which is fitted anyway. An error of the angle itself is `gear_harmonic`.
    """

    name = "joint_error_motion"
    summary = "radial, axial and tilt error motion of a joint, periodic in its angle"
    remedy = "Check the seat and the runout of the bearing of the joint; replace a worn bearing."
    uses = ("{axis}",)
    order: int = eqx.field(static=True)

    @property
    def _vectors(self) -> list[tuple[str, str, float, float]]:
        """Name of the parameters, components, sense of rotation, and prior standard deviation."""
        kinds = (("radial", "XY", 20.0), ("tilt", "AB", 100.0))
        ways = (("", 1.0),) if self.order == 1 else (("", 1.0), ("_back", -1.0))
        return [(kind + back, pair, way, size) for kind, pair, size in kinds for back, way in ways]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        usual = [(name, "um" if pair == "XY" else "urad", s) for name, pair, _, s in self._vectors]
        return tuple(
            Parameter(f"{wave}{self.order}_{name}", unit, sigma=sigma)
            for name, unit, sigma in (*usual, ("axial", "um", 20.0))
            for wave in ("sine", "cosine")
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        phase = self.order * plan.x(self.placement)
        xp = namespace(phase)
        sine, cosine = xp.sin(phase), xp.cos(phase)
        moved: Response = {
            (f"EZ{self.placement}", f"sine{self.order}_axial"): sine,
            (f"EZ{self.placement}", f"cosine{self.order}_axial"): cosine,
        }
        for name, (first, second), way, _ in self._vectors:
            along, across = (f"E{c}{self.placement}" for c in (first, second))
            moved[along, f"cosine{self.order}_{name}"] = cosine
            moved[across, f"cosine{self.order}_{name}"] = way * sine
            moved[along, f"sine{self.order}_{name}"] = -way * sine
            moved[across, f"sine{self.order}_{name}"] = cosine
        return moved

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for joint in setup.chain.joints:
            if joint.kind == "revolute":
                for order in (1, 2):
                    yield cls(order=order, placement=joint.name)


@register
class ReadbackLag(Effect):
    """Read-back angles taken before the arm had settled: true = read + k (commanded - read).

    There is one share k for all joints; k = 1 where the arm reaches the command.
    """

    name = "readback_lag"
    summary = "read-back joint angles lag behind the true ones"
    remedy = (
        "Wait until the arm stands still before a reading is taken, or read the joint angles at "
        "the time of the measurement."
    )
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
        plan = setup.plan
        # Where the plan holds the commanded angles, no read-back is used that could lag.
        commanded = all(
            plan.has(name := f"commanded_{j}") and np.array_equal(plan.values(name), plan.values(j))
            for j in revolute
        )
        if revolute and not commanded:
            yield cls(joints=revolute)
