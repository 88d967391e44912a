"""Formats of compensation: one file per control, found without a list of them."""

import importlib
import pkgutil

from ..base import FORMATS

__all__ = ["FORMATS", "discover"]


def discover() -> None:
    """Import every file of this folder, which registers its formats."""
    for leaf in pkgutil.iter_modules(__path__, f"{__name__}."):
        importlib.import_module(leaf.name)


discover()
