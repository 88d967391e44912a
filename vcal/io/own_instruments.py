"""Instruments of a user's own file, tried once before any work is done with them."""

import dataclasses
import inspect
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..chain import Chain, chain_from_string
from ..effects.base import Effect
from ..errors import StudyError
from ..instruments.base import INSTRUMENTS, Column, InstrumentSettings, TableInstrument
from ..model import Model, observe_all, observe_row, observe_with_jacobian
from ..plan import Plan
from ..ports import PortLayout
from .folder import Folder
from .messages import listed
from .own_code import Attribute, Trial
from .own_effects import ATTRIBUTES, check_effect

_INSIDE = f"{__name__.partition('.')[0]}."
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_SAME, _NOTHING = 1e-6, 1e-12
"""Share of the largest value, and m or rad, within which what is written is what is read."""
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
    ("labels", _texts, 'a tuple of columns, as in ("plane",)'),
    ("derived", _texts, 'a tuple of covariates, as in ("range",)'),
)


def instrument_class(settings: InstrumentSettings, folder: Folder) -> type[TableInstrument]:
    """The class of the instrument that settings name, which were validated."""
    if settings.kind_file is None:
        return INSTRUMENTS[settings.kind]
    return own_instruments(folder, settings.kind_file)[settings.kind]


def own_instruments(folder: Folder, file: str) -> dict[str, type[TableInstrument]]:
    """The instruments that a user's file defines, by kind; it is run once for a study.

    Raises `StudyError` if the file cannot be used, or has a class that cannot be one, or a kind
    that exists.
    """
    found: dict[str, type[TableInstrument]] = {}
    for kind in INSTRUMENTS.defined_in(folder.module(file, INSTRUMENTS.what), TableInstrument):
        trial, name = Trial(file, kind.__name__), kind.kind
        if not _NAME.fullmatch(name):
            raise trial.refusal("kind", repr(name), "letters, digits and _, a letter first")
        known = INSTRUMENTS.get(name)
        taken = known is not None and known.__module__.startswith(_INSIDE)
        if taken or name in found:
            raise trial.refusal(
                "kind", f"{name!r}, which is taken", "a kind that no other instrument has"
            )
        if inspect.isabstract(kind):
            missing = listed(sorted(kind.__abstractmethods__))
            expected = "all that vcal.instruments.TableInstrument leaves open"
            raise trial.refusal("body", f"no {missing}", expected)
        trial.check_attributes(kind, _ATTRIBUTES)
        with trial.calling("Settings", "fields with types that pydantic knows"):
            kind.Settings.model_rebuild()
        if kind.machine is not None:
            with trial.calling("machine", 'a chain such as "w X b Y Z t"'):
                chain_from_string(kind.machine)
        found[name] = kind
    return found


def calling(
    settings: InstrumentSettings, kind: type[TableInstrument], method: str, expected: str
) -> AbstractContextManager[None]:
    """Calls of a method of an instrument in this block: where it is a user's own, what it raises is
    told as a mistake of its class.
    """
    if settings.kind_file is None:
        return nullcontext()
    return Trial(settings.kind_file, kind.__name__).calling(method, expected)


def columns_of(
    settings: InstrumentSettings, kind: type[TableInstrument], axes: Sequence[str]
) -> tuple[list[Column], list[Column]]:
    """The columns of an instrument's table: of a plan, and with the readings.

    Raises `StudyError` where a user's own class gives something else.
    """
    expected = "a list of vcal.instruments.Column, the same with readings=True and more"
    with calling(settings, kind, "columns", expected):
        plain = kind.columns(settings, axes, readings=False)
        full = kind.columns(settings, axes, readings=True)
    if settings.kind_file is None:
        return plain, full
    trial = Trial(settings.kind_file, kind.__name__)
    for columns in (plain, full):
        if not isinstance(columns, list) or not all(isinstance(c, Column) for c in columns):
            raise trial.refusal("columns", repr(columns), expected)
    missing = {c.name for c in plain} - {c.name for c in full}
    if missing:
        found = f"{listed(sorted(missing))} without readings only"
        raise trial.refusal("columns", found, expected)
    return plain, full


