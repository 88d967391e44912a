"""The base class of all effects, and what effects may know when they are placed.

An effect is anything that makes reality differ from nominal. It defines which ports it disturbs
(`vcal.machine.ports`) and by how much per unit of each of its parameters; prediction, derivatives,
screening, evidence and reports follow from that.
"""

import abc
import dataclasses
import functools
import math
import re
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

_TEMPERATURE = re.compile(r"T_(?!\w*_K(_|$))\w+")
"""Covariates in degC; not gradients, such as ``"T_gradient_z_K_per_m"``."""


@dataclass(frozen=True)
class Artefact:
    """Properties of a measured artefact that effects may use."""

    supports: tuple[float, float]
    """Positions of its supports as shares of its length."""
    beam: tuple[float, float, float]
    """Direction of its long axis, in its own frame."""


@dataclass(frozen=True)
class Reference:
    """The value of a covariate at which an effect is zero, where it is not exactly known.

    An effect in proportion to T - T0 is k (T - 20 degC) + c with c = k (20 degC - T0): its response
    to the covariate, and a constant part of the same form. The machine may be compensated at
    another temperature than 20 degC, and the sensor may be biased.
    """

    covariate: str
    unit: str
    """Unit of the covariate, as in the unit of the amplitude: ``"K"`` of ``"um/K"``."""
    sigma: float
    """Standard uncertainty of the reference value, in `unit`."""


TEMPERATURE_SIGMA_K = 10.0
"""Standard uncertainty of the temperature at which an effect of temperature is zero: machines are
compensated at the temperature of their shop, and a sensor measures where it is mounted."""


@dataclass(frozen=True)
class Fitted:
    """An effect of the model with its estimated values."""

    effect: "Effect"
    shape: Mapping[str, float]
    """Values of its shape parameters, SI."""
    sizes: Mapping[str, float]
    """Values of its amplitudes, SI."""


@dataclass(frozen=True)
class Setup:
    """Everything from which a class of effects derives its candidates."""

    chain: Chain
    layout: PortLayout
    plan: Plan
    declared: tuple["Effect", ...] = ()
    artefact: Artefact | None = None
    derived: tuple[str, ...] = ()
    """Covariates that the instrument derives from positions and readings."""
    used: frozenset[str] = frozenset()
    """Covariates, groups and axes that the other candidates need."""
    fitted: tuple[Fitted, ...] = ()
    """Systematic effects of the model with their estimates, for descriptions of their changes."""
    stations: tuple[str, ...] = ()
    """Names of the stations of the instrument, where one table has several."""
    data_set: str = ""
    """Name of the data set, where this is one of `parts`."""
    parts: tuple["Setup", ...] = ()
    """The setups of the data sets, each with its own instrument, where there are several."""


