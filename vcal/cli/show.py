"""What commands print: a compact summary on stdout; the details are in the written files."""

import inspect
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ..effects.base import Effect, Setup
from ..effects.cyclic import ScrewCyclic
from ..effects.reference import with_known_reference
from ..instruments.base import averaged_of, remarks_of
from ..instruments.conditions import file_name, inside_name
from ..loop.outcome.closure import Closure, Errors
from ..loop.residuals.confounded import confounding
from ..loop.residuals.implausible import implausible
from ..loop.residuals.times import backwards
from ..loop.screening.candidates import candidates
from ..loop.screening.spanned import spanned_on_plan
from ..loop.screening.unconverted import not_shown
from ..loop.weighing.cross_validation import Rms
from ..machine.chain import Joint
from ..machine.plan import Plan
from ..model.measurement import Measurement, rows_in_words
from ..report.html.text import COVERAGE, probability, with_uncertainty
from ..report.loop.could_be_seen import why
from ..report.loop.derived import FEW, Listed, declared, in_short, missing_columns, parameters
from ..study import Study
from ..study.csv_table import Table as CsvTable
from ..study.data_sets import DataSet
from ..study.declared_effects import choices
from ..study.messages import listed as in_list
from ..study.messages import shown
from ..study.observed_errors import observed_errors
from ..study.reading.text import PLAIN
from ..study.study import looked_for
from ..study.unseen_errors import determined_errors
from ..words import counted, plural, printable, three_digits

_MOST_PITCHES = 6
"""Most pitches that one line lists."""
_MOST = 6
_MOST_COMPARED = 100
"""Most columns that are compared with each other."""
_FEW_RIVALS, _LEAST_PROBABILITY = 3, 0.05
"""Largest number of rivals that are printed, and the least probability of one."""
_LITTLE = 0.3
"""Share of a travel below which the coverage of an axis is reported."""


def decision_in(report: Path) -> str:
    """The decision on the tolerance in the record of a report; empty without one."""
    record = json.loads((report / "report.json").read_text(encoding="utf-8"))
    return record.get("acceptance", {}).get("sentence", "")


def show_closure(closure: Closure) -> None:
    """Print the verdict, the effects found, and the errors before and after."""
    console = _console()
    console.print(_text(closure.sentence, style="bold"))
    for found in (*closure.found, *closure.hints):
        if closure.hints and found is closure.hints[0]:
            console.print(Text("Hints, compensated by the average of what each may be:"))
        values = _values(parameters(closure, found))
        at = f"if it is {found.effect.key}, " if found.joint else ""
        console.print(
            _text(
                f"  {found.effect.name} {found.placement}".rstrip()
                + f": {at}{values}, {_probability(found.p_value)}, {found.status}"
            ),
            soft_wrap=True,
        )
        if found.hint:
            console.print(_text(f"    a hint only: {found.hint}"))
        if found.equivalent:
            console.print(_text(f"    equivalent on these data: {', '.join(found.equivalent)}"))
        if instead := [
            f"{name} {place}".strip() + f" ({100 * p:.0f} %)"
            for name, place, p in found.alternatives[:_FEW_RIVALS]
            if p >= _LEAST_PROBABILITY
        ]:
            console.print(_text(f"    alternatives: {', '.join(instead)}"))
        if found.separation:
            console.print(_text(f"    to decide: {found.separation}"))
    for effect, listed in declared(closure):
        if any(u > 0.0 for *_, u in listed):
            many = len(listed) > FEW
            values = in_short(effect, listed) if many else f"{_values(listed)}, declared"
            console.print(_text(f"  {effect.key}: {values}"), soft_wrap=True)
    if closure.unexplained is not None:
        console.print(_text(f"  {closure.unexplained.reason}"))
    console.print(_errors_table(closure.errors))
    if closure.suspected:
        plan = closure.after.measurement.plan
        rows = ", ".join(plan.row_name(s.row) for s in closure.suspected[:_MOST])
        more = ", ..." if len(closure.suspected) > _MOST else ""
        console.print(_text(f"Outliers, left out of the fit: rows {rows}{more}."))
    for note in closure.notes:
        console.print(_text(f"Note: {note}."))


