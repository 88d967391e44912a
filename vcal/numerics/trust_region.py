"""Least squares with a prior, by a trust region: for strongly curved problems.

    minimise  |r(z)|^2,    r(z) = (data residual, z),    z in standard deviations of the prior

A parameter that a catalogue gives within a factor of two is far from linear for data that are a
thousand times more accurate: a Gauss-Newton step from the catalogue value may end anywhere. Each
step is therefore the minimum of the linear model within |dz| <= radius, in standard deviations of
the prior. It is found from the eigenvalues of J'J, all of which are at least one (More', Sorensen
1983, SIAM J. Sci. Stat. Comput. 4, 553). The radius grows where the linear model predicted the
cost, and shrinks where it did not.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Bool, Float, Int

from .arrays import Array
from .least_squares import Status
from .spatial import require_float64

_RADIUS = 1.0
"""First radius, standard deviations of the prior."""
_GOOD, _POOR = 0.75, 0.25
"""Shares of the predicted reduction above which the radius grows, and below which it shrinks."""
_ACCEPTED = 1e-3
_LOST = 1e-10
"""Radius at which a step no longer changes anything."""
_ROUNDING = 1e-11
"""Predicted reduction, relative to the cost, that may be rounding alone."""
_SECULAR = 6
"""Newton steps for the length of a step; each doubles the digits."""


class Found(eqx.Module):
    """The end of a search within the prior. Under `vmap` every field has a leading axis."""

    value: Float[Array, " k"]
    """z, in standard deviations of the prior."""
    status: Int[Array, ""]
    """A `Status`."""
    steps: Int[Array, ""]
    """Number of evaluations after the first one, at the start."""
    cost: Float[Array, ""]
    """|r|^2 at `value`."""
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n k"]

    @property
    def covariance(self) -> Float[Array, "k k"]:
        """(J'J)^-1, the posterior covariance in units of the prior."""
        return jnp.linalg.inv(self.jacobian.T @ self.jacobian)


class _State(eqx.Module):
    trial: Float[Array, " k"]
    residual: Float[Array, " n"]
    jacobian: Float[Array, "n k"]
    cost: Float[Array, ""]
    radius: Float[Array, ""]
    predicted: Float[Array, ""]
    """Reduction of the cost that the linear model predicts for the trial."""
    length: Float[Array, ""]
    """Length of the step to the trial."""
    evaluations: Int[Array, ""]
    status: Int[Array, ""]
    done: Bool[Array, ""]


class TrustRegion(optx.AbstractLeastSquaresSolver):
    """The step of More' and Sorensen, as an optimistix solver; `y` is the vector z."""

    tolerance: float | Array
    """Remaining step at which to stop, sqrt(g' H^-1 g), in posterior standard deviations."""
    # optimistix requires these names of every solver; convergence is judged by the tolerance alone.
    rtol: float = 0.0
    atol: float = 0.0
    norm: Any = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        n, k = f_struct.shape[0], y.shape[0]
        return _State(
            trial=y,
            residual=jnp.zeros(n),
            jacobian=jnp.zeros((n, k)),
            cost=jnp.asarray(jnp.inf),
            radius=jnp.asarray(_RADIUS),
            predicted=jnp.asarray(1.0),
            length=jnp.asarray(0.0),
            evaluations=jnp.asarray(0),
            status=jnp.asarray(int(Status.STEP_LIMIT)),
            done=jnp.asarray(False),
        )

    def step(self, fn, y, args, options, state, tags):
        residual, push = jax.linearize(lambda z: fn(z, args)[0], state.trial)
        jacobian = jax.vmap(push, out_axes=1)(jnp.eye(y.shape[0]))
        cost = residual @ residual
        first = state.evaluations == 0
        finite = jnp.isfinite(cost) & jnp.isfinite(jacobian).all()
        share = jnp.where(finite, (state.cost - cost) / state.predicted, -jnp.inf)
        accept = (first | (share > _ACCEPTED)) & finite
        edge = state.length >= 0.9 * state.radius
        radius = jnp.where(~first & (share > _GOOD) & edge, 2.0 * state.radius, state.radius)
        radius = jnp.where(~first & ~(share > _POOR), 0.25 * state.length, radius)
        y = jnp.where(accept, state.trial, y)
        residual, jacobian, cost = (
            jnp.where(accept, new, old)
            for new, old in (
                (residual, state.residual),
                (jacobian, state.jacobian),
                (cost, state.cost),
            )
        )
        gradient = residual @ jacobian
        values, vectors = jnp.linalg.eigh(jacobian.T @ jacobian)
        along = gradient @ vectors
        newton = (along**2 / values).sum()
        step, predicted = _within(values, along, radius)
        # The remaining step is rounding, or shorter than the tolerance.
        stationary = (newton <= self.tolerance**2) | (newton <= _ROUNDING * cost)
        broken = first & ~finite
        lost = ~stationary & (radius < _LOST)
        status = jnp.where(stationary, int(Status.CONVERGED), int(Status.STEP_LIMIT))
        status = jnp.where(lost, int(Status.STALLED), status)
        status = jnp.where(broken, int(Status.NON_FINITE), status)
        state = _State(
            trial=y + vectors @ step,
            residual=residual,
            jacobian=jacobian,
            cost=cost,
            radius=radius,
            predicted=predicted,
            length=jnp.linalg.norm(step),
            evaluations=state.evaluations + 1,
            status=status,
            done=stationary | lost | broken,
        )
        return y, state, None

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def _within(values: Array, along: Array, radius: Array) -> tuple[Array, Array]:
    """The step -(H + mu)^-1 g, at most as long as the radius, along the eigenvectors of H, and the
    reduction of the cost that the linear model predicts for it.
    """
    free = jnp.linalg.norm(along / values)
    # 1 / |step(mu)| is nearly linear in mu: Newton's iteration on it rises to the solution.
    mu = jnp.asarray(0.0)
    for _ in range(_SECULAR):
        scaled = along / (values + mu)
        length = jnp.linalg.norm(scaled)
        slope = (scaled**2 / (values + mu)).sum()
        step = length**2 / jnp.maximum(slope, 1e-300) * (length - radius) / radius
        mu = jnp.maximum(mu + step, 0.0)
    mu = jnp.where(free > radius, mu, 0.0)
    step = -along / (values + mu)
    return step, -(2.0 * along @ step + values @ step**2)


def within_prior(
    residual: Callable[[Array, Any], Array],
    start: Float[Array, " k"],
    args: Any = None,
    *,
    tolerance: float = 1e-3,
    max_steps: int = 60,
) -> Found:
    """Minimise |residual(z, args)|^2 over z (k,), in standard deviations of the prior.

    `residual` returns the whitened data residual followed by the rows of the prior, z itself.
    `tolerance` is the remaining step in posterior standard deviations, `max_steps` limits the
    number of steps. The function may be jitted and mapped. A failure is no exception: see
    `Found.status`. The minimum may be a local one.

    Raises `RuntimeError` where JAX runs in float32.
    """
    require_float64()
    solver = TrustRegion(tolerance=jnp.asarray(tolerance))
    # The first evaluation is at the start.
    found = optx.least_squares(residual, solver, start, args, max_steps=max_steps + 1, throw=False)
    state = found.state
    return Found(
        found.value,
        state.status,
        state.evaluations - 1,
        state.cost,
        state.residual,
        state.jacobian,
    )
