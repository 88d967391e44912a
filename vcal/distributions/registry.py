"""Distributions by name, as study files and tables call them."""

import difflib
import inspect
from collections.abc import Iterable
from typing import Any, TypeVar

from ..errors import StudyError
from .base import Distribution

CATALOGUE: dict[str, type[Distribution]] = {}
"""Every distribution, by identifier."""

_D = TypeVar("_D", bound=type[Distribution])


def register(kind: _D) -> _D:
    """Class decorator that enters a distribution into the catalogue under its `name`.

    Raises `ValueError` if another class holds that name.
    """
    known = CATALOGUE.get(kind.name)
    if known is not None and known.__qualname__ != kind.__qualname__:
        raise ValueError(f"two distributions are named {kind.name!r}: {known} and {kind}")
    CATALOGUE[kind.name] = kind
    return kind


def nearest(name: str, known: Iterable[str]) -> str:
    """``" (did you mean 'normal'?)"`` for the closest known name, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


def distribution_class(name: str) -> type[Distribution]:
    """The distribution of that name; raises `StudyError` that offers the nearest one."""
    if name not in CATALOGUE:
        raise StudyError(
            f"unknown distribution {name!r}{nearest(name, CATALOGUE)}; "
            f"known: {', '.join(CATALOGUE)}"
        )
    return CATALOGUE[name]


def distribution(name: str, **settings: Any) -> Distribution:
    """The distribution of that name with its settings: ``distribution("uniform", low=0, high=1)``.

    Raises `StudyError` for an unknown name, a setting that it does not have, one that is missing,
    or a value that it cannot take.
    """
    kind = distribution_class(name)
    accepted = inspect.signature(kind).parameters
    for key in settings:
        if key not in accepted:
            raise StudyError(
                f"distribution {name!r}: unknown setting {key!r}{nearest(key, accepted)}; it "
                f"takes {', '.join(accepted)}"
            )
    missing = [
        key
        for key, p in accepted.items()
        if p.default is inspect.Parameter.empty and key not in settings
    ]
    if missing:
        raise StudyError(
            f"distribution {name!r}: {', '.join(missing)} missing; it takes {', '.join(accepted)}"
        )
    try:
        return kind(**settings)
    except ValueError as error:
        raise StudyError(f"distribution {name!r}: {error}") from error
