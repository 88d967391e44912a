"""Effects by name: the built-in catalogue and the user's own."""

import difflib
import importlib.util
from collections.abc import Iterable
from pathlib import Path

from ..errors import StudyError
from .base import Effect

CATALOGUE: dict[str, type[Effect]] = {}
"""Every effect the loop may name, by identifier."""


def register(effect: type[Effect]) -> type[Effect]:
    """Class decorator that enters an effect into the catalogue under its `name`.

    Raises `ValueError` if another class holds that name.
    """
    known = CATALOGUE.get(effect.name)
    if known is not None and known.__qualname__ != effect.__qualname__:
        raise ValueError(f"two effects are named {effect.name!r}: {known} and {effect}")
    CATALOGUE[effect.name] = effect
    return effect


def nearest(name: str, known: Iterable[str]) -> str:
    """``" (did you mean 'backlash'?)"`` for the closest known name, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


def effect_class(name: str, catalogue: dict[str, type[Effect]] | None = None) -> type[Effect]:
    """The effect of that name; raises `StudyError` that offers the nearest one."""
    catalogue = CATALOGUE if catalogue is None else catalogue
    if name not in catalogue:
        raise StudyError(
            f"unknown effect {name!r}{nearest(name, catalogue)}; known: {', '.join(catalogue)}"
        )
    return catalogue[name]


def load_effects(path: Path) -> list[type[Effect]]:
    """The effect classes a user wrote in a Python file.

    Raises `StudyError` if the file cannot be read or run, or holds no subclass of `Effect`.
    """
    if not path.is_file():
        raise StudyError(f"{path}: no such file, expected a Python file with classes of effects")
    spec = importlib.util.spec_from_file_location(f"vcal_user_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise StudyError(f"{path}: not a Python file, expected a name that ends in .py")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise StudyError(
            f"{path}: cannot be run: {type(error).__name__}: {error}; mend the file"
        ) from error
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, Effect)
        and value.__module__ == module.__name__
    ]
    if not found:
        raise StudyError(
            f"{path}: holds no effect, expected at least one class derived from vcal.Effect"
        )
    for effect in found:
        if not isinstance(getattr(effect, "name", None), str):
            raise StudyError(f"{path}: class {effect.__name__} has no 'name', expected a string")
    return found
