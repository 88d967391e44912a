"""Identification: the parameters of a model from a measurement, with their covariance.

    minimise  |W (y - h(theta))|^2 + |L^(1/2) theta|^2

h is the exact forward model, W whitens each row, theta is in units of the prior standard deviations
(L: one for a proper prior, zero for a flat one). `optimistix` solves; the Jacobian is the port
Jacobian times the effects' responses (`vcal.model`). Shape parameters are relinearised around the
solver, so that a new effect, or a new shape, is only new data to a compiled solver.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .arrays import Array
from .chain import Chain
from .fit import Fit, entries, shape_step
from .instruments.base import Instrument
from .least_squares import Solution, Status, least_squares
from .measurement import Measurement
from .model import (
    Model,
    Shapes,
    Terms,
    check_keep,
    check_theta,
    concatenate,
    effect_terms,
    observe_all,
    observe_with_jacobian,
    port_values,
)
from .plan import Plan
from .programs import outer_filter_jit
from .spatial import require_float64
from .walk import Walk

_SLOTS = 32
"""Parameters and terms are padded to one common multiple of this, so that models of similar size
share one compiled solver."""


_RELINEARISATIONS = 40


class Problem(NamedTuple):
    """What the compiled solver needs: arrays only."""

    position: Float[Array, "n axes"]
    rows: Any
    measured: Float[Array, "n m"]
    whitener: Float[Array, "n m m"]
    """Per row W with W' W the inverse covariance; zero for rows that are left out."""
    terms: Terms
    root_precision: Float[Array, " k"]


def _whitened(instrument: Instrument, problem: Problem, difference: Array) -> Array:
    return jnp.einsum("nij,nj...->ni...", problem.whitener, difference)


def _residual(chain: Chain, instrument: Instrument, reduce, theta: Array, problem: Problem):
    ports = port_values(problem.terms, theta, problem.terms.offset.shape[1])
    predicted = reduce(observe_all(chain, instrument, problem.position, problem.rows, ports))
    data = _whitened(instrument, problem, instrument.difference(problem.measured, predicted))
    return jnp.concatenate([data.reshape(-1), problem.root_precision * theta])


def _residual_and_jacobian(
    chain: Chain, instrument: Instrument, reduce, theta: Array, problem: Problem
):
    ports = port_values(problem.terms, theta, problem.terms.offset.shape[1])
    predicted, by_port = observe_with_jacobian(
        chain, instrument, problem.position, problem.rows, ports
    )
    difference = instrument.difference(problem.measured, reduce(predicted))
    by_port = -_whitened(instrument, problem, reduce(by_port))
    by_term = by_port[:, :, problem.terms.port] * problem.terms.values[:, None, :]
    size = theta.shape[0]
    data = _whitened(instrument, problem, difference).reshape(-1)
    columns = by_term.reshape(len(data), -1).T
    jacobian = jax.ops.segment_sum(columns, problem.terms.parameter, size).T
    return (
        jnp.concatenate([data, problem.root_precision * theta]),
        jnp.concatenate([jacobian, jnp.diag(problem.root_precision)]),
    )


_TOLERANCE = 1e-5
"""Distance to the minimum in standard uncertainties (`vcal.least_squares`)."""
NEARLY = 1e-3
"""The same of a fit that is a step on the way: it is off by its square in chi-square."""
_ENDS = (Status.CONVERGED, Status.SINGULAR)
"""Ends that damping does not change."""
_STEPS = {False: 24, True: 200}
"""Steps allowed without and with damping."""


def _solve_with(
    chain: Chain,
    instrument: Instrument,
    plan: Plan,
    problem: Problem,
    start: Array,
    tolerance: Array,
    damped: bool,
) -> Solution:
    def reduce(values):
        return instrument.reduce(values, plan)

    def residual(theta, problem):
        return _residual(chain, instrument, reduce, theta, problem)

    def linearised(theta, problem):
        return _residual_and_jacobian(chain, instrument, reduce, theta, problem)

    # The residuals are whitened: their standard deviation is known.
    return least_squares(
        residual,
        start,
        problem,
        tolerance=tolerance,
        noise=1.0,
        damped=damped,
        max_steps=_STEPS[damped],
        linearised=linearised,
    )


