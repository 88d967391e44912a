"""The import itself: exports in, a whole study folder out."""

import csv
import datetime
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from ..errors import StudyError
from ..files import naming, write_file
from ..study import load_study
from ..study.folder import made_whole, require_empty
from ..study.messages import at, listed, refusal
from ..words import counted, printable
from .base import Columns, DataSet, Format, Machine, Needs, Options, joined
from .export import Export
from .machine import SETUP, TOOL_OFFSET, built, completed, declared, offset_of, with_overrides
from .recognise import recognised

_GEOMETRIC = {
    False: {
        "family": "smooth",
        "translation_um": 10.0,
        "rotation_urad": 15.0,
        "squareness_urad": 30.0,
    },
    True: {"link_translation_um": 300.0, "link_rotation_urad": 1000.0},
}
"""Prior sizes of the errors of a machine tool and of an arm, as in the start studies."""


@dataclass(frozen=True)
class Imported:
    """What an import wrote."""

    folder: Path
    formats: Sequence[str]
    """Format of every file."""
    files: Sequence[str]
    """Names of the files in the folder."""
    rows: Mapping[str, int]
    """Rows per table."""
    notes: Sequence[str]
    """What was converted, left out or assumed."""


def import_study(
    files: Sequence[Path],
    out: Path,
    *,
    format_name: str | None = None,
    machine: str | None = None,
    tool_offset: str | None = None,
    options: Options | None = None,
    overrides: Sequence[str] = (),
    checked: bool = True,
    allow_outside: bool = False,
) -> Imported:
    """Write the study folder `out` from exports.

    `machine` is a chain, a study file or a URDF file; a URDF file among `files` is the machine as
    well. Several tables become several data sets, each with an instrument of its own. `overrides`
    set keys of the study file, where ``instrument.KEY`` concerns every data set. With `checked`,
    the folder is read as by ``vcal check`` before it appears. Files that the study of `machine`
    names outside its folder are only read with `allow_outside`.

    Raises `StudyError` with one message for whatever is wrong or lacking; nothing is written then.
    """
    require_empty(out)
    options = replace(options or Options(), given=_instrument_keys(overrides))
    exports = [Export(path) for path in files]
    formats = [recognised(export, format_name) for export in exports]
    needs = Needs()
    machines = [
        (export, tree)
        for export, kind in zip(exports, formats, strict=True)
        if (tree := kind.machine(export)) is not None
    ]
    tree, extra = _one_machine(machine, machines, allow_outside)
    if tree is not None and tool_offset is not None:
        tree = {**tree, "tool_offset_mm": offset_of(tool_offset)}
    table: dict[str, Any] = {}
    its: Machine | None = None
    if tree is not None:
        table, its = built(tree, extra, overrides)
    carriers = [export for export, _ in machines]
    sets: list[DataSet] = []
    for export, kind in zip(exports, formats, strict=True):
        if export in carriers and len(carriers) < len(exports):
            continue
        parts = kind.read(export, options, its, needs)
        if kind.joined and (same := [one for one in sets if one.instrument["kind"] == kind.joined]):
            sets[sets.index(same[0])] = joined(same[0], parts)
        else:
            sets += parts
    notes = [f"{one.name}: {note}" if len(sets) > 1 else note for one in sets for note in one.notes]
    if its is not None and sets:
        notes += completed(table, its, _together(sets), needs)
    where = listed(export.name for export in exports)
    if needs and not sets:
        _expect(formats, its, tool_offset, overrides, needs)
    sets = _named(sets)
    if its is not None and sets:
        written = _tree(out, exports, table, its, sets)
        study = with_overrides(tomli_w.dumps(written), overrides, len(sets))
        _check_keys(study, sets, needs)
    needs.check(where)
    if its is None or not sets:
        raise refusal(where, "file", "nothing to write", "a table of readings", "name one")
    sizes = "machine tool" if not its.arm else "arm"
    notes.append(f"[model.geometric] holds the usual sizes of the errors of a {sizes}: review them")
    head = _head(exports, [kind.name for kind in formats], notes)
    with made_whole(out) as work:
        _write(work, head + _toml(study), sets, its)
        if checked:
            try:
                load_study(work)
            except StudyError as error:
                raise StudyError(
                    f"{where}: the imported study does not pass its check, so that nothing was "
                    f"written. {error} (--unchecked writes it all the same)"
                ) from error
        names = sorted(path.name for path in work.iterdir())
    rows = {_file(one, len(sets)): _length(one.columns) for one in sets}
    return Imported(out, [kind.name for kind in formats], names, rows, notes)


def _one_machine(
    given: str | None, found: Sequence[tuple[Export, Mapping[str, Any]]], outside: bool
) -> tuple[Mapping[str, Any] | None, dict[str, bytes]]:
    if len(found) + (given is not None) > 1:
        names = [export.name for export, _ in found] + ([f"--machine {given}"] if given else [])
        raise refusal(
            listed(names), "machine", "several machines", "one per study", "leave one of them out"
        )
    if given is not None:
        return declared(given, outside)
    if found:
        export, tree = found[0]
        return tree, {export.name: export.data}
    return None, {}


