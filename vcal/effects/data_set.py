"""Effects of the instrument of one data set, in a study with several data sets."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Bool

from ..machine.parameters import Parameter
from ..machine.plan import Plan, of_set
from ..machine.ports import PortLayout
from ..numerics.arrays import Array, namespace
from .base import Effect, Response, Setup
from .wrapper import Wrapper


class OfDataSet(Wrapper):
    """An effect of an instrument that disturbs the readings of its own data set only.

    Its covariates are those of `effect` with the name of the data set in front, and so are its
    ports, except those of the joints and the tool, which are common to all data sets; in all other
    rows its response is zero. It has the name of `effect`; the data set comes first in its
    placement: ``"station tracker"``, ``"encoder_eccentricity tracker azimuth"``. It is not in the
    catalogue: `in_setup` wraps every effect whose `where` is the instrument.
    """

    data_set: str = eqx.field(static=True)

    @classmethod
    def of(cls, effect: Effect, data_set: str) -> "OfDataSet":
        """An effect, with its declared values, in one data set."""
        place = f"{data_set} {effect.placement}".strip()
        return cls(effect, data_set, placement=place, given=effect.given, priors=effect.priors)

    @property
    def summary(self) -> str:  # type: ignore[override]
        """Summary of the effect, with the data set."""
        return f"{self.effect.summary}, in the data set {self.data_set}"

    @property
    def where(self):  # type: ignore[override]
        """The instrument."""
        return "instrument"

    @property
    def on_instrument(self) -> bool:
        return True

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(of_set(self.data_set, name) for name in self.effect.needs)

    @property
    def indicators(self) -> tuple[str, ...]:
        return tuple(of_set(self.data_set, name) for name in self.effect.indicators)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        here, shared = self.rows(plan), PortLayout.of(plan.axes, ())
        found = {}
        for (port, amplitude), column in self.effect.response(
            plan.of(self.data_set), shape
        ).items():
            name = port if port in shared else of_set(self.data_set, port)
            found[name, amplitude] = namespace(column).where(here, column, 0.0)
        return found

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return plan.in_set(self.data_set)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        # On the rows of the data set: the scan spans the range of a covariate there.
        return self.effect.scan(plan.part(self.data_set))

    def edges(self, plan: Plan) -> Mapping[str, np.ndarray]:
        return self.effect.edges(plan.part(self.data_set))

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        return self.effect.shape_odds(plan.part(self.data_set), values, uncertainties)


class SharedByDataSets(Effect):
    """An effect of the instruments of several data sets with one set of parameters, such as the
    places of the reflectors on a tool that all of them measured.

    It has the name of the effect, and its placement is the name of what is shared. Raises
    `ValueError` where the parameters differ.
    """

    effects: tuple[OfDataSet, ...]

    @classmethod
    def of(cls, effects: Mapping[str, Effect], what: str) -> "SharedByDataSets":
        """From the effects of the data sets by their names, with the same declared values."""
        made = tuple(OfDataSet.of(effect, name) for name, effect in effects.items())
        first, *others = effects.values()
        for other in others:
            if other.parameters != first.parameters or other.given != first.given:
                raise ValueError(
                    f"{what}: found effects with different parameters, expected the same ones in "
                    f"the data sets {', '.join(effects)}"
                )
        return cls(made, placement=what, given=first.given, priors=first.priors)

    @property
    def name(self) -> str:  # type: ignore[override]
        """Identifier of the effect."""
        return self.effects[0].name

    @property
    def summary(self) -> str:  # type: ignore[override]
        """Summary of the effect, with what is shared."""
        return f"{self.effects[0].effect.summary}, {self.placement}"

    @property
    def kind(self):  # type: ignore[override]
        """Kind of the effect."""
        return self.effects[0].kind

    @property
    def where(self):  # type: ignore[override]
        """The instrument."""
        return "instrument"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.effects[0].parameters

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(name for effect in self.effects for name in effect.needs)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        found: dict[tuple[str, str], Array] = {}
        for effect in self.effects:
            found |= effect.response(plan, shape)
        return found

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return np.any([effect.rows(plan) for effect in self.effects], axis=0)


def in_setup(kind: type[Effect], setup: Setup) -> list[Effect]:
    """The candidates of a class of effects in a setup: those of the machine once, those of an
    instrument once for every data set.
    """
    if not setup.parts:
        return list(kind.candidates(setup))
    shared: list[Effect] = [e for e in kind.candidates(setup) if not e.on_instrument]
    return shared + [
        OfDataSet.of(effect, part.data_set)
        for part in setup.parts
        for effect in kind.candidates(part)
        if effect.on_instrument
    ]