@outer_filter_jit
def _solve(
    chain: Chain,
    instrument: Instrument,
    plan: Plan,
    problem: Problem,
    start: Array,
    tolerance: Array,
    damped: bool,
) -> tuple[Array, Array, Array, Array, Array]:
    s = _solve_with(chain, instrument, plan, problem, start, tolerance, damped)
    return s.value, s.status, s.steps, s.cost, s.rank


@outer_filter_jit
def _evaluate(chain: Chain, instrument: Instrument, plan, problem: Problem, theta: Array):
    ports = port_values(problem.terms, theta, problem.terms.offset.shape[1])
    predicted, by_port = observe_with_jacobian(
        chain, instrument, problem.position, problem.rows, ports
    )
    difference = instrument.difference(problem.measured, instrument.reduce(predicted, plan))
    return difference, instrument.reduce(by_port, plan)


def linearised_terms(
    model: Model,
    plan: Plan,
    shapes: Shapes,
    theta: np.ndarray,
    fixed: dict[int, Terms] | None = None,
) -> Terms:
    """Terms of all amplitudes, and of the smooth shape parameters at the given amplitudes.

    `fixed` keeps the terms of effects without shape parameters from one call to the next.
    """
    fixed = {} if fixed is None else fixed
    blocks, start, k = [], 0, len(model.entries)
    for i, effect in enumerate(model.effects):
        amplitudes = effect.amplitudes
        if effect.shapes or i not in fixed:
            fixed[i] = effect_terms(effect, model.layout, plan, shapes.get(i, {}), start)
        blocks.append(fixed[i])
        slopes = shape_terms(
            model, i, plan, shapes[i] if effect.shapes else {}, theta[start:], plan, k
        )
        blocks += slopes
        k += len(slopes)
        start += len(amplitudes)
    return concatenate(blocks, plan.rows, len(model.layout))


def shape_terms(
    model: Model,
    effect: int,
    plan: Plan,
    shape: Mapping[str, Any],
    theta: np.ndarray,
    scanned: Plan,
    first: int,
) -> list[Terms]:
    """How the ports change with every smooth shape parameter of the effect at that place of the
    model, per solver unit: its step on the plan that is `scanned`, which is the one identified on.

    `theta` begins with the effect's own amplitudes; `first` is the place of its first shape
    parameter in the parameter vector.
    """
    one, found = model.effects[effect], []
    moving = [p for p in one.shapes if p.moves]
    grids = one.scan(scanned) if moving else {}
    sizes = {
        a.name: a.mean * a.si + value * a.step
        for a, value in zip(one.amplitudes, theta, strict=False)
    }
    at = {name: jnp.asarray(value, float) for name, value in shape.items()}
    for p in moving:
        along = {name: jnp.asarray(float(name == p.name)) for name in at}
        _, slopes = jax.jvp(lambda s: dict(one.response(plan, s)), (at,), (along,))
        step = shape_step(p, float(shape[p.name]), grids)
        columns: dict[int, np.ndarray] = {}
        for (port, name), slope in slopes.items():
            place = model.layout.index(port)
            slope = np.broadcast_to(np.asarray(slope), (plan.rows,))
            columns[place] = columns.get(place, 0.0) + slope * sizes[name] * step
        found.append(
            Terms(
                np.zeros((plan.rows, len(model.layout))),
                np.stack(list(columns.values()), 1),
                np.asarray(list(columns)),
                np.full(len(columns), first + len(found)),
            )  # type: ignore[arg-type]
        )
    return found


def declared_whitener(model: Model, measurement: Measurement) -> np.ndarray:
    """W of every row from the instrument's declared noise and the model's random effects.

    A random effect whose response through the nominal machine is c (per unit of its parameter, SI)
    adds sigma^2 c c' to the covariance of each row.
    """
    covariance = np.sum([part for _, part in declared_covariances(model, measurement)], axis=0)
    return whitener_of(covariance + absent(model, measurement.plan))


def whitener_of(covariance: Float[np.ndarray, "n m m"]) -> Float[np.ndarray, "n m m"]:
    """W of every row, with W'W the inverse of its covariance."""
    return np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)


