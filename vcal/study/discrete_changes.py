"""Changes of a sign, a unit or an order with which the readings follow the declared machine.

A joint that counts the other way, or a link declared in metres, leaves errors of the machine far
outside their declared sizes. Each such change of one machine number or of the columns is tried on
the data: first with the nominal machine, the unknown poses and points fitted, then with the
declared model.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..effects.geometric import GeometricErrors
from ..errors import StudyError
from ..identification.declared_sizes import DeclaredSizes, declared_sizes
from ..identification.fit import Fit
from ..identification.identify import ROUGHLY, identify
from ..identification.posterior import slopes
from ..machine.chain import Chain
from ..model.declared_noise import declared_whitener
from ..model.forward import Model, compared_with_jacobian
from ..model.measurement import Measurement
from .csv_table import Table
from .data_sets import DataSet, together
from .declared_chain import build_chain
from .folder import Folder
from .geometric_family import geometric_errors
from .messages import listed, refusal
from .settings import MachineSettings
from .study import Study

_INCH, _DEG = 25.4, math.degrees(1.0)
_UNITS = {
    "mm": ((1e3, "m"), (1e-3, "um"), (_INCH, "inch"), (1.0 / _INCH, "")),
    "deg": ((_DEG, "rad"), (1.0 / _DEG, "")),
}
"""Factors on a number by its unit, each with the unit in which it may have been written."""
_BETTER = 0.25
"""Largest ratio of the nominal machine's residuals, after to before a change, for a refit."""
_MOST_REFITS = 8
_INSIDE, _NEARER = 10.0, 5.0
"""Declared standard deviations within which all errors lie after a change with which the readings
follow, and the least factor by which the largest has become smaller."""
_COLUMNS, _ORDER, _NUMBER = 0.0, 4.0, 2.0
"""Penalty of a change in chi-square: exchanged columns are rarer than a wrong number, and that is
rarer than a joint that counts the other way."""


@dataclass(frozen=True)
class Change:
    """One change of the columns of the data or of a number of the machine."""

    words: str
    """What is changed, after "with"."""
    penalty: float
    machine: MachineSettings
    columns: Callable[[Table], Mapping[str, np.ndarray]]
    """New values of some columns of a table; those of columns that it lacks are left out."""


def check_declared(study: Study, fit: Fit) -> None:
    """Raise `StudyError` where the declared errors of a fit lie grossly outside their sizes, and
    the readings follow the machine after a change of a sign, a unit or the order of columns.

    The message lists all such changes, the likeliest first.
    """
    noise = math.sqrt(max(1.0, fit.chi2 / fit.dof))
    found = declared_sizes(fit, _declared(fit.model), noise)
    if not found.gross:
        return
    changes = following(study, found)
    if not changes:
        return
    (_, p, times, value), *_ = found.largest
    raise refusal(
        listed([*(one.file for one in study.sets), study.path.name]),
        "columns of positions and readings, table machine",
        f"readings that do not follow the declared machine: its error {p.name} would be "
        f"{value:.3g} {p.unit}, {abs(times):.0f} times its declared size",
        "errors of about their declared sizes",
        f"they follow with {' or with '.join(change.words for change in changes)}: compare "
        + ("it" if len(changes) == 1 else "these, the likeliest first,")
        + " with the machine",
    )


def following(study: Study, found: DeclaredSizes) -> list[Change]:
    """The changes after which the readings follow the declared machine, the likeliest first."""
    machine = study.settings.machine
    folder = Folder(study.folder, study.trust, study.allow_outside)
    now = _nominal_rms(study, Change("", 0.0, machine, lambda table: {}), folder)
    tried = []
    for change in discrete_changes(study):
        rms = _nominal_rms(study, change, folder)
        if rms < _BETTER * now:
            tried.append((rms, change))
    tried.sort(key=lambda pair: pair[0])
    largest = abs(found.largest[0][2])
    follow = []
    for _, change in tried[:_MOST_REFITS]:
        fit = _refitted(study, change, folder)
        if fit is None:
            continue
        its = declared_sizes(fit, _declared(fit.model), math.sqrt(max(1.0, fit.chi2 / fit.dof)))
        farthest = abs(its.largest[0][2]) if its.largest else 0.0
        if farthest <= min(_INSIDE, largest / _NEARER):
            follow.append((fit.cost + change.penalty, change))
    return [change for _, change in sorted(follow, key=lambda pair: pair[0])]


