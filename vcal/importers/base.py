"""The base class of formats, their registry, what they need of the user and what they yield."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..machine.chain import Chain
from ..registry import Catalogue
from ..study.messages import refusal
from .export import Export

FORMATS: Catalogue[type["Format"]] = Catalogue("format")
"""All formats by name."""
register = FORMATS.register
"""Class decorator that registers a format under its name."""

SURE, LIKELY, POSSIBLE, NO = 1.0, 0.8, 0.5, 0.0
"""What `Format.sniff` answers: a mark that only this format has; columns of this format; numbers
that may be of this format; none of it."""

Columns = Mapping[str, np.ndarray | Sequence[str]]
"""Columns of a table of the study by name."""


@dataclass(frozen=True)
class Options:
    """What the user says about an export that the file itself does not."""

    unit: str | None = None
    """Unit of the lengths without a unit of their own, a key of `LENGTHS_MM`."""
    angle_unit: str | None = None
    """Unit of the angles without a unit of their own, a key of `ANGLES_RAD`."""
    angles: str | None = None
    """The two angles of spherical coordinates in the order of their columns, such as
    ``"azimuth,zenith"``."""
    time_format: str | None = None
    """Format of time stamps, as in `strptime`."""
    positions: Path | None = None
    """Table of the positions of the axes or joints at the points of the export."""
    axis: str | None = None
    """Axis or error motion of an interferometer, or plane of a ball-bar record, where the file
    names none."""
    at_mm: Mapping[str, float] = field(default_factory=dict)
    """Positions of the axes that stand still, or of the centre of a circle, by axis; mm or deg."""
    deviation_unit: str | None = None
    """Unit of deviations without a unit of their own."""
    artefact: Path | None = None
    """Table of the calibrated centres of balls."""
    contacts: int | None = None
    """Number of contacts of a probe with each ball."""
    given: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the instrument that the user has set, such as the length of a bar."""


class Needs:
    """What an import lacks: collected while the files are read, and reported in one message."""

    def __init__(self) -> None:
        self._found: dict[str, str] = {}

    def add(self, option: str, what: str) -> None:
        """Record that `option` is needed, and the reason."""
        self._found.setdefault(option, what)

    def check(self, file: str) -> None:
        """Raise `StudyError` where something is lacking."""
        if self._found:
            each = "; ".join(f"{option} ({what})" for option, what in self._found.items())
            raise refusal(
                file,
                "options",
                "nothing that says what the file does not hold",
                each,
                f"add {'it' if len(self._found) == 1 else 'them'} to the command",
            )

    def __bool__(self) -> bool:
        return bool(self._found)


@dataclass(frozen=True)
class Machine:
    """The declared machine."""

    tree: Mapping[str, Any]
    """Its ``[machine]`` table."""
    chain: Chain
    """The chain built from it."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Files that the table names."""

    @property
    def arm(self) -> bool:
        """Whether it is an arm of joints, not a machine tool."""
        return "chain" not in self.tree


@dataclass(frozen=True)
class DataSet:
    """One table of the study with its instrument."""

    name: str
    """Name of the data set where there are several."""
    instrument: Mapping[str, Any]
    """Its ``[instrument]`` table, without keys that only the user knows."""
    columns: Columns
    """Columns of the table in vcal's names and units."""
    needed: Mapping[str, str] = field(default_factory=dict)
    """Keys of `instrument` that only the user knows, each with its meaning and unit."""
    notes: Sequence[str] = ()
    """What was converted, left out or assumed, one sentence each."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Further files that the instrument names."""


class Format(abc.ABC):
    """One format of exports: how to recognise and how to read it."""

    name: ClassVar[str]
    """Name in `--format`."""
    summary: ClassVar[str]
    """What it holds, in one line."""
    needs: ClassVar[str]
    """What the user has to give."""
    source: ClassVar[str]
    """The public documentation that the reader follows."""
    undocumented: ClassVar[str]
    """What that documentation leaves open, and how the reader decides it."""
    keys: ClassVar[Mapping[str, str]] = {}
    """Keys of the instrument that only the user knows, each with its meaning and unit."""
    joined: ClassVar[str] = ""
    """Kind of the instrument whose files become one data set; empty where each file is its own."""
    levers: ClassVar[bool] = False
    """Whether it needs the tool offset of a machine tool."""

    @abc.abstractmethod
    def sniff(self, export: Export) -> float:
        """How sure it is that a file is of this format, from 0 to 1 (`SURE`, `LIKELY`, ...)."""

    def machine(self, export: Export) -> Mapping[str, Any] | None:
        """The ``[machine]`` table that the file declares; None where it declares none."""
        del export
        return None

    @abc.abstractmethod
    def read(
        self, export: Export, options: Options, machine: Machine | None, needs: Needs
    ) -> Sequence[DataSet]:
        """The data sets of one file.

        What the file lacks and the options do not give is added to `needs`; the reader then goes
        on with any value, or returns early. Raises `StudyError` for a file that is not of the
        format.
        """


def joined(one: DataSet, more: Sequence[DataSet]) -> DataSet:
    """One data set of several files of one instrument. Columns that are missing in a file hold
    blank readings there; ``line``, ``setup`` and ``run`` go on counting.
    """
    for other in more:
        columns: dict[str, np.ndarray] = {}
        rows = [len(next(iter(part.columns.values()))) for part in (one, other)]
        for name in dict.fromkeys([*one.columns, *other.columns]):
            parts = [
                np.asarray(part.columns[name]) if name in part.columns else np.full(count, np.nan)
                for part, count in zip((one, other), rows, strict=True)
            ]
            if name in ("line", "setup", "run"):
                parts[1] = parts[1] + int(parts[0].max()) + 1
            columns[name] = np.concatenate(parts)
        notes = [*one.notes, *(note for note in other.notes if note not in one.notes)]
        one = replace(one, columns=columns, notes=notes, needed={**one.needed, **other.needed})
    return one
