"""Where the numbers of a page come from."""

import datetime
import json
import math
from collections.abc import Mapping

from ..io import Study
from . import text
from .record import plain, versions
from .sheet import Section, Table


def provenance(
    study: Study, settings: Mapping[str, str], command: str, seconds: float, files: str
) -> Section:
    """Input files with their hashes, what was asked for, and the study as it was understood.

    `settings` are further rows, `command` and `seconds` are left out where they are empty or nan,
    and `files` says what lies beside the page.
    """
    rows = [
        *([("command", command)] if command else []),
        *settings.items(),
        ("versions", ", ".join(f"{k} {v}" for k, v in versions().items())),
        *([("time", f"{text.number(seconds)} s")] if math.isfinite(seconds) else []),
        ("written", datetime.datetime.now().strftime("%Y-%m-%d %H:%M")),
    ]
    content = json.dumps(plain(study.as_dict), ensure_ascii=False)
    return Section(
        "Provenance",
        tables=(
            Table(("input file", "SHA-256"), sorted(study.hashes.items())),
            Table(("", ""), rows),
            Table(("",), [(content,)], fold="The study file as it was understood"),
        ),
        note=f"Beside this page: result.json (everything for programs), {files}.",
    )
