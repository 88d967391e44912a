"""The data sets of a study: tables that were read, with their instruments and plans."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np

from ..errors import KeyedError, RowError
from ..instruments.base import Instrument, InstrumentSettings, TableInstrument
from ..instruments.conditions import LINEAR, file_name
from ..instruments.several import DataSet as Member
from ..instruments.several import several, with_tool
from ..machine.chain import Chain
from ..machine.plan import Plan
from .csv_table import Table
from .declared_chain import check_offset
from .folder import Folder
from .messages import listed, refusal, stated
from .plugins.instrument_trial import check_instrument
from .plugins.instruments import (
    calling,
    check_built,
    check_plan,
    check_readings,
    check_row,
    instrument_class,
    readings_of,
)
from .settings import (
    AnySettings,
    SeveralSettings,
    StudySettings,
)
from .table_checks import check_alive, check_scatter
from .tables import run_table


@dataclass(frozen=True)
class DataSet:
    """One table of a study with its instrument."""

    name: str
    """Name of the data set; empty in a study of one data set."""
    file: str
    """The table in the study folder."""
    settings: InstrumentSettings
    """Its ``[instrument]``."""
    instrument: TableInstrument
    """The instrument, with starting values from the readings where there are any."""
    chain: Chain
    """The machine with the tool of this data set."""
    plan: Plan
    readings: np.ndarray | None
    """Readings (n, m), SI; None for a table without columns of readings."""
    table: Table
    """The whole table, including the rows with a blank reading, which the plan leaves out; of a
    recording that is averaged, its averages with the numbers of their first samples.
    """
    tool: str = ""
    """Name of the tool that it shares with other data sets; empty for one of its own."""
    declared: TableInstrument | None = None
    """The instrument as declared, before its starting values."""

    @property
    def label(self) -> str:
        """The kind of the instrument in words, after the name of the data set if it has one."""
        kind = self.settings.kind.replace("_", " ")
        return f"{self.name}: {kind}" if self.name else kind


def data_sets(
    settings: AnySettings, chain: Chain, folder: Folder, file: str
) -> tuple[DataSet, ...]:
    """The data sets with their tables read and their instruments built."""
    if isinstance(settings, StudySettings):
        return (_data_set("", settings.data.table, settings.instrument, chain, folder, file),)
    found = []
    for i, row in enumerate(settings.data):
        if row.name in chain.axes:
            raise refusal(
                file,
                f"key data.{i}.name",
                f"{row.name!r}, the name of an axis",
                f"another name than {listed(chain.axes)}",
                "rename the data set",
            )
        own = chain
        if row.tool_offset_mm is not None:
            check_offset(row.tool_offset_mm, chain, file, f"data.{i}.tool_offset_mm")
            offset = np.array(row.tool_offset_mm) * 1e-3
            own = with_tool(chain, offset - np.asarray(chain.tool_offset))
        one = _data_set(row.name, row.file, row.instrument, own, folder, file, f"data.{i}.")
        if "t" in one.plan.covariates:
            later = {"t": np.asarray(one.plan.covariates["t"]) + row.start_s}
            one = replace(one, plan=replace(one.plan, covariates={**one.plan.covariates, **later}))
        _check_twice(one, found, folder, file, f"data.{i}.file")
        found.append(one)
    without = [one for one in found if one.readings is None]
    if without and len(without) < len(found):
        raise refusal(
            without[0].file,
            "header",
            "no column of readings",
            f"the readings of a {without[0].settings.kind}, as the other data sets have readings",
            "add them, or remove this data set",
        )
    return _with_shared_tools(settings, found, file)


def _with_shared_tools(
    settings: SeveralSettings, sets: Sequence[DataSet], file: str
) -> tuple[DataSet, ...]:
    """The data sets, those with the same tool with the same initial positions of its reflectors.

    Raises `StudyError` for an instrument without anything on the tool, and for tools of one name
    that differ.
    """
    found = list(sets)
    first: dict[str, int] = {}
    for i, (row, one) in enumerate(zip(settings.data, sets, strict=True)):
        if row.tool is None:
            continue
        k = first.setdefault(row.tool, i)
        other = sets[k]
        if not one.instrument.on_tool:
            raise refusal(
                file,
                f"key data.{i}.tool",
                f"{row.tool!r} for a {one.settings.kind}, which has nothing on the tool",
                "a tool for the reflectors of an arm only",
                "remove the key",
            )
        try:
            if one.settings.kind != other.settings.kind:
                raise ValueError(f"a {one.settings.kind} in place of a {other.settings.kind}")
            if (one.chain.tool_offset != other.chain.tool_offset).any():
                raise ValueError("another tool_offset_mm")
            again = one.instrument.with_tool_of(other.instrument, one.chain, one.plan, one.readings)
        except ValueError as error:
            raise refusal(
                file,
                f"key data.{i}.tool",
                f"{row.tool!r} with {error}",
                f"the same as in {other.name}",
                "correct it, or give the tool another name",
            ) from error
        if k != i:
            found[i] = replace(one, instrument=again)
    return tuple(
        replace(one, tool=row.tool or "") for one, row in zip(found, settings.data, strict=True)
    )


def _check_twice(
    one: DataSet, earlier: Sequence[DataSet], folder: Folder, file: str, key: str
) -> None:
    """Raise `StudyError` where a table of readings is named twice, also under another name."""
    for other in earlier:
        files = [folder.plain(each.file) for each in (one, other)]
        same = (folder.root / files[0]).samefile(folder.root / files[1])
        alike = folder.hashes[files[0]] == folder.hashes[files[1]]
        # Two sheets of one spreadsheet are two tables.
        if one.table.kind == other.table.kind and (same or one.readings is not None and alike):
            again = " a second time" if one.file == other.file else f", the same as {other.file!r}"
            raise refusal(
                file,
                f"key {key}",
                f"{one.file!r}{again}",
                "a table of its own for every data set, as its readings would count twice",
                "correct the name, or remove the row",
            )


def _data_set(
    name: str,
    table_name: str,
    settings: InstrumentSettings,
    chain: Chain,
    folder: Folder,
    file: str,
    key: str = "",
) -> DataSet:
    """One data set; `key` is its place in the study file."""
    kind = instrument_class(settings, folder)
    settings = kind.recognised(settings, folder.written(table_name))
    table, measured = run_table(table_name, settings, chain, folder, file, key)
    try:
        with _naming_rows(settings, folder, table.complete):
            declared, instrument, plan, readings, rows = _instrument(
                settings, chain, table, measured, folder
            )
    except KeyedError as error:
        own = key if error.key.startswith("instrument.") else ""
        raise stated(file, f"key {own}{error.key}", error.what) from error
    if rows is not None:
        blank, table = table.blank_rows, table.complete.taken(rows)
        table.left_out = blank
        made = instrument.to_table(plan, np.asarray(readings))
        table.update({column: made[column] for column in table if column in made})
    return DataSet(
        name, table_name, settings, instrument, chain, plan, readings, table, declared=declared
    )


@contextlib.contextmanager
def _naming_rows(settings: InstrumentSettings, folder: Folder, table: Table) -> Iterator[None]:
    """Replace the row index of a `RowError` of an instrument by the row and line of the file."""
    try:
        yield
    except RowError as error:
        check_row(settings, instrument_class(settings, folder), error.row, table.rows)
        place = f", {error.place}" if error.place else ""
        where = f"{table.where(error.row)}{place}"
        raise stated(table.name, where, error.what) from error


def _instrument(
    settings: InstrumentSettings, chain: Chain, whole: Table, measured: bool, folder: Folder
) -> tuple[TableInstrument, TableInstrument, Plan, np.ndarray | None, np.ndarray | None]:
    """The instrument of a table as declared, and with starting values from its readings; the plan
    and the readings of the rows without a blank reading. Where these are means of several rows,
    also the first of each; otherwise None.
    """
    kind, table = instrument_class(settings, folder), whole.complete
    if measured:
        own = readings_of(settings, kind, chain.axes)
        places = [file_name(axis, chain.axes) for axis in chain.axes if axis in LINEAR]
        check_alive(table, (own or {*places}) - {*kind.steady}, settings.kind)
    with calling(settings, kind, "build", f"an instance of {kind.__name__}"):
        instrument = kind.build(settings, chain, table, folder.table)
    check_built(settings, kind, instrument, "build")
    # If positions are the readings, they are unknown in rows with a blank one.
    remembers = kind.remembers and bool(readings_of(settings, kind, chain.axes))
    if table is not whole and remembers:
        expected = "a vcal.Plan, also of the rows with a blank reading"
        with _naming_rows(settings, folder, whole), calling(settings, kind, "plan", expected):
            plan = instrument.plan(chain, whole)
        check_plan(settings, kind, chain, whole, plan)
        plan = jax.tree.map(lambda values: np.asarray(values)[~whole.blank], plan)
    else:
        plan = _planned(settings, instrument, chain, table)
    if table is not whole:
        plan = replace(plan, numbers=np.array(table.numbers))
    declared, readings, every, rows, used = instrument, None, None, None, plan
    if measured:
        with calling(settings, kind, "measured", "readings in SI from the columns of the table"):
            readings = instrument.measured(table)
        check_readings(settings, instrument, plan, readings)
        every = readings
        with calling(settings, kind, "summarised", "a Summary, or None"):
            summary = instrument.summarised(plan, readings)
        if summary is not None:
            declared = instrument = summary.instrument
            used, rows = summary.plan, summary.rows
            readings = summary.readings
        with calling(settings, kind, "start", "the same instrument"):
            instrument = instrument.start(chain, used, readings)
        check_built(settings, kind, instrument, "start")
    if settings.kind_file is not None:
        # The trial needs a plan of the complete rows only.
        alone = _planned(settings, instrument, chain, table)
        check_instrument(settings, instrument, chain, table, alone, readings)
    if every is not None:
        check_scatter(table, readings_of(settings, kind, chain.axes), instrument, plan, every)
    return declared, instrument, used, readings, rows


def _planned(
    settings: InstrumentSettings, instrument: TableInstrument, chain: Chain, table: Table
) -> Plan:
    """The checked plan of a table."""
    with calling(settings, type(instrument), "plan", "a vcal.Plan"):
        plan = instrument.plan(chain, table)
    check_plan(settings, type(instrument), chain, table, plan)
    return plan


def together(sets: Sequence[DataSet], chain: Chain) -> tuple[Instrument, Plan, np.ndarray | None]:
    """Instrument, plan and readings of all data sets."""
    if not sets[0].name:
        return sets[0].instrument, sets[0].plan, sets[0].readings
    members = {
        one.name: Member(
            one.instrument,
            one.plan,
            tuple(np.asarray(one.chain.tool_offset) - np.asarray(chain.tool_offset)),
            one.tool,
        )
        for one in sets
    }
    instrument, plan = several(members)
    tables = [one.readings for one in sets if one.readings is not None]
    return instrument, plan, instrument.padded(tables) if tables else None
