"""The base classes of all instruments, and the registry that finds instruments by kind."""

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field

from ..effects.base import Artefact, Effect
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..numerics.record import Record
from ..numerics.rigid import Rotation, Scalar, Vector
from ..registry import Catalogue
from .marks import Mark

Of = TypeVar("Of")


class Column(BaseModel):
    """A column an instrument expects in its data, in the file's units."""

    model_config = ConfigDict(frozen=True)
    name: str
    low: float = -np.inf
    high: float = np.inf
    """Physical range, ends included."""
    why: str = ""
    """Why no number is beyond it: a clause, for messages and the documentation."""
    integer: bool = False
    unique_with: tuple[str, ...] = ()
    """Index columns that together with this one must not repeat."""
    sparse: bool = False
    """Whether it is optional, and treated as absent where hardly any cell is a number."""


FileName = Annotated[str, Field(min_length=1)]
"""A file beside the study file."""


Loader = Callable[..., Mapping[str, np.ndarray]]
"""Reads and checks a table beside the study file: (file name, columns) -> columns; `labels=` names
columns of text."""


Ports = Mapping[str, Sequence[Scalar]]
"""The instrument's own ports of one row, by group: ``ports["frame"]`` has six."""


class InstrumentSettings(BaseModel):
    """Keys of every ``[instrument]`` table; each instrument adds its own."""

    model_config = ConfigDict(extra="forbid")
    kind: str
    """Kind of the instrument: one of those that vcal knows, or that of a class in `kind_file`."""
    kind_file: FileName | None = None
    """Python file beside the study that defines the class of that kind, for a user's own."""


