"""Catalogues: classes by the names by which study files and commands call them, and those that a
user wrote in a file of their own.
"""

import difflib
import hashlib
import importlib.util
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Generic, TypeVar

from pydantic import ValidationError

from .errors import StudyError

C = TypeVar("C", bound=type[Any])
D = TypeVar("D", bound=type[Any])
T = TypeVar("T")
_OWN = "vcal_user_"
"""How the names of modules begin that are files of a user's own."""


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name most like `name`, upper and lower case counting as the same; none of a single
    letter, which is as much like all that have it.
    """
    if len(name) < 2:
        return next((k for k in known if k.casefold() == name.casefold()), None)
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

    _all: ClassVar[list["Catalogue[Any]"]] = []

    def __init__(self, what: str, attribute: str = "name"):
        super().__init__()
        self.what, self.attribute = what, attribute
        Catalogue._all.append(self)

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

    def defined_in(self, module: ModuleType, base: type[T]) -> list[type[T]]:
        """The classes derived from `base` that a file of the user's own defines.

        One without a name from which another derives is what they have in common. Raises
        `StudyError` where there is none, or another one without a name.
        """
        found = [
            value
            for value in vars(module).values()
            if isinstance(value, type)
            and issubclass(value, base)
            and value.__module__ == module.__name__
        ]
        if not found:
            raise StudyError(
                f"{module.__file__}: holds no {self.what}, expected at least one class derived "
                f"from {base.__module__}.{base.__qualname__}; add one, or correct the name of the "
                "file"
            )
        bases = {base for kind in found for base in kind.__mro__[1:]}
        named = [kind for kind in found if hasattr(kind, self.attribute) or kind not in bases]
        for kind in named:
            if not isinstance(getattr(kind, self.attribute, None), str):
                raise StudyError(
                    f"{module.__file__}: class {kind.__name__} has no {self.attribute!r}, expected "
                    f'text in quotes, as in `{self.attribute} = "mine"`; add it'
                )
        return named


@contextmanager
def unchanged() -> Iterator[None]:
    """What is registered meanwhile, in any catalogue, is forgotten afterwards."""
    before = [(catalogue, dict(catalogue)) for catalogue in Catalogue._all]
    try:
        yield
    finally:
        for catalogue, known in before:
            catalogue.clear()
            catalogue.update(known)


def run_file(path: Path, what: str) -> ModuleType:
    """A Python file of the user's own as a module; it is run anew every time.

    It stays among the modules under a name that no other file has, the last run in place of those
    before. `what` is what its classes are, for messages. Raises `StudyError` if it cannot be read
    or run.
    """
    if not path.is_file():
        raise StudyError(f"{path}: no such file, expected a Python file with classes of {what}s")
    # A name of its own for every file: own_effect.py is one of many.
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]
    spec = importlib.util.spec_from_file_location(f"{_OWN}{path.stem}_{digest}", path)
    if spec is None or spec.loader is None:
        raise StudyError(f"{path}: not a Python file, expected a name that ends in .py; rename it")
    module = importlib.util.module_from_spec(spec)
    earlier = sys.modules.get(spec.name)
    # Annotations that are text (`from __future__ import annotations`) are looked up there, by
    # dataclasses while the file is run, and by others later.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        if earlier is None:
            del sys.modules[spec.name]
        else:
            sys.modules[spec.name] = earlier
        if isinstance(error, KeyboardInterrupt):
            raise
        raise StudyError(f"{path}: cannot be run: {in_own_words(error)}; mend the file") from error
    return module


def in_own_words(error: BaseException) -> str:
    """An error of a file of the user's own in one line: its kind, what it says, and where."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        what = f"{'.'.join(map(str, first['loc']))}: {first['msg']} ({error.title})"
    else:
        what = str(error).strip().partition("\n")[0]
    text = type(error).__name__ + (f": {what}" if what else "")
    place = own_place(error)
    return text if place is None else f"{text} (line {place[1]})"


def own_place(error: BaseException) -> tuple[str, int, str] | None:
    """File, line and function of the user's own in which an error arose; None where in none."""
    found, step = None, error.__traceback__
    while step is not None:
        code = step.tb_frame.f_code
        if str(step.tb_frame.f_globals.get("__name__", "")).startswith(_OWN):
            found = Path(code.co_filename).name, step.tb_lineno, code.co_name
        step = step.tb_next
    return found
