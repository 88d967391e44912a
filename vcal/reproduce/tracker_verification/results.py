"""The whole of a reproduction as numbers, and the verified machine as a measuring machine."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from ..registry import Computed, each, part
from .compared import Rung, rung
from .family import Rank, Search, find_family, rank_of
from .setting import INITIAL_UM, TESTS, Influences, Setting
from .trials import LEFT, Runner, Trials, component_labels


@dataclass(frozen=True)
class Probe:
    """Errors of probing a point in addition to the machine's own (assumed sizes)."""

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
    """For independent errors of the two points, um."""


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
    b along e has e' cov(d_b - d_a) e from the machine, so that the common part cancels.
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
        u, independent = (alone - common + extra) ** 0.5, (alone + extra) ** 0.5
        lengths.append(ProbedLength(name, float(np.linalg.norm(away)), u, independent))
    return Probing(probe, np.sqrt(own**2 + probe.variance), own, tuple(lengths))


THREE, ONE = Setting(), Setting(angle_sigmas=1.0)
ALL_THREE = Setting(range_sigmas=3.0)
"""24 urad as three standard deviations, as one, and with the range's noise as three as well."""

_SCATTER: dict[str, Any] = {"repeatability_um": 2.0}
_WARM: dict[str, Any] = {"expansion_um_per_m_kelvin": 10.0, "warming_kelvin": 2.0}
_LOOSE: dict[str, Any] = {"pose_um": 20.0, "pose_urad": 20.0}

INFLUENCES = {
    "tracker noise alone": Influences(),
    "and repeatability": Influences(**_SCATTER),
    "and warming up": Influences(**_WARM),
    "and tracker's pose": Influences(**_LOOSE),
    "and pose, fitted": Influences(**_LOOSE, fit_pose=True),
    "all of these, pose fitted": Influences(**_SCATTER, **_WARM, **_LOOSE, fit_pose=True),
}
"""Influences in addition to the tracker's noise, by name; the sizes are assumed."""

_RUNGS = {
    "noise × 1": THREE,
    "noise × 10": replace(THREE, noise_factor=10.0),
    "noise × 100": replace(THREE, noise_factor=100.0),
    "noise × 1, fit's sizes × 30": replace(THREE, family_factor=30.0),
}
LEAST = 200
"""Tests of the smallest campaign."""
CAMPAIGN = 30_000
"""Tests of the long campaign."""


READINGS = {"24 µrad = 3 σ": THREE, "24 µrad = 1 σ": ONE, "all noise 3 σ": ALL_THREE}
"""By what the printed noise means."""


@dataclass
class Results(Computed):
    """Everything: all campaigns, with `draws` tests but for those of influences, which have a tenth
    of them and at least `LEAST`.
    """

    setting: Setting = THREE
    """Gives the grid and the degrees."""

    @part("searching the family of machines")
    def search(self) -> Search:
        return find_family(self.setting, *INITIAL_UM, seed=self.seed)

    @part("what the points can see")
    def rank(self) -> Rank:
        return rank_of(self.setting, self.search.family)

    @part("the tests")
    def run(self) -> Runner:
        return Runner(self.search.family, self.seed)

    def tests(self, setting: Setting, draws: int) -> Trials:
        """A campaign on the grid and with the degrees that were asked for."""
        own = replace(setting, grid=self.setting.grid, degrees=self.setting.degrees)
        return self.run(own, draws)

    @each("as many tests as the publication made, {}", READINGS)
    def few(self, reading: str) -> Trials:
        return self.tests(READINGS[reading], min(TESTS, self.draws))

    @each("tests, {}", READINGS)
    def many(self, reading: str) -> Trials:
        return self.tests(READINGS[reading], self.draws)

    @each("GUM and Monte Carlo, {}", _RUNGS)
    def rungs(self, name: str) -> Rung:
        one = _RUNGS[name]
        # The first rung is the first reading.
        return rung(self.first if one == THREE else self.tests(one, self.draws))

    @each("influences: {}", INFLUENCES)
    def influences(self, name: str) -> Trials:
        setting = replace(THREE, influences=INFLUENCES[name])
        return self.tests(setting, max(self.draws // 10, LEAST))

    @part("probing")
    def probing(self) -> Probing:
        return probing(self.first, Probe())

    @property
    def first(self) -> Trials:
        """All tests of the first reading."""
        return self.many["24 µrad = 3 σ"]
