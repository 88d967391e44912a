"""Study files for tables that vcal writes itself, in its own names and units."""

from collections.abc import Collection, Mapping
from pathlib import PurePath
from typing import Any

from .reading.formats import FORMAT_KEYS

_TEXT = ("", ".csv", ".txt", ".dat", ".tsv", ".asc", ".prn")
"""Endings of files of text."""


def own_name(name: str) -> str:
    """Name of the CSV file that takes the place of a table: ``run.xlsx#Sheet 1`` becomes
    ``run_Sheet_1.csv``; a file of text keeps its name.
    """
    file, _, sheet = name.partition("#")
    path = PurePath(file)
    if path.suffix.lower() in _TEXT and not sheet:
        return name
    stem = "_".join(filter(None, (path.stem, *sheet.split())))
    return str(path.with_name(f"{stem}.csv"))


def with_own_tables(raw: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """A study file as a raw tree for tables `names` that were written anew by `own_name`, without
    the keys that say how they were read.
    """
    found = dict(raw)
    data = raw.get("data", {})
    if isinstance(data, list):
        found["data"] = [_plain(row) | {"file": own_name(row["file"])} for row in data]
    elif data:
        one = _plain(data)
        for key in ("data", "file", "check"):
            if key in one:
                one[key] = own_name(one[key]) if one[key] in names else one[key]
        found["data"] = one
    if "check" in raw and raw["check"] in names:
        found["check"] = own_name(raw["check"])
    tables = {name: form for name, form in raw.get("tables", {}).items() if name not in names}
    found.pop("tables", None)
    return found | ({"tables": tables} if tables else {})


def _plain(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in FORMAT_KEYS}