def _probability(p: float) -> str:
    shown = probability(p)
    return f"p {shown}" if shown[0] in "<>" else f"p = {shown}"


def _values(listed: Listed) -> str:
    values = (
        f"{name} = {with_uncertainty(value, COVERAGE * u)} {unit}".rstrip()
        for name, value, unit, u in listed
    )
    return f"{', '.join(values)} (k = {COVERAGE:g})"


def _errors_table(errors: Mapping[Any, Errors]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    table.add_column("rms error, µm,\n± one standard uncertainty")
    for name in errors:
        table.add_column(name, justify="right")

    def row(label: str, cells: Iterable[str]) -> None:
        table.add_row(label, *cells)

    every = list(errors.values())
    if all(e.check is not None for e in every):
        row("check points, aligned", (_rms(e.check) for e in every))
    row("held-out readings", (_rms(e.heldout) for e in every))
    row("fitted readings", (three_digits(e.fit.value) for e in every))
    row("chi² per degree of freedom", (three_digits(e.chi2_per_dof) for e in every))
    for name in every[0].sets:
        row(f"held-out readings of {name}", (_rms(e.sets[name].heldout) for e in every))
        row(f"chi² per dof of {name}", (three_digits(e.sets[name].chi2_per_dof) for e in every))
    return table


def _rms(rms: Rms | None) -> str:
    return "" if rms is None else with_uncertainty(rms.value, rms.u)


def show_study(study: Study) -> None:
    """Print the contents of a study, and which effects the loop can test on it."""
    show_rows(study, study_rows(study))


def show_rows(study: Study, rows: Iterable[tuple[str, str]]) -> None:
    """Print lines about a study: label and text."""
    console = _console()
    console.print(_text(f"{study.name}: {study.path} can be used.", style="bold"), soft_wrap=True)
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 2))
    for label, value in rows:
        table.add_row(_text(label), _text(value))
    console.print(table)


