"""Effects whose reference value, such as the temperature at which they are zero, is uncertain."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..machine.parameters import Parameter
from ..machine.plan import Plan
from ..numerics.arrays import Array
from ..units import si_factor, times
from .base import Effect, Reference, Response
from .data_set import OfDataSet
from .wrapper import Wrapper

_DETERMINED = 2.0
"""Least size of an effect, in standard uncertainties, from which its reference value follows."""
_ODDS = 0.5
"""Prior odds of another reference value against the declared one."""


class FreeReference(Wrapper):
    """An effect together with a constant part, because its reference value is uncertain.

    With the response f to a covariate T, a deviation k f(T - T0) is k f(T - 20 degC) + c f' for an
    effect that is linear in T, c = k (20 degC - T0): the constant part has the form of the effect
    and an amplitude of its own, for every amplitude of the effect. Its prior standard deviation is
    that of k times that of T0. It has the name and the placement of `effect`, and is a candidate
    beside it (`with_free_reference`): the readings decide whether the reference is as declared.
    """

    @property
    def odds(self) -> float:  # type: ignore[override]
        """Half of those of the effect: a reference value is as declared more often than not."""
        return _ODDS * self.effect.odds

    @property
    def reference(self) -> Reference:
        """That of the effect, which has one."""
        found = self.effect.reference
        assert found is not None
        return found

    @property
    def constants(self) -> dict[str, Parameter]:
        """The amplitude of the constant part, by the name of the amplitude it belongs to."""
        unit, sigma = self.reference.unit, self.reference.sigma
        return {
            p.name: Parameter(f"{p.name}_at_zero", times(p.unit, unit), sigma=p.sigma * sigma)
            for p in self.effect.amplitudes
            if not p.known
        }

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        own = self.effect.parameters
        shapes = tuple(p for p in own if p.shape)
        return (*(p for p in own if not p.shape), *self.constants.values(), *shapes)

    def response(self, plan: Plan, shape: Mapping[str, Array]) -> Response:
        constants = self.constants
        constant = {
            (port, constants[name].name): value
            for (port, name), value in self.effect.constant_part(plan, shape).items()
            if name in constants
        }
        return {**self.effect.response(plan, shape), **constant}

    def shape_odds(
        self, plan: Plan, values: Mapping[str, float], uncertainties: Mapping[str, float]
    ) -> float:
        """That of the effect, times the odds of its reference value.

        The fit assumes a constant part that is independent of the size k. The true one is k times
        a deviation of the reference value, which beyond its standard uncertainty is as improbable
        as in the normal distribution: a constant alone is no effect.
        """
        own = self.effect.shape_odds(plan, values, uncertainties)
        square = 0.0
        for name, constant in self.constants.items():
            usual = math.hypot(values[name], uncertainties[name]) * self._sigma
            square = max(square, (values[constant.name] / usual) ** 2)
        return own * math.exp(-0.5 * max(square - 1.0, 0.0))

    @property
    def _sigma(self) -> float:
        """Standard uncertainty of the reference value, SI."""
        return self.reference.sigma * si_factor(self.reference.unit)

    def zero(self, values: np.ndarray, covariance: np.ndarray) -> tuple[float, float] | None:
        """How far the reference value is from the declared one, with its standard uncertainty, SI.

        It is -c/k of the best determined amplitude k, from the estimates (SI) of all amplitudes
        and their covariance. None where no amplitude is at least twice its uncertainty.
        """
        names = [p.name for p in self.amplitudes]
        pairs = [(names.index(n), names.index(p.name)) for n, p in self.constants.items()]
        u = np.sqrt(np.diag(covariance))
        own, constant = max(pairs, key=lambda pair: abs(values[pair[0]]) / u[pair[0]])
        k, c = values[own], values[constant]
        if abs(k) < _DETERMINED * u[own]:
            return None
        slope = np.zeros(len(values))
        slope[own], slope[constant] = c / k**2, -1.0 / k
        return float(-c / k), float(np.sqrt(slope @ covariance @ slope))


def with_free_reference(effect: Effect) -> Effect | None:
    """The effect with an uncertain reference value; None where it has none."""
    if isinstance(effect, OfDataSet):
        inner = with_free_reference(effect.effect)
        return None if inner is None else replace(effect, effect=inner)
    return None if effect.reference is None else FreeReference(effect, placement=effect.placement)


def same_effect(effect: Effect) -> int:
    """A number that an effect shares with itself with a free reference value."""
    inner = effect.effect if isinstance(effect, OfDataSet) else effect
    return id(inner.effect if isinstance(inner, FreeReference) else inner)


def with_known_reference(effect: Effect) -> Effect:
    """The effect without the constant part of an uncertain reference value."""
    if isinstance(effect, OfDataSet):
        return replace(effect, effect=with_known_reference(effect.effect))
    return effect.effect if isinstance(effect, FreeReference) else effect
