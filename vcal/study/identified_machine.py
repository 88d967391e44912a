"""The machine that a closed loop has identified, from the closure itself or from its report."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..compensation.machine import IdentifiedMachine
from ..compensation.stored import SCHEMA, machine_from
from ..errors import StudyError
from ..numerics.stored import NotStoredError
from .messages import refusal, shown

if TYPE_CHECKING:
    from ..loop.outcome.closure import Closure
    from .study import Study

FILE = "machine.json"
"""Name of the record in the folder of a report."""
_REPORT, _PAGE = "report.json", "index.html"


_BLOCK = 256
_FEWEST = 32
"""Check points of which a block of rows may consist."""
_OF_MACHINE = ("manufacturer", "model", "serial_number")


def identified_machine(closure: "Closure", study: "Study", date: str = "") -> IdentifiedMachine:
    """The machine of a closure: its final fit, the models that compete with the effects found, the
    check points, and what the study states of it (`stated_of`).
    """
    rows = 0 if closure.check is None else closure.check.plan.rows
    return IdentifiedMachine.of_fit(
        closure.after,
        alternatives=closure.alternatives,
        check=None if closure.check is None else closure.check.plan,
        name=study.name,
        date=date,
        no_gain=closure.no_gain,
        about=stated_of(study),
        block=rows if rows >= _FEWEST else _BLOCK,  # check points are compiled already
    )


def stated_of(study: "Study") -> dict[str, dict[str, Any]]:
    """What a study states of its machine, instruments, tolerance, measurement and certificate, by
    table.
    """
    from .statements import stated  # imported here: a machine that is read back needs no study

    given = study.settings
    machine = {key: getattr(given.machine, key) for key in _OF_MACHINE}
    machine = {key: value for key, value in machine.items() if value is not None}
    kinds = {one.name or one.settings.kind: one.settings.kind for one in study.sets}
    return {"instruments": kinds, **({"machine": machine} if machine else {})} | stated(
        acceptance=given.acceptance, measurement=given.measurement, certificate=given.certificate
    )


def is_report(path: Path) -> bool:
    """Whether a path is the folder of a report, or the page or the record of one."""
    if path.is_dir():
        return (path / FILE).is_file() or (path / _REPORT).is_file()
    return path.suffix == ".json" or path.name == _PAGE


def load_machine(path: Path | str) -> IdentifiedMachine:
    """The identified machine of a report of ``vcal loop``: its folder, its page ``index.html``,
    ``report.json`` or ``machine.json``. The measurement is not needed.

    Raises `StudyError` for a file that is none, for one of another schema, and where an effect
    cannot be restored.
    """
    path = Path(path)
    file = path / FILE if path.is_dir() else path
    if file.name in (_REPORT, _PAGE):
        file = file.with_name(FILE)
    expected = f"{FILE} of a report written by vcal loop, schema {SCHEMA}"
    again = "write the report again with vcal loop, or name the study instead"
    if not file.is_file():
        raise refusal(str(path), "report", f"no {FILE}", expected, again)
    content = _content(file, expected, again)
    schema = content.get("schema")
    if schema != SCHEMA:
        raise refusal(str(file), "key schema", shown(schema), expected, again)
    try:
        return machine_from(content)
    except NotStoredError as error:
        raise refusal(
            str(file), "identified machine", str(error), "a machine that can be restored", again
        ) from error


def _content(file: Path, expected: str, again: str) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        found = f"what is no JSON ({error})"
        raise refusal(str(file), "report", found, expected, again) from error
    if not isinstance(content, dict):
        raise StudyError(str(refusal(str(file), "report", "no table", expected, again)))
    return content
