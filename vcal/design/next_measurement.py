"""What to measure next, on top of what was measured: the verb behind ``vcal design --next``."""

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
"""Further measurements tried at random; the best of them are where the search starts."""
_FITS_M = 1e-9
_TOLERANCE = 1e-6


class Candidate(NamedTuple):
    """A further measurement that was looked at."""

    placed: Any
    start: float
    """What the search makes small, where it began."""
    value: Value
    """Of the data so far and this."""
    lambdas: Lambda | None
    searched: bool
    """Whether it was moved by gradient; else it is one of those drawn."""


@dataclass(frozen=True)
class NextMeasurement:
    """The next measurement."""

    task: Task
    """Its space is that of the further groups."""
    present: PlanSpace
    before: Value
    """Of the data so far."""
    prior: Value | None
    candidates: tuple[Candidate, ...]
    """Best first."""
    separation: Separation | None
    separated: Lambda | None
    """By the data so far."""
    differentiable: bool
    drawn: int
    """How many were drawn at random."""

    @property
    def best(self) -> Candidate:
        """What to measure."""
        return self.candidates[0]


def plan_next(
    task: Task, count: int, *, separation: Separation | None = None, seed: int = 0,
    starts: int = 8, steps: int = 200, progress: Callable[[str], None] = lambda text: None,
) -> NextMeasurement:  # fmt: skip
    """Search for `count` further groups that make the criterion small, or tell two rivals apart.

    What is measured already (the plan of the task as it is) is held fixed; the station or the balls
    are known jointly. Raises `StudyError` where nothing that fits the travel was found.
    """
    present = task.space
    varied = [] if separation is None else separation.varied(recorded(task))
    space = present.following(count, varied)
    progress("judging the data so far")
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
        found = search(smooth, chosen, space.low, space.high, steps=steps, tolerance=_TOLERANCE)
        ends = [(f.z, f.start) for f in found]
    else:
        ends = [(drawn[i], float(values[i])) for i in order[:starts]]
    progress("judging the best")
    told = None
    if separating is not None:
        told = jit_outermost(separating.lambdas) if differentiable else separating.lambdas
    candidates = []
    for z, start in ends:
        placed = space.settled(space.placed(jnp.asarray(z)))
        if float(space.excess(placed)) > _FITS_M:
            continue
        lambdas = None
        if told is not None:
            lambdas = Lambda(*np.asarray(told(placed, 1.0)).tolist())
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
    if told is not None:
        separated = Lambda(*np.asarray(told(anything, 0.0)).tolist())
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
    """Covariates of the plan as it is, by name."""
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
