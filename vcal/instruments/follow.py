"""Axis positions that follow a point of the workpiece, and checks that readings follow the axes, by
the nominal kinematics of the machine.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

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
_ANY_CAUSE = 4.0
"""Multiple of the largest plausible error above which readings are refused without a known cause. A
wrong sign, unit, order or chain moves them farther; below it, an instrument that was moved or a
joint that yields is to be found."""
_PLANE = 2
"""Least dimension of the measured region for a comparison of readings with linear axes."""
_LEAST_M = 1e-3
"""Plausible distance in a region of any size: the declared position of a rotary axis is
approximate."""

_HALF, _FAR = 0.5, 0.5
"""Largest relative error of the motion of readings; and least motion that is compared, as a share
of the largest."""
_AS_GOOD, _AS_NEAR, _MOST_CAUSES = 3.0, 0.02, 5
"""Multiple of what the best change leaves, and share of what is allowed, within which another one
is as good; and most changes that are listed."""
_LENGTHS = (("inches", 25.4), ("metres", 1e3), ("micrometres", 1e-3))
"""Units of lengths that may have been written for millimetres, with their factors."""
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


@dataclass(frozen=True)
class Variant:
    """Readings after one change of their columns."""

    words: str
    """What is changed, after "with"."""
    off: Callable[[np.ndarray], np.ndarray]
    """The distance of these readings from nominal points."""


Points = Callable[[Chain, np.ndarray], np.ndarray]
"""Nominal points (n, 3), m, of a chain at positions (n, axes)."""


def check_follows(
    chain: Chain,
    plan: Plan,
    off: Callable[[np.ndarray], np.ndarray],
    columns: str,
    beside: str = "the machine",
    *,
    points: Points = Chain.tool_point,
    readings: Sequence[Variant] = (),
    mirrors: bool = True,
) -> None:
    """Check that readings agree with the tool points at the axis positions.

    `off` gives the distance (n,), m, of every reading from nominal points (n, 3) in the workpiece
    frame, after the unknown rigid motions are fitted; `points` gives these points, the tool point
    by default, and `readings` are changes of the columns of readings. `mirrors`: whether a mirror
    image is another one. The median is compared, since a few outliers are removed later. Raises
    `RowError`, which lists every single change with which the readings follow, the likeliest first;
    without one, and where they are far off (`_ANY_CAUSE`), it asks to compare the columns with the
    things named in `beside`.
    """
    position = np.asarray(plan.position)
    linear = position[:, [axis in LINEAR for axis in plan.axes]]
    apart = linear - linear.mean(0)
    if chain.linear and np.linalg.matrix_rank(apart, tol=_LEAST_M) < _PLANE:
        return
    size = np.linalg.norm(apart, axis=1).max()
    allowed = max(_MOST_OFF * size, _LEAST_M)
    found = off(points(chain, position))
    if np.median(found) <= allowed:
        return
    why = cause(chain, plan.axes, position, off, allowed, points, readings, mirrors)
    if not why and np.median(found) <= _ANY_CAUSE * allowed:
        return
    row = int(np.argmax(found))
    raise RowError(
        row,
        columns,
        f"a reading {1e3 * found[row]:.4g} mm away from the tool point at the axis positions, in "
        f"half of the rows more than {1e3 * np.median(found):.4g} mm",
        f"readings that follow the positions to {1e3 * allowed:.4g} mm",
        why
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
        f"they do with {', or with '.join(causes)}: compare that with the machine"
        if causes
        else "compare units, signs and order of the columns of readings with the instrument",
    )


def cause(
    chain: Chain,
    axes: tuple[str, ...],
    position: np.ndarray,
    off: Callable[[np.ndarray], np.ndarray],
    allowed: float,
    points: Points = Chain.tool_point,
    readings: Sequence[Variant] = (),
    mirrors: bool = True,
) -> str:
    """The single changes with which the median of `off` is within `allowed`, the likeliest first;
    empty where there is none.

    Several changes may have the same effect on these positions: the readings cannot tell which one
    is right. With linear axes only, each change of a sign gives the same mirror image, of positions
    or of readings, and so does every exchange of two columns.
    """

    def far(found: np.ndarray) -> float:
        middle = float(np.median(found))
        return middle if math.isfinite(middle) else math.inf

    def mirrored() -> bool:
        changed = position * np.array([-1.0 if axis == linear[0] else 1.0 for axis in axes])
        return far(off(points(chain, changed))) <= allowed

    linear = [axis for axis in axes if axis in LINEAR]
    if chain.linear and mirrors and linear and mirrored():
        return (
            "the readings are a mirror image of that: compare the signs and the order of "
            "the columns of positions and readings with the machine"
        )
    tried = [
        (one.words, far(off(points(one.chain, one.position))))
        for one in tool_changes(chain, axes, position)
    ]
    nominal = points(chain, position)
    tried += [(one.words, far(one.off(nominal))) for one in readings]
    return with_these([pair for pair in tried if pair[1] <= allowed], allowed)


def with_these(tried: Sequence[tuple[str, float]], allowed: float) -> str:
    """The changes (words, what is left) with which readings follow, in a sentence; empty where
    there are none. A change that leaves far more than another one is no cause.
    """
    if not tried:
        return ""
    least = min(left for _, left in tried)
    words = [words for words, left in tried if left <= _AS_GOOD * least + _AS_NEAR * allowed]
    more = f" (and {len(words) - _MOST_CAUSES} more)" if len(words) > _MOST_CAUSES else ""
    listed = ", or with ".join(words[:_MOST_CAUSES])
    which = "these, the likeliest first," if len(words) > 1 else "it"
    return f"they do with {listed}{more}: compare {which} with the machine"


@dataclass(frozen=True)
class Change:
    """A chain and positions after one change of the declared machine or of a column."""

    words: str
    """What is changed, after "with"."""
    chain: Chain
    position: np.ndarray


def tool_changes(chain: Chain, axes: tuple[str, ...], position: np.ndarray) -> Iterator[Change]:
    """Single changes of a machine tool and of the columns of its positions, the likeliest first:
    signs, rotary axes before linear ones; other chains; units of a column; exchanged columns.
    """
    columns = {axis: file_column(axis, axes) for axis in axes}
    likely = sorted(axes, key=lambda axis: (axis in LINEAR, ROTARY[::-1].find(axis)))

    def scaled(words: str, factors: Mapping[str, float]) -> Change:
        return Change(words, chain, position * np.array([factors.get(a, 1.0) for a in axes]))

    for axis in likely:
        yield scaled(f"the other sign in {columns[axis][0]}", {axis: -1.0})
    for other in other_chains(chain):
        words = f'the chain "{other.text}" (or one with the same nominal motion)'
        yield Change(words, other, position)
    turning = {axis: factor for axis, (_, factor) in columns.items() if axis not in LINEAR}
    for factors in _each_and_all(turning):
        names = ", ".join(columns[axis][0] for axis in factors)
        yield scaled(f"radians turned into degrees in {names}", factors)
    linear = [axis for axis in axes if axis in LINEAR]
    for unit, factor in _LENGTHS:
        for factors in _each_and_all(dict.fromkeys(linear, factor)):
            names = ", ".join(columns[axis][0] for axis in factors)
            yield scaled(f"{unit} turned into millimetres in {names}", factors)
    for some in (linear, [*turning]):
        for a, b in itertools.combinations(some, 2):
            order = [*range(len(axes))]
            i, k = axes.index(a), axes.index(b)
            order[i], order[k] = k, i
            words = f"{columns[a][0]} and {columns[b][0]} exchanged"
            yield Change(words, chain, position[:, order])


def _each_and_all(factors: Mapping[str, float]) -> Iterator[Mapping[str, float]]:
    yield from ({axis: factor} for axis, factor in factors.items())
    if len(factors) > 1:
        yield factors


def other_chains(chain: Chain) -> Iterator[Chain]:
    """Chains of the same axes in another order, or on the other side of the bed, with another
    nominal motion; of those with the same motion, the most similar to this one.

    Linear axes without a rotary axis between them commute.
    """
    if chain.arm or chain.linear:
        return
    letters = [chain.axes[i] for i in reversed(chain.workpiece_side)]
    own = [*letters, "b", *(chain.axes[i] for i in chain.tool_side)]
    rng = np.random.default_rng(0)
    probes = rng.uniform(-0.5, 0.5, (4, len(chain.axes)))

    def motion(one: Chain) -> bytes:
        # Rounded to 1 nm.
        return np.round(one.tool_point(probes), 9).tobytes()

    found: dict[bytes, tuple[tuple[int, int], Chain]] = {}
    known = motion(chain)
    for order in itertools.permutations(own):
        one, moved = rearranged(chain, order), _moved(order, own)
        key = motion(one)
        likely = moved, _inside(one)
        if key != known and (key not in found or likely < found[key][0]):
            found[key] = likely, one
    yield from (one for _, one in sorted(found.values(), key=lambda pair: pair[0]))


def _moved(order: Sequence[str], own: Sequence[str]) -> int:
    """Number of letters that are moved: all but the longest common subsequence."""
    place = {letter: i for i, letter in enumerate(own)}
    longest: list[int] = []
    for i, letter in enumerate(order):
        before = [longest[k] for k in range(i) if place[order[k]] < place[letter]]
        longest.append(1 + max(before, default=0))
    return len(own) - max(longest)


def _inside(chain: Chain) -> int:
    """Number of rotary axes that carry a linear one, which is unusual."""
    count = 0
    for side in (chain.workpiece_side, chain.tool_side):
        names = [chain.axes[i] for i in side]
        count += sum(a in ROTARY and any(b in LINEAR for b in names[i:])
                     for i, a in enumerate(names))  # fmt: skip
    return count


def rearranged(chain: Chain, order: Sequence[str]) -> Chain:
    """The same axes in another order from the workpiece to the tool, with ``"b"`` for the bed."""
    bed = list(order).index("b")
    work = [chain.axes.index(axis) for axis in reversed(order[:bed])]
    tool = [chain.axes.index(axis) for axis in order[bed + 1 :]]
    joints = tuple(
        replace(joint, side="workpiece" if i in work else "tool")
        for i, joint in enumerate(chain.joints)
    )
    text = " ".join(["w", *order, "t"]) + chain.text.partition(" t")[2]
    return replace(
        chain, joints=joints, tool_side=tuple(tool), workpiece_side=tuple(work), text=text
    )
