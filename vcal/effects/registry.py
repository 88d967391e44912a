"""Effects by name: the built-in catalogue and the user's own."""

import importlib.util
from pathlib import Path

from ..catalogue import Catalogue
from ..errors import StudyError
from .base import Effect

CATALOGUE: Catalogue[type[Effect]] = Catalogue("effect")
"""Every effect that may be declared, and of these all that the loop may name, by identifier."""

register = CATALOGUE.register
effect_class = CATALOGUE.named


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
    except (Exception, SystemExit) as error:
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
