"""A study: the machine, instrument, model and data of one folder, read, checked and built."""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..effects.base import Effect
from ..effects.registry import CATALOGUE
from ..errors import KeyedError, RowError, StudyError
from ..identification.rank import flat_rank
from ..instruments.base import Instrument, InstrumentSettings, TableInstrument
from ..instruments.conditions import LINEAR, file_name
from ..instruments.several import DataSet as Member
from ..instruments.several import several, with_tool
from ..machine.chain import Chain, chain_from_dh, chain_from_string
from ..machine.plan import Plan
from ..model.forward import Model
from ..model.measurement import CheckPoints, Measurement
from ..numerics.spatial import require_float64
from ..registry import nearest
from ..words import counted, plural, printable
from .consent import require_inside
from .csv_table import Table
from .declared_effects import catalogue_with, declared_effects, unknown_effect
from .folder import Folder
from .geometric_family import geometric_errors
from .hold_out import held_out
from .messages import FEW, listed, refusal, source, stated
from .must_see import check_identifiable
from .plugins.effects import check_own
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
from .previous_campaign import with_posterior
from .settings import (
    AnySettings,
    LoopSettings,
    MachineSettings,
    SeveralSettings,
    StudySettings,
    table_formats,
    validate,
)
from .table_checks import check_alive, check_scatter
from .tables import check_points, run_table
from .toml_file import read_setup
from .urdf import chain_from_urdf

_SHORTEST_MM = 0.1
"""Least travel; a smaller number is in another unit."""
_MOST_TOOL, _LEAST_LONG_TOOL_MM = 2.0, 1000.0
"""Largest size of a tool offset as a multiple of the size of the machine: the diagonal of its
travel, or the length of all links of an arm. A tool of less than a metre may be on any machine.
"""
_LEAST_TOOL = 1e-3
"""Least share of the shortest travel; a tool offset that is smaller but not zero is in another
unit.
"""


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
    """The whole table, including the rows with a blank reading, which the plan leaves out."""
    tool: str = ""
    """Name of the tool that it shares with other data sets; empty for one of its own."""
    declared: TableInstrument | None = None
    """The instrument as declared, before its starting values."""

    @property
    def label(self) -> str:
        """The kind of the instrument in words, after the name of the data set if it has one."""
        kind = self.settings.kind.replace("_", " ")
        return f"{self.name}: {kind}" if self.name else kind


@dataclass(frozen=True)
class Study:
    """A machine, its instruments, the declared model of their errors, and the measurement."""

    name: str
    path: Path
    """The study file."""
    settings: AnySettings
    """The settings of the study file, with overrides and defaults."""
    chain: Chain
    sets: tuple[DataSet, ...]
    """The data set, or those of the ``[[data]]`` rows."""
    instrument: Instrument
    """The instrument of all data sets together, with starting values from the readings."""
    model: Model
    """The declared model: geometric errors, effects of the instrument, declared effects."""
    plan: Plan
    measurement: Measurement | None
    """The readings with their plan; None for a table without columns of readings."""
    check: CheckPoints | None
    """Independent check points; None without any."""
    catalogue: Mapping[str, type[Effect]]
    """Effects by name that the loop may test, including those of the user's own file."""
    hashes: Mapping[str, str]
    """SHA-256 of every input file by name."""
    tables: Mapping[str, Table] = field(default_factory=dict)
    """Every table as it was read, by the name that the study gives it."""
    trust: bool = False
    """Whether the Python files that it names may be run."""
    allow_outside: bool = False
    """Whether files outside its folder may be read."""

    def __repr__(self) -> str:
        kinds = ", ".join(one.settings.kind for one in self.sets)
        readings = "no readings" if self.measurement is None else f"{self.plan.rows} rows"
        check = "" if self.check is None else f", {self.check.plan.rows} check points"
        return f"Study({self.name!r}: {self.chain.text}, {kinds}, {readings}{check})"

    @property
    def single(self) -> StudySettings:
        """The settings of a study of one data set.

        Raises `StudyError` for several data sets, for callers that need a single one.
        """
        if isinstance(self.settings, StudySettings):
            return self.settings
        raise refusal(
            self.path.name,
            "key data",
            f"{len(self.sets)} [[data]] rows ({listed(one.name for one in self.sets)})",
            "a single data set, as `vcal design` supports only one",
            "write a study of one of them, with its [instrument]",
        )

    @property
    def one(self) -> DataSet:
        """The data set of a study of one data set; raises `StudyError` as `single` does."""
        _ = self.single
        return self.sets[0]

    @property
    def observers(self) -> tuple[str, str]:
        """``"Instrument"`` or ``"Instruments"``, and their kinds in words."""
        return plural(len(self.sets), "Instrument"), "; ".join(one.label for one in self.sets)

    @property
    def observations(self) -> str:
        """Numbers of observations and of readings, in words."""
        return "; ".join(
            f"{counted(one.plan.rows, 'observation')} of "
            f"{counted(len(one.instrument.readings), 'reading')}"
            + (f" ({count} more with a blank reading left out)" if count else "")
            for one in self.sets
            for count in [len(one.table.blank_rows)]
        )

    @property
    def files(self) -> dict[str, str]:
        """The table of every data set by its name; by the empty name for a single data set."""
        return {one.name: one.file for one in self.sets}

    @property
    def check_file(self) -> str:
        """Name of the table of check points, which need not exist."""
        return _check_given(self.settings) or "check.csv"

    @property
    def folder(self) -> Path:
        """The folder of the study file and of its tables."""
        return self.path.parent

    @property
    def options(self) -> LoopSettings:
        """Settings of the loop."""
        return self.settings.loop

    @property
    def tried(self) -> list[type[Effect]]:
        """The effects that the loop tests: those named in its settings, or the whole catalogue."""
        if self.options.effects:
            return [self.catalogue[name] for name in self.options.effects]
        return list(self.catalogue.values())

    @property
    def as_dict(self) -> dict[str, Any]:
        """The settings as plain values, for reports."""
        return self.settings.model_dump()


