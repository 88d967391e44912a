"""Which effects of the catalogue are related: of the same cause, or seen by the same column."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ...effects.base import Effect, Setup
from ...instruments.conditions import file_name

_GENERAL = tuple(f"vcal.effects.{name}" for name in ("base", "forms", "clock"))
"""Modules of base classes that say nothing of a cause."""


class Related(NamedTuple):
    """Effects that are related to one, by name."""

    family: tuple[str, ...]
    """Effects of the same cause: declared in the same module, or with a base class in common."""
    rivals: tuple[str, ...]
    """Effects whose deviations depend first on the same column: the loop has to separate them."""
    column: str
    """That column, where `axis` stands for the axis or joint; empty without one."""


def related(
    effects: Sequence[type[Effect]], examples: Mapping[str, tuple[Effect, Setup] | None]
) -> dict[str, Related]:
    """What every effect is related to among the others, by its name."""
    causes = {effect.name: _causes(effect) for effect in effects}
    columns = {effect.name: _column(examples.get(effect.name)) for effect in effects}
    return {
        one: Related(
            tuple(other for other in causes if other != one and causes[one] & causes[other]),
            tuple(
                other
                for other in causes
                if other != one and columns[one] and columns[one] == columns[other]
            ),
            columns[one],
        )
        for one in causes
    }


def _causes(effect: type[Effect]) -> set[str]:
    """Modules of an effect and of its base classes, for causes."""
    modules = {base.__module__ for base in effect.__mro__ if issubclass(base, Effect)}
    return {effect.__module__} | modules.difference(_GENERAL)


def _column(example: tuple[Effect, Setup] | None) -> str:
    """The column that shows an effect best, with ``axis`` for its placement; empty for none."""
    if example is None:
        return ""
    instance, setup = example
    names = dict.fromkeys((*instance.indicators, *instance.needs))
    if not names:
        return ""
    name, own = next(iter(names)), instance.placement
    axes = setup.plan.axes
    if own in axes and name == own:
        return f"position of the {'joint' if setup.chain.arm else 'axis'}"
    column = file_name(name, axes)
    if own not in axes:
        return column
    letter = re.escape(file_name(own, axes).split("_")[0])
    return re.sub(rf"(?<=_){letter}(?=_|$)", "axis", column)