def study_rows(study: Study) -> list[tuple[str, str]]:
    """The contents of a study, and which effects the loop can test on it: label and text."""
    plan, chain = study.plan, study.chain
    readings = len(study.instrument.readings)
    travels = ", ".join(_travel(j) for j in chain.joints if np.isfinite(j.travel).all())
    measurement = study.measurement or Measurement(plan, np.zeros((plan.rows, readings)))
    found, missing = candidates(study.model, measurement, study.tried)
    rows = [
        ("machine", f"{chain.text}; {travels}" if travels and not chain.arm else chain.text),
        *(line for one in study.sets for line in _data_set(study, one)),
        *(("times", words) for words in backwards(plan)),
        *(
            ("implausible", words)
            for words in implausible(
                chain,
                plan,
                study.instrument,
                None if study.measurement is None else study.measurement.readings,
            )
        ),
        ("check points", str(study.check.plan.rows) if study.check else "none"),
        *(
            row
            for name, table in study.tables.items()
            if name not in study.files.values()
            for row in _read_as(name, table, f" of {name}")
        ),
        *_lacking(study, [*study.model.effects, *found]),
        (
            "declared",
            ", ".join(_size(effect) for effect in (*study.model.effects, *study.model.random)),
        ),
        *(row for one in study.sets for row in _determined(one)),
        ("to be tested", _kinds(found)),
        *_aliased(found, plan),
        *_identified(study),
        *_unseen(study),
        *(("averaged", words) for words in averaged_of(study.instrument)),
        *(("compare", remark) for remark in remarks_of(study.instrument)),
    ]
    wanted: dict[str, list[str]] = {}
    for item in missing:
        why = missing_columns(item, plan) or [item.reason]
        wanted.setdefault(item.effect, []).extend(why)
    alike: dict[tuple[str, ...], list[str]] = {}
    for effect, why in wanted.items():
        alike.setdefault(tuple(dict.fromkeys(why)), []).append(effect)
    for why, effects in alike.items():
        verb = "need" if effects[1:] else "needs"
        rows.append(("not testable", f"{', '.join(effects)}: {verb} {', '.join(_short(why))}"))
    for effect in [*study.model.effects, *found]:
        shape = {name: grid[len(grid) // 2] for name, grid in effect.scan(plan).items()}
        for column in not_shown(effect, plan, shape):
            rows.append(("units", f"{effect.key}: {column.words}"))
    return rows


def _identified(study: Study) -> list[tuple[str, str]]:
    """Rank of the errors of the machine, and its null directions; an instrument of lines has rows
    of its own (`_determined`).
    """
    if any(one.instrument.shows_unseen for one in study.sets):
        return []
    found = observed_errors(study.chain, study.instrument, study.plan)
    return [] if found is None else [("identified", found.words)]


def _unseen(study: Study) -> list[tuple[str, str]]:
    """Effects of which no size can be seen on this plan, by what takes them up."""
    given = study.plan if study.measurement is None else study.measurement
    alike: dict[str, dict[str, set[str]]] = {}
    for one in spanned_on_plan(study.model, given, study.tried) or ():
        words = " ".join(p.name for p in one.effect.amplitudes)
        errors = re.findall(r"(?<![A-Z])E[A-CX-Z][A-Z]\d*(?![A-Z])", words)
        alike.setdefault(why(one), {}).setdefault(one.effect.key, set()).update(errors)
    rows = []
    for reason, keys in alike.items():
        named = [f"{key} ({', '.join(sorted(of))})" if of else key for key, of in keys.items()]
        rows.append(("not visible", f"{', '.join(named)}: {reason}"))
    return rows


def _aliased(effects: Iterable[Effect], plan: Plan) -> list[tuple[str, str]]:
    """Pitches that equal steps of an axis cannot distinguish, or do not show."""
    rows = []
    for effect in effects:
        found = effect.aliases(plan) if isinstance(effect, ScrewCyclic) else None
        if found is None:
            continue
        (p,) = effect.shapes
        said = []
        for verb, pitches in (("distinguished", found.alike), ("seen", found.unseen)):
            if len(pitches) > (verb == "distinguished"):
                some = ", ".join(f"{v / p.si:.4g}" for v in pitches[:_MOST_PITCHES])
                more = len(pitches) > _MOST_PITCHES
                many = f", ... {p.unit} ({len(pitches)} in all)" if more else f" {p.unit}"
                said.append(f"pitches of {some}{many} cannot be {verb}")
        if said:
            axis, step = effect.placement, f"{found.step / p.si:.4g} {p.unit}"
            rows.append(("aliased", f"positions of {axis} every {step}: {'; '.join(said)}"))
    return rows


def _data_set(study: Study, one: DataSet) -> list[tuple[str, str]]:
    """Instrument and table of a data set, with its name where a study has several."""
    rows, of = one.plan.rows, f" of {one.name}" if one.name else ""
    header = one.table.header
    return [
        (f"instrument{of}", one.settings.kind),
        (
            f"data{of}",
            f"{counted(rows, 'row')} of {counted(len(one.instrument.readings), 'reading')}"
            if one.readings is not None
            else f"{counted(rows, 'row')} without readings: a plan",
        ),
        *_blank(one, of),
        *_read_as(one.file, one.table, of),
        (f"columns{of}", ", ".join(column for column in header if column in one.table)),
        *_ignored(one, header, of),
        *_constant(one.plan, header, of),
        *_covered(one, of),
        *_together(one, header, of),
    ]


def _read_as(name: str, table: CsvTable, of: str) -> list[tuple[str, str]]:
    """What kind of file a table is, and the columns that are converted or renamed."""
    rows = [(f"read{of}", each.words) for each in table.changed]
    if rows or table.kind != PLAIN:
        rows.insert(0, (f"file{of}", f"{name}: {table.kind}"))
    if table.unused:
        rows.append(
            (f"not used{of}", f"{', '.join(table.unused)}: the mapping names another column")
        )
    return rows


def _determined(one: DataSet) -> list[tuple[str, str]]:
    """Rank of the lines for the error motions of the machine, and the errors they do not show."""
    if not one.instrument.shows_unseen:
        return []
    found, of = determined_errors(one.chain, one.instrument, one.plan), ""
    if one.name:
        of = f" of {one.name}"
    rows = [
        (
            f"rank{of}",
            f"{found.rank} of {found.columns} coefficients of the {found.errors} errors "
            "(Legendre degrees up to 3), without a prior",
        )
    ]
    if found.unseen:
        rows.append(
            (
                f"not shown{of}",
                f"{', '.join(found.unseen)}: not read, or part of the zero or alignment of a line",
            )
        )
    if found.mixed:
        words = "in part not separated from each other, or from the zero, slope or alignment"
        rows.append((f"not separated{of}", f"{', '.join(found.mixed)}: {words}"))
    return rows


def _blank(one: DataSet, of: str) -> list[tuple[str, str]]:
    """Rows with a blank reading."""
    if not (rows := one.table.blank_rows):
        return []
    return [(f"left out{of}", f"{rows_in_words(rows)}: a reading is blank")]


def _ignored(one: DataSet, header: Sequence[str], of: str) -> list[tuple[str, str]]:
    """Columns that are ignored, as most of their cells are not numbers."""
    columns = [column for column in header if column and column not in one.table]
    if not columns:
        return []
    return [(f"ignored{of}", f"{in_list(columns)}: no more than half of the cells are numbers")]


def _constant(plan: Plan, header: Collection[str], of: str) -> list[tuple[str, str]]:
    """Recorded columns that effects could depend on, but that are constant."""
    still = (name for name in (*plan.axes, *plan.covariates) if np.ptp(plan.values(name)) == 0)
    there = {file_name(inside_name(c, plan.axes), plan.axes): c for c in header}
    columns = [there[c] for c in (file_name(name, plan.axes) for name in still) if c in there]
    if not columns:
        return []
    whose = "their" if columns[1:] else "its"
    return [(f"constant{of}", f"{in_list(columns)}: effects of {whose} variation are not seen")]


def _travel(joint: Joint) -> str:
    unit, factor = ("deg", math.degrees(1.0)) if joint.turns else ("mm", 1e3)
    low, high = factor * np.asarray(joint.travel)
    return f"{joint.name} {low:g} to {high:g} {unit}"


def _covered(one: DataSet, of: str) -> list[tuple[str, str]]:
    """Axes of which the measurement covers a small part of the travel.

    Most of their errors are not observed, or the travel is that of another machine or in another
    unit.
    """
    found = []
    for joint in one.chain.joints:
        if joint.kind == "revolute" or not np.isfinite(joint.travel).all():
            continue
        share = np.ptp(one.plan.values(joint.name)) / np.ptp(joint.travel)
        if 0.0 < share < _LITTLE and not one.instrument.positioned:
            found.append(f"{100 * share:.2g} % of {joint.name}")
    covered = f"{', '.join(found)}: errors of the rest of the travel are not seen"
    return [(f"covered{of}", covered)] if found else []


def _together(one: DataSet, header: Collection[str], of: str) -> list[tuple[str, str]]:
    """Conditions that correlate with a position or with each other, so that effects of them are
    hard to separate.
    """
    if one.instrument.positioned:  # its circles are fixed by the instrument
        return []
    axes = one.plan.axes
    inside = {column: inside_name(column, axes) for column in header}
    # The motion of an axis follows from its positions.
    names = [n for c, n in inside.items() if n == "t" or n == c or n.startswith("T_")]
    names = [n for n in names if n in one.plan.covariates]
    if len(names) > _MOST_COMPARED:  # every pair would be compared; own columns come last
        names = [n for n in names if n == "t" or n.startswith("T_")][:_MOST_COMPARED]
    lines = confounding(one.plan, names)
    return [(f"confounded{of}", line) for line in lines]


def _lacking(study: Study, effects: Iterable[Effect]) -> list[tuple[str, str]]:
    """Columns that the check points lack, although effects of the machine depend on them."""
    if study.check is None:
        return []
    plan = study.check.plan
    lacking: dict[str, dict[str, None]] = {}
    for effect in effects:
        if effect.where == "machine" and effect.kind != "nuisance":
            for need in effect.needs:
                if not plan.has(need):
                    lacking.setdefault(file_name(need, plan.axes), {})[effect.name] = None
    alike: dict[tuple[str, ...], list[str]] = {}
    for column, names in lacking.items():
        alike.setdefault(tuple(names), []).append(column)
    return [
        (
            "lacking there",
            f"{', '.join(columns)}: without {plural(len(columns), 'it', 'them')}, the error at the "
            f"check points excludes {', '.join(names)}",
        )
        for names, columns in alike.items()
    ]


def _size(effect: Effect) -> str:
    count = len(effect.parameters)
    return f"{effect.key} ({counted(count, 'parameter')})"


def _kinds(found: list[Effect]) -> str:
    names = list(dict.fromkeys(effect.name for effect in found))
    if not names:
        return "none"
    # An effect with a free reference value is tried beside itself with the declared one.
    own = [e for e in found if len(with_known_reference(e).parameters) == len(e.parameters)]
    count = f"{counted(len(own), 'candidate')} of {counted(len(names), 'kind')}"
    return f"{count}: {', '.join(names)}"


def _short(texts: Sequence[str]) -> list[str]:
    return [*texts] if len(texts) <= _MOST else [*texts[:_MOST], f"{len(texts) - _MOST} more"]


def show_catalogue(catalogue: Iterable[type[Effect]]) -> None:
    """Print the effects with their summaries."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("effect")
    table.add_column("description")
    for effect in catalogue:
        only = "" if looked_for(effect) else " (only if declared)"
        table.add_row(_text(effect.name), _text(effect.summary + only))
    _console().print(table)


def show_effect(effect: type[Effect], example: tuple[Effect, Setup] | None) -> None:
    """Print the description of an effect, and the keys and columns of an example."""
    console = _console()
    console.print(_text(f"{effect.name}: {effect.summary}", style="bold"), soft_wrap=True)
    console.print(_text(f"\n{inspect.cleandoc(effect.__doc__ or '')}\n"), soft_wrap=True)
    console.print(_text(f"Disturbs the {effect.where}; {effect.kind}."))
    if not looked_for(effect):
        console.print(_text("The loop does not search for it; a study can declare it."))
    if example is None:
        return
    instance, setup = example
    priors = (
        f"{p.label} (searched)" if p.shape else f"{p.label} ({p.sigma:g})"
        for p in instance.parameters
    )
    columns = dict.fromkeys(file_name(need, setup.plan.axes) for need in instance.needs)
    place = f"placement {instance.placement}" if instance.placement else "no placement"
    chosen = "".join(
        f"  {key}, required: {' or '.join(_plain(value) for value in values)}\n"
        for key, values in choices(instance, setup).items()
    )
    console.print(
        _text(
            f"For example, with {place}:\n{chosen}"
            f"  parameters (standard deviation of the prior): {', '.join(priors)}\n"
            f"  depends on: {', '.join(columns) or 'no recorded column'}"
        ),
        soft_wrap=True,
    )


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else shown(value)


def _text(words: str, style: str = "") -> Text:
    """A text for the terminal, in which the user's own words cannot control it."""
    return Text(printable(words), style=style)


def _console() -> Console:
    return Console(highlight=False)