def load_study(
    path: Path | str,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    *,
    trust: bool = False,
    allow_outside: bool = False,
) -> Study:
    """Read a study file, or the ``setup.toml`` of a folder, and all files that it names.

    `overrides` replace keys before the checks: texts such as ``"instrument.joints=read"``, or a
    mapping of keys to values. Python files with effects and instruments of the user's own are run
    with `trust`, where they lie in a folder that the user's settings trust, or where the same
    contents were trusted before at this path. Other files must lie in the folder of the study,
    unless `allow_outside` is set. Raises `StudyError` for every mistake in the input, and
    `RuntimeError` where JAX runs in float32.
    """
    require_float64()
    path = Path(path)
    if path.is_dir():
        path = path / "setup.toml"
    file = path.name
    folder = Folder(path.parent, trust, allow_outside)
    require_inside(folder.root, file, allowed=allow_outside)
    raw, given = read_setup(path, overrides)
    folder.path(file)
    folder.keys.update(_naming(raw, file))
    settings = validate(raw, file, given, folder)
    for name, key in _naming(settings.model_dump(by_alias=True), file, " by default").items():
        folder.keys.setdefault(name, key)
    folder.formats.update(table_formats(settings, file))
    catalogue = catalogue_with(folder, settings.model.effects_file)
    _check_wanted(settings.loop.effects or (), catalogue, file, given)
    chain = build_chain(settings.machine, file, folder)
    sets = _data_sets(settings, chain, folder, file)
    instrument, plan, readings = together(sets, chain)
    measurement = None
    if readings is not None:
        blank = {one.file: rows for one in sets if (rows := one.table.blank_rows)}
        measurement = Measurement(
            plan, readings, printable(settings.name or path.parent.name, lines=False), blank=blank
        )
    model = Model(chain, instrument)
    if settings.model.geometric is not None:
        errors: Effect = geometric_errors(settings.model.geometric, chain, folder, file)
        if settings.model.previous is not None:
            errors = with_posterior(errors, settings.model.previous, chain, folder, file)
        model = model.with_effects(errors)
    elif settings.model.previous is not None:
        raise refusal(
            file,
            "key model.from",
            "it without [model.geometric]",
            "the [model.geometric] of that campaign",
            "add it, or remove the key",
        )
    model = model.with_effects(*instrument.effects(plan))
    files = {one.name: one.file for one in sets}
    model = model.with_effects(
        *declared_effects(settings.model.effect, catalogue, model.setup(plan), file, files)
    )
    if settings.model.effects_file is not None:
        own = {name: kind for name, kind in catalogue.items() if name not in CATALOGUE}
        check_own(settings.model.effects_file, own, model.setup(plan), plan)
    if not model.entries:
        raise refusal(
            file,
            "tables instrument and model",
            "no parameter, neither of the machine, nor of an effect, nor of the instrument",
            "at least one parameter to identify",
            "add [model.geometric] or an effect",
        )
    _check_size(model, plan, listed(files.values()), measurement is not None)
    _check_determined(model, plan, listed(files.values()))
    if measurement is not None:
        headers = {one.name: tuple(one.table) for one in sets}
        chosen = held_out(settings.holdout, model, measurement, file, headers)
        measurement = replace(measurement, holdout=chosen)
        _check_fitted(model, measurement, listed(files.values()), settings.holdout is not None)
    _check_seen(settings, sets, file)
    check = _checked(settings, chain, sets, folder)
    _check_formats(settings, folder, file)
    return Study(
        name=printable(settings.name or path.resolve().parent.name, lines=False),
        path=path,
        settings=settings,
        chain=chain,
        sets=sets,
        instrument=instrument,
        model=model,
        plan=plan,
        measurement=measurement,
        check=check,
        catalogue=catalogue,
        hashes=folder.hashes,
        tables=folder.tables,
        trust=trust,
        allow_outside=allow_outside,
    )