def check_built(
    settings: InstrumentSettings, kind: type[TableInstrument], instrument: Any, method: str
) -> None:
    """Raises `StudyError` where a user's own class made no instrument of itself, of fields that
    compiled programs can take.
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
                expected = (
                    "numbers and arrays; in static fields what can be hashed, such as a tuple"
                )
                raise trial.refusal(method, found, expected) from error


def check_plan(
    settings: InstrumentSettings,
    kind: type[TableInstrument],
    chain: Chain,
    table: Mapping[str, np.ndarray],
    plan: Any,
) -> None:
    """Raises `StudyError` where a user's own class made no plan of the rows of its table."""
    if settings.kind_file is None:
        return
    trial, rows = Trial(settings.kind_file, kind.__name__), len(next(iter(table.values())))
    expected = f"a vcal.Plan of {rows} rows with the axes {listed(chain.axes)}"
    if not isinstance(plan, Plan):
        raise trial.refusal("plan", type(plan).__name__, expected)
    if plan.axes != chain.axes or plan.rows != rows:
        found = f"one of {plan.rows} rows with the axes {listed(plan.axes)}"
        raise trial.refusal("plan", found, expected)


def check_readings(
    settings: InstrumentSettings, instrument: TableInstrument, plan: Plan, readings: Any
) -> None:
    """Raises `StudyError` where a user's own class made no readings of its table."""
    if settings.kind_file is None:
        return
    trial = Trial(settings.kind_file, type(instrument).__name__)
    names = _check_names(trial, instrument)
    trial.numbers("measured", readings, (plan.rows, len(names)), f"readings {listed(names)}, SI")


def check_instrument(
    settings: InstrumentSettings,
    instrument: TableInstrument,
    chain: Chain,
    table: Mapping[str, np.ndarray],
    plan: Plan,
    readings: np.ndarray | None,
) -> None:
    """Everything that a user's own instrument declares and does, asked for once.

    Raises `StudyError` that names the class and its method where it fails, or gives something of
    another shape than `vcal.instruments.base` says.
    """
    if settings.kind_file is None:
        return
    trial = Trial(settings.kind_file, type(instrument).__name__)
    names = _check_names(trial, instrument)
    nominal = _check_path(trial, instrument, chain, plan, names)
    read = nominal if readings is None else np.asarray(readings, float)
    present = _check_present(trial, instrument, plan, names)
    shape = plan.rows, len(names)
    with trial.calling("noise", f"standard deviations of the shape {shape}, SI"):
        noise = instrument.noise(plan, read)
    noise = trial.numbers("noise", noise, shape, "standard deviations of the readings, SI")
    if (bad := present & (noise <= 0.0)).any():
        row, k = np.argwhere(bad)[0]
        found = f"{noise[row, k]:g} for {names[k]} in row {row + 1}"
        raise trial.refusal("noise", found, "standard deviations above 0, SI")
    with trial.calling("lengths", f"metres per unit of the readings, of the shape {shape}"):
        lengths = instrument.lengths(plan, read)
    trial.numbers("lengths", lengths, shape, "metres per unit of the readings")
    with trial.calling("dimensions", f"numbers of the shape ({plan.rows},)"):
        dimensions = instrument.dimensions(plan)
    dimensions = trial.numbers("dimensions", dimensions, (plan.rows,), "readings that make a point")
    if dimensions.min() <= 0.0:
        raise trial.refusal("dimensions", f"{dimensions.min():g}", "numbers above 0")
    with trial.calling("clusters", f"indices of the shape ({plan.rows},)"):
        clusters = instrument.clusters(plan)
    _indices(trial, "clusters", clusters, plan.rows)
    _check_folds(trial, instrument, plan)
    _check_effects(trial, instrument, chain, plan)
    _check_table(trial, instrument, chain, table, plan, read)
    _check_record(trial, instrument, chain, plan, nominal.shape)


def _check_names(trial: Trial, instrument: TableInstrument) -> tuple[str, ...]:
    """The names of the readings; ports and readings must have such as can be told apart."""
    with trial.calling("readings", 'a tuple of names, as in ("range",)'):
        names = instrument.readings
    if not _texts(names) or not names or len(set(names)) < len(names):
        expected = 'a tuple of at least one name, each once, as in ("range",)'
        raise trial.refusal("readings", repr(names), expected)
    expected = 'a tuple of names GROUP.COMPONENT, as in vcal.ports.group("frame")'
    with trial.calling("ports", expected):
        ports = instrument.ports
    if not _texts(ports) or len(set(ports)) < len(ports):
        raise trial.refusal("ports", repr(ports), f"{expected}, each once")
    groups: list[str] = []
    for port in ports:
        if not _PORT.fullmatch(port):
            raise trial.refusal("ports", repr(port), expected)
        group = port.partition(".")[0]
        if group == "tool":
            raise trial.refusal("ports", repr(port), "another group than that of the machine")
        if group in groups and group != groups[-1]:
            raise trial.refusal("ports", f"{port!r} apart from its group", "groups in one piece")
        groups.append(group)
    return names


