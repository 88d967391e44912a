"""Static R-test: three probes measure a sphere that is nominally at rest while rotary axes turn and
the linear axes follow.

The readings of the probes are the combined error of rotary and linear axes. Weikert, Knapp (2004),
CIRP Annals 53(1), 429-432; Bringmann, Knapp (2006), CIRP Annals 55(1), 531-534; Ibaraki, Oyama,
Otsubo (2011), Int. J. Mach. Tools Manuf. 51(3), 190-200. The kinematic tests of ISO 10791-6 travel
the same paths.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

import equinox as eqx
import numpy as np

from ..bounds import Uncertainty
from ..effects.base import Effect, Response
from ..errors import KeyedError, RowError
from ..machine.chain import Chain
from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..machine.ports import group
from ..numerics.arrays import Array
from ..numerics.rigid import Rotation, Scalar, Vector
from ..words import counted
from .base import Column, Loader, Ports, TableInstrument, register
from .conditions import ROTARY, file_column, linear_plan, linear_plan_table
from .follow import cause
from .marks import Mark
from .nest import COORDINATES, PROBES, Nest, NestSettings, PlaceOfRuns, reading_columns

_XYZ = ("X", "Y", "Z")
_ELEMENTS = tuple(i + j for i in _XYZ for j in _XYZ)
_FEWEST = 4
"""Least number of rows of a run, one of which determines the position of the sphere."""
_FOLDS = 5
"""Number of parts of a run that are held out in turn."""


class StaticRTestSettings(NestSettings):
    """Keys of ``[instrument]`` for ``kind = "static_r_test"``."""

    nest: Literal["spindle", "table"]
    """Position of the probes; the sphere is at the other end."""
    zero_u_um: Uncertainty
    """Standard uncertainty of the position of the sphere, or of the middle of the probes, in the
    spindle: of each coordinate relative to the declared tool offset. Positions of rotary axes are
    relative to it.
    """


class TablePlaces(PlaceOfRuns):
    """Position of the sphere, or of the probes, on the table, in the frame of the workpiece: three
    parameters per run with flat priors.
    """

    name = "table_place"
    summary = "place of the sphere, or of the probes, on the table in each run"
    group = "place"


class SpindleZero(Effect):
    """Position of the sphere, or of the probes, in the spindle relative to the declared tool
    offset, in the frame of the tool, known with an uncertainty and the same in all runs.
    """

    name = "spindle_zero"
    summary = "place of the sphere, or of the probes, in the spindle"
    where = "instrument"
    sigma: float = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(c, "um", sigma=self.sigma / 1e-6) for c in _XYZ)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(f"zero.{c}", c): np.ones(plan.rows) for c in _XYZ}


class NestMatrix(Effect):
    """Errors of the probes' sensitivities and directions: a displacement p is read as (1 + S) p."""

    name = "nest_matrix"
    summary = "sensitivities and directions of the probes"
    where = "instrument"
    sigma: float = 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"S_{k}", "um/m", sigma=self.sigma / 1e-6) for k in _ELEMENTS)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        return {(f"matrix.{k}", f"S_{k}"): np.ones(plan.rows) for k in _ELEMENTS}


