"""Preparation of a declared family of errors for the evaluation of plans."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..geometry.straight_lines import StraightLines
from ..geometry.volumetric import displacements, volumetric_gram
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..machine.ports import COMPONENTS
from ..model.forward import Model
from ..model.simulate import conditions_at, scattered, travels
from .criteria import ErrorMotion, Judged

NODES = 21
"""Number of positions along every axis at which the uncertainty of error motions is evaluated."""
_SCATTERED = 600
"""Number of random points for an arm or a machine with rotary axes, as a grid over all joints is
too large.
"""

_ROUNDING = 1e-15
"""Slope, rad, below which a parameter has no effect on it."""


def judge(
    model: Model, plan: Plan, grid: tuple[int, int, int], names: Sequence[str] | None = None
) -> Judged:
    """The judged family of a model without nuisances.

    `names` are the errors that count for the criterion; all of the declared family by default.
    `plan` provides the conditions of the points of the `grid`.
    """
    own = error_motions(model, plan)
    motions = (*own, *straight_lines(model, plan))
    wanted = [m.name for m in own] if names is None else names
    chosen = tuple(i for i, m in enumerate(motions) if m.name in wanted)
    return Judged(
        model, volumetric_gram(model, grid_points(model.chain, plan, grid)), motions, chosen
    )


def grid_points(chain: Chain, plan: Plan, grid: tuple[int, int, int]) -> Plan:
    """A grid over the travel of X, Y and Z, under the conditions of random rows of the plan.

    Machines with other axes get random positions.
    """
    if set(chain.axes) != set("XYZ"):
        return scattered(chain, plan, jax.random.key(0), _SCATTERED)
    travel = travels(chain, plan)
    ends = [travel[chain.axes.index(axis)] for axis in "XYZ"]
    sides = [np.linspace(low, high, n) for (low, high), n in zip(ends, grid, strict=True)]
    mesh = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    rows = np.random.default_rng(0).integers(plan.rows, size=len(mesh))
    return plan.elsewhere(mesh[:, ["XYZ".index(a) for a in chain.axes]], rows)


def error_motions(model: Model, plan: Plan) -> tuple[ErrorMotion, ...]:
    """Every error motion and location error with free parameters, at positions along its axis, with
    the other axes in the middle of their travel.
    """
    chain, layout = model.chain, model.layout
    travel = travels(chain, plan)
    names = [entry.parameter.name for entry in model.entries]
    lines = [np.linspace(low, high, NODES) for low, high in travel]
    position = np.tile(travel.mean(1), (len(lines), NODES, 1))
    for a, line in enumerate(lines):
        position[a, :, a] = line
    # All axes are in one plan, as every size of a plan needs a compilation of its own.
    terms = model.terms(conditions_at(plan, position.reshape(-1, len(lines))))
    values, port, parameter = (
        np.asarray(part) for part in (terms.values, terms.port, terms.parameter)
    )
    found = []
    for a, axis in enumerate(chain.axes):
        here = values[a * NODES : (a + 1) * NODES]
        for c in COMPONENTS:
            own = port == layout.index(f"E{c}{axis}")
            rows = np.zeros((NODES, len(names)))
            for column in np.flatnonzero(own):
                rows[:, parameter[column]] += here[:, column]
            if not rows.any():
                continue
            mine = tuple(i for i, n in enumerate(names) if n.startswith(f"E{c}{axis}."))
            unit = "um" if c in "XYZ" else "urad"
            parts = tuple(np.flatnonzero(np.abs(rows).max(0) > 0.0).tolist())
            found.append(ErrorMotion(f"E{c}{axis}", unit, lines[a], rows, mine or parts))
    for i, entry in enumerate(model.entries):
        if entry.key == "geometric" and "." not in entry.parameter.name:
            row = np.zeros((1, len(names)))
            p = entry.parameter
            row[0, i] = p.step
            found.append(ErrorMotion(p.name, p.unit, np.zeros(0), row, (i,)))
    return tuple(found)


def straight_lines(model: Model, plan: Plan) -> tuple[ErrorMotion, ...]:
    """Squareness errors between linear axes and slopes of their positioning errors.

    They are those of least-squares lines through the paths of the tool point (`StraightLines`), as
    geometric tests state them (ISO 230-1:2012, 3.4 and 3.6), independent of the parametrisation.
    Only those on which a free parameter acts are returned.
    """
    chain = model.chain
    if chain.arm:
        return ()
    lines = StraightLines.of(chain, travels(chain, plan), NODES)
    asked = [(name, "urad", weights) for name, *_, weights in lines.squareness]
    for axis, along in lines.along.items():
        weights = lines.on(axis, lines.slope(axis), along)
        asked.append((f"E{axis}{axis} slope", "um/m", weights))
    if not asked:
        return ()
    moved = displacements(model, conditions_at(plan, lines.position))
    rows = np.zeros((len(asked), len(model.entries)))
    rows[:, moved.places] = np.array([weights.ravel() for *_, weights in asked]) @ (
        moved.raw.reshape(lines.nominal.size, -1)
    )
    return tuple(
        ErrorMotion(name, unit, np.zeros(0), row[None], ())
        for (name, unit, _), row in zip(asked, rows, strict=True)
        if np.abs(row).max() > _ROUNDING
    )


def prior_covariance(judged: Judged) -> jnp.ndarray | None:
    """Prior covariance of the amplitudes; None where an error of the machine has no prior."""
    open_ = judged.precision == 0.0
    moves = np.diagonal(judged.gram.raw) > 0.0
    return None if (open_ & moves).any() else jnp.diag(jnp.where(jnp.asarray(open_), 0.0, 1.0))
