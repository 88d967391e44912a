"""Stiffness, damping, centres of gravity and delay from the circles of an R-test.

    minimise  sum over circles |(X_int - x_int(z)) / u_int|^2
              + |(X_err - x_err(z) - S X_int) / u_err|^2   + |z|^2 + |S / u_S|^2

x(z) are the amplitudes of the simulated machine under its controllers (`predicted`), by z the
unknowns in standard deviations of what a catalogue says of them, S the matrix of the probes' own
errors with the standard uncertainty u_S of its elements. The derivative goes through the assembly,
the discretisation and the solution for the steady state.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..arrays import Array
from ..least_squares import Status, least_squares
from .assemble import assemble
from .bodies import Machine
from .circles import Phasors, predicted_at
from .closed_loop import ClosedLoop, close
from .compliance import compliance
from .control import Controller
from .unknowns import Unknown, applied

_TOLERANCE = 1e-3
"""Remaining step in standard uncertainties."""
_STEPS = 60
_MIXED = 0.5
"""Share of the prior variance above which a combination counts as not told by the circles."""


@dataclass(frozen=True)
class Identified:
    """What the circles say of a machine."""

    unknowns: tuple[Unknown, ...]
    z: Float[np.ndarray, " k"]
    """In standard deviations of the prior."""
    covariance: Float[np.ndarray, "k k"]
    """Of z; the prior's is the identity."""
    machine: Machine
    controller: Controller
    matrix: Float[np.ndarray, "3 axes"]
    """E of the identified machine, m per m/s^2."""
    matrix_u: Float[np.ndarray, "3 axes"]
    """Standard uncertainty of its elements."""
    chi2: float
    """Sum of the squared whitened differences, without the prior."""
    readings: int
    """How many numbers that are."""
    status: Status

    @property
    def values(self) -> Float[np.ndarray, " k"]:
        """In the unit of every unknown."""
        return np.array([float(u.value(z)) for u, z in zip(self.unknowns, self.z, strict=True)])

    def interval(self, k: float = 2.0) -> Float[np.ndarray, "k 2"]:
        """Values at z - k u and z + k u."""
        u = np.sqrt(np.diag(self.covariance))
        ends = ([float(w.value(z)) for w, z in zip(self.unknowns, self.z + s * k * u, strict=True)]
                for s in (-1.0, 1.0))  # fmt: skip
        return np.array(list(ends)).T

    @property
    def told(self) -> Float[np.ndarray, " k"]:
        """Share of the prior variance that the circles took away."""
        return 1.0 - np.diag(self.covariance)

    def not_told(self) -> list[str]:
        """Combinations of unknowns that the circles say little of, in words."""
        sizes, ways = np.linalg.eigh(self.covariance)
        found = []
        for size, way in zip(sizes[::-1], ways.T[::-1], strict=True):
            if size < _MIXED:
                break
            order = [i for i in np.argsort(-np.abs(way)) if abs(way[i]) > 0.3]
            first = np.sign(way[order[0]])
            parts = [f"{'+' if first * way[i] > 0 else '-'} {self.unknowns[i].name}" for i in order]
            words = " ".join(parts).removeprefix("+ ")
            found.append(f"{words}: {100 * size:.0f} % of the prior variance is left")
        return found


class Task(eqx.Module):
    """Everything that stays the same while z is looked for."""

    machine: Machine
    controller: Controller
    unknowns: tuple[Unknown, ...]
    omega: Float[Array, " w"]
    """Distinct angular velocities."""
    place: tuple[int, ...] = eqx.field(static=True)
    matrix_u: float = eqx.field(static=True)
    """u_S."""

    @property
    def size(self) -> int:
        """Numbers that are looked for: z and S."""
        return len(self.unknowns) + (9 if self.matrix_u > 0.0 else 0)

    def loop(self, z: Float[Array, " k"]) -> ClosedLoop:
        """The closed loop at z."""
        machine, controller = applied(self.unknowns, self.machine, self.controller, z)
        return close(assemble(machine), controller)

    def residual(self, both: Float[Array, " p"], seen: Phasors) -> Float[Array, " n"]:
        """Whitened differences, then z and S in their prior standard deviations."""
        z = both[: len(self.unknowns)]
        internal, error = predicted_at(self.loop(z), self.omega, np.array(self.place), seen.asked)
        if self.matrix_u > 0.0:
            S = self.matrix_u * both[len(self.unknowns) :].reshape(3, 3)
            three = jnp.array(["XYZ".index(axis) for axis in seen.axes])
            error = error + seen.internal @ S[:, three].T
        left = jnp.concatenate(
            [
                ((seen.internal - internal) / seen.internal_u[:, None]).ravel(),
                ((seen.error - error) / seen.error_u[:, None]).ravel(),
            ]
        )
        return jnp.concatenate([left.real, left.imag, both])


def task(
    machine: Machine,
    controller: Controller,
    unknowns: Sequence[Unknown],
    seen: Phasors,
    *,
    matrix_u: float = 0.0,
) -> Task:
    """`matrix_u` is the standard uncertainty of an element of the probes' matrix: for the standard
    uncertainty u of a coordinate at the end of the range R, u / R.
    """
    # Circles of one acceleration differ in their angular velocity by the noise of its estimate.
    omega, place = np.unique(np.round(np.asarray(seen.omega), 3), return_inverse=True)
    means = np.array([np.asarray(seen.omega)[place == i].mean() for i in range(len(omega))])
    return Task(
        machine, controller, tuple(unknowns), jnp.asarray(means), tuple(place.tolist()), matrix_u
    )


def solve(given: Task, seen: Phasors, start: Float[Array, " p"] | None = None):
    """The minimum for one measurement; may be mapped over many (`seen`)."""
    first = jnp.zeros(given.size) if start is None else start
    return least_squares(
        _residual, first, (given, seen), tolerance=_TOLERANCE, noise=1.0, max_steps=_STEPS
    )


def _residual(both: Array, args: tuple[Task, Phasors]) -> Array:
    given, seen = args
    return given.residual(both, seen)


def identify_machine(given: Task, seen: Phasors) -> Identified:
    """Unknowns and the matrix E that follows, with their covariance.

    The result says by its `status` whether the search converged.
    """
    found = solve(given, seen)
    k = len(given.unknowns)
    whole = np.linalg.inv(np.asarray(found.jacobian.T @ found.jacobian))
    z, covariance = np.asarray(found.value[:k]), whole[:k, :k]
    machine, controller = applied(given.unknowns, given.machine, given.controller, jnp.asarray(z))

    def matrix(z: Array) -> Array:
        return compliance(assemble(applied(given.unknowns, given.machine, controller, z)[0]))

    slope = np.asarray(jax.jacfwd(matrix)(jnp.asarray(z)))
    variance = np.einsum("iak,kl,ial->ia", slope, covariance, slope)
    residual = np.asarray(found.residual)[: -given.size]
    return Identified(
        given.unknowns,
        z,
        covariance,
        machine,
        controller,
        np.asarray(matrix(jnp.asarray(z))),
        np.sqrt(variance),
        float(residual @ residual),
        len(residual),
        Status(int(found.status)),
    )