def absent(model: Model, plan: Plan) -> Float[np.ndarray, "n m m"]:
    """What keeps the covariance of a row invertible that has fewer readings than others: one, in
    the place of what it has not.
    """
    missing = ~model.instrument.present(plan)
    return np.einsum("ni,ij->nij", missing.astype(float), np.eye(missing.shape[1]))


def declared_covariances(model: Model, measurement: Measurement) -> list[tuple[str, np.ndarray]]:
    """What the covariance of every row is made of, each with its name and (n, m, m), SI: the noise
    of every component of a reading, of every data set, and the random effects.
    """
    plan, instrument = measurement.plan, model.instrument
    sigma = instrument.noise(plan, measurement.readings) * instrument.present(plan)
    m = sigma.shape[1]
    found = []
    for one, inside in plan.parts.items():
        for k, name in enumerate(instrument.members.get(one, instrument).readings[:m]):
            part = np.zeros((len(sigma), m, m))
            part[inside, k, k] = sigma[inside, k] ** 2
            found.append((f"{one} {name}".strip(), part))
    if model.random:
        ports = np.zeros((plan.rows, len(model.layout)))
        _, by_port = observe_with_jacobian(
            model.chain, instrument, plan.position, instrument.rows(plan), ports
        )
        by_port = np.asarray(instrument.reduce(by_port, plan))
        for effect in model.random:
            for p in effect.amplitudes:
                # A declared value is the standard deviation itself, known.
                given = ((p.name, 0.0, p.mean or p.sigma),)
                own = dataclasses.replace(effect, given=given, priors=())
                terms = effect_terms(own, model.layout, plan, {})
                mine = terms.parameter == [q.name for q in effect.amplitudes].index(p.name)
                c = (by_port[:, :, terms.port] * terms.values[:, None, :])[:, :, mine].sum(2)
                found.append((f"{effect.key} {p.name}", np.einsum("ni,nj->nij", c, c)))
    return found


