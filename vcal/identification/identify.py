"""Identification: the parameters of a model from a measurement, with their covariance.

    minimise  |W (y - h(theta))|^2 + |L^(1/2) theta|^2

h is the exact forward model, W whitens each row, and theta is in units of the prior standard
deviations (L is one for a proper prior, zero for a flat one). The Jacobian is the port Jacobian, by
automatic differentiation, times the responses of the effects (`vcal.model.forward`). Where
Gauss-Newton converges quickly, it needs only that compiled Jacobian, whatever the model
(`vcal.numerics.gauss_newton`). The other problems are solved in a compiled program
(`vcal.numerics.least_squares`). Shape parameters are relinearised outside both
(`vcal.identification.shape_steps`), so that a new effect, or a new shape, is only new data to a
compiled program.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..model.declared_noise import declared_whitener
from ..model.forward import (
    Model,
    Shapes,
    Terms,
    check_keep,
    check_theta,
    compared_with_jacobian,
    concatenate,
    effect_terms,
    observe_all,
    observe_with_jacobian,
    port_values,
)
from ..model.measurement import Measurement
from ..numerics.arrays import Array
from ..numerics.compiled import filter_jit_outermost
from ..numerics.gauss_newton import Point, minimise
from ..numerics.least_squares import Solution, Status, least_squares
from ..numerics.spatial import require_float64
from .fit import Fit, entries
from .linearised import slopes
from .shape_steps import SETTLED, ShapeSteps, Step

_SLOTS = 32
"""Parameters and terms are padded to a common multiple of this number, so that models of similar
size share one compiled solver."""
_RELINEARISATIONS = 40
"""Largest number of steps of the shape parameters."""
_RIDGE = 1e-12
"""Added to the squared lengths (one) of the columns, for combinations that are not determined."""


class Problem(NamedTuple):
    """The data of the compiled solver: arrays only."""

    position: Float[Array, "n axes"]
    rows: Any
    measured: Float[Array, "n m"]
    whitener: Float[Array, "n m m"]
    """W of every row, with W'W the inverse covariance; zero for rows that are left out."""
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
"""Distance to the minimum in standard uncertainties (`vcal.numerics.least_squares`)."""
NEARLY, ROUGHLY = 1e-2, 3e-2
"""The same for intermediate fits, whose chi-square is then off by the square of this number."""
_ENDS = (Status.CONVERGED, Status.SINGULAR)
"""Results that damping does not change."""
_STEPS = {False: 24, True: 200}
"""Largest number of steps without and with damping."""


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


