"""Dense non-linear least squares: the solver behind every identification.

    minimise  |r(theta)|^2

`optimistix` runs the iteration; the solver is vcal's own. It takes Gauss-Newton steps as long as
the linear model predicts the cost. From the first failure on it uses Levenberg-Marquardt: damping
in units of the columns of the Jacobian (More' 1978), Nielsen's update of the damping (1999), and
the geodesic acceleration of Transtrum and Sethna (arXiv:1201.5885), whose size also limits how far
the linear model is trusted. Without damping, the last few steps of Gauss-Newton are combined
(`vcal.numerics.anderson`): where residuals are large and the model is curved, Gauss-Newton alone
converges linearly, and a step may remove as little as a third of the remaining distance.

All tests are independent of the units of parameters and residuals. The step that is left to the
minimum of the linear model, g = -J^+ r, is compared with the standard uncertainties: the test
|J g| <= tolerance s, s^2 = |r|^2 / (n - p), is the relative offset of Bates and Watts (1981). A
short step is no sign of convergence: on a plateau the damped step is short and g is long.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from .anderson import anderson_step_traced
from .arrays import Array
from .spatial import require_float64

_EPS = float(jnp.finfo(jnp.float64).eps)
_TRUSTED = 0.9
"""Least share of the predicted reduction of the cost that an undamped step must achieve."""
_LOWERED = 1e-4
"""The same for a damped step: any real reduction is enough."""
_DAMPING = 2e-4
"""First damping, in squares of the column norms."""
_HOPELESS = 1e20
"""Damping at which a step no longer changes anything."""
_FORGET = 0.5
"""Share of its size that the damping scale of a parameter keeps from step to step, so that a
column that collapses does not release its parameter at once."""
_CURVED = 0.75
"""Largest length of the geodesic acceleration, relative to the step, at which a step is tried."""
_PROBE = 0.1
"""Share of the step at which the curvature of the residual is probed."""
_CLOSE = 1e-8
"""Relative reduction of the cost below which the difference is mostly rounding. A step is then
judged by whether the remaining step has become shorter."""
_ROUNDING = 1e-12
"""Relative reduction of the cost that may be rounding alone."""
_DEFICIENT = 1e-10
"""Singular value, relative to the largest, below which a combination of parameters counts as free:
its step would have fewer than six correct digits."""
_NEAR = 0.5
"""Share of the tolerance within which the remaining step may be computed with the triangle of the
previous point: its relative error is the rate at which the steps converge."""
_ABOUT = 0.25
"""Least share of the predicted reduction that the step to such a point must have achieved."""
_CERTAIN = 1e8
"""Bound of the condition number up to which no singular value can be smaller than `_DEFICIENT`. R
is then solved directly, in a third of the time that its singular values take."""
_SQUARED = 1e6
"""Bound of the condition number up to which R is taken from J'J: Householder reflections are most
of the work of a large fit. The square may lose 1e-4 of a step, which the next step corrects."""
_LEAST = 1e-6
"""Remaining step, relative to the residual, below which a step that shrinks no further is rounding.
"""
_SECANTS = 3
"""Number of the last steps of Gauss-Newton that are combined."""
_SLOW = 0.1
"""Ratio of a step to the previous one above which steps are combined. Below it Gauss-Newton alone
converges quickly; a ratio above one means that the minimum is far away."""
_LONGER = 5.0
"""Largest length of a combined step, relative to the step of Gauss-Newton."""
_FLAT = 1e-6
"""Downward curvature, relative to that of the linear model, that may be rounding."""
_RELATIVE = 1e-11
"""Remaining step relative to every parameter at which a zero-residual problem counts as solved."""


class Status(IntEnum):
    """How a minimisation ended."""

    CONVERGED = 0
    SINGULAR = 1
    STALLED = 2
    STEP_LIMIT = 3
    NON_FINITE = 4

    @property
    def prose(self) -> str:
        """Meaning of the status, and what to do about it."""
        return _PROSE[self]


_PROSE = {
    Status.CONVERGED: "a minimum, with a Jacobian of full rank",
    Status.SINGULAR: "the gradient vanishes but the Jacobian is rank deficient, so that some "
    "combinations of parameters are free: give them a prior, or measure what they depend on",
    Status.STALLED: "no step lowers the cost any more although its gradient does not vanish: a "
    "plateau, a kink, or noise in the residual; start elsewhere",
    Status.STEP_LIMIT: "the step limit was reached first: parameters may diverge to infinity; "
    "start elsewhere or allow more steps",
    Status.NON_FINITE: "the residual or its Jacobian is not finite at the start: start elsewhere",
}


class Solution(eqx.Module):
    """The minimum, or the best point found. Under `vmap` every field has a leading axis."""

    value: Float[Array, " p"]
    status: Int[Array, ""]
    """A `Status`; its prose is `Status(int(status)).prose`."""
    steps: Int[Array, ""]
    """Number of steps tried, including rejected ones."""
    cost: Float[Array, ""]
    """|r|^2 at `value`."""
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n p"]
    """At `value`."""
    rank: Int[Array, ""]
    """Rank of the Jacobian with columns of unit length."""
    condition: Float[Array, ""]
    """Condition of the Jacobian with columns of unit length; infinite if a column is zero."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether `value` is an isolated minimum."""
        return self.status == Status.CONVERGED