def discrete_changes(study: Study) -> Iterator[Change]:
    """All changes that are tried: of the columns of positions, then of the machine's numbers, then
    of the columns of readings.
    """
    machine = study.settings.machine
    columns = _position_columns(study)
    for name in columns:
        yield Change(f"the other sign in {name}", _COLUMNS, machine, _scaled([name], -1.0))
    for unit in ("deg", "mm"):
        its = [name for name in columns if name.endswith(f"_{unit}")]
        for factor, given in _UNITS[unit][:3]:
            for names in [[name] for name in its] + ([its] if len(its) > 1 else []):
                if given:
                    words = f"{given} turned into {unit} in {', '.join(names)}"
                    yield Change(words, _NUMBER, machine, _scaled(names, factor))
        for a, b in itertools.combinations(its, 2):
            words = f"{a} and {b} exchanged"
            yield Change(words, _ORDER, machine, _exchanged(a, b))
    for key, changed, old, new in _numbers(machine):
        words = f"machine.{key} = {_shown(new)} instead of {_shown(old)}"
        yield Change(words, _NUMBER, changed, lambda table: {})
    for c in "xyz":
        for one in study.sets:
            names = [n for n in one.table if n in one.table.read and n.endswith(f"_{c}_mm")]
            if names and not one.chain.linear:
                words = f"the other sign in {', '.join(names)} (a left-handed frame)"
                yield Change(words, _ORDER, machine, _scaled(names, -1.0))


def _declared(model: Model) -> list[int]:
    return [i for i, effect in enumerate(model.effects) if effect.kind == "systematic"]


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"[{', '.join(f'{v:.6g}' for v in value)}]"


def _scaled(names: Sequence[str], factor: float) -> Callable[[Table], dict[str, np.ndarray]]:
    return lambda table: {name: factor * table[name] for name in names if name in table}


def _exchanged(a: str, b: str) -> Callable[[Table], dict[str, np.ndarray]]:
    return lambda table: {a: table[b], b: table[a]} if a in table and b in table else {}


def _position_columns(study: Study) -> list[str]:
    """Columns of the tables that hold the positions of the axes, in the order of the axes."""
    found: dict[str, None] = {}
    for one in study.sets:
        table = one.table.complete
        for values in np.asarray(one.plan.position).T:
            if len(values) != table.rows or not np.ptp(values) > 0.0:
                continue
            for name, column in table.items():
                factor = {"deg": _DEG, "mm": 1e3}.get(name.rpartition("_")[2])
                if factor is not None and np.allclose(column, factor * values, rtol=1e-9):
                    found[name] = None
                    break
    return list(found)


def _numbers(machine: MachineSettings) -> Iterator[tuple[str, MachineSettings, Any, Any]]:
    """Key, changed machine, old and new value of every change of a number of the machine."""
    for i, joint in enumerate(machine.joint):
        for key, value in joint:
            if not isinstance(value, float) or not value or key.startswith(("low_", "high_")):
                continue
            for new in _values(key, value):
                row = joint.model_copy(update={key: new})
                rows = (*machine.joint[:i], row, *machine.joint[i + 1 :])
                changed = machine.model_copy(update={"joint": rows})
                yield f"joint.{i}.{key}", changed, value, new
    for axis, rotary in machine.rotary.items():
        for new in _vectors(rotary.at_mm):
            row = rotary.model_copy(update={"at_mm": new})
            changed = machine.model_copy(update={"rotary": {**machine.rotary, axis: row}})
            yield f"rotary.{axis}.at_mm", changed, rotary.at_mm, new
    for new in _vectors(machine.tool_offset_mm):
        changed = machine.model_copy(update={"tool_offset_mm": new})
        yield "tool_offset_mm", changed, machine.tool_offset_mm, new


def _values(key: str, value: float) -> list[float]:
    factors = [-1.0, *(factor for factor, _ in _UNITS.get(key.rpartition("_")[2], ()))]
    return [factor * value for factor in factors]