class Instrument(Record):
    """Base class of all instruments.

    An instrument is the geometry between the tool point and a reading, for one observation
    (`observe`), together with its ports, its noise and its nuisances. A row is one observation with
    all its m readings; a plan has n rows. Everything is in SI: m, rad, s.

    An instrument is a frozen dataclass and a pytree: fields hold numbers and arrays; a field on
    which the control flow in `observe` depends (a name, a flag, a tuple of numbers) is an
    ``eqx.field(static=True)``, which must be hashable. Compiled programs take the arrays as
    arguments. Methods may be called any number of times: they return the same for the same plan,
    and do not change it.
    """

    derived: ClassVar[tuple[str, ...]] = ()
    """Covariates that it derives and that have a meaning for this instrument only, such as angles
    as seen from its station. In a study with several data sets, they belong to its own data set;
    empirical descriptions of unexplained deviations do not multiply by them.
    """

    @property
    @abc.abstractmethod
    def ports(self) -> tuple[str, ...]:
        """Names of its ports, ``GROUP.COMPONENT`` (`vcal.instruments.group`), at which its own
        deviations enter, m or rad. The components of a group are contiguous; the group
        ``tool`` and those of the axes belong to the machine. The instrument's effects name these
        ports in their response.
        """

    @property
    @abc.abstractmethod
    def readings(self) -> tuple[str, ...]:
        """Names of the m components of one reading, each once."""

    @property
    def temperature_offset_K(self) -> float:
        """Temperatures in its table minus those in the plan, K: zero where effects vanish at
        20 degC. Readings that are changes since a reference run at another temperature have the
        temperature of that run minus 20 degC.
        """
        return 0.0

    # --- the path of one observation ------------------------------------------------------------
    def rows(self, plan: Plan) -> Any:
        """Pytree of everything that `observe` needs per row besides the pose (leading axis n), such
        as the nominal position of a ball; empty by default. It is not traced: numpy may be used.
        """
        del plan
        return ()

    @abc.abstractmethod
    def observe(self, row: Any, rotation: Rotation, tool: Vector, ports: Ports) -> Sequence[Scalar]:
        """Ideal reading of one row: m numbers in the order of `readings`.

        `row` is one row of `rows`; `rotation` and `tool` are the tool frame and the tool point in
        the workpiece frame with all errors of the machine; `ports` are the instrument's own ports
        by group, zero for a nominal instrument: ``ports["frame"][0]`` is ``frame.X``.

        Vectors and rotations are in components (`vcal.numerics.rigid`), so that the function stays
        one elementwise expression when it is mapped over rows and draws. It is traced and
        differentiated: use `jax.numpy` instead of numpy, no ``float()`` and no ``if`` on the
        arguments; the derivative must be finite at the nominal machine. A port may also be a plain
        Python number.
        """

    def reduce(self, values: Float[Array, "n m *k"], plan: Plan) -> Float[Array, "n m *k"]:
        """Linear map from readings to the fitted values, applied to data, model and derivatives;
        it keeps the shape. The identity by default. It is traced, and so is the plan.
        """
        del plan
        return values

    def difference(self, measured: Array, predicted: Array) -> Array:
        """measured - predicted (n, m), with angles unwrapped where there are any. It is traced."""
        return measured - predicted

    def record(
        self, plan: Plan, ideal: Callable[[Plan], np.ndarray], noise: np.ndarray
    ) -> tuple[Plan, np.ndarray]:
        """The recorded plan and readings (n, m); only simulation needs this.

        `ideal` gives the readings (n, m) without noise at a plan, for a machine with errors;
        `noise` (n, m) is the drawn noise, SI. By default: the same plan, and readings with noise.

        An instrument that searches a position instead of reading one (a probe that is moved until
        it touches) is *implicit*: its reading is the distance to that position, which is zero in
        measured data. It returns the plan at the positions where `ideal` is zero, displaced by the
        noise, and readings of zero. One that derives covariates from its readings returns a plan
        with the covariates derived from the simulated readings. Raises `StudyError` where no such
        position exists.
        """
        return plan, ideal(plan) + noise

    # --- what it declares -----------------------------------------------------------------------
    @abc.abstractmethod
    def noise(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        """Standard deviation of the noise of the reduced readings (n, m), SI, above zero. The noise
        is independent between readings; an error common to several readings, such as a wrong
        position of a ball, is one of `effects`.

        `readings` (n, m) are the measured ones, or those of a nominal machine.
        """

    @abc.abstractmethod
    def lengths(self, plan: Plan, readings: np.ndarray) -> np.ndarray:
        """Metres per unit of each reading (n, m), to report residuals in micrometres: one for a
        length, the lever arm for an angle. Reported errors depend on it, fits do not.
        """

    def start(self, chain: Chain, plan: Plan, readings: np.ndarray) -> Self:
        """The same instrument with initial values of its unknown poses from the data, accurate
        enough for a linearisation there; itself by default. It is not called for a plan without
        readings.
        """
        del chain, plan, readings
        return self

    @abc.abstractmethod
    def effects(self, plan: Plan) -> tuple[Effect, ...]:
        """Its nuisances, and its effects with a prior, such as uncertain calibrated positions.

        An unknown without a prior (the pose of a station, the centre of a circle) is an effect of
        the kind *nuisance* whose parameters have no sigma, only a scale; the readings must
        determine all of them. A quantity known with an uncertainty has parameters with that sigma,
        and is *systematic*, or *random* where it is independent in every row. `where` is
        ``"instrument"``. Every key (name and placement) occurs once.
        """

    @abc.abstractmethod
    def folds(self, plan: Plan) -> tuple[np.ndarray, bool | np.ndarray]:
        """Folds of the cross-validation: fold index per row (n,), and whether held-out rows are
        excluded from every fit.

        Rows with the same index, an integer from 0 on, are held out together; rows with -1 are
        always fitted. The second value is one for all rows, or one for each (n,), of which only
        those of rows with an index count:

        - False: the folds *rotate*. All rows are fitted in the end, and each fold is predicted from
          the others in turn. This loses no data and is the usual choice.
        - True: the rows are *kept apart*. No fit includes them, whatever their index, and they are
          predicted from all others. This validates later use, such as with the last fifth of the
          poses of an arm that is used after its calibration. It costs these rows.

        Rows that determine an unknown only together belong to one fold: all balls of a pose, whose
        six unknowns no other row contains (such parameters without a prior are fitted to the fold
        itself). Where neighbouring rows share a drift, folds are blocks in time rather than every
        fifth row. There are at least two folds, or rows that are always fitted; five are usual.
        """

    @abc.abstractmethod
    def dimensions(self, plan: Plan) -> np.ndarray:
        """Dimension of a point in each row (n,), for rms errors of points: the squared error of a
        row is the mean square of its readings times this. It is three for a point in space, with
        any number of readings; nine coordinates of three reflectors are three points of dimension
        three. It is one for a single distance.
        """

    def present(self, plan: Plan) -> np.ndarray:
        """Which readings exist (n, m), at least one in every row; all by default. The others are
        zero in data and model.
        """
        return np.ones((plan.rows, len(self.readings)), bool)

    def clusters(self, plan: Plan) -> np.ndarray:
        """Index per row (n,) of groups of rows with a common covariance of the readings of a row,
        which is estimated from the residuals of the group; -1, the default, where the noise is as
        declared up to its size, which is estimated anyway.

        It is meant for rows of many readings that unmodelled scatter of the machine disturbs
        together, such as the coordinates of reflectors on an arm. Rows of one index have the same
        readings present. Groups with no more rows than readings, or with hardly any degrees of
        freedom beyond the parameters, keep the declared noise.
        """
        return np.full(plan.rows, -1)

    @property
    def frame_pose(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Initial orientation (3, 3) and origin (3,), m, of its frame in the frame of the
        workpiece or of an arm's base, which the ports ``frame.X`` to ``frame.C`` displace
        (`vcal.instruments.frame.displaced`); None without such a frame.
        """
        return None

    @property
    def tool_places(self) -> Mapping[str, np.ndarray]:
        """Initial places (3,), m, of points on the tool in the tool frame, by the group of the
        ports that displace them; empty where it reads the tool point.
        """
        return {}

    def marks(self, chain: Chain, plan: Plan) -> tuple[Mark, ...]:
        """Places that a picture of the declared machine shows: by default the frame of `frame_pose`
        and the points of `tool_places`.
        """
        del chain, plan
        found = []
        if self.frame_pose is not None:
            turn, origin = self.frame_pose
            found.append(Mark("instrument", np.reshape(origin, (1, 3)), frame=np.asarray(turn)))
        if self.tool_places:
            places = np.array([np.asarray(place, float) for place in self.tool_places.values()])
            found.append(Mark("point on the tool", places, "tool", free=True))
        return tuple(found)

    def as_declared(self) -> Self:
        """The instrument where the study file declares it, wherever its readings place it: that of
        a simulation. The same instrument by default.
        """
        return self

    def seen_points(self, readings: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n k 3"] | None:
        """Measured points (n, k, 3), m, in a frame of the instrument that is at rest to the
        workpiece: of the tool point (k = 1), or of the k `tool_places` in their order. None, the
        default, where the readings are no points.

        `readings` (n, m) are SI and not reduced. They serve the picture of the machine only.
        """
        del readings
        return None

    @property
    def artefact(self) -> Artefact | None:
        """The artefact it measures, for the effects that act on it."""
        return None

    @property
    def on_tool(self) -> tuple[str, ...]:
        """Names of its effects that belong to the tool, so that several data sets measured with
        that tool may share their parameters; none by default.
        """
        return ()

    @property
    def stations(self) -> tuple[str, ...]:
        """Names of its stations by their index in the group ``"station"``, where one table has
        several: what disturbs a stand is then an effect of each; empty otherwise.
        """
        return ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on what its readings contradict in its settings, without effect on the result,
        such as another approximate place; none by default.
        """
        return ()

    @property
    def averaged(self) -> str:
        """A sentence on samples that were averaged (`TableInstrument.summarised`); empty where all
        are used.
        """
        return ""

    @property
    def members(self) -> Mapping[str, "Instrument"]:
        """The instruments of several data sets by their names; empty for a single instrument."""
        return {}


def averaged_of(instrument: Instrument) -> list[str]:
    """What an instrument averages, or each of several with the name of its data set."""
    found = [instrument.averaged] if instrument.averaged else []
    for name, member in instrument.members.items():
        found += [f"{name}: {member.averaged}"] if member.averaged else []
    return found


def remarks_of(instrument: Instrument) -> list[str]:
    """The remarks of an instrument, or of each of several with the name of its data set."""
    found = [*instrument.remarks]
    for name, member in instrument.members.items():
        found += [f"{name}: {remark}" for remark in member.remarks]
    return found


class TableInstrument(Instrument):
    """An instrument whose readings a study file names as one table; subclasses are final.

    A user's own instrument is such a class in a Python file that the study names beside its kind::

        [instrument]
        kind = "disc_probe"
        kind_file = "disc_probe.py"

    It needs no registration, and anything it registers is removed afterwards. It is tried once when
    a study is read (`vcal.study.plugins.instrument_trial`): a method that returns anything but what
    is documented here is reported with its class and name. A complete example is
    ``tests/own_instrument/disc_probe.py``.
    """

    kind: ClassVar[str]
    """Name in study files: letters, digits and ``_``."""
    dimension: ClassVar[int] = 3
    """Dimension of a point, where it is the same in all rows (`dimensions`)."""
    machine: ClassVar[str | None] = None
    """Chain of a study without a ``[machine]``; where this is None, the study must have one."""
    rotary: ClassVar[bool] = False
    """Whether it can measure machines with rotary axes."""
    parallel: ClassVar[bool] = False
    """Whether it can measure machines with secondary linear axes U, V, W, such as a quill."""
    arms: ClassVar[bool] = False
    """Whether it measures arms, whose joint positions are in columns of its own."""
    positioned: ClassVar[bool] = False
    """Whether the axis positions are in columns of its own; otherwise the table has ``x_mm``, ...
    for every linear axis, which `columns` does not list.
    """
    labels: ClassVar[tuple[str, ...]] = ()
    """Columns of text in its data table."""
    remembers: ClassVar[bool] = False
    """Whether `plan` derives covariates of a row from other rows, such as the last move of a joint.

    Rows with a blank reading are removed from the table before an instrument gets it. The `plan` of
    an instrument that remembers gets them, with the readings of a neighbour; they are removed from
    its result.
    """
    steady: ClassVar[tuple[str, ...]] = ()
    """Columns of readings that may be the same in every row, such as a position on a detector."""
    read_by: ClassVar[str] = ""
    """Index column with which the kinds of reading differ, such as a set-up; empty where all rows
    have the same ones.

    Every column of readings may then be missing, and blank in all rows of an index: its cells are
    NaN in the table, and `present` says so. A row is left out only where a reading is blank that
    other rows of its index have.
    """
    shows_unseen: ClassVar[bool] = False
    """Whether `vcal check` says which error motions its readings do not determine."""
    read_otherwise: ClassVar[tuple[str, ...]] = ()
    """Columns that are readings with some settings and not with others: a table with one of them,
    but without the readings of the current settings, is not a plan.
    """
    Settings: ClassVar[type[InstrumentSettings]] = InstrumentSettings
    """Keys of the ``[instrument]`` table, validated; their names end in the unit."""

    def with_tool_of(
        self, other: Self, chain: Chain, plan: Plan, readings: np.ndarray | None
    ) -> Self:
        """The same instrument with the initial values that another one of the same kind has for
        what is on the tool (`on_tool`), and its other initial values to match; itself by default.

        Raises `ValueError` that says what differs, where it cannot be the same tool.
        """
        del other, chain, plan, readings
        return self

    # --- edges: from and to files -------------------------------------------------------------
    @classmethod
    def recognised(cls, settings: Any, header: Sequence[str]) -> Any:
        """The settings, completed by what the names of the columns of its table say; the same by
        default.
        """
        del header
        return settings

    @classmethod
    def label_columns(cls, settings: Any, header: Sequence[str]) -> tuple[str, ...]:
        """Columns of text that a table with this header has, or lacks; `labels` by default."""
        del settings, header
        return cls.labels

    @classmethod
    @abc.abstractmethod
    def columns(cls, settings: Any, axes: Sequence[str], readings: bool) -> list[Column]:
        """Columns of its data table besides the conditions; without the readings for a plan.

        A table without any column that only the list with readings contains is a plan. Where the
        two lists are equal, the positions are the readings, and every table is data. Further
        numeric columns (``t_s``, ``T_x_degC``, ``dir_x``) are read anyway.
        """

    @classmethod
    @abc.abstractmethod
    def build(
        cls, settings: Any, chain: Chain, table: Mapping[str, np.ndarray], load: Loader
    ) -> Self:
        """From validated settings and data; `load` reads a further table beside the study file.

        `table` has its columns in the units of the file, `chain` the axes, their travel and
        `tool_offset` (m). Raises `StudyError` where the data and the further tables are
        inconsistent: `RowError` for a row, `KeyedError` for a key; neither needs the file name.
        """

    @abc.abstractmethod
    def plan(self, chain: Chain, table: Mapping[str, np.ndarray]) -> Plan:
        """The plan: axis positions, with every covariate that can be derived. For linear axes,
        `linear_plan` builds it; its argument `groups` names index columns of this instrument only.
        The axes are those of the chain, in their order.
        """

    @abc.abstractmethod
    def measured(self, table: Mapping[str, np.ndarray]) -> np.ndarray:
        """Readings (n, m) in SI from the columns of the table; zeros for an implicit instrument."""

    @abc.abstractmethod
    def to_table(self, plan: Plan, readings: np.ndarray) -> dict[str, np.ndarray]:
        """The inverse of `plan` and `measured`: columns in file units, one cell per row. Columns
        that it omits are copied from the table of the plan.
        """

    def summarised(self, plan: Plan, readings: np.ndarray) -> "Summary[Self] | None":
        """Means in place of the samples of a long recording; None, the default: all rows are used.

        It is called with the plan and the readings of the whole table, after both were checked.
        """
        del plan, readings
        return None

    def dimensions(self, plan: Plan) -> np.ndarray:
        return np.full(plan.rows, self.dimension)


class Summary(NamedTuple, Generic[Of]):
    """Rows that are means of several samples."""

    instrument: Of
    """The instrument, which says what was averaged (`Instrument.averaged`)."""
    plan: Plan
    readings: np.ndarray
    rows: np.ndarray
    """First sample of every row."""


INSTRUMENTS: Catalogue[type[TableInstrument]] = Catalogue("instrument", "kind")
"""Every instrument that a study file may name, by kind."""

register = INSTRUMENTS.register
