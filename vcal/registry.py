"""Catalogues of classes by the names that study files and commands use; classes of user files."""

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
"""Prefix of the names of modules that are user files."""


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name most similar to `name`, regardless of case, or None.

    A single letter only matches the same letter: it is equally similar to all names that contain
    it.
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
    """Classes of one kind by their names.

    `what` is the word for one of them in messages, `attribute` the class attribute with its name.
    """

    _all: ClassVar[list["Catalogue[Any]"]] = []

    def __init__(self, what: str, attribute: str = "name"):
        super().__init__()
        self.what, self.attribute = what, attribute
        Catalogue._all.append(self)

    def register(self, kind: D) -> D:
        """Class decorator that registers a class under its name.

        Raises `ValueError` if another class has that name.
        """
        name = getattr(kind, self.attribute)
        known = self.get(name)
        if known is not None and known.__qualname__ != kind.__qualname__:
            raise ValueError(f"two {self.what}s are named {name!r}: {known} and {kind}")
        self[name] = kind  # type: ignore[assignment]
        return kind

    def named(self, name: str) -> C:
        """The class of that name. Raises `StudyError` that suggests the nearest name."""
        if name not in self:
            raise StudyError(
                f"unknown {self.what} {name!r}{nearest(name, self)}; known: {', '.join(self)}"
            )
        return self[name]

    def defined_in(self, module: ModuleType, base: type[T]) -> list[type[T]]:
        """The classes derived from `base` that a user file defines.

        A class without a name that is the base of another one is a common base class, and is left
        out. Raises `StudyError` where there is no class, or another class without a name.
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
    """Context after which all catalogues are as before: registrations within it are undone."""
    before = [(catalogue, dict(catalogue)) for catalogue in Catalogue._all]
    try:
        yield
    finally:
        for catalogue, known in before:
            catalogue.clear()
            catalogue.update(known)


def run_file(path: Path, what: str, source: bytes | None = None) -> ModuleType:
    """Run a Python file of the user, every time it is called, and return it as a module.

    `source` are its contents, by default read here. They are compiled anew: a ``__pycache__``
    beside the file, whose contents nobody reads, is neither used nor written.

    The module stays in `sys.modules` under a name that no other file has, and replaces the one of
    an earlier run. `what` is the word for its classes in messages. Raises `StudyError` if the file
    cannot be read or run.
    """
    if not path.is_file():
        raise StudyError(f"{path}: no such file, expected a Python file with classes of {what}s")
    # The name is unique for every file: many studies have an own_effect.py.
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]
    spec = importlib.util.spec_from_file_location(f"{_OWN}{path.stem}_{digest}", path)
    if spec is None or spec.loader is None:
        raise StudyError(f"{path}: not a Python file, expected a name that ends in .py; rename it")
    module = importlib.util.module_from_spec(spec)
    earlier = sys.modules.get(spec.name)
    # Annotations that are strings (`from __future__ import annotations`) are looked up there: by
    # dataclasses while the file is run, and by other code later.
    sys.modules[spec.name] = module
    try:
        text = path.read_bytes() if source is None else source
        exec(compile(text, str(path), "exec", dont_inherit=True), module.__dict__)
    except BaseException as error:
        if earlier is None:
            del sys.modules[spec.name]
        else:
            sys.modules[spec.name] = earlier
        if isinstance(error, KeyboardInterrupt):
            raise
        raise StudyError(
            f"{path}: cannot be run: {in_own_words(error)}; correct the file"
        ) from error
    return module


def in_own_words(error: BaseException) -> str:
    """An error of a user file in one line: its type, its message and its line number."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        what = f"{'.'.join(map(str, first['loc']))}: {first['msg']} ({error.title})"
    else:
        what = str(error).strip().partition("\n")[0]
    text = type(error).__name__ + (f": {what}" if what else "")
    place = own_place(error)
    return text if place is None else f"{text} (line {place[1]})"


def own_place(error: BaseException) -> tuple[str, int, str] | None:
    """Name, line and function of the user file in which an error was raised; None if in none."""
    found, step = None, error.__traceback__
    while step is not None:
        code = step.tb_frame.f_code
        if str(step.tb_frame.f_globals.get("__name__", "")).startswith(_OWN):
            found = Path(code.co_filename).name, step.tb_lineno, code.co_name
        step = step.tb_next
    return found