@register
class StaticRTest(TableInstrument):
    """Centre p of the sphere in the frame of the probes.

    With the tool point t and the rotation R of the tool in the frame of the workpiece, s the
    position on the table and z the position in the spindle relative to the declared tool offset::

        p = (1 + S) R' (s - t - R z)        (probes in the spindle)
        p = (1 + S) (t + R z - s)           (probes on the table, which turn with it)

    s is constant in a run; its initial value is the mean of the run's nominal tool points, which
    must all be within the range of the probes. An error of the position of the whole table cannot
    be separated from z: positions of rotary axes are relative to the sphere, or the probes, in the
    spindle.
    """

    kind = "static_r_test"
    rotary = True
    read_otherwise = (*COORDINATES, *PROBES)
    Settings = StaticRTestSettings

    sigma: float
    """Noise of a coordinate, m."""
    zero_sigma: float
    matrix_sigma: float
    in_spindle: bool = eqx.field(static=True)
    """Whether the probes are in the spindle."""
    nest: Nest
    runs: tuple[int, ...] = eqx.field(static=True)
    places: np.ndarray
    """Nominal s in the order of `runs` (runs, 3), m."""

    @property
    def ports(self) -> tuple[str, ...]:
        return group("place", _XYZ) + group("zero", _XYZ) + group("matrix", _ELEMENTS)

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        return (Mark("sphere" if self.in_spindle else "nest", self.places, free=True),)

    @property
    def readings(self) -> tuple[str, ...]:
        return self.nest.readings

    @classmethod
    def columns(
        cls, settings: StaticRTestSettings, axes: Sequence[str], readings: bool
    ) -> list[Column]:
        return [Column(name="run", low=0, integer=True)] + reading_columns(settings) * readings

    @classmethod
    def build(
        cls,
        settings: StaticRTestSettings,
        chain: Chain,
        table: Mapping[str, np.ndarray],
        load: Loader,
    ) -> Self:
        run = np.asarray(table["run"], int)
        position = np.asarray(linear_plan(chain, {k: table[k] for k in _places(chain)}).position)
        runs = np.unique(run)
        _check_runs(run, runs)
        _check_turns(chain, run, position)
        _check_follows(chain, settings.range_mm * 1e-3, run, position)
        points = chain.tool_point(position)
        return cls(
            sigma=settings.external_sigma_um * 1e-6,
            zero_sigma=settings.zero_u_um * 1e-6,
            matrix_sigma=settings.matrix_sigma,
            in_spindle=settings.nest == "spindle",
            nest=Nest.of(settings),
            runs=tuple(int(k) for k in runs),
            places=np.stack([points[run == k].mean(0) for k in runs]),
        )

    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        return linear_plan(chain, table, (*COORDINATES, *PROBES))

    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        return self.nest.measured(table)

    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        return {**linear_plan_table(plan), **self.nest.to_table(readings)}

    def rows(self, plan: Plan) -> Any:
        return self.places[np.searchsorted(self.runs, np.asarray(plan.groups["run"]))]

    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        above = tool + rotation @ Vector.of(ports["zero"])
        below = Vector.of(row) + Vector.of(ports["place"])
        p = rotation.T @ (below - above) if self.in_spindle else above - below
        s = ports["matrix"]
        return self.nest.read(p + Vector(*(Vector.of(s[k : k + 3]).dot(p) for k in (0, 3, 6))))

    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.full((plan.rows, 3), self.sigma)

    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        return np.ones((plan.rows, 3))

    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        found: tuple[Effect, ...] = (TablePlaces(runs=self.runs),)
        if self.zero_sigma > 0.0:
            found += (SpindleZero(sigma=self.zero_sigma),)
        if self.matrix_sigma > 0.0:
            found += (NestMatrix(sigma=self.matrix_sigma),)
        return found

    def folds(self, plan: Plan) -> tuple[np.ndarray, bool]:
        # Fifths of every run, contiguous in time, as neighbours share a drift; the other fifths
        # determine the position of the sphere.
        run, fold = np.asarray(plan.groups["run"]), np.zeros(plan.rows, int)
        for k in np.unique(run):
            mine = plan.in_time(np.flatnonzero(run == k))
            fold[mine] = np.arange(len(mine)) * _FOLDS // len(mine)
        return fold, False


def _places(chain: Chain) -> list[str]:
    """Columns of the axis positions."""
    return [file_column(axis, chain.axes)[0] for axis in chain.axes]


def _check_runs(run: np.ndarray, runs: np.ndarray) -> None:
    for k in runs:
        rows = np.flatnonzero(run == k)
        if len(rows) < _FEWEST:
            raise RowError(
                int(rows[0]),
                "column run",
                f"{counted(len(rows), 'row')} of run {k}",
                f"at least {_FEWEST}, as a run has a place of its own on the table",
                "measure more, leave them out, or give them the run to which they belong",
            )


def _check_turns(chain: Chain, run: np.ndarray, position: np.ndarray) -> None:
    """Raise `StudyError` where no rotary axis turns: only the position is observable then."""
    turning = [i for i, axis in enumerate(chain.axes) if axis in ROTARY]
    if not turning:
        raise KeyedError(
            "machine.chain",
            f"{chain.text!r}, without a rotary axis",
            "one that turns the sphere, as linear axes alone have nothing to follow",
            'add it, as in "w C b X Y Z t"; circles of linear axes are the r_test',
        )
    if not any(np.ptp(position[run == k][:, turning]) > 0.0 for k in np.unique(run)):
        columns = ", ".join(file_column(chain.axes[i], chain.axes)[0] for i in turning)
        raise RowError(
            0,
            f"column {columns}",
            "the same in all rows of every run",
            "rotary axes that turn within a run",
            "correct the column run, or measure at other angles",
        )


def _check_follows(chain: Chain, reach: float, run: np.ndarray, position: np.ndarray) -> None:
    """Raise `RowError` where the nominal tool point leaves the mean position of its run."""

    def off(points: np.ndarray) -> np.ndarray:
        found = np.empty(len(run))
        for k in np.unique(run):
            found[run == k] = np.linalg.norm(points[run == k] - points[run == k].mean(0), axis=1)
        return found

    found = off(chain.tool_point(position))
    row = int(np.argmax(found))
    if found[row] > reach:
        raise RowError(
            row,
            "columns " + ", ".join(_places(chain)),
            f"a tool point {1e3 * found[row]:.4g} mm from the mean of run {run[row]}, in the frame "
            "of the workpiece",
            f"axes that follow the sphere, within the {1e3 * reach:g} mm of instrument.range_mm",
            cause(chain, chain.axes, position, off, reach)
            or "correct the positions, their signs, machine.rotary or the run",
        )
