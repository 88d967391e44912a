"""Columns of the joints of an arm: commanded and read-back positions, and moves between poses."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from ..machine.chain import Chain
from ..machine.plan import Plan, slides
from ..numerics.arrays import Array, namespace
from .base import Column
from .conditions import file_column, inside_name

_FARTHEST = {True: 1e5, False: 720.0}
"""Farthest position of a prismatic joint, mm, and of another one, deg; larger numbers are in
another unit."""
_KINDS: tuple[Literal["commanded", "read"], ...] = ("commanded", "read")


def arm_columns(axes: Sequence[str], joints: str) -> list[Column]:
    """The number of the pose and the commanded positions of all joints; with ``joints = "read"``,
    those that were read back too.
    """
    kinds = _KINDS if joints == "read" else _KINDS[:1]
    found = [Column(name="pose", low=0, integer=True, unique_with=("pose",))]
    for axis in axes:
        most = _FARTHEST[slides(axes, axis)]
        names = (file_column(f"{kind}_{axis}", axes)[0] for kind in kinds)
        found += [Column(name=name, low=-most, high=most) for name in names]
    return found


def arm_plan(
    chain: Chain, table: Mapping[str, np.ndarray], joints: str, readings: Collection[str]
) -> Plan:
    """The plan of an arm: positions of the joints, their latest moves, time, temperatures and all
    other recorded columns except the `readings`.
    """
    commanded = _positions(chain, table, "commanded")
    pose = np.asarray(table["pose"], int)
    move, direction = (np.asarray(v) for v in moves(commanded, pose))
    covariates: dict[str, np.ndarray] = {"order": pose.astype(float)}
    position = commanded
    if all(file_column(f"read_{axis}", chain.axes)[0] in table for axis in chain.axes):
        read = _positions(chain, table, "read")
        covariates |= {f"read_{axis}": read[:, i] for i, axis in enumerate(chain.axes)}
        position = read if joints == "read" else commanded
    for i, axis in enumerate(chain.axes):
        covariates[f"commanded_{axis}"] = commanded[:, i]
        covariates[f"dir_{axis}"] = direction[:, i]
        covariates[f"move_{axis}"] = move[:, i]
    own = re.compile(r"q\d+_(cmd|read)_\w+|pose")
    covariates |= {
        inside_name(name, chain.axes): values
        for name, values in table.items()
        if name not in readings and not own.fullmatch(name)
    }
    return Plan(chain.axes, position, covariates, {"pose": pose})


def arm_table(plan: Plan, commands: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of the joints in file units: the inverse of `arm_plan`. `commands` computes commands
    from positions of the joints (n, joints), m or rad (`Chain.commands`).
    """
    table: dict[str, np.ndarray] = {"pose": np.asarray(plan.groups["pose"])}
    for kind in _KINDS:
        names = [f"{kind}_{axis}" for axis in plan.axes]
        if any(name not in plan.covariates for name in names):
            continue
        columns = commands(np.column_stack([plan.covariates[name] for name in names]))
        for name, values in zip(names, columns.T, strict=True):
            column, factor = file_column(name, plan.axes)
            table[column] = values * factor
    return table


def moves(
    angle: Float[Array, "n joints"], pose: Int[np.ndarray, " n"]
) -> tuple[Float[Array, "n joints"], Float[Array, "n joints"]]:
    """The move of every joint into every pose, rad, and the direction of its latest move: +1, -1.

    The rows may be in any order: the numbers of the poses give their sequence. A joint that does
    not move keeps its direction. The move into the first pose, and into one after a gap in the
    numbering, is unknown and set to zero, and so is the direction until the next move.
    """
    xp = namespace(angle)
    in_time = np.argsort(pose, kind="stable")
    pose, angle, own = pose[in_time], angle[in_time], np.argsort(in_time)
    known = np.r_[False, np.diff(pose) == 1][:, None]
    move = xp.where(known, xp.diff(angle, axis=0, prepend=angle[:1]), 0.0)
    row = np.arange(len(pose))[:, None]
    last = xp.maximum.accumulate(xp.where(known & (move == 0.0), 0, row), axis=0)
    return move[own], xp.sign(xp.take_along_axis(move, last, axis=0))[own]


def _positions(
    chain: Chain, table: Mapping[str, np.ndarray], kind: Literal["commanded", "read"]
) -> np.ndarray:
    """Positions of the joints (n, joints), m or rad, from their columns."""
    columns = (file_column(f"{kind}_{axis}", chain.axes) for axis in chain.axes)
    return chain.positions(np.column_stack([table[name] / factor for name, factor in columns]))
