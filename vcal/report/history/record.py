"""The record of a history for programs: the content of ``history.json``."""

import math
from typing import Any

from ...history import Appearance, Change, Entry, History, Outcome, Series, Since, Size
from ..html.provenance import plain, versions
from .sentences import lines, sentence

HISTORY_SCHEMA = "vcal-history/1"


def record(history: History, *, command: str = "", seconds: float = math.nan) -> dict[str, Any]:
    """All series of a history with their tests, as plain values; see `HISTORY_SCHEMA`.

    ``history.schema.json`` describes every key. Numbers that do not exist are None.
    """
    return plain(
        {
            "schema": HISTORY_SCHEMA,
            "sentence": sentence(history),
            "changes": lines(history),
            "machine": history.machine,
            "serial_number": history.serial_number or None,
            "reports": [
                {
                    "folder": one.folder,
                    "date": str(one.date),
                    "name": one.content["name"],
                    "sha256": one.content.get("sha256", {}).get("report.json"),
                }
                for one in history.reports
            ],
            "alpha": history.alpha,
            "tests": history.tests,
            "effective_tests": history.effective,
            "series": [_series(history, one) for one in history.outcomes],
            "notes": list(history.notes),
            "versions": versions(),
            "seconds": seconds,
            "command": command,
        }
    )


def _series(history: History, one: Outcome) -> dict[str, Any]:
    series, tested = one.series, one.tested
    return {
        "name": series.name,
        "group": series.group,
        "entries": [
            {"date": str(report.date), **_entry(series, entry)}
            for report, entry in zip(history.reports, series.entries, strict=True)
        ],
        "tests": 0 if tested is None else len(tested.alternatives),
        "effective_tests": None if tested is None else tested.effective,
        "p_value": None if tested is None else one.p_value,
        "changes": [_change(series, change) for change in one.changes],
        "remaining_p_value": None if tested is None else one.remaining_p_value,
        "since_last_report": None if one.since is None else _since(series, one.since),
        "appearances": [_appearance(found) for found in one.appearances],
    }


def _entry(series: Series, entry: Entry) -> dict[str, Any]:
    found: dict[str, Any] = {"state": entry.state}
    if entry.size is not None:
        found["values"] = _size(series, entry.size)
    if entry.smallest:
        found["smallest_sizes"] = [
            {"name": part.name, "unit": part.unit, "size": size}
            for part, size in zip(series.parts, entry.smallest, strict=True)
        ]
    return found


def _size(series: Series, size: Size) -> list[dict[str, Any]]:
    return [
        {"name": part.name, "unit": part.unit, "value": value, "standard_uncertainty": u}
        for part, value, u in zip(series.parts, size.value, size.u, strict=True)
    ]


def _change(series: Series, change: Change) -> dict[str, Any]:
    return {
        "kind": change.kind,
        "size": _size(series, change.size),
        "first": str(change.first),
        "last": str(change.last),
        "p_value": change.p_value,
    }


def _since(series: Series, since: Since) -> dict[str, Any]:
    return {
        "first": str(since.first),
        "last": str(since.last),
        "difference": _size(series, since.size),
        "p_value": since.p_value,
        "corrected_p_value": since.corrected,
    }


def _appearance(found: Appearance) -> dict[str, Any]:
    return {
        "what": found.what,
        "name": found.part,
        "unit": found.unit,
        "value": found.value,
        "standard_uncertainty": found.u,
        "smallest_size": found.smallest,
        "first": str(found.first),
        "last": str(found.last),
    }
