"""The verified machine as a measuring machine: uncertainty of probed points and lengths."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .judge import LEFT, component_labels
from .trials import Trials


@dataclass(frozen=True)
class Probe:
    """What comes on top of the machine's own errors when it probes a point (assumed sizes)."""

    repeatability_um: float = 2.0
    """Standard deviation of every axis at a point."""
    probe_um: float = 1.0
    """Standard deviation of the probe in every direction."""

    @property
    def variance(self) -> float:
        """Variance of one coordinate, um^2."""
        return self.repeatability_um**2 + self.probe_um**2


@dataclass(frozen=True)
class ProbedLength:
    """Uncertainty of a length between two probed points."""

    name: str
    length_mm: float
    u: float
    """With the correlation of the two points' errors, um."""
    u_independent: float
    """As if the two points had nothing in common, um."""


@dataclass(frozen=True)
class Probing:
    """Uncertainty of what is probed after the verification."""

    probe: Probe
    u: Float[np.ndarray, "side side 3"]
    """Standard uncertainty of the coordinates at every point, um; first index X, second Y."""
    u_machine: Float[np.ndarray, "side side 3"]
    """The part of the verified machine alone."""
    lengths: tuple[ProbedLength, ...]


def probing(trials: Trials, probe: Probe) -> Probing:
    """Combine the error left at every point with that of probing it.

    u^2 = u^2(d) + u_repeatability^2 + u_probe^2: the parts are independent. A length between a and
    b along e has e' cov(d_b - d_a) e from the machine, so that what the two have in common drops
    out.
    """
    side = trials.setting.grid
    own = trials.ensemble.fields[LEFT].u.reshape(side, side, 3)
    points = trials.points
    position = 1e3 * points.position[list(points.named)]
    ends = position[:, :2].max(0)
    corner = {tuple(p[:2]): i for i, p in enumerate(position)}
    pairs = {
        "along X": ((0.0, 0.0), (ends[0], 0.0)),
        "along Y": ((0.0, 0.0), (0.0, ends[1])),
        "diagonal": ((0.0, 0.0), tuple(ends)),
        "other diagonal": ((ends[0], 0.0), (0.0, ends[1])),
    }
    at = [trials.ensemble.index(label) for label in component_labels(points)]
    covariance = trials.ensemble.covariance[np.ix_(at, at)].reshape(len(position), 3, -1, 3)
    lengths = []
    for name, (a, b) in pairs.items():
        i, j = corner[a], corner[b]
        away = position[j] - position[i]
        e = away / np.linalg.norm(away)
        alone = sum(float(e @ covariance[k, :, k] @ e) for k in (i, j))
        common = 2.0 * float(e @ covariance[i, :, j] @ e)
        extra = 2.0 * probe.variance
        lengths.append(
            ProbedLength(
                name,
                float(np.linalg.norm(away)),
                (alone - common + extra) ** 0.5,
                (alone + extra) ** 0.5,
            )
        )
    return Probing(probe, np.sqrt(own**2 + probe.variance), own, tuple(lengths))
