"""Effects by name: the built-in catalogue and the user's own."""

from pathlib import Path

from ..registry import Catalogue, run_file
from .base import Effect

CATALOGUE: Catalogue[type[Effect]] = Catalogue("effect")
"""Every effect that may be declared, and of these all that the loop may name, by identifier."""

register = CATALOGUE.register
effect_class = CATALOGUE.named


def load_effects(path: Path) -> list[type[Effect]]:
    """The effect classes a user wrote in a Python file, which is run anew every time.

    Raises `StudyError` if the file cannot be read or run, or holds no subclass of `Effect`.
    """
    return CATALOGUE.defined_in(run_file(path, CATALOGUE.what), Effect)
