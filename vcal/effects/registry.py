"""Effects by name: the built-in catalogue and the user's own."""

from pathlib import Path

from ..registry import Catalogue, run_file
from .base import Effect

CATALOGUE: Catalogue[type[Effect]] = Catalogue("effect")
"""Every effect that can be declared, among them all that the loop may identify, by name."""

register = CATALOGUE.register
effect_class = CATALOGUE.named


def load_effects(path: Path) -> list[type[Effect]]:
    """The effect classes that a user defined in a Python file, which is run at every call.

    Raises `StudyError` if the file cannot be read or run, or holds no subclass of `Effect`.
    """
    return CATALOGUE.defined_in(run_file(path, CATALOGUE.what), Effect)
