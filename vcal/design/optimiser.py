"""Optimisation of a plan: the verb of ``vcal design``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import StudyError
from ..geometry.volumetric import expected_rms
from ..identification.posterior import eliminated, inverse
from ..identification.rank import rank_of
from ..model.forward import Model
from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost
from ..words import counted
from .criteria import MICRO, Criterion, Judged, averaged
from .judged import prior_covariance
from .multistart import Found, search
from .plan_space import NOT_TRACED, PlanSpace, starts_of

_FITS_M = 1e-9
_TOLERANCE = 1e-5


class Task(NamedTuple):
    """A design task: a space of plans, the judged families and the criterion."""

    space: PlanSpace
    families: tuple[Judged, ...]
    """The study's own first."""
    criterion: Criterion


class Value(NamedTuple):
    """The posterior uncertainty of a plan; averages over the families, except for `largest`."""

    criterion: float
    aligned_um: float
    """Expected rms volumetric error after compensation and rigid alignment."""
    raw_um: float
    """Expected rms volumetric error after compensation, without alignment."""
    largest: np.ndarray
    """Largest U (k = 2) of every error motion of the study's own family, um or urad."""


@dataclass(frozen=True)
class Designed:
    """A plan before and after its optimisation."""

    task: Task
    nominal: Any
    """Placed, as all plans here."""
    best: Any
    before: Value
    after: Value
    prior: Value | None
    """Before any measurement; None where an error of the machine has no prior."""
    worse_before: np.ndarray
    """Relative increase of the criterion without each of the groups."""
    worse_after: np.ndarray
    found: tuple[Found, ...]
    """All starts, best first."""
    fits: tuple[bool, ...]
    """Whether each result lies within the travel."""

    @property
    def gain(self) -> float:
        """Relative decrease of the criterion."""
        return 1.0 - self.after.criterion / self.before.criterion


def valuation(value: Value, prior: Value | None) -> float:
    """Share of the prior rms volumetric error that a plan removes."""
    return 1.0 - value.aligned_um / prior.aligned_um if prior is not None else np.nan


class Compiled:
    """The compiled functions of a task, in addition to the information of the present data.

    Effects and families are constants of the programs, as they are the same for all plans.
    """

    def __init__(self, task: Task, held: Sequence[np.ndarray] | None = None):
        self.task = task
        self.held = held
        self._value = jit_outermost(self._valued)

    def covariances(self, placed: Any, weights: Float[Array, " g"]) -> list[Float[Array, "k k"]]:
        """Posterior covariances of the amplitudes of every family."""
        space, found = self.task.space, []
        for i, judged in enumerate(self.task.families):
            joint = space.information(placed, judged.model, weights)
            if self.held is not None:
                joint = joint + self.held[i]
            H = eliminated(
                joint, jnp.diag(jnp.asarray(judged.precision)), jnp.asarray(space.shared)
            )
            found.append(inverse(H))
        return found

    def smooth(self, z: Float[Array, " d"]) -> Float[Array, ""]:
        """The objective of the search."""
        space, criterion = self.task.space, self.task.criterion
        placed = space.placed(z)
        covariances = self.covariances(placed, jnp.ones(len(space.groups)))
        value = averaged(criterion.smooth, criterion, self.task.families, covariances)
        return value * space.penalty(placed)

    def value(self, placed: Any, weight: float = 1.0) -> Value:
        """The uncertainty of a plan, in which every group counts `weight` times."""
        weights = np.full(len(self.task.space.groups), weight)
        return _value(self._value(placed, weights))

    def without_each(self, placed: Any) -> np.ndarray:
        """Relative increase of the criterion without each of the groups."""
        # Repeated calls of the compiled value take less time than compiling a batched program.
        groups = len(self.task.space.groups)
        whole = float(self._value(placed, np.ones(groups))[0])
        rows = 1.0 - np.eye(groups)
        return np.array([float(self._value(placed, row)[0]) for row in rows]) / whole - 1.0

    def _valued(self, placed: Any, weights: Float[Array, " g"]):
        return _values(self.task, self.covariances(placed, weights))


def prior_value(task: Task) -> Value | None:
    """Before any measurement; None where an error of the machine has no prior."""
    priors = [prior_covariance(judged) for judged in task.families]
    known = [p for p in priors if p is not None]
    if len(known) < len(priors):
        return None
    # Passed as an argument, as XLA folds constants slowly.
    return _value(jit_outermost(lambda priors: _values(task, priors))(known))


