"""The reports of one machine below a folder, read and put in the order of their dates."""

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..compensation.stored import SCHEMA as MACHINE_SCHEMA
from ..errors import StudyError
from ..numerics.stored import NotStoredError, Reader
from ..study.identified_machine import FILE as MACHINE
from ..study.messages import listed, refusal, shown
from .dates import dated

REPORT = "report.json"
REPORT_SCHEMA = "vcal-report/1"
_AGAIN = "write the report again with vcal loop, or move it away"
_SAME = 1e-9
"""Largest difference of two positions of joints that are the same, m or rad."""


@dataclass(frozen=True)
class Report:
    """One report: what ``vcal loop`` has written of one measurement."""

    folder: str
    """Path of its folder, below that of all reports."""
    date: datetime.date
    """Date of the measurement."""
    content: Mapping[str, Any] = field(repr=False)
    """``report.json``."""
    record: Mapping[str, Any] = field(repr=False)
    """``machine.json``."""

    @property
    def serial_number(self) -> str:
        """Serial number of the machine; empty where it is not stated."""
        return _serial(self.content)


def read_reports(
    folder: Path | str, dates: Mapping[str, datetime.date] | None = None, *, written: bool = False
) -> list[Report]:
    """The reports below a folder in the order of their dates; see `dated` for `dates` and
    `written`.

    Raises `StudyError` where there is none, for a record that cannot be read, for reports of
    different machines, for reports of the same readings, and as `dated` does.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise refusal(str(folder), "folder", "none", "a folder of reports", "name another")
    found: dict[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {}
    for path in sorted(folder.rglob(REPORT)):
        name = path.parent.relative_to(folder).as_posix()
        expected = f"a report written by vcal loop, schema {REPORT_SCHEMA}"
        content = _content(path, REPORT_SCHEMA, expected)
        record = _content(path.with_name(MACHINE), MACHINE_SCHEMA, f"that of {name}")
        found[name] = content, record
    if not found:
        raise refusal(
            str(folder),
            "folder",
            f"no {REPORT} in it or below it",
            "reports of one machine, each in a folder of its own",
            "write them with vcal loop",
        )
    _one_machine(found)
    _own_readings(found)
    when = dated(found, dates or {}, written)
    reports = [Report(name, when[name], *both) for name, both in found.items()]
    return sorted(reports, key=lambda one: (one.date, one.folder))


def _content(path: Path, schema: str, expected: str) -> Mapping[str, Any]:
    if not path.is_file():
        raise refusal(str(path), "file", "none", expected, _AGAIN)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise refusal(str(path), "file", f"no JSON ({error})", expected, _AGAIN) from error
    if not isinstance(content, dict) or content.get("schema") != schema:
        what = content.get("schema") if isinstance(content, dict) else None
        raise refusal(str(path), "key schema", shown(what), shown(schema), _AGAIN)
    return content


def _serial(content: Mapping[str, Any]) -> str:
    return str(content.get("stated", {}).get("machine", {}).get("serial_number", ""))


def _one_machine(found: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]]) -> None:
    """Refuse reports whose chains, or serial numbers where both state one, differ."""
    first, (_, record) = next(iter(found.items()))
    joints = _joints(record, first)
    same_chain = all(
        other["machine"] == record["machine"] and _alike(joints, _joints(other, name))
        for name, (_, other) in found.items()
    )
    numbers = {number for content, _ in found.values() if (number := _serial(content))}
    if same_chain and len(numbers) < 2:
        return
    lines = []
    for name, (content, other) in found.items():
        number = _serial(content)
        lines.append(f"{name}: {other['machine']}{f', serial number {number}' if number else ''}")
    what = "different machines" if same_chain else "different kinematic chains"
    raise StudyError(
        f"reports: found {what} ({'; '.join(lines)}), expected one machine; move the reports of "
        "the others to another folder"
    )


def _joints(record: Mapping[str, Any], name: str) -> list[np.ndarray]:
    """Fixed transformations of the joints of an arm, whose text does not tell them; else empty."""
    chain = _object(record, "chain", name)
    if not chain.arm:
        return []
    return [np.asarray(m) for joint in chain.joints for m in (joint.before, joint.after)]


def check_points(report: Report) -> Float[np.ndarray, "n axes"] | None:
    """Positions of the check points, m or rad; None without any. Raises `StudyError` for a record
    that is not whole.
    """
    found = _object(report.record, "check", report.folder)
    return None if found is None else np.asarray(dict(found)["position"], float)


def _object(record: Mapping[str, Any], key: str, folder: str) -> Any:
    """An object of ``machine.json``, made again."""
    try:
        objects = record["objects"]
        return Reader(objects["records"], objects["arrays"]).value(objects[key])
    except (NotStoredError, KeyError, IndexError, TypeError, ValueError) as error:
        raise refusal(
            f"{folder}/{MACHINE}", f"key objects.{key}", str(error), "a whole record", _AGAIN
        ) from error


def _alike(first: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> bool:
    return len(first) == len(other) and all(
        np.allclose(a, b, rtol=0.0, atol=_SAME) for a, b in zip(first, other, strict=True)
    )


def _own_readings(found: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]]) -> None:
    """Refuse reports of one set of readings, which are not independent of one another."""
    by_sum: dict[str, list[str]] = {}
    for name, (content, _) in found.items():
        for key in _tables(content):
            if total := content.get("input_files", {}).get(key):
                by_sum.setdefault(total, []).append(name)
    twice = [names for names in by_sum.values() if len(names) > 1]
    if twice:
        raise refusal(
            "; ".join(f"{listed(names)}" for names in twice),
            "readings",
            "the same data file in several reports",
            "measurements that are independent of one another",
            "keep one report of every measurement",
        )


def _tables(content: Mapping[str, Any]) -> list[str]:
    """The tables of readings of a report."""
    study = content.get("settings", {}).get("study", {})
    data = study.get("data", {})
    single = (data.get("file") or data.get("data")) if isinstance(data, dict) else None
    several = [one.get("file") for one in content.get("data_sets", [])]
    return [name for name in (single, *several) if isinstance(name, str)]