class _Point(eqx.Module):
    """The residual, its derivative and their factorisation at one value of the parameters."""

    residual: Float[Array, " n"]
    jacobian: Float[Array, "n p"]
    cost: Float[Array, ""]
    columns: Float[Array, " p"]
    """Column norms of the Jacobian; one for a column of zeros."""
    triangle: Float[Array, "k p"]
    """R of the Jacobian with columns of unit length."""
    projected: Float[Array, " k"]
    """Q' r."""
    rank: Int[Array, ""]
    certain: Bool[Array, ""]
    """Whether a bound of the condition number proves full rank."""
    newton: Float[Array, " p"]
    """The shortest step to the minimum of the linear model, g = -J^+ r."""
    decrement: Float[Array, ""]
    """|J g|: the part of the residual that the linear model removes."""
    rounding: Float[Array, ""]
    """Change of the residual by the last digits of the parameters, eps |J diag(theta)|."""


class _State(eqx.Module):
    point: _Point
    trial: Float[Array, " p"]
    predicted: Float[Array, ""]
    """Reduction of the cost that the linear model predicts for the trial."""
    usable: Bool[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    scale: Float[Array, " p"]
    moved: Float[Array, "s p"]
    changed: Float[Array, "s p"]
    """The last moves, and the change of the Gauss-Newton step with each, the newest first."""
    evaluations: Int[Array, ""]
    status: Int[Array, ""]
    done: Bool[Array, ""]


def _significant(singular: Array) -> Array:
    return singular > _DEFICIENT * singular[0]


def _point(theta: Array, residual: Array, jacobian: Array) -> tuple[_Point, Array]:
    """The point, and whether all its numbers are finite."""
    norms, cost = _norm(jacobian), residual @ residual
    finite = jnp.isfinite(jnp.sum(norms) + cost)
    columns = jnp.where(norms > 0.0, norms, 1.0)
    triangle, projected = _triangle(jacobian / columns, residual, finite)
    rank, certain, newton, decrement = _to_the_minimum(triangle, projected)
    point = _Point(
        residual=residual,
        jacobian=jacobian,
        cost=cost,
        columns=columns,
        triangle=triangle,
        projected=projected,
        rank=rank,
        certain=certain,
        newton=newton / columns,
        decrement=decrement,
        rounding=_EPS * _norm(norms * theta),
    )
    return point, finite


def _triangle(scaled: Array, residual: Array, finite: Array) -> tuple[Array, Array]:
    """R of J = Q R and Q' r, for columns of unit length; zero unless all numbers are finite."""
    n, p = scaled.shape
    k = min(n, p + 1)

    def by_reflections(_):
        # R alone is enough: the residual, appended as the last column, becomes Q' r.
        both = jnp.linalg.qr(jnp.column_stack([scaled, residual]), mode="r")
        both = jnp.where(finite, both, 0.0)
        return both[:, :-1], both[:, -1], jnp.array(True)

    if n < p + 1:
        return by_reflections(None)[:2]
    lower = jnp.linalg.cholesky(scaled.T @ scaled, symmetrize_input=False)
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(p), lower=True)
    good = _condition(lower, inverse) < _SQUARED
    begin = (
        jnp.zeros((k, p)).at[:p].set(lower.T),
        jnp.zeros(k).at[:p].set(inverse @ (residual @ scaled)),
        good & finite,
    )
    # A loop, because `vmap` over many problems would compute both branches of a condition.
    return jax.lax.while_loop(lambda found: ~found[2], by_reflections, begin)[:2]


