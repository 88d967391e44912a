"""What may be chosen about a measurement with one kind of instrument, as numbers within bounds."""

import abc
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field

from ..errors import StudyError
from ..instruments.base import TableInstrument
from ..machine.chain import Chain
from ..machine.plan import Plan
from ..model.forward import Model
from ..numerics.arrays import Array
from ..numerics.compiled import jit_outermost
from ..registry import Catalogue

Goal = Literal["volume", "largest", "determinant"]

_Count = Annotated[int, Field(ge=2, le=200)]


class DesignSettings(BaseModel):
    """What every ``[design]`` table holds; each kind of instrument adds its own keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    goal: Goal = "volume"
    """What is made small: the expected rms volumetric error, the largest uncertainty of some
    errors, or the determinant of their covariance.
    """
    errors: tuple[str, ...] | None = None
    """Error motions and squarenesses that count for ``largest`` and ``determinant``; all of those
    that are declared by default.
    """
    grid: tuple[_Count, _Count, _Count] = (12, 8, 8)
    """Points along X, Y and Z at which the volumetric error is judged; machines with other axes are
    judged at random positions.
    """
    starts: int = Field(default=8, ge=1, le=10_000)
    """Starts of the search: the plan as it is, and others scattered around it."""
    steps: int = Field(default=200, ge=1, le=1_000_000)
    """Steps after which the search from one start ends in any case."""
    families: tuple[str, ...] = ()
    """Study files whose ``[model.geometric]`` counts as well: what is made small is an average."""
    must_see: dict[str, int] = {}
    """What the designed plan has to tell apart without a prior, as in ``[data]``."""
    more: int | None = Field(default=None, ge=1, le=10_000)
    """Poses, or points, of the next measurement (``--next``)."""
    seconds_per_metre: float = Field(default=0.0, ge=0)
    """Time of travel between successive points."""


class Subject(NamedTuple):
    """A measurement as it stands: where a space begins."""

    chain: Chain
    instrument: TableInstrument
    plan: Plan
    file: str
    """What messages call the study file."""

    def refusal(self, key: str, found: str, expected: str, do: str) -> StudyError:
        """The error to raise for a key of ``[design]``."""
        return StudyError(
            f"{self.file}, key design.{key}: found {found}, expected {expected}; {do}"
        )


class Varied(NamedTuple):
    """A condition that a further measurement may choose, within what the data have seen."""

    name: str
    low: float
    high: float
    step: bool = False
    """Whether only the two ends exist, as of a direction of travel."""


class PlanSpace(abc.ABC):
    """Base class of all spaces; subclasses are final and frozen.

    A point z of a space stands for a measurement that is *placed*: positions, conditions, and what
    of the instrument may vary, a pytree that only the space itself looks into. Its rows come in
    *groups* that are measured together or not at all.
    """

    kind: ClassVar[str]
    """Kind of the instrument in study files."""
    Settings: ClassVar[type[DesignSettings]]
    """Keys of the ``[design]`` table, validated."""
    group: ClassVar[str]
    """What one group is called: ``"pose"``, ``"point"``."""
    rotary: ClassVar[bool] = False
    """Whether it places the axes A, B and C of a machine tool too."""
    lacking: ClassVar[str] = "room for all of them; start from a plan that lies further inside"
    """What was expected, and what to do, where nothing fits the travel."""

    # --- where it begins ------------------------------------------------------------------------
    @classmethod
    @abc.abstractmethod
    def of(cls, subject: Subject, model: Model, settings: Any) -> Self:
        """The space around a study's plan; `model` holds the effects that are judged.

        Raises `StudyError` for bounds that nothing satisfies.
        """

    @abc.abstractmethod
    def following(self, count: int, varied: Sequence[Varied]) -> Self:
        """The space of `count` further groups with the instrument as it is; conditions that are
        not `varied` are those of the last row.
        """

    @property
    @abc.abstractmethod
    def taken(self) -> bool:
        """Whether the plan shows that it was measured, where readings do not tell."""

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
    @abc.abstractmethod
    def start(self) -> Float[np.ndarray, " d"]:
        """The plan as it is, moved to where the bounds allow it."""

    @abc.abstractmethod
    def scattered(self, key: Array) -> Float[np.ndarray, " d"]:
        """A start near the plan as it is; anywhere for a space of further groups."""

    # --- what a point stands for ----------------------------------------------------------------
    @property
    @abc.abstractmethod
    def nominal(self) -> Any:
        """The plan as it is, placed."""

    @abc.abstractmethod
    def placed(self, z: Float[Array, " d"]) -> Any:
        """What some numbers stand for; may be traced."""

    @abc.abstractmethod
    def excess(self, placed: Any) -> Float[Array, ""]:
        """By how much it stands out of the travel, m; zero where it fits by construction."""

    def penalty(self, placed: Any) -> Float[Array, ""] | float:
        """By which factor a search counts a plan that leaves little room; smooth, at least one."""
        del placed
        return 1.0

    @abc.abstractmethod
    def settled(self, placed: Any) -> Any:
        """The same with conditions that have only two values at one of them."""

    # --- what it tells --------------------------------------------------------------------------
    @property
    @abc.abstractmethod
    def groups(self) -> tuple[int, ...]:
        """Number of every group."""

    @abc.abstractmethod
    def information(
        self, placed: Any, model: Model, weights: Float[Array, " g"]
    ) -> Float[Array, "k+s k+s"]:
        """J' C^-1 J by the amplitudes of `model` in solver units and then by what the groups share
        (a station, the errors of balls); what only one group has is left over. Every group counts
        as often as its weight says. Adds up over measurements of one instrument.
        """

    @property
    @abc.abstractmethod
    def shared(self) -> Float[np.ndarray, "s s"]:
        """Precision of what the groups share, before any measurement."""

    # --- edges ----------------------------------------------------------------------------------
    @abc.abstractmethod
    def instrument(self, placed: Any) -> TableInstrument:
        """The instrument that measures it."""

    @abc.abstractmethod
    def plan(self, placed: Any) -> Plan:
        """The plan to be written, with every covariate."""

    @abc.abstractmethod
    def seconds(self, placed: Any) -> float:
        """How long it takes to measure."""

    def artefact(self, placed: Any) -> Mapping[str, np.ndarray] | None:
        """Table of the artefact in file units, where there is one."""
        del placed
        return None

    def station(self, placed: Any) -> Float[np.ndarray, "3"] | None:
        """Where the instrument stands, m, where it stands somewhere."""
        del placed
        return None

    def changed(self, placed: Any) -> Mapping[str, Any]:
        """Keys of ``[instrument]`` that have other values now."""
        del placed
        return {}


SPACES: Catalogue[type[PlanSpace]] = Catalogue("space of plans", "kind")
"""Every space, by kind of instrument."""

register = SPACES.register


def starts_of(space: PlanSpace, seed: int, count: int) -> list[np.ndarray]:
    """The plan as it is and `count` - 1 starts scattered around it."""
    keys = jax.random.split(jax.random.key(seed), max(count - 1, 1))
    return [space.start, *(space.scattered(k) for k in keys[: count - 1])]


NOT_TRACED = (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError)
"""What is raised where the response of an effect leaves JAX."""


def joint_information(space: PlanSpace, placed: Any, model: Model) -> Float[np.ndarray, "n n"]:
    """What a plan tells, all groups counting once; slower for effects that leave JAX."""

    def told(placed: Any) -> Float[Array, "n n"]:
        return space.information(placed, model, jax.numpy.ones(len(space.groups)))

    try:
        jax.eval_shape(told, placed)
    except NOT_TRACED:
        return np.asarray(told(placed))
    return np.asarray(jit_outermost(told)(placed))


def path_m(position: Float[np.ndarray, "n axes"]) -> float:
    """Length of the way through successive positions, m."""
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
