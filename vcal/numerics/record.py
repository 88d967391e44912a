"""What models, plans and effects are: frozen dataclasses that are pytrees."""

from typing import TYPE_CHECKING

import equinox as eqx


class Record(eqx.Module):
    """A module of equinox whose methods are those of any other Python object.

    A module's own are wrapped, each time one is looked up, in one more module that is a pytree
    too, so that a compiled function may take it for an argument. What is looked up a hundred
    thousand times in one run of the loop, and never given to a compiled function, need not be: it
    took a tenth of the time of a run, with compilation.
    """

    if not TYPE_CHECKING:
        __getattribute__ = object.__getattribute__
