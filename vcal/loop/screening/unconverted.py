"""Columns that are kept in the unit of the file, while the parameters of an effect are converted.

The quantities that vcal knows lose their unit on reading (``"T_X"``, ``"since_X"``); any further
column keeps its name, its numbers and its unit (``"gap_mm"``). An effect that is proportional to
such a column, with a parameter per that unit (um/mm), has to convert the column itself.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...effects.base import Effect
from ...machine.parameters import Parameter
from ...machine.plan import Plan
from ...units import is_per, unit_of_column

_SAME = 1e-6
"""Relative tolerance of a factor, and of a response that is linear in a column."""
_INSIDE = f"{__name__.partition('.')[0]}."


@dataclass(frozen=True)
class Unconverted:
    """A column in the unit of the file, and the parameter of an effect that is per that unit."""

    name: str
    unit: str
    factor: float
    """Factor from the unit of the column to SI."""
    parameter: Parameter

    @property
    def label(self) -> str:
        """The parameter with its unit."""
        return self.parameter.label

    @property
    def words(self) -> str:
        """What a user's own response has to do."""
        return (
            f"the column {self.name} is in {self.unit}, as in the file, and {self.label} is "
            f"converted to SI: the response has to multiply the column by {self.factor:g}"
        )


def unconverted(effect: Effect) -> list[Unconverted]:
    """The columns that a user's own effect has to convert."""
    if type(effect).__module__.startswith(_INSIDE):
        return []
    found = []
    for need in effect.needs:
        unit, factor = unit_of_column(need.rpartition(":")[2])
        for p in effect.amplitudes if factor != 1.0 else ():
            if is_per(p.unit, unit):
                found.append(Unconverted(need, unit, factor, p))
    return found


def as_in_file(effect: Effect, plan: Plan, shape: Mapping[str, Any]) -> Iterator[Unconverted]:
    """Those columns that the effect certainly does not convert: its response is plus or minus the
    column, apart from a constant.
    """
    for column in unconverted(effect):
        if any(abs(abs(k) - 1.0) < _SAME for k in _slopes(effect, plan, shape, column)):
            yield column


def not_shown(effect: Effect, plan: Plan, shape: Mapping[str, Any]) -> list[Unconverted]:
    """Those columns of which the response does not show whether they are converted: it is not
    linear in them, or with another factor.
    """
    return [
        column
        for column in unconverted(effect)
        if not any(
            abs(abs(k) / column.factor - 1.0) < _SAME for k in _slopes(effect, plan, shape, column)
        )
    ]


def _slopes(
    effect: Effect, plan: Plan, shape: Mapping[str, Any], column: Unconverted
) -> Iterator[float]:
    """The slope of every deviation that is linear in a column, apart from a constant."""
    x = np.asarray(plan.covariate(column.name), float)
    x = x - x.mean()
    if not x.any():
        return
    for (_, name), values in effect.response(plan, shape).items():
        if name != column.parameter.name:
            continue
        y = np.broadcast_to(np.asarray(values, float), x.shape)
        y = y - y.mean()
        slope = float(x @ y / (x @ x))
        if slope and np.abs(y - slope * x).max() < _SAME * np.abs(y).max():
            yield slope
