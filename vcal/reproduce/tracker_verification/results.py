"""The whole of a reproduction as numbers, and its campaigns one after the other."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from .compared import Rung, rung
from .family import Search, find_family
from .probing import Probe, Probing, probing
from .rank import Rank, rank_of
from .setting import INITIAL_UM, TESTS, Influences, Setting
from .trials import Runner, Trials

THREE, ONE = Setting(), Setting(angle_sigmas=1.0)
ALL_THREE = Setting(range_sigmas=3.0)
"""24 urad as three standard deviations, as one, and with the range's noise as three as well."""

_REPEATABILITY_UM = 2.0
_EXPANSION = 10.0
_WARMING = 2.0
_POSE_UM, _POSE_URAD = 20.0, 20.0
_SCATTER = Influences(repeatability_um=_REPEATABILITY_UM)
_WARM = Influences(expansion_um_per_m_kelvin=_EXPANSION, warming_kelvin=_WARMING)
_LOOSE = Influences(pose_um=_POSE_UM, pose_urad=_POSE_URAD)

INFLUENCES = {
    "tracker noise alone": Influences(),
    "and repeatability": _SCATTER,
    "and warming up": _WARM,
    "and tracker's pose": _LOOSE,
    "and pose, fitted": replace(_LOOSE, fit_pose=True),
    "all of these, pose fitted": Influences(
        repeatability_um=_REPEATABILITY_UM,
        expansion_um_per_m_kelvin=_EXPANSION,
        warming_kelvin=_WARMING,
        pose_um=_POSE_UM,
        pose_urad=_POSE_URAD,
        fit_pose=True,
    ),
}
"""What is there beside the tracker's noise, by name; sizes are assumed, none is printed."""

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


@dataclass(frozen=True)
class Results:
    """Everything that was computed."""

    seed: int
    draws: int
    search: Search
    rank: Rank
    few: dict[str, Trials]
    """As many tests as the publication made, by reading of the angles' noise."""
    many: dict[str, Trials]
    """All tests."""
    rungs: dict[str, Rung]
    influences: dict[str, Trials]
    probing: Probing


def compute(
    draws: int, seed: int, progress: Callable[[str], None], setting: Setting = THREE
) -> Results:
    """Run all campaigns; `setting` gives the grid and the degrees, `draws` the number of tests.

    The campaigns of influences have a tenth of the tests, and at least `LEAST`.
    """

    def on(other: Setting) -> Setting:
        return replace(other, grid=setting.grid, degrees=setting.degrees)

    progress("searching the family of machines")
    search = find_family(setting, *INITIAL_UM, seed=seed)
    rank = rank_of(setting, search.family)
    run = Runner(search.family, seed)
    readings = {"24 µrad = 3 σ": THREE, "24 µrad = 1 σ": ONE, "all noise 3 σ": ALL_THREE}
    few, many = {}, {}
    for name, reading in readings.items():
        progress(f"tests, {name}")
        few[name] = run(on(reading), min(TESTS, draws))
        many[name] = run(on(reading), draws)
    rungs = {}
    for name, one in _RUNGS.items():
        progress(f"GUM and Monte Carlo, {name}")
        # The first rung is the first reading.
        rungs[name] = rung(many["24 µrad = 3 σ"] if one == THREE else run(on(one), draws))
    found = {}
    for name, influences in INFLUENCES.items():
        progress(f"influences: {name}")
        other = on(replace(THREE, influences=influences))
        found[name] = run(other, max(draws // 10, LEAST))
    points = probing(many["24 µrad = 3 σ"], Probe())
    return Results(seed, draws, search, rank, few, many, rungs, found, points)
