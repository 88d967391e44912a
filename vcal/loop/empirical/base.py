"""What an empirical description is."""

import abc
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import numpy as np

from ...effects.base import Effect, Setup
from ...machine.parameters import Parameter
from ...machine.plan import Plan


@dataclass(frozen=True)
class Interval:
    """A stretch of a covariate, in SI."""

    covariate: str
    low: float
    high: float


Read = Callable[[str], str]
"""Python for the values of a covariate by its name."""
Code = tuple[list[str], dict[tuple[str, str], str]]
"""Lines of Python, and an expression for every port and amplitude."""


class Empirical(Effect):
    """Base class of the descriptions: functions of covariates in one error motion of an axis, of
    free size.
    """

    words: ClassVar[str]
    """What it is, for a sentence: *a local error*."""
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("size", self.unit, sigma=10.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    def said(self, shape: Mapping[str, float]) -> str:
        """The words at given shape values."""
        del shape
        return self.words

    def depends_on(self, plan: Plan, shape: Mapping[str, float]) -> tuple[str, ...]:
        """Covariates that it depends on, first of all that along which it has its shape."""
        del plan, shape
        return self.needs

    @property
    def joint(self) -> bool:
        """Whether it is a product of the first two of them."""
        return False

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        """Where it sits; nothing where it is everywhere."""
        del plan, shape
        return ()

    @property
    def coded(self) -> bool:
        """Whether there is Python for it."""
        return True

    @abc.abstractmethod
    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        """Lines of Python that prepare what it needs from what `read` gives for a covariate, and
        the expression of a port's deviation per unit of an amplitude.
        """

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            for c in "XYZABC":
                yield cls(port=f"E{c}{axis}", unit="um" if c in "XYZ" else "urad", placement=axis)

    def _length(self) -> str:
        return "rad" if self.placement.startswith("J") else "mm"


def written(value: float, over: float) -> str:
    """A number to six digits of the range that it is a place in: a moment of a clock that counts
    from 1970 has more of them before its point.
    """
    digits = 6 - math.floor(math.log10(over)) if over > 0.0 else 6
    return repr(round(float(value), digits))


def range_of(plan: Plan, axis: str) -> tuple[float, float]:
    """Between which positions of an axis was measured, m or rad."""
    x = np.asarray(plan.x(axis))
    return float(x.min()), float(x.max())
