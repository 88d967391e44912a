"""Catalogues: classes by the names by which study files and commands call them."""

import difflib
from collections.abc import Iterable
from typing import Any, Generic, TypeVar

from .errors import StudyError

C = TypeVar("C", bound=type[Any])
D = TypeVar("D", bound=type[Any])


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name most like `name`, upper and lower case counting as the same."""
    folded = {k.casefold(): k for k in known}
    close = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=0.5)
    return folded[close[0]] if close else None


def nearest(name: str, known: Iterable[str]) -> str:
    """``" (did you mean 'backlash'?)"`` for the closest known name, or nothing."""
    close = closest(name, known)
    return f" (did you mean {close!r}?)" if close else ""


class Catalogue(dict[str, C], Generic[C]):
    """Classes of one sort by their names.

    `what` is what messages call one of them, `attribute` the class attribute with its name.
    """

    def __init__(self, what: str, attribute: str = "name"):
        super().__init__()
        self.what, self.attribute = what, attribute

    def register(self, kind: D) -> D:
        """Class decorator that enters a class under its name.

        Raises `ValueError` if another class holds that name.
        """
        name = getattr(kind, self.attribute)
        known = self.get(name)
        if known is not None and known.__qualname__ != kind.__qualname__:
            raise ValueError(f"two {self.what}s are named {name!r}: {known} and {kind}")
        self[name] = kind  # type: ignore[assignment]
        return kind

    def named(self, name: str) -> C:
        """The class of that name; raises `StudyError` that offers the nearest one."""
        if name not in self:
            raise StudyError(
                f"unknown {self.what} {name!r}{nearest(name, self)}; known: {', '.join(self)}"
            )
        return self[name]
