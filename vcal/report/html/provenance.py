"""Provenance of a report, for its page and its record, and the conventions that pages share."""

import datetime
import json
import math
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...study import Study
from ...study.reading.text import PLAIN
from . import text
from .sheet import Section, Table

NAMES = (
    "Right-handed frames. Error = actual − nominal; a compensation subtracts it. Names of ISO "
    "230-1: E, then the component (X, Y, Z translations; A, B, C rotations about them), then the "
    "axis that moves; location errors such as EC0Y. Signs refer to the axis's own frame."
)
EXPANDED = "u is a standard uncertainty, U = k u the expanded uncertainty with k = 2."
_PACKAGES = ("jax", "jaxlib", "optimistix", "numpy")


def provenance_section(
    study: Study,
    settings: Mapping[str, str],
    files: Mapping[str, str],
    command: str,
    seconds: float,
) -> Section:
    """Input files with their hashes, command, settings, versions and the study as it was read.

    `settings` are further rows, `files` describe the files beside the page by their names;
    `command` and `seconds` are left out where they are empty or nan.
    """
    rows = [
        *([("command", command)] if command else []),
        *settings.items(),
        ("versions", ", ".join(f"{k} {v}" for k, v in versions().items())),
        *([("time", f"{text.number(seconds)} s")] if math.isfinite(seconds) else []),
        ("written", datetime.datetime.now().strftime("%Y-%m-%d %H:%M")),
    ]
    content = json.dumps(plain(study.as_dict), indent=1, ensure_ascii=False)
    header, links = ("file beside this page", "content"), {name: name for name in files}
    beside = Table(header, [*files.items()], links=links)
    return Section(
        "Provenance",
        tables=(
            Table(("input file", "SHA-256"), sorted(study.hashes.items()), "lc"),
            *_tables_read(study),
            Table(("", ""), rows),
            Table(("",), [(content,)], "c", fold="The study file as read, defaults included"),
            *([beside] if files else []),
        ),
    )


def _tables_read(study: Study) -> list[Table]:
    """How the input tables were read, where one is no plain CSV file in vcal's own columns."""
    rows = [
        (name, table.kind, "; ".join(one.words for one in table.changed) or "as named")
        for name, table in study.tables.items()
        if table.changed or table.kind != PLAIN
    ]
    return [Table(("table", "file", "columns as read"), rows, "lll")] if rows else []


def provenance_record(
    study: Study, settings: Mapping[str, Any], command: str, seconds: float
) -> dict[str, Any]:
    """The same for programs: settings, versions, run time in s, input files and command."""
    return {
        "settings": {**settings, "study": study.as_dict},
        "versions": versions(),
        "seconds": seconds,
        "input_files": dict(study.hashes),
        "tables_read": [
            {"table": name, "file": table.kind, "columns": [one.record for one in table.changed]}
            for name, table in study.tables.items()
        ],
        "command": command,
    }


def versions() -> dict[str, str]:
    """Versions of vcal, of Python and of the packages that compute."""
    found = {"vcal": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found


def plain(value: Any) -> Any:
    """The value in the types of JSON: numpy to Python, numbers that are not finite to None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, str):
        return value
    return str(value) if isinstance(value, Path) else repr(value)