class Effect(Record):
    """Base class of all effects; subclasses are final.

    Class attributes: `name` (the identifier used in files and reports), `summary` (one line), and
    `kind`: *systematic* (a parameter with a prior), *nuisance* (not of interest in itself: a
    station, the pose of an artefact) or *random* (an independent draw per row with the parameters'
    sigma, which enters the covariance of the readings).
    """

    name: ClassVar[str]
    summary: ClassVar[str] = ""
    remedy: ClassVar[str] = ""
    """What to check and what to do about it, for the page of a report."""
    kind: ClassVar[Kind] = "systematic"
    where: ClassVar[Literal["machine", "instrument"]] = "machine"
    """Whether it displaces the tool point, or only changes what the instrument reads."""

    @property
    def on_instrument(self) -> bool:
        """Whether this instance belongs to an instrument; a class may have instances of both."""
        return self.where == "instrument"

    odds: ClassVar[float] = 1.0
    """Prior odds of this effect against the others."""

    uses: ClassVar[tuple[str, ...]] = ()
    """Names that it `needs`; ``{axis}`` stands for the placement: ``("T_{axis}",)``."""

    shown_by: ClassVar[tuple[str, ...]] = ()
    """Its `indicators` in the same form, where they differ from `uses`."""

    placement: str = eqx.field(static=True, default="", kw_only=True)
    """The axis or joint it acts on, such as ``"Y"`` or ``"J2"``; empty where there is none."""

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

        It must be elementwise over the rows: `shape` values may have a leading axis, (g, 1) against
        rows (n,), when a whole grid is evaluated at once. JAX also traces them to take the
        derivative with respect to them: compute with `jax.numpy`, or with
        `vcal.numerics.arrays.namespace` of the values, which is faster where they are plain
        numbers.
        """

    @property
    def needs(self) -> tuple[str, ...]:
        """Covariates, groups or axes of the plan without which it cannot be evaluated."""
        return tuple(name.format(axis=self.placement) for name in self.uses)

    def needs_at(self, shape: Mapping[str, float]) -> tuple[str, ...]:
        """What it needs at given shape values: more than `needs` where they select a covariate."""
        del shape
        return self.needs

    @property
    def indicators(self) -> tuple[str, ...]:
        """Covariates on which its residual depends, the clearest first (for pictures)."""
        return tuple(name.format(axis=self.placement) for name in self.shown_by) or self.needs

    @property
    def reference(self) -> Reference | None:
        """The covariate whose reference value is uncertain; None where there is none.

        By default it is the first temperature (``"T_X"``, degC) that the effect `needs`. An effect
        whose reference is exactly known returns None.
        """
        temperatures = (name for name in self.needs if _TEMPERATURE.fullmatch(name))
        name = next(temperatures, None)
        return None if name is None else Reference(name, "K", TEMPERATURE_SIGMA_K)

    def constant_part(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        """Change of the response per unit (SI) of the covariate of `reference`: the form of the
        deviation that another reference value adds.

        It is a difference quotient, exact for a response that is linear in the covariate.
        """
        assert self.reference is not None
        name = self.reference.covariate
        moved = {**plan.covariates, name: plan.covariate(name) + 1.0}
        further = self.response(dataclasses.replace(plan, covariates=moved), shape)
        return {key: further[key] - value for key, value in self.response(plan, shape).items()}

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        """The rows that it can disturb."""
        return np.ones(plan.rows, bool)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        """Grid of each shape parameter (SI), dense enough that no peak of the fit is missed."""
        del plan
        return {}

    def edges(self, plan: Plan) -> Mapping[str, np.ndarray]:
        """Values of shape parameters without a derivative (SI, ascending) at which the response of
        some row changes: between two neighbours it is constant. Empty where the scan contains all
        possible values.
        """
        del plan
        return {}

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        """Prior density of the estimated values (SI) of its parameters, averaged over their
        uncertainty, relative to that which the fit assumes: uniform for shapes, and normal for
        amplitudes; one unless some values are known to be more probable than others.
        """
        del plan, values, uncertainties
        return 1.0

    def decided_by(self, plan: Plan) -> tuple[np.ndarray, ...]:
        """Columns (n,) that decide the response: rows in which all of them are equal have the same
        response at every step of the scan. The screening of a large plan then evaluates and sums
        such rows together. Empty where that is not known.
        """
        del plan
        return ()

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
                f"effect {self.key!r}: found declared values and priors for "
                f"{', '.join((*given, *priors))}, expected each at most once, from "
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
        """Linear combinations of the amplitudes that do not depend on the plan: name, unit, and the
        coefficient of every amplitude, by its name, in their units.
        """
        return ()

    def tilts(self, plan: Plan) -> Mapping[str, Float[Array, "n 3"]]:
        """Rotation (n, 3) of the body that carries an arm or a slide, in the frame of the bed, per
        unit of each amplitude; empty unless the effect tilts such a body. Recorded accelerometers
        and inclinometers are compared with it.
        """
        del plan
        return {}

    def alike(self, other: "Effect") -> bool:
        """Whether another is the same effect at the same placement, whatever its declared values.

        Effects of one key may differ in direction or order; then their parameters' names differ.
        """
        names, others = ([p.name for p in one.parameters] for one in (self, other))
        return self.key == other.key and names == others


def along(chain: Chain, axis: str) -> tuple[str, str]:
    """Port of the joint's own motion, and its unit: ``("EYY", "um")``, ``("ECJ2", "urad")``.

    Axes of machine tools move along or about their own letter, joints of arms along or about their
    z: ``"ECC"``, ``"EAA"``.
    """
    joint = chain.joint(axis)
    letters, unit = ("ABC", "urad") if joint.turns else ("XYZ", "um")
    return f"E{letters[int(np.argmax(np.abs(joint.direction)))]}{axis}", unit


def unit_of(port: str) -> str:
    """Unit of a port: ``"um"`` of a translation, ``"urad"`` of a rotation."""
    component = port.partition(".")[2] or port[1]
    return "um" if component in "XYZ" else "urad"


def across(chain: Chain, axis: str) -> tuple[str, ...]:
    """Ports of the error translations of a joint except its own motion."""
    own, _ = along(chain, axis)
    return tuple(f"E{c}{axis}" for c in "XYZ" if f"E{c}{axis}" != own)


def harmonic_summary(sine: float, cosine: float) -> tuple[float, float]:
    """Amplitude and phase (rad) of ``sine*sin(u) + cosine*cos(u) = A sin(u + phase)``."""
    return math.hypot(sine, cosine), math.atan2(cosine, sine)
