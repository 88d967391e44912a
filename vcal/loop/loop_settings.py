"""``[loop]``: how the missing effect is looked for, within which bounds."""

from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..effects.base import Effect
from ..effects.registry import effect_class


class LoopSettings(BaseModel):
    """``[loop]``: how the missing effect is looked for."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    alpha: float = Field(default=0.01, gt=0, lt=1)
    """Share of clean measurements in which the whole loop may name an effect."""
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    """Seed of all random draws."""
    effects: tuple[str, ...] | None = Field(default=None, min_length=1)
    """Identifiers of the effects to try; all of the catalogue by default."""
    draws: int = Field(default=500, ge=25, le=1_000_000)
    """Null draws behind a significance: fewer do not tell how rare the rarest of them is."""
    max_effects: int = Field(default=16, ge=0)
    """Effects after which the loop stops."""
    learn: bool = False
    """Whether the families' sizes are learned for the final fit, after the search."""


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
    """The classes of effects to try, of which names are those of the catalogue.

    Raises `ValueError` for what is neither, and for a name that is not known.
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