def optimise(
    task: Task, *, seed: int = 0, starts: int = 8, steps: int = 200,
    progress: Callable[[str], None] = lambda text: None,
) -> Designed:  # fmt: skip
    """Search the space from the present plan and from random plans around it.

    Raises `StudyError` where no start leads to a plan within the travel, and where the present plan
    leaves the criterion undetermined.
    """
    space, compiled = task.space, Compiled(task)
    nominal = space.nominal
    progress("evaluating the present plan")
    require_traceable(compiled.smooth, space)
    before = compiled.value(nominal)
    check_finite(before, task)
    progress(f"searching from {counted(starts, 'start')}")
    found, placed = [], []
    if len(space.start):
        begin = starts_of(space, seed, starts)
        found = search(
            compiled.smooth,
            begin,
            space.low,
            space.high,
            steps=steps,
            tolerance=_TOLERANCE,
            levels=space.levels,
        )
        placed = [space.settled(space.placed(jnp.asarray(f.z))) for f in found]
    fits = tuple(float(space.excess(p)) <= _FITS_M for p in placed)
    # Ranked by the criterion itself, not by its smooth substitute.
    options = [(compiled.value(p), p) for p, fit in zip(placed, fits, strict=True) if fit]
    if placed and not options:
        raise StudyError(
            f"the search: found no {space.group}s within the travel from {starts} starts, expected "
            f"{space.lacking}, or take more starts (design.starts)"
        )
    after, best = min(options, key=lambda o: o[0].criterion, default=(before, nominal))
    # Without an improvement, the present plan is the result.
    if after.criterion > before.criterion and inside(task, nominal):
        after, best = before, nominal
    progress(f"evaluating every {space.group}")
    return Designed(
        task=task,
        nominal=nominal,
        best=best,
        before=before,
        after=after,
        prior=prior_value(task),
        worse_before=compiled.without_each(nominal),
        worse_after=compiled.without_each(best),
        found=tuple(found),
        fits=fits,
    )


def traceable(function: Callable[[Any], Any], space: PlanSpace) -> bool:
    """Whether JAX can differentiate a criterion by the numbers of a space."""
    try:
        jax.eval_shape(function, jax.ShapeDtypeStruct(space.low.shape, float))
    except NOT_TRACED:
        return False
    return True


def require_traceable(function: Callable[[Any], Any], space: PlanSpace) -> None:
    """Raise `StudyError` where a criterion cannot be differentiated."""
    if not traceable(function, space):
        raise StudyError(
            "the search: found a declared effect whose response leaves JAX (by numpy.asarray or an "
            "`if` on a value), expected a response that is differentiable by positions; write it "
            "with jax.numpy, or remove the effect"
        )


def inside(task: Task, placed: Any) -> bool:
    """Whether all positions are within the travel."""
    position = np.asarray(task.space.plan(placed).position)
    low, high = task.families[0].model.chain.travel.T
    return bool((position >= low - _FITS_M).all() and (position <= high + _FITS_M).all())


def check_finite(value: Value, task: Task) -> None:
    """Raise `StudyError` for a plan that leaves its criterion undetermined."""
    if not (np.isfinite(value.criterion) and value.criterion > 0.0):
        raise StudyError(
            f"the present plan: found that it leaves the {task.criterion.words} undetermined, "
            "expected a finite value; give every error a prior, measure more, or choose other "
            "errors"
        )


def _values(task: Task, covariances: Sequence[Float[Array, "k k"]]):
    rms = []
    for gram in ("aligned", "raw"):
        each = [
            expected_rms(jnp.asarray(getattr(j.gram, gram)), C)
            for j, C in zip(task.families, covariances, strict=True)
        ]
        rms.append(jnp.sqrt(jnp.mean(jnp.stack(each) ** 2)) / MICRO)
    own, C = task.families[0], covariances[0]
    courses = [
        2.0 * jnp.sqrt(jnp.maximum(jnp.einsum("qk,kl,ql->q", m.functionals, C, m.functionals), 0.0))
        / MICRO
        for m in own.motions
    ]  # fmt: skip
    criterion = averaged(task.criterion.of, task.criterion, task.families, covariances)
    return criterion, *rms, courses


def _value(values) -> Value:
    criterion, aligned, raw, courses = values
    largest = np.array([np.asarray(c).max() for c in courses])
    return Value(float(criterion), float(aligned), float(raw), largest)


class Seen(NamedTuple):
    """Rank of the Jacobian of all readings by all amplitudes and unknown poses, without priors."""

    columns: int
    rank: int
    unseen: tuple[str, ...]
    """Errors and effects that contribute to unobserved combinations."""


def seen(task: Task, placed: Any) -> Seen:
    """The rank of a plan for the study's own family."""
    space, model = task.space, task.families[0].model
    plan, instrument = space.plan(placed), space.instrument(placed)
    nuisances = [e for e in instrument.effects(plan) if e.kind == "nuisance"]
    whole = Model(model.chain, instrument, (*model.effects, *nuisances))
    found = rank_of(whole, plan)
    names = []
    for i in found.mixed:
        entry = whole.entries[i]
        if i < len(model.entries):
            own = entry.parameter.name.split(".")[0]
            names.append(own if entry.key == "geometric" else entry.key)
    return Seen(found.columns, found.rank, tuple(dict.fromkeys(names)))