def _naming(tree: Any, file: str, how: str = "") -> dict[str, str]:
    """The key of every text in the tree of a study file, in words, by the text; and by the text
    without a sheet (``run.xlsx#check``). The first key of a text counts.
    """
    found: dict[str, str] = {}
    stack = [("", tree)]
    while stack:
        key, value = stack.pop()
        if isinstance(value, str):
            for name in (value, value.rpartition("#")[0]):
                found[name] = f"key {key} of {file}{how}"
        elif isinstance(value, Mapping | list | tuple):
            items = value.items() if isinstance(value, Mapping) else enumerate(value)
            stack += [(f"{key}.{part}" if key else str(part), inner) for part, inner in items]
    found.pop("", None)
    return found


def looked_for(kind: type[Effect]) -> bool:
    """Whether the loop may name an effect; others can only be declared."""
    return kind.kind == "systematic" and kind.candidates.__func__ is not Effect.candidates.__func__


def _check_wanted(
    names: Sequence[str],
    catalogue: Mapping[str, type[Effect]],
    file: str,
    overrides: Mapping[str, str],
) -> None:
    """Effects that are to be tried must be known, and such as the loop looks for."""
    for i, name in enumerate(names):
        if name in catalogue and looked_for(catalogue[name]):
            continue
        where = source(file, "loop.effects", overrides)
        choice = {n: kind for n, kind in catalogue.items() if looked_for(kind)}
        if name in catalogue:
            raise refusal(
                where,
                f"key loop.effects.{i}",
                f"{name!r}, which can only be declared",
                f"one of {listed(sorted(choice), 60)}",
                "leave it out",
            )
        plain = name.partition(":")[0]
        if plain in choice:
            raise refusal(
                where,
                f"key loop.effects.{i}",
                repr(name),
                f"the name alone, {plain!r}: the loop tries it at every place",
                "correct the name",
            )
        raise unknown_effect(name, choice, where, f"loop.effects.{i}")


