"""Identification of stiffness, damping, centres of gravity and delay from circles of an R-test.

    minimise  sum over circles |(X_int - x_int(z)) / u_int|^2
              + |(X_err - x_err(z) - S X_int) / u_err|^2   + |z|^2 + |S / u_S|^2   over z and S

x(z) are the amplitudes of the simulated machine under its controllers (`predicted`), z the unknowns
in prior standard deviations from their catalogue values, and S the matrix of the probes' own errors
with the standard uncertainty u_S of its elements. S is linear and is eliminated: its contribution
to the differences is part of their covariance, V = 1 + u_S^2 X_int X_int' / u_err^2. The derivative
includes the assembly, the discretisation and the solution for the steady state.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ..numerics.arrays import Array
from ..numerics.compiled import filter_jit_outermost
from ..numerics.eigen import eigh
from ..numerics.least_squares import Status
from ..numerics.trust_region import Found, within_prior
from .bodies import Machine
from .circles import Phasors, answers
from .closed_loop import check_stable, controlled
from .control import Controller
from .harmonic_response import harmonics, response
from .quasi_static import compliance
from .structure import Structure, assemble
from .unknowns import Unknown, applied

Answers = tuple[Complex[Array, "w axes axes"], Complex[Array, "w 3 axes"]]
_TOLERANCE = 1e-3
"""Convergence tolerance: remaining step in standard uncertainties."""
_STEPS = 60
_MIXED = 0.5
"""Remaining share of the prior variance above which a combination counts as undetermined."""


@dataclass(frozen=True)
class Identified:
    """The result of the identification of a machine."""

    unknowns: tuple[Unknown, ...]
    z: Float[np.ndarray, " k"]
    """Identified unknowns in prior standard deviations."""
    covariance: Float[np.ndarray, "k k"]
    """Posterior covariance of z; the prior covariance is the identity."""
    machine: Machine
    controller: Controller
    declared: Controller
    """The declared controller."""
    matrix: Float[np.ndarray, "3 axes"]
    """E of the identified machine, m per m/s^2."""
    matrix_u: Float[np.ndarray, "3 axes"]
    """Standard uncertainty of its elements."""
    chi2: float
    """Sum of the squared whitened differences, without the prior."""
    readings: int
    """Number of these differences."""
    status: Status

    @property
    def values(self) -> Float[np.ndarray, " k"]:
        """Identified values in the unit of every unknown."""
        return self._at(self.z)

    def interval(self, k: float = 2.0) -> Float[np.ndarray, "k 2"]:
        """Values at z - k u and z + k u."""
        u = np.sqrt(np.diag(self.covariance))
        return np.array([self._at(self.z - k * u), self._at(self.z + k * u)]).T

    def _at(self, z: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        pairs = zip(self.unknowns, z, strict=True)
        return np.array([float(unknown.value(each, self.declared)) for unknown, each in pairs])

    @property
    def told(self) -> Float[np.ndarray, " k"]:
        """Information share: the part of the prior variance that the circles removed."""
        return 1.0 - np.diag(self.covariance)

    def not_told(self) -> list[str]:
        """Combinations of unknowns about which the circles contain little information, in words."""
        sizes, ways = eigh(self.covariance)
        found = []
        for size, way in zip(sizes[::-1], ways.T[::-1], strict=True):
            if size < _MIXED:
                break
            order = [i for i in np.argsort(-np.abs(way)) if abs(way[i]) > 0.3]
            first = np.sign(way[order[0]])
            parts = [f"{'+' if first * way[i] > 0 else '-'} {self.unknowns[i].name}" for i in order]
            words = " ".join(parts).removeprefix("+ ")
            found.append(f"{words}: {100 * size:.0f} % of the prior variance remains")
        return found


class Task(eqx.Module):
    """Everything that is constant during the search for z."""

    machine: Machine
    controller: Controller
    unknowns: tuple[Unknown, ...]
    omega: Float[Array, " w"]
    """Distinct angular velocities."""
    place: tuple[int, ...] = eqx.field(static=True)
    matrix_u: float = eqx.field(static=True)
    """Standard uncertainty u_S of an element of the probes' matrix."""
    harmonics: int | None = eqx.field(static=True, default=None)
    """Number of harmonics for `response`, which takes a fraction of the time; None for the exact
    solution."""

    def at(self, z: Float[Array, " k"]) -> tuple[Structure, Controller]:
        """Matrices and controllers at z."""
        machine, controller = applied(self.unknowns, self.machine, self.controller, z)
        return assemble(machine), controller

    def answers(self, z: Float[Array, " k"]) -> Answers:
        """Internal reading and error per set position of every axis, at every `omega`."""
        structure, controller = self.at(z)
        if (number := self.harmonics) is not None:
            return jax.vmap(lambda w: response(structure, controller, w, number))(self.omega)
        return answers(controlled(structure, controller), self.omega)

    def residual(self, z: Float[Array, " k"], seen: Phasors) -> Float[Array, " n"]:
        """Whitened differences, then z, which is in prior standard deviations."""
        place = np.array(self.place)
        internal, error = (
            jnp.einsum("rxa,ra->rx", per[place], seen.asked) for per in self.answers(z)
        )
        scales = seen.internal - internal
        # The error is the reading of the probes minus that of the scales, whose noise it contains.
        # Adding the residual of the scales again makes both independent.
        axes = np.array(["XYZ".index(axis) for axis in seen.axes])
        known = jnp.where(jnp.isfinite(seen.internal_u), scales, 0.0)
        shown = jnp.asarray(seen.error - error).at[:, axes].add(known)
        scales, probes = _real(scales / seen.internal_u), _real(shown / seen.external_u)
        if self.matrix_u > 0.0:
            # V^(-1/2) keeps differences that S cannot cause, and shrinks the others.
            def shrunk(probes: Array, u: Array) -> Array:
                taken = self.matrix_u * _real(seen.internal / u[:, None])
                values, ways = jnp.linalg.eigh(taken.T @ taken)
                root = jnp.sqrt(1.0 + jnp.maximum(values, 0.0))
                shrink = -1.0 / (root * (1.0 + root))
                return probes + taken @ (ways @ (shrink * (ways.T @ (taken.T @ probes))))

            probes = jax.vmap(shrunk, in_axes=1, out_axes=1)(probes, seen.external_u)
        return jnp.concatenate([scales.ravel(), probes.ravel(), z])