def identify(
    model: Model,
    measurement: Measurement,
    *,
    theta: np.ndarray | None = None,
    shapes: Shapes | None = None,
    whitener: np.ndarray | None = None,
    keep: np.ndarray | None = None,
    room: int = 0,
    tolerance: float = _TOLERANCE,
) -> Fit:
    """Fit a model to a measurement by non-linear least squares.

    `theta` (solver units) and `shapes` (SI) start the solver; shape parameters that are not given
    start at the middle of their scan. `whitener` (n, m, m) replaces the declared noise, `keep` (n,)
    leaves rows out, `room` is the least number of slots to compile the solver for (smaller and
    larger models then share it), `tolerance` the distance to the minimum at which to stop, in
    standard uncertainties. Gauss-Newton first, with damping where that does not converge;
    `Fit.status` says how it ended. Raises `RuntimeError` where JAX runs in float32, and
    `ValueError` where measurement, theta or keep do not fit the model, or the tolerance is not
    positive.
    """
    require_float64()
    if not tolerance > 0.0:
        raise ValueError(f"tolerance: found {tolerance}, expected a positive number")
    instrument = model.instrument
    width, found = len(instrument.readings), measurement.readings.shape[1]
    if found != width:
        raise ValueError(
            f"measurement: found {found} readings per row, expected {width} "
            f"({', '.join(instrument.readings)}) as the instrument of the model has them; give all"
        )
    if theta is not None:
        check_theta(model, theta)
    plan = measurement.plan
    model.check_plan(plan)
    if whitener is None:
        whitener = declared_whitener(model, measurement)
    if keep is not None:
        check_keep(plan, keep)
        whitener = whitener * np.asarray(keep, float)[:, None, None]
    current = {
        i: {name: float(value) for name, value in shape.items()}
        for i, shape in model.shapes_at(plan, shapes).items()
    }
    names = entries(model)
    size, amplitudes = len(names), len(model.entries)
    precision = np.array([float(p.informed) if not p.shape else 0.0 for _, p in names])
    # A shape parameter that the data hardly see would run off in its linearisation. What holds it
    # back by a step of its scan has no say where it stands still.
    held = np.where([p.shape for _, p in names], 1.0, np.sqrt(precision))
    estimate = np.zeros(size)
    if theta is not None:
        estimate[: len(theta)] = theta
    rows = instrument.rows(plan)
    fixed: dict[int, Terms] = {}

    def solved(
        shapes: dict[int, dict[str, float]], begin: np.ndarray, still: np.ndarray
    ) -> _Solved:
        terms = linearised_terms(model, plan, shapes, begin, fixed)
        moving = np.concatenate([np.ones(amplitudes, bool), ~still])[terms.parameter]
        held_terms = terms._replace(values=np.where(moving, terms.values, 0.0))  # type: ignore[arg-type]
        problem = _padded(
            Problem(plan.position, rows, measurement.readings, whitener, held_terms, held),  # type: ignore[arg-type]
            room,
        )
        start = _pad(begin, problem.root_precision)
        given = model.chain, instrument, plan, problem, start, np.asarray(tolerance)
        found, *how = _solve(*given, False)
        if int(how[0]) not in _ENDS:
            found, *how = _solve(*given, True)
        status, used, cost, rank = how
        return _Solved(
            shapes, terms, problem, np.array(found)[:size], Status(int(status)), int(used),
            float(cost), int(rank) - (len(start) - size),
        )  # fmt: skip

    walk, steps = Walk(model, plan, amplitudes, solved), 0
    for _ in range(_RELINEARISATIONS if size > amplitudes else 1):
        it, used = walk.solved(current, estimate)
        steps += used
        if size == amplitudes:
            at_best, end = it, it.status
            break
        if walk.ends(it):
            at_best, end = walk.standing, walk.standing.status
            it = walk.last
            break
        current, estimate = walk.onward()
    else:
        at_best, end = walk.standing, Status.STEP_LIMIT
        it = walk.last
    # With a move that is not made, the amplitudes would be those of another place.
    estimate, terms = at_best.amplitudes(amplitudes), it.terms
    residual, by_port = _evaluate(
        model.chain, instrument, plan, it.problem, _pad(estimate, it.problem.root_precision)
    )
    residual, by_port = np.asarray(residual), np.asarray(by_port)
    by_term = (
        np.einsum("nij,njp->nip", whitener, by_port)[:, :, terms.port] * terms.values[:, None, :]
    )
    gather = np.zeros((len(terms.parameter), size))
    gather[np.arange(len(terms.parameter)), np.asarray(terms.parameter)] = 1.0
    return Fit(
        model=model,
        measurement=measurement,
        theta=estimate,
        shapes=it.shapes,
        residual=residual,
        whitener=whitener,
        whitened=np.einsum("nij,nj->ni", whitener, residual).reshape(-1),
        jacobian=(by_term @ gather).reshape(-1, size),
        port_jacobian=by_port,
        precision=precision,
        status=end,
        steps=steps,
        rank=it.rank,
    )


class _Solved(NamedTuple):
    """The solution of the problem that is linear in the shapes, about some of them."""

    shapes: dict[int, dict[str, float]]
    terms: Terms
    problem: Problem
    found: np.ndarray
    """Amplitudes, and by how much the shapes should move (solver units)."""
    status: Status
    steps: int
    cost: float
    """With the shapes moved, as far as the linear model goes."""
    rank: int

    def amplitudes(self, count: int) -> np.ndarray:
        """What was found, the shapes where they are."""
        return np.where(np.arange(len(self.found)) < count, self.found, 0.0)


def _pad(values: np.ndarray, like: Array) -> np.ndarray:
    padded = np.zeros(len(like))
    padded[: len(values)] = values
    return padded


def _padded(problem: Problem, room: int) -> Problem:
    terms, size = problem.terms, len(problem.root_precision)
    slots = -(-max(size, len(terms.port), room) // _SLOTS) * _SLOTS
    more_terms, more = slots - len(terms.port), slots - size
    return problem._replace(
        terms=Terms(
            terms.offset,
            np.pad(terms.values, ((0, 0), (0, more_terms))),
            np.pad(terms.port, (0, more_terms)),
            np.pad(terms.parameter, (0, more_terms)),
        ),  # type: ignore[arg-type]
        root_precision=np.pad(problem.root_precision, (0, more), constant_values=1.0),
    )