def build_chain(machine: MachineSettings, file: str, folder: Folder) -> Chain:
    """The chain of a ``[machine]``, whose files are in `folder`; raises `StudyError` that names the
    key in `file`.
    """
    offset = [v * 1e-3 for v in machine.tool_offset_mm]
    if machine.urdf is not None:
        return _from_urdf(machine, machine.urdf, offset, file, folder)
    if machine.chain is None:
        rows = []
        for joint in machine.joint:
            factor = math.radians(1.0) if joint.type == "revolute" else 1e-3
            low, high = (bound * factor for bound in joint.bounds)
            rows.append(
                {
                    "type": joint.type,
                    "a": joint.a_mm * 1e-3,
                    "d": joint.d_mm * 1e-3,
                    "alpha": math.radians(joint.alpha_deg),
                    "theta": math.radians(joint.theta_deg),
                    "low": low,
                    "high": high,
                }
            )
        try:
            coupling = _coupling_si(machine, [joint.type == "revolute" for joint in machine.joint])
            arm = chain_from_dh(rows, offset, machine.up, machine.convention, coupling)
        except ValueError as error:
            raise _wrong_coupling(error, file) from error
        _check_offset(machine.tool_offset_mm, arm, file, "machine.tool_offset_mm")
        return arm
    travel = {axis: (low * 1e-3, high * 1e-3) for axis, (low, high) in machine.travel_mm.items()}
    rotary = {}
    for axis, row in machine.rotary.items():
        rotary[axis] = [v * 1e-3 for v in row.at_mm]
        if row.travel_deg is not None:
            low, high = row.travel_deg
            travel[axis] = math.radians(low), math.radians(high)
    _check_rotary(machine, file)
    try:
        chain = chain_from_string(machine.chain, travel, offset, rotary, machine.up)
    except ValueError as error:
        found, _, expected = str(error).rpartition("expected ")
        raise refusal(
            file,
            "key machine.chain",
            f"an impossible {found.rstrip(';: ')}",
            expected,
            "correct the chain",
        ) from error
    linear = [joint.name for joint in chain.joints if not joint.turns]
    for axis, (low, high) in machine.travel_mm.items():
        if axis not in linear:
            raise refusal(
                file,
                f"key machine.travel_mm.{axis}",
                f"the unknown axis {axis!r}{nearest(axis, linear)}"
                if axis not in chain.axes
                else f"millimetres of travel of the rotary axis {axis}",
                f"one of {listed(linear)}, the linear axes of the chain {chain.text!r}"
                + (f"; travel_deg in [machine.rotary.{axis}]" if axis in chain.axes else ""),
                "correct or remove the key",
            )
        if not low < high:
            raise refusal(
                file,
                f"key machine.travel_mm.{axis}",
                f"[{low:g}, {high:g}]",
                "[lowest, highest] with the lowest below the highest",
                "exchange or correct them",
            )
        if high - low < _SHORTEST_MM:
            raise refusal(
                file,
                f"key machine.travel_mm.{axis}",
                f"[{low:g}, {high:g}]",
                f"at least {_SHORTEST_MM:g} mm of travel",
                "correct the unit",
            )
    _check_offset(machine.tool_offset_mm, chain, file, "machine.tool_offset_mm")
    return chain


def _from_urdf(
    machine: MachineSettings, name: str, offset: Sequence[float], file: str, folder: Folder
) -> Chain:
    """The chain of a URDF file."""
    path = folder.path(name, "a URDF file")

    def read(coupling: np.ndarray | None) -> Chain:
        return chain_from_urdf(
            path,
            name,
            file,
            base_link=machine.base_link,
            tip_link=machine.tip_link,
            tool_offset_m=offset,
            up=machine.up,
            coupling=coupling,
        )

    chain = read(None)
    if machine.coupling is None:
        return chain
    try:
        return read(_coupling_si(machine, [joint.turns for joint in chain.joints]))
    except ValueError as error:
        raise _wrong_coupling(error, file) from error


def _wrong_coupling(error: ValueError, file: str) -> StudyError:
    found, _, expected = str(error).partition(", expected ")
    return refusal(
        file,
        "key machine.coupling",
        found.removeprefix("found "),
        expected.partition(";")[0],
        "correct the matrix",
    )


def _coupling_si(machine: MachineSettings, turning: Sequence[bool]) -> np.ndarray | None:
    """The matrix from commands to joint variables in SI, from that between the file's units; the
    joints are `turning` or slide.
    """
    if machine.coupling is None:
        return None
    count, rows = len(turning), {len(row) for row in machine.coupling}
    if rows != {count} or len(machine.coupling) != count:
        raise ValueError(
            f"found {len(machine.coupling)} rows of {listed(str(n) for n in sorted(rows))} "
            f"numbers, expected {count} rows of {count} numbers, one row and one column for every "
            "joint"
        )
    units = np.array([math.radians(1.0) if turns else 1e-3 for turns in turning])
    return units[:, None] * np.array(machine.coupling) / units


