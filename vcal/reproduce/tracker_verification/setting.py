"""What the publication prints, what it leaves open, and the models that follow from both.

Aguado, Perez, Albajez, Velazquez and Santolaria (2017), Monte Carlo method to machine tool
uncertainty evaluation, Manufacturing Engineering Society International Conference, Vigo.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ...effects.base import Setup
from ...effects.geometric import ErrorMotion, GeometricErrors, LocationError
from ...effects.reversal import Repeatability
from ...effects.thermal import REFERENCE_DEGC, ScaleGrowth
from ...instruments.base import Instrument
from ...instruments.frame import Station
from ...instruments.laser_tracker import LaserTracker, LaserTrackerSettings
from ...machine.chain import chain_from_string
from ...machine.error_functions import Legendre
from ...machine.plan import Plan
from ...machine.ports import COMPONENTS
from ...model.forward import Model

CHAIN = "XFYZ"
AREA_MM = 400.0
STATION_MM = (-863.527, 194.373, 677.782)
EULER_XYZ_DEG = (0.0339, 0.0343, 59.4652)
ANGLE_URAD = 24.0
RANGE_UM = 4.0
RANGE_UM_PER_M = 0.8
TESTS = 1000
INITIAL_UM = (77.39, 40.91)
"""Mean and standard deviation of the initial volumetric error, all points and tests."""
FINAL_UM = (12.34, 7.06)
"""Those of the error after verification."""

_LOCATIONS = ("EC0Y", "EB0Z", "EA0Z")


@dataclass(frozen=True)
class Family:
    """The machines that are drawn: normal Legendre coefficients with these standard deviations."""

    translation_um: float
    """Every coefficient of an error translation."""
    rotation_urad: float
    """Every coefficient of an error rotation, and every squareness."""

    def times(self, factor: float) -> "Family":
        """All sizes multiplied by a factor."""
        return Family(self.translation_um * factor, self.rotation_urad * factor)


@dataclass(frozen=True)
class Influences:
    """What the publication names and leaves out. Zero switches an influence off.

    All are standard deviations, and in reality only; what is fitted knows nothing of them, except
    the tracker's pose where `fit_pose` says so.
    """

    repeatability_um: float = 0.0
    """Of the position of every axis, fresh at every point."""
    expansion_um_per_m_kelvin: float = 0.0
    """Of the expansion of the scales of X and Y that nobody compensates."""
    warming_kelvin: float = 0.0
    """By so much the scales warm up from 20 degC during the measurement; judged at 20 degC."""
    pose_um: float = 0.0
    """Of the tracker's position, each coordinate."""
    pose_urad: float = 0.0
    """Of its orientation, each angle."""
    fit_pose: bool = False


@dataclass(frozen=True)
class Setting:
    """One campaign: a reading of what is printed, and a choice where nothing is."""

    angle_sigmas: float = 3.0
    """The printed 24 urad are so many standard deviations."""
    range_sigmas: float = 1.0
    """So are the printed 4 um + 0.8 um/m."""
    noise_factor: float = 1.0
    """Multiplies the tracker's noise, as declared to the fit too."""
    family_factor: float = 1.0
    """The sizes that the fit believes in, over those of the machines: large ones leave everything
    to the data, as plain least squares does.
    """
    grid: int = 9
    """Points per side of the area (not printed)."""
    degrees: tuple[int, ...] = (1, 2, 3)
    """Legendre degrees of every error motion (not printed: "approximation functions")."""
    influences: Influences = Influences()

    @property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Axis positions of the points, m; X changes slowest."""
        side = np.linspace(0.0, AREA_MM * 1e-3, self.grid)
        return np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), -1).reshape(-1, 3)

    @property
    def plan(self) -> Plan:
        """The points as they are measured, one after the other while the scales warm up."""
        at = self.positions
        warm = REFERENCE_DEGC + self.influences.warming_kelvin * np.linspace(0.0, 1.0, len(at))
        return Plan(("X", "Y", "Z"), at, {"T_X": warm, "T_Y": warm})

    @property
    def points(self) -> Plan:
        """The same points at 20 degC, where the machine is judged."""
        still = np.full(self.grid**2, REFERENCE_DEGC)
        return Plan(("X", "Y", "Z"), self.positions, {"T_X": still, "T_Y": still})


def machine(setting: Setting, family: Family) -> Model:
    """Chain, tracker and geometric errors alone."""
    chain = chain_from_string(CHAIN, dict.fromkeys("XYZ", (0.0, AREA_MM * 1e-3)))
    sizes = {True: family.translation_um * 1e-6, False: family.rotation_urad * 1e-6}
    motions = tuple(
        ErrorMotion(
            f"E{c}{axis}",
            axis,
            Legendre((0.0, AREA_MM * 1e-3), setting.degrees, sizes[c in "XYZ"]),
        )
        for axis in chain.axes
        for c in COMPONENTS
    )
    locations = tuple(LocationError.of(chain, name, sizes[False]) for name in _LOCATIONS)
    return Model(chain, _tracker(setting), (GeometricErrors(motions=motions, locations=locations),))


def _tracker(setting: Setting) -> Instrument:
    nominal = LaserTracker.build(
        LaserTrackerSettings(
            kind=LaserTracker.kind,
            range_sigma_um=RANGE_UM,
            range_sigma_um_per_m=RANGE_UM_PER_M,
            angle_sigma_urad=ANGLE_URAD,
            station_mm=STATION_MM,
            euler_xyz_deg=EULER_XYZ_DEG,
        ),
        chain_from_string(CHAIN),
        {},
        lambda name, columns: {},
    )
    length, angle = (setting.noise_factor / k for k in (setting.range_sigmas, setting.angle_sigmas))
    # Numbers of numpy are data to a compiled program, so that another noise is not another one.
    sizes = {
        "range_sigma": RANGE_UM * 1e-6 * length,
        "range_sigma_per_m": RANGE_UM_PER_M * 1e-6 * length,
        "angle_sigma": ANGLE_URAD * 1e-6 * angle,
    }
    return replace(nominal, **{name: np.float64(size) for name, size in sizes.items()})


def truth_and_fit(setting: Setting, family: Family) -> tuple[Model, Model]:
    """What reality is and what is fitted.

    Influences that are off stay in, with a size of zero: all campaigns are one compiled program.
    """
    own = setting.influences
    truth = machine(setting, family)
    place = Setup(truth.chain, truth.layout, setting.plan)
    growth = (("alpha", 0.0, own.expansion_um_per_m_kelvin),)
    scatter = (("size", 0.0, own.repeatability_um),)
    added = [
        *(replace(e, given=growth) for e in ScaleGrowth.candidates(place) if e.placement in "XY"),
        _pose(own.pose_um, own.pose_urad),
        *(replace(e, given=scatter) for e in Repeatability.candidates(place)),
    ]
    fitted = (own.pose_um, own.pose_urad) if own.fit_pose else (0.0, 0.0)
    fit = machine(setting, family.times(setting.family_factor))
    return truth.with_effects(*added), fit.with_effects(_pose(*fitted))


def _pose(um: float, urad: float) -> Station:
    return Station(given=tuple((c, 0.0, um if c in "XYZ" else urad) for c in COMPONENTS))