def _real(numbers: Complex[Array, "r a"]) -> Float[Array, "2*r a"]:
    return jnp.concatenate([jnp.real(numbers), jnp.imag(numbers)])


def task(
    machine: Machine,
    controller: Controller,
    unknowns: Sequence[Unknown],
    seen: Phasors,
    *,
    matrix_u: float = 0.0,
    quick: bool = False,
) -> Task:
    """The identification task of a machine, its controller and its unknowns.

    `matrix_u` is the standard uncertainty of an element of the probes' matrix: u / R for the
    standard uncertainty u of a coordinate at the end of the range R. With `quick`, responses are
    accurate to seven digits at the catalogue values, which suits campaigns. Raises `ValueError` for
    an unknown of a component that the machine lacks.
    """
    for unknown in unknowns:
        unknown.check(machine)
    # The angular velocities of circles of one acceleration differ by the noise of their estimates.
    omega, place = np.unique(np.round(np.asarray(seen.omega), 3), return_inverse=True)
    means = np.array([np.asarray(seen.omega)[place == i].mean() for i in range(len(omega))])
    known = jnp.asarray(means), tuple(place.tolist())
    number = harmonics(assemble(machine), controller, means.max()) if quick else None
    return Task(machine, controller, tuple(unknowns), *known, matrix_u, number)


def solve(given: Task, seen: Phasors) -> Found:
    """The minimum for one measurement, from the catalogue values; may be mapped over `seen`."""
    return within_prior(
        _residual,
        jnp.zeros(len(given.unknowns)),
        (given, seen),
        tolerance=_TOLERANCE,
        max_steps=_STEPS,
    )


def _residual(z: Array, args: tuple[Task, Phasors]) -> Array:
    given, seen = args
    return given.residual(z, seen)


_solve = filter_jit_outermost(solve)


def identify_machine(given: Task, seen: Phasors) -> Identified:
    """The unknowns and the resulting matrix E, with their covariance.

    The `status` of the result reports the convergence. Raises `ValueError` where the search cannot
    start, and where the identified machine has an unstable loop: a steady state can be computed,
    but such a machine cannot travel circles. The machine of the catalogue values may be unstable,
    as the search leads away from it.
    """
    found = _solve(given, seen)
    if found.status == Status.NON_FINITE:
        raise ValueError(
            "found weighted differences that are not finite at the catalogue values; expected a "
            "machine that travels circles, and uncertainties above zero"
        )
    z, covariance = np.asarray(found.value), np.asarray(found.covariance)
    machine, controller = applied(given.unknowns, given.machine, given.controller, jnp.asarray(z))
    structure = assemble(machine)
    try:
        check_stable(controlled(structure, controller), structure)
    except ValueError as error:
        raise ValueError(f"the identified machine, {error}") from error

    def matrix(z: Array) -> Array:
        return compliance(assemble(applied(given.unknowns, given.machine, controller, z)[0]))

    slope = np.asarray(jax.jacfwd(matrix)(jnp.asarray(z)))
    variance = np.einsum("iak,kl,ial->ia", slope, covariance, slope)
    whole = np.asarray(found.residual)
    residual = whole[: len(whole) - len(z)]
    silent = 2 * int(np.isinf(seen.internal_u).sum())
    return Identified(
        given.unknowns,
        z,
        covariance,
        machine,
        controller,
        given.controller,
        np.asarray(matrix(jnp.asarray(z))),
        np.sqrt(variance),
        float(residual @ residual),
        len(residual) - silent,
        Status(int(found.status)),
    )
