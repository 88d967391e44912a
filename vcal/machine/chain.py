"""Serial kinematic chains of prismatic and revolute joints.

Conventions (stated here once):

- Frames are right-handed; error = actual - nominal.
- A prismatic joint translates by its position along its nominal direction plus its error
  translation, then rotates by its error rotation about its own moving frame. What it carries
  follows.
- A joint on the workpiece side moves against its own command; its errors are in its own frame too.
- A rotary axis (ISO 230-1) is displaced by its error translation and tilted by its error rotation
  about its reference point, then rotates about the displaced and tilted axis. Its errors are in the
  frame of what carries it, and do not rotate with it.
- A revolute joint of an arm rotates by theta + q about z, then has its error twist, then what is
  left of its row: d, a and alpha (standard DH), or d alone (modified DH, where a and alpha come
  before theta). Its errors rotate with it. A prismatic joint of an arm translates by q along z in
  the place of that rotation; its errors move with it.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..numerics.arrays import Array
from ..numerics.record import Record
from ..numerics.rigid import (
    IDENTITY,
    ORIGIN,
    Rotation,
    Scalar,
    Vector,
    about,
    exp,
    left_jacobian,
    left_jacobian_matrix,
    like,
    placement,
    spun,
)
from ..numerics.spatial import rotation
from .plan import Axes

_DIRECTIONS = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_PARALLEL = dict(zip("UVW", _DIRECTIONS.values(), strict=True))
"""Nominal directions of secondary linear axes: U is parallel to X, V to Y, W to Z (ISO 841)."""
_ABOUT = dict(zip("ABC", _DIRECTIONS.values(), strict=True))
"""Nominal directions of rotary axes: A turns about X, B about Y, C about Z (ISO 841)."""
UPRIGHT = "+Z"
"""The axis that points against gravity by default."""
_JOINT = "J"
"""First letter of the names of the joints of an arm."""
Up = str | Sequence[float]
"""The direction against gravity: an axis such as ``"-Z"``, or a vector of any length."""
Convention = Literal["standard", "modified"]
"""Denavit-Hartenberg rows with a and alpha behind the joint, or before it (Craig)."""


class Joint(Record):
    """One joint: its nominal motion, and the frame of its six error ports."""

    name: str = eqx.field(static=True)
    kind: Literal["prismatic", "rotary", "revolute"] = eqx.field(static=True)
    """A linear axis, a rotary axis of a machine tool, or a joint of an arm."""
    side: Literal["tool", "workpiece"] = eqx.field(static=True)
    direction: Float[Array, "3"]
    """Nominal direction of travel or of rotation, in the joint's own frame."""
    before: Float[Array, "4 4"]
    """Fixed transformation in front of the motion."""
    after: Float[Array, "4 4"]
    """Fixed transformation behind the error twist (the link)."""
    travel: Float[Array, "2"]
    """Lowest and highest position, m or rad; infinite where not declared."""

    @property
    def turns(self) -> bool:
        """Whether its position is an angle."""
        return self.kind != "prismatic"

    @property
    def around(self) -> bool:
        """Whether it turns by 360 degrees or more, so that its errors are periodic."""
        low, high = np.asarray(self.travel)
        return self.turns and bool(high - low >= 2.0 * np.pi * (1.0 - 1e-9))

    @property
    def sign(self) -> float:
        """+1 where the joint moves with its command, -1 on the workpiece side."""
        return 1.0 if self.side == "tool" else -1.0


class _Hinge(NamedTuple):
    """Lines and points of the motion and the errors of one joint, in the frame of the bed."""

    drive: Vector
    """Direction of its motion."""
    base: Vector
    """A point on its axis."""
    frame: Rotation
    """Frame in which its error translation acts."""
    origin: Vector
    """Point about which its error rotation turns."""


