"""Serial kinematic chains of prismatic and revolute joints.

Conventions (stated here once): frames are right-handed; error = actual - nominal. A prismatic joint
translates by its position along its nominal direction plus its error translation, then rotates by
its error rotation about its own moving frame, then comes what it carries. A joint on the workpiece
side moves against its own command, and its errors live in its own frame all the same. A revolute
joint (standard DH) rotates by theta + q about z, then comes the error twist, then d, a, alpha.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .arrays import Array
from .spatial import rotation

_DIRECTIONS = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


class Joint(eqx.Module):
    """One joint: what it does nominally, and where its six error ports act."""

    name: str = eqx.field(static=True)
    kind: Literal["prismatic", "revolute"] = eqx.field(static=True)
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
    def sign(self) -> float:
        """+1 where the joint moves with its command, -1 on the workpiece side."""
        return 1.0 if self.side == "tool" else -1.0

    def transform(
        self, q: Float[Array, ""], twist: Float[Array, "6"]
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Rotation and translation of this joint at position `q` with the error `twist`."""
        r, t = self.before[:3, :3], self.before[:3, 3]
        if self.kind == "prismatic":
            t = t + r @ (self.sign * q * self.direction)
        else:
            r = r @ rotation(self.sign * q * self.direction)
        t = t + r @ twist[:3]
        r = r @ rotation(twist[3:])
        return r @ self.after[:3, :3], t + r @ self.after[:3, 3]


class Chain(eqx.Module):
    """The joints from the workpiece to the tool, split at the bed.

    `tool_side` and `workpiece_side` are ordered from the bed outwards and index `joints`.
    """

    joints: tuple[Joint, ...]
    tool_side: tuple[int, ...] = eqx.field(static=True)
    workpiece_side: tuple[int, ...] = eqx.field(static=True)
    tool_offset: Float[Array, "3"]
    """From the last joint's frame to the tool point, m."""
    text: str = eqx.field(static=True, default="")
    """The chain as it was declared, for reports."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the joints, in the order of a plan's columns."""
        return tuple(joint.name for joint in self.joints)

    def joint(self, name: str) -> Joint:
        """A joint by name."""
        return self.joints[self.axes.index(name)]

    def pose(
        self, q: Float[Array, " axes"], twists: Float[Array, "axes 6"]
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Pose of the last joint's frame in the workpiece frame, T = T_w^-1 T_t, for one row."""
        r, t = jnp.eye(3), jnp.zeros(3)
        for i in self.tool_side:
            rj, tj = self.joints[i].transform(q[i], twists[i])
            r, t = r @ rj, t + r @ tj
        rw, tw = jnp.eye(3), jnp.zeros(3)
        for i in self.workpiece_side:
            rj, tj = self.joints[i].transform(q[i], twists[i])
            rw, tw = rw @ rj, tw + rw @ tj
        return rw.T @ r, rw.T @ (t - tw)

    def frames(self, q: Float[Array, " axes"]) -> tuple[Array, Array]:
        """Nominal frame of every joint before its motion, in the bed frame: R (axes, 3, 3) and
        origin (axes, 3); for gravity torques.
        """
        rotations: list[Array] = [jnp.eye(3)] * len(self.joints)
        origins: list[Array] = [jnp.zeros(3)] * len(self.joints)
        for side in (self.tool_side, self.workpiece_side):
            r, t = jnp.eye(3), jnp.zeros(3)
            for i in side:
                before = self.joints[i].before
                rotations[i], origins[i] = r @ before[:3, :3], t + r @ before[:3, 3]
                rj, tj = self.joints[i].transform(q[i], jnp.zeros(6))
                r, t = r @ rj, t + r @ tj
        return jnp.stack(rotations), jnp.stack(origins)


def chain_from_string(
    text: str,
    travel_m: Mapping[str, Sequence[float]] | None = None,
    tool_offset_m: Sequence[float] = (0.0, 0.0, 0.0),
) -> Chain:
    """A chain of linear axes from its ISO 10791-6 description, such as ``"w X b Y Z t"``.

    Everything between ``b`` (bed) and ``t`` (tool) carries the tool, everything between ``w``
    (workpiece) and ``b`` carries the workpiece. The seeds' way to write the same without spaces
    and with ``F`` or ``b`` for the bed (``"XFYZ"``) is understood too.

    Raises `ValueError` if the string does not start at ``w`` and end at ``t`` with one bed in
    between, or names an axis twice or one that is not X, Y or Z.
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
        if axis not in _DIRECTIONS:
            raise ValueError(
                f"chain {text!r}: axis {axis!r} is not one of X, Y, Z; {expected} "
                "(give other joints as [[machine.joint]] rows)"
            )
        if axes.count(axis) > 1:
            raise ValueError(f"chain {text!r}: axis {axis!r} appears twice; {expected}")
    bed = letters.index("b")
    order = sorted(axes)
    joints = tuple(
        Joint(
            name=axis,
            kind="prismatic",
            side="workpiece" if letters.index(axis) < bed else "tool",
            direction=np.asarray(_DIRECTIONS[axis]),
            before=np.eye(4),
            after=np.eye(4),
            travel=np.asarray((travel_m or {}).get(axis, (-np.inf, np.inf)), float),
        )
        for axis in order
    )
    return Chain(
        joints=joints,
        tool_side=tuple(order.index(a) for a in letters[bed + 1 : -1]),
        workpiece_side=tuple(order.index(a) for a in reversed(letters[1:bed])),
        tool_offset=np.asarray(tool_offset_m, float),
        text=" ".join(letters),
    )


def chain_from_dh(
    rows: Sequence[Mapping[str, float | str]], tool_offset_m: Sequence[float] = (0.0, 0.0, 0.0)
) -> Chain:
    """A chain from standard Denavit-Hartenberg rows, base to flange.

    Each row: ``type`` (``"revolute"`` or ``"prismatic"``), ``a``, ``d`` (m), ``alpha``, ``theta``
    (rad); the joint variable is added to theta or to d. T = Rz(theta) Tz(d) Tx(a) Rx(alpha). The
    error twist acts behind the joint's motion and before the link. Optional ``low`` and ``high``
    bound the joint variable. Joints are named J1, J2, ...
    """
    joints = []
    for i, row in enumerate(rows):
        a, d = float(row.get("a", 0.0)), float(row.get("d", 0.0))
        alpha, theta = float(row.get("alpha", 0.0)), float(row.get("theta", 0.0))
        before, after = np.eye(4), np.eye(4)
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        before[:3, :3] = [[ct, -st, 0.0], [st, ct, 0.0], [0.0, 0.0, 1.0]]
        after[:3, 3] = a, 0.0, d
        after[:3, :3] = [[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]]
        joints.append(
            Joint(
                name=f"J{i + 1}",
                kind="prismatic" if row["type"] == "prismatic" else "revolute",
                side="tool",
                direction=np.asarray(_DIRECTIONS["Z"]),
                before=before,
                after=after,
                travel=np.asarray([row.get("low", -np.inf), row.get("high", np.inf)], float),
            )
        )
    return Chain(
        joints=tuple(joints),
        tool_side=tuple(range(len(joints))),
        workpiece_side=(),
        tool_offset=np.asarray(tool_offset_m, float),
        text=f"{len(joints)} joints, standard DH",
    )
