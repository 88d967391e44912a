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


SMALLEST_NOISE, LARGEST_NOISE = 1e-5, 1e5
"""um or urad: an instrument that is off by a decimetre measures no machine, or in another unit, and
so does one that is never off by a tenth of an atom."""
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
    """Kind of the instrument: one of those that vcal knows, or that of a class in `kind_file`."""
    kind_file: FileName | None = None
    """Python file beside the study with the class of that kind, where it is one's own."""


class Instrument(Record):
    """Base class of all instruments.

    An instrument is the geometry between the tool point and a reading, for one observation
    (`observe`), plus what it declares: its ports, its noise, its nuisances. A row is one
    observation, all its m readings together; a plan has n of them. Everything is in SI: m, rad, s.

    It is a frozen dataclass and a pytree: fields hold numbers and arrays, and what decides anything
    in `observe` (a name, a flag, a tuple of numbers) is an ``eqx.field(static=True)``, which has to
    be hashable. Compiled programs take the arrays as arguments. Methods are called as often as need
    be: they give the same for the same plan, and leave it as it is.
    """

    derived: ClassVar[tuple[str, ...]] = ()
    """Covariates that it derives, and that mean something to this very instrument only: angles as
    its station sees them, say. Among several data sets they stay with its own, and descriptions of
    what is unexplained multiply none of them.
    """

    @property
    @abc.abstractmethod
    def ports(self) -> tuple[str, ...]:
        """Names of its ports, ``GROUP.COMPONENT`` (`vcal.ports.group`): where a deviation of its
        own can enter, m or rad. The components of a group stand together; the groups ``tool`` and
        those of the axes are the machine's. Its effects name them in their response.
        """

    @property
    @abc.abstractmethod
    def readings(self) -> tuple[str, ...]:
        """Names of the m components of one reading, each once."""

    @property
    def warmer(self) -> float:
        """By how many K temperatures of its table are above those that effects count, which begin
        at 20 degC: readings that are changes since a run at another temperature count from there.
        """
        return 0.0

    # --- the path of one observation ------------------------------------------------------------
    def rows(self, plan: Plan) -> Any:
        """Pytree of what `observe` needs per row beside the pose (leading axis n): the nominal
        place of a ball, say. Nothing by default. Not traced: numpy will do.
        """
        del plan
        return ()

    @abc.abstractmethod
    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        """Ideal reading of one row: m numbers in the order of `readings`.

        `row` is that of `rows`, `rotation` and `tool` are the tool frame and the tool point in the
        workpiece frame with all errors of the machine, `ports` its own by group, zero for a nominal
        instrument: ``ports["frame"][0]`` is ``frame.X``.

        In components (`vcal.rigid`), so that it stays one elementwise expression when it is mapped
        over rows and draws. It is traced and differentiated: `jax.numpy` instead of numpy, no
        ``float()`` and no ``if`` on what comes in, and a derivative that is finite at the nominal
        machine. A port may also be a plain Python number.
        """

    def reduce(self, values: Float[Array, "n m *k"], plan: Plan) -> Float[Array, "n m *k"]:
        """Linear step from readings to what is fitted, applied to data, model and derivatives: as
        many come out as go in. The readings themselves by default. Traced, the plan too.
        """
        del plan
        return values

    def difference(self, measured: Array, predicted: Array) -> Array:
        """measured - predicted (n, m), with angles unwrapped where an instrument reads angles.
        Traced.
        """
        return measured - predicted

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """What would be written down: plan and readings (n, m). Only simulation needs this.

        `ideal` gives the readings (n, m) without noise at a plan, of a machine with errors; `noise`
        (n, m) is what was drawn, SI. By default the plan as it is, and readings with noise.

        An instrument that looks for a place instead of reading one (a probe that is moved until it
        touches) is *implicit*: its reading is by how much that place was missed, zero as measured.
        It returns the plan at the positions it finds, where `ideal` is zero, displaced by the
        noise, and readings of zero. One that derives covariates from what it reads returns a plan
        with those that it would have read. Raises `StudyError` where there is no such place.
        """
        return plan, ideal(plan) + noise

    # --- what it declares -----------------------------------------------------------------------
    @abc.abstractmethod
    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        """One-sigma noise of the reduced readings (n, m), SI, above zero: independent from reading
        to reading. What readings share, such as a wrong place of a ball, is one of `effects`.

        `readings` (n, m) are those measured, or what a nominal machine would give.
        """

    @abc.abstractmethod
    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        """Metre per unit of each reading (n, m), so that residuals can be told in micrometres: one
        for a length, the lever arm for an angle. Figures of error go by it, no fit does.
        """

    def start(self, chain: Chain, plan: Plan, readings: np.ndarray) -> Self:
        """The same instrument with its unknown poses started from the data, near enough that a
        linearisation there holds; itself by default. Not called for a plan without readings.
        """
        del chain, plan, readings
        return self

    @abc.abstractmethod
    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        """Its nuisances, and effects with a prior such as uncertain calibrated positions.

        What is unknown and has no prior (the pose of a station, the centre of a circle) is an
        effect of the kind *nuisance* whose parameters have no sigma, only a scale; the readings
        have to tell all of them. What is known with an uncertainty has parameters with that sigma,
        and is *systematic*, or *random* where it is another one in every row. `where` is
        ``"instrument"``. Every key (name and placement) once.
        """

    @abc.abstractmethod
    def folds(self, plan: Plan) -> tuple[np.ndarray, bool | np.ndarray]:
        """How readings are held out, to see how well those are foretold that were not fitted: fold
        index per row (n,), and whether held-out rows are kept out of every fit.

        Rows with the same index, a whole number from 0 on, are held out together; rows with -1
        never are, they are fitted always. The second says what held out means, for all rows or for
        each (n,), where it counts in those with an index only:

        - False, they *rotate*: all rows are fitted, and each fold is foretold from the others, one
          after the other. Nothing is lost, so that this is the rule.
        - True, they are *kept apart*: no fit ever sees them, whatever their index, and they are
          foretold from all others. For what is to hold later on as well: the last fifth of the
          poses of an arm that is used after it was calibrated. It costs these rows.

        What is known only together belongs into one fold: all balls of a pose, whose six unknowns
        no other row tells (such parameters without a prior are fitted to the fold itself). Where
        neighbours share what drifts, folds are blocks in time rather than every fifth row. There
        are at least two folds, or rows that are fitted beside the held-out ones; five are usual.
        """

    @abc.abstractmethod
    def dimensions(self, plan: Plan) -> np.ndarray:
        """How many readings of each row make one point (n,), for root mean squares of points: a row
        counts as the mean square of its readings times this. Three for a point in space, however
        many readings tell it; nine coordinates of three reflectors are three points of three. One
        for a distance alone.
        """

    def present(self, plan: Plan) -> np.ndarray:
        """Which readings there are (n, m), at least one in every row; all by default. The others
        are zero, and nothing makes them differ.
        """
        return np.ones((plan.rows, len(self.readings)), bool)

    def clusters(self, plan: Plan) -> np.ndarray:
        """Index per row (n,) of the rows whose readings share errors of the machine that are not
        modelled, so that the covariance of a row is to be estimated from all of them; -1, as by
        default, where the noise is as declared but for its size, which is looked for anyway.

        For rows of many readings of which the machine's own scatter disturbs all alike: the
        coordinates of reflectors on an arm. Rows of one index have the same readings present. Those
        of an index with no more rows than readings, or with next to nothing left beyond the
        parameters, keep the declared noise.
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
    """An instrument whose readings a study file names as one table; subclasses are final.

    One of a user's own is such a class in a Python file that the study names beside its kind:

        [instrument]
        kind = "double_ball_bar"
        kind_file = "ball_bar.py"

    It needs no registration, and what it registers is forgotten. It is tried once when a study is
    read (`vcal.io.own_trial`): whatever has another shape than is said here is told with the
    class and the method. ``tests/own_instrument/ball_bar.py`` is one in full.
    """

    kind: ClassVar[str]
    """Name in study files: letters, digits and ``_``."""
    dimension: ClassVar[int] = 3
    """How many readings make one point, where that is the same in all rows (`dimensions`)."""
    machine: ClassVar[str | None] = None
    """Chain of a study without a ``[machine]``; without one the study has to have it."""
    rotary: ClassVar[bool] = False
    """Whether it measures machines that have rotary axes as well."""
    positioned: ClassVar[bool] = False
    """Whether the axis positions are in columns of its own; else the table has ``x_mm``, ... of
    every linear axis, without `columns` naming them.
    """
    labels: ClassVar[tuple[str, ...]] = ()
    """Columns of text in its data table."""
    remembers: ClassVar[bool] = False
    """Whether `plan` derives of a row what other rows say, as the last move of a joint.

    Rows of which a reading is blank are left out of the table before an instrument sees it. `plan`
    of one that remembers has them, with the readings of a neighbour, and they are left out of what
    it gives.
    """
    read_otherwise: ClassVar[tuple[str, ...]] = ()
    """Columns that it reads with some settings, and not with others: without the readings of its
    own settings, a table that has one is no plan.
    """
    Settings: ClassVar[type[InstrumentSettings]] = InstrumentSettings
    """Keys of the ``[instrument]`` table, validated; units stand in their names."""

    # --- edges: from and to files -------------------------------------------------------------
    @classmethod
    @abc.abstractmethod
    def columns(cls, settings: Any, axes: Sequence[str], readings: bool) -> list[Column]:
        """Columns of its data table besides the conditions; without readings for a plan.

        A table that has none of the columns which only the list with readings has is a plan. Where
        the two lists are the same, what is measured are the positions, and every table is data.
        Further columns of numbers (``t_s``, ``T_x_degC``, ``dir_x``) are read anyway.
        """

    @classmethod
    @abc.abstractmethod
    def build(
        cls, settings: Any, chain: Chain, table: Mapping[str, np.ndarray], load: Loader
    ) -> Self:
        """From validated settings and data; `load` reads a further table beside the study file.

        `table` has its columns in the units of the file, `chain` the axes, their travel and
        `tool_offset` (m). Raises `StudyError` where the data and the further tables do not fit
        together: `RowError` for a row, `KeyedError` for a key, which need not know the file.
        """

    @abc.abstractmethod
    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        """The command step: what the axes did, with every covariate that can be derived. Of linear
        axes `linear_plan` makes it, which has to be told of indices that only this instrument knows
        (``groups``). The axes are those of the chain, in their order.
        """

    @abc.abstractmethod
    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        """Readings (n, m) in SI from the columns of the table; zeros of an implicit instrument."""

    @abc.abstractmethod
    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        """The inverse of `plan` and `measured`: columns in file units, one cell per row. Columns
        that it leaves out stay as they are in the table of the plan.
        """

    def dimensions(self, plan: Plan) -> np.ndarray:
        return np.full(plan.rows, self.dimension)


INSTRUMENTS: Catalogue[type[TableInstrument]] = Catalogue("instrument", "kind")
"""Every instrument a study file may name, by kind."""

register = INSTRUMENTS.register
