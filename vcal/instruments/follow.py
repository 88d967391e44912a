"""Axis positions that follow a point of the workpiece, and checks that readings follow the axes, by
the nominal kinematics of the machine.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..errors import RowError
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..words import plural
from .conditions import LINEAR, ROTARY, file_column

_MOST_OFF = 0.02
"""Largest plausible error of a machine, as a share of the size of the measured region."""
_PLANE = 2
"""Least dimension of the measured region for a comparison of readings with linear axes."""
_LEAST_M = 1e-3
"""Plausible distance in a region of any size: the declared position of a rotary axis is
approximate."""

_HALF, _FAR = 0.5, 0.5
"""Largest relative error of the motion of readings; and least motion that is compared, as a share
of the largest."""
_CHANGES = (
    (1e3, "metres turned into millimetres"),
    (1e-3, "micrometres turned into millimetres"),
    (-1.0, "the other sign"),
)


def followed(
    chain: Chain, position: Float[Array, "n axes"], point: Float[Array, "n 3"]
) -> Float[Array, "n axes"]:
    """Positions at which the nominal tool point is at `point` (m, in the frame of the workpiece):
    the linear axes follow, the others keep the angles in `position` (rad). It may be traced.

    At constant angles, the tool point t is linear in the positions x of the linear axes::

        t(x) = t(0) + M x,        x = M^-1 (point - t(0))

    The machine needs three linear axes with no rotary axis between any two of them
    (`carried_apart`): M is then orthogonal.
    """
    linear = [i for i, axis in enumerate(chain.axes) if axis in LINEAR]
    still = jnp.zeros((len(chain.joints), 6))
    units = jnp.eye(len(chain.axes))[np.array(linear)]

    def one(q: Float[Array, " axes"], at: Float[Array, "3"]) -> Float[Array, " axes"]:
        def tool(q: Float[Array, " axes"]) -> Float[Array, "3"]:
            rotation, t = chain.pose_as_arrays(q, still)
            return t + rotation @ chain.tool_offset

        rest = jnp.asarray(q).at[np.array(linear)].set(0.0)
        start = tool(rest)
        moved = jax.vmap(lambda unit: tool(rest + unit) - start)(units)
        return rest + units.T @ (moved @ (at - start))

    return jax.vmap(one)(jnp.asarray(position), jnp.asarray(point))


def carried_apart(chain: Chain) -> str:
    """The rotary axis between two linear axes; empty where there is none."""
    order = [*reversed(chain.workpiece_side), *chain.tool_side]
    turning = [chain.axes[i] for i in order]
    places = [k for k, axis in enumerate(turning) if axis in LINEAR]
    between = turning[min(places, default=0) : max(places, default=0)]
    return next((axis for axis in between if axis not in LINEAR), "")


def check_follows(
    chain: Chain,
    plan: Plan,
    off: Callable[[np.ndarray], np.ndarray],
    columns: str,
    beside: str = "the machine",
) -> None:
    """Check that readings agree with the tool points at the axis positions.

    `off` gives the distance (n,), m, of every reading from nominal tool points (n, 3) in the
    workpiece frame, after the unknown rigid motions are fitted. The median is compared, since a few
    outliers are removed later. Raises `RowError`, which names the columns in another unit, or the
    one with another sign, where that alone is the cause; otherwise it asks to compare the columns
    with the things named in `beside`.
    """
    position = np.asarray(plan.position)
    linear = position[:, [axis in LINEAR for axis in plan.axes]]
    apart = linear - linear.mean(0)
    if chain.linear and np.linalg.matrix_rank(apart, tol=_LEAST_M) < _PLANE:
        return
    size = np.linalg.norm(apart, axis=1).max()
    allowed = max(_MOST_OFF * size, _LEAST_M)
    found = off(chain.tool_point(position))
    if np.median(found) <= allowed:
        return
    row = int(np.argmax(found))
    raise RowError(
        row,
        columns,
        f"a reading {1e3 * found[row]:.4g} mm away from the tool point at the axis positions, in "
        f"half of the rows more than {1e3 * np.median(found):.4g} mm",
        f"readings that follow the positions to {1e3 * allowed:.4g} mm",
        cause(chain, plan.axes, position, off, allowed)
        or "compare signs, units and order of the columns of positions and readings, "
        f"{'' if chain.linear else 'at_mm of the rotary axes, '}tool_offset_mm and the chain with "
        f"{beside}",
    )


def check_moves(
    readings: Float[np.ndarray, "n m"],
    expected: Float[np.ndarray, "n m"],
    run: Int[np.ndarray, " n"],
    columns: Sequence[str],
) -> None:
    """Check that readings (m) move with the axes within every run, apart from a constant: a column
    is wrong where its motion differs by more than half in half of the rows that are far from the
    mean of their run. No machine has such an error.

    Raises `RowError`, which names a unit, a sign or the order of the columns where that alone is
    the cause.
    """
    index = np.unique(run, return_inverse=True)[1]

    def about(values: np.ndarray) -> np.ndarray:
        sums = np.zeros((index.max() + 1, values.shape[1]))
        np.add.at(sums, index, values)
        return values - (sums / np.bincount(index)[:, None])[index]

    seen, moved = about(readings), about(expected)
    far = np.abs(moved) > _FAR * np.abs(moved).max()

    def follows(values: np.ndarray, i: int) -> bool:
        rows = far[:, i]
        off = np.abs(values[rows] - moved[rows, i]) / np.abs(moved[rows, i])
        return not len(off) or float(np.median(off)) <= _HALF

    wrong = [i for i in range(len(columns)) if not follows(seen[:, i], i)]
    if not wrong:
        return
    named = ", ".join(columns[i] for i in wrong)
    causes = [
        f"{words} in {named}"
        for factor, words in _CHANGES
        if all(follows(factor * seen[:, i], i) for i in wrong)
    ] + [
        f"the columns in the order {', '.join(columns[k] for k in order)}"
        for order in itertools.permutations(range(len(columns)))
        if all(follows(seen[:, k], i) for i, k in enumerate(order))
    ]
    off = np.where(far, np.abs(seen - moved), 0.0)[:, wrong]
    row, place = np.unravel_index(int(np.argmax(off)), off.shape)
    at = row, wrong[place]
    raise RowError(
        int(row),
        f"{plural(len(wrong), 'column')} {named}",
        f"{columns[at[1]]} {1e3 * seen[at]:.4g} mm from the mean of run {run[row]}, where the axes "
        f"are {1e3 * moved[at]:.4g} mm from it",
        "readings that follow the axes, to half of their motion in half of the rows",
        f"they do with {causes[0]}: correct that"
        if causes
        else "compare units, signs and order of the columns of readings with the instrument",
    )


def cause(
    chain: Chain,
    axes: tuple[str, ...],
    position: np.ndarray,
    off: Callable[[np.ndarray], np.ndarray],
    allowed: float,
) -> str:
    """The single changes of the positions with which the median of `off` is within `allowed`; empty
    where there is none. All changes of a sign are named, rotary axes first, as several may have the
    same effect on these positions. With linear axes only, each change of a sign gives the same
    mirror image, of positions or of readings.
    """

    def follows(factors: Mapping[str, float]) -> bool:
        changed = position * np.array([factors.get(axis, 1.0) for axis in axes])
        return bool(np.median(off(chain.tool_point(changed))) <= allowed)

    columns = {axis: file_column(axis, axes) for axis in axes}
    likely = sorted(axes, key=lambda axis: (axis in LINEAR, ROTARY[::-1].find(axis)))
    signs = [axis for axis in likely if follows({axis: -1.0})]
    if signs and chain.linear:
        return (
            "the readings are a mirror image of that: compare the signs and the order of "
            "the columns of positions and readings with the machine"
        )
    if signs:
        first, *others = (columns[axis][0] for axis in signs)
        either = "".join(f", or in {name}" for name in others)
        return f"they do with the other sign in {first}{either}: correct " + (
            f"the one that is wrong on the machine, probably {first}" if others else "that"
        )
    turning = {axis: factor for axis, (_, factor) in columns.items() if axis not in LINEAR}
    for factors in (*({axis: factor} for axis, factor in turning.items()), turning):
        if factors and follows(factors):
            names = ", ".join(columns[axis][0] for axis in factors)
            return f"they do with radians turned into degrees in {names}: correct that"
    return ""
