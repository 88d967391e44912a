"""Spaces of plans: the choices of a measurement with one instrument, as numbers within bounds."""

import abc
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Float, Int
from pydantic import BaseModel, ConfigDict

from ..bounds import Seconds, Within
from ..errors import StudyError
from ..instruments.base import TableInstrument
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..model.forward import Model
from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost
from ..registry import Catalogue

Goal = Literal["volume", "largest", "determinant"]

_Count = Annotated[
    int, Within(2, 200, "a line has two ends, and more points do not change an average")
]
_Degree = Annotated[int, Within(0, 50, "no plan has the points for a higher degree")]


class DesignSettings(BaseModel):
    """``[design]``: the common keys; each kind of instrument adds its own."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    goal: Goal = "volume"
    """Criterion to minimise: the expected rms volumetric error (``volume``), the largest
    uncertainty of some errors (``largest``), or the determinant of the covariance of their
    amplitudes (``determinant``).
    """
    errors: tuple[str, ...] | None = None
    """Error motions and squareness errors that count for ``largest`` and ``determinant``; all
    declared ones by default.
    """
    grid: tuple[_Count, _Count, _Count] = (12, 8, 8)
    """Points along X, Y and Z for the volumetric error; machines with other axes use random
    positions.
    """
    starts: Annotated[int, Within(1, 10_000, "no search gains by more starts")] = 8
    """Starts of the search: the present plan, and random plans around it."""
    steps: Annotated[int, Within(1, 1_000_000, "no search takes as many steps")] = 200
    """Largest number of steps of the search from one start."""
    families: tuple[str, ...] = ()
    """Study files whose ``[model.geometric]`` counts as well; the criterion is then an average."""
    must_see: dict[str, _Degree] = {}
    """Errors that the designed plan has to identify without a prior, as in ``[data]``."""
    more: Annotated[int, Within(1, 10_000, "nobody measures as many more")] | None = None
    """Number of poses or points of the next measurement (``--next``)."""
    seconds_per_metre: Seconds = 0.0
    """Time of travel between successive points."""


class Subject(NamedTuple):
    """A present measurement, around which a space is built."""

    chain: Chain
    instrument: TableInstrument
    plan: Plan
    file: str
    """Name of the study file in messages."""

    def refusal(self, key: str, found: str, expected: str, do: str) -> StudyError:
        """The error to raise for a key of ``[design]``."""
        return StudyError(
            f"{self.file}, key design.{key}: found {found}, expected {expected}; {do}"
        )


class Varied(NamedTuple):
    """A condition that a further measurement may choose, within the range of the data."""

    name: str
    low: float
    high: float
    step: bool = False
    """Whether only the two ends are possible, as for a direction of travel."""


class PlanSpace(abc.ABC):
    """Base class of all spaces; subclasses are final and frozen.

    A vector z of a space represents a *placed* measurement: positions, conditions and the variable
    part of the instrument, as a pytree that only the space itself interprets. The rows come in
    *groups* that are measured together or not at all.
    """

    kind: ClassVar[str]
    """Kind of the instrument in study files."""
    Settings: ClassVar[type[DesignSettings]]
    """Keys of the ``[design]`` table, validated."""
    group: ClassVar[str]
    """Name of one group: ``"pose"``, ``"point"``, ``"setup"``."""
    rotary: ClassVar[bool] = False
    """Whether it also places the axes A, B and C of a machine tool."""
    lacking: ClassVar[str] = "room for all of them; start from a plan that lies further inside"
    """The expectation and the remedy of the message where no plan fits the travel."""
    planned: ClassVar[tuple[str, ...]] = ()
    """Columns of its tables, besides positions and those that every table needs, that it sets."""

    # --- construction ---------------------------------------------------------------------------
    @classmethod
    @abc.abstractmethod
    def of(cls, subject: Subject, model: Model, settings: Any) -> Self:
        """The space around the plan of a study; `model` holds the judged effects.

        Raises `StudyError` for bounds that no plan satisfies.
        """

    @abc.abstractmethod
    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        """The space of `count` further groups with the present instrument.

        Conditions that are not `varied` have the values of the last row.
        """

    @property
    @abc.abstractmethod
    def taken(self) -> bool:
        """Whether the plan was measured, for instruments whose tables always hold readings."""

    # --- numbers within bounds ------------------------------------------------------------------
    @property
    @abc.abstractmethod
    def low(self) -> Float[np.ndarray, " d"]:
        """Lower bounds."""

    @property
    @abc.abstractmethod
    def high(self) -> Float[np.ndarray, " d"]:
        """Upper bounds."""

    @property
    def levels(self) -> Int[np.ndarray, " d"]:
        """Number of the choices 0, 1, ... of which a number of a vector is one; 0, the default, for
        a continuous number.
        """
        return np.zeros(len(self.low), int)

    @property
    @abc.abstractmethod
    def start(self) -> Float[np.ndarray, " d"]:
        """The present plan, moved within the bounds."""

    @abc.abstractmethod
    def scattered(self, key: Array) -> Float[np.ndarray, " d"]:
        """A random start near the present plan; anywhere for a space of further groups."""

    # --- the placed measurement -----------------------------------------------------------------
    @property
    @abc.abstractmethod
    def nominal(self) -> Any:
        """The present plan as a placed measurement."""

    @abc.abstractmethod
    def placed(self, z: Float[Array, " d"]) -> Any:
        """The placed measurement of a vector z; may be traced."""

    @abc.abstractmethod
    def excess(self, placed: Any) -> Float[Array, ""]:
        """Distance by which it exceeds the travel, m; zero where it fits by construction."""

    def penalty(self, placed: Any) -> Float[Array, ""] | float:
        """Factor on the criterion of a plan that is close to the limits; smooth, at least one."""
        del placed
        return 1.0

    @abc.abstractmethod
    def settled(self, placed: Any) -> Any:
        """The same measurement, with every two-valued condition at one of its values."""

    # --- information ----------------------------------------------------------------------------
    @property
    @abc.abstractmethod
    def groups(self) -> tuple[int, ...]:
        """Numbers of the groups."""

    @abc.abstractmethod
    def information(
        self, placed: Any, model: Model, weights: Float[Array, " g"]
    ) -> Float[Array, "k+s k+s"]:
        """J' C^-1 J by the amplitudes of `model` in solver units, then by the unknowns that the
        groups share (a station, the errors of balls).

        Unknowns of a single group are eliminated. Every group counts as often as its weight.
        Information is additive over measurements with one instrument.
        """

    @property
    @abc.abstractmethod
    def shared(self) -> Float[np.ndarray, "s s"]:
        """Prior precision of the unknowns that the groups share."""

    # --- output ---------------------------------------------------------------------------------
    @abc.abstractmethod
    def instrument(self, placed: Any) -> TableInstrument:
        """The instrument of the placed measurement."""

    @abc.abstractmethod
    def plan(self, placed: Any) -> Plan:
        """The plan to write, with every covariate."""

    @abc.abstractmethod
    def seconds(self, placed: Any) -> float:
        """Duration of the measurement, s."""

    def artefact(self, placed: Any) -> Mapping[str, np.ndarray] | None:
        """Table of the artefact in file units; None without an artefact."""
        del placed
        return None

    def station(self, placed: Any) -> Float[np.ndarray, "3"] | None:
        """Position of the instrument, m; None where it has none."""
        del placed
        return None

    def changed(self, placed: Any) -> Mapping[str, Any]:
        """Keys of ``[instrument]`` with changed values."""
        del placed
        return {}


SPACES: Catalogue[type[PlanSpace]] = Catalogue("space of plans", "kind")
"""Every space, by kind of instrument."""

register = SPACES.register


def starts_of(space: PlanSpace, seed: int, count: int) -> list[np.ndarray]:
    """The present plan and `count` - 1 random starts around it."""
    keys = jax.random.split(jax.random.key(seed), max(count - 1, 1))
    return [space.start, *(space.scattered(k) for k in keys[: count - 1])]


NOT_TRACED = (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError)
"""Exceptions raised where the response of an effect leaves JAX."""


def joint_information(space: PlanSpace, placed: Any, model: Model) -> Float[np.ndarray, "n n"]:
    """The information of a plan with every group once; slower for effects that leave JAX."""

    def information(placed: Any) -> Float[Array, "n n"]:
        return space.information(placed, model, jax.numpy.ones(len(space.groups)))

    try:
        jax.eval_shape(information, placed)
    except NOT_TRACED:
        return np.asarray(information(placed))
    return np.asarray(jit_outermost(information)(placed))


def beyond_m(
    travel: Float[np.ndarray, "axes 2"], position: Float[Array, "n axes"], clear: Any = 0.0
) -> Float[Array, "n axes"]:
    """Distance by which positions exceed the travel minus a clearance (axes,), m; may be traced."""
    low, high = np.asarray(travel).T
    x = jax.numpy.asarray(position)
    return jax.numpy.maximum(jax.numpy.maximum(low + clear - x, x - high + clear), 0.0)


def path_m(position: Float[np.ndarray, "n axes"]) -> float:
    """Length of the path through successive positions, m."""
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