def _vectors(value: Sequence[float]) -> list[tuple[float, ...]]:
    """A vector in another unit, or with another sign of one component or of all."""
    if not any(value):
        return []
    changed = [tuple(f * v for v in value) for f in (-1.0, *(f for f, _ in _UNITS["mm"]))]
    for i, v in enumerate(value):
        if v and sum(1 for other in value if other) > 1:
            changed.append(tuple(-w if k == i else w for k, w in enumerate(value)))
    return changed


def _assembled(study: Study, change: Change, folder: Folder) -> tuple[Model, Measurement] | None:
    """The nominal machine with the nuisances of its instruments, and the readings, after a change;
    None where the instrument or the machine cannot be built.
    """
    file = study.path.name
    try:
        chain = build_chain(change.machine, file, folder)
        sets = [_rebuilt(one, study, chain, change, folder) for one in study.sets]
        instrument, plan, readings = together(sets, chain)
    except (StudyError, ValueError, np.linalg.LinAlgError):
        return None
    assert readings is not None
    return Model(chain, instrument, instrument.effects(plan)), Measurement(plan, readings)


def _rebuilt(one: DataSet, study: Study, chain: Chain, change: Change, folder: Folder) -> DataSet:
    whole = one.table.complete
    table = Table(whole.name, whole.lines, whole.numbers, tuple(whole.read))
    table.update({**whole, **change.columns(whole)})
    own = np.asarray(one.chain.tool_offset) - np.asarray(study.chain.tool_offset)
    if one.name and own.any():
        chain = replace(chain, tool_offset=np.asarray(chain.tool_offset) + own)
    kind = type(one.instrument)
    instrument = kind.build(one.settings, chain, table, folder.table)
    plan = instrument.plan(chain, table)
    readings = instrument.measured(table)
    instrument = instrument.start(chain, plan, readings)
    return replace(one, instrument=instrument, chain=chain, plan=plan, readings=readings)


def _nominal_rms(study: Study, change: Change, folder: Folder) -> float:
    """Median of the residuals of the nominal machine in units of the noise, with the parameters
    without a prior fitted; infinite where the change is impossible.

    These parameters are fitted linearly, about the starting values that the instrument takes from
    the readings.
    """
    built = _assembled(study, change, folder)
    if built is None:
        return math.inf
    model, measurement = built
    plan, width = measurement.plan, len(model.layout)
    residual, by_port = compared_with_jacobian(
        model.chain,
        model.instrument,
        plan,
        model.instrument.rows(plan),
        measurement.readings,
        np.zeros((plan.rows, width)),  # type: ignore[arg-type]
    )
    flat = np.array([not e.parameter.informed for e in model.entries], bool)
    J = np.asarray(slopes(model.effects, model, plan, np.asarray(by_port)))[:, :, flat]  # type: ignore[arg-type]
    whitener = declared_whitener(model, measurement)
    r = np.einsum("nij,nj->ni", whitener, np.asarray(residual)).reshape(-1)
    J = np.einsum("nij,njk->nik", whitener, J).reshape(len(r), -1)
    if not np.isfinite(r).all() or not np.isfinite(J).all():
        return math.inf
    left = r - J @ np.linalg.lstsq(J, r)[0]
    lengths = np.linalg.norm(left.reshape(plan.rows, -1), axis=1)
    return float(np.median(lengths))


def _refitted(study: Study, change: Change, folder: Folder) -> Fit | None:
    """The declared model after a change; None where its fit does not converge."""
    built = _assembled(study, change, folder)
    if built is None:
        return None
    model, measurement = built
    geometric = study.settings.model.geometric
    instruments = {effect.key for effect in model.effects}
    others = [
        effect
        for effect in study.model.effects
        if not isinstance(effect, GeometricErrors) and effect.key not in instruments
    ]
    try:
        if geometric is not None:
            errors = geometric_errors(geometric, model.chain, folder, study.path.name)
            model = Model(model.chain, model.instrument, (errors, *model.effects, *model.random))
        model = model.with_effects(*others)
        fit = identify(model, measurement, room=len(study.model.entries) + 16, tolerance=ROUGHLY)
    except (StudyError, ValueError, np.linalg.LinAlgError):
        return None
    return fit if fit.converged and fit.determined else None
