"""Effects by name: the built-in catalogue and the user's own."""

import hashlib
import importlib.util
import sys
from pathlib import Path

from ..catalogue import Catalogue
from ..errors import StudyError
from .base import Effect

CATALOGUE: Catalogue[type[Effect]] = Catalogue("effect")
"""Every effect that may be declared, and of these all that the loop may name, by identifier."""

register = CATALOGUE.register
effect_class = CATALOGUE.named


def load_effects(path: Path) -> list[type[Effect]]:
    """The effect classes a user wrote in a Python file, which is run anew every time.

    It stays among the modules under a name that no other file has, the last run in place of those
    before. Raises `StudyError` if the file cannot be read or run, or holds no subclass of `Effect`.
    """
    if not path.is_file():
        raise StudyError(f"{path}: no such file, expected a Python file with classes of effects")
    # A name of its own for every file: own_effect.py is one of many.
    digest = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]
    spec = importlib.util.spec_from_file_location(f"vcal_user_{path.stem}_{digest}", path)
    if spec is None or spec.loader is None:
        raise StudyError(f"{path}: not a Python file, expected a name that ends in .py")
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
        if not isinstance(error, Exception | SystemExit):
            raise
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
