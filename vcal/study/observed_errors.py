"""Which errors of a machine tool a plan identifies, without any prior: rank and null directions.

The errors are those of ISO 230-1: six error motions of every axis, as Legendre polynomials without
the degrees that are a position or orientation of the workpiece or of the tool, and the location
errors. The unknown poses, dead paths and other nuisances of the instruments without a prior are
identified together with them. A null direction is a combination of errors to which no reading
responds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects.base import across
from ..effects.geometric import GeometricErrors, LocationError
from ..identification.rank import FREE, nominal_jacobian
from ..instruments.base import Instrument
from ..instruments.conditions import PARALLEL
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..machine.ports import PortLayout
from ..model.forward import Model, effect_terms, tool_points_with_jacobian
from ..numerics.spatial import rigid_columns
from ..words import counted, plural
from .messages import FEW, listed
from .must_see import LINES, error_motion

_HIGHEST = 3
"""Highest degree of an error motion."""
_APART = 0.01
"""Distance, as a share of the range of an axis, from which two of its positions differ."""
_MOST_ROWS = 4000
_PART = 1e-4
"""Share of a null direction from which an error is part of it."""
_SIZE = 1e-5
_PROBES = 60


class Observed(NamedTuple):
    """What a plan identifies of the errors of a machine."""

    errors: tuple[str, ...]
    """All errors of the axes that move, ISO 230-1."""
    still: tuple[str, ...]
    """Axes that do not move."""
    degree: int
    """Highest degree of the error motions."""
    rank: int
    columns: int
    """Rank and number of the parameters of the errors."""
    null: tuple[tuple[tuple[str, ...], int], ...]
    """Errors of which only combinations are identified, or nothing of a single one; each with the
    number of directions that are not."""

    @property
    def complete(self) -> bool:
        """Whether all errors are identified."""
        return not self.null

    @property
    def words(self) -> str:
        """The rank and the null directions in a sentence."""
        count = f"{counted(len(self.errors), 'error')} (ISO 230-1, degrees up to {self.degree})"
        fixed = (
            f"; {', '.join(self.still)} {plural(len(self.still), 'does', 'do')} not move"
            if self.still
            else ""
        )
        if self.complete:
            return (
                f"all {count} without a prior, rank {self.rank} of {self.columns}: complete{fixed}"
            )
        alone = [names[0] for names, _ in self.null if len(names) == 1]
        mixed = [names for names, _ in self.null if len(names) > 1]
        said = [f"nothing of {listed(alone, FEW)}"] if alone else []
        if mixed:
            classes = "; of ".join(listed(names, FEW) for names in mixed[:FEW])
            more = f"; and {len(mixed) - FEW} more" if len(mixed) > FEW else ""
            said.append(f"only combinations of {classes}{more}")
        return (
            f"rank {self.rank} of {self.columns} for {count} without a prior; not identified: "
            f"{'; '.join(said)}{fixed}"
        )


def observed_errors(chain: Chain, instrument: Instrument, plan: Plan) -> Observed | None:
    """The errors that the readings of a plan identify at the nominal machine; None for an arm, and
    where no axis moves.
    """
    if chain.arm:
        return None
    if plan.rows > _MOST_ROWS:
        plan = plan.take(np.unique(np.linspace(0, plan.rows - 1, _MOST_ROWS).astype(int)))
    levels = {axis: _levels(np.asarray(plan.x(axis))) for axis in chain.axes}
    moving = [axis for axis in chain.axes if levels[axis] > 1]
    if not moving:
        return None
    straight = {p for axis in moving if not chain.joint(axis).turns for p in across(chain, axis)}
    motions, top = [], 1
    for axis in moving:
        highest = min(_HIGHEST, levels[axis] - 1)
        top = max(top, highest)
        for c in "XYZABC":
            lowest = 2 if f"E{c}{axis}" in straight else 1
            if highest >= lowest:
                motions.append(error_motion(plan, f"E{c}{axis}", range(lowest, highest + 1)))
    locations = [
        LocationError.of(chain, name, _SIZE)
        for name in _located(chain, moving)
        if name in _independent(chain)
    ]
    family = GeometricErrors(motions=tuple(motions), locations=tuple(locations))
    free = [
        effect
        for effect in instrument.effects(plan)
        if effect.kind == "nuisance" and not any(p.informed for p in effect.amplitudes)
    ]
    model = Model(chain, instrument, (family, *free))
    J = nominal_jacobian(model, plan)
    J = J.reshape(-1, J.shape[-1])
    J = J[np.any(J != 0.0, axis=1)]
    own = model.places[0]
    names = [e.parameter.name.split(".")[0] for e in model.entries[own]]
    apart = _no_pose(chain, family, plan)
    null = apart @ _null(J[:, own] @ apart, np.delete(J, np.arange(J.shape[1])[own], axis=1))
    return Observed(
        errors=tuple(dict.fromkeys(names)),
        still=tuple(axis for axis in chain.axes if axis not in moving),
        degree=top,
        rank=apart.shape[1] - null.shape[1],
        columns=apart.shape[1],
        null=_together(names, null),
    )


def _levels(values: Float[np.ndarray, " n"]) -> int:
    """Number of positions of an axis that differ by more than a hundredth of its range."""
    ordered = np.sort(values)
    size = ordered[-1] - ordered[0]
    return 1 + int((np.diff(ordered) > _APART * size).sum()) if size > 1e-9 else 1


def _located(chain: Chain, moving: Sequence[str]) -> list[str]:
    """Location errors of the axes that move."""
    found = []
    for axis in moving:
        turning = chain.joint(axis).turns
        found += [f"E{c}0{axis}" for c in ("XYZABC" if turning else "ABC") if axis not in LINES[c]]
    return found


def _independent(chain: Chain) -> set[str]:
    """Location errors that are no pose of the workpiece or of the tool: three squareness errors of
    three linear axes, four location errors of every rotary axis but those of the zero position of a
    frame.
    """
    names = {"EC0Y", "EB0Z", "EA0Z"}
    for axis in chain.axes:
        if axis in PARALLEL or chain.joint(axis).turns:
            names |= {f"E{c}0{axis}" for c in "XYZABC"}
    return names


def _no_pose(chain: Chain, family: GeometricErrors, plan: Plan) -> Float[np.ndarray, "p q"]:
    """Orthonormal basis of the parameters without those combinations that are a constant pose of
    the workpiece or of the tool, to which no instrument of unknown pose responds.

    They are the null directions of four points on the tool at random positions, with both poses
    free.
    """
    rng = np.random.default_rng(0)
    x = np.asarray(plan.position)
    low, high = x.min(0), x.max(0)
    position = low + rng.uniform(size=(_PROBES, x.shape[1])) * (high - low)
    there = Plan(plan.axes, position)
    terms = effect_terms(family, PortLayout.of(chain.axes, ()), there, {})
    values, port, parameter = (
        np.asarray(part) for part in (terms.values, terms.port, terms.parameter)
    )
    turn, origin = chain.tool_frame(position)
    moved, posed = [], []
    for point in 0.3 * np.vstack([np.zeros(3), np.eye(3)]):
        own = eqx.tree_at(lambda c: c.tool_offset, chain, np.asarray(chain.tool_offset) + point)
        still = np.zeros((_PROBES, 6 * len(chain.joints) + 6))
        _, by_port = tool_points_with_jacobian(own, position, still)  # type: ignore[arg-type]
        by_port = np.asarray(by_port)
        J = np.zeros((_PROBES, 3, len(family.amplitudes)))
        for k in range(len(port)):
            J[:, :, parameter[k]] += by_port[:, :, port[k]] * values[:, None, k]
        moved.append(J)
        work = rigid_columns(origin + turn @ point)
        spin = np.stack([turn @ np.cross(w, point) for w in np.eye(3)], axis=-1)
        posed.append(np.concatenate([work, turn, spin], axis=-1))
    J = np.concatenate(moved).reshape(-1, len(family.amplitudes))
    poses = np.concatenate(posed).reshape(len(J), -1)
    gauge = _null(J, poses)
    u, _, _ = np.linalg.svd(gauge, full_matrices=True)
    return u[:, gauge.shape[1] :]


def _null(
    mine: Float[np.ndarray, "n p"], others: Float[np.ndarray, "n q"]
) -> Float[np.ndarray, "p d"]:
    """Null directions of some columns, orthonormal, with the `others` free."""

    def scaled(J: np.ndarray) -> np.ndarray:
        norms = np.linalg.norm(J, axis=0)
        return J / np.where(norms > 0.0, norms, 1.0)

    norm = np.linalg.norm(mine)
    others = scaled(others)
    if others.shape[1]:
        u, s, _ = np.linalg.svd(others, full_matrices=False)
        u = u[:, s > FREE]
        mine = mine - u @ (u.T @ mine)
    _, sizes, vt = np.linalg.svd(mine, full_matrices=len(mine) < mine.shape[1])
    rank = int((sizes > FREE * max(float(norm), 1e-300)).sum())
    return vt[rank:].T


def _together(
    names: Sequence[str], null: Float[np.ndarray, "p d"]
) -> tuple[tuple[tuple[str, ...], int], ...]:
    """Errors that share null directions, with the number of these."""
    if not null.shape[1]:
        return ()
    shared = np.abs(null @ null.T) > _PART
    left = [i for i in range(len(names)) if shared[i, i]]
    found: list[tuple[tuple[str, ...], int]] = []
    while left:
        group: set[int] = {left[0]}
        grown: set[int] = {left[0]}
        while grown:
            grown = {k for i in grown for k in np.flatnonzero(shared[i]).tolist()} - group
            group |= grown
        left = [i for i in left if i not in group]
        count = int(np.linalg.matrix_rank(null[sorted(group)], tol=_PART))
        found.append((tuple(dict.fromkeys(names[i] for i in sorted(group))), count))
    # Several degrees of the same errors, and errors that share one of several names, are one class.
    merged: list[tuple[tuple[str, ...], int]] = []
    for errors, count in found:
        for one in [m for m in merged if {*m[0]} & {*errors}]:
            merged.remove(one)
            errors = tuple(dict.fromkeys((*one[0], *errors)))
            count += one[1]
        merged.append((errors, count))
    return tuple(merged)