class Chain(Record):
    """The joints from the workpiece to the tool, split at the bed.

    `tool_side` and `workpiece_side` are ordered from the bed outwards and index `joints`.
    """

    joints: tuple[Joint, ...]
    tool_side: tuple[int, ...] = eqx.field(static=True)
    workpiece_side: tuple[int, ...] = eqx.field(static=True)
    tool_offset: Float[Array, "3"]
    """From the last joint's frame to the tool point, m."""
    text: str = eqx.field(static=True, default="")
    """The declaration of the chain, for reports."""
    up: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 0.0, 1.0))
    """Unit vector against gravity in the frame of the bed, or of an arm's base."""
    coupling: tuple[tuple[float, ...], ...] | None = eqx.field(static=True, default=None)
    """Matrix C from the commands to the positions of the joints, q = C c (SI), where the control
    counts a joint from another one; None: the commands are the positions."""

    @property
    def axes(self) -> Axes:
        """Names of the joints, in the order of a plan's columns."""
        sliding = (j.name for j in self.joints if j.kind == "prismatic" and j.name[0] == _JOINT)
        return Axes((joint.name for joint in self.joints), sliding)

    @property
    def travel(self) -> Float[np.ndarray, "axes 2"]:
        """Lowest and highest position of every axis, m or rad; infinite where not declared."""
        return np.stack([joint.travel for joint in self.joints])

    def joint(self, name: str) -> Joint:
        """A joint by name."""
        return self.joints[self.axes.index(name)]

    def positions(self, command: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n axes"]:
        """Positions of the joints from their commands, q = C c, m or rad."""
        return command if self.coupling is None else command @ np.array(self.coupling).T

    def commands(self, position: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n axes"]:
        """Commands that lead to positions of the joints, c = C^-1 q, m or rad."""
        if self.coupling is None:
            return position
        return np.linalg.solve(np.array(self.coupling), np.asarray(position).T).T

    def pose(
        self, q: Sequence[Scalar], twists: Sequence[Sequence[Scalar]]
    ) -> tuple[Rotation, Vector]:
        """Pose of the last joint's frame in the workpiece frame, T = T_w^-1 T_t, for one row: the
        rotation and the translation (m).

        `q` are the axis positions (m or rad), `twists` six errors per joint (m, rad). The
        derivative is that of a serial chain: every motion displaces what it carries by a
        translation, or by w x (p - origin). Raises `NotImplementedError` where the pose is
        differentiated with respect to the dimensions of the chain.
        """
        return _pose(self, tuple(q), tuple(tuple(twist) for twist in twists))

    def pose_as_arrays(
        self, q: Float[Array, " axes"], twists: Float[Array, "axes 6"]
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """`pose` in arrays: R (3, 3) and t (3,)."""
        _, _, (rt, pt), (rw, pw) = self._as_arrays(q, twists)
        return rw.T @ rt, rw.T @ (pt - pw)

    def jacobian(
        self, q: Float[Array, " axes"], twists: Float[Array, "axes 6"], offset: Float[Array, "3"]
    ) -> tuple[Array, Array, Array, Array]:
        """`pose` in arrays and its derivative by the twists, for a point of the last joint's frame.

        Returns R (3, 3), the point t + R offset (3,), the derivative of the point (3, 6 axes) and
        of the rotation (3, 6 axes; dR = skew(w) R), all in the workpiece frame. This is the
        geometric Jacobian of a serial chain; every column follows from the pose of its joint.
        """
        frame, origin, (rt, pt), (rw, pw) = self._as_arrays(q, twists)
        point = pt + rt @ offset
        side = np.array([joint.sign for joint in self.joints])[:, None, None]
        frame = side * frame
        spin = frame @ jax.vmap(left_jacobian_matrix)(twists[:, 3:])
        arm = jnp.cross(spin, (point - origin)[:, :, None], axis=1)
        moved = jnp.concatenate([frame, arm], 2)
        turned = jnp.concatenate([jnp.zeros_like(frame), spin], 2)
        back = rw.T
        return (
            back @ rt,
            back @ (point - pw),
            back @ jnp.swapaxes(moved, 0, 1).reshape(3, -1),
            back @ jnp.swapaxes(turned, 0, 1).reshape(3, -1),
        )

    def _as_arrays(
        self, q: Float[Array, " axes"], twists: Float[Array, "axes 6"]
    ) -> tuple[Array, Array, tuple[Array, Array], tuple[Array, Array]]:
        """`_frames_along` in arrays: where the errors of every joint act, rotation (axes, 3, 3) and
        origin (axes, 3); the last frame of the tool's side and that of the workpiece's.

        What belongs to one joint is computed for all at once, which halves the compilation.
        """
        ahead, moves, behind, links = self._links(q, twists)
        frames, origins = [jnp.eye(3)] * len(self.joints), [jnp.zeros(3)] * len(self.joints)
        ends = []
        for side in (self.tool_side, self.workpiece_side):
            r, t = jnp.eye(3), jnp.zeros(3)
            for i in side:
                t, r = t + r @ moves[i], r @ ahead[i]
                frames[i], origins[i] = r, t
                t, r = t + r @ links[i], r @ behind[i]
            ends.append((r, t))
        return jnp.stack(frames), jnp.stack(origins), *ends

    def _links(
        self, q: Float[Array, " axes"], twists: Float[Array, "axes 6"]
    ) -> tuple[Array, Array, Array, Array]:
        """Of every joint, from the end of the last one to where its errors act, and from there to
        its own end: rotation (axes, 3, 3) and translation (axes, 3).
        """
        before = jnp.stack([joint.before for joint in self.joints])
        after = jnp.stack([joint.after for joint in self.joints])
        along = jnp.stack([joint.direction * joint.sign for joint in self.joints]) * q[:, None]
        turns = np.array([joint.turns for joint in self.joints])
        first = np.array([joint.kind == "revolute" for joint in self.joints])
        turned = jax.vmap(rotation)(jnp.where(turns[:, None], along, 0.0))
        slid = jnp.where(turns[:, None], 0.0, along)
        ahead = before[:, :3, :3] @ jnp.where(first[:, None, None], turned, jnp.eye(3))
        moved = jnp.einsum("nij,nj->ni", before[:, :3, :3], slid)
        moved += before[:, :3, 3] + jnp.einsum("nij,nj->ni", ahead, twists[:, :3])
        last = jnp.where(first[:, None, None], jnp.eye(3), turned)
        tilted = jax.vmap(rotation)(twists[:, 3:]) @ last
        link = jnp.einsum("nij,nj->ni", tilted, after[:, :3, 3])
        return ahead, moved, tilted @ after[:, :3, :3], link

    def _frames_along(
        self, side: Sequence[int], q: Sequence[Scalar], twists: Sequence[Sequence[Scalar]]
    ) -> tuple[Rotation, Vector, list[_Hinge]]:
        """Pose of the last frame of one side in the frame of the bed, and the joints before it; by
        components, the fastest evaluation over many draws.
        """
        r, t = IDENTITY, ORIGIN
        hinges = []
        for i in side:
            joint, twist = self.joints[i], twists[i]
            turn, shift = placement(joint.before)
            base, r = t + r @ shift, r @ turn
            direction = Vector.of(joint.direction)
            drive = r @ (direction * joint.sign)
            if joint.kind == "prismatic":
                t = base + drive * q[i]
            elif joint.kind == "revolute":
                t, r = base, r @ about(direction, joint.sign * q[i])
            else:
                t = base
            t = t + r @ Vector.of(twist[:3])
            tilted = r @ exp(Vector.of(twist[3:]))
            if joint.kind == "rotary":
                drive, base = tilted @ (direction * joint.sign), t
            hinges.append(_Hinge(drive, base, r, t))
            r = tilted
            if joint.kind == "rotary":
                r = r @ about(direction, joint.sign * q[i])
            turn, shift = placement(joint.after)
            t, r = t + r @ shift, r @ turn
        return r, t, hinges

    def _velocity(
        self,
        side: Sequence[int],
        hinges: Sequence[_Hinge],
        point: Vector,
        twists: Sequence[Sequence[Scalar]],
        dq: Sequence[Scalar],
        dtwists: Sequence[Sequence[Scalar]],
    ) -> tuple[Vector, Vector]:
        """Displacement of a point carried by one side, and the rotation of the last frame."""
        moved, turned = ORIGIN, ORIGIN
        for i, hinge in zip(side, hinges, strict=True):
            spin = hinge.drive * dq[i]
            if self.joints[i].kind == "prismatic":
                moved = moved + spin
            else:
                moved, turned = moved + spin.cross(point - hinge.base), turned + spin
            moved = moved + hinge.frame @ Vector.of(dtwists[i][:3])
            w = hinge.frame @ left_jacobian(Vector.of(twists[i][3:]), Vector.of(dtwists[i][3:]))
            moved, turned = moved + w.cross(point - hinge.origin), turned + w
        return moved, turned

    @property
    def arm(self) -> bool:
        """Whether it is described by joint rows, with link errors that are not small: an arm, also
        on a rail or a column, or a gantry with a head.
        """
        return any(joint.name[0] == _JOINT for joint in self.joints)

    @property
    def linear(self) -> bool:
        """Whether no axis turns."""
        return not any(joint.turns for joint in self.joints)

    def tool_point(self, q: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n 3"]:
        """Nominal tool point in the workpiece frame, m."""
        return self.tool_frame(q)[1]

    def tool_frame(
        self, q: Float[np.ndarray, "n axes"]
    ) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
        """Nominal rotation of the tool and tool point (m) in the workpiece frame."""
        rt, pt = self._nominal(self.tool_side, q)
        rw, pw = self._nominal(self.workpiece_side, q)
        point = np.einsum("nji,nj->ni", rw, pt + rt @ np.asarray(self.tool_offset) - pw)
        return np.swapaxes(rw, 1, 2) @ rt, point

    def flange_frame(
        self, q: Float[np.ndarray, "n axes"]
    ) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
        """Nominal frame after the last joint in the workpiece frame: R and origin (m)."""
        rt, pt = self._nominal(self.tool_side, q)
        rw, pw = self._nominal(self.workpiece_side, q)
        return np.swapaxes(rw, 1, 2) @ rt, np.einsum("nji,nj->ni", rw, pt - pw)

    def turn(self, q: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "n 3 3"]:
        """Nominal rotation from the bed's frame to that of the workpiece."""
        return np.swapaxes(self._nominal(self.workpiece_side, q)[0], 1, 2)

    def frames(
        self, q: Float[np.ndarray, "n axes"]
    ) -> tuple[Float[np.ndarray, "n axes 3 3"], Float[np.ndarray, "n axes 3"]]:
        """Nominal frame of every joint before its motion, in the frame of the bed: R and origin
        (m); for gravity torques.
        """
        placed = {
            i: (r, t)
            for side in (self.tool_side, self.workpiece_side)
            for i, r, t in self._placed(side, q)
        }
        rotations, origins = zip(*(placed[i] for i in range(len(self.joints))), strict=True)
        return np.stack(rotations, 1), np.stack(origins, 1)

    def _nominal(
        self, side: Sequence[int], q: Float[np.ndarray, "n axes"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """`_frames_along` without errors for all rows: R (n, 3, 3) and t (n, 3)."""
        *_, (_, r, t) = self._placed(side, q)
        return r, t

    def _placed(
        self, side: Sequence[int], q: Float[np.ndarray, "n axes"]
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Every joint of a side with its nominal frame before its motion, for all rows; at the end
        -1 with the last frame.

        In numpy, because the first call of every operation of jax takes a compilation, a hundred
        here.
        """
        q = np.asarray(q, float)
        r, t = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        for i in side:
            joint = self.joints[i]
            before, after = np.asarray(joint.before), np.asarray(joint.after)
            motion = q[:, i, None] * np.asarray(joint.direction) * joint.sign
            t, r = t + r @ before[:3, 3], r @ before[:3, :3]
            yield i, r, t
            if joint.turns:
                # Imported here, as the import takes long and only rotary joints need it.
                from scipy.spatial.transform import Rotation as Rotations

                r = r @ Rotations.from_rotvec(motion).as_matrix()
            else:
                t = t + np.einsum("nij,nj->ni", r, motion)
            t, r = t + r @ after[:3, 3], r @ after[:3, :3]
        yield -1, r, t


@eqx.filter_custom_jvp
def _pose(chain: Chain, q, twists):
    rt, pt, _ = chain._frames_along(chain.tool_side, q, twists)
    rw, pw, _ = chain._frames_along(chain.workpiece_side, q, twists)
    return rw.T @ rt, rw.T @ (pt - pw)


@_pose.def_jvp
def _(primals, tangents):
    chain, q, twists = primals
    if jax.tree.leaves(tangents[0]):
        raise NotImplementedError(
            "the pose of a chain has no derivative with respect to the dimensions of the chain; "
            "give them as errors, or differentiate Chain.pose_as_arrays"
        )
    # Arguments that are not varied have no tangent, and drop out of the expression.
    still = lambda v: 0.0 if v is None else v  # noqa: E731
    dq = jax.tree.map(still, tangents[1], is_leaf=lambda v: v is None)
    dtwists = jax.tree.map(still, tangents[2], is_leaf=lambda v: v is None)
    rt, pt, tool = chain._frames_along(chain.tool_side, q, twists)
    rw, pw, work = chain._frames_along(chain.workpiece_side, q, twists)
    moved, turned = chain._velocity(chain.tool_side, tool, pt, twists, dq, dtwists)
    back, undone = chain._velocity(chain.workpiece_side, work, pt, twists, dq, dtwists)
    r, t = rw.T @ rt, rw.T @ (pt - pw)
    slopes = spun(r, rw.T @ (turned - undone)), rw.T @ (moved - back)
    # A constant component is a number; its tangent must have the type of the component.
    return (r, t), jax.tree.map(like, slopes, (r, t))


def chain_from_string(
    text: str,
    travel: Mapping[str, Sequence[float]] | None = None,
    tool_offset_m: Sequence[float] = (0.0, 0.0, 0.0),
    rotary_m: Mapping[str, Sequence[float]] | None = None,
    up: Up = UPRIGHT,
) -> Chain:
    """A machine tool from its ISO 10791-6 description, such as ``"w X b Y Z t"`` or, with rotary
    axes A, B or C, ``"w C A b X Y Z t"``; a quill or a second column is a secondary axis U, V or W,
    parallel to X, Y or Z: ``"w X b Y Z W t"``.

    Axes between ``b`` (bed) and ``t`` (tool) carry the tool, axes between ``w`` (workpiece) and
    ``b`` carry the workpiece. The short form without spaces, with ``F`` or ``b`` for the bed
    (``"XFYZ"``), is accepted too. `travel` is in m or rad. `rotary_m` gives a point on every rotary
    axis with all axes at zero, m: its reference point, about which it tilts. In the frame of the
    machine, the tool point is then at the tool offset `tool_offset_m`, m. `up` is the axis that
    points against gravity, ``"+Y"`` where the spindle is horizontal, or a vector of any length.

    Raises `ValueError` if the string does not start with ``w`` and end with ``t`` with one bed in
    between, if it names an axis twice or one other than X to Z, U to W and A to C, or if the axes
    in `rotary_m` are not the rotary axes of the chain.
    """
    letters = re.findall(r"[A-Za-z]\d*", text)
    if letters and letters[0] != "w" and letters[-1] != "t":
        letters = ["w", *letters, "t"]
    letters = ["b" if letter in ("b", "F") else letter for letter in letters]
    expected = "expected 'w', the table's axes, 'b', the tool's axes, 't', such as 'w X b Y Z t'"
    if len(letters) < 4 or letters[0] != "w" or letters[-1] != "t" or letters.count("b") != 1:
        raise ValueError(f"chain {text!r}: {expected}")
    axes = [letter for letter in letters[1:-1] if letter != "b"]
    for axis in axes:
        beside = _PARALLEL if {*_DIRECTIONS} <= {*axes} else {}
        if axis not in {**_DIRECTIONS, **beside, **_ABOUT}:
            raise ValueError(
                f"chain {text!r}: axis {axis!r} is none of the linear axes X, Y, Z and the rotary "
                "axes A, B, C, nor, in a chain with all of X, Y and Z, of the secondary axes U, V, "
                f"W; {expected}"
            )
        if axes.count(axis) > 1:
            raise ValueError(f"chain {text!r}: axis {axis!r} appears twice; {expected}")
    places = dict(rotary_m or {})
    for axis in sorted({*places} | {*axes} & {*_ABOUT}):
        if axis not in places or axis not in axes or axis not in _ABOUT:
            raise ValueError(
                f"chain {text!r}: found the rotary axis {axis!r} only in "
                f"{'the chain' if axis not in places else 'the positions of rotary axes'}, "
                "expected a position for every rotary axis of the chain; add or remove it"
            )
    bed = letters.index("b")
    order = sorted(axes, key=lambda axis: (axis in _ABOUT, axis))
    joints = []
    for axis in order:
        before, after = np.eye(4), np.eye(4)
        if axis in _ABOUT:
            before[:3, 3] = places[axis]
            after[:3, 3] = -before[:3, 3]
        joints.append(
            Joint(
                name=axis,
                kind="rotary" if axis in _ABOUT else "prismatic",
                side="workpiece" if letters.index(axis) < bed else "tool",
                direction=np.asarray({**_DIRECTIONS, **_PARALLEL, **_ABOUT}[axis]),
                before=before,
                after=after,
                travel=np.asarray((travel or {}).get(axis, (-np.inf, np.inf)), float),
            )
        )
    return Chain(
        joints=tuple(joints),
        tool_side=tuple(order.index(a) for a in letters[bed + 1 : -1]),
        workpiece_side=tuple(order.index(a) for a in reversed(letters[1:bed])),
        tool_offset=np.asarray(tool_offset_m, float),
        text=" ".join(letters) + _standing(up),
        up=_upward(up),
    )


def _upward(up: Up) -> tuple[float, float, float]:
    if isinstance(up, str):
        sign = -1.0 if up[0] == "-" else 1.0
        x, y, z = (0.0 if v == 0.0 else sign * v for v in _DIRECTIONS[up[1]])
        return x, y, z
    length = math.hypot(*up)
    if not (len(up) == 3 and 0.0 < length < math.inf):
        raise ValueError(f"up: found {[*up]}, expected three numbers that are not all zero")
    x, y, z = (0.0 if v == 0.0 else float(v) / length for v in up)
    return x, y, z


def _standing(up: Up) -> str:
    direction = _upward(up)
    if direction == _upward(UPRIGHT):
        return ""
    for name in ("+X", "-X", "+Y", "-Y", "-Z"):
        if direction == _upward(name):
            return f", {name} up"
    return f", ({', '.join(f'{v:.4g}' for v in direction)}) up"


def chain_from_dh(
    rows: Sequence[Mapping[str, float | str]],
    tool_offset_m: Sequence[float] = (0.0, 0.0, 0.0),
    up: Up = UPRIGHT,
    convention: Convention = "standard",
    coupling: Sequence[Sequence[float]] | Float[np.ndarray, "n n"] | None = None,
) -> Chain:
    """A chain from Denavit-Hartenberg rows, base to flange.

    Each row has ``type`` (``"revolute"`` or ``"prismatic"``), ``a`` and ``d`` (m), ``alpha`` and
    ``theta`` (rad). With the ``"standard"`` `convention` T = Rz(theta) Tz(d) Tx(a) Rx(alpha), with
    the ``"modified"`` one (Craig) T = Rx(alpha) Tx(a) Rz(theta) Tz(d). The joint variable is added
    to theta or to d. The error twist acts after the joint's motion and before what follows it in
    the row. Optional ``low`` and ``high`` (m or rad) bound the joint variable. Joints are named J1,
    J2, ... `tool_offset_m` is the tool point in the frame of the flange, m. `up` is the axis of the
    base that points against gravity, ``"-Z"`` for a hanging arm, or a vector of any length.
    `coupling` is the matrix from the commands to the joint variables, in SI.

    Raises `ValueError` for a convention that is not known, and for a coupling that is not an
    invertible matrix of as many rows and columns as joints.
    """
    if convention not in ("standard", "modified"):
        raise ValueError(f"found {convention!r}, expected 'standard' or 'modified'; correct it")
    joints = []
    for i, row in enumerate(rows):
        a, d = float(row.get("a", 0.0)), float(row.get("d", 0.0))
        alpha, theta = float(row.get("alpha", 0.0)), float(row.get("theta", 0.0))
        turn, link, along = np.eye(4), np.eye(4), np.eye(4)
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        turn[:3, :3] = [[ct, -st, 0.0], [st, ct, 0.0], [0.0, 0.0, 1.0]]
        along[2, 3], link[0, 3] = d, a
        link[:3, :3] = [[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]]
        slides = row["type"] == "prismatic"
        first = convention == "modified"
        joints.append(
            Joint(
                name=f"{_JOINT}{i + 1}",
                kind="prismatic" if slides else "revolute",
                side="tool",
                direction=np.asarray(_DIRECTIONS["Z"]),
                before=link @ turn if first else turn,
                after=along if first else along @ link,
                travel=np.asarray([row.get("low", -np.inf), row.get("high", np.inf)], float),
            )
        )
    return chain_of_joints(joints, tool_offset_m, f"{convention} DH", up, coupling)


def chain_of_joints(
    joints: Sequence[Joint],
    tool_offset_m: Sequence[float],
    described: str,
    up: Up = UPRIGHT,
    coupling: Sequence[Sequence[float]] | Float[np.ndarray, "n n"] | None = None,
) -> Chain:
    """An arm of `joints` from base to flange; `described` says in reports how it was given. The
    other arguments and the errors raised are those of `chain_from_dh`.
    """
    matrix = None
    if coupling is not None:
        matrix = tuple(tuple(float(v) for v in row) for row in coupling)
        count = len(joints)
        if len(matrix) != count or any(len(row) != count for row in matrix):
            raise ValueError(
                f"found a coupling of {len(matrix)} rows of {[len(row) for row in matrix]} "
                "numbers, "
                f"expected {count} rows of {count}, one row and one column for every joint"
            )
        if np.linalg.matrix_rank(np.array(matrix)) < count:
            raise ValueError(
                "found a coupling that is not invertible, expected one from which the commands "
                "follow; a row of zeros is a joint that no command moves"
            )
        if np.array_equal(np.array(matrix), np.eye(count)):
            matrix = None
    return Chain(
        joints=tuple(joints),
        tool_side=tuple(range(len(joints))),
        workpiece_side=(),
        tool_offset=np.asarray(tool_offset_m, float),
        text=f"{len(joints)} joints, {described}"
        + (", coupled" if matrix is not None else "")
        + _standing(up),
        up=_upward(up),
        coupling=matrix,
    )