@filter_jit_outermost
def _solve(
    chain: Chain,
    instrument: Instrument,
    plan: Plan,
    problem: Problem,
    start: Array,
    tolerance: Array,
    damped: bool,
) -> tuple[Array, Array, Array, Array]:
    s = _solve_with(chain, instrument, plan, problem, start, tolerance, damped)
    return s.value, s.status, s.steps, s.rank


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

    `theta` (k,), in solver units, and `shapes` (SI) are the start; shape parameters that are not
    given start at the middle of their scan. `whitener` (n, m, m) replaces the declared noise.
    `keep` (n,) selects rows. `room` is the least number of slots for which the solver is compiled,
    so that smaller and larger models share it. `tolerance` is the distance to the minimum at which
    to stop, in standard uncertainties. Gauss-Newton is tried first, damping where it does not
    converge; `Fit.status` states the result.

    Raises `RuntimeError` where JAX runs in float32. Raises `ValueError` where measurement, theta or
    keep do not fit the model, or where the tolerance is not positive.
    """
    require_float64()
    if not tolerance > 0.0:
        raise ValueError(f"tolerance: found {tolerance}, expected a positive number")
    instrument = model.instrument
    width, found = len(instrument.readings), measurement.readings.shape[1]
    if found != width:
        raise ValueError(
            f"measurement: found {found} readings per row, expected {width} "
            f"({', '.join(instrument.readings)}) as declared by the instrument of the model; give "
            "all of them"
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
    solver = _Solver(model, measurement, whitener, room)
    size, amplitudes = len(solver.precision), len(model.entries)
    begin = np.zeros(amplitudes) if theta is None else np.asarray(theta, float)[:amplitudes]
    intermediate = tolerance if size == amplitudes else max(tolerance, NEARLY)
    optimum = solver.amplitudes_at(current, begin, intermediate)
    end, steps = optimum.status, optimum.steps
    if size > amplitudes:
        iteration = ShapeSteps[_AmplitudesAt](model, plan, max(SETTLED, tolerance**2))
        for _ in range(_RELINEARISATIONS):
            if ended := iteration.converged(optimum):
                break
            optimum = solver.amplitudes_at(*iteration.propose(), intermediate)
            steps += optimum.steps
        optimum = iteration.last
        if tolerance < intermediate:
            optimum = solver.amplitudes_at(optimum.shapes, optimum.point.theta, tolerance)
            steps += optimum.steps
        end = optimum.status if ended else Status.STEP_LIMIT
    return Fit(
        model=model,
        measurement=measurement,
        theta=optimum.theta,
        shapes=optimum.shapes,
        residual=optimum.point.residual,
        whitener=whitener,
        whitened=optimum.point.whitened,
        jacobian=optimum.jacobian,
        port_jacobian=optimum.point.by_port,
        precision=solver.precision,
        status=end,
        steps=steps,
        rank=optimum.rank,
    )


class _Solver:
    """The problem of a model and a measurement that remains where the shapes are known."""

    def __init__(self, model: Model, measurement: Measurement, whitener: np.ndarray, room: int):
        self.model, self.measurement, self.whitener, self.room = model, measurement, whitener, room
        free = [float(p.informed) if not p.shape else 0.0 for _, p in entries(model)]
        self.precision = np.array(free)
        """Diagonal of L, for amplitudes and shapes."""
        self._rows = model.instrument.rows(measurement.plan)
        self._fixed: dict[int, Terms] = {}

    def amplitudes_at(
        self, shapes: dict[int, dict[str, float]], begin: np.ndarray, tolerance: float
    ) -> "_AmplitudesAt":
        """The optimal amplitudes at some shapes (SI), from the start `begin` (solver units)."""
        terms = self._terms(shapes)
        rough = tolerance >= NEARLY
        point, steps, ended = minimise(partial(self._point, terms), begin, tolerance, rough)
        status, size = Status.CONVERGED, len(self.precision)
        rank = size
        if not ended:
            best, status, more, rank = self._compiled(terms, point.theta, begin, tolerance)
            point, steps = self._point(terms, best), steps + more
        moving = slopes(self.model, self.measurement.plan, shapes, point.theta, rough)
        along = concatenate(moving, self.measurement.rows, len(self.model.layout))
        along = along._replace(parameter=along.parameter - len(begin))
        by_port = np.matmul(self.whitener, point.by_port)
        return _AmplitudesAt(
            shapes=shapes,
            point=point,
            along=_by_parameter(by_port, along, size - len(begin)),
            precision=self.precision,
            status=status,
            steps=steps,
            rank=rank,
        )

    def _point(self, terms: Terms, theta: np.ndarray) -> Point:
        """The residual and its derivatives at some amplitudes."""
        model, measurement = self.model, self.measurement
        residual, by_port = (
            np.asarray(found)
            for found in compared_with_jacobian(
                model.chain,
                model.instrument,
                measurement.plan,
                self._rows,
                measurement.readings,
                _ports(terms, theta),
            )
        )
        return Point(
            theta=theta,
            precision=self.precision[: len(theta)],
            residual=residual,
            by_port=by_port,
            whitened=np.matmul(self.whitener, residual[:, :, None]).reshape(-1),
            derive=lambda: _by_parameter(np.matmul(self.whitener, by_port), terms, len(theta)),
        )

    def _compiled(
        self, terms: Terms, near: np.ndarray, begin: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, Status, int, int]:
        """The optimal amplitudes by the compiled solver: without damping from the start `near`,
        and if that fails with damping from the start `begin`.

        Returns amplitudes, status, number of steps, and the rank of the Jacobian, shapes included.
        """
        model, plan, size = self.model, self.measurement.plan, len(self.precision)
        root = np.sqrt(self.precision[: len(begin)])
        given = plan.position, self._rows, self.measurement.readings, self.whitener, terms, root
        problem = _padded(Problem(*given), self.room)  # type: ignore[arg-type]
        slots = len(problem.root_precision)
        for damped, start in ((False, near), (True, begin)):
            found, *how = _solve(
                model.chain,
                model.instrument,
                plan,
                problem,
                _pad(start, slots),
                np.asarray(tolerance),
                damped,
            )
            status, steps, rank = (int(number) for number in how)
            if status in _ENDS:
                break
        return np.array(found)[: len(begin)], Status(status), steps, rank - slots + size

    def _terms(self, shapes: Shapes) -> Terms:
        """`Model.terms`; terms of effects without shape parameters are computed once."""
        model, plan = self.model, self.measurement.plan
        for i, (effect, own) in enumerate(zip(model.effects, model.places, strict=True)):
            if effect.shapes or i not in self._fixed:
                shape = shapes.get(i, {})
                self._fixed[i] = effect_terms(effect, model.layout, plan, shape, own.start)
        blocks = [self._fixed[i] for i in range(len(model.effects))]
        return concatenate(blocks, plan.rows, len(model.layout))


@dataclass(frozen=True)
class _AmplitudesAt:
    """Some shapes with the optimal amplitudes there: a
    `vcal.identification.shape_steps.LinearisedPoint`.
    """

    shapes: dict[int, dict[str, float]]
    point: Point
    """The point at the optimal amplitudes (solver units)."""
    along: np.ndarray
    """W dh/dshapes, one row per shape parameter that moves."""
    precision: np.ndarray
    """Diagonal of L, for amplitudes and shapes."""
    status: Status
    steps: int
    rank: int

    @property
    def theta(self) -> np.ndarray:
        """Amplitudes, and zeros for the moves of the shapes (solver units)."""
        return _pad(self.point.theta, len(self.precision))

    @property
    def jacobian(self) -> np.ndarray:
        """W dh/dtheta by amplitudes and shapes (n m, k), without the rows of the prior."""
        return np.ascontiguousarray(np.concatenate([self.point.rows, self.along]).T)

    @cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """The linearised problem, with the amplitudes eliminated.

        The step of the amplitudes at fixed shapes and their derivative by the shapes; the gradient
        and the curvature of the cost by the shapes (a Schur complement); and the reduction of the
        cost by the step of the amplitudes at fixed shapes.
        """
        here, k = self.point, len(self.point.theta)
        across = here.rows @ self.along.T
        slope = here.rows @ here.whitened - here.precision * here.theta
        curvature, right = here.squared + np.diag(here.precision), np.column_stack([slope, across])
        alone, follow = np.split(_solved_for(curvature, right), [1], axis=1)
        pull = self.along @ here.whitened - across.T @ alone[:, 0]
        # A shape parameter about which the data contain little would diverge in its linearisation.
        # The unit matrix limits it to about a step of its scan, and has no effect on the minimum.
        stiffness = self.along @ self.along.T + np.eye(len(self.precision) - k)
        return alone[:, 0], follow, pull, stiffness - across.T @ follow, float(slope @ alone[:, 0])

    @property
    def cost(self) -> float:
        """The cost with optimal amplitudes, in units of the noise variance."""
        return self.point.cost - self._linear[-1]

    def step(self, still: np.ndarray) -> Step:
        """The step of the linearised problem, with the shapes marked in `still` held fixed."""
        alone, follow, pull, stiffness, _ = self._linear
        moves, free = np.zeros(len(still)), ~still
        if free.any():
            moves[free] = _solved_for(stiffness[np.ix_(free, free)], pull[free])
        amplitudes = self.point.theta + alone - follow @ moves
        return Step(amplitudes, moves, float(pull @ moves))


def _solved_for(curvature: np.ndarray, right: np.ndarray) -> np.ndarray:
    """curvature^-1 right; a combination that is undetermined to rounding does not move."""
    scale = np.sqrt(np.diag(curvature))
    scale = np.where(scale > 0.0, scale, 1.0)
    scaled = curvature / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
    return (np.linalg.solve(scaled, (right.T / scale).T).T / scale).T


def _ports(terms: Terms, theta: np.ndarray) -> Float[np.ndarray, "n p"]:
    """`vcal.model.forward.port_values` in numpy."""
    ports = np.array(terms.offset)
    for column, port, parameter in zip(terms.values.T, terms.port, terms.parameter, strict=True):
        ports[:, port] += column * theta[parameter]
    return ports


def _by_parameter(
    by_port: Float[np.ndarray, "n m p"], terms: Terms, size: int
) -> Float[np.ndarray, "k nm"]:
    """The derivative by the parameters from that by the ports of every row."""
    n, m, _ = by_port.shape
    # A contiguous row for every port and term takes a quarter of the time of gathering columns.
    across = np.ascontiguousarray(by_port.transpose(2, 0, 1))
    values = np.ascontiguousarray(np.asarray(terms.values).T)[:, :, None]
    found = np.zeros((size, n, m))
    for value, port, parameter in zip(values, terms.port, terms.parameter, strict=True):
        found[parameter] += across[port] * value
    return found.reshape(size, n * m)


def _pad(values: np.ndarray, size: int) -> np.ndarray:
    padded = np.zeros(size)
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
