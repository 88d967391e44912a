"""Instruments of a user's own file: their classes, and checks of the results of their methods."""

import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Annotated, Any

import jax
import numpy as np
from pydantic import TypeAdapter, ValidationError

from ...instruments.base import INSTRUMENTS, Column, InstrumentSettings, TableInstrument
from ...machine.chain import Chain, chain_from_string
from ...machine.plan import Plan
from ..folder import Folder
from ..messages import listed
from .trial import Attribute, Trial, shown

INSIDE = f"{__name__.partition('.')[0]}."
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_PORT = re.compile(r"[A-Za-z]\w*\.\w+")


def _texts(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(v, str) for v in value)


_ATTRIBUTES: tuple[Attribute, ...] = (
    (
        "Settings",
        lambda v: isinstance(v, type) and issubclass(v, InstrumentSettings),
        "a class derived from vcal.instruments.InstrumentSettings",
    ),
    (
        "dimension",
        lambda v: isinstance(v, int) and not isinstance(v, bool) and v > 0,
        "a whole number of at least 1",
    ),
    ("machine", lambda v: v is None or isinstance(v, str), "a chain in quotes, or None"),
    ("rotary", lambda v: isinstance(v, bool), "True or False"),
    ("positioned", lambda v: isinstance(v, bool), "True or False"),
    ("remembers", lambda v: isinstance(v, bool), "True or False"),
    ("labels", _texts, 'a tuple of columns, as in ("plane",)'),
    ("steady", _texts, 'a tuple of columns, as in ("psd_u_mm",)'),
    ("read_otherwise", _texts, 'a tuple of columns, as in ("p1_mm",)'),
    ("derived", _texts, 'a tuple of covariates, as in ("range",)'),
)


def instrument_class(settings: InstrumentSettings, folder: Folder) -> type[TableInstrument]:
    """The class of the instrument that validated settings name."""
    if settings.kind_file is None:
        return INSTRUMENTS[settings.kind]
    return own_instruments(folder, settings.kind_file)[settings.kind]


def own_instruments(folder: Folder, file: str) -> dict[str, type[TableInstrument]]:
    """The instruments that a user's file defines, by kind; it is executed once per study.

    Raises `StudyError` for a file that cannot be used, for an incomplete or wrong class, and for a
    kind that another instrument has.
    """
    found: dict[str, type[TableInstrument]] = {}
    for kind in INSTRUMENTS.defined_in(folder.module(file, INSTRUMENTS.what), TableInstrument):
        trial, name = Trial(file, kind.__name__), kind.kind
        if not _NAME.fullmatch(name):
            raise trial.refusal("kind", repr(name), "letters, digits and _, a letter first")
        known = INSTRUMENTS.get(name)
        taken = known is not None and known.__module__.startswith(INSIDE)
        if taken or name in found:
            raise trial.refusal(
                "kind", f"{name!r}, which is taken", "a kind that no other instrument has"
            )
        if inspect.isabstract(kind):
            missing = listed(sorted(kind.__abstractmethods__))
            expected = "all abstract methods of vcal.instruments.TableInstrument"
            raise trial.refusal("body", f"no {missing}", expected)
        trial.check_attributes(kind, _ATTRIBUTES)
        with trial.calling("Settings", "fields with types that pydantic knows"):
            kind.Settings.model_rebuild()
        _check_defaults(trial, kind.Settings)
        if kind.machine is not None:
            with trial.calling("machine", 'a chain such as "w X b Y Z t"'):
                chain_from_string(kind.machine)
        found[name] = kind
    return found


def _check_defaults(trial: Trial, settings: type[InstrumentSettings]) -> None:
    """Raise `StudyError` for a default value that its own validation refuses."""
    for name, field in settings.model_fields.items():
        if field.is_required():
            continue
        default = field.get_default(call_default_factory=True)
        try:
            kind: Any = Annotated[field.annotation, field]  # type: ignore
            TypeAdapter(kind).validate_python(default)
        except ValidationError as error:
            found = f"the default {default!r} of {name}"
            raise trial.refusal("Settings", found, error.errors()[0]["msg"]) from error


def calling(
    settings: InstrumentSettings, kind: type[TableInstrument], method: str, expected: str
) -> AbstractContextManager[None]:
    """Report exceptions in this block as mistakes of the method of a user's own instrument."""
    if settings.kind_file is None:
        return nullcontext()
    return Trial(settings.kind_file, kind.__name__).calling(method, expected)


def columns_of(
    settings: InstrumentSettings, kind: type[TableInstrument], axes: Sequence[str]
) -> tuple[list[Column], list[Column]]:
    """The columns of an instrument's table, without and with the readings.

    Raises `StudyError` where a user's own class returns anything else.
    """
    expected = "a list of vcal.instruments.Column, and with readings=True the same ones and more"
    with calling(settings, kind, "columns", expected):
        plain = kind.columns(settings, axes, readings=False)
        full = kind.columns(settings, axes, readings=True)
    if settings.kind_file is None:
        return plain, full
    trial = Trial(settings.kind_file, kind.__name__)
    for columns in (plain, full):
        if not isinstance(columns, list) or not all(isinstance(c, Column) for c in columns):
            raise trial.refusal("columns", repr(columns), expected)
        names = [c.name for c in columns]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise trial.refusal("columns", f"{listed(twice)} twice", "every column once")
        for c in columns:
            if unknown := {*c.unique_with} - {*names}:
                found = f"{c.name} unique_with {listed(sorted(unknown))}"
                raise trial.refusal("columns", found, f"some of {listed(names)}")
    missing = {c.name for c in plain} - {c.name for c in full}
    if missing:
        found = f"{listed(sorted(missing))} without readings only"
        raise trial.refusal("columns", found, expected)
    return plain, full


