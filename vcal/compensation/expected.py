"""The error to expect of a compensated machine, before any control has run it.

    r = p(q + c(q, s) + E(q + c, s; theta)) - p(q),    theta ~ N(theta, C)

with the correction c that a format applies, the conditions s, and the posterior of the parameters
theta. Everything that the measurement left uncertain is in the draws: parts that are not identified
have the size of their prior, rival models their probability, random effects their scatter.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..numerics.eigen import eigh
from ..numerics.spatial import rigid_basis
from .base import Tables
from .machine import IdentifiedMachine
from .volume import POINTS, Use, check_use, working_volume

DRAWS = 400
"""Default number of machines drawn from the posterior."""


@dataclass(frozen=True)
class Drawn:
    """A quantity over the draws."""

    mean: float
    """um."""
    u: float
    """Standard deviation over the draws, um."""


@dataclass(frozen=True)
class Expected:
    """The volumetric error of a machine at some points, um."""

    rms: Drawn
    """Root of the mean squared length of the error of the tool point."""
    largest: Drawn


@dataclass(frozen=True)
class Verified:
    """The expected error of a machine with one compensation, or without any."""

    aligned: Mapping[str, Expected]
    """By place, ``"check points"`` (where there are some) and ``"working volume"``: after the best
    rigid alignment of all points, as in a report."""
    raw: Mapping[str, Expected]
    """The same without alignment."""


def places(machine: IdentifiedMachine, points: int = POINTS) -> dict[str, Use]:
    """Where the error is stated: check points, where there are some, and the working volume."""
    check = check_use(machine)
    found = {} if check is None else {"check points": check}
    return found | {"working volume": working_volume(machine, points)}


def verify(
    machine: IdentifiedMachine,
    tables: Tables | None = None,
    *,
    points: int = POINTS,
    draws: int = DRAWS,
    seed: int = 0,
) -> Verified:
    """The expected error with the compensation of `tables`, or without any.

    The same seed draws the same machines, whatever the compensation.
    """
    aligned, raw = {}, {}
    for place, use in places(machine, points).items():
        errors = drawn_errors(machine, use, tables, draws=draws, seed=seed)
        raw[place] = expected(errors)
        aligned[place] = expected(after_alignment(errors, machine.nominal(use.position)))
    return Verified(aligned, raw)


def drawn_errors(
    machine: IdentifiedMachine,
    use: Use,
    tables: Tables | None = None,
    *,
    draws: int = DRAWS,
    seed: int = 0,
) -> Float[np.ndarray, "draws n 3"]:
    """Errors of the tool point of machines drawn from the posterior, m, linearised at its mean."""
    real = machine.whole
    added = np.zeros_like(use.position)
    if tables is not None:
        added = tables.applied(use.position, use.directions, use.covariates)
    plan = real.plan(use.position + added, use.directions, use.covariates)
    points, slopes = real.derivative(plan)
    random = np.random.default_rng(seed)
    root = _root(machine.covariance)
    moved = slopes.reshape(-1, slopes.shape[2]) @ root
    normal = random.standard_normal((draws, root.shape[1]))
    found = (normal @ moved.T).reshape(draws, *points.shape)
    found += points - machine.nominal(use.position)
    for rival in machine.rivals:
        changes = rival.changes(plan)
        if rival.averaged:
            found -= sum(p * change for p, change in changes)
        ends = np.cumsum([p for p, _ in changes])
        chosen = np.searchsorted(ends, random.uniform(size=draws), side="right")
        for i, (_, change) in enumerate(changes):
            found[chosen == i] += change
    scatter = real.scatter(plan)
    if scatter.any():
        found += scatter * random.standard_normal(found.shape)
    return found


def after_alignment(
    errors: Float[np.ndarray, "draws n 3"], nominal: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "draws n 3"]:
    """Errors after the best rigid alignment of the points of every draw."""
    rigid = rigid_basis(nominal)
    flat = errors.reshape(len(errors), -1)
    return (flat - (flat @ rigid) @ rigid.T).reshape(errors.shape)


def expected(errors: Float[np.ndarray, "draws n 3"]) -> Expected:
    """Rms and largest error over the points of every draw, um."""
    square = (1e6 * errors) ** 2
    length = square.sum(2)
    return Expected(_drawn(np.sqrt(length.mean(1))), _drawn(np.sqrt(length.max(1, initial=0.0))))


def _drawn(values: np.ndarray) -> Drawn:
    return Drawn(float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else 0.0)


def _root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric A with A A = C, for a covariance that rounding may have made indefinite.

    It is continuous in C, so that a machine that was stored has the same draws.
    """
    values, vectors = eigh(0.5 * (covariance + covariance.T))
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
