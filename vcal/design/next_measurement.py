"""Design of the next measurement, given the present data: the verb of ``vcal design --next``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import StudyError
from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost
from .multistart import search
from .optimiser import (
    Compiled,
    Task,
    Value,
    check_finite,
    prior_value,
    require_traceable,
    traceable,
)
from .plan_space import PlanSpace, joint_information
from .separation import Lambda, Separating, Separation

CANDIDATES = 96
"""Number of random further measurements; the search starts from the best of them."""
_FITS_M = 1e-9
_TOLERANCE = 1e-6


class Candidate(NamedTuple):
    """A further measurement that was evaluated."""

    placed: Any
    start: float
    """Objective of the search at its start."""
    value: Value
    """Uncertainty after the present data and this measurement."""
    lambdas: Lambda | None
    searched: bool
    """Whether a gradient search improved it; otherwise it is one of the random ones."""


@dataclass(frozen=True)
class NextMeasurement:
    """The next measurement."""

    task: Task
    """The design task, with the space of the further groups."""
    present: PlanSpace
    before: Value
    """Uncertainty after the present data."""
    prior: Value | None
    candidates: tuple[Candidate, ...]
    """Evaluated measurements, best first."""
    separation: Separation | None
    separated: Lambda | None
    """Noncentralities of the rivals with the present data."""
    differentiable: bool
    drawn: int
    """Number of random measurements."""

    @property
    def best(self) -> Candidate:
        """The measurement to make."""
        return self.candidates[0]


def plan_next(
    task: Task, count: int, *, separation: Separation | None = None, seed: int = 0,
    starts: int = 8, steps: int = 200, progress: Callable[[str], None] = lambda text: None,
) -> NextMeasurement:  # fmt: skip
    """Search for `count` further groups that minimise the criterion, or that separate two rivals.

    The present measurement, that is, the plan of the task, is held fixed; the station or the balls
    are estimated jointly from both. Raises `StudyError` where no measurement within the travel was
    found.
    """
    present = task.space
    varied = [] if separation is None else separation.varied(recorded(task))
    space = present.following(count, varied)
    progress("evaluating the present data")
    held = [joint_information(present, present.nominal, j.model) for j in task.families]
    further = task._replace(space=space)
    compiled = Compiled(further, held)
    require_traceable(compiled.smooth, space)
    separating = None
    if separation is not None:
        known = joint_information(present, present.nominal, separation.model)
        separating = Separating(separation, space, known)
    smooth = compiled.smooth if separating is None else separating.smooth
    differentiable = traceable(smooth, space)
    keys = jax.random.split(jax.random.key(seed), max(CANDIDATES, starts))
    drawn = [space.scattered(key) for key in keys]
    progress(f"trying {len(drawn)} at random")
    values = _each(smooth, drawn, differentiable)
    order = np.argsort(np.where(np.isfinite(values), values, np.inf), kind="stable")
    chosen = [drawn[i] for i in order[:starts]]
    if differentiable:
        progress(f"searching from the best {len(chosen)}")
        found = search(
            smooth,
            chosen,
            space.low,
            space.high,
            steps=steps,
            tolerance=_TOLERANCE,
            levels=space.levels,
        )
        ends = [(f.z, f.start) for f in found]
    else:
        ends = [(drawn[i], float(values[i])) for i in order[:starts]]
    progress("evaluating the best")
    lambdas_of = None
    if separating is not None:
        lambdas_of = jit_outermost(separating.lambdas) if differentiable else separating.lambdas
    candidates = []
    for z, start in ends:
        placed = space.settled(space.placed(jnp.asarray(z)))
        if float(space.excess(placed)) > _FITS_M:
            continue
        lambdas = None
        if lambdas_of is not None:
            lambdas = Lambda(*np.asarray(lambdas_of(placed, 1.0)).tolist())
        value = compiled.value(placed)
        candidates.append(Candidate(placed, start, value, lambdas, differentiable))
    if not candidates:
        raise StudyError(
            f"--next: found no {space.group} within the travel from {len(chosen)} starts, expected "
            f"{space.lacking}, or take more starts (design.starts)"
        )
    candidates.sort(key=_rank)
    anything = space.placed(jnp.asarray(space.start))
    before = compiled.value(anything, 0.0)
    check_finite(candidates[0].value, task)
    separated = None
    if lambdas_of is not None:
        separated = Lambda(*np.asarray(lambdas_of(anything, 0.0)).tolist())
    return NextMeasurement(
        task=further,
        present=present,
        before=before,
        prior=prior_value(task),
        candidates=tuple(candidates),
        separation=separation,
        separated=separated,
        differentiable=differentiable,
        drawn=len(drawn),
    )


def recorded(task: Task) -> dict[str, np.ndarray]:
    """Covariates of the present plan, by name."""
    plan = task.space.plan(task.space.nominal)
    return {name: np.asarray(values) for name, values in plan.covariates.items()}


def _each(
    function: Callable[[Any], Float[Array, ""]], points: Sequence[np.ndarray], compile_it: bool
) -> Float[np.ndarray, " n"]:
    if not compile_it:
        return np.array([float(function(z)) for z in points])
    compiled = jit_outermost(function)
    return np.array([float(compiled(z)) for z in points])


def _rank(candidate: Candidate) -> float:
    if candidate.lambdas is not None:
        return -candidate.lambdas.smaller
    return candidate.value.criterion
