"""The trial of a user's own instrument: each method is called once before it is used."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...effects.base import Artefact, Effect
from ...effects.registry import CATALOGUE
from ...errors import StudyError
from ...identification.rank import flat_rank
from ...instruments.base import InstrumentSettings, TableInstrument
from ...machine.chain import Chain
from ...machine.plan import Plan
from ...machine.ports import PortLayout
from ...model.forward import Model, observe_all, observe_with_jacobian, split_ports
from ...numerics.rigid import Rotation, Vector
from ...words import counted
from ..messages import listed
from .effects import ATTRIBUTES, check_effect
from .instruments import INSIDE, check_names, readings_of
from .trial import Trial, read_only, shown

_SAME, _NOTHING = 1e-6, 1e-12
"""Tolerance of a value that is written and read again: share of the largest value, and m or rad."""
_PATH = (
    "{} in a list, one for each of `readings`, computed by jax.numpy without float() or "
    "if where the row, the tool or a port is used"
)
_ADDRESS = re.compile(r"0x[0-9a-f]+")
_LINEAR = 1e-9
"""Relative tolerance between the reduction of a sum and the sum of the reductions."""


def check_instrument(
    settings: InstrumentSettings,
    instrument: TableInstrument,
    chain: Chain,
    table: Mapping[str, np.ndarray],
    plan: Plan,
    readings: np.ndarray | None,
) -> None:
    """Call all methods of a user's own instrument once and check their results.

    Raises `StudyError` with the class and the method where one fails, or returns a result other
    than `vcal.instruments.base` specifies.
    """
    if settings.kind_file is None:
        return
    trial, plan = Trial(settings.kind_file, type(instrument).__name__), read_only(plan)
    names, n = check_names(trial, instrument), plan.rows
    _check_figures(trial, instrument)
    # The checks without a compiled program come first.
    rows = _check_traced(trial, instrument, plan, names)
    present = _check_present(trial, instrument, plan, names)
    with trial.calling("dimensions", f"numbers of the shape ({n},)"):
        dimensions = instrument.dimensions(plan)
    dimensions = trial.numbers("dimensions", dimensions, (n,), "readings that make a point")
    if dimensions.min() <= 0.0:
        raise trial.refusal("dimensions", f"{dimensions.min():g}", "numbers above 0")
    with trial.calling("clusters", f"indices of the shape ({n},)"):
        clusters = instrument.clusters(plan)
    check_clusters(trial, _indices(trial, "clusters", clusters, n), present)
    apart = _check_folds(trial, instrument, plan)
    effects = _check_effects(trial, instrument, chain, plan)
    _check_determined(trial, Model(chain, instrument, effects), plan, apart)
    nominal = _check_path(trial, instrument, chain, plan, rows, names)
    read = nominal if readings is None else np.asarray(readings, float)
    _check_sizes(trial, instrument, plan, read, present, names)
    unread = readings_of(settings, type(instrument), chain.axes)
    plain = {name: values for name, values in table.items() if name not in unread}
    _check_table(trial, instrument, chain, plain, plan, read)
    _check_record(trial, instrument, chain, plan, nominal.shape)


def _asked(trial: Trial, method: str, expected: str, call: Callable[[], Any]) -> Any:
    """The result of a method, which must be the same when it is called again."""
    with trial.calling(method, expected):
        first, again = call(), call()
    pairs = zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=False)
    for one, other in pairs:
        if isinstance(one, np.ndarray | jax.Array | float | int) and not np.array_equal(
            np.asarray(one), np.asarray(other)
        ):
            _refuse_change(trial, method)
    return first


def _refuse_change(trial: Trial, method: str) -> None:
    """Raise `StudyError` for a result that differs between calls."""
    found = "another result when it was called again"
    expected = "the same result for the same plan, without random numbers or counters"
    raise trial.refusal(method, found, expected)


def _check_figures(trial: Trial, instrument: TableInstrument) -> None:
    """Check the properties with defaults: `temperature_offset_K`, `artefact` and `members`."""
    with trial.calling("temperature_offset_K", "a number of K"):
        temperature_offset_K = instrument.temperature_offset_K
    if not isinstance(temperature_offset_K, float | int) or not np.isfinite(temperature_offset_K):
        raise trial.refusal(
            "temperature_offset_K", shown(temperature_offset_K), "a finite number of K"
        )
    with trial.calling("artefact", "a vcal.effects.base.Artefact, or None"):
        artefact = instrument.artefact
    if not isinstance(artefact, Artefact | None):
        raise trial.refusal("artefact", shown(artefact), "a vcal.effects.base.Artefact, or None")
    if type(instrument).members is not TableInstrument.members:
        raise trial.refusal("members", "some", "none, as a study joins its data sets itself")


def _check_traced(
    trial: Trial, instrument: TableInstrument, plan: Plan, names: Sequence[str]
) -> Any:
    """The result of `rows`; tracing `observe` with one of them must give the same program twice."""
    n, m = plan.rows, len(names)
    expected = f"arrays of numbers whose first axis has the {n} rows of the plan"
    rows = _asked(trial, "rows", expected, lambda: instrument.rows(plan))
    for leaf in jax.tree.leaves(rows):
        if np.shape(leaf)[:1] != (n,):
            raise trial.refusal("rows", f"shape {np.shape(leaf)}", expected)
        if leaf.dtype.kind not in "biufc":
            raise trial.refusal("rows", f"an array of {leaf.dtype}", expected)
    ports = [0.0 if i % 2 else jnp.asarray(0.0) for i in range(len(instrument.ports))]

    def one(instrument: TableInstrument, row: Any, turn: Any, tool: Any) -> Any:
        own = split_ports(instrument, ports)
        return tuple(instrument.observe(row, Rotation.of(turn), Vector.of(tool), own))

    expected = _PATH.format(counted(m, "number"))
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], rows)
    with trial.calling("observe", expected):
        path = eqx.filter_make_jaxpr(one)
        traced = [path(instrument, first, jnp.eye(3), jnp.zeros(3)) for _ in range(2)]
    made = eqx.combine(*traced[0][1:])
    if len(made) != m:
        raise trial.refusal("observe", counted(len(made), "number"), expected)
    for name, value in zip(names, made, strict=True):
        if np.shape(value) != ():
            raise trial.refusal("observe", f"shape {np.shape(value)} for {name}", expected)
        kind = getattr(value, "dtype", type(value).__name__)
        if not isinstance(value, float | int) and kind != np.dtype(float):
            raise trial.refusal("observe", f"{kind} for {name}", "float64")
    once, again = (_ADDRESS.sub("", str(closed)) for closed, *_ in traced)
    if once != again:
        _refuse_change(trial, "observe")
    return rows


def _check_path(
    trial: Trial,
    instrument: TableInstrument,
    chain: Chain,
    plan: Plan,
    rows: Any,
    names: Sequence[str],
) -> np.ndarray:
    """The readings of the nominal machine; raises `StudyError` unless they and their derivatives by
    all ports are finite.
    """
    n, m = plan.rows, len(names)
    still = jnp.zeros((n, len(PortLayout.of(chain.axes, instrument.ports))))
    with trial.calling("observe", _PATH.format(counted(m, "number"))):
        values, slopes = observe_with_jacobian(chain, instrument, plan.position, rows, still)
    values, slopes = np.asarray(values), np.asarray(slopes)
    trial.numbers("observe", values, (n, m), "finite readings of the nominal machine")
    if not np.isfinite(slopes).all():
        row, k, _ = np.argwhere(~np.isfinite(slopes))[0]  # one port affects all
        found = f"no finite derivative of {names[k]} in row {row + 1}"
        expected = "a finite one, also for a length of 0 or an arc cosine of 1"
        raise trial.refusal("observe", found, expected)
    for given in (values, slopes):
        with trial.calling("reduce", f"an array of the shape {given.shape}, by jax.numpy"):
            eqx.filter_eval_shape(lambda i, v, p: i.reduce(v, p), instrument, given, plan)
            reduced = np.asarray(instrument.reduce(jnp.asarray(given), plan))
        trial.numbers("reduce", reduced, given.shape, "as many readings as its argument has")
    values = _reduced(trial, instrument, plan, values)
    with trial.calling("difference", f"an array of the shape {(n, m)}, by jax.numpy"):
        apart = jax.eval_shape(instrument.difference, jnp.asarray(values), jnp.asarray(values))
    if apart.shape != (n, m):
        raise trial.refusal("difference", f"shape {apart.shape}", f"the shape {(n, m)}")
    return values


def _check_sizes(
    trial: Trial,
    instrument: TableInstrument,
    plan: Plan,
    read: np.ndarray,
    present: np.ndarray,
    names: Sequence[str],
) -> None:
    """Check the noise of the readings, and their conversion to lengths."""
    expected = f"standard deviations of the shape {read.shape}, SI"
    noise = _asked(trial, "noise", expected, lambda: instrument.noise(plan, read))
    noise = trial.numbers("noise", noise, read.shape, "standard deviations of the readings, SI")
    if (bad := present & (noise <= 0.0)).any():
        row, k = np.argwhere(bad)[0]
        found = f"{noise[row, k]:g} for {names[k]} in row {row + 1}"
        raise trial.refusal("noise", found, "standard deviations above 0, SI")
    expected = f"metres per unit of the readings, of the shape {read.shape}"
    lengths = _asked(trial, "lengths", expected, lambda: instrument.lengths(plan, read))
    lengths = trial.numbers("lengths", lengths, read.shape, "metres per unit of the readings")
    if lengths.min() < 0.0 or not lengths.any():
        found = f"{lengths.min():g}" + ("" if lengths.any() else " for every reading")
        raise trial.refusal("lengths", found, "metres per unit of the readings, above 0")


def _reduced(
    trial: Trial, instrument: TableInstrument, plan: Plan, values: np.ndarray
) -> np.ndarray:
    """The reduced readings; raises `StudyError` unless the reduction is linear."""
    other = np.random.default_rng(0).standard_normal(values.shape)

    def reduce(values: np.ndarray) -> np.ndarray:
        return np.asarray(instrument.reduce(jnp.asarray(values), plan))

    found, together = reduce(values), reduce(values + 2.0 * other)
    off = np.abs(found + 2.0 * reduce(other) - together)
    if off.max() > _LINEAR * np.abs(together).max() + _NOTHING:
        raise trial.refusal("reduce", "a step that is not linear", "reduce(a + b) to be their sum")
    return found


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


def check_clusters(trial: Trial, clusters: np.ndarray, present: np.ndarray) -> None:
    """Raise `StudyError` unless the rows of every cluster have the same readings present."""
    for k in np.unique(clusters[clusters >= 0]):
        mine = np.flatnonzero(clusters == k)
        other = (present[mine] != present[mine[0]]).any(1)
        if other.any():
            found = f"rows {mine[0] + 1} and {mine[int(np.argmax(other))] + 1} under one index, {k}"
            expected = "the same readings present in all rows of an index"
            raise trial.refusal("clusters", f"{found}, with other readings present", expected)


def _check_folds(trial: Trial, instrument: TableInstrument, plan: Plan) -> np.ndarray:
    """The rows (n,) that no fit uses."""
    expected = "a pair: the fold of every row, and True or False, for all rows or for each"
    found = _asked(trial, "folds", expected, lambda: instrument.folds(plan))
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
        raise trial.refusal("folds", "no rows outside one of them", "at least two folds")
    return apart


def _check_determined(trial: Trial, model: Model, plan: Plan, apart: np.ndarray) -> None:
    """Raise `StudyError` where only rows that no fit uses identify a parameter without a prior."""
    if not apart.any():
        return
    less, every = (flat_rank(model, rows) for rows in (plan.take(~apart), plan))
    if lost := sorted({*less.mixed} - {*every.mixed}):
        names = [f"{model.entries[i].key} {model.entries[i].parameter.name}" for i in lost]
        found = f"all rows that identify {listed(names)} held out of every fit"
        raise trial.refusal("folds", found, "fitted rows for every parameter without a prior")


def _check_effects(
    trial: Trial, instrument: TableInstrument, chain: Chain, plan: Plan
) -> tuple[Effect, ...]:
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
        known = CATALOGUE.get(effect.name)
        if known not in (None, type(effect)) and known.__module__.startswith(INSIDE):
            raise own.refusal("name", f"{effect.name!r}, which is taken", "a name of its own")
    keys = [effect.key for effect in effects]
    if len(set(keys)) < len(keys):
        raise trial.refusal("effects", listed(keys), expected)
    setup = Model(chain, instrument).setup(plan)
    for effect in effects:
        own = Trial(trial.file, type(effect).__name__)
        check_effect(own, effect, setup, plan)
        if missing := [name for name in effect.needs if not plan.has(name)]:
            found = f"{listed(missing)}, which the plan does not have"
            expected = f"what it has; else {trial.kind}.effects has to leave it out"
            raise own.refusal("needs", found, expected)
    return effects


def _check_table(
    trial: Trial,
    instrument: TableInstrument,
    chain: Chain,
    table: Mapping[str, np.ndarray],
    plan: Plan,
    readings: np.ndarray,
) -> None:
    """Raise `StudyError` unless a written table reads back as the same plan and readings."""
    expected = "a dict {column: one cell for every row} that reads back as the same"
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
            return  # only simulations need it, and report it then
    if not isinstance(found, tuple) or len(found) != 2 or not isinstance(found[0], Plan):
        raise trial.refusal("record", type(found).__name__, expected)
    trial.numbers("record", found[1], shape, "recorded readings")
    if found[0].rows != plan.rows:
        raise trial.refusal("record", f"a plan of {found[0].rows} rows", expected)