def _check_path(
    trial: Trial, instrument: TableInstrument, chain: Chain, plan: Plan, names: Sequence[str]
) -> np.ndarray:
    """The readings of the nominal machine, with finite derivatives by all ports."""
    n, m = plan.rows, len(names)
    with trial.calling("rows", f"arrays whose first axis has the {n} rows of the plan"):
        rows = instrument.rows(plan)
    for leaf in jax.tree.leaves(rows):
        if np.shape(leaf)[:1] != (n,):
            expected = f"arrays whose first axis has the {n} rows of the plan"
            raise trial.refusal("rows", f"shape {np.shape(leaf)}", expected)
    layout = PortLayout.of(chain.axes, instrument.ports)
    ports = [*[jnp.asarray(0.0)] * (len(layout) - len(instrument.ports))]
    ports += [0.0 if i % 2 else jnp.asarray(0.0) for i in range(len(instrument.ports))]

    def one(instrument: TableInstrument, q: Any, row: Any) -> Any:
        return observe_row(chain, instrument, list(q), row, ports)

    expected = (
        f"{m} number(s) in a list, one for each of `readings`, made by jax.numpy with no float() "
        "or if where the row, the tool or a port comes in"
    )
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], rows)
    with trial.calling("observe", expected):
        made = eqx.filter_eval_shape(one, instrument, jnp.asarray(plan.position)[0], first)
    if len(made) != m:
        raise trial.refusal("observe", f"{len(made)} number(s)", expected)
    for name, value in zip(names, made, strict=True):
        if np.shape(value) != ():
            raise trial.refusal("observe", f"shape {np.shape(value)} for {name}", expected)
    still = jnp.zeros((n, len(layout)))
    with trial.calling("observe", expected):
        values, slopes = observe_with_jacobian(chain, instrument, plan.position, rows, still)
    values, slopes = np.asarray(values), np.asarray(slopes)
    trial.numbers("observe", values, (n, m), "finite readings of the nominal machine")
    if not np.isfinite(slopes).all():
        row, k, _ = np.argwhere(~np.isfinite(slopes))[0]  # from one port, it spreads to all
        found = f"no finite derivative of {names[k]} in row {row + 1}"
        raise trial.refusal("observe", found, "one, also where a length is 0 or an arc cosine 1")
    for given in (values, slopes):
        with trial.calling("reduce", f"an array of the shape {given.shape}, by jax.numpy"):
            eqx.filter_eval_shape(lambda i, v, p: i.reduce(v, p), instrument, given, plan)
            reduced = np.asarray(instrument.reduce(jnp.asarray(given), plan))
        trial.numbers("reduce", reduced, given.shape, "as many readings as it was given")
    values = np.asarray(instrument.reduce(jnp.asarray(values), plan))
    with trial.calling("difference", f"an array of the shape {(n, m)}, by jax.numpy"):
        apart = jax.eval_shape(instrument.difference, jnp.asarray(values), jnp.asarray(values))
    if apart.shape != (n, m):
        raise trial.refusal("difference", f"shape {apart.shape}", f"the shape {(n, m)}")
    return values


def _check_present(
    trial: Trial, instrument: TableInstrument, plan: Plan, names: Sequence[str]
) -> np.ndarray:
    expected = "True or False for every reading, at least one True in every row"
    with trial.calling("present", expected):
        present = instrument.present(plan)
    present = trial.array("present", present, (plan.rows, len(names)), expected)
    if present.dtype != bool:
        raise trial.refusal("present", f"an array of {present.dtype}", expected)
    if not present.any(1).all():
        found = f"no reading in row {int(np.argmin(present.any(1))) + 1}"
        raise trial.refusal("present", found, expected)
    return present


def _indices(trial: Trial, method: str, values: Any, rows: int) -> np.ndarray:
    expected = "an index for every row, a whole number from 0 on, or -1"
    found = trial.array(method, values, (rows,), expected)
    if found.dtype.kind not in "iu":
        raise trial.refusal(method, f"an array of {found.dtype}", expected)
    if found.min() < -1:
        raise trial.refusal(method, f"{found.min()}", expected)
    return found


def _check_folds(trial: Trial, instrument: TableInstrument, plan: Plan) -> None:
    expected = "a pair: the fold of every row, and True or False, for all of them or for each"
    with trial.calling("folds", expected):
        found = instrument.folds(plan)
    if not isinstance(found, tuple) or len(found) != 2:
        raise trial.refusal("folds", type(found).__name__, expected)
    folds, apart = _indices(trial, "folds", found[0], plan.rows), np.asarray(found[1])
    if apart.dtype != bool or apart.shape not in ((), (plan.rows,)):
        given = f"{found[1]!r}" if not apart.shape else f"{apart.dtype} of shape {apart.shape}"
        raise trial.refusal("folds", f"{given} for what is kept out of every fit", expected)
    apart = np.broadcast_to(apart, folds.shape) & (folds >= 0)
    rotating = np.unique(folds[(folds >= 0) & ~apart])
    if not (folds >= 0).any():
        raise trial.refusal("folds", "-1 for every row", "rows that are held out, in two folds")
    fitted = [~apart & (folds != fold) for fold in rotating] or [~apart]
    if not all(rest.any() for rest in fitted):
        raise trial.refusal("folds", "no rows beside one of them", "at least two folds")


