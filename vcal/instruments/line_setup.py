"""What is unknown of an interferometer's set-ups: zero, slope and alignment of every line, the
optical square, and the scale of the laser with its compensation to 20 degC.

All of them add to the readings of a line in proportion to one, or to the distance s = x - c of the
moving axis from the middle c of the line. A line is a set-up: one moving axis, one alignment of the
optics, one place of the reflector.
"""

import abc
from collections.abc import Iterator, Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, Kind, Response
from ..effects.thermal import REFERENCE_DEGC
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.record import Record

POSITION = "meas_position"
STRAIGHT = ("meas_straight_x", "meas_straight_y", "meas_straight_z")
ANGLES = ("meas_angle_a", "meas_angle_b", "meas_angle_c")
READ = (POSITION, *STRAIGHT, *ANGLES)
"""All kinds of reading: positioning, two of the three straightnesses, roll, pitch and yaw."""
LINE, AIR, MATERIAL = "line", "T_air", "T_material"
"""Index of the set-up, and the covariates of the environment."""


def unit_of_reading(name: str) -> str:
    """``"urad"`` of an angle, ``"um"`` otherwise."""
    return "urad" if name in ANGLES else "um"


class Lines(Record):
    """The lines of a measurement, in the order of their numbers."""

    numbers: tuple[int, ...] = eqx.field(static=True)
    axes: tuple[str, ...] = eqx.field(static=True)
    """The axis that moves along each."""
    along: np.ndarray
    """Its direction in the frame of the bed (lines, 3)."""
    reads: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    """Kinds of reading of each."""
    labels: tuple[str, ...] = eqx.field(static=True)
    """Name of the alignment of each; lines with one name share it by an optical square."""
    centres: np.ndarray
    """Middle c of the positions of each (lines,), m."""
    starts: np.ndarray
    """Position of the first row of each (lines,), m."""
    offsets: np.ndarray
    """Place of the reflector relative to the tool point, in the frame of the tool (lines, 3), m."""
    dead_paths: np.ndarray
    """Length of air between interferometer and reflector at the first row of each (lines,), m."""

    def index(self, plan: Plan) -> np.ndarray:
        """Index (n,) of the line of every row."""
        return np.searchsorted(self.numbers, np.asarray(plan.groups[LINE]))

    def moving(self, plan: Plan) -> Float[Array, " n"]:
        """Position (n,) of the axis that moves, m; it may be traced."""
        columns = np.array([plan.axes.index(axis) for axis in self.axes])
        chosen = np.eye(len(plan.axes))[columns[self.index(plan)]]
        return (plan.position * chosen).sum(1)

    def distance(self, plan: Plan) -> Float[Array, " n"]:
        """Distance s (n,) from the middle of the line, m; it may be traced."""
        return self.moving(plan) - self.centres[self.index(plan)]

    def present(self, plan: Plan, names: tuple[str, ...]) -> np.ndarray:
        """Which of the readings `names` exist (n, m)."""
        has = np.array([[name in reads for name in names] for reads in self.reads])
        return has[self.index(plan)]

    def with_position(self) -> list[int]:
        """The lines of which the positioning is read."""
        return [k for k, reads in enumerate(self.reads) if POSITION in reads]

    def slopes(self, k: int) -> Iterator[tuple[str, str, float]]:
        """The rotations of the optics that give a straightness of line k a slope: component,
        reading, and slope per radian.

        Optics that are rotated by w see a displacement s e along the line as s (e - w x e).
        """
        for i, rotation in enumerate("ABC"):
            slope = -np.cross(np.eye(3)[i], self.along[k])
            for c, reading in enumerate(STRAIGHT):
                if reading in self.reads[k] and slope[c] != 0.0:
                    yield rotation, reading, float(slope[c])

    def shared(self) -> list[int]:
        """The lines whose alignment is that of another one too."""
        return [k for k, label in enumerate(self.labels) if self.labels.count(label) > 1]


class LineZero(Effect):
    """Zero of every reading of every line, or of every run of it: constants with flat priors."""

    name = "line_zero"
    summary = "zero of every reading of an interferometer in every set-up"
    kind = "nuisance"
    where = "instrument"
    lines: Lines
    runs: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    """Numbers of the runs of every line that have zeros of their own; empty where they share one.
    """

    def _zeros(self) -> Iterator[tuple[str, str, int, int | None]]:
        """Name of the parameter, reading, number of the line, and of the run."""
        for k, (number, reads) in enumerate(zip(self.lines.numbers, self.lines.reads, strict=True)):
            for run in self.runs[k] if self.runs else (None,):
                for reading in reads:
                    own = "" if run is None else f"{run}."
                    yield f"{number}.{own}{reading.removeprefix('meas_')}", reading, number, run

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(name, unit_of_reading(reading), scale=10.0)
            for name, reading, _, _ in self._zeros()
        )

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        line = plan.groups[LINE]
        found = {}
        for name, reading, number, run in self._zeros():
            rows = line == number
            rows = rows if run is None else rows & (plan.groups["run"] == run)
            found[f"read.{reading}", name] = rows * 1.0
        return found


