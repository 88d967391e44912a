"""Distributions by name, as study files and tables call them."""

import inspect
from typing import Any

from ..errors import StudyError
from ..registry import Catalogue, nearest
from .base import Distribution

CATALOGUE: Catalogue[type[Distribution]] = Catalogue("distribution")
"""Every distribution, by identifier."""

register = CATALOGUE.register
distribution_class = CATALOGUE.named


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
