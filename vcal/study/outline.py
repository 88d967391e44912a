"""What a refused study declares, as far as it can be read: for the picture of its machine."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StudyError
from ..geometry.declared_machine import Measured
from ..instruments.base import InstrumentSettings
from ..instruments.conditions import linear_plan
from ..instruments.several import with_tool
from ..machine.chain import Chain
from ..words import printable
from .consent import require_inside
from .declared_chain import build_chain
from .folder import Folder
from .plugins.instruments import instrument_class, readings_of
from .settings import AnySettings, StudySettings, validate
from .tables import run_table
from .toml_file import read_setup

_NOT_BUILT = (StudyError, ArithmeticError, LookupError, ValueError, np.linalg.LinAlgError)
"""Errors of instruments with data that they refuse."""


@dataclass(frozen=True)
class Outline:
    """The machine of a study that was refused, and those of its data sets that could be read."""

    name: str
    path: Path
    """The study file."""
    chain: Chain
    sets: tuple[Measured, ...]
    hashes: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of every input file that was read, by name."""


def outline(
    path: Path | str,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    *,
    allow_outside: bool = False,
) -> Outline | None:
    """The declared machine of a study that `load_study` refuses, and the tables of its data sets
    without the checks of their readings; None where the study file itself is refused.

    Python files that the study names are not run, unless the user has trusted them before.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "setup.toml"
    folder = Folder(path.parent, outside=allow_outside)
    try:
        require_inside(folder.root, path.name, allowed=allow_outside)
        raw, given = read_setup(path, overrides)
        folder.path(path.name)
        settings = validate(raw, path.name, given, folder)
        chain = build_chain(settings.machine, path.name, folder)
    except StudyError:
        return None
    found = []
    for name, file, instrument, own in _tables(settings, chain):
        with contextlib.suppress(*_NOT_BUILT):
            found.append(_measured(name, file, instrument, own, folder, path.name))
    name = printable(settings.name or path.resolve().parent.name, lines=False)
    return Outline(name, path, chain, tuple(found), folder.hashes)


def _tables(
    settings: AnySettings, chain: Chain
) -> Iterator[tuple[str, str, InstrumentSettings, Chain]]:
    """Name, table, instrument and machine of every data set."""
    if isinstance(settings, StudySettings):
        yield "", settings.data.table, settings.instrument, chain
        return
    for row in settings.data:
        own = chain
        if row.tool_offset_mm is not None:
            offset = np.array(row.tool_offset_mm) * 1e-3
            own = with_tool(chain, offset - np.asarray(chain.tool_offset))
        yield row.name, row.file, row.instrument, own


def _measured(
    name: str, file: str, settings: InstrumentSettings, chain: Chain, folder: Folder, study: str
) -> Measured:
    """A data set whose instrument is built without its readings, which it may refuse."""
    table, measured = run_table(file, settings, chain, folder, study, "")
    kind, whole = instrument_class(settings, folder), table.complete
    readings_in = readings_of(settings, kind, chain.axes)
    bare = {column: values for column, values in whole.items() if column not in readings_in}
    words = settings.kind.replace("_", " ")
    try:
        instrument = kind.build(settings, chain, bare, folder.table)
        plan = instrument.plan(chain, bare)
    except _NOT_BUILT:
        plan = linear_plan(chain, bare)
        return Measured(name, words, chain, None, None, plan, None)
    started, readings = instrument, None
    if measured and readings_in:
        with contextlib.suppress(*_NOT_BUILT):
            found = instrument.measured(whole)
            started, readings = instrument.start(chain, plan, found), found
    return Measured(name, words, chain, instrument, started, plan, readings)