class _Slope(Effect):
    """Base class of a slope of the positioning of every line: a beam at the angle g to the axis
    reads s cos(g), and the refractive index of the air and its compensation differ between set-ups.
    """

    where = "instrument"
    lines: Lines
    sigma: float = np.inf
    """Prior standard deviation, m/m."""

    def _names(self) -> Iterator[tuple[str, int]]:
        for k in self.lines.with_position():
            yield f"{self.lines.numbers[k]}", self.lines.numbers[k]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        more: dict = {"scale": 10.0} if np.isinf(self.sigma) else {"sigma": self.sigma / 1e-6}
        return tuple(Parameter(name, "um/m", **more) for name, _ in self._names())

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        s, line = self.lines.distance(plan), plan.groups[LINE]
        port = f"read.{POSITION}"
        return {(port, name): (line == number) * s for name, number in self._names()}


class BeamSlope(_Slope):
    """Slope of the positioning in every line, known to be zero with an uncertainty."""

    name = "beam_slope"
    summary = "slope of the positioning in a set-up: cosine error, refractive index"


class FreeBeamSlope(_Slope):
    """Slope of the positioning in every line, unknown."""

    name = "free_beam_slope"
    summary = "unknown slope of the positioning in a set-up"
    kind = "nuisance"


class _Rotations(Effect):
    """Base class of rotations of the optics that give the straightness readings a slope."""

    where = "instrument"
    lines: Lines
    kind: ClassVar[Kind]

    @abc.abstractmethod
    def _owners(self) -> Iterator[tuple[str, int]]:
        """Owner of the rotations of every line, and the index of the line."""

    def _terms(self) -> Iterator[tuple[str, str, int, float]]:
        for owner, k in self._owners():
            for rotation, reading, slope in self.lines.slopes(k):
                yield f"{owner}.{rotation}", reading, k, slope

    def _names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for name, *_ in self._terms()))

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        s, line = self.lines.distance(plan), plan.groups[LINE]
        found: dict = {}
        for name, reading, k, slope in self._terms():
            key = f"read.{reading}", name
            found[key] = found.get(key, 0.0) + (line == self.lines.numbers[k]) * (slope * s)
        return found


class BeamAlignment(_Rotations):
    """Rotation of the straightness optics, or of the straight-edge, of every alignment: A, B, C in
    the frame of the bed, with flat priors. Lines along one axis cannot show that about it.
    """

    name = "beam_alignment"
    summary = "alignment of the straightness optics of an interferometer"
    kind = "nuisance"

    def _owners(self) -> Iterator[tuple[str, int]]:
        for k, label in enumerate(self.lines.labels):
            yield label, k

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "urad", scale=100.0) for name in self._names())


class OpticalSquare(_Rotations):
    """Error of the optical square, or of its adjustment, in every line that shares an alignment:
    rotations known to be zero with an uncertainty.
    """

    name = "optical_square"
    summary = "error of the optical square between lines that share an alignment"
    kind = "systematic"
    sigma: float = 0.0
    """Standard uncertainty, rad."""

    def _owners(self) -> Iterator[tuple[str, int]]:
        for k in self.lines.shared():
            yield f"{self.lines.numbers[k]}", k

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, "urad", sigma=self.sigma / 1e-6) for name in self._names())


class LaserScale(Effect):
    """Scale of the laser: wavelength and its calibration, the same in all lines."""

    name = "laser_scale"
    summary = "scale error of the laser, common to all set-ups"
    where = "instrument"
    lines: Lines
    sigma: float = 0.0
    """Standard uncertainty, m/m."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("scale", "um/m", sigma=self.sigma / 1e-6),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(f"read.{POSITION}", "scale"): self.lines.distance(plan)}


class MaterialCompensation(Effect):
    """Errors of the compensation of readings to 20 degC: alpha (T_material - 20 degC) s is
    subtracted from the positioning with an uncertain alpha, and with an uncertain temperature.
    """

    name = "material_compensation"
    summary = "expansion coefficient and temperature of the compensation to 20 degC"
    where = "instrument"
    lines: Lines
    expansion: float = 0.0
    """alpha, 1/K."""
    expansion_sigma: float = 0.0
    """1/K."""
    temperature_sigma: float = 0.0
    """K."""

    @property
    def reference(self) -> None:
        """20 degC is exact: ISO 1."""
        return None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        found = (
            ("expansion", "um/(m K)", self.expansion_sigma / 1e-6),
            ("temperature", "K", self.temperature_sigma),
        )
        return tuple(Parameter(name, unit, sigma=sigma) for name, unit, sigma in found if sigma)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        s, port = self.lines.distance(plan), f"read.{POSITION}"
        warm = plan.covariate(MATERIAL) - REFERENCE_DEGC
        found: dict = {}
        if self.expansion_sigma:
            found[port, "expansion"] = -s * warm
        if self.temperature_sigma:
            found[port, "temperature"] = -s * self.expansion
        return found


class DeadPath(Effect):
    """Dead path: air that the compensation does not count, of the length L in every set-up, changes
    the positioning by k L (T_air - mean of the line).
    """

    name = "dead_path"
    summary = "uncompensated air between interferometer and reflector at zero"
    where = "instrument"
    lines: Lines
    sigma: float = 0.0
    """Prior standard deviation of k, 1/K."""

    @property
    def reference(self) -> None:
        """A constant part is the zero of the line."""
        return None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("coefficient", "um/(m K)", sigma=self.sigma / 1e-6),)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        index, air = self.lines.index(plan), plan.covariate(AIR)
        rows = np.eye(len(self.lines.numbers))[index]
        mean = (rows.T @ air) / np.maximum(rows.sum(0), 1.0)
        response = self.lines.dead_paths[index] * (air - mean[index])
        return {(f"read.{POSITION}", "coefficient"): response}
