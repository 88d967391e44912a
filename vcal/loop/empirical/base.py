"""The base class of empirical descriptions."""

import abc
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import numpy as np

from ...effects.base import Effect, Setup
from ...machine.parameters import Parameter
from ...machine.plan import Plan, slides


@dataclass(frozen=True)
class Interval:
    """An interval of a covariate, in SI."""

    covariate: str
    low: float
    high: float


Read = Callable[[str], str]
"""Python code for the values of a covariate, by its name."""
Code = tuple[list[str], dict[tuple[str, str], str]]
"""Lines of Python code, and an expression for every port and amplitude."""


class Empirical(Effect):
    """Base class of the descriptions: functions of covariates in one error motion of an axis, with
    amplitudes that are not bounded by physics.
    """

    words: ClassVar[str]
    """Name of the description within a sentence: *a local error*."""
    port: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    sliding: bool = eqx.field(static=True, default=False, kw_only=True)
    """Whether its axis is a prismatic joint of an arm."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("size", self.unit, sigma=10.0),)

    @property
    def needs(self) -> tuple[str, ...]:
        return (self.placement,)

    @property
    def reference(self) -> None:
        """None: a description has the constants that it needs."""
        return None

    def said(self, shape: Mapping[str, float]) -> str:
        """The name within a sentence, at given shape values (SI)."""
        del shape
        return self.words

    def depends_on(self, plan: Plan, shape: Mapping[str, float]) -> tuple[str, ...]:
        """Covariates that it depends on; the first is that of its shape."""
        del plan, shape
        return self.needs

    @property
    def joint(self) -> bool:
        """Whether it is a product of the first two covariates."""
        return False

    def intervals(self, plan: Plan, shape: Mapping[str, float]) -> tuple[Interval, ...]:
        """The intervals where it is not zero or deviates; empty where it acts everywhere."""
        del plan, shape
        return ()

    @property
    def coded(self) -> bool:
        """Whether `code` can write it as Python."""
        return True

    @abc.abstractmethod
    def code(self, plan: Plan, shape: Mapping[str, float], read: Read) -> Code:
        """Lines of Python code that prepare the values given by `read`, and the expression of every
        port's displacement per unit of an amplitude (SI).
        """

    @classmethod
    def candidates(cls, setup: Setup) -> Iterable[Effect]:
        for axis in setup.chain.axes:
            for c in "XYZABC":
                yield cls(
                    port=f"E{c}{axis}",
                    unit="um" if c in "XYZ" else "urad",
                    sliding=slides(setup.chain.axes, axis),
                    placement=axis,
                )

    def _length(self) -> str:
        return "rad" if self.placement.startswith("J") and not self.sliding else "mm"


def written(value: float, over: float) -> str:
    """A number rounded to six digits of the range `over`. An absolute time counted from 1970 has
    more digits than that before its decimal point.
    """
    digits = 6 - math.floor(math.log10(over)) if over > 0.0 else 6
    return repr(round(float(value), digits))


def range_of(plan: Plan, axis: str) -> tuple[float, float]:
    """Lowest and highest measured position of an axis, m or rad."""
    x = np.asarray(plan.x(axis))
    return float(x.min()), float(x.max())
