"""Where the numbers of a page come from."""

import datetime
import json
import math
from collections.abc import Mapping

from ...study import Study
from ..loop.record import plain, versions
from . import text
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


NAMES = (
    "Right-handed frames. Error = actual − nominal; a compensation subtracts it. Names of ISO "
    "230-1: E, then the component (X, Y, Z translations; A, B, C rotations about them), then the "
    "axis that moves; location errors such as EC0Y. Signs as parameters of the axis's own frame."
)
EXPANDED = "u is a standard uncertainty, U = k u with k = 2."
