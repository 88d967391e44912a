"""Identification of many measurements that differ little from one nominal problem.

All draws of a Monte Carlo campaign share the plan, the model and very nearly the curvature
H = J'J + L of the cost

    f(theta) = |W (y - h(theta))|^2 / 2 + |L^(1/2) theta|^2 / 2.

The nominal problem is therefore linearised and H factorised once. Every draw starts at the linear
solution and takes steps theta <- theta - H^-1 g with its own exact gradient g. It ends where the
Newton decrement sqrt(g' H^-1 g), the remaining distance in posterior standard deviations, is small.
Where the error motions are 1e-5, one such step is enough. Where they are so large that H differs
from draw to draw (an arm whose links deviate by a milliradian), every draw needs its own curvature:
`identify_alone`.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.scipy.sparse.linalg import cg
from jaxtyping import Bool, Float, Int

from ..instruments.base import Instrument
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..model.declared_noise import declared_whitener
from ..model.forward import Model, Shapes, observe_columns, observe_with_jacobian, port_values
from ..model.measurement import Measurement
from ..model.port_map import PortMap, port_map
from ..model.prior import Amplitudes
from ..numerics.arrays import Array
from ..numerics.least_squares import least_squares
from ..numerics.spatial import require_float64
from .fit import entries, shape_step
from .linearised import linearised_terms

_SHARED = 0.5
"""Contraction up to which the shared curvature is used: 12 steps then gain three digits."""
_INNER, _MOST_INNER = 1e-3, 100
"""Relative accuracy to which a step with its own curvature is solved, and the largest number of
iterations."""
_MACHINES = 3
"""Number of machines drawn from the prior whose curvature is compared with the nominal one."""
_CAREFUL = 10.0
"""Safety factor on the contraction observed in the last step, which is a single observation."""


class _Steps(eqx.Module):
    """State of `SharedCurvature`."""

    decrement: Float[Array, ""]
    """Length of the last step, in posterior standard deviations."""
    before: Float[Array, ""]
    """Length of the previous step."""
    count: Int[Array, ""]


class SharedCurvature(optx.AbstractLeastSquaresSolver):
    """theta <- theta - H^-1 g(theta): a fixed H, the exact gradient g, as an optimistix solver.

    `y` is the parameter vector. The iteration has converged when the Newton decrement, reduced by
    the contraction of the step just taken, is below `tolerance`; it has diverged when steps grow.
    The contraction is the larger of the observed and the expected one: a long first step, in which
    nearly all parameters converge at once, hides the few that converge slowly.
    `options["decrement"]` is the length of the step that led to the start, if there was one;
    `options["state"]` is a state to continue from.
    """

    inverse: Float[Array, "k k"]
    """H^-1, shared by all problems."""
    tolerance: float
    expected: Float[Array, ""] | float = 0.0
    """Contraction of steps in the slowest direction."""
    # optimistix requires these names of every solver; convergence is judged by the decrement alone.
    rtol: float = 0.0
    atol: float = 0.0
    norm: Any = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _Steps:
        if "state" in options:
            return options["state"]
        first = jnp.asarray(options.get("decrement", jnp.inf))
        return _Steps(first, jnp.asarray(jnp.inf), jnp.asarray(0))

    def step(self, fn, y, args, options, state, tags):
        del options, tags
        residual, pull, aux = jax.vjp(lambda theta: fn(theta, args), y, has_aux=True)
        (gradient,) = pull(residual)
        step = self.inverse @ gradient
        # Rounding may make the product slightly negative where the gradient is zero.
        decrement = jnp.sqrt(jnp.maximum(gradient @ step, 0.0))
        return y - step, _Steps(decrement, state.decrement, state.count + 1), aux

    def terminate(self, fn, y, args, options, state, tags):
        contraction = jnp.where(jnp.isfinite(state.before), state.decrement / state.before, 1.0)
        slowest = self.expected / (1.0 - jnp.minimum(self.expected, 0.9))
        left = jnp.maximum(jnp.minimum(_CAREFUL * contraction, 1.0), slowest) * state.decrement
        done = (state.count > 0) & (left < self.tolerance)
        grows = (state.count > 0) & ~(state.decrement <= 10.0 * state.before)
        result = optx.RESULTS.where(
            grows, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        return done | grows, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


class OwnCurvature(SharedCurvature):
    """`SharedCurvature` with the curvature at theta itself, H(theta) = J'J + L.

    A step solves (R H(theta) R') w = R g by conjugate gradients, with R'R = H^-1 of the nominal
    problem. R H(theta) R' is nearly the identity, so that a few products with J are enough; J is
    never computed. |w| is in posterior standard deviations. Gradients are exact, so that an
    inaccurate step costs a further step and nothing else.
    """

    root: Float[Array, "k k"] = eqx.field(kw_only=True)
    """R, with R'R = H^-1 of the nominal problem."""

    def step(self, fn, y, args, options, state, tags):
        del options, tags
        residual, push, aux = jax.linearize(lambda theta: fn(theta, args), y, has_aux=True)
        pull = jax.linear_transpose(push, y)

        def product(w: Array) -> Array:
            return self.root @ pull(push(self.root.T @ w))[0]

        gradient = self.root @ pull(residual)[0]
        step, _ = cg(product, gradient, tol=_INNER, maxiter=_MOST_INNER)
        decrement = jnp.sqrt(jnp.maximum(gradient @ step, 0.0))
        return y - self.root.T @ step, _Steps(decrement, state.decrement, state.count + 1), aux


class Batch(eqx.Module):
    """A model on a plan, linearised once, prepared for identification from many measurements.

    Parameters are in solver units: the amplitudes, then the shape parameters that move, as in
    `Fit.entries`. Shape parameters are in steps of their scan, from their nominal values.
    """

    chain: Chain
    instrument: Instrument
    plan: Plan
    rows: Any
    ports: PortMap
    shapes: tuple[tuple[int, str, Float[Array, ""], Float[Array, ""]], ...]
    """Shape parameters that move: position of the effect, name, nominal value and step (SI)."""
    fixed: dict[int, dict[str, Float[Array, ""]]]
    """Values (SI) of the other shape parameters of the effects that have a moving one."""
    nominal_shapes: dict[int, dict[str, float]]
    """Nominal values (SI) of all shape parameters."""
    amplitudes: int = eqx.field(static=True)
    """Number of amplitudes."""
    start: Float[Array, " k"]
    """Nominal parameters, about which the problem is linearised."""
    nominal: Float[Array, "n m"]
    """Readings at the nominal parameters."""
    whitener: Float[Array, "n m m"]
    """W of the declared noise."""
    independent: bool = eqx.field(static=True)
    """Whether the readings of a row are independent: the whitener is diagonal."""
    root_precision: Float[Array, " k"]
    """Diagonal of L^(1/2)."""
    jacobian: Float[Array, "nm k"]
    """Whitened Jacobian at the nominal parameters."""
    curvature: Float[Array, "k k"]
    """H = J'J + L."""
    inverse: Float[Array, "k k"]
    """H^-1: the posterior covariance."""
    root: Float[Array, "k k"]
    """R, with R' R = H^-1."""
    gain: Float[Array, "k nm"]
    """H^-1 J' W: the linear estimate from a residual."""
    contraction: Float[Array, ""]
    """Ratio of the distances to the solution after and before a step with the shared curvature, in
    the worst direction close to the solution: the spectral radius of 1 - H^-1 H(theta), median over
    machines drawn from the prior.
    """

    @property
    def shared(self) -> bool:
        """Whether the draws differ so little that they can share one curvature."""
        return float(self.contraction) < _SHARED

    def shape_values(self, theta: Float[Array, " k"]) -> dict[int, dict[str, Any]]:
        """Shape parameters (SI) of the effects that have a moving one, by the effect's position."""
        values: dict[int, dict[str, Any]] = {i: dict(known) for i, known in self.fixed.items()}
        for place, (i, name, at, step) in enumerate(self.shapes, start=self.amplitudes):
            values.setdefault(i, {})[name] = at + step * theta[place]
        return values

    def predict(self, theta: Float[Array, " k"]) -> Float[Array, "n m"]:
        """Reduced readings (n, m) of the parameters `theta` (k,), SI."""
        ports = self.ports(theta, self.shape_values(theta))
        position = self.plan.position
        readings = observe_columns(self.chain, self.instrument, position, self.rows, ports)
        return self.instrument.reduce(jnp.stack(readings, -1), self.plan)

    def residual(self, theta: Float[Array, " k"], readings: Float[Array, "n m"]) -> Array:
        """The residual whose square is minimised: the whitened data residual, then the rows of the
        prior (n m + k,).
        """
        if not self.chain.linear:
            return self.dense_residual(theta, readings)
        off = self.instrument.difference(readings, self.predict(theta))
        return jnp.concatenate([self._whitened(off), self.root_precision * theta])

    def dense_residual(self, theta: Float[Array, " k"], readings: Float[Array, "n m"]) -> Array:
        """`residual`, differentiated through the derivatives of the readings by all ports.

        This uses the kinematics in arrays. They compile in seconds even for the long expressions of
        rotary axes, but run more slowly.
        """

        @jax.custom_jvp
        def residual(theta, readings):
            return self._dense(theta, readings)[0]

        @residual.defjvp
        def _(primals, tangents):
            value, by_port = self._dense(*primals)
            _, moved = jax.jvp(self._port_table, (primals[0],), (tangents[0],))
            off = tangents[1] - jnp.einsum("nmp,np->nm", by_port, moved)
            return value, jnp.concatenate([self._whitened(off), self.root_precision * tangents[0]])

        return residual(theta, readings)

    def _dense(self, theta: Array, readings: Array) -> tuple[Array, Array]:
        """The residual, and the derivatives of the reduced readings by the ports (n, m, p)."""
        predicted, by_port = observe_with_jacobian(
            self.chain, self.instrument, self.plan.position, self.rows, self._port_table(theta)
        )
        predicted = self.instrument.reduce(predicted, self.plan)
        off = self._whitened(self.instrument.difference(readings, predicted))
        by_port = self.instrument.reduce(by_port, self.plan)
        return jnp.concatenate([off, self.root_precision * theta]), by_port

    def _port_table(self, theta: Array) -> Float[Array, "n p"]:
        ports, rows = self.ports(theta, self.shape_values(theta)), self.plan.position.shape[0]
        return jnp.stack([jnp.broadcast_to(p, (rows,)) for p in ports], -1)

    def _whitened(self, off: Float[Array, "n m"]) -> Float[Array, " nm"]:
        if self.independent:
            return (jnp.diagonal(self.whitener, axis1=1, axis2=2) * off).reshape(-1)
        return (self.whitener * off[:, None, :]).sum(-1).reshape(-1)

    def linear(self, readings: Float[Array, "n m"]) -> tuple[Float[Array, " k"], Float[Array, ""]]:
        """The solution of the linearised problem (k,), and its distance from the nominal parameters
        in posterior standard deviations.
        """
        off = self.instrument.difference(readings, self.nominal).reshape(-1)
        step = self.gain @ off - self.inverse @ (self.root_precision**2 * self.start)
        # Rounding may make the square slightly negative where it is zero.
        return self.start + step, jnp.sqrt(jnp.maximum(step @ (self.curvature @ step), 0.0))


class Identified(NamedTuple):
    """One identified draw."""

    theta: Float[Array, " k"]
    """Parameters in solver units."""
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    """Number of exact gradients that were computed."""


def prepare_batch(
    model: Model,
    plan: Plan,
    *,
    shapes: Shapes | None = None,
    theta: Float[np.ndarray, " a"] | None = None,
) -> Batch:
    """The part of a batched identification that is the same for every draw.

    The problem is linearised about the amplitudes `theta` (a,) in solver units, zero by default,
    and the `shapes` (SI). Shape parameters that are not given have their declared value, or the
    middle of their scan.

    Raises `RuntimeError` where JAX runs in float32. Raises `ValueError` where theta does not fit,
    or where data and prior leave a parameter undetermined; a shape parameter is undetermined as
    long as its effect has no amplitude.
    """
    require_float64()
    model.check_plan(plan)
    at = {
        i: {name: float(value) for name, value in shape.items()}
        for i, shape in model.shapes_at(plan, shapes).items()
    }
    rows = model.instrument.rows(plan)
    names = entries(model)
    moving = sorted({i for i, e in enumerate(model.effects) if any(p.moves for p in e.shapes)})
    size = len(names)
    begin = np.zeros(size)
    if theta is not None:
        if np.shape(theta) != (len(model.entries),):
            raise ValueError(
                f"theta: found shape {np.shape(theta)}, expected ({len(model.entries)},), one "
                "value per amplitude of the model; `Model.entries` lists them in order"
            )
        begin[: len(model.entries)] = theta
    terms = linearised_terms(model, plan, at, begin)

    def linearised(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Readings (n, m), and their derivative by every term of the ports (n, m, t), SI."""
        ports = port_values(terms, jnp.asarray(theta), len(model.layout))
        readings, by_port = observe_with_jacobian(
            model.chain, model.instrument, plan.position, rows, ports
        )
        by_port = np.asarray(model.instrument.reduce(by_port, plan))
        return (
            np.asarray(model.instrument.reduce(readings, plan)),
            by_port[:, :, terms.port] * np.asarray(terms.values)[:, None, :],
        )

    nominal, by_term = linearised(begin)
    whitener = declared_whitener(model, Measurement(plan, nominal))

    def whitened(by_term: np.ndarray) -> np.ndarray:
        """The whitened Jacobian (n m, k)."""
        by_term = np.einsum("nij,njt->nit", whitener, by_term)
        found = np.zeros((by_term.shape[0] * by_term.shape[1], size))
        np.add.at(found.T, np.asarray(terms.parameter), by_term.reshape(len(found), -1).T)
        return found

    jacobian = whitened(by_term)
    precision = np.array([float(p.informed) if not p.shape else 0.0 for _, p in names])
    curvature = jacobian.T @ jacobian + np.diag(precision)
    _check_determined(curvature, names)
    root = np.linalg.inv(np.linalg.cholesky(curvature))
    inverse = root.T @ root
    machines = Amplitudes.of(model.effects)
    rates = []
    for key in jax.random.split(jax.random.key(0), _MACHINES):
        drawn = begin.copy()
        drawn[: len(model.entries)] += np.asarray(machines.sample(key))
        own = whitened(linearised(drawn)[1])
        # H^-1 H(theta), made symmetric.
        relative = root @ (own.T @ own + np.diag(precision)) @ root.T
        rates.append(np.abs(1.0 - np.linalg.eigvalsh(relative)).max())
    n, m = nominal.shape
    weighted = np.einsum("nik,nij->njk", jacobian.reshape(n, m, size), whitener)
    moves, fixed = _shapes(model, plan, at, moving)
    return Batch(
        chain=model.chain,
        instrument=model.instrument,
        plan=plan,
        rows=rows,
        ports=port_map(model, plan, at, moving),
        shapes=moves,
        fixed=fixed,
        nominal_shapes=at,
        amplitudes=len(model.entries),
        start=jnp.asarray(begin),
        nominal=jnp.asarray(nominal),
        whitener=jnp.asarray(whitener),
        independent=not (whitener * (1.0 - np.eye(whitener.shape[1]))).any(),
        root_precision=jnp.asarray(np.sqrt(precision)),
        jacobian=jnp.asarray(jacobian),
        curvature=jnp.asarray(curvature),
        inverse=jnp.asarray(inverse),
        root=jnp.asarray(root),
        gain=jnp.asarray(inverse @ weighted.reshape(n * m, size).T),
        contraction=jnp.asarray(np.median(rates)),
    )


def _check_determined(
    curvature: Float[np.ndarray, "k k"], names: Sequence[tuple[str, Parameter]]
) -> None:
    """Raise `ValueError` where a parameter, or a combination of them, is not determined."""
    diagonal = np.diag(curvature)
    lost = np.flatnonzero(diagonal == 0.0).tolist()
    if lost or np.linalg.cond(curvature / np.sqrt(np.outer(diagonal, diagonal))) > 1e14:
        names_lost = ", ".join(f"{names[i][0]} {names[i][1].name}" for i in lost) or "a combination"
        raise ValueError(
            f"neither data nor prior determine {names_lost} near the nominal parameters; give a "
            "prior, a plan that observes it, or (shape parameters) nominal amplitudes `theta`"
        )


def _shapes(
    model: Model, plan: Plan, at: Shapes, moving: Iterable[int]
) -> tuple[tuple[tuple[int, str, Array, Array], ...], dict[int, dict[str, Array]]]:
    """Shape parameters of the effects at the positions `moving`: those that move, as (effect, name,
    value, step), and the values of the others (SI).
    """
    moves, fixed = [], {}
    for i in moving:
        grids = model.effects[i].scan(plan)
        for p in model.effects[i].shapes:
            value = at[i][p.name]
            if p.moves:
                step = shape_step(p, value, grids)
                moves.append((i, p.name, jnp.asarray(value), jnp.asarray(step)))
            else:
                fixed.setdefault(i, {})[p.name] = jnp.asarray(value)
    return tuple(moves), fixed


def identify_one(
    batch: Batch, readings: Float[Array, "n m"], *, tolerance: float = 1e-3, steps: int = 12
) -> Identified:
    """Identify one draw with the shared curvature: a pure function, to be mapped over readings.

    `readings` (n, m) are in SI, `tolerance` is in posterior standard deviations. `steps` is the
    largest number of exact gradients; `Identified.converged` states whether it was enough.
    """
    start, length = batch.linear(readings)
    shared = SharedCurvature(inverse=batch.inverse, tolerance=tolerance, expected=batch.contraction)
    return _stepped(batch.residual, shared, start, length, readings, steps)


def _stepped(residual, solver: SharedCurvature, start, length, readings, steps: int) -> Identified:
    # One step is mostly enough. Before the loop, it is compiled together with the simulation of the
    # readings, which takes half the time; the loop is entered only where one step is not enough.
    def with_aux(theta, y):
        return residual(theta, y), None

    given = start, readings, {"decrement": length}
    state = solver.init(with_aux, *given, None, None, frozenset())
    first, state, _ = solver.step(with_aux, *given, state, frozenset())
    return _driven(with_aux, solver, first, state, readings, steps)


def _driven(function, solver: SharedCurvature, start, state: _Steps, readings, steps) -> Identified:
    """Step until the solver ends, or has made `steps` steps.

    A draw is not differentiated, and its solver has no auxiliary output. `optimistix.least_squares`
    prepares for both, and takes two thirds longer to compile.
    """
    rest = readings, {}

    def ended(theta: Array, state: _Steps):
        return solver.terminate(function, theta, *rest, state, frozenset())

    def goes_on(now):
        return ~ended(*now)[0] & (now[1].count < steps)

    def step(now):
        theta, state = now
        return solver.step(function, theta, *rest, state, frozenset())[:2]

    theta, state = jax.lax.while_loop(goes_on, step, (start, state))
    done, result = ended(theta, state)
    good = done & (result == optx.RESULTS.successful) & jnp.all(jnp.isfinite(theta))
    return Identified(theta, good, state.count)


def identify_alone(
    batch: Batch, readings: Float[Array, "n m"], *, tolerance: float = 1e-3, steps: int = 12
) -> Identified:
    """Identify one draw with its own curvature, for draws that differ too much from the nominal
    problem; arguments as in `identify_one`.
    """
    start, _ = batch.linear(readings)
    start = jnp.where(jnp.isfinite(start), start, 0.0)
    own = OwnCurvature(inverse=batch.inverse, tolerance=tolerance, root=batch.root)

    def with_aux(theta, y):
        return batch.dense_residual(theta, y), None

    state = own.init(with_aux, start, readings, {}, None, None, frozenset())
    return _driven(with_aux, own, start, state, readings, steps)


def identify_damped(
    batch: Batch, readings: Float[Array, "n m"], *, tolerance: float = 1e-3
) -> Identified:
    """Identify one draw by damped least squares from the linear solution; arguments as in
    `identify_one`.
    """
    start, _ = batch.linear(readings)
    start = jnp.where(jnp.isfinite(start), start, 0.0)
    # The residuals are whitened: their standard deviation is known to be one.
    found = least_squares(batch.dense_residual, start, readings, tolerance=tolerance, noise=1.0)
    return Identified(found.value, found.converged, found.steps)