def _condition(square: Array, inverse: Array) -> Array:
    """|R|_F |R^-1|_F, an upper bound of the condition number; nan where R is singular."""
    return _norm(square.reshape(-1)) * _norm(inverse.reshape(-1))


def _to_the_minimum(triangle: Array, projected: Array) -> tuple[Array, Array, Array, Array]:
    """Rank of R, whether a bound proves it full, the shortest step to the minimum of |R x + Q'r|,
    and the length of its image.
    """
    k, p = triangle.shape

    def by_singular_values():
        u, singular, vt = jnp.linalg.svd(triangle, full_matrices=False)
        kept = _significant(singular)
        along = jnp.where(kept, projected @ u, 0.0)
        step = -((along / jnp.where(kept, singular, 1.0)) @ vt)
        return jnp.sum(kept), jnp.array(False), step, _norm(along)

    if k < p:
        return by_singular_values()
    square = triangle[:p]
    inverse = jax.scipy.linalg.solve_triangular(square, jnp.eye(p))
    certain = _condition(square, inverse) < _CERTAIN

    def as_it_is():
        return jnp.array(p), jnp.array(True), -(inverse @ projected[:p]), _norm(projected[:p])

    return jax.lax.cond(certain, as_it_is, by_singular_values)


def _near(
    theta: Array,
    residual: Array,
    jacobian: Array,
    before: _Point,
    tolerance: Array,
    predicted: Array,
) -> tuple[_Point, Array]:
    """The point with the triangle of the previous point, and whether this shows that it is within
    the `tolerance` (in units of the residual) of the minimum.

    The factorisation of its own, which is most of the work, is then not needed. The test fails
    where the step achieved little of the `predicted` reduction: far from the minimum, where a
    Jacobian has collapsed, any step seems short by the previous triangle.
    """
    p = len(theta)
    norms, cost = _norm(jacobian), residual @ residual
    if len(before.triangle) < p:
        return before, jnp.array(False)
    square = before.triangle[:p]
    downhill = (residual @ jacobian) / before.columns
    projected = jax.scipy.linalg.solve_triangular(square, downhill, trans=1)
    newton = -jax.scipy.linalg.solve_triangular(square, projected) / before.columns
    decrement = _norm(projected)
    point = _Point(
        residual=residual,
        jacobian=jacobian,
        cost=cost,
        columns=jnp.where(norms > 0.0, norms, 1.0),
        triangle=before.triangle,
        projected=jnp.zeros_like(before.projected).at[:p].set(projected),
        rank=before.rank,
        certain=before.certain,
        newton=newton,
        decrement=decrement,
        rounding=_EPS * _norm(norms * theta),
    )
    short = predicted <= _CLOSE * before.cost
    about = short | (before.cost - cost >= _ABOUT * predicted)
    return point, before.certain & about & (decrement <= _NEAR * tolerance)


