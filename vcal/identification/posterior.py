"""The posterior covariance that a plan will give, as a function that is differentiable by the plan.

    H = sum over rows of J' C^-1 J + L,      covariance = H^-1

J is the derivative of the readings of a row by the amplitudes at the nominal machine, C the
covariance of these readings, and L the precision of the prior. Positions of the axes, numbers of
the instrument and sizes of random effects may be traced, so that the uncertainty has a gradient
with respect to all of them.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..machine.plan import Plan
from ..model.forward import Model, observe_with_jacobian
from ..model.simulate import scattering
from ..numerics.arrays import Array, namespace

_NOTHING = 1e-30
"""Lower bound of a variance, SI: the square root has no derivative at zero."""


def jacobian(model: Model, plan: Plan) -> Float[Array, "n m k"]:
    """Derivative (n, m, k) of the readings (SI) by the amplitudes in solver units
    (`Model.entries`), at the nominal machine.

    Shape parameters are held at their declared values. Raises `ValueError` for a model whose
    effects have shape parameters that are not declared: the response to their amplitudes is then
    unknown.
    """
    return _with_ports(model, plan)[0]


def open_shapes(effect: Effect) -> set[str]:
    """Names of the shape parameters without a declared value."""
    return {p.name for p in effect.shapes} - {name for name, *_ in effect.given}


def check_shapes(model: Model) -> None:
    """Raise `ValueError` for effects with shape parameters that are not declared."""
    for effect in model.effects:
        if loose := open_shapes(effect):
            raise ValueError(
                f"effect {effect.key!r}: found the free shape parameter {min(loose)!r}, expected "
                "declared ones, because a plan is evaluated at the nominal machine"
            )


def _with_ports(
    model: Model, plan: Plan
) -> tuple[Float[Array, "n m k"], Float[Array, "n m"], Float[Array, "n m p"]]:
    """`jacobian`, the readings at the nominal machine, and their derivative by the ports."""
    check_shapes(model)
    instrument = model.instrument
    still = jnp.zeros((plan.rows, len(model.layout)))
    readings, by_port = observe_with_jacobian(
        model.chain, instrument, plan.position, instrument.rows(plan), still
    )
    readings, by_port = (instrument.reduce(v, plan) for v in (readings, by_port))
    return slopes(model.effects, model, plan, by_port), readings, by_port


def information(model: Model, plan: Plan) -> Float[Array, "n k k"]:
    """Information matrix J' C^-1 J of every row (n, k, k). Raises as `jacobian` does."""
    J = whitened(model, plan)
    return jnp.einsum("nik,nil->nkl", J, J)


def whitened(model: Model, plan: Plan) -> Float[Array, "n m k"]:
    """W J of every row (n, m, k), with W'W = C^-1. Raises as `jacobian` does."""
    J, readings, by_port = _with_ports(model, plan)
    # Instrument.noise is typed for numpy. With a traced plan, the instrument must support tracing.
    sigma = jnp.asarray(model.instrument.noise(plan, readings))  # type: ignore[arg-type]
    if not model.random:
        return J / sigma[:, :, None]
    scatter = fresh_scatter(model, plan, by_port)
    return by_root(sigma[:, :, None] ** 2 * jnp.eye(sigma.shape[1]), scatter, J)


def fresh_scatter(
    model: Model, plan: Plan, by_port: Float[Array, "n m p"]
) -> Float[Array, "n m r"]:
    """Change of the readings of a row (n, m, r) by one standard deviation of every random effect,
    SI.
    """
    return slopes([scattering(effect) for effect in model.random], model, plan, by_port)


def by_root(
    noise: Float[Array, "n m m"], scatter: Float[Array, "n m r"], J: Float[Array, "n m k"]
) -> Float[Array, "n m k"]:
    """L^-1 J of every row (n, m, k), with L L' = noise + scatter scatter'."""
    noise = noise + jnp.einsum("nik,njk->nij", scatter, scatter)
    return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(noise), J, lower=True)


def precision(model: Model) -> Float[np.ndarray, "k k"]:
    """L (k, k) of the amplitudes in solver units: one on the diagonal, zero for a flat prior."""
    return np.diag([float(e.parameter.informed) for e in model.entries])


def curvature(model: Model, plan: Plan) -> Float[Array, "k k"]:
    """H (k, k) of the amplitudes in solver units. Raises as `information` does."""
    return information(model, plan).sum(0) + precision(model)


def covariance(model: Model, plan: Plan) -> Float[Array, "k k"]:
    """H^-1 (k, k) of the amplitudes in solver units. Raises as `information` does.

    Where the plan cannot separate parameters, elements are not finite, or very large.
    """
    return inverse(curvature(model, plan))


def inverse(H: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """H^-1, computed with the diagonal of H scaled to one."""
    scale = 1.0 / jnp.sqrt(jnp.diagonal(H))
    return scale[:, None] * jnp.linalg.inv(scale[:, None] * H * scale) * scale


def eliminated(
    joint: Float[Array, "n n"], own: Float[Array, "k k"], shared: Float[Array, "s s"]
) -> Float[Array, "k k"]:
    """H (k, k) of the first k parameters of the information matrix `joint`, with the other s
    eliminated: the Schur complement

        H = J_kk + own - J_ks (J_ss + shared)^-1 J_sk.

    `own` and `shared` are the prior precisions of both groups; zero is a flat prior.
    """
    k = own.shape[0]
    H = joint[:k, :k] + own
    if not shared.shape[0]:
        return H
    inner, reach = joint[k:, k:] + shared, joint[:k, k:]
    # Scaled to a unit diagonal, as the smallest and the largest precision differ by many decades.
    scale = 1.0 / jnp.sqrt(jnp.diagonal(inner))
    reach = reach * scale
    return H - reach @ jnp.linalg.solve(scale[:, None] * inner * scale, reach.T)


def expanded(
    functionals: Float[Array, "q k"], covariance: Float[Array, "k k"], coverage: float = 2.0
) -> Float[Array, " q"]:
    """Expanded uncertainty U = k sqrt(d' C d) of linear functionals d (q, k) of the amplitudes.

    `covariance` is C (k, k) in solver units, `coverage` the coverage factor k.

    For a functional of zero, such as an odd error function at mid-travel, U and its derivative are
    zero.
    """
    variance = jnp.einsum("qk,kl,ql->q", functionals, covariance, functionals)
    return coverage * jnp.sqrt(jnp.maximum(variance, _NOTHING))


def slopes(
    effects: Sequence[Effect], model: Model, plan: Plan, by_port: Float[Array, "n m p"]
) -> Float[Array, "n m k"]:
    """Derivative (n, m, k) of the readings by the amplitudes of some effects, in solver units, from
    the derivative by the ports.
    """
    columns, ports, places, start = [], [], [], 0
    for effect in effects:
        shape = {p.name: np.asarray(p.mean * p.si) for p in effect.shapes}
        own = {p.name: (start + k, p.step) for k, p in enumerate(effect.amplitudes)}
        for (port, name), response in effect.response(plan, shape).items():
            place, step = own[name]
            xp = namespace(response)
            columns.append(xp.broadcast_to(xp.asarray(response), (plan.rows,)) * step)
            ports.append(model.layout.index(port))
            places.append(place)
        start += len(own)
    xp = namespace(by_port, *columns)
    if not columns:
        return xp.zeros((*np.shape(by_port)[:2], start))
    by_term = by_port[:, :, np.array(ports)] * xp.stack(columns, -1)[:, None, :]
    return by_term @ np.eye(start)[np.array(places)]
