"""``[loop]``: settings of the search for missing effects, with their bounds."""

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..bounds import Seed, Within
from ..effects.base import Effect
from ..effects.registry import effect_class


class LoopSettings(BaseModel):
    """``[loop]``: settings of the search for missing effects."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    alpha: Annotated[
        float, Within(0.0, 1.0, "it is a probability", open_low=True, open_high=True)
    ] = 0.01
    """Probability that the whole loop names an effect in a clean measurement."""
    seed: Seed = 0
    """Seed of all random draws."""
    effects: tuple[str, ...] | None = Field(default=None, min_length=1)
    """Identifiers of the effects to try; all of the catalogue by default."""
    draws: (
        Annotated[
            int,
            Within(25, 1_000_000, "fewer do not show the tail, and more resolve p to a permille"),
        ]
        | None
    ) = None
    """Null draws for the p-values; by default 500, and 200 for more than 30,000 readings, where
    they take most of the time. The relative uncertainty of a p-value is then 20 % instead of 14 %.
    """
    max_effects: Annotated[
        int, Within(0, 10_000, "no catalogue has as many effects at as many places")
    ] = 32
    """Number of effects after which the loop stops."""
    learn: bool = False
    """Whether the families' sizes are learned for the final fit, after the search."""


def null_draws(draws: int | None, readings: int) -> int:
    """The number of null draws for a measurement of so many readings."""
    if draws is not None:
        return draws
    return _DRAWS if readings <= _MANY else _FEWER


_DRAWS, _FEWER, _MANY = 500, 200, 30_000


def checked(**settings: Any) -> LoopSettings:
    """Settings given in Python; raises `ValueError` for the first that is out of its bounds."""
    try:
        return LoopSettings(**settings)
    except ValidationError as error:
        first = error.errors()[0]
        expected = first["msg"].removeprefix("Input should be ")
        raise ValueError(
            f"{first['loc'][0]}: found {first['input']!r}, expected {expected}; correct it"
        ) from error


def classes_of(effects: Iterable[type[Effect] | str]) -> list[type[Effect]]:
    """The classes of the given effects; names are those of the catalogue.

    Raises `ValueError` for an unknown name, and for anything that is neither a class nor a name.
    """
    given = [effects] if isinstance(effects, str) else list(effects)
    found = [effect_class(one) if isinstance(one, str) else one for one in given]
    for one in found:
        if not (isinstance(one, type) and issubclass(one, Effect)):
            raise ValueError(
                f"effects: found {one!r}, expected classes of effects or their names, as in "
                "effects=['backlash']; the loop itself finds where each could be"
            )
    return found
