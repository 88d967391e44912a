"""The base class of effects that stand for another one, under its name."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from .base import Effect


class Wrapper(Effect):
    """Base class of effects with the name, the placement and the parameters of `effect`.

    They are in no catalogue: the loop puts them in the place of an effect.
    """

    effect: Effect

    # Class attributes of other effects are those of the wrapped effect here.
    @property
    def name(self) -> str:  # type: ignore[override]
        """Identifier of the effect."""
        return self.effect.name

    @property
    def summary(self) -> str:  # type: ignore[override]
        """Summary of the effect."""
        return self.effect.summary

    @property
    def kind(self):  # type: ignore[override]
        """Kind of the effect."""
        return self.effect.kind

    @property
    def where(self):  # type: ignore[override]
        """Where the effect is."""
        return self.effect.where

    @property
    def on_instrument(self) -> bool:
        return self.effect.on_instrument

    @property
    def odds(self) -> float:  # type: ignore[override]
        """Prior odds of the effect."""
        return self.effect.odds

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.effect.parameters

    @property
    def needs(self) -> tuple[str, ...]:
        return self.effect.needs

    @property
    def indicators(self) -> tuple[str, ...]:
        return self.effect.indicators

    def rows(self, plan: Plan) -> Bool[np.ndarray, " n"]:
        return self.effect.rows(plan)

    def scan(self, plan: Plan) -> Mapping[str, np.ndarray]:
        return self.effect.scan(plan)

    def edges(self, plan: Plan) -> Mapping[str, np.ndarray]:
        return self.effect.edges(plan)

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        return self.effect.shape_odds(plan, values, uncertainties)
