"""Check that the readings of reflectors on an arm follow its joint positions, by the rigid best fit
of the nominal arm.

The pose of the instrument and the places of the reflectors on the flange are unknown: the two
closed-form solutions, for the pose with known places and for the places with a known pose,
alternate.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ..errors import RowError
from ..machine.chain import Chain, Joint
from ..machine.plan import slides
from ..numerics.spatial import best_rigid
from .conditions import file_column
from .follow import Change, with_these

_MOST_OFF = 0.05
"""Largest plausible error of an arm, as a share of the size of the measured region."""
_ANY_CAUSE = 2.5
"""Multiple of it above which readings are refused without a known cause."""
_LEAST_M = 2e-3
_PLAUSIBLE, _BETTER = 0.01, 8.0
"""Share of the size from which changes are tried, as an arm is seldom that wrong; and least factor
by which a change with which the readings follow reduces what is left. Of errors of an arm, no such
change takes away much.
"""
_LARGEST_ROWS = 120
_ROUNDS, _SETTLED = 200, 1e-6
_FEW_ROUNDS = 40
"""Alternations for a change that is tried: each halves what is left."""
_SURPLUS = 2.0
"""Least ratio of coordinates to unknowns of the rigid fit."""


def check_arm_follows(
    chain: Chain,
    position: Float[np.ndarray, "n joints"],
    seen: Float[np.ndarray, "n k 3"],
    columns: str,
    prefix: str = "commanded_",
) -> None:
    """Raise `RowError` where coordinates (m) of reflectors do not follow the nominal arm.

    The message lists every single change with which they do, the likeliest first: signs of joints;
    units of a joint column or a link; exchanged joint columns; coupled joints; the other
    Denavit-Hartenberg convention; a left-handed frame. `prefix` is that of the joint positions
    among the covariates, ``"commanded_"`` or ``"read_"``.
    """
    n, k, _ = seen.shape
    if any(not joint.turns and not np.isfinite(joint.travel).all() for joint in chain.joints):
        return  # another check asks for its bounds
    if seen.size < _SURPLUS * (6 + 3 * k):
        return
    found = arm_off(chain, position, seen)
    _, nominal = chain.tool_frame(position)
    size = float(np.linalg.norm(nominal - nominal.mean(0), axis=1).max())
    allowed, now = max(_MOST_OFF * size, _LEAST_M), float(np.median(found))
    if now <= max(_PLAUSIBLE * size, _LEAST_M):
        return
    row = int(np.argmax(found))
    some = np.unique(np.linspace(0, n - 1, _LARGEST_ROWS).astype(int))

    def left(one: Change, coordinates: np.ndarray) -> float:
        off = arm_off(one.chain, one.position, coordinates, _FEW_ROUNDS)
        return float(np.median(off)) if np.isfinite(off).all() else np.inf

    tried = [
        (one.words, left(one, seen[some])) for one in arm_changes(chain, position[some], prefix)
    ]
    same = Change("", chain, position[some])
    for words, factor in (("inches", 25.4), ("metres", 1e3), ("micrometres", 1e-3)):
        tried.append(
            (f"{words} turned into millimetres in {columns}", left(same, factor * seen[some]))
        )
    mirrored = seen[some] * np.array([-1.0, 1.0, 1.0])
    tried.append(("the other sign in one coordinate of all reflectors", left(same, mirrored)))
    follow = [pair for pair in tried if pair[1] <= min(allowed, now / _BETTER)]
    if now <= _ANY_CAUSE * allowed and not follow:
        return
    bound = allowed if now > allowed else now / _BETTER
    causes = with_these(follow, min(allowed, now / _BETTER))
    raise RowError(
        row,
        columns,
        f"a reflector {1e3 * found[row]:.4g} mm away from the nominal arm after the rigid best "
        f"fit, in half of the rows more than {1e3 * now:.4g} mm",
        f"readings that follow the joint positions to {1e3 * bound:.4g} mm",
        causes
        or "compare the signs, units and order of the joint columns, the rows of machine.joint and "
        "machine.coupling with the arm",
    )


def arm_off(
    chain: Chain,
    position: Float[np.ndarray, "n joints"],
    seen: Float[np.ndarray, "n k 3"],
    rounds: int = _ROUNDS,
) -> Float[np.ndarray, " n"]:
    """Distance (n,), m, of the coordinates of reflectors from the nominal arm, rms over the
    reflectors, with the pose of the instrument and the places of the reflectors fitted.
    """
    rotations, origins = chain.tool_frame(position)
    points = np.zeros((seen.shape[1], 3))
    turn, place = np.eye(3), np.zeros(3)
    for _ in range(rounds):
        model = origins[:, None] + np.einsum("nij,kj->nki", rotations, points)
        turn, place = best_rigid(seen.reshape(-1, 3), model.reshape(-1, 3))
        there = seen @ turn.T + place
        new = np.einsum("nji,nkj->ki", rotations, there - origins[:, None]) / len(seen)
        if np.abs(new - points).max() < _SETTLED:
            points = new
            break
        points = new
    model = origins[:, None] + np.einsum("nij,kj->nki", rotations, points)
    off = seen @ turn.T + place - model
    return np.sqrt((off**2).sum(2).mean(1))


def arm_changes(
    chain: Chain, position: Float[np.ndarray, "n joints"], prefix: str = "commanded_"
) -> Iterator[Change]:
    """Single changes of an arm and of its joint columns, the likeliest first."""
    axes, count = chain.axes, len(chain.joints)
    command = chain.commands(position)
    names = [file_column(f"{prefix}{axis}", axes)[0] for axis in axes]

    def commanded(words: str, changed: np.ndarray) -> Change:
        return Change(words, chain, chain.positions(changed))

    def scaled(words: str, joints: Sequence[int], factor: float) -> Change:
        factors = np.ones(count)
        factors[list(joints)] = factor
        return commanded(words, command * factors)

    for i, name in enumerate(names):
        yield scaled(f"the other sign in {name}", [i], -1.0)
    turning = [i for i, axis in enumerate(axes) if not slides(axes, axis)]
    sliding = [i for i in range(count) if i not in turning]
    for joints in [*([i] for i in turning), turning]:
        listed = ", ".join(names[i] for i in joints)
        yield scaled(f"radians turned into degrees in {listed}", joints, 180.0 / np.pi)
    for i in sliding:
        for unit, factor in (("inches", 25.4), ("metres", 1e3)):
            yield scaled(f"{unit} turned into millimetres in {names[i]}", [i], factor)
    yield from _links(chain, position)
    for some in (turning, sliding):
        for a, b in itertools.combinations(some, 2):
            order = [*range(count)]
            order[a], order[b] = b, a
            yield commanded(f"{names[a]} and {names[b]} exchanged", command[:, order])
    if chain.coupling is not None:
        yield Change("no machine.coupling", replace(chain, coupling=None), command)
    else:
        for a, b in itertools.pairwise(turning):
            for sign, words in ((1.0, "plus"), (-1.0, "minus")):
                moved = position.copy()
                moved[:, b] += sign * position[:, a]
                coupled = (
                    f"joint {b + 1} coupled to joint {a + 1} (machine.coupling: its angle is "
                    f"{names[b]} {words} {names[a]})"
                )
                yield Change(coupled, chain, moved)
    for i in turning:
        for angle in (90.0, -90.0, 180.0):
            moved = position.copy()
            moved[:, i] += np.deg2rad(angle)
            yield Change(f"{angle:g} deg more in machine.joint.{i}.theta_deg", chain, moved)
    other = other_convention(chain)
    if other is not None:
        yield Change(f"{other.text.partition(', ')[2]} rows", other, position)


def _links(chain: Chain, position: np.ndarray) -> Iterator[Change]:
    """Links in another unit: the lengths a and d of every row of an arm."""
    rows = _rows(chain)
    if rows is None:
        return
    for i, row in enumerate(rows):
        for key in ("a", "d"):
            if not row[key]:
                continue
            for unit, factor in (("metres", 1e3), ("inches", 25.4), ("micrometres", 1e-3)):
                changed = [dict(r) for r in rows]
                changed[i][key] = factor * row[key]
                words = (
                    f"{unit} turned into millimetres in machine.joint.{i}.{key}_mm "
                    f"({1e3 * row[key]:.6g})"
                )
                yield Change(words, _with_rows(chain, changed, _modified(chain)), position)


def _modified(chain: Chain) -> bool:
    return chain.text.split(", ")[1:2] == ["modified DH"]


def _rows(chain: Chain) -> list[dict[str, float]] | None:
    """The Denavit-Hartenberg rows of an arm; None where it was given otherwise."""
    given = chain.text.split(", ")[1:2]
    if given not in (["standard DH"], ["modified DH"]):
        return None
    rows = []
    for joint in chain.joints:
        before, after = np.asarray(joint.before), np.asarray(joint.after)
        if given == ["standard DH"]:
            theta = np.arctan2(before[1, 0], before[0, 0])
            alpha = np.arctan2(after[2, 1], after[2, 2])
            a, d = after[0, 3], after[2, 3]
        else:
            theta = np.arctan2(-before[0, 1], before[0, 0])
            alpha = np.arctan2(-before[1, 2], before[2, 2])
            a, d = before[0, 3], after[2, 3]
        rows.append({"a": float(a), "d": float(d), "alpha": float(alpha), "theta": float(theta)})
    return rows


def _with_rows(chain: Chain, rows: Sequence[dict[str, float]], modified: bool) -> Chain:
    """The arm with other Denavit-Hartenberg rows."""
    joints = []
    for joint, row in zip(chain.joints, rows, strict=True):
        about, along, link = np.eye(4), np.eye(4), np.eye(4)
        ct, st = np.cos(row["theta"]), np.sin(row["theta"])
        ca, sa = np.cos(row["alpha"]), np.sin(row["alpha"])
        about[:2, :2] = [[ct, -st], [st, ct]]
        along[2, 3], link[0, 3] = row["d"], row["a"]
        link[1:3, 1:3] = [[ca, -sa], [sa, ca]]
        ends = (link @ about, along) if modified else (about, along @ link)
        joints.append(_placed(joint, *ends))
    count = chain.text.partition(", ")[0]
    rest = chain.text.split(", ")[2:]
    named = "modified DH" if modified else "standard DH"
    return replace(chain, joints=tuple(joints), text=", ".join([count, named, *rest]))


def _placed(joint: Joint, before: np.ndarray, after: np.ndarray) -> Joint:
    return replace(joint, before=before, after=after)


def other_convention(chain: Chain) -> Chain | None:
    """The arm whose rows are read by the other Denavit-Hartenberg convention; None where it was
    not given by rows.
    """
    rows = _rows(chain)
    return None if rows is None else _with_rows(chain, rows, not _modified(chain))