def _check_offset(offset: Sequence[float], chain: Chain, file: str, key: str) -> None:
    """Raise `StudyError` for a tool offset that is probably in metres.

    Its levers are then a thousandth of the true ones, and no reading need contradict it.
    """
    travels = [np.ptp(j.travel) * 1e3 for j in chain.joints if not j.turns]
    large, size = largest_tool(chain), float(np.linalg.norm(offset))
    if size > large:
        raise refusal(
            file,
            f"key {key}",
            f"{[*offset]}, {size:.4g} mm in all",
            f"at most {large:.4g} mm, {_MOST_TOOL:g} times the size of the machine",
            "correct the offset or its unit, or the travel or the links of the machine: a tool is "
            "not larger than the machine that carries it",
        )
    reach = min((travel for travel in travels if math.isfinite(travel)), default=0.0)
    if chain.arm or not 0.0 < np.abs(offset).max() < _LEAST_TOOL * reach:
        return
    raise refusal(
        file,
        f"key {key}",
        f"{[*offset]}, less than a thousandth of the travel",
        "millimetres from the frame of the last axis to the tool point",
        "correct the unit, or write [0, 0, 0] if the tool point is the origin of that frame",
    )


def largest_tool(chain: Chain) -> float:
    """The largest plausible tool offset, mm; infinite where the size of the machine is unknown."""
    if chain.arm:
        links = [part[:3, 3] for joint in chain.joints for part in (joint.before, joint.after)]
        parts = [np.linalg.norm(link) for link in links]
        parts += [np.ptp(joint.travel) for joint in chain.joints if not joint.turns]
        size = 1e3 * float(np.sum(parts))
    else:
        parts = [np.ptp(joint.travel) for joint in chain.joints if not joint.turns]
        size = 1e3 * float(np.linalg.norm(parts))
    return max(_MOST_TOOL * size, _LEAST_LONG_TOOL_MM) if math.isfinite(size) else math.inf


def _check_rotary(machine: MachineSettings, file: str) -> None:
    """Raise `StudyError` unless every rotary axis of the chain has a table ``[machine.rotary.*]``,
    and every such table an axis in the chain.
    """
    in_chain = [axis for axis in re.findall(r"[A-Z]", machine.chain or "") if axis in "ABC"]
    for axis in in_chain:
        if axis not in machine.rotary:
            raise refusal(
                file,
                f"key machine.rotary.{axis}",
                "nothing",
                f"the position of the rotary axis {axis} of the chain, with all axes at zero",
                f"add [machine.rotary.{axis}] with at_mm = [x, y, z], a point on the axis, and "
                "travel_deg = [lowest, highest]",
            )
    for axis in machine.rotary:
        if axis not in in_chain:
            raise refusal(
                file,
                f"key machine.rotary.{axis}",
                f"a rotary axis that is not in the chain {machine.chain!r}",
                f"one of {listed(in_chain)}" if in_chain else "no rotary axis",
                "add it to the chain, or remove the table",
            )