def _together(sets: Sequence[DataSet]) -> dict[str, np.ndarray]:
    """The columns of numbers of all data sets below one another."""
    found: dict[str, list[np.ndarray]] = {}
    for one in sets:
        for name, values in one.columns.items():
            if np.asarray(values).dtype.kind in "biuf":
                found.setdefault(name, []).append(np.asarray(values, float))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _named(sets: Sequence[DataSet]) -> list[DataSet]:
    """The data sets with names that a study may have, each once."""
    named: list[DataSet] = []
    for one in sets:
        name = re.sub(r"[^A-Za-z0-9_-]+", "_", one.name).strip("_-") or "set"
        taken = {other.name for other in named}
        count, own = 2, name
        while own in taken:
            own, count = f"{name}_{count}", count + 1
        named.append(replace(one, name=own))
    return named


def _file(one: DataSet, several: int) -> str:
    return "data.csv" if several == 1 else f"{one.name}.csv"


def _tree(
    out: Path,
    exports: Sequence[Export],
    table: Mapping[str, Any],
    machine: Machine,
    sets: Sequence[DataSet],
) -> dict[str, Any]:
    """The tree of the study file, without the overrides of the user."""
    tree: dict[str, Any] = {"name": printable(out.name, lines=False) or exports[0].name}
    tree["machine"] = dict(table)
    if len(sets) == 1:
        tree["instrument"] = dict(sets[0].instrument)
        tree["data"] = {"data": _file(sets[0], 1)}
    else:
        tree["data"] = [
            {"name": s.name, "file": _file(s, len(sets)), "instrument": dict(s.instrument)}
            for s in sets
        ]
    tree["model"] = {"geometric": dict(_GEOMETRIC[machine.arm])}
    return tree


def _check_keys(study: Mapping[str, Any], sets: Sequence[DataSet], needs: Needs) -> None:
    """Add to `needs` the keys of the instruments that only the user knows."""
    for i, one in enumerate(sets):
        above: tuple[str | int, ...] = () if len(sets) == 1 else ("data", i)
        for key, meaning in one.needed.items():
            if at(study, (*above, "instrument", key)) is None:
                needs.add(f"--set instrument.{key}=VALUE", meaning)


def _instrument_keys(overrides: Sequence[str]) -> dict[str, Any]:
    """The keys of the instrument among the overrides, with their values."""
    own = [text for text in overrides if text.partition("=")[0].strip().startswith("instrument.")]
    return with_overrides("", own, 1).get("instrument", {})


def _expect(
    formats: Sequence[Format],
    machine: Machine | None,
    tool_offset: str | None,
    overrides: Sequence[str],
    needs: Needs,
) -> None:
    """Add to `needs` what will be lacking next, so that one message has it all."""
    given = {text.partition("=")[0].strip().rpartition(".")[2] for text in overrides}
    if machine is None and tool_offset is None and any(kind.levers for kind in formats):
        needs.add(*TOOL_OFFSET)
    for kind in formats:
        for key, meaning in kind.keys.items():
            if key not in given:
                needs.add(f"--set instrument.{key}=VALUE", meaning)


def _toml(tree: Mapping[str, Any]) -> str:
    """A tree as TOML, with short lists in one line."""
    text = tomli_w.dumps(tree)
    return re.sub(
        r"\[\n((?: +[^\[\]{}\n]+,\n){1,9})\]",
        lambda m: "[" + ", ".join(p.strip().rstrip(",") for p in m[1].splitlines()) + "]",
        text,
    )


def _sentence(note: str) -> str:
    """A note with a capital letter, unless it begins with a key."""
    return f"{note if '.' in note.split(' ')[0] else note[0].upper() + note[1:]}."


def _head(exports: Sequence[Export], formats: Sequence[str], notes: Sequence[str]) -> str:
    """Comment lines on the origin of the study."""
    lines = [f"Imported by vcal on {datetime.date.today().isoformat()} from:"]
    for export, kind in zip(exports, formats, strict=True):
        lines.append(f"  {export.name} ({kind}), SHA-256 {export.sha256}")
    lines += ["", *map(_sentence, notes), ""]
    lines += ["vcal check setup.toml reads and checks the folder; the reference of the study file"]
    lines += ["describes all further keys."]
    return "".join(f"# {printable(line, lines=False)}".rstrip() + "\n" for line in lines) + "\n"


def _write(work: Path, text: str, sets: Sequence[DataSet], machine: Machine) -> None:
    write_file(work / SETUP, text)
    for one in sets:
        _write_columns(work / _file(one, len(sets)), one.columns)
        for name, data in one.files.items():
            write_file(work / name, data)
    for name, data in machine.files.items():
        write_file(work / name, data)


def _write_columns(path: Path, columns: Columns) -> None:
    """Write a table with every digit of its numbers: they are those of the export."""
    cells = []
    for values in columns.values():
        if np.asarray(values).dtype.kind in "biu":
            cells.append([str(int(v)) for v in values])
        else:
            cells.append([v if isinstance(v, str) else repr(float(v)) for v in values])
    with naming(path), open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*cells, strict=True))


def _length(columns: Columns) -> int:
    return len(next(iter(columns.values())))


def summary(done: Imported) -> list[str]:
    """Sentences for the command line."""
    tables = ", ".join(f"{name} ({counted(rows, 'row')})" for name, rows in done.rows.items())
    others = [name for name in done.files if name not in done.rows]
    return [
        f"Wrote {done.folder} from {listed(dict.fromkeys(done.formats))}: {tables}, "
        f"{listed(others)}.",
        *(f"Note: {note}." for note in done.notes),
    ]