def _combined(point: _Point, moved: Array, changed: Array) -> tuple[Array, Array]:
    """The last steps of Gauss-Newton combined into one (`vcal.numerics.anderson`), and whether the
    cost curves upwards along all of the last moves.

    `moved` (s, p) and `changed` (s, p) are the last moves and the change of the step with each. The
    length that is minimised is that of the residual, |J g|. A combined step longer than `_LONGER`
    times the step of Gauss-Newton is not used.

    Towards a minimum the cost curves upwards: J'J times the change of a step is minus the Hessian
    times the move. No step is left at a saddle either, and the combination would converge to it,
    which Gauss-Newton alone does not.
    """

    def image(rows: Array) -> Array:
        return (point.triangle @ (rows * point.columns).T).T

    moves, changes, step = image(moved), image(changed), image(point.newton[None])[0]
    lengths = jnp.sqrt(jnp.sum(moves**2, axis=1))
    lengths = jnp.where(lengths > 0.0, lengths, 1.0)[:, None]
    bends = -(moves / lengths) @ (changes / lengths).T
    upwards = _positive(bends + bends.T + _FLAT * jnp.eye(_SECANTS))
    found = anderson_step_traced(point.newton, moved, changed, step, changes)
    short = _norm(image(found[None])[0]) <= _LONGER * point.decrement
    return jnp.where(short, found, point.newton), upwards


def _positive(matrix: Array) -> Array:
    """Whether a small symmetric matrix is positive definite, by the pivots of elimination."""
    found = jnp.array(True)
    for _ in range(len(matrix)):
        pivot = matrix[0, 0]
        found = found & (pivot > 0.0)
        eliminated = matrix[1:, :1] * matrix[:1, 1:] / jnp.where(pivot > 0.0, pivot, 1.0)
        matrix = matrix[1:, 1:] - eliminated
    return found


def _norm(values: Array) -> Array:
    """Euclidean norm over the first axis."""
    return jnp.sqrt(jnp.sum(values**2, axis=0))


def _noise(point: _Point) -> Array:
    """Change of the cost that may be rounding alone."""
    return _ROUNDING * point.cost + 10.0 * point.rounding * jnp.sqrt(point.cost)