def _data_sets(
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
            _check_offset(row.tool_offset_mm, chain, file, f"data.{i}.tool_offset_mm")
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
            declared, instrument, plan, readings = _instrument(
                settings, chain, table, measured, folder
            )
    except KeyedError as error:
        own = key if error.key.startswith("instrument.") else ""
        raise stated(file, f"key {own}{error.key}", error.what) from error
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
) -> tuple[TableInstrument, TableInstrument, Plan, np.ndarray | None]:
    """The instrument of a table as declared, and with starting values from its readings; the plan
    and the readings of the rows without a blank reading.
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
    declared, readings = instrument, None
    if measured:
        with calling(settings, kind, "measured", "readings in SI from the columns of the table"):
            readings = instrument.measured(table)
        check_readings(settings, instrument, plan, readings)
        with calling(settings, kind, "start", "the same instrument"):
            instrument = instrument.start(chain, plan, readings)
        check_built(settings, kind, instrument, "start")
    if settings.kind_file is not None:
        # The trial needs a plan of the complete rows only.
        alone = _planned(settings, instrument, chain, table)
        check_instrument(settings, instrument, chain, table, alone, readings)
    if readings is not None:
        check_scatter(table, readings_of(settings, kind, chain.axes), instrument, plan, readings)
    return declared, instrument, plan, readings


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


def _check_seen(settings: AnySettings, sets: Sequence[DataSet], file: str) -> None:
    """Raise `StudyError` where a table alone does not identify its ``must_see`` errors."""
    if isinstance(settings, StudySettings):
        wanted = {"data.must_see": settings.data.must_see}
    else:
        wanted = {f"data.{i}.must_see": row.must_see for i, row in enumerate(settings.data)}
    for (key, errors), one in zip(wanted.items(), sets, strict=True):
        check_identifiable(errors, one.chain, one.instrument, one.plan, file, key)


def _check_formats(settings: AnySettings, folder: Folder, file: str) -> None:
    """Raise `StudyError` for a declared table that no key of the study names."""
    for name in settings.tables:
        if name not in folder.tables:
            raise refusal(
                file,
                f"key tables.{name}",
                f"a table that the study does not read{nearest(name, folder.tables)}",
                f"one of {listed(folder.tables)}",
                "correct the name, or remove the table",
            )


def _checked(
    settings: AnySettings, chain: Chain, sets: Sequence[DataSet], folder: Folder
) -> CheckPoints | None:
    """The check points of the named table, or of ``check.csv`` where it exists; None otherwise."""
    given = _check_given(settings)
    name = given or "check.csv"
    if given is None and not folder.has(name):
        return None
    return check_points(name, sets[0].instrument, sets[0].settings, chain, folder)


def _check_given(settings: AnySettings) -> str | None:
    """The name of the table of check points in the study file, if it names one."""
    return settings.data.check if isinstance(settings, StudySettings) else settings.check


def _check_size(model: Model, plan: Plan, data: str, measured: bool) -> None:
    """Raise `StudyError` for fewer readings than parameters without a prior.

    Measured readings must exceed these parameters even without any one row, as only the surplus
    determines the scatter.
    """
    flat = [entry for entry in model.entries if not entry.parameter.informed]
    width = len(model.instrument.readings)
    readings = int(model.instrument.present(plan).sum())
    needed = len(flat) + width + 1 if measured and flat else len(flat)
    if readings >= needed:
        return
    keys = listed(dict.fromkeys(entry.key for entry in flat), FEW)
    raise refusal(
        data,
        f"row {plan.row_name(plan.rows - 1)} (the last one)",
        f"{counted(readings, 'reading')} ({counted(plan.rows, 'row')} of {width}) for "
        f"{counted(len(flat), 'parameter')} without a "
        f"prior ({keys})",
        f"more than {needed - 1} readings, so that they outnumber the parameters even without any "
        "one row"
        if measured
        else f"at least {counted(needed, 'reading')}",
        "measure more rows, or give a prior (a *_sigma) to parameters that are known",
    )


def _check_determined(model: Model, plan: Plan, data: str) -> None:
    """Raise `StudyError` where the Jacobian of the parameters without a prior has no full rank.

    The number of readings does not help: points on one straight line contain no information about a
    rotation about it.
    """
    found = flat_rank(model, plan)
    if found.rank == found.columns:
        return
    mixed = [model.entries[i] for i in found.mixed]
    names = [f"{entry.key} {entry.parameter.name}" for entry in mixed]
    raise refusal(
        data,
        "columns of positions and conditions",
        f"{plan.rows} rows that identify {found.rank} of {found.columns} parameters without a "
        f"prior; {listed(names, FEW)} {'is' if len(names) == 1 else 'are'} not identified",
        "rows that identify all of them: for an instrument with an unknown pose, positions that "
        "are not all on one straight line or in one place",
        "measure further positions, or give a prior (a *_sigma) to a parameter that can have one",
    )


def _check_fitted(model: Model, measurement: Measurement, data: str, chosen: bool) -> None:
    """Raise `StudyError` where the rows that are fitted, without those that are held out of every
    fit, do not determine the parameters without a prior.
    """
    plan, holdout = measurement.plan, measurement.holdout
    if holdout is None:
        folds, apart = model.instrument.folds(plan)
        apart = np.broadcast_to(apart, folds.shape) & (folds >= 0)
    else:
        apart = holdout.apart
    if not apart.any():
        return
    found = flat_rank(model, plan, ~apart)
    if found.rank == found.columns:
        return
    names = [f"{model.entries[i].key} {model.entries[i].parameter.name}" for i in found.mixed]
    raise refusal(
        data,
        "columns of positions and conditions",
        f"{int((~apart).sum())} rows that are fitted, without {int(apart.sum())} held-out ones, "
        f"which identify {found.rank} of {found.columns} parameters without a prior; "
        f"{listed(names, FEW)} {'is' if len(names) == 1 else 'are'} not identified",
        "fitted rows that identify all of them",
        "choose another kind in [holdout], such as random"
        if chosen
        else "measure further positions, or choose the held-out rows in [holdout]",
    )
