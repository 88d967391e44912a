"""What an effect is.

An effect is anything that makes reality differ from nominal. It says which ports it disturbs
(`vcal.ports`) and by how much per unit of each of its parameters; everything else - prediction,
derivatives, screening, evidence, reporting - is the engine's work.
"""

import abc
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..machine.chain import Chain
from ..machine.parameters import Parameter, Prior
from ..machine.plan import Plan
from ..machine.ports import PortLayout
from ..numerics.arrays import Array
from ..numerics.record import Record

Response = Mapping[tuple[str, str], Float[Array, "..."]]
"""(port, amplitude) -> deviation of that port per SI unit of that amplitude, one value per row."""

Kind = Literal["systematic", "nuisance", "random"]


@dataclass(frozen=True)
class Artefact:
    """What effects may know of a measured artefact."""

    supports: tuple[float, float]
    """Places of its supports as shares of its length."""
    beam: tuple[float, float, float]
    """Direction of its long axis, in its own frame."""


@dataclass(frozen=True)
class Fitted:
    """An effect of the model, and what was found of it."""

    effect: "Effect"
    shape: Mapping[str, float]
    """Values of its shape parameters, SI."""
    sizes: Mapping[str, float]
    """Values of its amplitudes, SI."""


@dataclass(frozen=True)
class Setup:
    """What a class of effects may look at to say where it could be placed."""

    chain: Chain
    layout: PortLayout
    plan: Plan
    declared: tuple["Effect", ...] = ()
    artefact: Artefact | None = None
    derived: tuple[str, ...] = ()
    """Covariates that the instrument derives from positions and readings."""
    used: frozenset[str] = frozenset()
    """What other effects that are tried look at: covariates, groups and axes."""
    fitted: tuple[Fitted, ...] = ()
    """Systematic effects of the model as they were found, for descriptions of what changes."""
    data_set: str = ""
    """Name of the data set, where this is one of `parts`."""
    parts: tuple["Setup", ...] = ()
    """The same for every data set with its own instrument, where there are several."""