class DampedGaussNewton(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton as long as it can be trusted, then Levenberg-Marquardt with geodesic
    acceleration: the solver of `least_squares`, as an optimistix solver.

    It handles one array of parameters (p,) and one of residuals (n,).
    """

    atol: float | Array
    """Remaining step at which to stop, in standard uncertainties of the parameters."""
    noise: float | Array = 0.0
    """Known standard deviation of a residual, a lower bound of the scatter s."""
    damped: bool = True
    """Whether to continue with damping where Gauss-Newton fails."""
    linearised: Callable[[Array, Any], tuple[Array, Array]] | None = None
    """Function that gives residual and Jacobian together; None: by forward derivatives."""
    rtol: float = _RELATIVE
    """Remaining step at which to stop, relative to every single parameter."""
    norm: Callable[[Any], Array] = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        n, p = f_struct.shape[0], y.shape[0]
        k, zero = min(n, p + 1), jnp.zeros((), y.dtype)
        point = _Point(
            residual=jnp.zeros(n, y.dtype),
            jacobian=jnp.zeros((n, p), y.dtype),
            cost=jnp.full((), jnp.inf, y.dtype),
            columns=jnp.ones(p, y.dtype),
            triangle=jnp.zeros((k, p), y.dtype),
            projected=jnp.zeros(k, y.dtype),
            rank=jnp.array(0),
            certain=jnp.array(False),
            newton=jnp.zeros(p, y.dtype),
            decrement=jnp.full((), jnp.inf, y.dtype),
            rounding=zero,
        )
        return _State(
            point=point,
            trial=y,
            predicted=zero,
            usable=jnp.array(True),
            damping=zero,
            growth=jnp.full((), 2.0, y.dtype),
            scale=jnp.zeros(p, y.dtype),
            moved=jnp.zeros((_SECANTS, p), y.dtype),
            changed=jnp.zeros((_SECANTS, p), y.dtype),
            evaluations=jnp.array(0),
            status=jnp.array(int(Status.STEP_LIMIT)),
            done=jnp.array(False),
        )

    def step(self, fn, y, args, options, state, tags):
        def push(tangent):
            return jax.jvp(lambda theta: fn(theta, args)[0], (state.trial,), (tangent,))

        if self.linearised is None:
            residual, jacobian = jax.vmap(push, out_axes=(None, 1))(jnp.eye(y.shape[0]))
        else:
            residual, jacobian = self.linearised(state.trial, args)
        old, first = state.point, state.evaluations == 0
        close_by, near = _near(
            state.trial,
            residual,
            jacobian,
            old,
            self.atol * self._scatter(residual, y),
            state.predicted,
        )
        new, finite = jax.lax.cond(
            near,
            lambda: (close_by, near),
            lambda: _point(state.trial, residual, jacobian),
        )

        reduction, noise = old.cost - new.cost, _noise(old)
        tiny = _CLOSE * old.cost + noise
        close = (state.predicted <= tiny) & (jnp.abs(reduction) <= tiny)
        needed = jnp.where(state.damping == 0.0, _TRUSTED, _LOWERED)
        shrunk = new.decrement < 0.99 * old.decrement
        lowered = (state.predicted > 0.0) & (reduction >= needed * state.predicted)
        # Without damping, Gauss-Newton may pass over a hill; the test of convergence is the same.
        lowered = lowered | (not self.damped)
        accept = first | (finite & state.usable & (lowered | (close & shrunk)))
        least = _LEAST * jnp.sqrt(old.cost) + 10.0 * old.rounding
        exhausted = ~first & close & ~shrunk & (old.decrement <= least)
        if not self.damped:
            # Combined steps approach minima that Gauss-Newton alone leaves again. A step that grows
            # there is no proof of rounding.
            exhausted = exhausted & (old.decrement <= 10.0 * old.rounding)

        share = jnp.where(close, 1.0, reduction / jnp.where(first, 1.0, state.predicted))
        eased = state.damping * jnp.maximum(1.0 / 3.0, 1.0 - (2.0 * share - 1.0) ** 3)
        raised = jnp.where(state.damping == 0.0, _DAMPING, state.damping * state.growth)
        damping = jnp.where(first, 0.0, jnp.where(accept, eased, raised))
        growth = jnp.where(accept, 2.0, 2.0 * state.growth)
        scale = jnp.where(accept, jnp.maximum(_FORGET * state.scale, new.columns), state.scale)
        moved = jnp.concatenate([(state.trial - y)[None], state.moved[:-1]])
        changed = jnp.concatenate([(new.newton - old.newton)[None], state.changed[:-1]])
        # Moves before the first step that shortens belong to another region of the cost.
        nearer = ~first & accept & (new.decrement < old.decrement)
        moved, changed = (jnp.where(nearer, rows, 0.0) for rows in (moved, changed))
        slow = nearer & (new.decrement > _SLOW * old.decrement)
        y = jnp.where(accept, state.trial, y)
        point = jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)

        stationary = self._stationary(y, point) | exhausted
        full = point.rank == y.shape[0]
        trial, predicted, usable = self._next(fn, y, args, point, damping, scale)
        if not self.damped:
            further, upwards = _combined(point, moved, changed)
            trial = jnp.where(slow & upwards, y + further, trial)
        hopeless = (damping > _HOPELESS) | jnp.all(trial == y) | (not self.damped)
        stuck = ~stationary & (damping > 0.0) & hopeless
        broken = first & ~finite
        status = jnp.where(stuck, int(Status.STALLED), int(Status.STEP_LIMIT))
        end = jnp.where(full, int(Status.CONVERGED), int(Status.SINGULAR))
        status = jnp.where(stationary, end, status)
        status = jnp.where(broken, int(Status.NON_FINITE), status)
        state = _State(
            point=point,
            trial=trial,
            predicted=predicted,
            usable=usable,
            damping=damping,
            growth=growth,
            scale=scale,
            moved=moved,
            changed=changed,
            evaluations=state.evaluations + 1,
            status=status,
            done=stationary | stuck | broken,
        )
        return y, state, None

    def _stationary(self, y: Array, point: _Point) -> Array:
        scatter = self._scatter(point.residual, y)
        return (
            point.decrement <= jnp.maximum(self.atol * scatter, 2.0 * point.rounding)
        ) | jnp.all(jnp.abs(point.newton) <= self.rtol * jnp.abs(y))

    def _scatter(self, residual: Array, y: Array) -> Array:
        """Standard deviation of a residual, at least the known one."""
        free = max(len(residual) - len(y), 1)
        return jnp.maximum(jnp.sqrt(residual @ residual / free), self.noise)

    def _next(self, fn, y, args, point: _Point, damping, scale):
        """The next trial, the predicted reduction of the cost, and whether it may be used."""

        def damped():
            # Parameters in units of 1 / scale, in which the damping is mu times the identity.
            u, singular, vt = jnp.linalg.svd(
                point.triangle * (point.columns / scale), full_matrices=False
            )
            inverse = 1.0 / (singular**2 + damping)
            along = inverse * singular * (u.T @ point.projected)
            velocity = -(vt.T @ along)
            predicted = jnp.sum((singular * along) ** 2) + 2.0 * damping * jnp.sum(along**2)
            # r(theta + v t + a t^2/2) stays closest to its linear model for J a = -r_vv.
            probe = fn(y + _PROBE * velocity / scale, args)[0]
            linear = point.jacobian @ (velocity / scale)
            bend = 2.0 / _PROBE * ((probe - point.residual) / _PROBE - linear)
            size = _norm(bend)
            floor = point.rounding + _EPS * jnp.sqrt(point.cost)
            significant = (size > 20.0 * floor / _PROBE**2) & (predicted > _ROUNDING * point.cost)
            finite = jnp.isfinite(size)
            bend = jnp.where(significant & finite, bend, 0.0)
            pull = (bend @ point.jacobian) / scale
            acceleration = -(vt.T @ (inverse * (vt @ pull)))
            usable = finite & (_norm(acceleration) <= _CURVED * _norm(velocity))
            move = jnp.where(usable, velocity + 0.5 * acceleration, velocity) / scale
            return move, predicted, usable

        free = (point.newton, point.decrement**2, jnp.array(True))
        move, predicted, usable = (
            jax.lax.cond(damping > 0.0, damped, lambda: free) if self.damped else free
        )
        return y + move, predicted, usable

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def least_squares(
    residual: Callable[[Array, Any], Array],
    start: Float[Array, " p"],
    args: Any = None,
    *,
    tolerance: float | Array = 1e-10,
    noise: float = 0.0,
    damped: bool = True,
    max_steps: int = 1000,
    linearised: Callable[[Array, Any], tuple[Array, Array]] | None = None,
) -> Solution:
    """Minimise |residual(theta, args)|^2 over theta (p,), from one start.

    `residual` is a pure JAX function of theta (p,) and of `args` that returns (n,). It is compiled
    once per function, set of options and set of shapes. The solver takes its forward derivative, by
    a `custom_jvp` if it has one, unless `linearised`, a function of the same arguments, returns
    residual (n,) and Jacobian (n, p) together.

    `tolerance` is the remaining step in standard uncertainties of the parameters. These follow from
    the scatter of the residuals, or from `noise`, the known standard deviation of a residual, if it
    is larger. `damped=False` is Gauss-Newton alone: it compiles in two thirds of the time and may
    diverge; what it does not solve needs a damped attempt from the same start. `max_steps` limits
    the number of steps.

    The function may be jitted and mapped. The derivative of `value` comes from the implicit
    function theorem; the other fields have none. A failure is no exception: see `Solution.status`.
    The minimum may be a local one.

    Raises `RuntimeError` where JAX runs in float32. Raises `ValueError` for a start or residual
    that is not one-dimensional, a tolerance that is not positive, a negative noise, or no steps.
    """
    require_float64()
    start = jnp.asarray(start, float)
    if start.ndim != 1 or start.size == 0:
        raise ValueError(f"start: found shape {start.shape}, expected (p,) with p of at least 1")
    if not (isinstance(tolerance, Tracer) or tolerance > 0.0):
        raise ValueError(f"tolerance: found {tolerance}, expected a positive number")
    if not noise >= 0.0:
        raise ValueError(f"noise: found {noise}, expected a standard deviation of at least 0")
    if max_steps < 1:
        raise ValueError(f"max_steps: found {max_steps}, expected at least 1")
    # As arrays they are not static: another tolerance compiles nothing.
    solver = DampedGaussNewton(
        atol=jnp.asarray(tolerance), noise=jnp.asarray(noise), damped=damped, linearised=linearised
    )
    return _solve(residual, solver, start, args, max_steps)


@eqx.filter_jit
def _solve(residual, solver: DampedGaussNewton, start: Array, args, max_steps: int) -> Solution:
    shape = jax.eval_shape(residual, start, args).shape
    if len(shape) != 1 or shape[0] == 0:
        raise ValueError(f"residual: found shape {shape}, expected (n,) with n of at least 1")
    # The first evaluation is at the start.
    found = optx.least_squares(residual, solver, start, args, max_steps=max_steps + 1, throw=False)
    point = found.state.point
    singular = jnp.linalg.svd(point.jacobian / point.columns, compute_uv=False)
    smallest = singular[-1] if len(singular) == len(start) else jnp.array(0.0)
    zero = smallest == 0.0
    # optimistix refuses a start that is not finite before the first evaluation.
    refused = found.state.evaluations == 0
    return Solution(
        value=found.value,
        status=jnp.where(refused, int(Status.NON_FINITE), found.state.status),
        steps=found.state.evaluations - jnp.where(refused, 0, 1),
        cost=point.cost,
        residual=point.residual,
        jacobian=point.jacobian,
        rank=point.rank,
        condition=jnp.where(zero, jnp.inf, singular[0] / jnp.where(zero, 1.0, smallest)),
    )


def covariance(solution: Solution, *, scaled: bool = True) -> Float[Array, "p p"]:
    """Covariance of the parameters (p, p), s^2 (J'J)^-1 at the minimum.

    s^2 = |r|^2 / (n - p) if `scaled`, else one, for residuals that are whitened already. It is
    computed from the singular values of the Jacobian with columns of unit length. All elements are
    nan where the Jacobian is rank deficient: some variance is then infinite. `solution` is a single
    one; use `vmap` for many.

    Raises `ValueError` if `scaled` and there are not more residuals than parameters.
    """
    n, p = solution.jacobian.shape
    if scaled and n <= p:
        raise ValueError(
            f"covariance: found {n} residuals for {p} parameters, which leaves none to estimate "
            "their scatter; expected more, or scaled=False for residuals in units of their noise"
        )
    norms = _norm(solution.jacobian)
    columns = jnp.where(norms > 0.0, norms, 1.0)
    _, singular, vt = jnp.linalg.svd(solution.jacobian / columns, full_matrices=False)
    full = solution.rank == p
    root = vt / jnp.where(full, singular, jnp.nan)[:, None] / columns
    variance = solution.cost / (n - p) if scaled else 1.0
    return variance * (root.T @ root)
