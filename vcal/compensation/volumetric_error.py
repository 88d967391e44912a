"""The volumetric error of an identified machine before and after compensation, as a distribution.

    before = p(q + E(q, s; theta)) - p(q),    after = before - d(q, s),    theta ~ N(theta, C)

with the identified displacement d (`IdentifiedMachine.displacement`): *after* is what the best
compensation leaves, one that knows positions, directions and conditions. It contains what the
measurement left uncertain, what it did not identify, and the repeatability. Tables of a control
leave more (`vcal.compensation.expected.verify`).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .expected import DRAWS, after_alignment, drawn_errors
from .machine import IdentifiedMachine
from .volume import POINTS, working_volume

MOST_POSITIONS = 400
"""Number of positions above which a grid over the working volume has fewer points per axis."""


class Sizes(NamedTuple):
    """Sizes of the volumetric error of every drawn machine, um."""

    rms: Float[np.ndarray, " draws"]
    """Root of the mean squared length of the error of the tool point, after the best rigid
    alignment of all positions."""
    largest: Float[np.ndarray, " draws"]
    """Its largest length."""


@dataclass(frozen=True)
class VolumetricError:
    """The volumetric error over the working volume, for machines drawn from the posterior."""

    before: Sizes
    after: Sizes
    positions: int
    """Number of positions in the working volume."""
    draws: int
    seed: int


def volumetric_error(
    machine: IdentifiedMachine, draws: int = DRAWS, seed: int = 0
) -> VolumetricError:
    """The volumetric error before and after compensation, over a grid of `points_per_axis`."""
    use = working_volume(machine, points_per_axis(machine))
    errors = drawn_errors(machine, use, draws=draws, seed=seed)
    identified = machine.displacement(use.plan(machine))
    nominal = machine.nominal(use.position)
    before, after = (
        _sizes(after_alignment(found, nominal)) for found in (errors, errors - identified)
    )
    return VolumetricError(before, after, len(use.position), draws, seed)


def points_per_axis(machine: IdentifiedMachine) -> int:
    """Points per axis of a grid of at most `MOST_POSITIONS` positions, from 2 to `POINTS`."""
    low, high = machine.volume.T
    moving = int((high > low).sum())
    counts = [n for n in range(2, POINTS + 1) if n**moving <= MOST_POSITIONS]
    return max(counts, default=2)


def _sizes(errors: Float[np.ndarray, "draws n 3"]) -> Sizes:
    length = 1e6 * np.linalg.norm(errors, axis=2)
    return Sizes(np.sqrt((length**2).mean(1)), length.max(1))