class Effect(Record):
    """Base class of all effects; subclasses are final.

    Class attributes: `name` (the identifier used in files and reports), `summary` (one line), and
    `kind`: *systematic* (a parameter with a prior), *nuisance* (no interest in itself: a station,
    the pose of an artefact) or *random* (a fresh draw per row with the parameters' sigma, which
    enters the covariance of the readings).
    """

    name: ClassVar[str]
    summary: ClassVar[str] = ""
    kind: ClassVar[Kind] = "systematic"
    where: ClassVar[Literal["machine", "instrument"]] = "machine"
    """Whether it moves the tool point, or only what the instrument sees."""

    @property
    def on_instrument(self) -> bool:
        """Whether this one belongs to an instrument; a class may have some that do not."""
        return self.where == "instrument"

    odds: ClassVar[float] = 1.0
    """Prior odds of this kind of effect against the others, where data cannot decide."""

    placement: str = eqx.field(static=True, default="", kw_only=True)
    """Where it sits: an axis or joint such as ``"Y"`` or ``"J2"``; empty where it has no place."""

    given: tuple[tuple[str, float, float], ...] = eqx.field(static=True, default=(), kw_only=True)
    """Declared values: (parameter, mean, sigma) in the parameter's unit; sigma 0 means known."""

    priors: tuple[Prior, ...] = eqx.field(default=(), kw_only=True)
    """Declared distributions of parameters that are not in `given`."""

    @property
    @abc.abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Amplitudes (they enter linearly) and shape parameters, with units and priors."""

    @abc.abstractmethod
    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        """Deviation per unit of each amplitude at given shape values (SI).

        Must be elementwise over the rows: `shape` values may arrive with a leading axis, (g, 1)
        against rows (n,), when a whole grid is evaluated at once. They are also traced by JAX,
        which takes the derivative by them: what is made of them is made by `jax.numpy`, or by
        `vcal.numerics.arrays.namespace` of them, which is faster where they are plain numbers.
        """

    @property
    def needs(self) -> tuple[str, ...]:
        """Covariates, groups or axes of the plan without which it cannot be evaluated."""
        return ()

    def needs_at(self, shape: Mapping[str, float]) -> tuple[str, ...]:
        """What it needs at given shape values: more than `needs` where these select a covariate."""
        del shape
        return self.needs

    @property
    def betrayed_by(self) -> tuple[str, ...]:
        """Covariates against which its residual shows, most telling first (for pictures)."""
        return self.needs

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        """The rows that it can disturb."""
        return np.ones(plan.rows, bool)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        """Grid of each shape parameter (SI), dense enough that no peak is missed."""
        del plan
        return {}

    def edges(self, plan: Plan) -> Mapping[str, np.ndarray]:
        """Values of shape parameters without a derivative (SI, in order) at which the response in
        some row changes: between two of them all say the same. None where the scan has all there
        are.
        """
        del plan
        return {}

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        """Prior density of estimated shape values over the uniform one, averaged over their
        uncertainty; one unless some values are known to be likelier than others.
        """
        del plan, values, uncertainties
        return 1.0

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable["Effect"]:
        """The instances the loop may try on this machine and plan; none by default."""
        del setup
        return ()

    @functools.cached_property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """The parameters that enter linearly, with the declared values in place."""
        return tuple(p for p in self._declared if not p.shape)

    @functools.cached_property
    def shapes(self) -> tuple[Parameter, ...]:
        """The parameters that enter non-linearly, with the declared values in place."""
        return tuple(p for p in self._declared if p.shape)

    @functools.cached_property
    def _declared(self) -> tuple[Parameter, ...]:
        known = self.parameters
        given = {name: (mean, sigma) for name, mean, sigma in self.given}
        priors = {name: prior for prior in self.priors for name in prior.names}
        if not given and not priors:
            return known
        unknown = {*given, *priors} - {p.name for p in known}
        if unknown or set(given) & set(priors):
            raise ValueError(
                f"effect {self.key!r}: found declared values and priors of "
                f"{', '.join((*given, *priors))}, expected each at most once, out of "
                f"{', '.join(p.name for p in known)}"
            )
        return tuple(
            p.with_prior(*given[p.name])
            if p.name in given
            else priors[p.name].of(p)
            if p.name in priors
            else p
            for p in known
        )

    @property
    def key(self) -> str:
        """Identifier with placement, such as ``"backlash Y"``."""
        return f"{self.name} {self.placement}".strip()

    @property
    def amounts_to(self) -> Sequence[tuple[str, str, Mapping[str, float]]]:
        """What the amplitudes amount to apart from the plan on which they are what they are: name,
        unit, and how much of every amplitude, by its name, in their units.
        """
        return ()

    def alike(self, other: "Effect") -> bool:
        """Whether another is the same effect at the same place, whatever is known of its values:
        effects of one key may differ in their direction or order, which their parameters name.
        """
        names, others = ([p.name for p in one.parameters] for one in (self, other))
        return self.key == other.key and names == others


def along(chain: Chain, axis: str) -> tuple[str, str]:
    """Port of the motion of a joint itself and its unit: ``("EYY", "um")``, ``("ECJ2", "urad")``.

    Axes of machine tools move along or about their own letter, joints of arms along or about their
    z: ``"ECC"``, ``"EAA"``.
    """
    joint = chain.joint(axis)
    letters, unit = ("ABC", "urad") if joint.turns else ("XYZ", "um")
    return f"E{letters[int(np.argmax(np.abs(joint.direction)))]}{axis}", unit


def across(chain: Chain, axis: str) -> tuple[str, ...]:
    """The error translations of a joint other than its own motion."""
    own, _ = along(chain, axis)
    return tuple(f"E{c}{axis}" for c in "XYZ" if f"E{c}{axis}" != own)


def harmonic_summary(sine: float, cosine: float) -> tuple[float, float]:
    """Amplitude and phase (rad) of ``sine*sin(u) + cosine*cos(u) = A sin(u + phase)``."""
    return math.hypot(sine, cosine), math.atan2(cosine, sine)