def _check_effects(trial: Trial, instrument: TableInstrument, chain: Chain, plan: Plan) -> None:
    expected = "a tuple of vcal.Effect, each with a name of its own"
    with trial.calling("effects", expected):
        effects = instrument.effects(plan)
    if not isinstance(effects, tuple) or not all(isinstance(e, Effect) for e in effects):
        raise trial.refusal("effects", repr(effects), expected)
    for effect in effects:
        own = Trial(trial.file, type(effect).__name__)
        if not isinstance(getattr(type(effect), "name", None), str):
            raise own.refusal("name", "none", "text in quotes")
        own.check_attributes(type(effect), ATTRIBUTES)
    keys = [effect.key for effect in effects]
    if len(set(keys)) < len(keys):
        raise trial.refusal("effects", listed(keys), expected)
    setup = Model(chain, instrument).setup(plan)
    for effect in effects:
        check_effect(Trial(trial.file, type(effect).__name__), effect, setup, plan)


def _check_table(
    trial: Trial,
    instrument: TableInstrument,
    chain: Chain,
    table: Mapping[str, np.ndarray],
    plan: Plan,
    readings: np.ndarray,
) -> None:
    """What is written must be what is read."""
    expected = "a dict {column: one cell for every row}, from which the same can be read again"
    with trial.calling("to_table", expected):
        written = instrument.to_table(plan, readings)
    if not isinstance(written, Mapping):
        raise trial.refusal("to_table", type(written).__name__, expected)
    for name, values in written.items():
        if np.shape(values) != (plan.rows,):
            raise trial.refusal("to_table", f"shape {np.shape(values)} of {name}", expected)
    whole = {**table, **{name: np.asarray(values) for name, values in written.items()}}
    with trial.calling("to_table", f"{expected} by plan and measured"):
        again, found = instrument.plan(chain, whole), instrument.measured(whole)
    trial.numbers("measured", found, readings.shape, "readings in SI")
    off = np.asarray(instrument.difference(jnp.asarray(found), jnp.asarray(readings)))
    pairs = [(f"the position of {a}", plan.x(a), again.x(a) - plan.x(a)) for a in plan.axes]
    names = enumerate(instrument.readings)
    pairs += [(f"the reading {name}", readings[:, k], off[:, k]) for k, name in names]
    for old, new in ((plan.covariates, again.covariates), (plan.groups, again.groups)):
        common = sorted({*old} & {*new} - {*instrument.derived})
        pairs += [(f"the {name}", old[name], new[name] - old[name]) for name in common]
    for what, before, apart in pairs:
        before, apart = np.asarray(before, float), np.asarray(apart, float)
        limit = _SAME * np.abs(before).max() + _NOTHING
        if (bad := ~(np.abs(apart) <= limit)).any():
            row = int(np.argmax(bad))
            found = f"{what} in row {row + 1}, {before[row]:.7g}, off by {apart[row]:.3g} as read"
            raise trial.refusal("to_table", found, "the inverse of plan and measured")


def _check_record(
    trial: Trial, instrument: TableInstrument, chain: Chain, plan: Plan, shape: tuple[int, ...]
) -> None:
    if type(instrument).record is TableInstrument.record:
        return
    still = jnp.zeros((plan.rows, len(PortLayout.of(chain.axes, instrument.ports))))

    def ideal(at: Plan) -> np.ndarray:
        values = observe_all(chain, instrument, at.position, instrument.rows(at), still)
        return np.asarray(instrument.reduce(values, at))

    expected = f"a pair: a vcal.Plan of {plan.rows} rows, and readings of the shape {shape}"
    with trial.calling("record", expected):
        try:
            found = instrument.record(plan, ideal, np.zeros(shape))
        except StudyError:
            return  # only simulations need it, and are told then
    if not isinstance(found, tuple) or len(found) != 2 or not isinstance(found[0], Plan):
        raise trial.refusal("record", type(found).__name__, expected)
    trial.numbers("record", found[1], shape, "readings that are written down")
    if found[0].rows != plan.rows:
        raise trial.refusal("record", f"a plan of {found[0].rows} rows", expected)