def readings_of(
    settings: InstrumentSettings, kind: type[TableInstrument], axes: Sequence[str]
) -> set[str]:
    """The columns of readings, which a plan lacks; empty where every table holds data."""
    plain, full = columns_of(settings, kind, axes)
    return {c.name for c in full} - {c.name for c in plain}


def check_built(
    settings: InstrumentSettings, kind: type[TableInstrument], instrument: Any, method: str
) -> None:
    """Raise `StudyError` where a user's own class returns no instance of itself, or an instance
    with fields that compiled programs cannot take.
    """
    if settings.kind_file is None:
        return
    trial = Trial(settings.kind_file, kind.__name__)
    if not isinstance(instrument, kind):
        raise trial.refusal(method, type(instrument).__name__, f"an instance of {kind.__name__}")
    for field in dataclasses.fields(instrument):
        value = getattr(instrument, field.name)
        static = field.metadata.get("static", False)
        for leaf in [value] if static else jax.tree.leaves(value):
            if not static and isinstance(leaf, np.ndarray | jax.Array):
                if leaf.dtype.kind in "biufc":
                    continue
                found = f"an array of {leaf.dtype} in the field {field.name}"
                raise trial.refusal(method, found, "arrays of numbers")
            try:
                hash(leaf)
            except TypeError as error:
                found = f"{'the static' if static else 'the'} field {field.name}: {error}"
                expected = "numbers and arrays; in static fields hashable values, such as a tuple"
                raise trial.refusal(method, found, expected) from error


def check_plan(
    settings: InstrumentSettings,
    kind: type[TableInstrument],
    chain: Chain,
    table: Mapping[str, np.ndarray],
    plan: Any,
) -> None:
    """Raise `StudyError` where a user's own class returns no plan of the rows of its table."""
    if settings.kind_file is None:
        return
    trial, rows = Trial(settings.kind_file, kind.__name__), len(next(iter(table.values())))
    expected = f"a vcal.Plan of {rows} rows with the axes {listed(chain.axes)}"
    if not isinstance(plan, Plan):
        raise trial.refusal("plan", type(plan).__name__, expected)
    if plan.axes != chain.axes or plan.rows != rows:
        found = f"one of {plan.rows} rows with the axes {listed(plan.axes)}"
        raise trial.refusal("plan", found, expected)
    # An effect proportional to a reading would explain everything.
    read = readings_of(settings, kind, chain.axes) & {*plan.covariates} - {*kind.derived}
    if read:
        found = f"{listed(sorted(read))} among the covariates"
        do = f"no reading, as by linear_plan(chain, table, readings={tuple(sorted(read))})"
        raise trial.refusal("plan", found, do)


def check_row(
    settings: InstrumentSettings, kind: type[TableInstrument], row: int, rows: int
) -> None:
    """Raise `StudyError` where a user's own class refuses a row that its table does not have."""
    if settings.kind_file is not None and not 0 <= row < rows:
        trial = Trial(settings.kind_file, kind.__name__)
        raise trial.refusal("body", f"RowError({row}, ...)", f"an index from 0 to {rows - 1}")


def check_readings(
    settings: InstrumentSettings, instrument: TableInstrument, plan: Plan, readings: Any
) -> None:
    """Raise `StudyError` where a user's own class returns no readings of its table."""
    if settings.kind_file is None:
        return
    trial = Trial(settings.kind_file, type(instrument).__name__)
    names = check_names(trial, instrument)
    trial.numbers("measured", readings, (plan.rows, len(names)), f"readings {listed(names)}, SI")


def check_names(trial: Trial, instrument: TableInstrument) -> tuple[str, ...]:
    """The names of the readings; raises `StudyError` for ambiguous names of readings or ports."""
    with trial.calling("readings", 'a tuple of names, as in ("range",)'):
        names = instrument.readings
    if not _texts(names) or not names or len(set(names)) < len(names):
        expected = 'a tuple of at least one name, each once, as in ("range",)'
        raise trial.refusal("readings", shown(names), expected)
    expected = 'a tuple of names GROUP.COMPONENT, as in vcal.instruments.group("frame")'
    with trial.calling("ports", expected):
        ports = instrument.ports
    if not _texts(ports) or len(set(ports)) < len(ports):
        raise trial.refusal("ports", shown(ports), f"{expected}, each once")
    groups: list[str] = []
    for port in ports:
        if not _PORT.fullmatch(port):
            raise trial.refusal("ports", repr(port), expected)
        group = port.partition(".")[0]
        if group == "tool":
            raise trial.refusal("ports", repr(port), "a group other than that of the machine")
        if group in groups and group != groups[-1]:
            raise trial.refusal("ports", f"{port!r} apart from its group", "groups in one piece")
        groups.append(group)
    return names
