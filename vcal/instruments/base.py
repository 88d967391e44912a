"""What an instrument is, and the registry that finds instruments by name."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field

from ..arrays import Array
from ..catalogue import Catalogue
from ..chain import Chain
from ..effects.base import Artefact, Effect
from ..plan import Plan
from ..record import Record
from ..rigid import Rotation, Scalar, Vector


class Column(BaseModel):
    """A column an instrument expects in its data, in the file's units."""

    model_config = ConfigDict(frozen=True)
    name: str
    low: float = -np.inf
    high: float = np.inf
    """Physical range, ends included."""
    integer: bool = False
    unique_with: tuple[str, ...] = ()
    """Index columns that together with this one must not repeat."""
    sparse: bool = False
    """Whether it may be left out, and counts as left out where hardly any cell is a number."""


LARGEST_NOISE = 1e5
"""um or urad: an instrument that is off by a decimetre measures no machine, or in another unit."""
FileName = Annotated[str, Field(min_length=1)]
"""A file beside the study file."""


Loader = Callable[[str, list[Column]], Mapping[str, np.ndarray]]
"""Reads and checks a table beside the study file: (file name, columns) -> columns."""


Ports = Mapping[str, Sequence[Scalar]]
"""The instrument's own ports of one row, by group: ``ports["frame"]`` has six."""


class InstrumentSettings(BaseModel):
    """What every ``[instrument]`` table holds; each instrument adds its own keys."""

    model_config = ConfigDict(extra="forbid")
    kind: str
    kind_file: FileName | None = None
    """Python file beside the study with the class of that kind, where it is one's own."""


class Instrument(Record):
    """Base class of all instruments.

    An instrument is the geometry between the tool point and a reading, for one observation
    (`observe`), plus what it declares: its ports, its noise, its nuisances.
    """

    derived: ClassVar[tuple[str, ...]] = ()
    """Covariates that it derives, and that mean something to this very instrument only: angles as
    its station sees them, say.
    """

    @property
    @abc.abstractmethod
    def ports(self) -> tuple[str, ...]:
        """Names of its ports (`vcal.ports.group`)."""

    @property
    @abc.abstractmethod
    def readings(self) -> tuple[str, ...]:
        """Names of the components of one reading."""

    @property
    def warmer(self) -> float:
        """By how many K temperatures of its table are above those that effects count, which begin
        at 20 degC: readings that are changes since a run at another temperature count from there.
        """
        return 0.0

    # --- the path of one observation ------------------------------------------------------------
    def rows(self, plan: Plan) -> Any:
        """Pytree of what `observe` needs per row beside the pose (leading axis n)."""
        del plan
        return ()

    @abc.abstractmethod
    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        """Ideal reading of one row: tool frame in the workpiece frame, instrument's own ports.

        In components (`vcal.rigid`), so that it stays one elementwise expression when it is mapped
        over rows and draws.
        """

    def reduce(self, values: Float[Array, "n m *k"], plan: Plan) -> Float[Array, "n m *k"]:
        """Linear step from readings to what is fitted, applied to data, model and derivatives."""
        del plan
        return values

    def difference(self, measured: Array, predicted: Array) -> Array:
        """measured - predicted, with angles unwrapped where an instrument reads angles."""
        return measured - predicted

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """What would be written down: plan and readings (n, m). Only simulation needs this.

        `ideal` gives the readings without noise at a plan, `noise` (n, m) is what was drawn, SI. An
        instrument that reads axis positions returns the plan at the positions it finds.
        """
        return plan, ideal(plan) + noise

    # --- what it declares -----------------------------------------------------------------------
    @abc.abstractmethod
    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        """One-sigma noise of the reduced readings (n, m), SI."""

    @abc.abstractmethod
    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        """Metre per unit of each reading (n, m), so that residuals can be told in micrometres."""

    def start(self, chain: Chain, plan: Plan, readings: np.ndarray) -> Self:
        """The same instrument with its unknown poses started from the data."""
        del chain, plan, readings
        return self

    @abc.abstractmethod
    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        """Its nuisances, and effects with a prior such as uncertain calibrated positions."""

    @abc.abstractmethod
    def folds(self, plan: Plan) -> tuple[np.ndarray, bool | np.ndarray]:
        """How readings are held out: fold index per row (-1: never held out), and whether held-out
        rows are kept out of every fit (True) or rotated (False), for all rows or for each.
        """

    @abc.abstractmethod
    def dimensions(self, plan: Plan) -> np.ndarray:
        """How many readings of each row make one point (n,), for root mean squares of points."""

    def present(self, plan: Plan) -> np.ndarray:
        """Which readings there are (n, m); the others are zero, and nothing makes them differ."""
        return np.ones((plan.rows, len(self.readings)), bool)

    def clusters(self, plan: Plan) -> np.ndarray:
        """Index per row (n,) of the rows whose readings share errors of the machine that are not
        modelled, so that the covariance of a row is to be estimated from all of them; -1 where the
        noise is as declared.
        """
        return np.full(plan.rows, -1)

    @property
    def artefact(self) -> Artefact | None:
        """The artefact it measures, for the effects that act on it."""
        return None

    @property
    def members(self) -> Mapping[str, "Instrument"]:
        """The instruments of several data sets by their names; none where it is only one."""
        return {}


class TableInstrument(Instrument):
    """An instrument whose readings a study file names as one table; subclasses are final."""

    kind: ClassVar[str]
    """Name in study files."""
    dimension: ClassVar[int] = 3
    """How many readings make one point, for root mean squares of points."""
    machine: ClassVar[str | None] = None
    """Chain of a study without a ``[machine]``; without one the study has to have it."""
    positioned: ClassVar[bool] = False
    """Whether the axis positions are in columns of its own."""
    labels: ClassVar[tuple[str, ...]] = ()
    """Columns of text in its data table."""
    Settings: ClassVar[type[InstrumentSettings]] = InstrumentSettings
    """Keys of the ``[instrument]`` table, validated."""

    # --- edges: from and to files -------------------------------------------------------------
    @classmethod
    @abc.abstractmethod
    def columns(cls, settings: Any, axes: Sequence[str], readings: bool) -> list[Column]:
        """Columns of its data table besides the conditions; without readings for a plan."""

    @classmethod
    @abc.abstractmethod
    def build(
        cls, settings: Any, chain: Chain, table: Mapping[str, np.ndarray], load: Loader
    ) -> Self:
        """From validated settings and data; `load` reads a further table beside the study file.

        Raises `StudyError` where the data and the further tables do not fit together.
        """

    @abc.abstractmethod
    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        """The command step: what the axes did, with every covariate that can be derived."""

    @abc.abstractmethod
    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        """Readings (n, m) in SI from the columns of the table."""

    @abc.abstractmethod
    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        """The inverse of `plan` and `measured`: columns in file units."""

    def dimensions(self, plan: Plan) -> np.ndarray:
        return np.full(plan.rows, self.dimension)


INSTRUMENTS: Catalogue[type[TableInstrument]] = Catalogue("instrument", "kind")
"""Every instrument a study file may name, by kind."""

register = INSTRUMENTS.register
