"""The base class of models, plans and effects: frozen dataclasses that are pytrees."""

from typing import TYPE_CHECKING

import equinox as eqx


class Record(eqx.Module):
    """An equinox module whose methods are looked up as those of any other Python object.

    equinox wraps a method, each time it is looked up, in a further module that is a pytree, so that
    a compiled function may take it as an argument. Methods of these classes are looked up a hundred
    thousand times in one run of the loop and never passed to a compiled function. Wrapping them
    took a tenth of the time of a run, compilation included.
    """

    if not TYPE_CHECKING:
        __getattribute__ = object.__getattribute__
