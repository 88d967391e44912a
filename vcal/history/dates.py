"""Dates of measurement: stated by the study of a report, or in a table of folders and dates."""

import csv
import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..study.messages import listed, refusal

HEADER = ("folder", "date")
_EXPECTED = "year, month and day such as 2026-03-14"


def read_dates(path: Path | str) -> dict[str, datetime.date]:
    """Dates by folder from a CSV table with the columns ``folder`` and ``date``.

    Raises `StudyError` for another header, a date of another form, and a folder that is twice.
    """
    path = Path(path)
    text = path.read_text(encoding="utf-8-sig")
    lines = [(n, row) for n, row in enumerate(csv.reader(text.splitlines()), 1) if any(row)]
    header = tuple(cell.strip() for cell in lines[0][1]) if lines else ()
    if header != HEADER:
        what = ",".join(header) or "nothing"
        raise refusal(path.name, "header", what, ",".join(HEADER), "correct the first line")
    found: dict[str, datetime.date] = {}
    for number, row in lines[1:]:
        where = f"line {number}"
        if len(row) != len(HEADER):
            many = f"{len(row)} cells"
            raise refusal(path.name, where, many, f"{len(HEADER)}, as in the header", "correct it")
        folder = row[0].strip().rstrip("/")
        if folder in found:
            raise refusal(path.name, where, f"{folder!r} again", "every folder once", "remove one")
        found[folder] = _date(row[1].strip(), path.name, f"{where}, column date")
    return found


def dated(
    stated: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]],
    given: Mapping[str, datetime.date],
    written: bool = False,
) -> dict[str, datetime.date]:
    """The date of measurement of every report, by its folder.

    `stated` holds ``report.json`` and ``machine.json`` by folder. A date in `given` comes first,
    then that of ``[measurement]`` of the study; with `written`, the day on which the report was
    made stands for one that is missing. Raises `StudyError` with all folders that have no date, and
    for a folder in `given` that holds no report.
    """
    if unknown := [name for name in given if name not in stated]:
        raise refusal(
            "dates",
            "column folder",
            listed(unknown),
            f"folders of reports ({listed(stated)})",
            "correct or remove them",
        )
    found, without = {}, []
    for folder, (report, machine) in stated.items():
        text = report.get("stated", {}).get("measurement", {}).get("date")
        if text is None and written:
            text = machine.get("date") or None
        if folder in given:
            found[folder] = given[folder]
        elif text is None:
            without.append(folder)
        else:
            found[folder] = _date(str(text), folder, "date of the measurement")
    if without:
        raise refusal(
            listed(without),
            "date of the measurement",
            "none",
            "one for every report",
            "state it as date in [measurement] of the study before vcal loop, list it in a table "
            f"with the header {','.join(HEADER)} (--dates FILE), or take the day on which each "
            "report was written (--date-written)",
        )
    return found


def _date(text: str, file: str, where: str) -> datetime.date:
    try:
        return datetime.date.fromisoformat(text)
    except ValueError as error:
        raise refusal(file, where, repr(text), _EXPECTED, "correct it") from error
