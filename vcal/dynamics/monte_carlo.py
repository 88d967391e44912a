"""Monte Carlo of the identification: many machines, each measured by circles and identified.

Every machine is drawn from the catalogue (z and the errors of the probes are standard normal). Its
circles are simulated sample by sample with the noise of scales and probes and reduced to their
amplitudes, from which the machine is identified.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..numerics.arrays import Array
from ..numerics.least_squares import Status
from .bodies import Machine
from .circles import Phasors, set_phasors
from .closed_loop import controlled, settles
from .control import Controller
from .identify import Task, solve, task
from .quasi_static import compliance
from .setpoints import SetCircle
from .structure import assemble
from .unknowns import Unknown, applied

_BLOCK = 20


@dataclass(frozen=True)
class Noise:
    """White noise of an R-test, and the number of samples per turn.

    Raises `ValueError` for noise that is zero, as it weights the readings, negative or infinite,
    and for a number of samples that is not a whole number of at least three: two do not separate
    amplitude and phase.
    """

    internal: float
    """Standard deviation of a scale, m."""
    external: float
    """Standard deviation of a coordinate of the sphere, m."""
    samples: int

    def __post_init__(self):
        if not (0.0 < self.internal < np.inf and 0.0 < self.external < np.inf):
            raise ValueError(
                f"noise: found {1e6 * self.internal:g} um of the scales and "
                f"{1e6 * self.external:g} um of the sphere, expected both above zero; correct "
                "them"
            )
        if not (isinstance(self.samples, int | np.integer) and self.samples >= 3):
            raise ValueError(
                f"noise: found {self.samples} samples a turn, expected a whole number from 3 on; "
                "correct it"
            )


@dataclass(frozen=True)
class Campaign:
    """True and identified values of many machines."""

    unknowns: tuple[Unknown, ...]
    true: Float[np.ndarray, "d k"]
    """True z of the machines."""
    found: Float[np.ndarray, "d k"]
    u: Float[np.ndarray, "d k"]
    """Standard uncertainties of z."""
    matrix: Float[np.ndarray, "d 3 axes"]
    """Identified E, m per m/s^2."""
    matrix_true: Float[np.ndarray, "d 3 axes"]
    matrix_u: Float[np.ndarray, "d 3 axes"]
    chi2: Float[np.ndarray, " d"]
    """Sum of squared whitened differences and of squared z: chi-squared with `readings` degrees of
    freedom.
    """
    readings: int
    stable: Bool[np.ndarray, " d"]
    """Whether each machine is stable under its controllers; the others cannot travel circles."""
    status: Int[np.ndarray, " d"]
    """`Status` of every search."""
    steps: Int[np.ndarray, " d"]
    """Number of evaluations of every search."""

    @property
    def converged(self) -> np.ndarray:
        """Whether each machine is stable and its search ended in a minimum (d,)."""
        return self.stable & (self.status == Status.CONVERGED)

    @property
    def pulls(self) -> Float[np.ndarray, "d k"]:
        """Errors divided by their standard uncertainties, for the machines with convergence."""
        return ((self.found - self.true) / self.u)[self.converged]


def campaign(
    machine: Machine,
    controller: Controller,
    unknowns: Sequence[Unknown],
    circles: Sequence[SetCircle],
    noise: Noise,
    *,
    draws: int,
    seed: int,
    matrix_u: float = 0.0,
) -> Campaign:
    """Simulate and identify `draws` machines, one after the other in one program.

    `matrix_u` is the standard uncertainty of an element of the probes' matrix. Machine number i is
    the same for any number of draws. Raises `ValueError` for fewer than one draw, without circles,
    and for circles in planes of axes that the machine lacks.
    """
    if draws < 1:
        raise ValueError(f"draws: found {draws}, expected at least 1")
    if not circles:
        raise ValueError("circles: found none, expected at least one; take those of circle_set")
    omega, asked = set_phasors(circles, machine.axes)
    each = np.sqrt(2.0 / noise.samples)
    blank = np.zeros((len(circles), len(machine.axes)), complex)
    seen = Phasors(
        machine.axes,
        jnp.asarray(omega),
        jnp.asarray(asked),
        jnp.asarray(blank),
        jnp.zeros((len(circles), 3), complex),
        jnp.full(blank.shape, each * noise.internal),
        jnp.full((len(circles), 3), each * noise.external),
    )
    given = task(machine, controller, unknowns, seen, matrix_u=matrix_u, quick=True)
    root = jax.random.key(seed)
    # Blocks have one size, so that any number of draws runs the same program.
    blocks = -(-draws // _BLOCK)
    keys = jax.vmap(lambda i: jax.random.fold_in(root, i))(jnp.arange(blocks * _BLOCK))
    scatter = jnp.array([noise.internal, noise.external])
    parts = [
        _run(given, seen, scatter, noise.samples, keys[start : start + _BLOCK])
        for start in range(0, blocks * _BLOCK, _BLOCK)
    ]
    readings = 2 * (len(machine.axes) + 3) * len(circles)
    return Campaign(
        unknowns=tuple(unknowns),
        readings=readings,
        **{
            name: np.concatenate([np.asarray(part[name]) for part in parts])[:draws]
            for name in parts[0]
        },
    )


@eqx.filter_jit
def _run(given: Task, seen: Phasors, scatter: Array, samples: int, keys: Array) -> dict:
    return jax.lax.map(lambda key: _one(given, seen, scatter, samples, key), keys)


def _one(given: Task, seen: Phasors, scatter: Array, samples: int, key: Array) -> dict:
    drawn, noise = jax.random.split(key)
    k = len(given.unknowns)
    true = jax.random.normal(drawn, (k + 9,))
    seen = _measured(given, seen, scatter, samples, true, noise)
    result = solve(given, seen)
    whole, z = result.covariance, result.value

    def matrix(z: Array) -> Array:
        return compliance(assemble(applied(given.unknowns, given.machine, given.controller, z)[0]))

    slope = jax.jacfwd(matrix)(z)
    return {
        "true": true[:k],
        "found": z,
        "u": jnp.sqrt(jnp.diag(whole)),
        "matrix": matrix(z),
        "matrix_true": matrix(true[:k]),
        "matrix_u": jnp.sqrt(jnp.einsum("xak,kl,xal->xa", slope, whole, slope)),
        "chi2": result.cost,
        "stable": settles(controlled(*given.at(true[:k]))),
        "status": result.status,
        "steps": result.steps,
    }


def _measured(
    given: Task, seen: Phasors, scatter: Array, samples: int, true: Array, key: Array
) -> Phasors:
    """Amplitudes of one turn of every circle, by least squares from its samples."""
    k = len(given.unknowns)
    rows = np.array(given.place)
    internal, error = (
        jnp.einsum("rxa,ra->rx", per[rows], seen.asked)
        for per in replace(given, harmonics=None).answers(true[:k])
    )
    S = given.matrix_u * true[k:].reshape(3, 3)
    axes = jnp.array(["XYZ".index(axis) for axis in seen.axes])
    turn = jnp.exp(2j * jnp.pi * (jnp.arange(samples) + 0.5) / samples)
    first, second = jax.random.split(key)
    read, shown = (  # (r, axes, n) and (r, 3, n)
        (amplitude[..., None] * turn).real for amplitude in (internal, error)
    )
    read_noise = scatter[0] * jax.random.normal(first, read.shape)
    # The probes read the sphere with the errors of their matrix. The error is this reading minus
    # that of the scales, noise included.
    place = jnp.zeros(shown.shape).at[:, axes].set(read)
    shown = shown + jnp.einsum("xy,ryn->rxn", S, place)
    shown = shown + scatter[1] * jax.random.normal(second, shown.shape)
    shown = shown.at[:, axes].add(-read_noise)
    reduced = [2.0 / samples * (x @ turn.conj()) for x in (read + read_noise, shown)]
    return eqx.tree_at(lambda p: (p.internal, p.error), seen, tuple(reduced))
