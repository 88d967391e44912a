"""Exports of instruments, controllers and metrology software to study folders.

`base` holds the base class of formats and their registry, `formats` one module per format;
`export` splits a text into cells, `columns` and `units` read its header, `points` its coordinates
and `positions` the places of the machine; `recognise` finds the format of a file, and `writing`
writes the study folder. Uses the study room and everything below; the command line stands on it.
"""

from . import formats
from .base import FORMATS, Format, Options
from .writing import Imported, import_study, summary

__all__ = ["FORMATS", "Format", "Imported", "Options", "formats", "import_study", "summary"]
